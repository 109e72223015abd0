"""Energy spectra and their bands: third octaves, triangular bands (mel or evenly spaced) and wavelet packets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import optional

#: Nominal mid-band frequencies of the third-octave bands [Hz] (IEC 61260-1:2014), as in feature names. The exact ones
#: are 1000 Hz times 10^(number / 10), with numbers from `_FIRST_THIRD_OCTAVE` on.
THIRD_OCTAVES = (
    *("8", "10", "12.5", "16", "20", "25"),
    *("31.5", "40", "50", "63", "80", "100", "125", "160", "200", "250", "315", "400", "500"),
    *("630", "800", "1000", "1250", "1600", "2000", "2500", "3150", "4000", "5000", "6300", "8000", "10000"),
)
_FIRST_THIRD_OCTAVE = -21
#: Spacing of the mel bands [mel], and their number.
_MEL_STEP, _MEL_BANDS = 100.0, 39
#: Spacing of the even bands [Hz], and their number.
_EVEN_STEP, _EVEN_BANDS = 150.0, 150
#: Daubechies' wavelet with eight vanishing moments: its bands overlap little, and it is short.
WAVELET = "db8"
#: Number of halvings of the band, and of the resulting packets.
LEVEL, N_PACKETS = 4, 16
#: Upper end of the spectra times the contact duration: above it a clean pulse has almost no energy (a low-pass there
#: changes the peak by less than 1 %), but noise has.
SPECTRUM_LIMIT = 4.0
#: Least length of a spectrum's transform over that of the contact (zero-padding).
_ZERO_PADDING = 8
#: Smallest share of an energy: anything less is rounding, not vibration.
MIN_SHARE = 1e-12


def third_octave(number: int) -> tuple[float, float]:
    """Return the edges [Hz] of a third-octave band, numbered from the first of `THIRD_OCTAVES`."""
    middle = 1000.0 * 10 ** ((_FIRST_THIRD_OCTAVE + number) / 10)
    return middle * 10**-0.05, middle * 10**0.05


def mel(frequency: Floats) -> Floats:
    """Return the mel of frequencies [Hz] (O'Shaughnessy 1987): even steps below 1 kHz, even ratios far above."""
    return np.asarray(2595.0 * np.log10(1.0 + frequency / 700.0))


def frequency_of(mels: Floats) -> Floats:
    """Return the frequencies [Hz] of mels."""
    return np.asarray(700.0 * (10.0 ** (mels / 2595.0) - 1.0))


@dataclass(frozen=True, eq=False, repr=False)
class TriangularBands:
    """A bank of overlapping triangular bands: between the first and the last centre they add up to 1."""

    corners: Floats  # (n_bands + 2,) [Hz]: lowest edge, centres, highest edge

    @property
    def centres(self) -> Floats:
        """Centres of the bands [Hz], (n_bands,)."""
        return self.corners[1:-1]

    @property
    def labels(self) -> list[str]:
        """The centres as in feature names."""
        return [f"{centre:.0f}" for centre in self.centres]

    def __len__(self) -> int:
        return len(self.corners) - 2

    def within(self, highest: float) -> TriangularBands:
        """Return the bands that end at or below a frequency [Hz]."""
        return TriangularBands(self.corners[: max(int(np.searchsorted(self.corners, highest, side="right")), 2)])

    def sums(self, energy: Floats, spacing: float) -> Floats:
        """Return the energy in each band, (..., n_bands), from the energy in each bin, (..., n_bins)."""
        # Bins are `spacing` [Hz] apart, the first at 0 Hz. Not a matrix product, whose rows would depend on each other.
        first, stop = (int(np.ceil(edge / spacing)) for edge in (self.corners[0], self.corners[-1]))
        stop = min(stop, energy.shape[-1])
        frequency = np.arange(first, stop) * spacing
        # Position of each bin between the corner below and the one above.
        gap = np.clip(np.searchsorted(self.corners, frequency, side="right") - 1, 0, len(self))
        rise = (frequency - self.corners[gap]) / np.diff(self.corners)[gap]
        begin = np.searchsorted(gap, np.arange(len(self) + 1))
        starts = np.flatnonzero(np.diff(np.append(begin, gap.size)))
        # Bins first: the sums then run along all rows at once, but separately for each row.
        part = np.ascontiguousarray(energy.reshape(-1, energy.shape[-1])[:, first:stop].T)
        out = np.zeros((len(self) + 2, part.shape[1]))
        if starts.size:
            complete = np.add.reduceat(part, begin[starts], axis=0)
            part *= rise[:, None]
            rising = np.add.reduceat(part, begin[starts], axis=0)
            out[starts + 1] += rising
            out[starts] += complete - rising
        return np.ascontiguousarray(out[1:-1].T).reshape(*energy.shape[:-1], len(self))


#: 39 bands, 100 mel apart, up to 23.7 kHz.
MEL_BANDS = TriangularBands(frequency_of(_MEL_STEP * np.arange(_MEL_BANDS + 2, dtype=np.float64)))
#: 150 bands, 150 Hz apart, up to 22.65 kHz: small bodies ring high, where mel bands are a kilohertz wide.
EVEN_BANDS = TriangularBands(_EVEN_STEP * np.arange(_EVEN_BANDS + 2, dtype=np.float64))


@dataclass(frozen=True, eq=False, repr=False)
class EnergySpectrum:
    """One-sided energy spectra of rows of samples, all at the same frequencies."""

    spacing: float  # width of a bin [Hz]; the first is centred at 0 Hz
    # in each bin, (n_signals, n_bins) [unit^2 s]; the bins of a row add up to its sum of squares over the sampling rate
    # (Parseval)
    energy: Floats

    @classmethod
    def of(cls, samples: Floats, sampling_rate: float, finer: int = 1) -> EnergySpectrum:
        """Return the spectra of rows of samples, zero-padded to a fast length of at least `finer` times their own."""
        length = padded_length(finer * samples.shape[1])
        transform = np.fft.rfft(samples, n=length, axis=1)
        energy = transform.real**2 + transform.imag**2
        energy *= 2 / (length * sampling_rate)
        # 0 Hz and half the sampling rate have no mirror image.
        energy[:, 0] *= 0.5
        energy[:, -1] *= 0.5
        return cls(sampling_rate / length, np.asarray(energy))

    @property
    def frequency(self) -> Floats:
        """Centres of the bins [Hz], (n_bins,)."""
        return np.arange(self.energy.shape[1], dtype=np.float64) * self.spacing

    @cached_property
    def _running(self) -> Floats:
        """Energy below each bin's lower edge, (n_signals, n_bins + 1)."""
        out = np.zeros((len(self.energy), self.energy.shape[1] + 1))
        np.cumsum(self.energy, axis=1, out=out[:, 1:])
        return out

    @property
    def total(self) -> Floats:
        """Energy of each row [unit^2 s]."""
        return np.asarray(self._running[:, -1])

    def between(self, low: float, high: float) -> Floats:
        """Return the energy between two frequencies [Hz]; the energy of a bin is spread evenly over its width."""
        return np.asarray(self._below(high) - self._below(low))

    def _below(self, frequency: float) -> Floats:
        position, last = frequency / self.spacing + 0.5, self.energy.shape[1] - 1
        n_bins = min(int(position), last)
        # The first and the last bin have half a width, above 0 Hz and below half the sampling rate.
        share = position - n_bins if 0 < n_bins < last else 2 * (position - n_bins) - (n_bins == 0)
        before, after = self._running[:, n_bins], self._running[:, n_bins + 1]
        return np.asarray(before + min(share, 1.0) * (after - before))

    # -- shape ----------------------------------------------------------------------------------------

    @cached_property
    def moments(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of the frequency, weighted by energy [Hz]."""
        total = self.energy.sum(axis=1)
        mean = np.sum(self.energy * self.frequency, axis=1) / total
        square = np.sum(self.energy * (self.frequency - mean[:, None]) ** 2, axis=1) / total
        return mean, np.sqrt(square)

    @cached_property
    def standardised_moments(self) -> tuple[Floats, Floats]:
        """Third and fourth moment of the frequency about its mean, in standard deviations."""
        # They depend on the sampling rate: the energy falls with the fourth power of the frequency, so the third moment
        # grows like the logarithm of the rate, the fourth in proportion to it.
        mean, deviation = self.moments
        # A line within one bin is as wide as the bin.
        position = (self.frequency - mean[:, None]) / np.maximum(deviation, 0.1 * self.spacing)[:, None]
        share = self.energy / self.energy.sum(axis=1)[:, None]
        return np.asarray(np.sum(share * position**3, axis=1)), np.asarray(np.sum(share * position**4, axis=1))

    def rolloff(self, share: float) -> Floats:
        """Return the frequency below which the spectrum has a fraction of its energy [Hz]."""
        # A bin extends half its width to either side.
        bins = passage(np.cumsum(self.energy, axis=1), share) - 0.5
        return np.maximum(bins, 0.5) * self.spacing

    @cached_property
    def flatness(self) -> Floats:
        """Log10 of the geometric over the arithmetic mean above 0 Hz; it depends on the sampling rate."""
        above = self.energy[:, 1:]
        mean = above.mean(axis=1)
        floor = np.maximum(MIN_SHARE * mean, np.finfo(np.float64).tiny)[:, None]
        return np.asarray(np.log10(np.maximum(above, floor)).mean(axis=1) - np.log10(np.maximum(mean, floor[:, 0])))

    def dominant(self, count: int, separation: float) -> Floats:
        """Return the `count` strongest maxima, at least `separation` apart [Hz]; repeat the last if there are fewer."""
        energy, rows = self.energy, np.arange(len(self.energy))
        padded = np.pad(energy, ((0, 0), (1, 1)), constant_values=-1.0)
        maxima = np.where((energy > padded[:, :-2]) & (energy >= padded[:, 2:]), energy, 0.0)
        out, reach = np.empty((len(energy), count)), np.arange(energy.shape[1])
        for position in range(count):
            top = np.argmax(maxima, axis=1)
            has_peak = maxima[rows, top] > 0
            before, peak, after = (padded[rows, top + step] for step in range(3))
            bend = before - 2 * peak + after
            # A parabola through three bins; at the ends of the spectrum there are only two.
            inside = (bend < 0) & (before >= 0) & (after >= 0)
            shift = np.where(inside, 0.5 * (before - after) / np.where(inside, bend, -1.0), 0.0)
            last = out[:, position - 1] if position else np.zeros(len(energy))
            out[:, position] = np.where(has_peak, (top + shift) * self.spacing, last)
            maxima[np.abs(reach - top[:, None]) * self.spacing < separation] = 0.0
        return out


class PulseSpectrum:
    """Power spectra (n_signals, n_bins) of pulses up to `SPECTRUM_LIMIT` over the contact duration, zero-padded."""

    # Windows (n_signals, n_samples) are zero outside contact. The padding, at least `_ZERO_PADDING` times the row's own
    # contact, makes a row independent of the others. Power is zero beyond `n_bins` (n_signals,).

    def __init__(self, windows: Floats, onset: Floats, separation: Floats, sampling_rate: float) -> None:
        min_length = np.maximum(_ZERO_PADDING * np.ceil(separation - onset + 1), 64)
        lengths = np.asarray(2 ** np.ceil(np.log2(min_length)).astype(np.intp))
        top = np.minimum(SPECTRUM_LIMIT / ((separation - onset) / sampling_rate), sampling_rate / 2)
        self.n_bins = np.floor(top * lengths / sampling_rate).astype(np.intp) + 1
        power = np.zeros((len(lengths), int(self.n_bins.max())))
        first, last = np.maximum(np.ceil(onset).astype(np.intp), 0), windows.shape[1] - 1
        for length in np.unique(lengths):
            rows = np.flatnonzero(lengths == length)
            columns = first[rows, None] + np.arange(int(np.ceil((separation - onset)[rows].max())) + 1)
            force = np.where(columns <= last, windows[rows[:, None], np.minimum(columns, last)], 0.0)
            max_bins = int(self.n_bins[rows].max())
            power[rows, :max_bins] = np.abs(np.fft.rfft(force, n=int(length)))[:, :max_bins] ** 2
        power[np.arange(power.shape[1]) >= self.n_bins[:, None]] = 0.0
        self.frequency, self.power = np.arange(power.shape[1]) * (sampling_rate / lengths)[:, None], power

    @cached_property
    def cumulative(self) -> Floats:
        """Share of the energy up to each frequency, (n_signals, n_bins), by the trapezoid rule."""
        steps = 0.5 * (self.power[:, 1:] + self.power[:, :-1])
        # No step from a row's last bin to its padding.
        steps[np.arange(1, self.power.shape[1]) >= self.n_bins[:, None]] = 0.0
        total = np.cumsum(steps, axis=1)
        return np.concatenate([np.zeros((len(total), 1)), total / total[:, -1:]], axis=1)

    @cached_property
    def moments(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of the frequency, weighted by power [Hz]."""
        mean = self._mean(self.frequency)
        return mean, np.sqrt(self._mean((self.frequency - mean[:, None]) ** 2))

    def _mean(self, values: Floats) -> Floats:
        """Return the mean weighted by power, by the trapezoid rule: the bin at 0 Hz has half a bin's width."""
        weight = self.power.copy()
        weight[:, 0] *= 0.5
        return np.asarray(np.sum(values * weight, axis=1) / weight.sum(axis=1))

    @property
    def rolloff(self) -> Floats:
        """Frequency below which the spectrum has 85 % of its energy [Hz]."""
        return self._where(self.cumulative, self.cumulative >= 0.85, 0.85)

    @property
    def cutoff(self) -> Floats:
        """Frequency where the spectrum first is 10 dB below its value at 0 Hz; if nowhere, its last frequency [Hz]."""
        decibel = 10 * np.log10(np.maximum(self.power, 1e-30 * self.power[:, :1]) / self.power[:, :1])
        reached = (decibel <= -10.0) & (np.arange(decibel.shape[1]) < self.n_bins[:, None])
        last = self.frequency[np.arange(len(decibel)), self.n_bins - 1]
        return np.where(reached.any(axis=1), self._where(decibel, reached, -10.0), last)

    def _where(self, curve: Floats, reached: NDArray[np.bool_], level: float) -> Floats:
        """Return the frequency at which a curve first reaches a level, linear between two bins."""
        rows, after = np.arange(len(curve)), np.maximum(np.argmax(reached, axis=1), 1)
        low, high = curve[rows, after - 1], curve[rows, after]
        share = np.clip((level - low) / np.where(high == low, 1.0, high - low), 0.0, 1.0)
        before = self.frequency[rows, after - 1]
        return np.asarray(before + share * (self.frequency[rows, after] - before))

    def between(self, low: float, high: float) -> Floats:
        """Return the share of the energy between two frequencies [Hz]."""
        return self._below(high) - self._below(low)

    def _below(self, limit: float) -> Floats:
        position, last = limit / self.frequency[:, 1], self.power.shape[1] - 1
        before = np.minimum(position.astype(np.intp), last)
        rows, after = np.arange(len(before)), np.minimum(before + 1, last)
        low, high = self.cumulative[rows, before], self.cumulative[rows, after]
        return np.asarray(low + (position - before).clip(0, 1) * (high - low))


def hann(length: int) -> Floats:
    """Return one period of the Hann window, sampled so that it is never zero."""
    return np.asarray(np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2)


def frame_spectra(samples: Floats, length: int, sampling_rate: float) -> tuple[float, Floats]:
    """Return bin width [Hz] and energies (n_rows, n_frames, n_bins) of half-overlapping Hann frames [unit^2 s]."""
    frames = np.lib.stride_tricks.sliding_window_view(samples, length, axis=1)[:, :: max(length // 2, 1)]
    spectrum = EnergySpectrum.of((frames * hann(length)).reshape(-1, length), sampling_rate, finer=2)
    return spectrum.spacing, spectrum.energy.reshape(len(samples), frames.shape[1], -1)


def padded_length(length: int) -> int:
    """Return a length of at least `length` samples with a fast transform: 4 to 8 times a power of two.

    >>> padded_length(882), padded_length(1024)
    (896, 1024)
    """
    step = 1 << max(length.bit_length() - 3, 1)
    return -(-length // step) * step


def passage(running: Floats, share: float) -> Floats:
    """Return after how many columns each running sum first reaches a share of its end, linear within a column."""
    level, rows = share * running[:, -1], np.arange(len(running))
    after = np.argmax(running >= level[:, None], axis=1)
    high = running[rows, after]
    low = np.where(after > 0, running[rows, np.maximum(after - 1, 0)], 0.0)
    step = np.where(high > low, high - low, 1.0)
    return np.asarray(after + np.clip((level - low) / step, 0.0, 1.0))


def packet_energies(samples: Floats) -> Floats:
    """Return the sum of squares of each wavelet packet, (n_rows, 16), the lowest band first; they sum to the row's."""
    pywt = optional("pywt", "wavelet packets need", "wavelets", name="PyWavelets")
    packets = [np.pad(samples, ((0, 0), (0, -samples.shape[1] % N_PACKETS)))]
    for _ in range(LEVEL):
        halves: list[Floats] = []
        for number, packet in enumerate(packets):
            low, high = pywt.dwt(packet, WAVELET, "periodization", axis=1)
            # Decimation reversed the frequencies of every second band.
            halves += [high, low] if number % 2 else [low, high]
        packets = halves
    return np.stack([np.square(packet).sum(axis=1) for packet in packets], axis=1)

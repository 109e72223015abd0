"""What can be measured on a batch of ringing signals, each quantity once and only when asked for.

A struck structure answers with an oscillation of both signs that begins at once and dies away. Everything here is
relative to a baseline and a noise taken before touch, and happens in an event: the samples from the onset on.

Most of it looks at the event times `exp(-t / WINDOW_TIME)`, the exponential window of impact testing: what comes late
weighs little, be it noise, the next blow or the end of the frame. So frames of other lengths are measured alike.

Other sampling rates give the same numbers, too, as long as the vibration lies well below half of the lower one. Three
numbers depend on the rate all the same, for all of the spectrum tells them: skewness, kurtosis and flatness
(`EnergySpectrum`).

The features of a vibration: a signal of both signs that an impact starts and that dies away.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from cgid.measure.frames import Frames
from cgid.measure.spectra import (
    LEVEL,
    LOWEST_SHARE,
    MEL_BANDS,
    N_PACKETS,
    WAVELET,
    EnergySpectrum,
    packet_energies,
    passage,
)
from cgid.measure.table import OF_THE_RATE, Feature
from cgid.validation import Floats

#: Time constant of the exponential window [s]. It widens a line by 1 / (pi WINDOW_TIME) = 21 Hz.
WINDOW_TIME = 15e-3
#: Maxima of the spectrum are further apart than this [Hz]: several widths of a line.
APART = 100.0
#: Length of the frames that say when the energy of a band comes [s].
DELAY_FRAME = 10e-3
#: Later than this after the onset nothing is looked at: the window has fallen to 2e-6 [s].
LONGEST_EVENT = 0.2
#: With less after the onset nothing can be said of a vibration [s].
SHORTEST_EVENT = 5e-3
#: The onset is where the signal first leaves the baseline by this share of its largest deviation,
ONSET_OVER_PEAK = 0.05
#: or by so many standard deviations of the noise, where that is more (but never by more than the last of these).
ONSET_OVER_NOISE, LATEST_ONSET = 5.0, 0.8
#: Where nobody says when touch is, quiet ends so long before the signal leaves it [s].
QUIET_MARGIN = 1e-3
#: Length of the early window, in which the force still acts [s].
EARLY_TIME = 2e-3
#: What is smaller has no fourth power that is a number.
SMALLEST_PEAK = 1e-75
#: The strong part of an event holds this share of its energy.
STRONG_SHARE = 0.9


class VibrationBatch(Frames):
    """Single ringing events in frames, measured lazily; every row is the same whatever else is in the batch.

    Parameters
    ----------
    samples : ndarray, (n_signals, n_samples)
        One impact's vibration a row, of both signs.
    sampling_rate : float
        [Hz].
    pre_trigger : int or None
        Samples before touch. None: each row's own, up to well before it first leaves what it is at its start.
    remove_baseline : bool
        Whether the mean before touch is subtracted.
    detection_limit : float
        The largest deviation must pass this many standard deviations of what is before touch.
    """

    # -- before touch ---------------------------------------------------------------------------------

    @property
    def n_quiet(self) -> NDArray[np.intp]:
        """Number of samples before touch that baseline and noise are of."""
        if self.pre_trigger is not None:
            return np.full(len(self.samples), self.pre_trigger, np.intp)
        return self._surely_quiet

    @cached_property
    def _surely_quiet(self) -> NDArray[np.intp]:
        """Samples up to well before the first that leaves what is before the largest deviation."""
        centre = self.samples.mean(axis=1, dtype=np.float64)
        place = np.argmax(np.abs(self.samples - centre[:, None]), axis=1)
        # The first half of what is before the largest deviation says what quiet is.
        mean, noise = self._moments(place // 2)
        deviation = np.abs(self.samples - mean[:, None])
        threshold = _onset_threshold(deviation[np.arange(len(place)), place], noise)
        first = np.argmax(deviation > threshold[:, None], axis=1)
        return np.asarray(np.maximum(first - int(np.ceil(QUIET_MARGIN * self.sampling_rate)), 0))

    # -- the onset ------------------------------------------------------------------------------------

    @cached_property
    def _deviation(self) -> Floats:
        """Distance from the baseline, 0 before touch."""
        offset = self.baseline if self.remove_baseline else np.zeros(len(self.samples))
        deviation = np.abs(self.samples - offset[:, None])
        if self.pre_trigger is None:
            deviation[np.arange(deviation.shape[1]) < self.n_quiet[:, None]] = 0.0
        else:
            deviation[:, : self.pre_trigger] = 0.0
        return deviation

    @cached_property
    def peak(self) -> Floats:
        """The largest distance from the baseline."""
        return np.asarray(self._deviation.max(axis=1))

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """The first sample of the event."""
        return np.asarray(np.argmax(self._deviation > self._threshold[:, None], axis=1))

    @cached_property
    def _threshold(self) -> Floats:
        return _onset_threshold(self.peak, self.noise)

    @cached_property
    def _lead(self) -> Floats:
        """How long before the first sample of the event the threshold is passed [samples], straight between two."""
        rows = np.arange(len(self.first))
        high = self._deviation[rows, self.first]
        low = np.where(self.first > 0, self._deviation[rows, np.maximum(self.first - 1, 0)], 0.0)
        return (high - self._threshold) / np.where(high > low, high - low, 1.0)

    # -- the event ------------------------------------------------------------------------------------

    @cached_property
    def event(self) -> Floats:
        """Samples from the onset on, baseline removed; zeros behind the end of the frame."""
        n_samples = self.samples.shape[1]
        out = np.zeros((len(self.samples), min(n_samples, int(np.ceil(LONGEST_EVENT * self.sampling_rate)))))
        offset = self.baseline if self.remove_baseline else np.zeros(len(self.samples))
        # Row by row: a slice is copied several times faster than the same samples are gathered.
        for row, first in enumerate(self.first.tolist()):
            part = self.samples[row, first : first + out.shape[1]]
            np.subtract(part, offset[row], out=out[row, : part.size])
        return out

    @cached_property
    def n_event(self) -> NDArray[np.intp]:
        """Samples of the frame in each event."""
        return np.asarray(np.minimum(self.samples.shape[1] - self.first, self.event.shape[1]))

    @cached_property
    def _window(self) -> Floats:
        return np.exp(-np.arange(self.event.shape[1]) / (WINDOW_TIME * self.sampling_rate))

    @cached_property
    def _noise_share(self) -> Floats:
        """Energy that the noise has in the windowed event [unit^2 s]."""
        sums = np.append(0.0, np.cumsum(self._window**2))
        return np.asarray(self.noise**2 * sums[self.n_event] / self.sampling_rate)

    def _running_energy(self, weight: Floats) -> Floats:
        """Return the energy of the event up to each sample under a weight [unit^2 s], that of the noise taken off.

        At most half of the energy is taken off: before touch, the blow before may still have rung.
        """
        square = self.event**2 * weight
        share = np.append(0.0, np.cumsum(weight))[self.n_event]
        noise = np.minimum(self.noise**2, 0.5 * square.sum(axis=1) / share)
        inside = np.arange(square.shape[1]) < self.n_event[:, None]
        square -= np.where(inside, noise[:, None] * weight, 0.0)
        return np.asarray(np.cumsum(square, axis=1, out=square)) / self.sampling_rate

    @cached_property
    def _growth(self) -> Floats:
        """Energy of the windowed event up to each sample, (n_signals, n_samples)."""
        return self._running_energy(self._window**2)

    def rise(self, share: float) -> Floats:
        """Return the time from the onset until a share of the windowed energy has come [s]."""
        # The energy of a sample comes in the time around it; the first is never all of it.
        count = passage(self._growth, share) - 0.5 + self._lead
        return np.maximum(count, 0.5) / self.sampling_rate

    # -- the strong part ------------------------------------------------------------------------------

    @cached_property
    def _n_strong(self) -> NDArray[np.intp]:
        """Samples until `STRONG_SHARE` of the windowed energy has come."""
        return np.maximum(np.ceil(passage(self._growth, STRONG_SHARE)), 1).astype(np.intp)

    @cached_property
    def _strong(self) -> Floats:
        """The event with everything behind its strong part set to zero."""
        longest = int(self._n_strong.max())
        return np.where(np.arange(longest) < self._n_strong[:, None], self.event[:, :longest], 0.0)

    @cached_property
    def strong_moments(self) -> tuple[Floats, Floats]:
        """Mean of the square and of the fourth power over the strong part."""
        # A running sum, for how a plain one is split depends on the longest row of the batch.
        square = self._strong**2
        second, fourth = (np.cumsum(power, axis=1)[:, -1] for power in (square, square**2))
        return np.asarray(second / self._n_strong), np.asarray(fourth / self._n_strong)

    @cached_property
    def zero_crossing_rate(self) -> Floats:
        """Changes of sign over the length of the strong part [Hz]."""
        sign = np.signbit(self._strong)
        changes = sign[:, 1:] != sign[:, :-1]
        inside = np.arange(1, self._strong.shape[1]) < self._n_strong[:, None]
        return np.asarray(np.sum(changes & inside, axis=1) * self.sampling_rate / self._n_strong)

    # -- times ----------------------------------------------------------------------------------------

    @cached_property
    def time_to_peak(self) -> Floats:
        """From the onset to the largest distance from the baseline [s]."""
        return np.asarray((np.argmax(self._deviation, axis=1) - self.first + self._lead) / self.sampling_rate)

    @cached_property
    def time_to_first_maximum(self) -> Floats:
        """From the onset to where the distance from the baseline first stops growing [s], by a parabola there."""
        size = np.abs(self.event)
        falls = size[:, 1:] < size[:, :-1]
        falls[:, -1] = True
        place = np.argmax(falls, axis=1)
        rows = np.arange(len(place))
        outside = self._deviation[rows, np.maximum(self.first - 1, 0)]
        before = np.where(place > 0, size[rows, place - 1], outside)
        top, after = size[rows, place], size[rows, place + 1]
        bend = before - 2 * top + after
        shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
        # Never before the onset, however the parabola bends.
        return np.asarray(np.maximum(place + np.clip(shift, -0.5, 0.5) + self._lead, 0.05) / self.sampling_rate)

    @cached_property
    def decay_time(self) -> Floats:
        """Time in which the energy falls by 60 dB, from where what is still to come is 5 and 15 dB down [s].

        Schroeder's backward integral of the event without window, the noise taken off. It ends with the frame: a
        vibration that goes on behind it comes out too short.
        """
        running = self._running_energy(np.ones(self.event.shape[1]))
        five, fifteen = (passage(running, 1 - 10**-fall) for fall in (0.5, 1.5))
        return np.asarray(6 * np.maximum(fifteen - five, 1.0) / self.sampling_rate)

    # -- the spectrum ---------------------------------------------------------------------------------

    @cached_property
    def spectrum(self) -> EnergySpectrum:
        """Of the windowed event."""
        return EnergySpectrum.of(self.event * self._window, self.sampling_rate)

    def level(self, low: float, high: float) -> Floats:
        """Return the logarithm (base 10) of the energy between two frequencies [Hz] in the windowed event.

        The share of the noise is taken off, as if it were white; at least that share, and `LOWEST_SHARE` of the
        whole energy, is left.
        """
        return self._level(self.spectrum, self._noise_share, low, high)

    @cached_property
    def total_level(self) -> Floats:
        """Level of all frequencies together."""
        return self.level(0.0, 0.5 * self.sampling_rate)

    def early_level(self, low: float, high: float) -> Floats:
        """Return the level between two frequencies [Hz] in the first `EARLY_TIME` of the event."""
        spectrum, noise = self._early
        return self._level(spectrum, noise, low, high)

    @cached_property
    def _early(self) -> tuple[EnergySpectrum, Floats]:
        """Spectrum of the early window, and the energy that the noise has in it [unit^2 s]."""
        count = min(max(round(EARLY_TIME * self.sampling_rate), 2), self.event.shape[1])
        # Half a cosine bell: an event begins by itself and must not be cut off.
        window = np.cos(np.arange(count) * (0.5 * np.pi / count)) ** 2
        noise = self.noise**2 * (np.sum(window**2) / self.sampling_rate)
        return EnergySpectrum.of(self.event[:, :count] * window, self.sampling_rate, finer=4), noise

    def _level(self, spectrum: EnergySpectrum, noise: Floats, low: float, high: float) -> Floats:
        energy, width = spectrum.between(low, high)[:, None], np.array([high - low])
        return self._levels(energy, spectrum.total, noise, width)[:, 0]

    @cached_property
    def clean_spectrum(self) -> EnergySpectrum:
        """Of the windowed event, the share of the noise taken off each bin but never more than there is."""
        energy = self.spectrum.energy
        clean = np.maximum(energy - (self._noise_share / (energy.shape[1] - 1))[:, None], 0.0)
        # Where noise is all there is, all of it counts.
        return EnergySpectrum(self.spectrum.spacing, np.where((clean > 0).any(axis=1)[:, None], clean, energy))

    @cached_property
    def dominant_frequencies(self) -> Floats:
        """Frequencies of the three strongest maxima of the clean spectrum [Hz], (n_signals, 3)."""
        return self.clean_spectrum.dominant(3, APART)

    # -- bands that overlap ---------------------------------------------------------------------------

    @cached_property
    def mel(self) -> Floats:
        """Level of each of `MEL_BANDS` in the windowed event, (n_signals, n_bands)."""
        bands = MEL_BANDS.within(0.5 * self.sampling_rate)
        width = 0.5 * (bands.corners[2:] - bands.corners[:-2])
        energy = bands.sums(self.spectrum.energy, self.spectrum.spacing)
        return self._levels(energy, self.spectrum.total, self._noise_share, width)

    @cached_property
    def mel_delay(self) -> Floats:
        """When the energy of each of `MEL_BANDS` comes after the onset, in the mean [s], (n_signals, n_bands).

        From the windowed event in frames of `DELAY_FRAME` under Hann bells, the first about the onset: bands that die
        slowly have their energy late.
        """
        length = 2 * max(round(0.5 * DELAY_FRAME * self.sampling_rate), 1)
        bell = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
        padded = np.pad(self.event * self._window, ((0, 0), (length // 2, length // 2)))
        cut = np.lib.stride_tricks.sliding_window_view(padded, length, axis=1)[:, :: length // 2]
        spectrum = EnergySpectrum.of((cut * bell).reshape(-1, length), self.sampling_rate, finer=2)
        energy = MEL_BANDS.within(0.5 * self.sampling_rate).sums(
            spectrum.energy.reshape(*cut.shape[:2], -1), spectrum.spacing
        )
        time = np.arange(cut.shape[1]) * (length // 2 / self.sampling_rate)
        total = np.maximum(energy.sum(axis=1), np.finfo(np.float64).tiny)
        return np.asarray((energy * time[:, None]).sum(axis=1) / total)

    @cached_property
    def packets(self) -> Floats:
        """Level of each wavelet packet of the windowed event, (n_signals, n_packets)."""
        energy = packet_energies(self.event * self._window) / self.sampling_rate
        width = np.full(energy.shape[1], 0.5 * self.sampling_rate / energy.shape[1])
        return self._levels(energy, energy.sum(axis=1), self._noise_share, width)

    def _levels(self, energy: Floats, total: Floats, noise: Floats, width: Floats) -> Floats:
        """Return levels of energies in bands (n_signals, n_bands) of widths [Hz], the share of the noise taken off."""
        share = noise[:, None] * (width / (0.5 * self.sampling_rate))
        least = np.maximum(share, np.maximum(LOWEST_SHARE * total, np.finfo(np.float64).tiny)[:, None])
        return np.asarray(np.log10(np.maximum(energy - share, least)))

    # -- what is wrong with it ------------------------------------------------------------------------

    def problems(self) -> dict[int, str]:
        """Return, for each row that cannot be measured, the rule it breaks, its value and the cure."""
        found: dict[int, str] = {}
        for row in np.flatnonzero(np.ptp(self.samples, axis=1) == 0):
            found[int(row)] = f"no impact: all samples are {self.samples[row, 0]:g}; check the sensor and its cable"
        for row in np.flatnonzero(~(self.peak > self.detection_limit * self.noise) | ~(self.peak > SMALLEST_PEAK)):
            found.setdefault(
                int(row),
                f"no impact: the signal must leave its baseline by {self.detection_limit:g} times the noise, it does "
                f"by {self.peak[row]:.3g} over a noise of {self.noise[row]:.3g}; record nearer or with less noise",
            )
        if self.pre_trigger is None:
            for row in np.flatnonzero(self.first == 0):
                found.setdefault(
                    int(row),
                    "the vibration must begin inside the frame, it is cut off by its start (sample 0): record some "
                    "samples before touch",
                )
        for row in np.flatnonzero(self.samples.shape[1] - self.first < SHORTEST_EVENT * self.sampling_rate):
            there = (self.samples.shape[1] - self.first[row]) / self.sampling_rate
            found.setdefault(
                int(row),
                f"the vibration must last {SHORTEST_EVENT * 1e3:g} ms inside the frame, it is cut off by its end after "
                f"{there * 1e3:.3g} ms: record a longer frame",
            )
        return found


def _onset_threshold(peak: Floats, noise: Floats) -> Floats:
    """Return what a signal must pass to have left its baseline."""
    return np.maximum(ONSET_OVER_PEAK * peak, np.minimum(ONSET_OVER_NOISE * noise, LATEST_ONSET * peak))


#: Nominal mid-band frequencies of the third-octave bands [Hz] (IEC 61260-1:2014), as in their names.
THIRD_OCTAVES = (
    *("31.5", "40", "50", "63", "80", "100", "125", "160", "200", "250", "315", "400", "500"),
    *("630", "800", "1000", "1250", "1600", "2000", "2500", "3150", "4000", "5000", "6300", "8000", "10000"),
)
#: The exact mid-band frequencies are 1000 Hz times 10^(number / 10), counted from here.
_FIRST_BAND = -15
#: Bands of the early window [Hz].
EARLY_BANDS = ((0, 500), (500, 1000), (1000, 2000), (2000, 4000), (4000, 8000))
_Measure = Callable[[VibrationBatch], Floats]
#: Below this there is no vibration of a structure to be measured: half the lowest sampling rate [Hz].
_LEAST_BANDWIDTH = 1000.0

_IEC = "IEC 61260-1:2014 (exact mid-band frequencies, base ten, ideal edges)"
_MEL = "Davis & Mermelstein 1980 (mel bands); O'Shaughnessy 1987 (mel)"
PACKETS_SOURCE = "Coifman, Meyer & Wickerhauser 1992 (wavelet packets); PyWavelets"
_PEETERS = "Peeters 2004, CUIDADO report (spectral shape)"
_SCHROEDER = "Schroeder 1965 (backward integral); as T20 of ISO 3382-1, but from -5 to -15 dB, times 6"
_WINDOWED = f"event x exp(-t/{WINDOW_TIME * 1e3:g} ms), the exponential window of impact testing (Fladung & Rost 1997)"


def band_edges(number: int) -> tuple[float, float]:
    """Return the edges of a third-octave band [Hz], counted from the first of `THIRD_OCTAVES`.

    Examples
    --------
    >>> [round(edge, 2) for edge in band_edges(15)]
    [891.25, 1122.02]
    """
    middle = 1000.0 * 10 ** ((_FIRST_BAND + number) / 10)
    return middle * 10**-0.05, middle * 10**0.05


def _rms(vibration: VibrationBatch) -> Floats:
    return np.sqrt(vibration.strong_moments[0])


def _crest_factor(vibration: VibrationBatch) -> Floats:
    return vibration.peak / _rms(vibration)


def _kurtosis(vibration: VibrationBatch) -> Floats:
    second, fourth = vibration.strong_moments
    return fourth / second**2


def _level(low: float, high: float) -> _Measure:
    return lambda vibration: vibration.level(low, high)


def _relative_level(low: float, high: float) -> _Measure:
    return lambda vibration: vibration.level(low, high) - vibration.total_level


def _early_level(low: float, high: float) -> _Measure:
    return lambda vibration: vibration.early_level(low, high)


def _relative_early_level(low: float, high: float) -> _Measure:
    return lambda vibration: vibration.early_level(low, high) - vibration.total_level


def _dominant(place: int) -> _Measure:
    return lambda vibration: vibration.dominant_frequencies[:, place]


def _vibration(
    name: str,
    unit: str,
    definition: str,
    source: str,
    measure: _Measure,
    *,
    positive: bool = False,
    highest_frequency: float = _LEAST_BANDWIDTH,
    shortest_frame: float = 0.0,
    extra: str = "",
) -> Feature:
    return Feature(
        name,
        unit,
        definition,
        source,
        measure,
        positive=positive,
        kind="vibration",
        highest_frequency=max(highest_frequency, _LEAST_BANDWIDTH),
        shortest_frame=shortest_frame,
        extra=extra,
    )


def _band(name: str, unit: str, definition: str, number: int, measure: _Measure) -> Feature:
    low, high = band_edges(number)
    # A frame cannot tell frequencies apart that are closer than one over its length.
    return _vibration(name, unit, definition, _IEC, measure, highest_frequency=high, shortest_frame=1 / (high - low))


def _bands() -> list[Feature]:
    absolute, relative = [], []
    for number, middle in enumerate(THIRD_OCTAVES):
        name, edges = f"level_{middle}_hz", band_edges(number)
        definition = f"log10 of the energy in the third octave at {middle} Hz, windowed as for level_total"
        absolute.append(_band(name, "log10(U^2 s)", definition, number, _level(*edges)))
        definition = f"{name} minus level_total: the gain of the sensor cancels"
        relative.append(_band(f"relative_{name}", "1", definition, number, _relative_level(*edges)))
    return absolute + relative


def _mel_bands() -> list[Feature]:
    def columns(number: int) -> tuple[_Measure, _Measure, _Measure]:
        return (
            lambda v: v.mel[:, number],
            lambda v: v.mel[:, number] - v.total_level,
            lambda v: v.mel_delay[:, number],
        )

    found: list[list[Feature]] = [[], [], []]
    for number, centre in enumerate(MEL_BANDS.centres.tolist()):
        low, high = (float(MEL_BANDS.corners[number + step]) for step in (0, 2))
        band = partial(_vibration, source=_MEL, highest_frequency=high, shortest_frame=2 / (high - low))
        name, (level, relative, delay) = f"mel_{centre:.0f}_hz", columns(number)
        definition = f"log10 of the energy in the mel band at {centre:.0f} Hz, windowed as for level_total"
        found[0].append(band(name, "log10(U^2 s)", definition, measure=level))
        definition = f"{name} minus level_total: the gain of the sensor cancels"
        found[1].append(band(f"relative_{name}", "1", definition, measure=relative))
        definition = f"when the energy of {name} comes after the onset, in the mean; late where it dies slowly"
        found[2].append(band(f"mel_delay_{centre:.0f}_hz", "s", definition, measure=delay))
    return [feature for features in found for feature in features]


def _packets() -> list[Feature]:
    def columns(number: int) -> tuple[_Measure, _Measure]:
        return (lambda v: v.packets[:, number]), (lambda v: v.packets[:, number] - v.total_level)

    absolute, relative = [], []
    for number in range(N_PACKETS):
        packet = partial(_vibration, source=PACKETS_SOURCE, extra="wavelets")
        name, (level, free) = f"packet_{number + 1}_of_{N_PACKETS}", columns(number)
        definition = (
            f"log10 of the energy in wavelet packet {number + 1} ({WAVELET}, level {LEVEL}, the lowest of {N_PACKETS} "
            "equal bands up to half the sampling rate first), windowed as for level_total"
        )
        absolute.append(packet(name, "log10(U^2 s)", definition, measure=level))
        definition = f"{name} minus level_total: the gain of the sensor cancels"
        relative.append(packet(f"relative_{name}", "1", definition, measure=free))
    return absolute + relative


VIBRATION_FEATURES = (
    _vibration("peak_amplitude", "U", "largest distance from the baseline", "signal amplitude", lambda v: v.peak),
    _vibration(
        "strong_rms",
        "U",
        "root mean square over the strong part: from the onset until 90 % of the windowed energy have come",
        "signal energy",
        _rms,
    ),
    _vibration("crest_factor", "1", "peak_amplitude over strong_rms", "signal shape", _crest_factor, positive=True),
    _vibration(
        "strong_kurtosis",
        "1",
        "fourth moment over the square of the second, strong part",
        "signal shape",
        _kurtosis,
        positive=True,
    ),
    _vibration(
        "zero_crossing_rate",
        "Hz",
        "changes of sign over the length of the strong part; twice the frequency of one mode",
        "Rice 1944 (zero crossings)",
        lambda v: v.zero_crossing_rate,
    ),
    _vibration("decay_time", "s", "time to fall by 60 dB", _SCHROEDER, lambda v: v.decay_time),
    _vibration(
        "vibration_centroid",
        "Hz",
        f"mean frequency, weighted by energy, noise taken off, of the {_WINDOWED}",
        _PEETERS,
        lambda v: v.clean_spectrum.moments[0],
    ),
    _vibration(
        "vibration_spread",
        "Hz",
        "standard deviation about that centroid",
        _PEETERS,
        lambda v: v.clean_spectrum.moments[1],
    ),
    _vibration(
        "vibration_rolloff",
        "Hz",
        "85 % of the same energy lie below",
        _PEETERS,
        lambda v: v.clean_spectrum.rolloff(0.85),
    ),
    _vibration(
        "time_to_first_maximum",
        "s",
        "from the onset (5 % of the peak, or what noise does not reach) to the first maximum of the amplitude",
        "cgid",
        lambda v: v.time_to_first_maximum,
    ),
    _vibration(
        "time_to_peak",
        "s",
        "from the onset to the largest distance from the baseline",
        "cgid",
        lambda v: v.time_to_peak,
    ),
    _vibration("energy_rise_50", "s", f"time to half of the energy of the {_WINDOWED}", "cgid", lambda v: v.rise(0.5)),
    _vibration("energy_rise_90", "s", "time to 90 % of it", "cgid", lambda v: v.rise(0.9)),
    _vibration(
        "level_total",
        "log10(U^2 s)",
        f"log10 of the energy, noise taken off, of the {_WINDOWED}",
        "signal energy",
        lambda v: v.total_level,
    ),
    *_bands(),
    *(
        _vibration(
            f"early_level_{low}_{high}_hz",
            "log10(U^2 s)",
            f"log10 of the energy between {low} and {high} Hz in the first {EARLY_TIME * 1e3:g} ms under half a "
            "cosine bell, noise taken off: the force still acts",
            "cgid",
            _early_level(float(low), float(high)),
            highest_frequency=float(high),
        )
        for low, high in EARLY_BANDS
    ),
    *(
        _vibration(
            f"relative_early_level_{low}_{high}_hz",
            "1",
            f"early_level_{low}_{high}_hz minus level_total: the gain of the sensor cancels",
            "cgid",
            _relative_early_level(float(low), float(high)),
            highest_frequency=float(high),
        )
        for low, high in EARLY_BANDS
    ),
    _vibration(
        "vibration_skewness",
        "1",
        f"third standardised moment about vibration_centroid; {OF_THE_RATE}",
        _PEETERS,
        lambda v: v.clean_spectrum.standardised_moments[0],
    ),
    _vibration(
        "vibration_kurtosis",
        "1",
        f"fourth standardised moment about vibration_centroid; {OF_THE_RATE}",
        _PEETERS,
        lambda v: v.clean_spectrum.standardised_moments[1],
        positive=True,
    ),
    _vibration(
        "vibration_flatness",
        "1",
        "log10 of the geometric over the arithmetic mean of the same spectrum above 0 Hz, noise left in; "
        f"{OF_THE_RATE}",
        _PEETERS,
        lambda v: v.spectrum.flatness,
    ),
    *(
        _vibration(
            f"{order}_frequency",
            "Hz",
            f"frequency of the {strength} maximum of the same spectrum, {APART:g} Hz or more from a stronger one",
            _PEETERS,
            _dominant(place),
        )
        for place, (order, strength) in enumerate(
            (("dominant", "strongest"), ("second", "second strongest"), ("third", "third strongest"))
        )
    ),
    *_mel_bands(),
    *_packets(),
)

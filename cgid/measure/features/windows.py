"""Measurements on windows of a recording, and their features (`WINDOW_FEATURES`, at the end).

In a window many bodies fall, slide and overlap, so single impacts are not located. It is cut into half-overlapping
Hann-windowed frames of `FRAME_TIME`: their mean spectrum describes the sources, the differences between frames the type
of sound. Features with `relative` in their names, frequencies and those without a unit do not depend on the gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.features.table import LEAST_BANDWIDTH, MIN_BANDWIDTH, Bank, Feature, bank, described
from cgid.measure.frames import Problem, ProblemKind
from cgid.measure.spectra import (
    EVEN_BANDS,
    MEL_BANDS,
    MIN_SHARE,
    N_PACKETS,
    THIRD_OCTAVES,
    EnergySpectrum,
    TriangularBands,
    frame_spectra,
    hann,
    packet_energies,
    third_octave,
)

#: Length of a frame [s], or [samples] if that is longer; frames overlap by half.
FRAME_TIME, _FRAME_SAMPLES = 10e-3, 20
#: Averaging time of the envelope, a root mean square [s], or [samples] if that is longer.
ENVELOPE_TIME, _ENVELOPE_SAMPLES = 1e-3, 2
#: An impact is a maximum of the envelope within `IMPACT_TIME` [s] to either side, of at least this many times its mean.
IMPACT_TIME, IMPACT_OVER_MEAN = 3e-3, 1.5
#: Smallest root mean square: the fourth power of anything less underflows.
MIN_RMS = 1e-70
#: Third octaves of windows [Hz]: without an exponential window they cover the audible range.
WINDOW_THIRD_OCTAVES = (*THIRD_OCTAVES, "12500", "16000", "20000")
#: Lags of the autocorrelation of the envelope [s].
CORRELATION_LAGS = (2e-3, 5e-3, 10e-3)
#: Shortest window [s]: three frames, half overlapping.
MIN_WINDOW = 2 * FRAME_TIME


@dataclass(eq=False, repr=False)
class WindowBatch:
    """Windows (n_windows, n_samples) of a recording; each quantity is computed on first use, each row by itself."""

    samples: NDArray[np.floating]
    sampling_rate: float
    remove_baseline: bool = True

    # -- samples --------------------------------------------------------------------------------------

    @cached_property
    def swing(self) -> Floats:
        """The samples, less the mean of each window if `remove_baseline`."""
        swing = self.samples.astype(np.float64)
        if self.remove_baseline:
            swing -= swing.mean(axis=1, keepdims=True)
        return swing

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.square(self.swing))

    @cached_property
    def mean_square(self) -> Floats:
        """Mean square of the samples [unit^2]."""
        return np.asarray(self._square.mean(axis=1))

    @cached_property
    def level(self) -> Floats:
        """Log10 of the mean square."""
        return np.asarray(np.log10(np.maximum(self.mean_square, np.finfo(np.float64).tiny)))

    @cached_property
    def peak(self) -> Floats:
        """Largest distance from the baseline."""
        return np.asarray(np.sqrt(self._square.max(axis=1)))

    @cached_property
    def kurtosis(self) -> Floats:
        """Fourth moment over the square of the second: 3 for Gaussian noise, 1.5 for a tone, more for impacts."""
        return np.asarray(np.square(self._square).mean(axis=1) / self.mean_square**2)

    @cached_property
    def zero_crossing_rate(self) -> Floats:
        """Changes of sign over the length of the window [Hz]."""
        sign = np.signbit(self.swing)
        changes = np.count_nonzero(sign[:, 1:] != sign[:, :-1], axis=1)
        return np.asarray(changes * self.sampling_rate / sign.shape[1])

    # -- the envelope ---------------------------------------------------------------------------------

    @cached_property
    def envelope(self) -> Floats:
        """Root mean square over each `ENVELOPE_TIME`, (n_windows, n_steps)."""
        length = min(round(self._envelope_step * self.sampling_rate), self._square.shape[1])
        count = self._square.shape[1] // length
        steps = self._square[:, : count * length].reshape(-1, count, length)
        return np.asarray(np.sqrt(steps.mean(axis=2)))

    @cached_property
    def _envelope_step(self) -> float:
        return max(round(ENVELOPE_TIME * self.sampling_rate), _ENVELOPE_SAMPLES) / self.sampling_rate

    @cached_property
    def envelope_moments(self) -> tuple[Floats, Floats, Floats]:
        """Deviation over mean, skewness and kurtosis of the envelope."""
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        square = np.square(centred)
        variance = np.maximum(square.mean(axis=1), MIN_SHARE * self.mean_square)
        third, fourth = (square * centred).mean(axis=1), np.square(square).mean(axis=1)
        return np.sqrt(variance) / self._mean_envelope, third / variance**1.5, fourth / variance**2

    @property
    def _mean_envelope(self) -> Floats:
        return np.asarray(np.maximum(self.envelope.mean(axis=1), 1e-6 * np.sqrt(self.mean_square)))

    @cached_property
    def log_envelope(self) -> Floats:
        """Log10 of the envelope."""
        return np.asarray(np.log10(np.maximum(self.envelope, 1e-6 * np.sqrt(self.mean_square)[:, None])))

    def envelope_quantile(self, share: float) -> Floats:
        """Return log10 of a quantile of the envelope."""
        return np.asarray(np.quantile(self.log_envelope, share, axis=1))

    def envelope_correlation(self, lag: float) -> Floats:
        """Return the autocorrelation of the envelope at a lag [s]."""
        steps = min(max(round(lag / self._envelope_step), 1), self.envelope.shape[1] - 1)
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        variance = np.maximum(np.square(centred).sum(axis=1), MIN_SHARE * self.mean_square)
        return np.asarray((centred[:, steps:] * centred[:, : centred.shape[1] - steps]).sum(axis=1) / variance)

    @cached_property
    def blow_rate(self) -> Floats:
        """Impacts per second [Hz]: local maxima of the envelope well above its mean."""
        reach = max(round(IMPACT_TIME / self._envelope_step), 1)
        padded = np.pad(self.envelope, ((0, 0), (reach, reach)))
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
        impacts = (self.envelope >= around.max(axis=2)) & (
            self.envelope > IMPACT_OVER_MEAN * self._mean_envelope[:, None]
        )
        return np.asarray(np.count_nonzero(impacts, axis=1) / (self.envelope.shape[1] * self._envelope_step))

    # -- spectra --------------------------------------------------------------------------------------

    @cached_property
    def _frames(self) -> tuple[float, Floats]:
        """Width of a bin [Hz], and the mean square in each bin of each frame, (n_windows, n_frames, n_bins)."""
        length = min(max(round(FRAME_TIME * self.sampling_rate), _FRAME_SAMPLES), self.swing.shape[1])
        spacing, power = frame_spectra(self.swing, length, self.sampling_rate)
        power *= self.sampling_rate / np.sum(hann(length) ** 2)
        return spacing, power

    @cached_property
    def spectrum(self) -> EnergySpectrum:
        """Mean square in each bin [unit^2], averaged over the frames (Welch)."""
        spacing, power = self._frames
        return EnergySpectrum(spacing, np.asarray(power.mean(axis=1)))

    @cached_property
    def dominant_frequencies(self) -> Floats:
        """Frequencies of the three strongest maxima of the spectrum [Hz], (n_windows, 3)."""
        return self.spectrum.dominant(3, 2 / max(FRAME_TIME, _FRAME_SAMPLES / self.sampling_rate))

    @cached_property
    def _fine_spectrum(self) -> EnergySpectrum:
        """Mean square in the narrow bins of the complete window [unit^2], without frames."""
        bell = hann(self.swing.shape[1])
        spectrum = EnergySpectrum.of(self.swing * bell, self.sampling_rate)
        return EnergySpectrum(spectrum.spacing, spectrum.energy * (self.sampling_rate / np.sum(bell**2)))

    def band_level(self, low: float, high: float) -> Floats:
        """Return log10 of the mean square between two frequencies [Hz]."""
        return np.log10(np.maximum(self._fine_spectrum.between(low, high), self._floor))

    @cached_property
    def packets(self) -> Floats:
        """Log10 of the mean square in each wavelet packet, (n_windows, n_packets)."""
        power = packet_energies(self.swing) / self.swing.shape[1]
        return np.asarray(np.log10(np.maximum(power, self._floor[:, None])))

    @cached_property
    def _floor(self) -> Floats:
        return np.maximum(MIN_SHARE * self.mean_square, np.finfo(np.float64).tiny)

    def _log_levels(self, bands: TriangularBands) -> Floats:
        """Return log10 of the mean square in each frame and band, (n_windows, n_frames, n_bands)."""
        spacing, power = self._frames
        sums = bands.within(0.5 * self.sampling_rate).sums(power, spacing)
        return np.asarray(np.log10(np.maximum(sums, self._floor[:, None, None], out=sums), out=sums))

    @cached_property
    def _mel_levels(self) -> Floats:
        return self._log_levels(MEL_BANDS)

    @cached_property
    def mel(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of log10 of `MEL_BANDS` over the frames, (n_windows, n_bands)."""
        return _over_frames(self._mel_levels)

    @cached_property
    def even(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of log10 of `EVEN_BANDS` over the frames, (n_windows, n_bands)."""
        return _over_frames(self._log_levels(EVEN_BANDS))

    @cached_property
    def flux(self) -> Floats:
        """Change of the log10 mel bands from frame to frame, root mean square over bands."""
        return np.asarray(np.sqrt(np.square(np.diff(self._mel_levels, axis=1)).mean(axis=1).mean(axis=1)))

    # -- rows that cannot be measured -----------------------------------------------------------------

    def problems(self) -> dict[int, Problem]:
        """Map each row that cannot be measured to its problem."""
        problems: dict[int, Problem] = {}
        constant = np.ptp(self.samples, axis=1) == 0
        for row in np.flatnonzero(constant | ~(self.mean_square > MIN_RMS**2)):
            problems[int(row)] = Problem(
                ProblemKind.NO_SIGNAL,
                f"a window must contain a signal, all its samples are {self.samples[row, 0]:g}; check the sensor and "
                "its cable",
            )
        return problems


def _over_frames(levels: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviation over the frames, (n_windows, n_bands)."""
    mean = levels.mean(axis=1)
    return np.asarray(mean), np.sqrt(np.square(levels - mean[:, None]).mean(axis=1))


# -- features -----------------------------------------------------------------------------------------

_described = partial(described, kind="window", highest_frequency=LEAST_BANDWIDTH, shortest_frame=MIN_WINDOW)
_bank = partial(bank, kind="window", shortest_frame=MIN_WINDOW)

_LEVEL, *_SHAPE = _described(
    {
        "window_level": lambda w: w.level,
        "window_peak": lambda w: w.peak,
        "window_crest_factor": lambda w: w.peak / w.mean_square**0.5,
        "window_kurtosis": lambda w: w.kurtosis,
        "window_zero_crossing_rate": lambda w: w.zero_crossing_rate,
        "window_centroid": lambda w: w.spectrum.moments[0],
        "window_spread": lambda w: w.spectrum.moments[1],
        "window_spectral_skewness": lambda w: w.spectrum.standardised_moments[0],
        "window_spectral_kurtosis": lambda w: w.spectrum.standardised_moments[1],
        "window_rolloff_50": lambda w: w.spectrum.rolloff(0.5),
        "window_rolloff_85": lambda w: w.spectrum.rolloff(0.85),
        "window_flatness": lambda w: w.spectrum.flatness,
        "window_dominant_frequency": lambda w: w.dominant_frequencies[:, 0],
        "window_second_frequency": lambda w: w.dominant_frequencies[:, 1],
        "window_third_frequency": lambda w: w.dominant_frequencies[:, 2],
        "window_envelope_variation": lambda w: w.envelope_moments[0],
        "window_envelope_skewness": lambda w: w.envelope_moments[1],
        "window_envelope_kurtosis": lambda w: w.envelope_moments[2],
        "window_envelope_range": lambda w: w.envelope_quantile(0.9) - w.envelope_quantile(0.1),
        "window_envelope_crest": lambda w: w.envelope_quantile(1.0) - w.envelope_quantile(0.5),
    }
)


def _triangular(
    of: str, bands: TriangularBands, measured: Callable[[WindowBatch], tuple[Floats, Floats]]
) -> tuple[Bank, Bank, Bank]:
    """Return banks of the mean, of the mean relative to the total level, and of the deviation over the frames."""
    highest = np.maximum(bands.corners[2:], MIN_BANDWIDTH).tolist()
    bank_of = partial(_bank, labels=bands.labels, highest_frequency=highest)
    mean = bank_of(f"window_{of}_*_hz", lambda w, n: measured(w)[0][:, n])
    deviation = bank_of(f"window_{of}_deviation_*_hz", lambda w, n: measured(w)[1][:, n])
    return mean, mean.less(f"window_relative_{of}_*_hz", _LEVEL), deviation


_OCTAVES = [third_octave(number) for number in range(len(WINDOW_THIRD_OCTAVES))]
_LEVELS = _bank(
    "window_level_*_hz",
    lambda w, n: w.band_level(*third_octave(n)),
    WINDOW_THIRD_OCTAVES,
    highest_frequency=[max(high, LEAST_BANDWIDTH) for _, high in _OCTAVES],
    # A Hann window over all samples makes a line two over its length wide.
    shortest_frame=[max(2 / (high - low), MIN_WINDOW) for low, high in _OCTAVES],
)
_PACKETS = _bank(
    f"window_packet_*_of_{N_PACKETS}",
    lambda w, n: w.packets[:, n],
    [str(number + 1) for number in range(N_PACKETS)],
    highest_frequency=MIN_BANDWIDTH,
    extra="wavelets",
)

WINDOW_FEATURES: tuple[Feature | Bank, ...] = (
    _LEVEL,
    *_SHAPE,
    *_described({"window_flux": lambda w: w.flux}, highest_frequency=MIN_BANDWIDTH),
    _bank(
        "window_envelope_correlation_*_ms",
        lambda w, n: w.envelope_correlation(CORRELATION_LAGS[n]),
        [f"{lag * 1e3:g}" for lag in CORRELATION_LAGS],
        highest_frequency=LEAST_BANDWIDTH,
    ),
    *_described({"window_blow_rate": lambda w: w.blow_rate}),
    _LEVELS,
    _LEVELS.less("window_relative_level_*_hz", _LEVEL),
    *_triangular("mel", MEL_BANDS, lambda w: w.mel),
    *_triangular("even", EVEN_BANDS, lambda w: w.even),
    _PACKETS,
    _PACKETS.less(f"window_relative_packet_*_of_{N_PACKETS}", _LEVEL),
)

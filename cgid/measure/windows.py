"""What can be measured on windows of a recording that nobody has looked for impacts in, lazily, each thing once.

A window is a stretch of a stationary record: many bodies fall, slide and overlap, and none has a beginning. So nothing
here looks for an onset, for noise before touch, or for where a vibration ends.

A window is cut into frames of `FRAME_TIME` that half overlap, each under a Hann bell. Their spectra, averaged, say what
sounds; how much they differ from frame to frame says how: single blows differ, a steady rustle does not.

The features of a window: a stretch of a recording in which anything may happen, with no beginning of its own.

Three kinds of them cancel a sensor's gain: names with `relative`, those without a unit, and frequencies.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from cgid.measure.spectra import (
    EVEN_BANDS,
    LEVEL,
    LOWEST_SHARE,
    MEL_BANDS,
    N_PACKETS,
    WAVELET,
    EnergySpectrum,
    TriangularBands,
    packet_energies,
)
from cgid.measure.table import OF_THE_RATE, Feature
from cgid.measure.vibration import PACKETS_SOURCE, THIRD_OCTAVES, band_edges
from cgid.validation import Floats

#: Length of a frame [s]; the next begins half of it later.
FRAME_TIME = 10e-3
#: The envelope is the root mean square over so long [s].
ENVELOPE_TIME = 1e-3
#: A blow is where the envelope is highest within `BLOW_TIME` to either side [s], and at least so many times its mean.
BLOW_TIME, BLOW_OVER_MEAN = 3e-3, 1.5
#: What is smaller has no fourth power that is a number.
SMALLEST_RMS = 1e-70


class WindowBatch:
    """Windows of a recording; every row is the same whatever else is in the batch.

    Parameters
    ----------
    samples : ndarray, (n_windows, n_samples)
    sampling_rate : float
        [Hz].
    remove_baseline : bool
        Whether the mean of a window is subtracted.
    """

    def __init__(self, samples: NDArray[np.floating], sampling_rate: float, remove_baseline: bool = True) -> None:
        self.samples = samples
        self.sampling_rate = sampling_rate
        self.remove_baseline = remove_baseline

    # -- in time --------------------------------------------------------------------------------------

    @cached_property
    def swing(self) -> Floats:
        """The samples, baseline removed."""
        swing = self.samples.astype(np.float64)
        if self.remove_baseline:
            swing -= swing.mean(axis=1, keepdims=True)
        return swing

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.square(self.swing))

    @cached_property
    def mean_square(self) -> Floats:
        """Of the samples [unit^2]."""
        return np.asarray(self._square.mean(axis=1))

    @cached_property
    def level(self) -> Floats:
        """Logarithm (base 10) of the mean square."""
        return np.asarray(np.log10(np.maximum(self.mean_square, np.finfo(np.float64).tiny)))

    @cached_property
    def peak(self) -> Floats:
        """Largest distance from the baseline."""
        return np.asarray(np.sqrt(self._square.max(axis=1)))

    @cached_property
    def kurtosis(self) -> Floats:
        """Fourth moment over the square of the second: 3 for Gaussian noise, 1.5 for a tone, more for blows."""
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
        length = min(max(round(ENVELOPE_TIME * self.sampling_rate), 1), self._square.shape[1])
        count = self._square.shape[1] // length
        steps = self._square[:, : count * length].reshape(-1, count, length)
        return np.asarray(np.sqrt(steps.mean(axis=2)))

    @cached_property
    def _envelope_step(self) -> float:
        return max(round(ENVELOPE_TIME * self.sampling_rate), 1) / self.sampling_rate

    @cached_property
    def envelope_moments(self) -> tuple[Floats, Floats, Floats]:
        """Deviation over mean, skewness and kurtosis of the envelope."""
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        square = np.square(centred)
        variance = np.maximum(square.mean(axis=1), LOWEST_SHARE * self.mean_square)
        third, fourth = (square * centred).mean(axis=1), np.square(square).mean(axis=1)
        return np.sqrt(variance) / self._mean_envelope, third / variance**1.5, fourth / variance**2

    @property
    def _mean_envelope(self) -> Floats:
        return np.asarray(np.maximum(self.envelope.mean(axis=1), 1e-6 * np.sqrt(self.mean_square)))

    @cached_property
    def log_envelope(self) -> Floats:
        """Logarithm (base 10) of the envelope."""
        return np.asarray(np.log10(np.maximum(self.envelope, 1e-6 * np.sqrt(self.mean_square)[:, None])))

    def envelope_quantile(self, share: float) -> Floats:
        """Return what a share of the envelope stays below, as a logarithm (base 10)."""
        return np.asarray(np.quantile(self.log_envelope, share, axis=1))

    def envelope_correlation(self, lag: float) -> Floats:
        """Return how the envelope correlates with itself a time [s] later: vibrations that die slowly, much."""
        steps = min(max(round(lag / self._envelope_step), 1), self.envelope.shape[1] - 1)
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        variance = np.maximum(np.square(centred).sum(axis=1), LOWEST_SHARE * self.mean_square)
        return np.asarray((centred[:, steps:] * centred[:, : centred.shape[1] - steps]).sum(axis=1) / variance)

    @cached_property
    def blow_rate(self) -> Floats:
        """Blows in a second [Hz]: where the envelope is highest around, and well above its mean."""
        reach = max(round(BLOW_TIME / self._envelope_step), 1)
        padded = np.pad(self.envelope, ((0, 0), (reach, reach)))
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
        blows = (self.envelope >= around.max(axis=2)) & (self.envelope > BLOW_OVER_MEAN * self._mean_envelope[:, None])
        return np.asarray(np.count_nonzero(blows, axis=1) / (self.envelope.shape[1] * self._envelope_step))

    # -- spectra --------------------------------------------------------------------------------------

    @cached_property
    def _frames(self) -> tuple[float, Floats]:
        """Width of a bin [Hz], and the mean square in each of them in each frame, (n_windows, n_frames, n_bins)."""
        n_windows, n_samples = self.swing.shape
        length = min(max(round(FRAME_TIME * self.sampling_rate), 2), n_samples)
        bell = _hann(length)
        cut = np.lib.stride_tricks.sliding_window_view(self.swing, length, axis=1)[:, :: max(length // 2, 1)]
        # Twice as long with zeros behind: bins no wider than half a frame's resolution.
        spectrum = EnergySpectrum.of((cut * bell).reshape(-1, length), self.sampling_rate, finer=2)
        power = spectrum.energy.reshape(n_windows, cut.shape[1], -1)
        power *= self.sampling_rate / np.sum(bell**2)
        return spectrum.spacing, power

    @cached_property
    def spectrum(self) -> EnergySpectrum:
        """Mean square in each bin [unit^2], the mean over the frames (Welch)."""
        spacing, power = self._frames
        return EnergySpectrum(spacing, np.asarray(power.mean(axis=1)))

    @cached_property
    def dominant_frequencies(self) -> Floats:
        """Frequencies of the three strongest maxima of the spectrum [Hz], (n_windows, 3)."""
        return self.spectrum.dominant(3, 2 / FRAME_TIME)

    @cached_property
    def _fine_spectrum(self) -> EnergySpectrum:
        """Mean square in the bins of the whole window [unit^2]: narrow, and no mean over frames."""
        bell = _hann(self.swing.shape[1])
        spectrum = EnergySpectrum.of(self.swing * bell, self.sampling_rate)
        return EnergySpectrum(spectrum.spacing, spectrum.energy * (self.sampling_rate / np.sum(bell**2)))

    def band_level(self, low: float, high: float) -> Floats:
        """Return the logarithm (base 10) of the mean square between two frequencies [Hz]."""
        return np.log10(np.maximum(self._fine_spectrum.between(low, high), self._floor))

    @cached_property
    def packets(self) -> Floats:
        """Logarithm (base 10) of the mean square in each wavelet packet, (n_windows, n_packets)."""
        power = packet_energies(self.swing) / self.swing.shape[1]
        return np.asarray(np.log10(np.maximum(power, self._floor[:, None])))

    @cached_property
    def _floor(self) -> Floats:
        return np.maximum(LOWEST_SHARE * self.mean_square, np.finfo(np.float64).tiny)

    def _log_levels(self, bands: TriangularBands) -> Floats:
        """Return the logarithms (base 10) of the mean square in each frame and band, (n_windows, n_frames, n_bands)."""
        spacing, power = self._frames
        sums = bands.within(0.5 * self.sampling_rate).sums(power, spacing)
        return np.asarray(np.log10(np.maximum(sums, self._floor[:, None, None], out=sums), out=sums))

    @cached_property
    def _mel_levels(self) -> Floats:
        return self._log_levels(MEL_BANDS)

    @cached_property
    def mel(self) -> tuple[Floats, Floats]:
        """Mean and deviation of the logarithms (base 10) of `MEL_BANDS` over the frames, (n_windows, n_bands)."""
        return _over_frames(self._mel_levels)

    @cached_property
    def mel_power(self) -> Floats:
        """Mean square in each of `MEL_BANDS` [unit^2], the mean over the frames, (n_windows, n_bands)."""
        return MEL_BANDS.within(0.5 * self.sampling_rate).sums(self.spectrum.energy, self.spectrum.spacing)

    @cached_property
    def even(self) -> tuple[Floats, Floats]:
        """The same of `EVEN_BANDS`."""
        return _over_frames(self._log_levels(EVEN_BANDS))

    @cached_property
    def flux(self) -> Floats:
        """How much the logarithms of the mel bands change from frame to frame, root mean square over bands."""
        return np.asarray(np.sqrt(np.square(np.diff(self._mel_levels, axis=1)).mean(axis=1).mean(axis=1)))

    # -- what is wrong with it ------------------------------------------------------------------------

    def problems(self) -> dict[int, str]:
        """Return, for each row that cannot be measured, the rule it breaks, its value and the cure."""
        found: dict[int, str] = {}
        constant = np.ptp(self.samples, axis=1) == 0
        for row in np.flatnonzero(constant | ~(self.mean_square > SMALLEST_RMS**2)):
            found[int(row)] = (
                f"a window must hold a signal, all its samples are {self.samples[row, 0]:g}; check the sensor and its "
                "cable"
            )
        return found


def _hann(length: int) -> Floats:
    """Return one period of the bell; it is never zero."""
    return np.asarray(np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2)


def _over_frames(levels: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviation over the frames, (n_windows, n_bands)."""
    mean = levels.mean(axis=1)
    return np.asarray(mean), np.sqrt(np.square(levels - mean[:, None]).mean(axis=1))


_Measure = Callable[[WindowBatch], Floats]

#: Third octaves of windows [Hz]: nothing is windowed away here, so they go on to what can be heard.
WINDOW_THIRD_OCTAVES = (*THIRD_OCTAVES, "12500", "16000", "20000")
#: How much later the envelope is compared with itself [s].
CORRELATION_LAGS = (2e-3, 5e-3, 10e-3)
#: What a window must hold to be called one [s]: three frames, half overlapping.
SHORTEST_WINDOW = 2 * FRAME_TIME
#: Below this there is no vibration of a structure to be measured: half the lowest sampling rate [Hz].
_LEAST_BANDWIDTH = 1000.0

_IEC = "IEC 61260-1:2014 (exact mid-band frequencies, base ten, ideal edges)"
_MEL = "Davis & Mermelstein 1980 (mel bands); O'Shaughnessy 1987 (mel)"
_PEETERS = "Peeters 2004, CUIDADO report (spectral shape), of the mean spectrum of Welch 1967"
_FRAMES = f"frames of {FRAME_TIME * 1e3:g} ms, half overlapping"
_ENVELOPE = f"root mean square over each {ENVELOPE_TIME * 1e3:g} ms"


def _window(
    name: str,
    unit: str,
    definition: str,
    source: str,
    measure: _Measure,
    *,
    positive: bool = False,
    highest_frequency: float = _LEAST_BANDWIDTH,
    shortest_frame: float = SHORTEST_WINDOW,
    extra: str = "",
) -> Feature:
    return Feature(
        f"window_{name}",
        unit,
        definition,
        source,
        measure,
        positive=positive,
        kind="window",
        highest_frequency=max(highest_frequency, _LEAST_BANDWIDTH),
        shortest_frame=max(shortest_frame, SHORTEST_WINDOW),
        extra=extra,
    )


def _triangular(
    of: str, title: str, source: str, bands: TriangularBands, measured: Callable[[WindowBatch], tuple[Floats, Floats]]
) -> list[Feature]:
    """Return mean, level-free mean and deviation of each band, of which a `WindowBatch` has means and deviations."""

    def mean(number: int) -> _Measure:
        return lambda w: measured(w)[0][:, number]

    def relative(number: int) -> _Measure:
        return lambda w: measured(w)[0][:, number] - w.level

    def deviation(number: int) -> _Measure:
        return lambda w: measured(w)[1][:, number]

    found: list[list[Feature]] = [[], [], []]
    for number, centre in enumerate(bands.centres.tolist()):
        end, level, band = float(bands.corners[number + 2]), f"{of}_{centre:.0f}_hz", f"{title} at {centre:.0f} Hz"
        definition = f"mean over {_FRAMES}, of log10 of the mean square in the {band}"
        found[0].append(_window(level, "log10(U^2)", definition, source, mean(number), highest_frequency=end))
        definition = f"window_{level} minus window_level: the gain of the sensor cancels"
        found[1].append(_window(f"relative_{level}", "1", definition, source, relative(number), highest_frequency=end))
        name, definition = f"{of}_deviation_{centre:.0f}_hz", f"standard deviation of what window_{level} is a mean of"
        found[2].append(_window(name, "1", definition, source, deviation(number), highest_frequency=end))
    return [feature for features in found for feature in features]


def _third_octaves() -> list[Feature]:
    def levels(low: float, high: float) -> tuple[_Measure, _Measure]:
        return (lambda w: w.band_level(low, high)), (lambda w: w.band_level(low, high) - w.level)

    absolute, free = [], []
    for number, middle in enumerate(WINDOW_THIRD_OCTAVES):
        low, high = band_edges(number)
        # A Hann bell over the window makes a line two over its length wide.
        band = partial(_window, source=_IEC, highest_frequency=high, shortest_frame=2 / (high - low))
        level, relative = levels(low, high)
        definition = f"log10 of the mean square in the third octave at {middle} Hz, under one Hann bell"
        absolute.append(band(f"level_{middle}_hz", "log10(U^2)", definition, measure=level))
        definition = f"window_level_{middle}_hz minus window_level: the gain of the sensor cancels"
        free.append(band(f"relative_level_{middle}_hz", "1", definition, measure=relative))
    return absolute + free


def _packets() -> list[Feature]:
    def columns(number: int) -> tuple[_Measure, _Measure]:
        return (lambda w: w.packets[:, number]), (lambda w: w.packets[:, number] - w.level)

    absolute, free = [], []
    for number in range(N_PACKETS):
        packet = partial(_window, source=PACKETS_SOURCE, extra="wavelets")
        name, (level, relative) = f"packet_{number + 1}_of_{N_PACKETS}", columns(number)
        definition = (
            f"log10 of the mean square in wavelet packet {number + 1} ({WAVELET}, level {LEVEL}, the lowest of "
            f"{N_PACKETS} equal bands up to half the sampling rate first)"
        )
        absolute.append(packet(name, "log10(U^2)", definition, measure=level))
        definition = f"window_{name} minus window_level: the gain of the sensor cancels"
        free.append(packet(f"relative_{name}", "1", definition, measure=relative))
    return absolute + free


def _dominant(place: int) -> _Measure:
    return lambda w: w.dominant_frequencies[:, place]


def _correlation(lag: float) -> _Measure:
    return lambda w: w.envelope_correlation(lag)


WINDOW_FEATURES = (
    _window("level", "log10(U^2)", "log10 of the mean square, baseline removed", "signal energy", lambda w: w.level),
    _window("peak", "U", "largest distance from the baseline", "signal amplitude", lambda w: w.peak),
    _window(
        "crest_factor",
        "1",
        "window_peak over the root mean square",
        "signal shape",
        lambda w: w.peak / w.mean_square**0.5,
        positive=True,
    ),
    _window(
        "kurtosis",
        "1",
        "fourth moment over the square of the second: 3 for Gaussian noise, more for blows",
        "signal shape",
        lambda w: w.kurtosis,
        positive=True,
    ),
    _window(
        "zero_crossing_rate",
        "Hz",
        "changes of sign over the length of the window",
        "Rice 1944 (zero crossings)",
        lambda w: w.zero_crossing_rate,
    ),
    _window("centroid", "Hz", "mean frequency, weighted by power", _PEETERS, lambda w: w.spectrum.moments[0]),
    _window("spread", "Hz", "standard deviation about the centroid", _PEETERS, lambda w: w.spectrum.moments[1]),
    _window(
        "spectral_skewness",
        "1",
        f"third standardised moment about the centroid; {OF_THE_RATE}",
        _PEETERS,
        lambda w: w.spectrum.standardised_moments[0],
    ),
    _window(
        "spectral_kurtosis",
        "1",
        f"fourth standardised moment about the centroid; {OF_THE_RATE}",
        _PEETERS,
        lambda w: w.spectrum.standardised_moments[1],
        positive=True,
    ),
    _window("rolloff_50", "Hz", "half of the power lies below", _PEETERS, lambda w: w.spectrum.rolloff(0.5)),
    _window("rolloff_85", "Hz", "85 % of the power lie below", _PEETERS, lambda w: w.spectrum.rolloff(0.85)),
    _window(
        "flatness",
        "1",
        f"log10 of the geometric over the arithmetic mean of the spectrum above 0 Hz; {OF_THE_RATE}",
        _PEETERS,
        lambda w: w.spectrum.flatness,
    ),
    _window(
        "flux",
        "1",
        f"root mean square change of log10 of the mel bands from one frame to the next ({_FRAMES})",
        _PEETERS,
        lambda w: w.flux,
        positive=True,
    ),
    *(
        _window(
            f"{order}_frequency",
            "Hz",
            f"frequency of the {strength} maximum of the mean spectrum, {2 / FRAME_TIME:g} Hz or more from a stronger",
            _PEETERS,
            _dominant(place),
        )
        for place, (order, strength) in enumerate(
            (("dominant", "strongest"), ("second", "second strongest"), ("third", "third strongest"))
        )
    ),
    _window(
        "envelope_variation",
        "1",
        f"standard deviation over mean of the envelope ({_ENVELOPE})",
        "signal shape",
        lambda w: w.envelope_moments[0],
        positive=True,
    ),
    _window(
        "envelope_skewness", "1", "third standardised moment of it", "signal shape", lambda w: w.envelope_moments[1]
    ),
    _window(
        "envelope_kurtosis",
        "1",
        "fourth standardised moment of it",
        "signal shape",
        lambda w: w.envelope_moments[2],
        positive=True,
    ),
    _window(
        "envelope_range",
        "1",
        "log10 of what 90 % of the envelope stay below over what 10 % stay below",
        "signal shape",
        lambda w: w.envelope_quantile(0.9) - w.envelope_quantile(0.1),
        positive=True,
    ),
    _window(
        "envelope_crest",
        "1",
        "log10 of the largest over the median of the envelope",
        "signal shape",
        lambda w: w.envelope_quantile(1.0) - w.envelope_quantile(0.5),
        positive=True,
    ),
    *(
        _window(
            f"envelope_correlation_{lag * 1e3:g}_ms",
            "1",
            f"correlation of the envelope with itself {lag * 1e3:g} ms later: much where vibrations die slowly",
            "signal shape",
            _correlation(lag),
        )
        for lag in CORRELATION_LAGS
    ),
    _window(
        "blow_rate",
        "Hz",
        f"maxima of the envelope, the highest within {BLOW_TIME * 1e3:g} ms and above {BLOW_OVER_MEAN:g} times its "
        "mean, in a second",
        "cgid",
        lambda w: w.blow_rate,
    ),
    *_third_octaves(),
    *_triangular("mel", "mel band", _MEL, MEL_BANDS, lambda w: w.mel),
    *_triangular("even", "band of an even bank", "cgid", EVEN_BANDS, lambda w: w.even),
    *_packets(),
)

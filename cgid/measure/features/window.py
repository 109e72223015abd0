"""The features of a window: a stretch of a recording in which anything may happen, with no beginning of its own.

Three kinds of them cancel a sensor's gain: names with `relative`, those without a unit, and frequencies.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from cgid.measure.bands import EVEN_BANDS, MEL_BANDS, TriangularBands
from cgid.measure.features.feature import OF_THE_RATE, Feature
from cgid.measure.features.vibration import PACKETS_SOURCE, THIRD_OCTAVES, band_edges
from cgid.measure.wavelets import LEVEL, N_PACKETS, WAVELET
from cgid.measure.windows import BLOW_OVER_MEAN, BLOW_TIME, ENVELOPE_TIME, FRAME_TIME, WindowBatch
from cgid.validation import Floats

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

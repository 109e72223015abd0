"""The features of a vibration: a signal of both signs that an impact starts and that dies away."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from cgid.measure.bands import MEL_BANDS
from cgid.measure.features.feature import OF_THE_RATE, Feature
from cgid.measure.vibration import APART, EARLY_TIME, WINDOW_TIME, VibrationBatch
from cgid.measure.wavelets import LEVEL, N_PACKETS, WAVELET
from cgid.validation import Floats

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

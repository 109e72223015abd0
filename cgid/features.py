"""The table of features, and their extraction: only what is asked is computed.

Every feature is one entry of `FEATURES`: name, unit, definition, source, and the measurement it needs. The
measurements themselves are in `cgid.pulses`, each made at most once. Columns, units and documentation all
come from this table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.counting import count
from cgid.errors import BadData, InvalidValue
from cgid.pulses import DETECTION_LIMIT, PulseBatch
from cgid.validation import Floats

if TYPE_CHECKING:
    import pandas

#: Rows measured at once: enough to share the overhead of the fit, few enough for the memory to stay flat.
_ROWS = 1024
#: A frame must hold the fewest samples of a pulse and one on either side.
MINIMUM_FRAME = 6


@dataclass(frozen=True)
class Feature:
    """One feature of a pulse.

    Attributes
    ----------
    name : str
    unit : str
        `U` stands for the unit of the signal.
    definition : str
    source : str
    measure : callable
        From a `PulseBatch` to one number a row.
    fitted : bool
        Whether it is read from the fitted pulse, which can be had where samples alone tell nothing.
    positive : bool
        Whether, without a unit, it is always above 0 and its ratios are what counts.
    spectral : bool
        Whether it is read from the spectrum.
    whole_frame : bool
        Whether it looks at samples far from the pulse.
    """

    name: str
    unit: str
    definition: str
    source: str
    measure: Callable[[PulseBatch], Floats]
    fitted: bool = False
    positive: bool = False
    spectral: bool = False
    whole_frame: bool = False

    def unit_for(self, signal_unit: str) -> str:
        """Return the unit when the signal is in `signal_unit`."""
        return self.unit.replace("U", signal_unit)


def _rise_time(pulses: PulseBatch) -> Floats:
    return (pulses.crossings(0.9)[0] - pulses.crossings(0.1)[0]) / pulses.sampling_rate


def _fall_time(pulses: PulseBatch) -> Floats:
    return (pulses.crossings(0.1)[1] - pulses.crossings(0.9)[1]) / pulses.sampling_rate


def _asymmetry(pulses: PulseBatch) -> Floats:
    rising, falling = pulses.crossings(0.1)
    return (rising + falling - 2 * pulses.time_of_peak) / (falling - rising)


def _tilt(pulses: PulseBatch) -> Floats:
    (rise_10, fall_10), (rise_50, fall_50) = pulses.crossings(0.1), pulses.crossings(0.5)
    return ((rise_10 + fall_10) - (rise_50 + fall_50)) / (fall_50 - rise_50)


def _weighted_mean(pulses: PulseBatch, values: Floats) -> Floats:
    """Return the mean over the spectrum by the trapezoid rule: the bin at 0 Hz has half a bin's width."""
    power = pulses.spectrum[1].copy()
    power[:, 0] *= 0.5
    return np.asarray(np.sum(values * power, axis=1) / power.sum(axis=1))


def _centroid(pulses: PulseBatch) -> Floats:
    return _weighted_mean(pulses, pulses.spectrum[0])


def _bandwidth(pulses: PulseBatch) -> Floats:
    return np.sqrt(_weighted_mean(pulses, (pulses.spectrum[0] - _centroid(pulses)[:, None]) ** 2))


def _rolloff(pulses: PulseBatch) -> Floats:
    return _frequency_where(pulses.spectrum[0], pulses.cumulative_energy, pulses.cumulative_energy >= 0.85, 0.85)


def _cutoff(pulses: PulseBatch) -> Floats:
    frequency, power = pulses.spectrum
    decibel = 10 * np.log10(np.maximum(power, 1e-30 * power[:, :1]) / power[:, :1])
    rows, last = np.arange(len(decibel)), pulses.n_bins - 1
    reached = (decibel <= -10.0) & (np.arange(decibel.shape[1]) <= last[:, None])
    # Where the spectrum is nowhere that low, its last frequency stands for "higher than can be told".
    found = _frequency_where(frequency, decibel, reached, -10.0)
    return np.where(reached.any(axis=1), found, frequency[rows, last])


def _frequency_where(frequency: Floats, curve: Floats, reached: NDArray[np.bool_], level: float) -> Floats:
    """Return the frequency at which a curve first reaches a level, straight between two bins."""
    rows = np.arange(len(curve))
    after = np.maximum(np.argmax(reached, axis=1), 1)
    low, high = curve[rows, after - 1], curve[rows, after]
    share = np.clip((level - low) / np.where(high == low, 1.0, high - low), 0.0, 1.0)
    return np.asarray(frequency[rows, after - 1] + share * (frequency[rows, after] - frequency[rows, after - 1]))


def _band(low: float, high: float) -> Callable[[PulseBatch], Floats]:
    def measure(pulses: PulseBatch) -> Floats:
        return _energy_up_to(pulses, high) - _energy_up_to(pulses, low)

    return measure


def _energy_up_to(pulses: PulseBatch, limit: float) -> Floats:
    frequency, energy = pulses.spectrum[0], pulses.cumulative_energy
    place = limit / frequency[:, 1]
    before = np.minimum(place.astype(np.intp), energy.shape[1] - 1)
    after = np.minimum(before + 1, energy.shape[1] - 1)
    rows = np.arange(len(energy))
    return np.asarray(energy[rows, before] + (place - before).clip(0, 1) * (energy[rows, after] - energy[rows, before]))


def _shrunken(pulses: PulseBatch) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of the fitted restitution and a wide Gaussian prior together."""
    mean, deviation = _WIDE_RESTITUTION
    certainty = pulses.fit.restitution_deviation**-2.0
    total = certainty + deviation**-2
    return (certainty * pulses.fit.restitution + mean * deviation**-2) / total, total**-0.5


#: Mean and standard deviation of the restitution of anything that falls on steel.
_WIDE_RESTITUTION = (0.5, 0.25)
_BANDS = ((0, 500), (500, 1000), (1000, 2000), (2000, 4000), (4000, 8000), (8000, 16000))
_IEEE = "IEEE Std 181-2011 (transition durations, reference levels)"
_PEETERS = "Peeters 2004, CUIDADO report (spectral shape), on the power spectrum of the contact up to 4/T"
_FIT = "cgid.estimation: least squares with Firth's penalty (1993)"
_YANG = "Yang, Zeng & Wan 2018"

_TABLE = (
    Feature("peak_force", "U", "largest sample, baseline removed", _YANG, lambda p: p.peak),
    Feature(
        "contact_duration",
        "s",
        "touch to separation T, arcsin(F^(2/3)) carried on to zero from two crossings at 4 and 12 times the noise",
        "Hertz 1882: an elastic pulse is close to sin^(3/2)",
        lambda p: p.duration,
    ),
    Feature("width_10", "s", "width at 10 % of the peak", _IEEE, lambda p: p.width(0.1)),
    Feature("width_50", "s", "width at 50 % of the peak", _IEEE, lambda p: p.width(0.5)),
    Feature("rise_time", "s", "10 % to 90 % of the peak, rising", _IEEE, _rise_time),
    Feature("fall_time", "s", "90 % to 10 % of the peak, falling", _IEEE, _fall_time),
    Feature(
        "asymmetry",
        "1",
        "(fall - rise) / (fall + rise), from the 10 % crossings to the top of a parabola fitted above 80 %",
        "cgid",
        _asymmetry,
    ),
    Feature("tilt", "1", "twice the middle at 10 % minus the middle at 50 %, over width_50", "cgid", _tilt),
    Feature("skewness", "1", "third standardised moment of the pulse in time", "cgid", lambda p: p.moments[2]),
    Feature("deviation", "s", "standard deviation of the pulse in time", "cgid", lambda p: p.moments[1]),
    Feature("impulse", "U s", "integral of the pulse over contact", "mechanics", lambda p: p.moments[0]),
    Feature("energy", "U^2 s", "integral of the squared pulse over contact", "signal energy", lambda p: p.energy),
    Feature(
        "size_free_index",
        "U/s^2",
        "peak_force / contact_duration^2: P ~ R^2 and T ~ R, so the size of the rock cancels",
        "Hertz scaling",
        lambda p: p.peak / p.duration**2,
    ),
    Feature("spectral_centroid", "Hz", "mean frequency, weighted by power", _PEETERS, _centroid, spectral=True),
    Feature("spectral_bandwidth", "Hz", "standard deviation about the centroid", _PEETERS, _bandwidth, spectral=True),
    Feature("spectral_rolloff", "Hz", "85 % of the energy lies below", _PEETERS, _rolloff, spectral=True),
    Feature(
        "cutoff_10db",
        "Hz",
        "where the spectrum first is 10 dB below its value at 0 Hz",
        _PEETERS,
        _cutoff,
        spectral=True,
    ),
    *(
        Feature(
            f"band_energy_{low}_{high}_hz",
            "1",
            f"share of the spectrum's energy between {low} and {high} Hz",
            _PEETERS,
            _band(float(low), float(high)),
            spectral=True,
        )
        for low, high in _BANDS
    ),
    Feature("fitted_peak", "U", "peak of the most likely damped-Hertz pulse", _FIT, lambda p: p.fit.peak, True),
    Feature("fitted_width", "s", "its impulse over its peak", _FIT, lambda p: p.fit.width / p.sampling_rate, True),
    Feature("fitted_duration", "s", "its contact duration", _FIT, lambda p: p.fit.duration / p.sampling_rate, True),
    Feature(
        "fitted_restitution",
        "1",
        "its restitution, above 1 where it rises more slowly than it falls",
        _FIT,
        lambda p: p.fit.restitution,
        True,
    ),
    Feature(
        "fitted_restitution_deviation",
        "1",
        "standard deviation of that restitution",
        _FIT,
        lambda p: p.fit.restitution_deviation,
        True,
        positive=True,
    ),
    Feature(
        "shrunken_restitution",
        "1",
        "mean of that restitution and of .5 +- .25, weighted by their certainty: where a pulse tells nothing, .5",
        _FIT,
        lambda p: _shrunken(p)[0],
        True,
    ),
    Feature(
        "shrunken_restitution_deviation",
        "1",
        "standard deviation of that mean, at most .25",
        _FIT,
        lambda p: _shrunken(p)[1],
        True,
        positive=True,
    ),
    Feature(
        "misfit",
        "1",
        "squared residual over what the noise explains (reduced chi-square), or a stray sample beside the pulse",
        _FIT,
        lambda p: p.fit.misfit,
        True,
        positive=True,
        whole_frame=True,
    ),
    Feature(
        "overload",
        "1",
        "fitted peak over the level where samples are cut off, minus 1",
        _FIT,
        lambda p: p.overload,
        True,
    ),
)
#: Every feature by name, in the order of the columns.
FEATURES: dict[str, Feature] = {feature.name: feature for feature in _TABLE}


def choose(features: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of the asked features in their order, all for None.

    Raises
    ------
    InvalidValue
        A name is unknown, given twice, or there is none.
    """
    if features is None:
        return tuple(FEATURES)
    names = (features,) if isinstance(features, str) else tuple(features)
    for name in names:
        validation.choice("feature", name, FEATURES)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"features must be named once each, and at least one, got {', '.join(names) or 'none'}")
    return names


def extract_array(
    samples: ArrayLike,
    sampling_rate: float,
    features: Iterable[str] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
    detection_limit: float = DETECTION_LIMIT,
) -> Floats:
    """Return features as plain numbers, without pandas; as `extract`.

    Parameters
    ----------
    samples, sampling_rate, features, pre_trigger, remove_baseline, invalid
        As in `extract`.
    detection_limit : float
        A peak must pass this many standard deviations of the noise before touch; an impact that was found in a
        recording by other means may ask for less.

    Returns
    -------
    ndarray, (n_signals, n_features)
        In the order of `features`.
    """
    names = choose(features)
    frames, rate = _frames(samples), float(validation.positive("sampling_rate", sampling_rate, "Hz"))
    if pre_trigger is not None and not 0 <= pre_trigger < frames.shape[1]:
        raise InvalidValue(
            f"pre_trigger must lie between 0 and the {frames.shape[1]} samples of the frame, got {pre_trigger}"
        )
    validation.choice("invalid", invalid, ("raise", "nan"))
    out = np.full((len(frames), len(names)), np.nan)
    for first in range(0, len(frames), _ROWS):
        pulses = PulseBatch(frames[first : first + _ROWS], rate, pre_trigger, remove_baseline, detection_limit)
        found = problems_of(pulses, names)
        if found and invalid == "raise":
            pulses.require_sound(found, first, len(frames))
        sound, pulses = pulses_without(pulses, found)
        out[first + sound] = measured(pulses, names)
    return out


def pulses_without(pulses: PulseBatch, found: Iterable[int]) -> tuple[NDArray[np.intp], PulseBatch]:
    """Return the rows in which no problem was found, and their pulses."""
    sound = np.ones(len(pulses.samples), bool)
    sound[list(found)] = False
    if sound.all():
        return np.arange(sound.size), pulses
    rest = PulseBatch(
        pulses.samples[sound],
        pulses.sampling_rate,
        pulses.pre_trigger,
        pulses.remove_baseline,
        pulses.detection_limit,
    )
    return np.flatnonzero(sound), rest


def measured(pulses: PulseBatch, names: Iterable[str]) -> Floats:
    """Return the features of pulses that can be measured, (n_signals, n_features)."""
    chosen = [FEATURES[name] for name in names]
    count("features", len(pulses.samples) * len(chosen))
    if not len(pulses.samples):
        return np.empty((0, len(chosen)))
    return np.stack([feature.measure(pulses) for feature in chosen], axis=1)


def problems_of(pulses: PulseBatch, names: Iterable[str]) -> dict[int, str]:
    """Return why rows cannot be measured: a fit needs less of a pulse than what is read off the samples."""
    kinds = {FEATURES[name].fitted for name in names}
    found = pulses.problems() if False in kinds else {}
    return (pulses.fit_problems() if True in kinds else {}) | found


def extract(
    samples: ArrayLike,
    sampling_rate: float,
    features: Iterable[str] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
) -> pandas.DataFrame:
    """Return the features of single pulses, one row a signal.

    Parameters
    ----------
    samples : array_like, (n_samples,) or (n_signals, n_samples)
        One positive pulse a row.
    sampling_rate : float
        [Hz].
    features : iterable of str, optional
        Names out of `FEATURES`; all of them by default. Only these, and what they need, are computed.
    pre_trigger : int, optional
        Samples before touch; baseline and noise are their mean and standard deviation. By default every
        sample up to the foot of the pulse (1 % of the way from the first samples to the largest).
    remove_baseline : bool
        Whether the baseline is subtracted before anything is measured.
    invalid : {"raise", "nan"}
        What happens to a signal that cannot be measured; a sample that is not finite is always an error.

    Returns
    -------
    pandas.DataFrame, (n_signals, n_features)
        The units are in `FEATURES`.

    Raises
    ------
    BadData
        A signal has no impact, is cut off, has too few samples on the pulse, or is not finite.
    InvalidValue
        A feature is unknown, or a number breaks its rule.

    Examples
    --------
    >>> t = np.arange(300) / 1e5
    >>> pulse = 800 * np.sin(np.pi * np.clip((t - 1e-3) / 1e-3, 0, 1)) ** 1.5
    >>> extract(pulse, 1e5, ["peak_force", "contact_duration"]).round(5).values.tolist()
    [[800.0, 0.001]]
    """
    import pandas

    names = choose(features)
    values = extract_array(
        samples, sampling_rate, names, pre_trigger=pre_trigger, remove_baseline=remove_baseline, invalid=invalid
    )
    return pandas.DataFrame(values, columns=list(names))


def _frames(samples: ArrayLike) -> NDArray[Any]:
    frames = np.asarray(samples)
    if frames.dtype not in (np.float32, np.float64):
        frames = validation.real("samples", frames)
    frames = frames[None] if frames.ndim == 1 else frames
    if frames.ndim != 2 or frames.shape[1] < MINIMUM_FRAME:
        raise BadData(
            f"samples must be rows of at least {MINIMUM_FRAME} samples, got shape {np.shape(samples)}: record longer"
        )
    finite = np.isfinite(frames)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        where = f"signal {row} sample {column}" if len(frames) > 1 else f"sample {column}"
        raise BadData(f"samples must be finite, {where} is {frames[row, column]}: cut or repair the recording there")
    return frames

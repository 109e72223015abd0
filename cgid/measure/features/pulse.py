"""The features of a positive pulse, such as a contact force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cgid.measure.features.feature import Feature
from cgid.measure.pulses import PulseBatch
from cgid.validation import Floats


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
_FIT = "cgid.measure.estimation: least squares with Firth's penalty (1993)"
_YANG = "Yang, Zeng & Wan 2018"

PULSE_FEATURES = (
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

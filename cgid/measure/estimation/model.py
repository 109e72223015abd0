"""A pulse with its parameters: samples of it, their slopes, and the covariance that these allow.

Inside, a pulse is (peak, ln of its width, time of its peak, s = ln e, baseline), the width being impulse over peak:
these hardly depend on one another, while contact duration and onset of a damped pulse, which ends in the noise, go
together with s. What is reported is `PARAMETERS`.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from cgid.measure.estimation.template import HIGHEST_SHAPE, LOWEST_SHAPE, curve, relative_times
from cgid.validation import Floats

#: Order of a reported covariance.
PARAMETERS = ("ln_peak", "ln_duration", "onset", "shape", "baseline")
#: Shapes, and points of time, at which the information of a densely sampled pulse is worked out.
_GRID, _POINTS = 241, 300


def free_parameters(onset_known: bool, fit_baseline: bool) -> list[int]:
    """Return the columns of (peak, ln width, place, shape, baseline) that are sought."""
    return [0, 1, *([] if onset_known else [2]), 3, *([4] if fit_baseline else [])]


def pulse_and_slopes(
    parameters: Floats, times: Floats, onset_known: bool = False, fit_baseline: bool = False
) -> tuple[Floats, Floats]:
    """Return pulses (without baseline) and their slopes in the free parameters.

    Parameters
    ----------
    parameters : ndarray, (n, 5)
    times : ndarray, (n, n_samples)
    onset_known : bool
        Then the place moves with width and shape.
    fit_baseline : bool

    Returns
    -------
    pulse : ndarray, (n, n_samples)
    slopes : ndarray, (n, n_free, n_samples)
    """
    peak, log_width, place, shape, _ = parameters.T
    width = np.exp(log_width)[:, None]
    duration, lead, duration_slope, lead_slope = (a[:, None] for a in relative_times(shape))
    z = (times - place[:, None]) / width
    share = (z + lead) / duration
    value, in_share, in_shape = curve(share, shape)
    steep = peak[:, None] * in_share / duration
    slopes = np.empty((len(parameters), len(free_parameters(onset_known, fit_baseline)), times.shape[1]))
    slopes[:, 0] = value
    if onset_known:
        slopes[:, 1] = -steep * (z + lead)
        slopes[:, 2] = peak[:, None] * in_shape - steep * share * duration_slope
    else:
        slopes[:, 1] = -steep * z
        slopes[:, 2] = -steep / width
        slopes[:, 3] = peak[:, None] * in_shape + steep * (lead_slope - share * duration_slope)
    if fit_baseline:
        slopes[:, -1] = 1.0
    return peak[:, None] * value, slopes


def covariance_of(
    information: Floats, parameters: Floats, onset_known: bool = False, fit_baseline: bool = False
) -> Floats:
    """Return the covariance of `PARAMETERS`, (n, 5, 5), for noise of variance 1; zero where a parameter is known.

    Parameters
    ----------
    information : ndarray, (n, n_free, n_free)
        Sums of products of the slopes.
    parameters : ndarray, (n, 5)
    onset_known, fit_baseline : bool
    """
    peak, log_width, _, shape, _ = parameters.T
    width = np.exp(log_width)
    duration, lead, duration_slope, lead_slope = relative_times(shape)
    turn = np.zeros((len(peak), 5, 5))
    turn[:, 0, 0] = 1 / peak
    turn[:, 1, 1], turn[:, 1, 3] = 1.0, duration_slope / duration
    if not onset_known:
        turn[:, 2, 1], turn[:, 2, 2], turn[:, 2, 3] = -lead * width, 1.0, -lead_slope * width
    turn[:, 3, 3] = turn[:, 4, 4] = 1.0
    turn = turn[:, :, free_parameters(onset_known, fit_baseline)]
    # Scaled to ones on the diagonal: peaks are newtons, shapes are ratios.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-300))
    unit = information / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(information.shape[1])
    inverse = np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(turn @ inverse @ np.swapaxes(turn, 1, 2))


@cache
def _shape_deviation() -> tuple[Floats, Floats]:
    """Return shapes s, and ln(standard deviation of s) there with two derivatives, for densely sampled pulses."""
    shapes = np.linspace(LOWEST_SHAPE, HIGHEST_SHAPE, _GRID)
    duration, lead, _, _ = relative_times(shapes)
    ones, zeros = np.ones(_GRID), np.zeros(_GRID)
    parameters = np.stack([ones, zeros, lead, shapes, zeros], axis=1)
    times = duration[:, None] * (np.arange(_POINTS) + 0.5) / _POINTS
    _, slopes = pulse_and_slopes(parameters, times)
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2)) * (duration / _POINTS)[:, None, None]
    deviation = np.log(covariance_of(information, parameters)[:, 3, 3]) / 2
    step = shapes[1] - shapes[0]
    slope = np.gradient(deviation, step)
    return shapes, np.stack([deviation, slope, np.gradient(slope, step)])


def shape_deviation(shape: Floats) -> Floats:
    """Return ln(standard deviation of s) of densely sampled pulses but for a constant, and two derivatives, (3, n)."""
    grid, held = _shape_deviation()
    place = (shape - LOWEST_SHAPE) / (grid[1] - grid[0])
    node = np.clip(place.astype(np.intp), 0, _GRID - 2)
    return np.asarray(held[:, node] + (place - node) * (held[:, node + 1] - held[:, node]))


def shape_penalty(shape: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the logarithm of Jeffreys' prior of the shape, its slope and its curvature (never above 0).

    The likelihood alone is biased at first order, for where e is small the shape is hardly told and estimates stray to
    ever smaller ones. Multiplied by Jeffreys' prior, one over the standard deviation of the shape, it is not (Firth
    1993, Biometrika 80).
    """
    value, slope, curvature = shape_deviation(shape)
    return -value, -slope, np.minimum(-curvature, 0.0)


def parameters_of(peak: Floats, width: Floats, onset: Floats, shape: Floats) -> Floats:
    """Return (peak, ln width, place, shape, baseline 0), (n, 5), of pulses given by their onset."""
    _, lead, _, _ = relative_times(shape)
    return np.stack([peak, np.log(width), onset + lead * width, shape, np.zeros_like(peak)], axis=1)

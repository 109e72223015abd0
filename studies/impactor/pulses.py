"""What studies use of pulses of the family, in terms of the fit: their logarithms, slopes and information."""

from __future__ import annotations

from functools import cache

import numpy as np

from cgid._lib.validation import Floats
from cgid.measure.fit.template import (
    MAX_SHAPE,
    MIN_SHAPE,
    covariance_of,
    dimensionless,
    relative_times,
    slopes_and_pulse,
)

#: Shapes and points in time for the information of a densely sampled pulse.
_GRID, _POINTS = 241, 300


def dimensionless_logarithms(shape: Floats, *names: str) -> tuple[Floats, ...]:
    """Return ln of "contact" time, "peak" or "width" of the dimensionless pulse by a table, each as `shape`."""
    table = _logarithms()
    return tuple(np.interp(shape, table["shape"], table[name]) for name in names)


@cache
def _logarithms() -> dict[str, Floats]:
    grid = np.linspace(MIN_SHAPE, 0.0, 1201)
    restitution, contact, _, peak = dimensionless(grid)
    # The impulse of m x'' from 1 to -e is 1 + e.
    return {"shape": grid, "contact": np.log(contact), "peak": np.log(peak), "width": np.log((1 + restitution) / peak)}


def parameters_of(peak: Floats, width: Floats, onset: Floats, shape: Floats) -> Floats:
    """Return (peak, ln width, peak time, shape), (n, 4), of pulses given by their onset."""
    _, lead, *_ = relative_times(shape)
    return np.stack([peak, np.log(width), onset + lead * width, shape], axis=1)


def pulse_and_slopes(parameters: Floats, times: Floats, onset_known: bool = False) -> tuple[Floats, Floats]:
    """Return the parts of `slopes_and_pulse`: pulses (n, n_samples), and their slopes (n, n_free, n_samples)."""
    both = slopes_and_pulse(parameters, times, onset_known)
    return both[:, -1], both[:, :-1]


def normal_equations(residual: Floats, slopes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return squared residual (n,), information (n, n_free, n_free) and gradient (n, n_free)."""
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
    gradient = np.matmul(slopes, residual[..., None])[..., 0]
    return np.sum(residual**2, axis=1), information, gradient


@cache
def _shape_deviation() -> tuple[Floats, Floats]:
    """Return shapes s, and ln(standard deviation of s) there with two derivatives, for densely sampled pulses."""
    shapes = np.linspace(MIN_SHAPE, MAX_SHAPE, _GRID)
    duration, lead, *_ = relative_times(shapes)
    ones, zeros = np.ones(_GRID), np.zeros(_GRID)
    parameters = np.stack([ones, zeros, lead, shapes], axis=1)
    times = duration[:, None] * (np.arange(_POINTS) + 0.5) / _POINTS
    _, slopes = pulse_and_slopes(parameters, times)
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2)) * (duration / _POINTS)[:, None, None]
    deviation = np.log(covariance_of(information, parameters, ones)[:, 3, 3]) / 2
    step = shapes[1] - shapes[0]
    slope = np.gradient(deviation, step)
    return shapes, np.stack([deviation, slope, np.gradient(slope, step)])


def shape_deviation(shape: Floats) -> Floats:
    """Return ln(standard deviation of s) of densely sampled pulses plus a constant, and two derivatives, (3, n)."""
    grid, tabulated = _shape_deviation()
    position = (shape - MIN_SHAPE) / (grid[1] - grid[0])
    node = np.clip(position.astype(np.intp), 0, _GRID - 2)
    return np.asarray(tabulated[:, node] + (position - node) * (tabulated[:, node + 1] - tabulated[:, node]))

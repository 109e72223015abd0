"""The likelihood of a pulse along its shape: what the samples say of e once everything else fits best.

Given the shape, peak, duration and onset are well told and their likelihood is near a Gaussian one; along the shape it
may be skewed or have two tops. So the shape gets a grid, evenly spaced where the shape is told equally well everywhere,
and the rest Laplace's approximation at each node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cgid.measure.estimation.fit import Problem, PulseFit
from cgid.measure.estimation.model import parameters_of, shape_deviation
from cgid.measure.estimation.template import HIGHEST_SHAPE, LOWEST_SHAPE, relative_times
from cgid.measure.estimation.window import windows
from cgid.validation import Floats

#: How far the grid reaches, in standard deviations of the stabilised shape.
_REACH = 6.5
_ITERATIONS = 5
#: Rows treated at once.
_ROWS = 256


@dataclass(frozen=True)
class Profile:
    """The likelihood of some pulses on grids of the shape.

    Attributes
    ----------
    shape : ndarray, (n, n_nodes)
        s = ln e at the nodes.
    log_weight : ndarray, (n, n_nodes)
        Logarithm of the integral over peak, duration and onset of the likelihood, times the width of the node in s, but
        for a constant of the row.
    log_peak, log_duration : ndarray, (n, n_nodes)
        The most likely ones there; duration in samples.
    """

    shape: Floats
    log_weight: Floats
    log_peak: Floats
    log_duration: Floats


@cache
def _stabilised() -> tuple[Floats, Floats]:
    """Return shapes, and the coordinate in which their standard deviation is the same everywhere."""
    shapes = np.linspace(LOWEST_SHAPE, HIGHEST_SHAPE, 2001)
    slope = np.exp(-shape_deviation(shapes)[0])
    return shapes, np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(shapes))])


def profile(
    samples: NDArray[np.floating],
    fit: PulseFit,
    noise: Floats,
    *,
    lowest: float = LOWEST_SHAPE,
    highest: float = HIGHEST_SHAPE,
    n_nodes: int = 33,
    offset: Floats | None = None,
    n_quiet: Floats | None = None,
    onset: Floats | None = None,
    onset_between: tuple[float, float] | None = None,
    clip_level: Floats | None = None,
    response: Floats | None = None,
) -> Profile:
    """Return the likelihood along the shape.

    Parameters
    ----------
    samples : ndarray, (n, n_samples)
    fit : PulseFit
        Of these samples.
    noise : ndarray, (n,)
        Standard deviation, above 0.
    lowest, highest : float
        Bounds of the shape: beyond them the prior is zero.
    n_nodes : int
    offset, clip_level, response
        As in `fit_pulses`.
    n_quiet : ndarray, (n,), optional
        Of how many samples the offset is the mean: it is uncertain by so much. None where it is certain.
    onset : ndarray, (n,), optional
        Time of touch [samples], where it is known.
    onset_between : tuple of float, optional
        Between what times [samples] every time of touch is as likely, and no other; everywhere if not given.
    """
    shapes = _grid(fit, noise, lowest, highest, n_nodes)
    out = Profile(shapes, *(np.empty(shapes.shape) for _ in range(3)))
    for first in range(0, len(samples), _ROWS):
        block = slice(first, first + _ROWS)
        guess = parameters_of(fit.peak[block], fit.width[block], fit.onset[block], fit.shape[block])
        own_offset = None if offset is None else offset[block]
        own_limit = None if clip_level is None else clip_level[block]
        # As long as the pulse would be at the lowest shape: a tail that is cut off says nothing against it.
        longest = guess.copy()
        longest[:, 3] = shapes[block, 0]
        for window in windows(samples[block], longest, own_offset, own_limit, averaged=response is None):
            rows = first + window.rows
            problem = Problem(window, n_quiet is not None, None if onset is None else onset[rows], response)
            sigma = noise[rows] / np.sqrt(window.averaged)
            hold = None if n_quiet is None else n_quiet[rows] / window.averaged
            for node in range(n_nodes):
                found = _at(problem, guess[window.rows], shapes[rows, node], sigma, hold, onset_between)
                for held, value in zip((out.log_weight, out.log_peak, out.log_duration), found, strict=True):
                    held[rows, node] = value
    widths = np.gradient(shapes, axis=1) if n_nodes > 1 else np.ones_like(shapes)
    with np.errstate(divide="ignore"):
        log_weight = out.log_weight + np.log(np.maximum(widths, 0.0))
    return Profile(shapes, log_weight, out.log_peak, out.log_duration)


def _grid(fit: PulseFit, noise: Floats, lowest: float, highest: float, n_nodes: int) -> Floats:
    """Return nodes around the fitted shape, evenly spaced in the stabilised coordinate, within the bounds."""
    shapes, coordinate = _stabilised()
    middle = np.interp(fit.shape, shapes, coordinate)
    reach = _REACH * noise / np.abs(fit.peak) / np.sqrt(fit.width)
    low, high = (np.interp(bound, shapes, coordinate) for bound in (lowest, highest))
    start = np.clip(middle - reach, low, high)
    stop = np.clip(middle + reach, low, high)
    # A shape far beyond the bounds leaves nothing: then the grid lies along the nearer one.
    short = stop - start < 0.5 * reach
    start = np.where(short, np.clip(start - reach, low, high), start)
    stop = np.where(short, np.clip(stop + reach, low, high), stop)
    share = (np.arange(n_nodes) + 0.5) / n_nodes
    return np.interp(start[:, None] + (stop - start)[:, None] * share, coordinate, shapes)


def _at(
    problem: Problem,
    guess: Floats,
    shape: Floats,
    sigma: Floats,
    hold: Floats | None,
    onset_between: tuple[float, float] | None,
) -> tuple[Floats, Floats, Floats]:
    """Return log of the integrated likelihood, ln peak and ln duration at given shapes.

    `hold` are the points that the baseline was the mean of before.
    """
    parameters = guess.copy()
    parameters[:, 3] = shape
    parameters = problem.tied(parameters)
    kept = [k for k, column in enumerate(problem.free) if column != 3]
    columns = [problem.free[k] for k in kept]
    for iteration in range(_ITERATIONS):
        residual, slopes = problem.residual(parameters, slice(None))
        slopes = slopes[:, kept]
        information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
        if hold is not None:
            information[:, -1, -1] += hold
        if iteration == _ITERATIONS - 1:
            break
        gradient = np.matmul(slopes, residual[..., None])
        if hold is not None:
            gradient[:, -1, 0] -= hold * parameters[:, 4]
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-300))
        unit = information / (scale[:, :, None] * scale[:, None, :]) + 1e-6 * np.eye(len(kept))
        step = np.linalg.solve(unit, gradient / scale[..., None])[..., 0] / scale
        parameters[:, 0] = np.maximum(parameters[:, 0] + step[:, 0], 0.2 * parameters[:, 0])
        width = np.exp(parameters[:, 1])
        parameters[:, 1] += np.clip(step[:, 1], -0.4, 0.4)
        if 2 in columns:
            parameters[:, 2] += np.clip(step[:, 2], -0.5 * width, 0.5 * width)
        if hold is not None:
            parameters[:, 4] += step[:, -1]
        parameters = problem.tied(parameters)
    duration, lead, _, _ = relative_times(shape)
    log_peak = np.log(parameters[:, 0])
    # In ln(peak), ln(duration) and, at this shape, the place, whose step is that of the onset.
    sign, determinant = np.linalg.slogdet(information / sigma[:, None, None] ** 2)
    squared = np.sum(residual**2, axis=1) + (0.0 if hold is None else hold * parameters[:, 4] ** 2)
    log_likelihood = -0.5 * squared / sigma**2 - 0.5 * (determinant + 2 * log_peak)
    if onset_between is not None:
        log_likelihood += _log_inside(parameters, lead, information / sigma[:, None, None] ** 2, onset_between)
    # Where the samples do not tell all parameters the fit lies beside the pulse.
    log_likelihood = np.where((sign > 0) & np.isfinite(log_likelihood), log_likelihood, -np.inf)
    return log_likelihood, log_peak, parameters[:, 1] + np.log(duration)


def _log_inside(parameters: Floats, lead: Floats, information: Floats, between: tuple[float, float]) -> Floats:
    """Return the logarithm of the probability that touch lies between two times, its likelihood being Gaussian."""
    width = np.exp(parameters[:, 1])
    onset = parameters[:, 2] - lead * width
    # Of (peak, ln width, place, ...): touch moves with the width and the place.
    slope = np.zeros(information.shape[:2])
    slope[:, 1], slope[:, 2] = -lead * width, 1.0
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-300))
    unit = information / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(information.shape[1])
    spread = np.linalg.solve(unit, (slope / scale)[..., None])[..., 0] / scale
    deviation = np.sqrt(np.maximum(np.sum(slope * spread, axis=1), 1e-300))
    low, high = ((bound - onset) / deviation for bound in between)
    return np.asarray(np.log(np.maximum(0.5 * (_erf(high / np.sqrt(2)) - _erf(low / np.sqrt(2))), 1e-300)))


_erf = np.vectorize(math.erf, otypes=[np.float64])

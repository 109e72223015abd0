"""The information of samples about a pulse: the Cramer-Rao bound, and the likelihood along the shape.

The bound (Rao 1945, Cramer 1946) limits the precision of any unbiased estimate. The profile is the likelihood of the
shape s = ln e, which may be skewed or have two maxima; at a given shape, peak, duration and onset are nearly Gaussian
and integrated by Laplace's approximation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, rates
from cgid.errors import InvalidValue
from cgid.measure.fit.fit_samples import windows
from cgid.measure.fit.least_squares import solve_scaled
from cgid.measure.fit.template import MAX_SHAPE, MIN_SHAPE, PARAMETERS, bounded, covariance_of, relative_times
from studies.impactor.pulses import normal_equations, parameters_of, pulse_and_slopes, shape_deviation

#: Maximum number of impacts of the bound computed at once, and most samples of them together.
_ROWS, _SAMPLES = 64, 1 << 20
#: Maximum number of samples of a contact: with more, the bound only falls as one over the square root of their number.
MAX_SAMPLES = 1_000_000
#: Extent of a profile's grid to either side, in standard deviations of the shape.
_REACH = 6.5
#: Evaluations of the fit at each node of a profile, and rows of profiles computed at once.
_ITERATIONS, _PROFILED_ROWS = 5, 256
#: Widest distribution of peak and duration at a node of a profile.
_WIDEST = 0.5


# -- the bound ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bound:
    """The Cramer-Rao bound."""

    #: (..., 4, 4), of ln(peak), ln(duration), onset [s], ln(restitution)
    covariance: Floats
    restitution: Floats  # (...), of the pulse

    def _deviation(self, name: str) -> Floats:
        index = PARAMETERS.index(name)
        return np.sqrt(self.covariance[..., index, index])

    @property
    def peak_deviation(self) -> Floats:
        """Smallest standard deviation of the peak, over the peak."""
        return self._deviation("ln_peak")

    @property
    def duration_deviation(self) -> Floats:
        """Smallest standard deviation of the contact duration, over the contact duration."""
        return self._deviation("ln_duration")

    @property
    def onset_deviation(self) -> Floats:
        """Smallest standard deviation of the time of onset [s]."""
        return self._deviation("onset")

    @property
    def restitution_deviation(self) -> Floats:
        """Smallest standard deviation of the restitution."""
        return np.asarray(self.restitution * self._deviation("shape"))


def cramer_rao_bound(
    contact_duration: ArrayLike,
    restitution: ArrayLike,
    noise: ArrayLike,
    sampling_rate: ArrayLike,
    *,
    onset: ArrayLike = 0.5,
) -> Bound:
    """Return the bound of the parameters of a damped-Hertz pulse in white noise.

    Parameters
    ----------
    contact_duration : array_like
        [s]; at most `MAX_SAMPLES` samples.
    restitution : array_like
        Within .05 and 20; above 1 for a pulse that rises more slowly than it falls.
    noise : array_like
        Standard deviation of a sample over the peak.
    sampling_rate : array_like
        [Hz].
    onset : array_like
        Position of onset between two samples, 0 to 1.

    Returns
    -------
    Bound
        Of the common shape of the parameters; infinite where there are fewer samples than unknowns.

    Raises
    ------
    InvalidValue
        An argument is out of range.

    Examples
    --------
    30 samples in contact and 2 % noise:

    >>> bound = cramer_rao_bound(150e-6, [0.35, 0.65], 0.02, 200e3)
    >>> bound.restitution_deviation.round(3).tolist()
    [0.072, 0.016]
    """
    duration, e, level, rate, phase = validation.broadcast(
        contact_duration=validation.positive("contact_duration", contact_duration, "s"),
        restitution=validation.positive("restitution", restitution),
        noise=validation.positive("noise", noise),
        sampling_rate=rates("sampling_rate", sampling_rate),
        onset=validation.between("onset", onset, 0, 1),
    )
    s = np.log(e).ravel()
    if not ((s >= MIN_SHAPE - 1e-12) & (s <= MAX_SHAPE + 1e-12)).all():
        low, high = np.exp(MIN_SHAPE), np.exp(MAX_SHAPE)
        raise InvalidValue(f"restitution must be in [{low:g}, {high:g}], got {e.min():g} to {e.max():g}")
    samples = (duration * rate).ravel()
    if (samples > MAX_SAMPLES).any():
        raise InvalidValue(
            f"contact_duration must be at most {MAX_SAMPLES} samples, got {samples.max():g} "
            f"({duration.max():g} s); give it in seconds, or lower the sampling rate"
        )
    covariance = np.empty((s.size, 4, 4))
    order = np.argsort(samples)
    together = int(np.clip(_SAMPLES / samples.max(initial=1.0), 1, _ROWS))
    for first in range(0, s.size, together):
        rows = order[first : first + together]
        covariance[rows] = _covariance(samples[rows], s[rows], phase.ravel()[rows])
    covariance *= (level.ravel() ** 2)[:, None, None]
    covariance[:, 2] /= rate.ravel()[:, None]
    covariance[:, :, 2] /= rate.ravel()[:, None]
    return Bound(covariance.reshape(*e.shape, 4, 4), e)


def _covariance(samples: Floats, shape: Floats, phase: Floats) -> Floats:
    """Return the covariance of pulses of peak 1 in noise of standard deviation 1, times in samples."""
    width = samples / relative_times(shape)[0]
    parameters = parameters_of(np.ones_like(shape), width, phase, shape)
    times = np.arange(-1.0, int(samples.max()) + 4)
    _, slopes = pulse_and_slopes(parameters, np.broadcast_to(times, (len(shape), times.size)))
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
    with np.errstate(all="ignore"):
        covariance = covariance_of(information, parameters, np.ones(len(shape)))
    enough = np.ceil(phase + samples) - np.floor(phase) - 1 >= information.shape[1]
    return np.where(enough[:, None, None], covariance, np.inf)


# -- the profile --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood of pulses on grids of the shape s = ln e, each attribute (n, n_nodes)."""

    # At a node, with independent standard normal x and y: ln peak is `log_peak + peak_deviation x`, ln duration
    # [samples] is `log_duration + cross x + duration_deviation y`.

    shape: Floats
    log_weight: Floats  # ln of the likelihood integrated over peak, duration and onset, plus a constant by row
    log_peak: Floats
    log_duration: Floats
    peak_deviation: Floats
    duration_deviation: Floats
    cross: Floats


class FittedCurve(Protocol):
    """Samples and a curve to fit to them, as `cgid.measure.fit.fit_samples.Window`."""

    @property
    def free(self) -> list[int]:
        """Columns of the parameters that are fitted."""

    def tied(self, parameters: Floats) -> Floats:
        """Return the parameters, with those that follow from others."""

    def residual(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return samples minus curve (n, n_points), and the slopes of the curve (n, n_free, n_points)."""


#: From rows of the frames and their pulses at the lowest shape to parts of these rows, each with its whitened residual.
Whitened = Callable[[slice, Floats], Iterator[tuple[NDArray[np.intp], FittedCurve]]]


@cache
def _stabilised() -> tuple[Floats, Floats]:
    """Return shapes, and the coordinate in which their standard deviation is the same everywhere."""
    shapes = np.linspace(MIN_SHAPE, MAX_SHAPE, 2001)
    slope = np.exp(-shape_deviation(shapes)[0])
    return shapes, np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(shapes))])


def profile(  # noqa: PLR0913
    samples: NDArray[np.floating],
    near: Floats,
    noise: Floats,
    *,
    lowest: float = MIN_SHAPE,
    highest: float = MAX_SHAPE,
    n_nodes: int = 33,
    onset: Floats | None = None,
    onset_between: tuple[float, float] | None = None,
    clip_level: Floats | None = None,
    response: Floats | None = None,
    whitened: Whitened | None = None,
) -> Profile:
    """Return the likelihood along the shape of pulses in samples (n, n_samples)."""
    # `near` (n, 4) holds pulses near the most likely ones: (peak, ln width, peak time, s). The prior is zero
    # outside `lowest` and `highest`, and outside `onset_between` [samples] if given. `noise` (n,) is above 0; other
    # arguments are as in `windows`. Where the noise is not white, `whitened` replaces samples, onset, limit and
    # response, and `noise` is the equivalent white noise.
    shapes = _grid(near, noise, lowest, highest, n_nodes)
    out = Profile(shapes, *(np.empty(shapes.shape) for _ in range(6)))
    for first in range(0, len(samples), _PROFILED_ROWS):
        block = slice(first, first + _PROFILED_ROWS)
        guess = near[block]
        # As long as the pulse of the lowest shape: a window without its tail could not rule out that shape.
        longest = guess.copy()
        longest[:, 3] = shapes[block, 0]
        if whitened is not None:
            for rows, residual in whitened(block, longest):
                _fill(out, first + rows, residual, guess[rows], np.ones(rows.size), onset_between)
            continue
        limit = np.inf if clip_level is None else clip_level[block]
        known = None if onset is None else onset[block]
        for window in windows(samples[block], longest, 0.0, limit, onset=known, response=response):
            rows = first + window.rows
            _fill(out, rows, window, guess[window.rows], noise[rows] / np.sqrt(window.averaged), onset_between)
    widths = np.gradient(shapes, axis=1) if n_nodes > 1 else np.ones_like(shapes)
    with np.errstate(divide="ignore"):
        log_weight = out.log_weight + np.log(np.maximum(widths, 0.0))
    return replace(out, log_weight=log_weight)


def _fill(
    out: Profile,
    rows: NDArray[np.intp],
    problem: FittedCurve,
    guess: Floats,
    sigma: Floats,
    onset_between: tuple[float, float] | None,
) -> None:
    for node in range(out.shape.shape[1]):
        solution = _at(problem, guess, out.shape[rows, node], sigma, onset_between)
        for part, value in zip(fields(Profile)[1:], solution, strict=True):
            getattr(out, part.name)[rows, node] = value


def _grid(near: Floats, noise: Floats, lowest: float, highest: float, n_nodes: int) -> Floats:
    """Return nodes around the shapes of pulses, within the bounds, evenly spaced in the stabilised coordinate."""
    shapes, coordinate = _stabilised()
    middle = np.interp(near[:, 3], shapes, coordinate)
    reach = _REACH * noise / np.abs(near[:, 0]) / np.exp(0.5 * near[:, 1])
    low, high = (np.interp(bound, shapes, coordinate) for bound in (lowest, highest))
    start = np.clip(middle - reach, low, high)
    stop = np.clip(middle + reach, low, high)
    # A shape far beyond the bounds leaves no nodes; the grid is then along the nearer bound.
    short = stop - start < 0.5 * reach
    start = np.where(short, np.clip(start - reach, low, high), start)
    stop = np.where(short, np.clip(stop + reach, low, high), stop)
    share = (np.arange(n_nodes) + 0.5) / n_nodes
    return np.interp(start[:, None] + (stop - start)[:, None] * share, coordinate, shapes)


def _at(
    problem: FittedCurve,
    guess: Floats,
    shape: Floats,
    sigma: Floats,
    onset_between: tuple[float, float] | None,
) -> tuple[Floats, ...]:
    """Return the attributes of a profile at given shapes."""
    parameters = guess.copy()
    parameters[:, 3] = shape
    parameters = problem.tied(parameters)
    indices = [k for k, column in enumerate(problem.free) if column != 3]
    columns = [problem.free[k] for k in indices]
    for iteration in range(_ITERATIONS):
        residual, slopes = problem.residual(parameters)
        squared, information, gradient = normal_equations(residual, slopes[:, indices])
        if iteration == _ITERATIONS - 1:
            break
        step = solve_scaled(information, gradient, 1e-6)
        parameters[:, 0] = np.maximum(parameters[:, 0] + step[:, 0], 0.2 * parameters[:, 0])
        parameters[:, columns[1:]] += bounded(step, columns, np.exp(parameters[:, 1]))[:, 1:]
        parameters = problem.tied(parameters)
    duration, lead, *_ = relative_times(shape)
    peak, log_width = parameters[:, 0], parameters[:, 1]
    information = information / sigma[:, None, None] ** 2
    # In terms of ln(peak), ln(duration) and the peak time, which at a given shape moves with the onset.
    sign, determinant = np.linalg.slogdet(information)
    log_likelihood = -0.5 * squared / sigma**2 - 0.5 * (determinant + 2 * np.log(peak))
    units = (np.broadcast_to(unit, gradient.shape) for unit in np.eye(gradient.shape[1])[:2])
    covariance = np.stack([solve_scaled(information, unit, 1e-12)[:, :2] for unit in units], axis=1)
    if onset_between is not None:
        inside, shift, fewer = _inside(parameters, lead, information, onset_between)
        log_likelihood += inside
        covariance = covariance - fewer[:, :2, None] * fewer[:, None, :2]
        log_width = log_width + np.clip(shift[:, 1], -0.4, 0.4)
        peak = np.maximum(peak + shift[:, 0], 0.2 * peak)
    # The fit has missed the pulse where the samples do not determine all parameters.
    log_likelihood = np.where((sign > 0) & np.isfinite(log_likelihood), log_likelihood, -np.inf)
    peak_deviation = np.sqrt(np.maximum(covariance[:, 0, 0], 1e-300))
    cross = covariance[:, 0, 1] / peak_deviation
    duration_deviation = np.sqrt(np.maximum(covariance[:, 1, 1] - cross**2, 0.0))
    return (
        log_likelihood,
        np.log(peak),
        log_width + np.log(duration),
        *(np.minimum(part, _WIDEST) for part in (peak_deviation / peak, duration_deviation)),
        np.clip(cross, -_WIDEST, _WIDEST),
    )


def _inside(
    parameters: Floats, lead: Floats, information: Floats, between: tuple[float, float]
) -> tuple[Floats, Floats, Floats]:
    """Return ln probability, mean shift and covariance vector (n, n_free) of an onset between two times."""
    width = np.exp(parameters[:, 1])
    onset = parameters[:, 2] - lead * width
    # Slope of onset in (peak, ln width, peak time, ...): it moves with the width and the peak time.
    slope = np.zeros(information.shape[:2])
    slope[:, 1], slope[:, 2] = -lead * width, 1.0
    spread = solve_scaled(information, slope, 1e-12)
    deviation = np.sqrt(np.maximum(np.sum(slope * spread, axis=1), 1e-300))
    low, high = ((bound - onset) / deviation for bound in between)
    share = np.maximum(0.5 * (_erf(high / np.sqrt(2)) - _erf(low / np.sqrt(2))), 1e-300)
    # Mean and variance of a normal number between two others; clipped where the share is lost to rounding.
    at_low, at_high = (np.exp(-0.5 * bound**2) / np.sqrt(2 * np.pi) / share for bound in (low, high))
    mean = np.clip(at_low - at_high, low, high)
    variance = np.clip(1 + low * at_low - high * at_high - mean**2, 0.0, 1.0)
    along = spread / deviation[:, None]
    return np.log(share), along * mean[:, None], along * np.sqrt(1 - variance)[:, None]


_erf = np.vectorize(math.erf, otypes=[np.float64])

"""The damped-Hertz pulse fitted to samples: windows, start values and maximum likelihood, batched over signals.

Under white noise the most likely pulse is the least-squares pulse. A coarse fit to few points of each pulse comes
first, then a fit to all samples around it. Levenberg-Marquardt damping bounds each signal's steps; converged signals
leave the batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.measure.colour import ORDER, Colour, colour_of
from cgid.measure.filters import mixing_matrix
from cgid.measure.search import BIN, NODES, Found, around, search
from cgid.measure.template import (
    HIGHEST_SHAPE,
    LOWEST_SHAPE,
    covariance_of,
    free_parameters,
    relative_times,
    slopes_and_pulse,
    solve_scaled,
)
from cgid.validation import Floats

#: Margin of the final window around the contact found by the coarse fit, and its largest extent after the peak, in
#: widths: less than 0.2 % of the peak is left there at any restitution.
_MARGIN, _FURTHEST = 0.35, 4.5
#: Window lengths are powers of this number.
_STEP = 1.5
#: Longer windows are averaged over equal runs of samples: a few hundred points suffice for a smooth curve.
_LONGEST = 240
#: Runs of `strongest_run`: growth factor, shortest [samples], longest over the frame.
_GROWTH, _SHORTEST, _LONGEST_SHARE = 1.4, 3, 0.5
#: Best run of a pulse over its width (impulse over peak), and mean of that run over the peak.
_RUN_OVER_WIDTH, _MEAN_OVER_PEAK = 1.1, 0.74
#: Largest steps of ln(width), of the place over the width, and of s.
_LARGEST_STEPS = (0.4, 0.5, 0.7)
_ITERATIONS = 8
#: A step is the last, and not evaluated, when it promises to reduce the squared residual by less than this share of the
#: noise variance: what it leaves is of higher order.
_TOLERANCE = 0.03
#: Rows fitted at once: their arrays must fit in the processor's cache.
_ROWS = 2048
#: Least damping after a failed step: less would not change the step.
_FELT = 0.6
#: Share of the promised gain from which a step was good.
_KEPT = 0.7
#: A search ends at this damping.
_STUCK = 1e4
#: Extent of the samples that the search looks at, over what the pulse of the start would need.
_REACH = 2.0
#: Shapes at which the likelihood is profiled (every other one of the search), and the highest fitted shape for it.
_EVERY = slice(0, 20, 2)
PROFILED = NODES[_EVERY]
#: Samples of the unit of the search from which its bins tell as much as the samples.
_WELL_BINNED = 12.0
#: Distance of a shape that a second search begins from.
_ANOTHER = 0.3
_HIGHEST_PROFILED = 0.3
#: A standard deviation of s up to which the likelihood is a parabola, if it has no second maximum.
_PARABOLIC = 0.1
#: Points and weights of the quadrature of a Gaussian by three points.
_HERMITE = np.array([[-np.sqrt(3), 0.0, np.sqrt(3)], [1 / 6, 2 / 3, 1 / 6]])
#: Mean and standard deviation of the restitution of any material that falls on steel.
WIDE_RESTITUTION = (0.5, 0.25)
#: Smallest noise over the peak: the accuracy of the template.
_NOISE_FLOOR = 1e-5
#: Deviations of this share of the peak count as noise in the misfit.
MODEL_ERROR = 1e-3
#: Samples outside the pulse of this share of the peak are nothing strange: hum, the ringing of a filter.
STRAY = 0.03
#: A deviation of this many standard deviations outside the window counts as a misfit of 1.
_OUTLIER = 5.5

Rows = NDArray[np.intp] | slice


def rows_of(values: NDArray[Any] | None, rows: Rows) -> Any:
    """Return some rows of an array, or None for None."""
    return None if values is None else values[rows]


# -- start and result of a fit ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Start:
    """Start of the search: peak, width (impulse over peak) [samples] and place (column of the peak), each (n,)."""

    peak: Floats
    width: Floats
    place: Floats

    def rows(self, chosen: Rows) -> Start:
        """Return some of the rows."""
        return Start(self.peak[chosen], self.width[chosen], self.place[chosen])


@dataclass(frozen=True, eq=False)
class PulseFit:
    """Fitted pulses; each attribute (n,) unless stated, times in samples of the frame.

    Attributes
    ----------
    peak : above the baseline, in the unit of the signal
    duration, onset, width : contact duration, time of touch, impulse over peak [samples]
    shape : s = ln e, above 0 for a pulse that rises more slowly than it falls
    baseline : 0 unless fitted
    covariance : (n, 5, 5), of `cgid.measure.template.PARAMETERS`, onset in samples; zero for given parameters
    restitution_deviation : of exp(s)
    expected_restitution, expected_deviation : mean and standard deviation of the restitution after the fit, if it was
        `WIDE_RESTITUTION` before
    misfit : reduced chi-square, 1 on average for a pulse of the family; more if a sample outside the pulse stands out
    stray : the largest sample outside the pulse, squared, over what noise and `STRAY` of the peak allow
    clipped : number of samples at the sensor's limit
    evidence : sum of squares that the pulse explains, over the variance of the noise
    reach : last sample used by the fit; only the misfit depends on the whole frame
    """

    peak: Floats
    duration: Floats
    onset: Floats
    width: Floats
    shape: Floats
    baseline: Floats
    covariance: Floats
    restitution_deviation: Floats
    expected_restitution: Floats
    expected_deviation: Floats
    misfit: Floats
    stray: Floats
    clipped: NDArray[np.intp]
    evidence: Floats
    converged: NDArray[np.bool_]
    reach: NDArray[np.intp]

    @classmethod
    def joined(cls, parts: list[PulseFit]) -> PulseFit:
        """Return the rows of all parts."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    @classmethod
    def nothing(cls) -> PulseFit:
        """Return a fit without rows."""
        none = np.empty(0)
        return cls(
            *(none,) * 6, np.empty((0, 5, 5)), *(none,) * 5, *(np.empty(0, kind) for kind in (int, float, bool, int))
        )

    def spread(self, places: NDArray[np.intp], n: int) -> PulseFit:
        """Return n rows with these at `places`; the others are nan, not clipped and not converged."""
        spread = {}
        for f in fields(self):
            held = getattr(self, f.name)
            spread[f.name] = np.full((n, *held.shape[1:]), np.nan if held.dtype.kind == "f" else 0, held.dtype)
            spread[f.name][places] = held
        return PulseFit(**spread)

    def rows(self, chosen: Rows) -> PulseFit:
        """Return some of the rows."""
        return PulseFit(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    @property
    def restitution(self) -> Floats:
        """Restitution exp(s), above 1 for a pulse that rises more slowly than it falls."""
        return np.exp(self.shape)


# -- the samples of a fit -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Window:
    """The samples of some rows that a fit uses.

    Attributes
    ----------
    rows : rows of the frames, (n,)
    values, times : (n, n_points); times in samples of the frame
    averaged : samples per point, (n,)
    outside, clipped : points outside the frame and at the sensor's limit, (n, n_points); None if there are none
    elsewhere : largest magnitude of the samples outside the window, (n,)
    run : samples per point if equal for all rows by design, else 1
    reach : last column of the window, in the frame or beyond it, (n,)
    """

    rows: NDArray[np.intp]
    values: Floats
    times: Floats
    averaged: Floats
    outside: NDArray[np.bool_] | None
    clipped: NDArray[np.bool_] | None
    elsewhere: Floats
    run: int
    reach: NDArray[np.intp]

    def part(self, rows: Rows) -> Window:
        """Return some of its rows."""
        arrays = {f.name: rows_of(getattr(self, f.name), rows) for f in fields(self) if f.name != "run"}
        return Window(run=self.run, **arrays)


def windows(
    samples: NDArray[np.floating],
    guess: Floats,
    offset: Floats | float,
    clip_level: Floats | float,
    unit: Floats | float = 1.0,
    averaged: bool = True,
    before: int = 0,
) -> Iterator[Window]:
    """Yield windows around pulses (peak, ln width, place, shape, baseline), grouped by similar length.

    Values are divided by `unit`; `offset` and `clip_level` are in the unit of the samples. Each window begins `before`
    points earlier than the pulse needs.
    """
    offset, clip_level, unit = (np.broadcast_to(value, len(samples)) for value in (offset, clip_level, unit))
    width = np.exp(guess[:, 1])
    duration, lead, _, _ = relative_times(guess[:, 3])
    first = np.floor(guess[:, 2] - (lead + _MARGIN) * width).astype(np.intp) - 2
    lengths = np.minimum(duration + 2 * _MARGIN, lead + _MARGIN + _FURTHEST) * width
    # Lengths come in steps, so that a row's window does not depend on the other rows.
    step = np.ceil(np.log(np.maximum(lengths, 1.0)) / np.log(_STEP)).astype(np.intp)
    for chosen in np.unique(step):
        rows = np.flatnonzero(step == chosen)
        length = int(np.ceil(_STEP**chosen)) + 4
        run = max(-(-length // _LONGEST), 1) if averaged else 1
        length = -(-length // run) * run + before * run
        yield _window(
            samples, rows, first[rows] - before * run, length, run, offset[rows], clip_level[rows], unit[rows]
        )


def _window(
    samples: NDArray[np.floating],
    rows: NDArray[np.intp],
    first: NDArray[np.intp],
    length: int,
    run: int,
    offset: Floats,
    clip_level: Floats,
    unit: Floats,
) -> Window:
    columns = first[:, None] + np.arange(length)
    beyond = (columns < 0) | (columns >= samples.shape[1])
    values = samples[rows[:, None], np.clip(columns, 0, samples.shape[1] - 1)] - offset[:, None]
    clipped = ~beyond & (values >= clip_level[:, None])
    # Each run of samples becomes one point.
    shape = (len(rows), length // run, run)
    return Window(
        rows=rows,
        values=(values / unit[:, None]).reshape(shape).mean(axis=2),
        times=columns.astype(np.float64).reshape(shape).mean(axis=2),
        averaged=np.full(len(rows), float(run)),
        outside=beyond.reshape(shape).any(axis=2) if beyond.any() else None,
        clipped=clipped.reshape(shape).any(axis=2) if clipped.any() else None,
        elsewhere=_largest_elsewhere(samples, rows, first, length, offset) / unit,
        run=run,
        reach=first + length - 1,
    )


def _largest_elsewhere(
    samples: NDArray[np.floating], rows: NDArray[np.intp], first: NDArray[np.intp], length: int, offset: Floats
) -> Floats:
    n_samples = samples.shape[1]
    begin, end = np.clip(first, 0, n_samples), np.clip(first + length, 0, n_samples)
    # The parts of a row before and after the window, and what lies between, as runs of all samples one after another.
    edges = np.stack([np.zeros_like(begin), begin, end, np.full_like(begin, n_samples)], axis=1)
    flat = np.minimum((edges + (rows * n_samples)[:, None]).ravel(), samples.size - 1)
    highest, lowest = (
        reduce.reduceat(samples.ravel(), flat).reshape(-1, 4)[:, :3:2] for reduce in (np.maximum, np.minimum)
    )
    some = np.stack([begin > 0, end < n_samples], axis=1)
    away = np.maximum(highest - offset[:, None], offset[:, None] - lowest)
    return np.where(some, away, 0.0).max(axis=1)


def strongest_run(samples: NDArray[np.floating], offset: Floats) -> tuple[Floats, Floats, Floats]:
    """Return peak, width [samples] and place [samples] of the pulse that stands out most, each (n,).

    It is where the mean over a run of samples is most significant. A box is within 6 % of the matched filter for these
    pulses, and running sums make boxes of all lengths cheap. `offset` (n,) is subtracted first.
    """
    n, n_samples = samples.shape
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples - offset[:, None], axis=1, dtype=np.float64, out=total[:, 1:])
    best = np.full(n, -np.inf)
    run, place = np.ones(n), np.zeros(n)
    rows = np.arange(n)
    length = _SHORTEST
    while length <= max(_LONGEST_SHARE * n_samples, _SHORTEST):
        strength = (total[:, length:] - total[:, :-length]) / np.sqrt(length)
        top = np.argmax(strength, axis=1)
        better = strength[rows, top] > best
        best = np.where(better, strength[rows, top], best)
        run, place = np.where(better, length, run), np.where(better, top + 0.5 * (length - 1), place)
        length = max(int(length * _GROWTH), length + 1)
    return best / np.sqrt(run) / _MEAN_OVER_PEAK, run / _RUN_OVER_WIDTH, place


# -- the fit ------------------------------------------------------------------------------------------


def fit_pulses(
    samples: NDArray[np.floating],
    start: Start,
    noise: Floats,
    *,
    offset: Floats | None = None,
    fit_baseline: bool = False,
    onset: Floats | None = None,
    clip_level: Floats | None = None,
    response: Floats | None = None,
    n_quiet: Floats | None = None,
) -> PulseFit:
    """Return the most likely pulse of the damped-Hertz family in each row of samples, (n, n_samples).

    `noise` (n,) is the standard deviation of the noise. It is white, unless the first `n_quiet` (n,) samples of the
    frames show another colour. `offset` (n,) is subtracted first, `onset` (n,) [samples]
    is the time of touch if known. Samples at or above `clip_level` (n,) are lower bounds of the force; infinite: not
    clipped. `response` (n_lags,) is the sensor's symmetric impulse response from lag 0: it filters the pulse, not the
    noise.
    """
    if not len(samples):
        return PulseFit.nothing()
    n = len(samples)
    offset = np.zeros(n) if offset is None else offset
    clip_level = np.full(n, np.inf) if clip_level is None else clip_level
    blocks = (slice(first, first + _ROWS) for first in range(0, n, _ROWS))
    parts = (
        (
            samples[rows],
            start.rows(rows),
            noise[rows],
            offset[rows],
            clip_level[rows],
            rows_of(onset, rows),
            rows_of(n_quiet, rows),
        )
        for rows in blocks
    )
    return PulseFit.joined([_fit_block(*part, fit_baseline, response) for part in parts])


def _fit_block(
    samples: NDArray[np.floating],
    start: Start,
    noise: Floats,
    offset: Floats,
    clip_level: Floats,
    onset: Floats | None,
    n_quiet: Floats | None,
    fit_baseline: bool,
    response: Floats | None,
) -> PulseFit:
    # In units of its first peak, every pulse is of order 1.
    unit = start.peak
    noise_over_peak = np.maximum(noise / unit, _NOISE_FLOOR)
    with np.errstate(all="ignore"):  # the fit of a frame without a pulse fails; `evidence` shows it
        parts_found = around(samples, start.place, start.width, offset, clip_level, _REACH)
        found = Found.joined(
            [(rows, search(own, start.place[rows], start.width[rows], fit_baseline)) for rows, own in parts_found]
        )
        guess = found.start()
        guess[:, [0, 4]] /= unit[:, None]
        parts = []
        for rows, coloured in _by_colour(samples, n_quiet, MODEL_ERROR * unit):
            levels = (offset[rows], clip_level[rows], unit[rows])
            for window in windows(samples[rows], guess[rows], *levels, response is None, ORDER * coloured):
                own = rows[window.rows]
                problem = Problem(window, fit_baseline, rows_of(onset, own), response)
                sigma = noise_over_peak[own]
                if coloured and n_quiet is not None:
                    problem.colour = colour_of(samples[own], n_quiet[own], MODEL_ERROR * unit[own], window.run)
                    sigma = problem.colour.innovation / unit[own] * np.sqrt(window.run)
                best = _search(problem, guess[own], sigma / np.sqrt(window.averaged), _ITERATIONS, 1e-6)
                parts.append((own, _report(problem, best, sigma, noise_over_peak[own], unit[own], found.rows(own))))
    rows = np.concatenate([rows for rows, _ in parts])
    return PulseFit.joined([part for _, part in parts]).rows(np.argsort(rows, kind="stable"))


def _by_colour(
    samples: NDArray[np.floating], n_quiet: Floats | None, floor: Floats
) -> list[tuple[NDArray[np.intp], bool]]:
    """Return the rows with white noise, and those with coloured noise and True; without the empty ones."""
    rows = np.arange(len(samples))
    coloured = np.empty(0, np.intp) if n_quiet is None else colour_of(samples, n_quiet, floor).rows
    white = rows if not coloured.size else np.setdiff1d(rows, coloured)
    return [(part, flag) for part, flag in ((white, False), (coloured, True)) if part.size]


class Problem:
    """A window of samples and the curve to fit to it; the onset [samples] and the sensor's response may be unknown."""

    def __init__(self, window: Window, fit_baseline: bool, onset: Floats | None, response: Floats | None) -> None:
        self.window, self.onset, self.fit_baseline = window, onset, fit_baseline
        self.free = free_parameters(onset is not None, fit_baseline)
        #: The mean over a run of samples is the curve at its middle plus this share of its second difference.
        self.blur = (1 - window.run**-2) / 24 if window.run > 1 else 0.0
        self.colour: Colour | None = None
        self.mixing = None
        if response is not None:
            self.mixing = mixing_matrix(response, window.values.shape[1])

    def tied(self, parameters: Floats, rows: Rows = slice(None)) -> Floats:
        """Return the parameters, with the place that follows from a known onset."""
        if self.onset is not None:
            _, lead, _, _ = relative_times(parameters[:, 3])
            parameters[:, 2] = self.onset[rows] + lead * np.exp(parameters[:, 1])
        return parameters

    def residual(self, parameters: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """Return samples minus curve (n, n_samples), and the slopes of the curve (n, n_free, n_samples)."""
        both = self.slopes_and_residual(parameters, rows)
        return both[:, -1], both[:, :-1]

    def slopes_and_residual(self, parameters: Floats, rows: Rows) -> Floats:
        """Return the slopes of the curve and, last, samples minus curve, (n, n_free + 1, n_samples)."""
        times = self.window.times[rows]
        curves = slopes_and_pulse(parameters, times, self.onset is not None, self.fit_baseline)
        if self.mixing is not None:
            curves = curves @ self.mixing
        if self.blur:
            curves[..., 1:-1] += self.blur * np.diff(curves, n=2)
        residual = curves[:, -1]
        np.subtract(self.window.values[rows], residual, out=residual)
        if self.fit_baseline:
            residual -= parameters[:, 4:]
        # Points outside the frame count nothing, nor do clipped samples below the curve.
        ignored = rows_of(self.window.outside, rows)
        if self.window.clipped is not None:
            above = self.window.clipped[rows] & (residual < 0)
            ignored = above if ignored is None else ignored | above
        if ignored is not None:
            curves[np.broadcast_to(ignored[:, None], curves.shape)] = 0.0
        if self.colour is not None:
            curves = self.colour.whitened(curves, np.arange(len(self.window.rows))[rows])
        return curves


@dataclass(frozen=True, eq=False)
class Optimum:
    """Parameters (n, 5), squared residual, information (times the variance of the noise) and convergence of rows."""

    parameters: Floats
    cost: Floats
    information: Floats
    converged: NDArray[np.bool_]

    def rows(self, chosen: Rows) -> Optimum:
        """Return some of the rows."""
        return Optimum(*(getattr(self, one.name)[chosen] for one in fields(self)))


def _search(
    problem: Problem, guess: Floats, sigma: Floats, iterations: int, first_damping: float, rows: Rows = slice(None)
) -> Optimum:
    """Return the optimum nearest to a guess, for all rows of a problem or some."""
    row = np.arange(len(problem.window.rows))[rows]
    parameters = problem.tied(guess, row)
    n, free, variance, column = len(parameters), problem.free, sigma**2, problem.free.index(3)
    cost, information, gradient = _equations(problem.slopes_and_residual(parameters, row))
    damping, active, converged = np.full(n, first_damping), np.arange(n), np.zeros(n, bool)
    for _ in range(iterations):
        held = _held(parameters[active], information[active], gradient[active], column)
        step, promise = _step(*held, damping[active])
        tried = _moved(problem, parameters[active], step, row[active])
        done = promise < _TOLERANCE * variance[active]
        if done.any():
            last = active[done]
            converged[last], parameters[last] = True, tried[done]
            cost[last] -= np.maximum(promise[done], 0.0)
            active, tried, promise = active[~done], tried[~done], promise[~done]
            if not active.size:
                break
        new = _equations(problem.slopes_and_residual(tried, row[active]))
        gained = cost[active] - new[0]
        better = gained >= 0
        taken = active[better]
        parameters[taken] = tried[better]
        cost[taken], information[taken], gradient[taken] = (a[better] for a in new)
        # A step that gains much less than promised has overshot; the next would come back.
        raised = np.maximum(np.where(better, 2.0, 10.0) * damping[active], _FELT)
        damping[active] = np.where(gained > _KEPT * promise, 0.1 * damping[active], raised)
        # Where even a tiny step goes uphill, the minimum is at a kink (a sample at touch).
        stuck = damping[active] > _STUCK
        converged[active[stuck]] = True
        active = active[~stuck]
    return Optimum(parameters, cost, information, converged)


def _moved(problem: Problem, parameters: Floats, step: Floats, rows: NDArray[np.intp]) -> Floats:
    """Return parameters (n, 5) after a step in the free ones, within bounds."""
    moved = parameters.copy()
    moved[:, problem.free] += _bounded(step, problem.free, np.exp(parameters[:, 1]))
    moved[:, 3] = np.minimum(np.maximum(moved[:, 3], LOWEST_SHAPE), HIGHEST_SHAPE)
    return problem.tied(moved, rows)


def normal_equations(residual: Floats, slopes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return squared residual (n,), information (n, n_free, n_free) and gradient (n, n_free)."""
    return _equations(np.concatenate([slopes, residual[:, None]], axis=1))


def _equations(curves: Floats) -> tuple[Floats, Floats, Floats]:
    """Return `normal_equations` of slopes and, last, the residual, (n, n_free + 1, n_samples)."""
    products = np.matmul(curves, np.swapaxes(curves, 1, 2))
    return products[:, -1, -1], products[:, :-1, :-1], products[:, :-1, -1]


def _held(parameters: Floats, information: Floats, gradient: Floats, column: int) -> tuple[Floats, Floats]:
    """Return information and gradient in which a shape at its bound stays where it would leave the bounds."""
    shape, pull = parameters[:, 3], gradient[:, column]
    out = ((shape <= LOWEST_SHAPE) & (pull < 0)) | ((shape >= HIGHEST_SHAPE) & (pull > 0))
    information[out, column, :] = information[out, :, column] = 0.0
    information[out, column, column] = 1.0
    gradient[out, column] = 0.0
    return information, gradient


def _step(information: Floats, gradient: Floats, damping: Floats) -> tuple[Floats, Floats]:
    """Return the damped step, and the reduction of the squared residual that a linear model predicts."""
    step = solve_scaled(information, gradient, (damping + 1e-10)[:, None, None])
    return step, np.sum(step * gradient, axis=1)


def _bounded(step: Floats, free: list[int], width: Floats) -> Floats:
    for column, parameter in enumerate(free):
        if 1 <= parameter <= 3:
            largest = _LARGEST_STEPS[parameter - 1] * (width if parameter == 2 else 1.0)
            step[:, column] = np.clip(step[:, column], -largest, largest)
    return step


def _report(problem: Problem, best: Optimum, sigma: Floats, noise: Floats, unit: Floats, found: Found) -> PulseFit:
    """Return the fitted pulses; `sigma`, `noise` and the parameters are in units of the start's peak."""
    window = problem.window
    variance = sigma**2 / window.averaged
    believed = variance + _model_variance(best.parameters[:, 0], window.averaged)
    covariance = _parabolic(problem, best, believed)
    restitution = _gaussian_restitution(best.parameters[:, 3], covariance[:, 3, 3])
    shape = best.parameters[:, 3]
    doubt = (covariance[:, 3, 3] > _PARABOLIC**2) | found.in_doubt(shape, believed * window.averaged * unit**2)
    well = (found.unit >= _WELL_BINNED) & (problem.colour is None)
    for profiled, some in ((_binned, well), (_exact, ~well)):
        rows = np.flatnonzero(doubt & some & (shape < _HIGHEST_PROFILED))
        if rows.size:
            profile = profiled(problem, found.rows(rows), unit[rows], rows)
            tops = _improve(problem, best, profile, believed, rows)
            covariance[rows], restitution[:, rows] = profile.moments(tops, believed[rows], problem)
    peak, log_width, place, shape, baseline = best.parameters.T
    width = np.exp(log_width)
    duration, lead, _, _ = relative_times(shape)
    covariance[:, 4] *= unit[:, None]
    covariance[:, :, 4] *= unit[:, None]
    clipped = np.zeros(len(peak), np.intp) if window.clipped is None else window.clipped.sum(axis=1)
    counted = window.values.shape[1] - (0 if window.outside is None else window.outside.sum(axis=1))
    freedom = np.maximum(counted - clipped - len(problem.free), 1)
    stray = (window.elsewhere / _OUTLIER) ** 2 / (noise**2 + (MODEL_ERROR * peak) ** 2)
    return PulseFit(
        peak=peak * unit,
        duration=width * duration,
        onset=place - lead * width,
        width=width,
        shape=shape,
        baseline=baseline * unit,
        covariance=covariance,
        restitution_deviation=restitution[0],
        expected_restitution=restitution[1],
        expected_deviation=restitution[2],
        misfit=np.maximum(best.cost / freedom / believed, stray),
        stray=(window.elsewhere / _OUTLIER) ** 2 / (noise**2 + (STRAY * peak) ** 2),
        clipped=clipped,
        evidence=peak**2 * np.maximum(best.information[:, 0, 0], 0.0) / variance,
        converged=best.converged,
        reach=window.reach,
    )


# -- where the likelihood is no parabola --------------------------------------------------------------


def _gaussian_restitution(shape: Floats, variance: Floats) -> Floats:
    """Return deviation, expected value and its deviation of the restitution for a Gaussian likelihood, (3, n)."""
    restitution = np.exp(shape)
    deviation = restitution * np.sqrt(variance)
    mean, wide = WIDE_RESTITUTION
    certainty = np.maximum(deviation, 1e-12) ** -2.0
    total = certainty + wide**-2
    return np.stack([deviation, (certainty * restitution + mean * wide**-2) / total, total**-0.5])


@cache
def _interpolation() -> tuple[Floats, Floats]:
    """Return a fine grid of shapes, and the matrix from values at `PROFILED` to a cubic spline there."""
    fine = np.linspace(PROFILED[0], PROFILED[-1], 8 * (PROFILED.size - 1) + 1)
    n, step = PROFILED.size, PROFILED[1] - PROFILED[0]
    # Second derivatives of a natural spline from its values.
    bend = np.zeros((n, n))
    inner = np.arange(1, n - 1)
    system = np.eye(n - 2) * 4 + np.eye(n - 2, k=1) + np.eye(n - 2, k=-1)
    differences = np.zeros((n - 2, n))
    differences[inner - 1, inner - 1], differences[inner - 1, inner], differences[inner - 1, inner + 1] = 1, -2, 1
    bend[1:-1] = np.linalg.solve(system, 6 * differences / step**2)
    cell = np.minimum(((fine - PROFILED[0]) / step).astype(np.intp), n - 2)
    far = (fine - PROFILED[cell]) / step
    near, eye = 1 - far, np.eye(n)
    matrix = near[:, None] * eye[cell] + far[:, None] * eye[cell + 1]
    matrix += (step**2 / 6) * ((near**3 - near)[:, None] * bend[cell] + (far**3 - far)[:, None] * bend[cell + 1])
    return fine, matrix


def _model_variance(peak: Floats, averaged: Floats) -> Floats:
    """Return the variance that the model of the pulse is worth: a better recorder cannot know more."""
    return (MODEL_ERROR * peak) ** 2 / averaged


def _parabolic(problem: Problem, best: Optimum, variance: Floats) -> Floats:
    """Return the covariance of a parabolic likelihood for noise of this variance, (n,)."""
    known = problem.onset is not None
    covariance = covariance_of(best.information, best.parameters, known, problem.fit_baseline)
    return covariance * variance[:, None, None]


@dataclass(frozen=True, eq=False)
class Profiled:
    """The best parameters (n, n_shapes, 5) at each of `PROFILED`, and their squared residuals (n, n_shapes).

    The costs of the search, `found`, times `scale` (n,) are squared residuals, too. Where the bins tell as much as the
    samples, they are these (`binned`).
    """

    parameters: Floats
    cost: Floats
    found: Found
    scale: Floats
    binned: bool

    def second(self, best: Optimum, variance: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return parameters (n, 5) of another likely shape than the best, and which rows have one."""
        # Whichever valley the first search did not end in.
        away = [np.abs(self.found.shape_of(k) - best.parameters[:, 3]) for k in (0, 1)]
        guess = np.where((away[1] < away[0])[:, None], self.found.start(), self.found.start(second=True))
        guess[:, [0, 4]] *= (self.parameters[:, 0, 0] / self.found.peak[:, 0])[:, None]
        likely = self.found.has_second(BIN * self.found.unit * variance / self.scale)
        if self.binned:
            return guess, likely
        far = np.where(np.abs(PROFILED - best.parameters[:, 3:4]) > _ANOTHER, self.cost, np.inf)
        rows, node = np.arange(len(far)), np.argmin(far, axis=1)
        lower = far[rows, node] < best.cost + np.where(likely, -1, 16) * variance
        return np.where(lower[:, None], self.parameters[rows, node], guess), likely | lower

    def moments(self, tops: list[Optimum], variance: Floats, problem: Problem) -> tuple[Floats, Floats]:
        """Return covariances about the best parameters, and restitutions as `_gaussian_restitution`.

        `tops` holds the best parameters, perhaps also those of a second top of the likelihood; `variance` is that of
        the noise. A top narrower than the grid counts by its own parabola, as three points of Gauss and Hermite.
        """
        fine, spline = _interpolation()
        best, shapes = tops[0].parameters, [np.broadcast_to(fine, (len(variance), fine.size))]
        squares = [np.matmul((self.cost / variance[:, None])[:, None], spline.T)[:, 0]]
        away = [np.matmul(spline, _away(self.parameters, PROFILED, best))]
        for top in tops:
            shape = top.parameters[:, 3:4]
            covariance = _parabolic(problem, top, variance)
            deviation = np.sqrt(covariance[:, 3, 3:4])
            narrow = deviation < _PARABOLIC
            squares[0] = np.where(narrow & (np.abs(fine - shape) < 3 * deviation), np.inf, squares[0])
            width = np.maximum(deviation, 1e-9) * np.sqrt(2 * np.pi) / (fine[1] - fine[0])
            squares.append(
                np.where(narrow, top.cost[:, None] / variance[:, None] - 2 * np.log(width * _HERMITE[1]), np.inf)
            )
            steps = deviation * _HERMITE[0]
            shapes.append(shape + steps)
            slopes = covariance[:, None, :, 3] / covariance[:, None, 3:4, 3]
            away.append(_away(top.parameters[:, None], shape, best) + steps[:, :, None] * slopes)
        s, square, moved = (np.concatenate(parts, axis=1) for parts in (shapes, squares, away))
        weight = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)))
        weight /= weight.sum(axis=1, keepdims=True)
        if problem.onset is not None:
            moved[:, :, 2] = 0.0
        spread = np.matmul(np.swapaxes(moved, 1, 2), weight[:, :, None] * moved)
        covariance = _parabolic(problem, tops[0], variance)
        column = covariance[:, :, 3]
        given_shape = covariance - column[:, :, None] * column[:, None] / covariance[:, 3, 3][:, None, None]
        e, mean, wide = np.exp(s), *WIDE_RESTITUTION
        deviation = np.sqrt(np.sum(weight * (e - np.exp(best[:, 3:4])) ** 2, axis=1))
        # The prior is a density of e, the grid one of ln e.
        weight = weight * (e * np.exp(-0.5 * ((e - mean) / wide) ** 2))
        weight /= weight.sum(axis=1, keepdims=True)
        expected = np.sum(weight * e, axis=1)
        rest = np.sqrt(np.sum(weight * (e - expected[:, None]) ** 2, axis=1))
        return given_shape + spread, np.stack([deviation, expected, rest])


def _away(parameters: Floats, shape: Floats, best: Floats) -> Floats:
    """Return how far parameters (n, k, 5) at some shapes are from the best (n, 5), as they are reported."""
    away = _reported(parameters, shape) - _reported(best[:, None], best[:, 3:4])
    return np.where(np.isfinite(away), away, 0.0)


def _reported(parameters: Floats, shape: Floats) -> Floats:
    """Return (ln peak, ln duration, onset, shape, baseline) of parameters (n, k, 5) at shapes of (n, k) or (k,)."""
    duration, lead, _, _ = (a.reshape(shape.shape) for a in relative_times(shape.ravel()))
    shape = np.broadcast_to(shape, parameters.shape[:2])
    log_peak = np.log(np.maximum(parameters[:, :, 0], 1e-300))
    onset = parameters[:, :, 2] - lead * np.exp(parameters[:, :, 1])
    return np.stack([log_peak, parameters[:, :, 1] + np.log(duration), onset, shape, parameters[:, :, 4]], axis=2)


def _binned(problem: Problem, found: Found, unit: Floats, rows: NDArray[np.intp]) -> Profiled:
    """Return what is best at each shape by the search, whose bins hold several samples each."""
    scale = found.unit * BIN / problem.window.averaged[rows] / unit**2
    return Profiled(_at_shapes(found, unit), found.cost[:, _EVERY] * scale[:, None], found, scale, True)


def _at_shapes(found: Found, unit: Floats) -> Floats:
    """Return the parameters found by the search at each of `PROFILED`, (n, n_shapes, 5)."""
    peak, width, place, baseline = (a[:, _EVERY] for a in (found.peak, found.width, found.place, found.baseline))
    shape = np.broadcast_to(PROFILED, peak.shape)
    return np.stack([peak / unit[:, None], np.log(width), place, shape, baseline / unit[:, None]], axis=2)


def _exact(problem: Problem, found: Found, unit: Floats, rows: NDArray[np.intp]) -> Profiled:
    """Return what is best at each shape, by one step of Gauss and Newton from the results of the search."""
    n, n_shapes = len(rows), PROFILED.size
    scale = found.unit * BIN / problem.window.averaged[rows] / unit**2
    each = np.repeat(rows, n_shapes)
    flat = problem.tied(_at_shapes(found, unit).reshape(-1, 5), each)
    kept = [k for k, column in enumerate(problem.free) if column != 3]
    columns = [problem.free[k] for k in kept]
    cost, information, gradient = _equations(problem.slopes_and_residual(flat, each)[:, [*kept, -1]])
    step = solve_scaled(information, gradient, 1e-9)
    cost = cost - np.sum(step * gradient, axis=1)
    flat[:, columns] += _bounded(step, columns, np.exp(flat[:, 1]))
    return Profiled(flat.reshape(n, n_shapes, 5), cost.reshape(n, n_shapes), found, scale, False)


def _improve(
    problem: Problem, best: Optimum, profile: Profiled, variance: Floats, rows: NDArray[np.intp]
) -> list[Optimum]:
    """Search again from the second likely shape of some rows; keep the better in place, return both, of these rows."""
    tops = [best.rows(rows)]
    guess, likely = profile.second(tops[0], variance[rows])
    if likely.any():
        again = _search(problem, guess[likely], np.sqrt(variance[rows[likely]]), _ITERATIONS, 1e-6, rows[likely])
        better = again.cost < tops[0].cost[likely]
        tops.append(tops[0].rows(slice(None)))
        for one in fields(Optimum):
            first, second, new = (getattr(held, one.name) for held in (*tops, again))
            swapped = np.flatnonzero(likely)[better]
            second = second.copy()
            second[likely] = new
            second[swapped] = first[swapped]
            first = first.copy()
            first[swapped] = new[better]
            getattr(best, one.name)[rows] = first
            tops = [replace(top, **{one.name: value}) for top, value in zip(tops, (first, second), strict=True)]
    if profile.binned:
        tops = [replace(top, cost=profile.found.depth_near(top.parameters[:, 3]) * profile.scale) for top in tops]
    return tops

"""The most likely pulse in windows of samples: Levenberg-Marquardt, batched over rows.

Damping bounds the steps of each row; rows that are done leave the batch. Everything but the curves themselves is
computed for all windows at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.measure.ar_noise import ARNoise
from cgid.measure.filters import mixing_matrix
from cgid.measure.fit_samples import Rows, Window, rows_of
from cgid.measure.template import (
    HIGHEST_SHAPE,
    LOWEST_SHAPE,
    free_parameters,
    relative_times,
    slopes_and_pulse,
    solve_scaled,
)
from cgid.validation import Floats

#: Largest steps of ln(width), of the place over the width, and of s.
LARGEST_STEPS = (0.4, 0.5, 0.7)
_ITERATIONS = 8
#: A step is the last, and not evaluated, when it promises to reduce the squared residual by less than this share of the
#: noise variance, undamped (what it leaves is of higher order) and damped.
_LAST, _LAST_DAMPED = 0.03, 0.008
#: First damping, and the least after a failed step: less would not change the step.
_FIRST_DAMPING, _FELT = 1e-6, 0.6
#: Share of the promised gain from which a step was good.
_KEPT = 0.7
#: A search ends at this damping.
_STUCK = 1e4
#: Points of curves that are computed at once: they stay in the processor's cache.
_BLOCK = 16384


class Problem:
    """A window of samples and the curve to fit to it; the onset [samples] and the sensor's response may be unknown."""

    def __init__(self, window: Window, fit_baseline: bool, onset: Floats | None, response: Floats | None) -> None:
        self.window, self.onset, self.fit_baseline = window, onset, fit_baseline
        self.free = free_parameters(onset is not None, fit_baseline)
        #: The mean over a run of samples is the curve at its middle plus this share of its second difference.
        self.blur = (1 - window.run**-2) / 24 if window.run > 1 else 0.0
        self.colour: ARNoise | None = None
        self.mixing = None
        if response is not None:
            self.mixing = mixing_matrix(response, window.values.shape[1])

    def tied(self, parameters: Floats, rows: Rows = slice(None)) -> Floats:
        """Return the parameters, with the place that follows from a known onset."""
        return tied(parameters, rows_of(self.onset, rows))

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


class Problems:
    """The windows of many rows, by the place of each row.

    Attributes
    ----------
    averaged : samples per point of each row's window, (n,)
    coloured : rows whose noise is not white, (n,)
    """

    def __init__(self, parts: list[tuple[NDArray[np.intp], Problem]], onset: Floats | None) -> None:
        self.parts, self.onset = parts, onset
        self.free, self.fit_baseline = parts[0][1].free, parts[0][1].fit_baseline
        n = sum(len(rows) for rows, _ in parts)
        self._part, self._place = np.zeros(n, np.intp), np.arange(n)
        self.coloured = np.zeros(n, bool)
        for part, (rows, problem) in enumerate(parts):
            self._part[rows], self._place[rows] = part, np.arange(len(rows))
            self.coloured[rows] = problem.colour is not None
        self.averaged = self.gathered([problem.window.averaged for _, problem in parts])

    def gathered(self, values: list[Any]) -> Any:
        """Return an array of all rows from those of the windows."""
        out = np.empty(len(self._part), values[0].dtype)
        for (rows, _), own in zip(self.parts, values, strict=True):
            out[rows] = own
        return out

    def tied(self, parameters: Floats, rows: Rows = slice(None)) -> Floats:
        """Return the parameters, with the place that follows from a known onset."""
        return tied(parameters, rows_of(self.onset, rows))

    def equations(self, parameters: Floats, rows: NDArray[np.intp]) -> Floats:
        """Return the products (n, n_free + 1, n_free + 1) of slopes and, last, the residual at parameters (n, 5)."""
        out = np.empty((len(rows), len(self.free) + 1, len(self.free) + 1))
        part, place = self._part[rows], self._place[rows]
        for k, (_, problem) in enumerate(self.parts):
            own = np.flatnonzero(part == k) if len(self.parts) > 1 else np.arange(len(rows))
            step = max(_BLOCK // problem.window.values.shape[1], 1)
            for some in (own[first : first + step] for first in range(0, own.size, step)):
                curves = problem.slopes_and_residual(parameters[some], place[some])
                out[some] = np.matmul(curves, np.swapaxes(curves, 1, 2))
        return out


def tied(parameters: Floats, onset: Floats | None) -> Floats:
    """Return the parameters (n, 5), with the place that follows from a known onset, (n,), in place."""
    if onset is not None:
        _, lead, _, _ = relative_times(parameters[:, 3])
        parameters[:, 2] = onset + lead * np.exp(parameters[:, 1])
    return parameters


@dataclass(frozen=True, eq=False)
class Optimum:
    """Parameters (n, 5), squared residual, information (times the variance of the noise) and convergence of rows."""

    parameters: Floats
    cost: Floats
    information: Floats
    converged: NDArray[np.bool_]

    def rows(self, chosen: Rows) -> Optimum:
        """Return copies of some of the rows."""
        return Optimum(*(np.array(getattr(self, one.name)[chosen]) for one in fields(self)))

    def put(self, chosen: NDArray[np.intp], other: Optimum) -> None:
        """Replace some of the rows."""
        for one in fields(self):
            getattr(self, one.name)[chosen] = getattr(other, one.name)


def search_nearby(problems: Problems, guess: Floats, sigma: Floats, rows: NDArray[np.intp]) -> Optimum:
    """Return the optimum nearest to a guess, (n, 5), for some rows (n,); `sigma` (n,) is the noise of a point."""
    parameters = problems.tied(np.where(np.isfinite(guess), guess, 0.0), rows)
    n, variance, column = len(parameters), sigma**2, problems.free.index(3)
    products = problems.equations(parameters, rows)
    damping, active, converged = np.full(n, _FIRST_DAMPING), np.arange(n), np.zeros(n, bool)
    for _ in range(_ITERATIONS):
        step, promise = _step(products[active], parameters[active, 3], damping[active], column)
        tried = _moved(problems, parameters[active], step, rows[active])
        done = promise < np.where(damping[active] < _FELT, _LAST, _LAST_DAMPED) * variance[active]
        if done.any():
            last = active[done]
            converged[last], parameters[last] = True, tried[done]
            products[last, -1, -1] -= promise[done]
            active, tried, promise = active[~done], tried[~done], promise[~done]
            if not active.size:
                break
        new = problems.equations(tried, rows[active])
        gained = products[active, -1, -1] - new[:, -1, -1]
        better = gained >= 0
        taken = active[better]
        parameters[taken], products[taken] = tried[better], new[better]
        # A step that gains much less than promised has overshot; the next would come back.
        raised = np.maximum(np.where(better, 2.0, 10.0) * damping[active], _FELT)
        damping[active] = np.where(gained > _KEPT * promise, 0.1 * damping[active], raised)
        # Where even a tiny step goes uphill, the minimum is at a kink (a sample at touch).
        stuck = damping[active] > _STUCK
        if stuck.any():
            converged[active[stuck]] = True
            active = active[~stuck]
            if not active.size:
                break
    return Optimum(parameters, products[:, -1, -1], products[:, :-1, :-1], converged)


def normal_equations(residual: Floats, slopes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return squared residual (n,), information (n, n_free, n_free) and gradient (n, n_free)."""
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
    gradient = np.matmul(slopes, residual[..., None])[..., 0]
    return np.sum(residual**2, axis=1), information, gradient


def _step(products: Floats, shape: Floats, damping: Floats, column: int) -> tuple[Floats, Floats]:
    """Return the damped step, and the reduction of the squared residual that a linear model predicts.

    `products` is that of `Problems.equations`. A shape at its bound stays where it would leave the bounds.
    """
    information, gradient = products[:, :-1, :-1], products[:, :-1, -1]
    pull = gradient[:, column]
    out = ((shape <= LOWEST_SHAPE) & (pull < 0)) | ((shape >= HIGHEST_SHAPE) & (pull > 0))
    if out.any():
        information, gradient = information.copy(), gradient.copy()
        information[out, column, :] = information[out, :, column] = gradient[out, column] = 0.0
        information[out, column, column] = 1.0
    step = solve_scaled(information, gradient, (damping + 1e-10)[:, None, None])
    return step, np.sum(step * gradient, axis=1)


def _moved(problems: Problems, parameters: Floats, step: Floats, rows: NDArray[np.intp]) -> Floats:
    """Return parameters (n, 5) after a step in the free ones, within bounds."""
    moved = parameters.copy()
    moved[:, problems.free] += bounded(step, problems.free, np.exp(parameters[:, 1]))
    moved[:, 3] = np.minimum(np.maximum(moved[:, 3], LOWEST_SHAPE), HIGHEST_SHAPE)
    # Where nothing was seen a step may be nan: no step, then.
    moved = np.where(np.isfinite(moved), moved, parameters)
    return problems.tied(moved, rows)


def bounded(step: Floats, free: list[int], width: Floats) -> Floats:
    """Return steps (n, n_free) in free parameters, none larger than `LARGEST_STEPS`; width (n,) [samples]."""
    step = step.copy()
    for column, parameter in enumerate(free):
        if 1 <= parameter <= 3:
            largest = LARGEST_STEPS[parameter - 1] * (width if parameter == 2 else 1.0)
            step[:, column] = np.minimum(np.maximum(step[:, column], -largest), largest)
    return step

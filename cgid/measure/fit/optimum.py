"""The most likely pulses in windows of samples, of all windows at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.fit_samples import Selected, Window
from cgid.measure.fit.least_squares import least_squares
from cgid.measure.fit.template import MAX_SHAPE, MIN_SHAPE, bounded

_ITERATIONS = 8
#: The last step, which is not evaluated, is one predicted to reduce the squared residual by less than this fraction of
#: the noise variance (the remaining error is of higher order).
_LAST = 0.03
#: Points of curves that are computed at once: they stay in the processor's cache.
_BLOCK = 16384


class Problems:
    """The windows of many rows, by the position of each row."""

    # `averaged` (n,): samples per point of each row's window; `coloured` (n,): rows whose noise is not white.

    def __init__(self, windows: list[Window]) -> None:
        self.windows, self.free = windows, windows[0].free
        n = sum(len(window.rows) for window in windows)
        self._window, self._row = np.zeros(n, np.intp), np.arange(n)
        for number, window in enumerate(windows):
            self._window[window.rows], self._row[window.rows] = number, np.arange(len(window.rows))
        self.coloured = np.array([window.colour is not None for window in windows])[self._window]
        self.averaged = self.gathered([window.averaged for window in windows])

    def gathered(self, values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return an array of all rows from those of the windows."""
        out = np.empty(len(self._window), values[0].dtype)
        for window, of_window in zip(self.windows, values, strict=True):
            out[window.rows] = of_window
        return out

    def equations(self, parameters: Floats, rows: NDArray[np.intp]) -> Floats:
        """Return the products (n, n_free + 1, n_free + 1) of slopes and, last, the residual at parameters (n, 4)."""
        out = np.empty((len(rows), len(self.free) + 1, len(self.free) + 1))
        number, place = self._window[rows], self._row[rows]
        for k, window in enumerate(self.windows):
            selected = np.flatnonzero(number == k) if len(self.windows) > 1 else np.arange(len(rows))
            step = max(_BLOCK // window.values.shape[1], 1)
            for some in (selected[first : first + step] for first in range(0, selected.size, step)):
                curves = window.slopes_and_residual(parameters[some], place[some])
                out[some] = np.matmul(curves, np.swapaxes(curves, 1, 2))
        return out


@dataclass(frozen=True, eq=False, repr=False)
class Optimum:
    """Parameters (n, 4), squared residual, information (times the variance of the noise) and convergence of rows."""

    parameters: Floats
    cost: Floats
    information: Floats
    converged: NDArray[np.bool_]

    def rows(self, chosen: Selected) -> Optimum:
        """Return copies of some of the rows."""
        return Optimum(*(np.array(getattr(self, one.name)[chosen]) for one in fields(self)))

    def put(self, chosen: NDArray[np.intp], other: Optimum) -> None:
        """Replace some of the rows."""
        for one in fields(self):
            getattr(self, one.name)[chosen] = getattr(other, one.name)


def search_nearby(problems: Problems, guess: Floats, sigma: Floats, rows: NDArray[np.intp]) -> Optimum:
    """Return the optimum nearest to a guess, (n, 4), for some rows (n,); `sigma` (n,) is the noise of a point."""
    free, column = problems.free, problems.free.index(3)

    def moved(parameters: Floats, step: Floats, _some: NDArray[np.intp]) -> Floats:
        new = parameters.copy()
        new[:, free] += bounded(step, free, np.exp(parameters[:, 1]))
        new[:, 3] = np.minimum(np.maximum(new[:, 3], MIN_SHAPE), MAX_SHAPE)
        # Without any samples a step may be nan, which counts as no step.
        return np.where(np.isfinite(new), new, parameters)

    def at_bound(parameters: Floats, gradient: Floats) -> NDArray[np.bool_]:
        """Return which shapes are at a bound that the step would cross."""
        out = np.zeros(gradient.shape, bool)
        shape, pull = parameters[:, 3], gradient[:, column]
        out[:, column] = ((shape <= MIN_SHAPE) & (pull < 0)) | ((shape >= MAX_SHAPE) & (pull > 0))
        return out

    parameters, products, converged = least_squares(
        np.where(np.isfinite(guess), guess, 0.0),
        lambda parameters, some: problems.equations(parameters, rows[some]),
        moved,
        _LAST * sigma**2,
        _ITERATIONS,
        at_bound,
    )
    return Optimum(parameters, products[:, -1, -1], products[:, :-1, :-1], converged)

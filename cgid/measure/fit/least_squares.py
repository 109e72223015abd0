"""Least squares by Levenberg (1944) and Marquardt (1963), batched over rows: pulses, contacts and poles use it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats

#: Initial damping, and the minimum after a failed step: less would not change the step.
_FIRST_DAMPING, _FELT = 1e-6, 0.6
#: A search ends at this damping.
_STUCK = 1e4
#: Minimum fraction of the predicted gain of a good step.
_MIN_GAIN = 0.7
#: Information on a parameter of which nothing is known: the square of its variance stays finite.
_LEAST_INFORMATION = 1e-140


def least_squares(
    start: Floats,
    equations: Callable[[Floats, NDArray[np.intp]], Floats],
    moved: Callable[[Floats, Floats, NDArray[np.intp]], Floats],
    small: Floats,
    n_steps: int,
    at_bound: Callable[[Floats, Floats], NDArray[np.bool_]] | None = None,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return parameters of least squares near `start` (n, ...), the products there, and which rows have converged."""
    # `equations` returns products (n, k + 1, k + 1) of the model's slopes and, last, the residual; `moved` takes steps
    # (n, k) within bounds; `at_bound` (n, k) are parameters that stay at their bounds. `small` (n,) are gains of the
    # squared residual that end a row's search: the last step is not evaluated, so it may gain as much undamped, a
    # quarter of it after damping.
    parameters, n = start, len(start)
    products = equations(parameters, np.arange(n))
    damping, active, converged = np.full(n, _FIRST_DAMPING), np.arange(n), np.zeros(n, bool)
    for _ in range(n_steps):
        information, gradient = products[active, :-1, :-1], products[active, :-1, -1]
        if at_bound is not None and (out := at_bound(parameters[active], gradient)).any():
            gradient[out] = 0.0
            information[out[:, :, None] | out[:, None]] = 0.0
            information += np.eye(out.shape[1]) * out[:, None]
        step = solve_scaled(information, gradient, (damping[active] + 1e-10)[:, None, None])
        promise = np.sum(step * gradient, axis=1)
        tried = moved(parameters[active], step, active)
        done = promise < np.where(damping[active] < _FELT, 1.0, 0.25) * small[active]
        if done.any():
            last = active[done]
            converged[last], parameters[last] = True, tried[done]
            products[last, -1, -1] -= promise[done]
            active, tried, promise = active[~done], tried[~done], promise[~done]
            if not active.size:
                break
        new = equations(tried, active)
        gained = products[active, -1, -1] - new[:, -1, -1]
        better = gained >= 0
        taken = active[better]
        parameters[taken], products[taken] = tried[better], new[better]
        # A step that gains much less than predicted has overshot; the next would come back.
        raised = np.maximum(np.where(better, 2.0, 10.0) * damping[active], _FELT)
        damping[active] = np.where(gained > _MIN_GAIN * promise, 0.1 * damping[active], raised)
        # Where even a tiny step goes uphill, the minimum is at a kink (a sample at onset).
        stuck = damping[active] > _STUCK
        converged[active[stuck]] = True
        active = active[~stuck]
        if not active.size:
            break
    return parameters, products, converged


def solve_scaled(information: Floats, right: Floats, ridge: Floats | float) -> Floats:
    """Return the solutions (n, n_free) of `information @ x = right`, with a ridge in scaled parameters."""
    scale, unit = scaled(information, ridge)
    return np.asarray(np.linalg.solve(unit, (right / scale)[..., None])[..., 0] / scale)


def scaled(information: Floats, ridge: Floats | float) -> tuple[Floats, Floats]:
    """Return scales and the information with ones on the diagonal, since peaks are newtons and shapes are ratios."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), _LEAST_INFORMATION))
    unit = information / (scale[:, :, None] * scale[:, None, :])
    return scale, unit + ridge * np.eye(information.shape[1])

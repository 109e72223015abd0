"""The likelihood of a pulse's shape where it is no parabola: means and standard deviations by a sum over shapes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.least_squares import solve_scaled
from cgid.measure.fit.search import BIN, NODES, SearchResult
from cgid.measure.fit.template import bounded, covariance_of, relative_times

if TYPE_CHECKING:
    from cgid.measure.fit.optimum import Optimum, Problems

#: Shapes at which the likelihood is profiled (every other one of the search).
_EVERY = slice(0, 20, 2)
PROFILED = NODES[_EVERY]
#: Distance in shape at which a second search begins.
_ANOTHER = 0.3
#: A standard deviation of s up to which the likelihood is a parabola, if it has no second maximum.
PARABOLIC = 0.1
#: Points and weights of the quadrature of a Gaussian by three points.
_HERMITE = np.array([[-np.sqrt(3), 0.0, np.sqrt(3)], [1 / 6, 2 / 3, 1 / 6]])
#: Mean and standard deviation of the restitution of any material that falls on steel.
WIDE_RESTITUTION = (0.5, 0.25)


def gaussian_restitution(shape: Floats, variance: Floats) -> Floats:
    """Return std, posterior mean and posterior std of the restitution for a Gaussian likelihood, (3, n)."""
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


@dataclass(frozen=True, eq=False, repr=False)
class Profiled:
    """The best parameters at each of `PROFILED` shapes, and their squared residuals."""

    parameters: Floats  # (n, n_shapes, 4)
    cost: Floats  # (n, n_shapes)
    result: SearchResult
    scale: Floats  # (n,), factor from costs of the search to squared residuals
    binned: bool  # whether costs of the search are used, since bins contain as much information as samples

    def second(self, best: Optimum, variance: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return parameters (n, 4) of the second likely shape, and which rows have one."""
        # The minimum that the first search did not end in.
        away = np.abs(self.result.valleys[2] - best.parameters[:, 3])
        guess = np.where((away[1] < away[0])[:, None], self.result.start(), self.result.start(second=True))
        guess[:, 0] *= self.parameters[:, 0, 0] / self.result.peak[:, 0]
        likely = self.result.in_doubt(BIN * self.result.unit * variance / self.scale)
        if self.binned:
            return guess, likely
        far = np.where(np.abs(PROFILED - best.parameters[:, 3:4]) > _ANOTHER, self.cost, np.inf)
        rows, node = np.arange(len(far)), np.argmin(far, axis=1)
        lower = far[rows, node] < best.cost + np.where(likely, -1, 16) * variance
        return np.where(lower[:, None], self.parameters[rows, node], guess), likely | lower

    def moments(self, tops: list[Optimum], variance: Floats) -> tuple[Floats, Floats]:
        """Return covariances about the best parameters, and restitutions as `gaussian_restitution`."""
        # `tops` contains the best parameters and those of a second maximum, of infinite cost if there is none. A
        # maximum narrower than the grid counts by its own parabola, as three points of Gauss-Hermite quadrature.
        fine, spline = _interpolation()
        best, shapes = tops[0].parameters, [np.broadcast_to(fine, (len(variance), fine.size))]
        squares = [np.matmul((self.cost / variance[:, None])[:, None], spline.T)[:, 0]]
        away = [np.matmul(spline, _away(self.parameters, PROFILED, best))]
        covariances = [covariance_of(top.information, top.parameters, variance) for top in tops]
        for top, covariance in zip(tops, covariances, strict=True):
            shape = top.parameters[:, 3:4]
            deviation = np.sqrt(covariance[:, 3, 3:4])
            narrow = deviation < PARABOLIC
            squares[0] = np.where(narrow & (np.abs(fine - shape) < 3 * deviation), np.inf, squares[0])
            width = np.maximum(deviation, 1e-9) * np.sqrt(2 * np.pi) / (fine[1] - fine[0])
            squares.append(
                np.where(narrow, top.cost[:, None] / variance[:, None] - 2 * np.log(width * _HERMITE[1]), np.inf)
            )
            # Shapes without weight stay finite: an undetermined one would overflow as a restitution.
            steps = np.where(narrow, deviation, 0.0) * _HERMITE[0]
            shapes.append(shape + steps)
            slopes = covariance[:, None, :, 3] / covariance[:, None, 3:4, 3]
            away.append(_away(top.parameters[:, None], shape, best) + steps[:, :, None] * slopes)
        s, square, moved = (np.concatenate(parts, axis=1) for parts in (shapes, squares, away))
        weight = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)))
        weight /= weight.sum(axis=1, keepdims=True)
        spread = np.matmul(np.swapaxes(moved, 1, 2), weight[:, :, None] * moved)
        column = covariances[0][:, :, 3]
        given_shape = covariances[0] - column[:, :, None] * column[:, None] / column[:, 3][:, None, None]
        e, mean, wide = np.exp(s), *WIDE_RESTITUTION
        deviation = np.sqrt(np.sum(weight * (e - np.exp(best[:, 3:4])) ** 2, axis=1))
        # The prior is a density of e, the grid one of ln e. Logarithms, since far from the prior both may underflow.
        log_weight = s - 0.5 * (square + ((e - mean) / wide) ** 2)
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        expected = np.sum(weight * e, axis=1)
        std_expected = np.sqrt(np.sum(weight * (e - expected[:, None]) ** 2, axis=1))
        return given_shape + spread, np.stack([deviation, expected, std_expected])


def _away(parameters: Floats, shape: Floats, best: Floats) -> Floats:
    """Return differences of parameters (n, k, 4) at some shapes from the best (n, 4), in reported quantities."""
    away = _reported(parameters, shape) - _reported(best[:, None], best[:, 3:4])
    return np.where(np.isfinite(away), away, 0.0)


def _reported(parameters: Floats, shape: Floats) -> Floats:
    """Return (ln peak, ln duration, onset, shape) of parameters (n, k, 4) at shapes of (n, k) or (k,)."""
    duration, lead = (a.reshape(shape.shape) for a in relative_times(shape.ravel())[:2])
    shape = np.broadcast_to(shape, parameters.shape[:2])
    log_peak = np.log(np.maximum(parameters[:, :, 0], 1e-300))
    onset = parameters[:, :, 2] - lead * np.exp(parameters[:, :, 1])
    return np.stack([log_peak, parameters[:, :, 1] + np.log(duration), onset, shape], axis=2)


def binned(problems: Problems, result: SearchResult, unit: Floats, rows: NDArray[np.intp]) -> Profiled:
    """Return the best parameters at each shape from the search, whose bins average several samples."""
    scale = _scale(problems, result, unit, rows)
    return Profiled(_at_shapes(result, unit), result.cost[:, _EVERY] * scale[:, None], result, scale, True)


def _scale(problems: Problems, result: SearchResult, unit: Floats, rows: NDArray[np.intp]) -> Floats:
    """Return the factor from costs of the search to squared residuals of the windows of some rows, (n,)."""
    return np.asarray(result.unit * BIN / problems.averaged[rows] / unit**2)


def _at_shapes(result: SearchResult, unit: Floats) -> Floats:
    """Return the parameters of the search at each of `PROFILED`, (n, n_shapes, 4)."""
    peak, width, peak_time = (a[:, _EVERY] for a in (result.peak, result.width, result.peak_time))
    shape = np.broadcast_to(PROFILED, peak.shape)
    return np.stack([peak / unit[:, None], np.log(width), peak_time, shape], axis=2)


def exact(problems: Problems, result: SearchResult, unit: Floats, rows: NDArray[np.intp]) -> Profiled:
    """Return the best parameters at each shape, by one Gauss-Newton step from the results of the search."""
    n, n_shapes, scale = len(rows), PROFILED.size, _scale(problems, result, unit, rows)
    each = np.repeat(rows, n_shapes)
    flat = _at_shapes(result, unit).reshape(-1, 4)
    indices = [k for k, column in enumerate(problems.free) if column != 3]
    columns = [problems.free[k] for k in indices]
    products = problems.equations(flat, each)
    information, gradient, cost = products[:, indices][:, :, indices], products[:, indices, -1], products[:, -1, -1]
    step = solve_scaled(information, gradient, 1e-9)
    cost = cost - np.sum(step * gradient, axis=1)
    flat[:, columns] += bounded(step, columns, np.exp(flat[:, 1]))
    return Profiled(flat.reshape(n, n_shapes, 4), cost.reshape(n, n_shapes), result, scale, False)

"""Numba kernels of modes: the shapes of a panel at points, and what a structure does where it is hit.

Dimensionless as in `_contact`: `Q_r'' + 2 z w Q_r' + w^2 Q_r = f`, and the point of impact moves with the velocity
`v = sum of mu_r Q_r'`, mu = participation times mass. With a = Q' + (z w + i w_d) Q and lambda = i w_d - z w, a' =
lambda a + f. So v is the free motion and the answers to the impulses of the past, values on a grid of time with
polynomials between them: a step costs the same with any number of modes, which take up the impulses where the grid
ends.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import bare_jit, inner_jit, jit
from cgid.physics.contact._dop853 import END, LAST, STAGES, within

Array = NDArray[Any]

_POINTS = 32  # evaluated together


@jit
def sine_shapes(x: Array, y: Array, along: Array, across: Array, out: Array) -> None:
    """Fill out (points, modes) with `sin(i pi x) sin(j pi y)`, x and y within [0, 1], i = along, j = across."""
    sines_along, sines_across = np.zeros(along.max() + 1), np.zeros(across.max() + 1)
    for point in range(x.size):
        for i in range(sines_along.size):
            sines_along[i] = math.sin(math.pi * i * x[point])
        for j in range(sines_across.size):
            sines_across[j] = math.sin(math.pi * j * y[point])
        for mode in range(along.size):
            out[point, mode] = sines_along[along[mode]] * sines_across[across[mode]]


@jit
def _legendre(u: float, out: Array) -> None:
    """Fill out (degrees) with the Legendre polynomials at u, by Bonnet's recurrence."""
    before, value = 0.0, 1.0
    for degree in range(out.size):
        out[degree] = value
        before, value = value, ((2 * degree + 1) * u * value - degree * before) / (degree + 1)


@jit
def polynomial_shapes(x: Array, y: Array, along: Array, across: Array, coefficients: Array, out: Array) -> None:
    """Fill out (points, modes) with sums of `P_i(2x - 1) P_j(2y - 1)`, i = along, j = across (terms)."""
    # Points are taken in blocks: each row of coefficients is then fetched once for all of them.
    legendre_along, legendre_across = np.empty(along.max() + 1), np.empty(across.max() + 1)
    weights = np.empty((_POINTS, along.size))
    for start in range(0, x.size, _POINTS):
        block = out[start : start + _POINTS]
        block[:, :] = 0.0
        for point in range(len(block)):
            _legendre(2.0 * x[start + point] - 1.0, legendre_along)
            _legendre(2.0 * y[start + point] - 1.0, legendre_across)
            for term in range(along.size):
                weights[point, term] = legendre_along[along[term]] * legendre_across[across[term]]
        for term in range(0, along.size, 4):
            c0, c1 = coefficients[term], coefficients[term + 1]
            c2, c3 = coefficients[term + 2], coefficients[term + 3]
            for point in range(len(block)):
                w0, w1 = weights[point, term], weights[point, term + 1]
                w2, w3 = weights[point, term + 2], weights[point, term + 3]
                for mode in range(c0.size):
                    block[point, mode] += (w0 * c0[mode] + w1 * c1[mode]) + (w2 * c2[mode] + w3 * c3[mode])


#: Cells of time in which free motion is known, and those of the longest step.
CELLS, LONGEST = 66, 16
#: Values of the polynomial of a cell, of which these are before it.
_POINTS, _BEFORE = 10, 4
#: Times before the clock at which answers are known, all such times, and the Chebyshev times between.
_NEGATIVE = LONGEST + _BEFORE
_TIMES, _NODES = _NEGATIVE + CELLS + _POINTS, 52
#: Rows of `cells`: answers from LONGEST before an impulse to LONGEST after it, the next motion, the stages, and the
#: clock: its time, width of a cell, first of the next cells.
_NEAR, STAGE = 2 * LONGEST, 3 * LONGEST + 2
#: Columns of a stage.
TIME, IMPULSE, VELOCITY, RATE = 0, 1, 2, 3


def _cardinal(at: Array) -> Array:
    """Return the coefficients of the polynomials that are 1 at one of some times and 0 at the others, by column."""
    others = [np.delete(at, k) for k in range(at.size)]
    return np.array([np.poly(rest)[::-1] / np.prod(one - rest) for one, rest in zip(at, others, strict=True)]).T.copy()


_FIT = _cardinal(np.arange(_POINTS) - float(_BEFORE))
#: Where in a step its velocity is known after it, the ends included; weights of the stages in its stages and there.
WITHIN = np.array([0.0, 0.08, 0.25, 0.42, 0.58, 0.75, 0.92, 1.0])
_WEIGHTS = np.array([[weights.get(k, 0.0) for k in range(LAST)] for weights in (*STAGES, *map(within, WITHIN))])
_CLOCK = STAGE + len(_WEIGHTS)
#: From values within a step to the coefficients of their polynomial.
THROUGH = _cardinal(WITHIN)
#: Chebyshev times on [-1, 1], and from values there to those at all times of the grid.
NODES = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
_EXPAND = (
    np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, _TIMES), _NODES - 1)
    @ (np.polynomial.chebyshev.chebvander(NODES, _NODES - 1).T * np.append(0.5, np.ones(_NODES - 1))[:, None])
    * (2 / _NODES)
)
_COLLECT = _EXPAND.T.copy()


class Structure(NamedTuple):
    """The modes of a structure in units of L, T0 and v, and their motion."""

    share: Array  # (modes,) mu
    loss: Array  # (modes,) z / sqrt(1 - z^2)
    angular: Array  # (modes,) w_d
    turns: Array  # (2, nodes, modes) real and imaginary part of exp(lambda t) at the Chebyshev times
    amplitude: Array  # (2, modes) of a when the clock was set
    answer: Array  # (times,) velocity after a unit impulse
    free: Array  # (times,) velocity without any more force
    level: Array  # (CELLS, 10) displacement without any force
    impulses: Array  # (times,) of the force since the clock was set
    cells: Array  # (rows, 10) what the stages of a step take: one array, since every other costs a reference
    totals: Array  # impulse, its work on the structure and that of the approach


@inner_jit
def structure(n_modes: int) -> Structure:
    """Return a structure to be filled: share, loss, angular and turns, then by `settle`."""
    numbers, grids, level = np.zeros((3, n_modes)), np.zeros((3, _TIMES)), np.zeros((CELLS, _POINTS))
    turns, amplitude, cells = np.zeros((2, _NODES, n_modes)), np.zeros((2, n_modes)), np.zeros((_CLOCK + 1, _POINTS))
    return Structure(
        numbers[0], numbers[1], numbers[2], turns, amplitude, grids[0], grids[1], level, grids[2], cells, np.zeros(3)
    )


#: The type of a structure, for functions that are called by their address.
STRUCTURE = numba.typeof(structure.py_func(1))


@inner_jit
def tabulate(decay: Array, angular: Array, width: float, turns: Array) -> None:
    """Fill the turns of modes for cells of this width [s]."""
    for k in range(_NODES):
        t = width * (0.5 * (_TIMES - 1) * (NODES[k] + 1.0) - _NEGATIVE)
        for r in range(decay.size):
            size = math.exp(-decay[r] * t)
            turns[0, k, r], turns[1, k, r] = size * math.cos(angular[r] * t), size * math.sin(angular[r] * t)


@inner_jit
def settle(m: Structure, width: float) -> None:
    """Bring a structure to rest at time 0."""
    m.amplitude[:] = 0.0
    m.free[:] = 0.0
    m.impulses[:] = 0.0
    m.totals[:] = 0.0
    m.cells[:] = 0.0
    m.cells[_CLOCK, 1] = width
    _expand(m, m.share, m.share * m.loss, m.answer)
    _fit(m.answer, 0, m.cells[:_NEAR])


@bare_jit
def dot(a: Array, b: Array) -> float:
    """Return the scalar product in four sums, which are independent and so run side by side."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    n = a.size - a.size % 4
    for k in range(0, n, 4):
        s0 += a[k] * b[k]
        s1 += a[k + 1] * b[k + 1]
        s2 += a[k + 2] * b[k + 2]
        s3 += a[k + 3] * b[k + 3]
    for k in range(n, a.size):
        s0 += a[k] * b[k]
    return (s0 + s1) + (s2 + s3)


@inner_jit
def _expand(m: Structure, a: Array, b: Array, out: Array) -> None:
    """Fill out (times,) with the sum of the real part of (a + i b) exp(lambda t)."""
    at_nodes = np.empty(_NODES)
    for k in range(_NODES):
        at_nodes[k] = dot(m.turns[0, k], a) - dot(m.turns[1, k], b)
    for k in range(_TIMES):
        out[k] = dot(_EXPAND[k], at_nodes)


@bare_jit
def _fit(values: Array, first: int, cells: Array) -> None:
    """Fill cells (n, 10) with the polynomials through values from the first on."""
    for k in range(len(cells)):
        near = values[first + k : first + k + _POINTS]
        for degree in range(_POINTS):
            cells[k, degree] = dot(_FIT[degree], near)


@bare_jit
def _polynomial(c: Array, first: int, n: int, at: float) -> float:
    """Return the value of polynomials in n cells from the first on at a time in widths of a cell."""
    k = min(max(int(at), 0), n - 1)
    s = at - k
    k += first
    square = s * s
    low = (c[k, 0] + s * c[k, 1]) + square * (c[k, 2] + s * c[k, 3])
    high = (c[k, 4] + s * c[k, 5]) + square * (c[k, 6] + s * c[k, 7])
    fourth = square * square
    total: float = low + fourth * (high + fourth * (c[k, 8] + s * c[k, 9]))
    return total


@bare_jit
def _spread(at: float, weights: Array) -> int:
    """Fill the weights (10,) of the values that give that at a time; return the first of these values."""
    k = math.floor(at)
    s = at - k
    weights[:] = 0.0
    for degree in range(_POINTS - 1, -1, -1):
        for i in range(_POINTS):
            weights[i] = weights[i] * s + _FIT[degree, i]
    return int(k) + _NEGATIVE - _BEFORE


@bare_jit
def velocity(cells: Array, stage: int, time: float, h: float) -> float:
    """Return the velocity of the point of impact at a stage of a step."""
    per = 1.0 / cells[_CLOCK, 1]
    v = _polynomial(cells, _NEAR, LONGEST + 2, (time - cells[_CLOCK, 0]) * per - cells[_CLOCK, 2])
    for k in range(min(stage, LAST)):
        weight = _WEIGHTS[stage, k] * cells[STAGE + k, IMPULSE]
        if weight != 0.0:
            v += h * weight * _polynomial(cells, 0, _NEAR, (time - cells[STAGE + k, TIME]) * per + LONGEST)
    cells[STAGE + stage, TIME], cells[STAGE + stage, VELOCITY] = time, v
    return v


@inner_jit
def remember(m: Structure, h: float) -> None:
    """Take the impulses of a step into the motion after it."""
    cells, totals, weights, own = m.cells, m.totals, np.empty(_POINTS), np.zeros(_TIMES)
    per, first, last = 1.0 / cells[_CLOCK, 1], _TIMES, 0
    for k in range(END):
        impulse = h * _WEIGHTS[END, k] * cells[STAGE + k, IMPULSE]
        if impulse != 0.0:
            at = _spread((cells[STAGE + k, TIME] - cells[_CLOCK, 0]) * per, weights)
            first, last = min(first, at), max(last, at + _POINTS)
            for i in range(_POINTS):
                own[at + i] += impulse * weights[i]
            totals[0] += impulse
            totals[1] += impulse * cells[STAGE + k, VELOCITY]
            totals[2] += impulse * cells[STAGE + k, RATE]
    time = cells[STAGE + END, TIME]
    begin, free, answer, impulses = int((time - cells[_CLOCK, 0]) * per) + LONGEST, m.free, m.answer, m.impulses
    for j in range(first, last):
        impulses[j] += own[j]
        after, later = free[begin : _TIMES - _NEGATIVE + j], answer[begin - j + _NEGATIVE :]
        for k in range(len(after)):
            after[k] += own[j] * later[k]
    for i in range(_POINTS):
        cells[STAGE, i] = cells[STAGE + END, i]
    _look_ahead(m, time)


@inner_jit
def _look_ahead(m: Structure, time: float) -> None:
    """Fit the motion in the next cells."""
    cells = m.cells
    first = max(min(math.floor((time - cells[_CLOCK, 0]) / cells[_CLOCK, 1]), CELLS - LONGEST - 2.0), 0.0)
    cells[_CLOCK, 2] = first
    _fit(m.free, int(first) + LONGEST, cells[_NEAR:STAGE])


@bare_jit
def known(cells: Array, time: float) -> float:
    """Return for how long the motion is known."""
    left: float = cells[_CLOCK, 0] + CELLS * cells[_CLOCK, 1] - time
    return left


@bare_jit
def width_of(cells: Array) -> float:
    """Return the width of a cell."""
    width: float = cells[_CLOCK, 1]
    return width


@inner_jit
def advance(m: Structure, time: float) -> None:
    """Let the modes take up the impulses until a time, and tabulate their free motion from there."""
    at, past, weights, clock = np.zeros(_TIMES), np.zeros(_TIMES), np.empty(_POINTS), m.cells[_CLOCK]
    first = _spread((time - clock[0]) / clock[1], weights)
    for i in range(_POINTS):
        at[first + i] = weights[i]
    moved = np.zeros((4, m.share.size))
    cosine, sine, real, imaginary = moved[0], moved[1], moved[2], moved[3]
    for j in range(_TIMES):
        if m.impulses[j] != 0.0:
            begin = first - j + _NEGATIVE
            for i in range(_POINTS):
                past[begin + i] += m.impulses[j] * weights[i]
    for k in range(_NODES):
        turn, impulse, c, s = dot(_COLLECT[k], at), dot(_COLLECT[k], past), m.turns[0, k], m.turns[1, k]
        for r in range(c.size):
            cosine[r] += turn * c[r]
            sine[r] += turn * s[r]
            real[r] += impulse * c[r]
            imaginary[r] += impulse * s[r]
    a, b = m.amplitude[0], m.amplitude[1]
    for r in range(m.share.size):
        a[r], b[r] = cosine[r] * a[r] - sine[r] * b[r] + real[r], cosine[r] * b[r] + sine[r] * a[r] + imaginary[r]
        # Q' is the real part of (1 + i z / sqrt(1 - z^2)) a.
        real[r], imaginary[r] = m.share[r] * (a[r] - m.loss[r] * b[r]), m.share[r] * (b[r] + m.loss[r] * a[r])
    _expand(m, real, imaginary, m.free)
    clock[0] = time
    m.impulses[:] = 0.0
    _look_ahead(m, time)


@inner_jit
def rise(m: Structure) -> float:
    """Tabulate the displacement without a force, Q is Im(a) / w_d; return the largest one."""
    level, largest = np.empty(_TIMES), 0.0
    real, imaginary = np.empty(m.share.size), np.empty(m.share.size)
    for r in range(m.share.size):
        per = m.share[r] / m.angular[r]
        real[r], imaginary[r] = per * m.amplitude[1, r], -per * m.amplitude[0, r]
        largest += math.sqrt(real[r] * real[r] + imaginary[r] * imaginary[r])
    _expand(m, real, imaginary, level)
    _fit(level, LONGEST, m.level)
    return largest


@inner_jit
def aloft(m: Structure, sphere: float, y: float, weight: float, t: float) -> tuple[float, float]:
    """Return the approach and its rate at a time in flight, of a sphere that began at `sphere` with the velocity y."""
    at = t / width_of(m.cells)
    k = min(int(at), CELLS - 1)
    cell = np.empty((1, _POINTS))
    _fit(m.free, k + LONGEST, cell)
    x = sphere + t * (y + 0.5 * weight * t) - _polynomial(m.level, 0, CELLS, at)
    return x, y + weight * t - _polynomial(cell, 0, 1, at - k)


@inner_jit
def energy(m: Structure) -> float:
    """Return the energy of the modes: mu (Q'^2 + w^2 Q^2) / 2."""
    total = 0.0
    for r in range(m.share.size):
        a, b, loss = m.amplitude[0, r], m.amplitude[1, r], m.loss[r]
        rate = a - loss * b
        total += 0.5 * m.share[r] * (rate * rate + b * b * (1.0 + loss * loss))
    return total


@inner_jit
def sway(m: Structure, weight: float) -> float:
    """Return the largest acceleration of the point of impact about where a weight holds it."""
    total = 0.0
    for r in range(m.share.size):
        loss, omega = m.loss[r], m.angular[r]
        still = weight / (omega * (1.0 + loss * loss))
        a, b = m.amplitude[0, r] - still * loss, m.amplitude[1, r] - still
        total += m.share[r] * omega * (1.0 + loss) * math.sqrt(a * a + b * b)
    return total

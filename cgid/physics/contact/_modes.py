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

from cgid._lib.compiled import bare_jit, constants, inner_jit, jit
from cgid.physics.contact._dop853 import END, LAST, STAGES, within

Array = NDArray[Any]

_POINTS = 32  # evaluated together


@bare_jit
def _count(degrees: Array) -> int:
    """Return the largest degree plus one; `max` of an array compiles three functions."""
    count: int = 0
    for k in range(degrees.size):
        count = max(count, degrees[k] + 1)
    return count


@jit
def sine_shapes(x: Array, y: Array, along: Array, across: Array, out: Array) -> None:
    """Fill out (points, modes) with `sin(i pi x) sin(j pi y)`, x and y within [0, 1], i = along, j = across."""
    sines_along, sines_across = np.zeros(_count(along)), np.zeros(_count(across))
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
    legendre_along, legendre_across = np.empty(_count(along)), np.empty(_count(across))
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
#: Rows of `cells`: answers from LONGEST before an impulse to LONGEST after it, the next motion, and the stages.
_NEAR, STAGE = 2 * LONGEST, 3 * LONGEST + 2
#: Columns of a stage; the last three are those of `_step`.
TIME, IMPULSE, VELOCITY, RATE, PLACE, TURN_W, TURN_Y = range(7)


def _cardinal(at: Array) -> Array:
    """Return the coefficients of the polynomials that are 1 at one of some times and 0 at the others, by column."""
    others = [np.delete(at, k) for k in range(at.size)]
    return np.array([np.poly(rest)[::-1] / np.prod(one - rest) for one, rest in zip(at, others, strict=True)]).T.copy()


_FIT = _cardinal(np.arange(_POINTS) - float(_BEFORE))
#: Where in a step its velocity is known after it, the ends included; weights of the stages in its stages and there.
WITHIN = np.array([0.0, 0.08, 0.25, 0.42, 0.58, 0.75, 0.92, 1.0])
_WEIGHTS = np.array([[weights.get(k, 0.0) for k in range(LAST)] for weights in (*STAGES, *map(within, WITHIN))])
#: Further rows: the clock (its time, width of a cell, first of the next cells); impulse, its work on the structure and
#: that of the approach; numbers in between; the displacement without any force.
_CLOCK = STAGE + len(_WEIGHTS)
TOTALS, SPARE, LEVEL = constants(_CLOCK + 1, _CLOCK + 2, _CLOCK + 3)
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
#: Rows of `modes`: mu, z / sqrt(1 - z^2), w_d, the real and imaginary part of a when the clock was set, numbers in
#: between, and the real and imaginary part of exp(lambda t) at the Chebyshev times.
SHARE, LOSS, ANGULAR, REAL, IMAGINARY, _A, _B, _C, _D, TURNS = range(10)
_SINES = TURNS + _NODES
#: Rows of `grids`: velocity after a unit impulse, without any more force, the impulses of the force since the clock was
#: set, and numbers in between.
_ANSWER, _FREE, _IMPULSES, _OWN, _AT, _PAST = constants(*range(6))
#: Rows and numbers of cells.
_BEGIN, _ONE, _NEXT, _NEXT_CELLS, _ALL_CELLS = constants(0, 1, _NEAR, LONGEST + 2, CELLS)


class Structure(NamedTuple):
    """The modes of a structure in units of L, T0 and v, and their motion: few arrays, each costs a reference."""

    modes: Array  # (rows, modes)
    grids: Array  # (rows, times)
    cells: Array  # (rows, 10) polynomials, and what the stages of a step take


@inner_jit
def structure(n_modes: int) -> Structure:
    """Return a structure to be filled: share, loss, angular and turns, then by `settle`."""
    return Structure(
        np.zeros((_SINES + _NODES, n_modes)), np.zeros((_PAST + 1, _TIMES)), np.zeros((LEVEL + CELLS, _POINTS))
    )


#: The type of a structure, for functions that are called by their address.
STRUCTURE = numba.typeof(Structure(*3 * [np.empty((1, 1))]))


@bare_jit
def tabulate(decay: Array, angular: Array, width: float, modes: Array) -> None:
    """Fill the turns of modes for cells of this width [s]."""
    for k in range(_NODES):
        t = width * (0.5 * (_TIMES - 1) * (NODES[k] + 1.0) - _NEGATIVE)
        for r in range(decay.size):
            size = math.exp(-decay[r] * t)
            modes[TURNS + k, r], modes[_SINES + k, r] = size * math.cos(angular[r] * t), size * math.sin(angular[r] * t)


@bare_jit
def settle(m: Structure, width: float) -> None:
    """Bring a structure to rest at time 0."""
    modes, grids, cells = m.modes, m.grids, m.cells
    for r in range(modes.shape[1]):
        modes[REAL, r], modes[IMAGINARY, r] = 0.0, 0.0
        modes[_A, r], modes[_B, r] = modes[SHARE, r], modes[SHARE, r] * modes[LOSS, r]
    _clear(grids, _FREE)
    _clear(grids, _IMPULSES)
    for row in range(SPARE):
        _clear(cells, row)
    cells[_CLOCK, 1] = width
    _expand(m, _ANSWER)
    _fit(grids, _ANSWER, _BEGIN, cells, _BEGIN, _NEXT)


@bare_jit
def _clear(rows: Array, row: int) -> None:
    for k in range(rows.shape[1]):
        rows[row, k] = 0.0


@bare_jit
def dot(a: Array, b: Array) -> float:
    """Return the scalar product with the first of b in four sums, which are independent and so run side by side."""
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


@bare_jit
def _expand(m: Structure, line: int) -> None:
    """Fill a row of the grids with the sum of the real part of (a + i b) exp(lambda t), a and b as left in `modes`."""
    modes, nodes, out = m.modes, m.grids[_AT], m.grids[line]
    for k in range(_NODES):
        nodes[k] = dot(modes[TURNS + k], modes[_A]) - dot(modes[_SINES + k], modes[_B])
    for k in range(_TIMES):
        out[k] = dot(_EXPAND[k], nodes)


@bare_jit
def _fit(grids: Array, line: int, first: int, cells: Array, begin: int, n: int) -> None:
    """Fill n cells with the polynomials through the values of a grid from the first on."""
    for k in range(n):
        near = grids[line, first + k : first + k + _POINTS]
        for degree in range(_POINTS):
            cells[begin + k, degree] = dot(_FIT[degree], near)


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
def _spread(at: float, cells: Array) -> int:
    """Put the weights of the values that give that at a time into the spare cell; return the first of these values."""
    k = math.floor(at)
    s = at - k
    _clear(cells, SPARE)
    for degree in range(_POINTS - 1, -1, -1):
        for i in range(_POINTS):
            cells[SPARE, i] = cells[SPARE, i] * s + _FIT[degree, i]
    return int(k) + _NEGATIVE - _BEFORE


@bare_jit
def velocity(cells: Array, stage: int, time: float, h: float) -> float:
    """Return the velocity of the point of impact at a stage of a step."""
    per = 1.0 / cells[_CLOCK, 1]
    v = _polynomial(cells, _NEXT, _NEXT_CELLS, (time - cells[_CLOCK, 0]) * per - cells[_CLOCK, 2])
    for k in range(min(stage, LAST)):
        weight = _WEIGHTS[stage, k] * cells[STAGE + k, IMPULSE]
        if weight != 0.0:
            v += h * weight * _polynomial(cells, _BEGIN, _NEXT, (time - cells[STAGE + k, TIME]) * per + LONGEST)
    cells[STAGE + stage, TIME], cells[STAGE + stage, VELOCITY] = time, v
    return v


@bare_jit
def remember(m: Structure, h: float) -> None:
    """Take the impulses of a step into the motion after it."""
    cells, grids = m.cells, m.grids
    _clear(grids, _OWN)
    per, first, last = 1.0 / cells[_CLOCK, 1], _TIMES, 0
    for k in range(END):
        impulse = h * _WEIGHTS[END, k] * cells[STAGE + k, IMPULSE]
        if impulse != 0.0:
            at = _spread((cells[STAGE + k, TIME] - cells[_CLOCK, 0]) * per, cells)
            first, last = min(first, at), max(last, at + _POINTS)
            for i in range(_POINTS):
                grids[_OWN, at + i] += impulse * cells[SPARE, i]
            cells[TOTALS, 0] += impulse
            cells[TOTALS, 1] += impulse * cells[STAGE + k, VELOCITY]
            cells[TOTALS, 2] += impulse * cells[STAGE + k, RATE]
    time = cells[STAGE + END, TIME]
    begin = int((time - cells[_CLOCK, 0]) * per) + LONGEST
    own, free, answer, impulses = grids[_OWN], grids[_FREE], grids[_ANSWER], grids[_IMPULSES]
    for j in range(first, last):
        impulses[j] += own[j]
        after, later = free[begin : _TIMES - _NEGATIVE + j], answer[begin - j + _NEGATIVE :]
        for k in range(len(after)):
            after[k] += own[j] * later[k]
    for i in range(_POINTS):
        cells[STAGE, i] = cells[STAGE + END, i]
    _look_ahead(m, time)


@bare_jit
def _look_ahead(m: Structure, time: float) -> None:
    """Fit the motion in the next cells."""
    cells = m.cells
    first = max(min(math.floor((time - cells[_CLOCK, 0]) / cells[_CLOCK, 1]), CELLS - LONGEST - 2.0), 0.0)
    cells[_CLOCK, 2] = first
    _fit(m.grids, _FREE, int(first) + LONGEST, cells, _NEXT, _NEXT_CELLS)


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


@bare_jit
def advance(m: Structure, time: float) -> None:
    """Let the modes take up the impulses until a time, and tabulate their free motion from there."""
    modes, grids, cells = m.modes, m.grids, m.cells
    first = _spread((time - cells[_CLOCK, 0]) / cells[_CLOCK, 1], cells)
    _clear(grids, _OWN)
    _clear(grids, _PAST)
    for i in range(_POINTS):
        grids[_OWN, first + i] = cells[SPARE, i]
    for j in range(_TIMES):
        if grids[_IMPULSES, j] != 0.0:
            begin = first - j + _NEGATIVE
            for i in range(_POINTS):
                grids[_PAST, begin + i] += grids[_IMPULSES, j] * cells[SPARE, i]
    for row in range(_A, _D + 1):
        _clear(modes, row)
    cosine, sine, real, imaginary, at, past = modes[_A], modes[_B], modes[_C], modes[_D], grids[_OWN], grids[_PAST]
    for k in range(_NODES):
        turn, impulse, c, s = dot(_COLLECT[k], at), dot(_COLLECT[k], past), modes[TURNS + k], modes[_SINES + k]
        for r in range(c.size):
            cosine[r] += turn * c[r]
            sine[r] += turn * s[r]
            real[r] += impulse * c[r]
            imaginary[r] += impulse * s[r]
    for r in range(modes.shape[1]):
        a, b, share, loss = modes[REAL, r], modes[IMAGINARY, r], modes[SHARE, r], modes[LOSS, r]
        a, b = cosine[r] * a - sine[r] * b + real[r], cosine[r] * b + sine[r] * a + imaginary[r]
        modes[REAL, r], modes[IMAGINARY, r] = a, b
        # Q' is the real part of (1 + i z / sqrt(1 - z^2)) a.
        cosine[r], sine[r] = share * (a - loss * b), share * (b + loss * a)
    _expand(m, _FREE)
    cells[_CLOCK, 0] = time
    _clear(grids, _IMPULSES)
    _look_ahead(m, time)


@bare_jit
def rise(m: Structure) -> float:
    """Tabulate the displacement without a force, Q is Im(a) / w_d; return the largest one."""
    modes, largest = m.modes, 0.0
    for r in range(modes.shape[1]):
        per = modes[SHARE, r] / modes[ANGULAR, r]
        real, imaginary = per * modes[IMAGINARY, r], -per * modes[REAL, r]
        modes[_A, r], modes[_B, r] = real, imaginary
        largest += math.sqrt(real * real + imaginary * imaginary)
    _expand(m, _PAST)
    _fit(m.grids, _PAST, _BEGIN + LONGEST, m.cells, LEVEL, _ALL_CELLS)
    return largest


@bare_jit
def aloft(m: Structure, sphere: float, y: float, weight: float, t: float) -> tuple[float, float]:
    """Return the approach and its rate at a time in flight, of a sphere that began at `sphere` with the velocity y."""
    cells = m.cells
    at = t / width_of(cells)
    k = min(int(at), CELLS - 1)
    _fit(m.grids, _FREE, k + LONGEST, cells, SPARE, _ONE)
    x = sphere + t * (y + 0.5 * weight * t) - _polynomial(cells, LEVEL, _ALL_CELLS, at)
    return x, y + weight * t - _polynomial(cells, SPARE, _ONE, at - k)


@bare_jit
def energy(modes: Array) -> float:
    """Return the energy of the modes: mu (Q'^2 + w^2 Q^2) / 2."""
    total = 0.0
    for r in range(modes.shape[1]):
        a, b, loss = modes[REAL, r], modes[IMAGINARY, r], modes[LOSS, r]
        rate = a - loss * b
        total += 0.5 * modes[SHARE, r] * (rate * rate + b * b * (1.0 + loss * loss))
    return total


@bare_jit
def sway(modes: Array, weight: float) -> float:
    """Return the largest acceleration of the point of impact about where a weight holds it."""
    total = 0.0
    for r in range(modes.shape[1]):
        loss, omega = modes[LOSS, r], modes[ANGULAR, r]
        still = weight / (omega * (1.0 + loss * loss))
        a, b = modes[REAL, r] - still * loss, modes[IMAGINARY, r] - still
        total += modes[SHARE, r] * omega * (1.0 + loss) * math.sqrt(a * a + b * b)
    return total

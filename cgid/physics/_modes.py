"""Numba kernels of the modes of a panel: a symmetric eigenproblem, and mode shapes at points.

The eigenproblem is `M v = mu K v` with a diagonal M, for its largest eigenvalues. LAPACK's results depend on the
kernels that its BLAS picks for a processor. These loops do the same sums in the same order everywhere, each along
rows, so that the compiler still vectorises over columns. The method is the classic one: Cholesky's factor turns the
problem into a standard one, Householder's reflections make it tridiagonal (Golub & Van Loan 2013, Matrix Computations,
section 8.3), bisection with Sturm's counts finds the eigenvalues, and inverse iteration their vectors, each made
orthogonal to those of near eigenvalues.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._elementary import sincos
from cgid.compiled import jit

Array = NDArray[Any]

#: Eigenvalues nearer than this, over the largest, have vectors that rounding may mix; bisections of one; iterations.
_NEAR, _HALVINGS, _ITERATIONS = 1e-3, 60, 4


@jit
def factorise(matrix: Array) -> bool:
    """Put Cholesky's factor U, `U' U = matrix` (n, n), into the upper half in place; return False if there is none."""
    n = matrix.shape[0]
    for j in range(n):
        if not matrix[j, j] > 0.0:
            return False
        inverse = 1.0 / math.sqrt(matrix[j, j])
        row = matrix[j, j:]
        for k in range(row.size):
            row[k] *= inverse
        for i in range(j + 1, n):
            factor, left, done = matrix[j, i], matrix[i, i:], matrix[j, i:]
            for k in range(left.size):
                left[k] -= factor * done[k]
    return True


@jit
def standard_form(factor: Array, mass: Array, out: Array) -> None:
    """Fill out (n, n) with `U'^-1 M U^-1`, whose eigenvalues are those of the problem; mass (n,) is M."""
    n = mass.size
    column = np.empty(n)
    out[:, :] = 0.0
    for k in range(n):
        # Column k of U'^-1 times the root of the mass, from its entry k on.
        column[k:] = 0.0
        column[k] = math.sqrt(mass[k])
        for j in range(k, n):
            column[j] /= factor[j, j]
            value, left, row = column[j], column[j + 1 :], factor[j, j + 1 :]
            for i in range(left.size):
                left[i] -= value * row[i]
        for i in range(k, n):
            value, row, other = column[i], out[i, k:], column[k:]
            for j in range(row.size):
                row[j] += value * other[j]


@jit
def tridiagonalise(matrix: Array, diagonal: Array, off_diagonal: Array, factors: Array) -> None:
    """Reduce a symmetric matrix (n, n) to a tridiagonal one: diagonal (n,) and off-diagonal (n - 1,).

    Row k of the matrix then holds the vector v of reflection k from entry k + 1 on, `I - factor v v'`, factors (n,).
    """
    n = diagonal.size
    product = np.empty(n)
    factors[:] = 0.0
    for k in range(n - 1):
        diagonal[k] = matrix[k, k]
        v = matrix[k, k + 1 :]
        square = 0.0
        for i in range(1, v.size):
            square += v[i] * v[i]
        if square == 0.0:
            off_diagonal[k] = v[0]
            continue
        length = math.sqrt(v[0] * v[0] + square)
        off_diagonal[k] = -length if v[0] > 0.0 else length
        v[0] -= off_diagonal[k]
        factor = 2.0 / (v[0] * v[0] + square)
        factors[k] = factor
        p = product[: v.size]
        p[:] = 0.0
        for i in range(v.size):
            value, row = v[i], matrix[k + 1 + i, k + 1 :]
            for j in range(p.size):
                p[j] += value * row[j]
        along = 0.0
        for i in range(v.size):
            along += v[i] * p[i]
        along *= 0.5 * factor * factor
        for i in range(v.size):
            p[i] = factor * p[i] - along * v[i]
        for i in range(v.size):
            of_p, of_v, row = v[i], p[i], matrix[k + 1 + i, k + 1 :]
            for j in range(p.size):
                row[j] -= of_p * p[j] + of_v * v[j]
    diagonal[n - 1] = matrix[n - 1, n - 1]


@jit
def _count_above(diagonal: Array, squares: Array, value: float, least: float) -> int:
    """Return how many eigenvalues lie above a value, by the signs of a Sturm sequence."""
    count = 0
    q = 1.0
    for k in range(diagonal.size):
        q = diagonal[k] - value - (squares[k - 1] / q if k > 0 else 0.0)
        if abs(q) < least:
            q = -least
        if q > 0.0:
            count += 1
    return count


@jit
def largest(diagonal: Array, off_diagonal: Array, lowest: float, out: Array) -> int:
    """Fill out (n,) with the eigenvalues above the lowest, falling; return how many there are."""
    squares = off_diagonal * off_diagonal
    high, low = diagonal[0], diagonal[0]
    for k in range(diagonal.size):  # Gershgorin's circles
        reach = abs(off_diagonal[k - 1]) if k > 0 else 0.0
        reach += abs(off_diagonal[k]) if k < off_diagonal.size else 0.0
        high, low = max(high, diagonal[k] + reach), min(low, diagonal[k] - reach)
    lowest = max(lowest, low - 1e-12 * (abs(high) + abs(low)) - 1e-290)
    high += 1e-12 * (abs(high) + abs(low)) + 1e-290
    least = 1e-300 + 1e-32 * max(abs(high), abs(low))
    wanted = _count_above(diagonal, squares, lowest, least)
    for number in range(wanted):
        below, above = lowest, high if number == 0 else out[number - 1]
        for _ in range(_HALVINGS):
            middle = 0.5 * (below + above)
            if _count_above(diagonal, squares, middle, least) > number:
                below = middle
            else:
                above = middle
        out[number] = 0.5 * (below + above)
    return wanted


@jit
def _solve_shifted(
    diagonal: Array, off_diagonal: Array, shift: float, least: float, workspace: Array, x: Array
) -> None:
    """Solve (T - shift I) x = x in place by elimination with row exchanges; workspace is (3, n)."""
    n = diagonal.size
    pivot, next_to, behind = workspace[0], workspace[1], workspace[2]
    pivot[0], next_to[0], behind[:] = diagonal[0] - shift, off_diagonal[0] if n > 1 else 0.0, 0.0
    for k in range(n - 1):
        below, own = off_diagonal[k], diagonal[k + 1] - shift
        after = off_diagonal[k + 1] if k + 1 < n - 1 else 0.0
        if abs(pivot[k]) >= abs(below):
            if abs(pivot[k]) < least:
                pivot[k] = least
            factor = below / pivot[k]
            pivot[k + 1], next_to[k + 1] = own - factor * next_to[k], after
            x[k + 1] -= factor * x[k]
        else:
            factor = pivot[k] / below
            pivot[k], upper = below, next_to[k]
            next_to[k], behind[k] = own, after
            pivot[k + 1], next_to[k + 1] = upper - factor * own, -factor * after
            x[k], x[k + 1] = x[k + 1], x[k] - factor * x[k + 1]
    if abs(pivot[n - 1]) < least:
        pivot[n - 1] = least
    for k in range(n - 1, -1, -1):
        value = x[k]
        if k + 1 < n:
            value -= next_to[k] * x[k + 1]
        if k + 2 < n:
            value -= behind[k] * x[k + 2]
        x[k] = value / pivot[k]


@jit
def vectors(diagonal: Array, off_diagonal: Array, values: Array, out: Array) -> None:
    """Fill out (n_values, n) with the unit vectors of the tridiagonal matrix that belong to falling eigenvalues."""
    n = diagonal.size
    workspace = np.empty((3, n))
    scale = max(abs(values[0]), abs(values[-1])) if values.size else 0.0
    least = 1e-300 + 1e-16 * scale
    first, shift = 0, 0.0
    for number in range(values.size):
        # Equal eigenvalues start from different vectors and shifts.
        shift = values[number] if number == 0 else min(values[number], shift - 10.0 * least)
        while values[first] - values[number] > _NEAR * scale:
            first += 1
        x = out[number]
        for i in range(n):
            x[i] = 0.5 + ((i * 40503 + number * 30011) % 65536) / 65536.0
        for _ in range(_ITERATIONS):
            _solve_shifted(diagonal, off_diagonal, shift, least, workspace, x)
            size = 0.0
            for i in range(n):
                size = max(size, abs(x[i]))
            for i in range(n):
                x[i] /= size
            # Twice: the first pass leaves a rest by cancellation.
            for _ in range(2):
                for other in range(first, number):
                    along, y = 0.0, out[other]
                    for i in range(n):
                        along += x[i] * y[i]
                    for i in range(n):
                        x[i] -= along * y[i]
            square = 0.0
            for i in range(n):
                square += x[i] * x[i]
            inverse = 1.0 / math.sqrt(square)
            for i in range(n):
                x[i] *= inverse


@jit
def turned_back(reflections: Array, factors: Array, columns: Array) -> None:
    """Turn vectors of the tridiagonal matrix, columns (n, n_values), into those of the symmetric one in place."""
    n = factors.size
    along = np.empty(columns.shape[1])
    for k in range(n - 2, -1, -1):
        if factors[k] == 0.0:
            continue
        v = reflections[k, k + 1 :]
        along[:] = 0.0
        for i in range(v.size):
            value, row = v[i], columns[k + 1 + i]
            for m in range(along.size):
                along[m] += value * row[m]
        for i in range(v.size):
            value, row = factors[k] * v[i], columns[k + 1 + i]
            for m in range(along.size):
                row[m] -= value * along[m]


@jit
def unfactorised(factor: Array, columns: Array) -> None:
    """Turn vectors of the standard form, columns (n, n_values), into those of the problem in place: `U^-1 y`."""
    n = columns.shape[0]
    for i in range(n - 1, -1, -1):
        row = columns[i]
        for j in range(i + 1, n):
            value, done = factor[i, j], columns[j]
            for m in range(row.size):
                row[m] -= value * done[m]
        for m in range(row.size):
            row[m] /= factor[i, i]


_POINTS = 32  # evaluated together


@jit
def sine_shapes(x: Array, y: Array, along: Array, across: Array, out: Array) -> None:
    """Fill out (points, modes) with `sin(i pi x) sin(j pi y)`, x and y within [0, 1], i = along, j = across."""
    sines_along, sines_across = np.zeros(along.max() + 1), np.zeros(across.max() + 1)
    for point in range(x.size):
        for i in range(sines_along.size):
            sines_along[i] = sincos(math.pi * i * x[point])[0]
        for j in range(sines_across.size):
            sines_across[j] = sincos(math.pi * j * y[point])[0]
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
    """Fill out (points, modes) with sums of `P_i(2x - 1) P_j(2y - 1)`, i = along, j = across (terms).

    Points are taken in blocks: each row of coefficients is then fetched once for all of them.

    Parameters
    ----------
    coefficients : ndarray, (terms, modes)
        Their number of modes is best a multiple of 16, so that the compiler vectorises over them. The number of terms
        must be a multiple of 4.
    """
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

"""Numba kernels of the mode shapes of a panel at points."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.compiled import jit

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

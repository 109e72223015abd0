"""The formulas of `cgid.elementary`, compiled: scalar functions for other kernels, and loops over arrays.

The scalar functions are plain Python functions that numba compiles into its callers; interpreted kernels call them
directly.
"""

from __future__ import annotations

import math
from typing import Any

from numba.extending import register_jitable
from numpy.typing import NDArray

from cgid import elementary
from cgid.compiled import jit

Array = NDArray[Any]

for _formula in elementary.FORMULAS:
    register_jitable(error_model="numpy")(_formula)

#: e^x.
exp = elementary.exp_of
#: Sine and cosine of an angle up to `elementary.LARGEST_ANGLE`, together.
sincos = elementary.sine_and_cosine


@register_jitable(error_model="numpy")
def log(x: float) -> float:
    """Return the natural logarithm: -inf at 0, nan below it."""
    if 0.0 < x < math.inf:
        return float(elementary.log_of(x))
    if x == 0.0:
        return -math.inf
    return x if x > 0.0 else math.nan


@register_jitable(error_model="numpy")
def power(x: float, y: float) -> float:
    """Return x^y for a finite x of 0 or more and a y that is not 0, nan for any other x."""
    if 0.0 < x < math.inf:
        return float(elementary.power_of(x, y))
    if x == 0.0:
        return 0.0 if y > 0.0 else math.inf
    return math.nan


@jit
def exp_loop(x: Array, out: Array) -> None:
    """Fill out (n,) with the exponentials of x (n,)."""
    for k in range(x.size):
        out[k] = exp(x[k])


@jit
def expm1_loop(x: Array, out: Array) -> None:
    """Fill out (n,) with the exponentials of x (n,) less 1."""
    for k in range(x.size):
        out[k] = elementary.expm1_of(x[k])


@jit
def log_loop(x: Array, out: Array) -> None:
    """Fill out (n,) with the logarithms of x (n,), above 0 and finite."""
    for k in range(x.size):
        out[k] = elementary.log_of(x[k])


@jit
def log1p_loop(x: Array, out: Array) -> None:
    """Fill out (n,) with the logarithms of 1 + x (n,), above 0 and finite."""
    for k in range(x.size):
        out[k] = elementary.log1p_of(x[k])


@jit
def power_loop(x: Array, y: Array, out: Array) -> None:
    """Fill out (n,) with the powers y (n,) of x (n,), above 0 and finite."""
    for k in range(x.size):
        out[k] = elementary.power_of(x[k], y[k])


@jit
def sincos_loop(x: Array, sine: Array, cosine: Array) -> None:
    """Fill sine and cosine (n,) of the angles x (n,)."""
    for k in range(x.size):
        sine[k], cosine[k] = sincos(x[k])


@jit
def normal_quantile_loop(p: Array, out: Array) -> None:
    """Fill out (n,) with the values below which the shares p (n,) of a standard normal distribution lie."""
    for k in range(p.size):
        q = p[k] - 0.5
        if abs(q) <= 0.425:
            out[k] = q * elementary.normal_ratio(0, 0.180625 - q * q)
            continue
        r = math.sqrt(-log(p[k] if q < 0.0 else 1.0 - p[k]))
        if r < math.inf:
            r = elementary.normal_ratio(2, r - 5.0) if r > 5.0 else elementary.normal_ratio(1, r - 1.6)
        out[k] = -r if q < 0.0 else r

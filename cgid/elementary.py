"""Elementary functions that give the same bits on every processor.

numpy uses another exponential where the processor has AVX-512, the C library another one where it fuses multiplication
and addition, and both change with their versions. The functions here use only sums, products, quotients, roots and
integers, which IEEE 754 rounds in one way. Everything that ends in a stored file goes through them.

Each function is one formula, written once for scalars and arrays: numpy evaluates it on arrays, and `cgid._elementary`
compiles it. The compiled loops run if numba has been loaded, numpy's evaluation if not; both give the same bits. Errors
are below 1 unit in the last place (`tests/test_elementary.py`, against mpmath).

Method: arguments are reduced by a multiple of ln 2 or pi/2 held in two or three parts (Cody & Waite 1980, Software
Manual for the Elementary Functions), the remainder goes into a series, and where one double is not enough a sum of two
is carried (Dekker 1971, Numer. Math. 18, 224).
"""

from __future__ import annotations

import math
import sys
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Adding it to a number below 2^51 rounds that number to an integer, held in the last bits of the sum.
_ROUNDER = 1.5 * 2.0**52
_ROUNDER_BITS = 0x4338000000000000
_BIAS, _FRACTION_BITS = 1023, 52
_SQRT_HALF_BITS = 0x3FE6A09E667F3BCD
_SMALLEST_NORMAL, _RAISE = 2.0**-1022, 2.0**54
#: Halves of a double: a product of two such halves is exact.
_SPLITTER = 2.0**27 + 1
#: ln 2 with 42 bits, which times any exponent is exact, and the remainder.
_LN2_HIGH, _LN2_LOW = float.fromhex("0x1.62E42FEFA38p-1"), float.fromhex("0x1.EF35793C7673p-45")
_INVERSE_LN2 = float.fromhex("0x1.71547652B82FEp0")
#: Outside the exponential is 0 or infinite.
_LOWEST_POWER, _HIGHEST_POWER, _MOST_EXPONENT = -760.0, 720.0, 1e200
#: 2/3 in two parts, and 2/5, 2/7, ...: ln((1 + s)/(1 - s)) = 2 s + 2/3 s^3 + ...
_TWO_THIRDS, _TWO_THIRDS_LOW = 2 / 3, float.fromhex("0x1.5555555555555p-55")
_LOGARITHM = tuple(2 / k for k in range(23, 3, -2))
_EXPONENTIAL = tuple(1 / math.factorial(k) for k in range(14, 1, -1))
#: pi/2 in three parts.
_QUARTER, _QUARTER_2, _QUARTER_3 = (
    float.fromhex("0x1.921FB54442D18p0"),
    float.fromhex("0x1.1A62633145C07p-54"),
    float.fromhex("-0x1.F1976B7ED8FBCp-110"),
)
_INVERSE_QUARTER = float.fromhex("0x1.45F306DC9C883p-1")
_SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(8, 0, -1))
_COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(9, 1, -1))
#: Rational functions of the normal quantile in its middle, its tails, and far out, highest power first (AS 241).
_NORMAL = (
    (
        (2509.0809287301227, 33430.57558358813, 67265.7709270087, 45921.95393154987,
         13731.69376550946, 1971.5909503065513, 133.14166789178438, 3.3871328727963665),
        (5226.495278852854, 28729.085735721943, 39307.89580009271, 21213.794301586597,
         5394.196021424751, 687.1870074920579, 42.31333070160091, 1.0),
    ),
    (
        (0.0007745450142783414, 0.022723844989269184, 0.2417807251774506, 1.2704582524523684,
         3.6478483247632045, 5.769497221460691, 4.630337846156546, 1.4234371107496835),
        (1.0507500716444169e-09, 0.0005475938084995345, 0.015198666563616457, 0.14810397642748008,
         0.6897673349851, 1.6763848301838038, 2.053191626637759, 1.0),
    ),
    (
        (2.0103343992922881e-07, 2.7115555687434876e-05, 0.0012426609473880784, 0.026532189526576124,
         0.29656057182850487, 1.7848265399172913, 5.463784911164114, 6.657904643501103),
        (2.0442631033899397e-15, 1.421511758316446e-07, 1.8463183175100548e-05, 0.0007868691311456133,
         0.014875361290850615, 0.1369298809227358, 0.599832206555888, 1.0),
    ),
)  # fmt: skip
#: Up to here sine and cosine keep all their digits.
LARGEST_ANGLE = 2.0**40


def product_parts(a: Any, b: Any) -> Any:
    """Return a product and its rounding error, whose sum is exact."""
    a_high = _SPLITTER * a - (_SPLITTER * a - a)
    b_high = _SPLITTER * b - (_SPLITTER * b - b)
    a_low, b_low = a - a_high, b - b_high
    value = a * b
    return value, ((a_high * b_high - value) + a_high * b_low + a_low * b_high) + a_low * b_low


def sum_parts(a: Any, b: Any) -> Any:
    """Return a sum and its rounding error, whose sum is exact."""
    value = a + b
    shadow = value - a
    return value, (a - (value - shadow)) + (b - shadow)


def exponential_parts(x: Any, more: Any) -> Any:
    """Return (high, low, n) with `exp(x + more) = (high + low) 2^n`, high near 1; more is a rounding error of x."""
    x = np.minimum(np.maximum(x, _LOWEST_POWER), _HIGHEST_POWER)
    rounded = x * _INVERSE_LN2 + _ROUNDER
    k = rounded - _ROUNDER
    a, b = x - k * _LN2_HIGH, k * _LN2_LOW - more
    r = a - b
    lost = (a - r) - b
    series = _EXPONENTIAL[0]
    for coefficient in _EXPONENTIAL[1:]:
        series = series * r + coefficient
    high = 1.0 + r
    return high, r * r * series + ((r - (high - 1.0)) + lost), np.float64(rounded).view(np.int64) - _ROUNDER_BITS


def times_power_of_two(value: Any, n: Any) -> Any:
    """Return value times 2^n, in two factors, as 2^n itself may be beyond all doubles."""
    half = n >> 1
    rest = n - half
    return (
        value
        * np.int64((half + _BIAS) << _FRACTION_BITS).view(np.float64)
        * np.int64((rest + _BIAS) << _FRACTION_BITS).view(np.float64)
    )


def logarithm_parts(x: Any) -> Any:
    """Return ln x in two parts, good to 2^-64 of it, for x above 0 and finite."""
    tiny = x < _SMALLEST_NORMAL
    bits = np.float64(x * (1.0 + tiny * (_RAISE - 1.0))).view(np.int64)
    exponent = (bits - _SQRT_HALF_BITS) >> _FRACTION_BITS
    m = np.int64(bits - (exponent << _FRACTION_BITS)).view(np.float64)
    # s = (m - 1)/(m + 1), up to .172
    below, above = m - 1.0, m + 1.0
    s = below / above
    p, p_low = product_parts(s, above)
    s_low = ((below - p) - p_low - s * (m - (above - 1.0))) / above
    z, z_low = product_parts(s, s)
    z_low = z_low + 2.0 * s * s_low
    series = _LOGARITHM[0]
    for coefficient in _LOGARITHM[1:]:
        series = series * z + coefficient
    series = series * z * z
    p, p_low = product_parts(_TWO_THIRDS, z)
    inner = p + series
    inner_low = ((p - inner) + series) + (p_low + _TWO_THIRDS * z_low + _TWO_THIRDS_LOW * z)
    p, p_low = product_parts(s, inner)
    p_low = p_low + (s * inner_low + s_low * inner)
    high = 2.0 * s + p
    low = ((2.0 * s - high) + p) + (p_low + 2.0 * s_low)
    k = np.float64(exponent) - 54.0 * tiny
    whole = k * _LN2_HIGH
    total = whole + high
    return total, ((whole - total) + high) + (low + k * _LN2_LOW)


def sine_and_cosine(x: Any) -> Any:
    """Return sin x and cos x, for x up to `LARGEST_ANGLE` either way."""
    rounded = x * _INVERSE_QUARTER + _ROUNDER
    k = rounded - _ROUNDER
    a, a_low = product_parts(k, _QUARTER)
    b, b_low = product_parts(k, _QUARTER_2)
    first, first_low = sum_parts(x - a, -a_low)
    second, second_low = sum_parts(first, -b)
    rest = (first_low + second_low) - (b_low + k * _QUARTER_3)
    r = second + rest
    r_low = (second - r) + rest
    z = r * r
    series = _SINE[0]
    for coefficient in _SINE[1:]:
        series = series * z + coefficient
    sine = r + (r * z * series + r_low * (1.0 - 0.5 * z))
    series = _COSINE[0]
    for coefficient in _COSINE[1:]:
        series = series * z + coefficient
    half = 0.5 * z
    most = 1.0 - half
    cosine = most + (((1.0 - most) - half) + (z * z * series - r * r_low))
    quadrant = np.float64(rounded).view(np.int64)
    odd = np.float64(quadrant & 1)
    even = 1.0 - odd
    flip = 1.0 - np.float64(quadrant & 2)
    flip_next = 1.0 - np.float64((quadrant + 1) & 2)
    return flip * (even * sine + odd * cosine), flip_next * (even * cosine + odd * sine)


def exp_of(x: Any) -> Any:
    """Return e^x of a scalar or an array."""
    high, low, n = exponential_parts(x, 0.0)
    return times_power_of_two(high + low, n)


def expm1_of(x: Any) -> Any:
    """Return `e^x - 1`, as `exp_of`."""
    # From 709.79 on it is infinite; half of 2^n, as 2^1024 is no double.
    high, low, n = exponential_parts(np.minimum(x, 709.9), 0.0)
    half = times_power_of_two(np.float64(1.0), np.maximum(n, -1022) - 1)
    value, lost = sum_parts(half * high, -0.5)
    return 2.0 * (value + (lost + half * low))


def log_of(x: Any) -> Any:
    """Return ln x for x above 0 and finite, as `exp_of`."""
    high, low = logarithm_parts(x)
    return high + low


def log1p_of(x: Any) -> Any:
    """Return `ln(1 + x)` for x above -1 and finite, as `exp_of`."""
    one_more = 1.0 + x
    shadow = one_more - 1.0
    lost = (1.0 - (one_more - shadow)) + (x - shadow)
    high, low = logarithm_parts(one_more)
    return high + (low + lost / one_more)


def power_of(x: Any, y: Any) -> Any:
    """Return x^y for x above 0 and finite, as `exp_of`."""
    y = np.minimum(np.maximum(y, -_MOST_EXPONENT), _MOST_EXPONENT)
    high, low = logarithm_parts(x)
    p, p_low = product_parts(y, high)
    high, low, n = exponential_parts(p, p_low + y * low)
    return times_power_of_two(high + low, n)


def normal_ratio(which: int, x: Any) -> Any:
    """Return one of the rational functions of the normal quantile, as `exp_of`."""
    above, below = _NORMAL[which][0][0] + 0.0 * x, _NORMAL[which][1][0] + 0.0 * x
    for k in range(1, 8):
        above, below = above * x + _NORMAL[which][0][k], below * x + _NORMAL[which][1][k]
    return above / below


#: Compiled by numba (`cgid._elementary`).
FORMULAS = (
    product_parts,
    sum_parts,
    exponential_parts,
    times_power_of_two,
    logarithm_parts,
    sine_and_cosine,
    exp_of,
    expm1_of,
    log_of,
    log1p_of,
    power_of,
    normal_ratio,
)


def _arrays(*values: ArrayLike) -> tuple[Floats, ...]:
    return tuple(np.asarray(value, np.float64) for value in values)


def _loop(name: str) -> Any:
    """Return the compiled loop of a function if numba has been loaded, else None: numpy then evaluates the formula."""
    if "numba" not in sys.modules:
        return None
    from cgid import _elementary

    return getattr(_elementary, name)


def _evaluate(name: str, formula: Any, *given: Floats) -> Floats:
    """Return the values of a function of arrays of one shape, by its compiled loop or by numpy."""
    loop = _loop(name)
    if loop is None:
        with np.errstate(all="ignore"):
            return np.asarray(formula(*given))
    out = np.empty(given[0].shape)
    loop(*(np.ascontiguousarray(values).ravel() for values in given), out.ravel())
    return out


def exp(x: ArrayLike) -> Floats:
    """Return e^x.

    Examples
    --------
    >>> float(exp(1.0))
    2.718281828459045
    """
    return _evaluate("exp_loop", exp_of, *_arrays(x))


def expm1(x: ArrayLike) -> Floats:
    """Return `e^x - 1` without cancellation near 0."""
    return _evaluate("expm1_loop", expm1_of, *_arrays(x))


def log(x: ArrayLike) -> Floats:
    """Return the natural logarithm: -inf at 0, nan below it."""
    (x,) = _arrays(x)
    with np.errstate(all="ignore"):
        inside = (x > 0) & (x < np.inf)
        outside = np.where(x == 0, -np.inf, np.where(x > 0, x, np.nan))
    return np.where(inside, _evaluate("log_loop", log_of, np.where(inside, x, 1.0)), outside)


def log1p(x: ArrayLike) -> Floats:
    """Return `ln(1 + x)` without cancellation near 0: -inf at -1, nan below it."""
    (x,) = _arrays(x)
    with np.errstate(all="ignore"):
        inside = (x > -1) & (x < np.inf)
        outside = np.where(x == -1, -np.inf, np.where(x > -1, x, np.nan))
    return np.where(inside, _evaluate("log1p_loop", log1p_of, np.where(inside, x, 0.0)), outside)


def power(x: ArrayLike, y: ArrayLike) -> Floats:
    """Return x^y for x of 0 or more, nan below.

    Examples
    --------
    >>> float(power(2.0, 0.5))
    1.4142135623730951
    """
    x, y = np.broadcast_arrays(*_arrays(x, y))
    with np.errstate(all="ignore"):
        inside = (x > 0) & (x < np.inf)
        # Powers of 0 and of infinity are exact.
        ends = np.where((x == 0) == (y > 0), 0.0, np.inf)
        outside = np.where(x < 0, np.nan, np.where(y == 0, 1.0, np.where(np.isnan(x + y), np.nan, ends)))
    raised = _evaluate("power_loop", power_of, np.where(inside, x, 1.0), np.where(inside, y, 1.0))
    return np.where(inside, raised, outside)


def sincos(x: ArrayLike) -> tuple[Floats, Floats]:
    """Return sine and cosine of angles [rad] up to `LARGEST_ANGLE`, nan beyond."""
    (x,) = _arrays(x)
    with np.errstate(invalid="ignore"):
        x = np.where(np.abs(x) <= LARGEST_ANGLE, x, np.nan)
    loop = _loop("sincos_loop")
    if loop is None:
        with np.errstate(all="ignore"):
            sine, cosine = sine_and_cosine(x)
        return np.asarray(sine), np.asarray(cosine)
    sine, cosine = np.empty(x.shape), np.empty(x.shape)
    loop(np.ascontiguousarray(x).ravel(), sine.ravel(), cosine.ravel())
    return sine, cosine


def sin(x: ArrayLike) -> Floats:
    """Return the sine, as `sincos`."""
    return sincos(x)[0]


def cos(x: ArrayLike) -> Floats:
    """Return the cosine, as `sincos`."""
    return sincos(x)[1]


def complex_of(real: Floats, imaginary: Floats) -> Complex:
    """Return complex numbers of these parts, which broadcast."""
    out = np.empty(np.broadcast_shapes(np.shape(real), np.shape(imaginary)), np.complex128)
    out.real, out.imag = real, imaginary
    return out


def complex_exp(x: Complex) -> Complex:
    """Return the exponential of complex numbers."""
    size, (sine, cosine) = exp(x.real), sincos(x.imag)
    return complex_of(size * cosine, size * sine)


def complex_product(a: Complex, b: Complex) -> Complex:
    """Return the product of complex arrays; numpy's own may fuse multiplication and addition."""
    return complex_of(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def matrix_product(a: Floats, b: Floats) -> Floats:
    """Return the product of a (n, k) and b (k, ...), summed in order of k; BLAS depends on the processor."""
    out = np.zeros((len(a), *b.shape[1:]))
    for k, row in enumerate(b):
        out += a[:, k].reshape(-1, *(1,) * row.ndim) * row
    return out


def modulus(x: Complex) -> Floats:
    """Return the absolute values of complex numbers whose squares are doubles."""
    return np.asarray(np.sqrt(x.real * x.real + x.imag * x.imag))


def normal_quantile(probability: ArrayLike) -> Floats:
    """Return the value below which this share of a standard normal distribution lies: infinite at 0 and 1, nan beyond.

    Wichura (1988), Appl. Stat. 37, 477, algorithm AS 241: good to 1e-15 of the value.

    Examples
    --------
    >>> float(normal_quantile(0.5)), round(float(normal_quantile(0.975)), 12)
    (0.0, 1.95996398454)
    """
    return _evaluate("normal_quantile_loop", _normal_quantile, *_arrays(probability))


def _normal_quantile(p: Floats) -> Floats:
    q = p - 0.5
    r = np.sqrt(-log(np.where(q < 0, p, 1 - p)))
    tail = np.where(r > 5.0, normal_ratio(2, r - 5.0), normal_ratio(1, r - 1.6))
    tail = np.where(r == np.inf, np.inf, tail)
    middle = np.abs(q) <= 0.425
    inside = q * normal_ratio(0, np.where(middle, 0.180625 - q * q, 0.0))
    return np.where(middle, inside, np.where(q < 0, -tail, tail))


@lru_cache(maxsize=1024)
def normal_share(value: float) -> float:
    """Return the share of a standard normal distribution that lies below a value.

    A power series within 2 standard deviations (Marsaglia 2004, J. Stat. Softw. 11, 4), Laplace's continued fraction
    for the tails, which keeps their digits.

    Examples
    --------
    >>> normal_share(0.0), round(normal_share(1.96), 12)
    (0.5, 0.975002104852)
    """
    size = abs(float(value))
    density = float(exp(-0.5 * size * size)) / math.sqrt(2 * math.pi)
    if size < 2.0:
        term, total, k = size, 0.0, 1
        while total + term != total:
            total, k = total + term, k + 2
            term *= size * size / k
        below = 0.5 - density * total
    else:
        mills = 0.0
        for k in range(200, 0, -1):
            mills = k / (size + mills)
        below = density / (size + mills)
    return below if value < 0 else 1 - below

"""Numba kernels of Fourier transforms that give the same bits on every processor, and what a scene does with them.

The transform is Stockham's, of mixed radix (Van Loan 1992, Computational Frameworks for the Fast Fourier Transform,
section 1.7); rows of an even number of samples are transformed as half as many complex numbers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid.compiled import jit
from cgid.elementary import sincos

Array = NDArray[Any]

#: A factor is as dear as its size; rows whose length has a prime factor above this are not transformed here.
LARGEST_FACTOR = 509


class Turns(NamedTuple):
    """What a transform of one length needs.

    Attributes
    ----------
    factors : ndarray of int
        Of the length.
    cosine, sine : ndarray, (length,)
        Of all parts of a turn.
    """

    factors: Array
    cosine: Array
    sine: Array


@lru_cache(maxsize=16)
def turns(length: int) -> Turns:
    """Return what a transform of this length needs."""
    factors, rest = [], length
    for factor in (4, 2, *range(3, LARGEST_FACTOR + 1, 2)):
        while rest % factor == 0:
            factors.append(factor)
            rest //= factor
    sine, cosine = sincos(2 * np.pi * (np.arange(length) / length))
    return Turns(np.array(factors, np.int64), cosine, sine)


def transformable(length: int) -> bool:
    """Return whether a length has no prime factor above `LARGEST_FACTOR`."""
    half = length // 2 if length % 2 == 0 else length
    return int(np.prod(turns(half).factors)) == half


@jit
def _transform(re: Array, im: Array, room_re: Array, room_im: Array, of: Turns, sign: float) -> None:
    """Transform re + i im (n,) in place by `sum x_j exp(sign 2 pi i j k / n)`."""
    n = re.size
    x, y, u, v = re, im, room_re, room_im
    stride, left = 1, n
    for radix in of.factors:
        part = left // radix
        if radix == 2:
            for p in range(part):
                c, s = of.cosine[p * stride], sign * of.sine[p * stride]
                first, second = stride * p, stride * (p + part)
                to = 2 * stride * p
                for q in range(stride):
                    a, b = x[first + q] - x[second + q], y[first + q] - y[second + q]
                    u[to + q], v[to + q] = x[first + q] + x[second + q], y[first + q] + y[second + q]
                    u[to + stride + q], v[to + stride + q] = c * a - s * b, c * b + s * a
        elif radix == 4:
            for p in range(part):
                c1, s1 = of.cosine[p * stride], sign * of.sine[p * stride]
                c2, s2 = of.cosine[2 * p * stride], sign * of.sine[2 * p * stride]
                c3, s3 = of.cosine[3 * p * stride], sign * of.sine[3 * p * stride]
                i0 = stride * p
                i1, i2, i3 = i0 + stride * part, i0 + 2 * stride * part, i0 + 3 * stride * part
                to = 4 * stride * p
                for q in range(stride):
                    a_re, a_im = x[i0 + q] + x[i2 + q], y[i0 + q] + y[i2 + q]
                    b_re, b_im = x[i0 + q] - x[i2 + q], y[i0 + q] - y[i2 + q]
                    c_re, c_im = x[i1 + q] + x[i3 + q], y[i1 + q] + y[i3 + q]
                    d_re, d_im = sign * (y[i3 + q] - y[i1 + q]), sign * (x[i1 + q] - x[i3 + q])
                    u[to + q], v[to + q] = a_re + c_re, a_im + c_im
                    e, f = b_re + d_re, b_im + d_im
                    u[to + stride + q], v[to + stride + q] = c1 * e - s1 * f, c1 * f + s1 * e
                    e, f = a_re - c_re, a_im - c_im
                    u[to + 2 * stride + q], v[to + 2 * stride + q] = c2 * e - s2 * f, c2 * f + s2 * e
                    e, f = b_re - d_re, b_im - d_im
                    u[to + 3 * stride + q], v[to + 3 * stride + q] = c3 * e - s3 * f, c3 * f + s3 * e
        else:
            for p in range(part):
                for k in range(radix):
                    c, s = of.cosine[p * k * stride], sign * of.sine[p * k * stride]
                    to = stride * (radix * p + k)
                    for q in range(stride):
                        a, b = 0.0, 0.0
                        for j in range(radix):
                            turn = (j * k) % radix * (n // radix)
                            e, f = of.cosine[turn], sign * of.sine[turn]
                            at = stride * (p + part * j) + q
                            a += e * x[at] - f * y[at]
                            b += e * y[at] + f * x[at]
                        u[to + q], v[to + q] = c * a - s * b, c * b + s * a
        x, y, u, v = u, v, x, y
        stride, left = stride * radix, part
    if of.factors.size % 2:
        re[:], im[:] = room_re, room_im


@jit
def _weigh(re: Array, im: Array, gain: Array, whole: Turns) -> None:
    """Multiply the spectrum of a real row by gain, where the row's even and odd samples were transformed as one."""
    half = re.size
    for k in range(half // 2 + 1):
        j = half - k if k > 0 else 0
        c, s = whole.cosine[k], -whole.sine[k]
        even_re, even_im = 0.5 * (re[k] + re[j]), 0.5 * (im[k] - im[j])
        odd_re, odd_im = 0.5 * (im[k] + im[j]), 0.5 * (re[j] - re[k])
        a, b = c * odd_re - s * odd_im, c * odd_im + s * odd_re
        low_re, low_im = gain[k] * (even_re + a), gain[k] * (even_im + b)
        high_re, high_im = gain[half - k] * (even_re - a), gain[half - k] * (even_im - b)
        _fold(re, im, k, j, low_re, low_im, high_re, high_im, c, s)


@jit
def _fold(
    re: Array,
    im: Array,
    k: int,
    j: int,
    low_re: float,
    low_im: float,
    high_re: float,
    high_im: float,
    c: float,
    s: float,
) -> None:
    """Enter the spectrum of a real row at k and, conjugate, at half its length less k, as that of even and odd ones."""
    even_re, even_im = 0.5 * (low_re + high_re), 0.5 * (low_im + high_im)
    a, b = 0.5 * (low_re - high_re), 0.5 * (low_im - high_im)
    odd_re, odd_im = c * a + s * b, c * b - s * a
    re[k], im[k] = even_re - odd_im, even_im + odd_re
    re[j], im[j] = even_re + odd_im, odd_re - even_im


@jit
def filter_rows(rows: Array, gain: Array, whole: Turns, half: Turns, out: Array) -> None:
    """Fill out (n, length) with rows whose spectra are multiplied by gain (length // 2 + 1,)."""
    length = rows.shape[1]
    even = length % 2 == 0
    n = length // 2 if even else length
    of = half if even else whole
    re, im, room_re, room_im = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(rows.shape[0]):
        row, filtered = rows[i], out[i]
        for k in range(n):
            re[k], im[k] = (row[2 * k], row[2 * k + 1]) if even else (row[k], 0.0)
        _transform(re, im, room_re, room_im, of, -1.0)
        if even:
            _weigh(re, im, gain, whole)
        else:
            for k in range(n):
                factor = gain[min(k, n - k)]
                re[k] *= factor
                im[k] *= factor
        _transform(re, im, room_re, room_im, of, 1.0)
        for k in range(n):
            if even:
                filtered[2 * k], filtered[2 * k + 1] = re[k] / n, im[k] / n
            else:
                filtered[k] = re[k] / n


@jit
def rows_of(real: Array, imaginary: Array, whole: Turns, half: Turns, out: Array) -> None:
    """Fill out (n, length), of even length, with the rows whose spectra (n, length // 2 + 1) these are.

    The imaginary parts at both ends are not looked at.
    """
    n = out.shape[1] // 2
    re, im, room_re, room_im = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(out.shape[0]):
        a, b = real[i], imaginary[i]
        re[0], im[0] = 0.5 * (a[0] + a[n]), 0.5 * (a[0] - a[n])
        for k in range(1, n // 2 + 1):
            # The spectrum at n - k, conjugate, goes with that at k.
            _fold(re, im, k, n - k, a[k], b[k], a[n - k], -b[n - k], whole.cosine[k], -whole.sine[k])
        _transform(re, im, room_re, room_im, half, 1.0)
        for k in range(n):
            out[i, 2 * k], out[i, 2 * k + 1] = re[k] / n, im[k] / n


def filtered(rows: Array, gain: Array) -> Array:
    """Return rows (n, length) filtered by a gain (length // 2 + 1,), of a length that is `transformable`."""
    length = rows.shape[1]
    out = np.empty(rows.shape)
    filter_rows(np.asarray(rows, np.float64), gain, turns(length), turns(max(length // 2, 1)), out)
    return out.astype(rows.dtype)


def from_spectrum(real: Array, imaginary: Array, length: int) -> Array:
    """Return the rows (n, length), of even length, of spectra (n, length // 2 + 1) as `numpy.fft.irfft` has them."""
    out = np.empty((len(real), length))
    rows_of(real, imaginary, turns(length), turns(length // 2), out)
    return out

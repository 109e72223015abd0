"""Every numba function of the impact: floats and arrays in, arrays out, no checks, no strings.

The symbols are those of `cgid.family`: a pulse is two sets of local polynomials in sigma, found by a
Chebyshev series over ln e. All kernels stay in this file: numba's cache does not see edits elsewhere.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@_jit
def _blend(cosine: float, terms: Array, out: Array) -> None:
    """Sum the Chebyshev series over ln e: terms (n_terms, n_coefficients) -> out (n_coefficients)."""
    before, now = 1.0, cosine
    for j in range(out.size):
        out[j] = terms[0, j] + cosine * terms[1, j]
    for k in range(2, terms.shape[0]):
        before, now = now, 2.0 * cosine * now - before
        for j in range(out.size):
            out[j] += now * terms[k, j]


@_jit
def _local(coefficients: Array, offset: int, n_segments: int, n_powers: int, sigma: float) -> float:
    """Evaluate the local polynomial that serves sigma."""
    place = sigma * n_segments
    segment = min(int(place), n_segments - 1)
    u = 2.0 * (place - segment) - 1.0
    first = offset + segment * n_powers
    value: float = coefficients[first + n_powers - 1]
    for power in range(n_powers - 2, -1, -1):
        value = value * u + coefficients[first + power]
    return value


@_jit
def _pulse(
    coefficients: Array, n_segments: int, n_powers: int, tau: float, cut: float, tau_c: float, cubic: bool
) -> float:
    """Return force (cubic) or displacement at tau within contact."""
    if tau <= cut:
        square, offset = tau / cut, 0
    else:
        square, offset = (tau_c - tau) / (tau_c - cut), n_segments * n_powers
    sigma = math.sqrt(square)
    value = square * _local(coefficients, offset, n_segments, n_powers, sigma)
    return value * sigma if cubic else value


@_jit
def at_times(
    times: Array,
    cosine: Array,
    tau_c: Array,
    cut: Array,
    time_scale: Array,
    amplitude: Array,
    terms: Array,
    cubic: bool,
    out: Array,
) -> None:
    """Fill out (n, k) with the pulses at times (n, k) [s]; zero outside contact."""
    n_segments, n_powers = terms.shape[2], terms.shape[3]
    flat = terms.reshape(terms.shape[0], 2 * n_segments * n_powers)
    coefficients = np.empty(flat.shape[1])
    for i in range(times.shape[0]):
        _blend(cosine[i], flat, coefficients)
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            if 0.0 < tau < tau_c[i]:
                out[i, k] = amplitude[i] * _pulse(coefficients, n_segments, n_powers, tau, cut[i], tau_c[i], cubic)
            else:
                out[i, k] = 0.0


@_jit
def add_to_frames(
    frames: Array, onset: Array, step: Array, cosine: Array, tau_c: Array, cut: Array, amplitude: Array, terms: Array
) -> None:
    """Add one force pulse to every row of frames (n, n_samples); only samples in contact are touched.

    onset [samples] is where touch falls on the sample grid, step is the sampling interval over T0.
    """
    n_segments, n_powers = terms.shape[2], terms.shape[3]
    flat = terms.reshape(terms.shape[0], 2 * n_segments * n_powers)
    coefficients = np.empty(flat.shape[1])
    for i in range(frames.shape[0]):
        _blend(cosine[i], flat, coefficients)
        first = max(math.ceil(onset[i]), 0)
        last = min(math.floor(onset[i] + tau_c[i] / step[i]), frames.shape[1] - 1)
        for k in range(first, last + 1):
            tau = (k - onset[i]) * step[i]
            if 0.0 < tau < tau_c[i]:
                frames[i, k] += amplitude[i] * _pulse(coefficients, n_segments, n_powers, tau, cut[i], tau_c[i], True)

"""Numba kernels of the response: damped resonators driven by a contact force, then in free decay.

A pole p with state z obeys z' = p z + P. Over a step h in which P is straight, z moves exactly to
E z + g0 P_n + g1 P_(n+1), E = exp(p h). With z = u + g1 P this is u_(n+1) = E u_n + b P_n, b = g0 + E g1: one input.
Over the M steps of a sample u moves to E^M u + b sum E^(M-1-j) P_j. As functions of j these powers are smooth, and a
few polynomials serve all poles: the sum over steps is made once for each polynomial, and each pole adds up polynomials.
Once P is zero, u rings as exp(p t): a table of a block of samples, multiplied by exp(p) of its length for the next.
No `fastmath`: loops run over poles or over samples, each of which keeps its own order of sums.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import jit

Array = NDArray[Any]


@jit
def _advance(state: Array, turn: Array, polynomials: Array, shares: Array, drive: Array, moments: Array) -> None:
    """Move the states (2, n_poles) by one sample; turn (2, n_poles) is exp(p) of it."""
    moments[:] = 0.0
    for j in range(drive.size):
        force, row = drive[j], polynomials[j]
        for n in range(moments.size):
            moments[n] += row[n] * force
    real, imaginary, cosine, sine = state[0], state[1], turn[0], turn[1]
    for r in range(real.size):
        re, im = real[r], imaginary[r]
        real[r] = cosine[r] * re - sine[r] * im
        imaginary[r] = cosine[r] * im + sine[r] * re
    for n in range(moments.size):
        moment, to_real, to_imaginary = moments[n], shares[0, n], shares[1, n]
        for r in range(real.size):
            real[r] += to_real[r] * moment
            imaginary[r] += to_imaginary[r] * moment


@jit
def _output(state: Array, edge: Array, amplitude: Array, force: float) -> float:
    """Return the sum over poles of the real part of amplitude times z; edge is g1."""
    total = 0.0
    for r in range(state.shape[1]):
        total += amplitude[0, r] * (state[0, r] + edge[0, r] * force)
        total -= amplitude[1, r] * (state[1, r] + edge[1, r] * force)
    return total


@jit
def strike(
    frames: Array,
    row: Array,
    first: Array,
    stride: Array,
    count: Array,
    level: Array,
    turn: Array,
    polynomials: Array,
    shares: Array,
    edge: Array,
    force: Array,
    drive: Array,
    amplitude: Array,
    direct: Array,
    ringing: Array,
    selected: Array,
) -> None:
    """Add the response during contact to frames, and fill ringing (n, 2, n_poles): the states at first + count."""
    # force (n, k) is on a grid of stride[i] steps a sample from sample first[i] on and ends with zeros; drive is
    # corrected for straight lines between steps. polynomials, shares and edge have a leading axis for level[i]; direct
    # passes undelayed.
    n_samples, n_poles = frames.shape[1], amplitude.shape[2]
    state, moments = np.empty((2, n_poles)), np.empty(polynomials.shape[2])
    for i in selected:
        state[:] = 0.0
        k, frame = level[i], frames[row[i]]
        for number in range(1, count[i] + 1):
            sample, n = first[i] + number, number * stride[i]
            _advance(state, turn, polynomials[k], shares[k], drive[i, n - stride[i] : n], moments)
            if 0 <= sample < n_samples and number < count[i]:
                frame[sample] += _output(state, edge[k], amplitude[i], drive[i, n]) + direct[i] * force[i, n]
        for r in range(n_poles):
            ringing[i, 0, r] = amplitude[i, 0, r] * state[0, r] - amplitude[i, 1, r] * state[1, r]
            ringing[i, 1, r] = amplitude[i, 0, r] * state[1, r] + amplitude[i, 1, r] * state[0, r]


@jit
def _add_ring(samples: Array, weights: Array, n_alive: int, table: Array, skipped: int) -> None:
    """Add the ringing of some poles to samples; table (2, n_poles, length) holds exp(p t), real and imaginary part."""
    for r in range(n_alive):
        re, im = weights[0, r], weights[1, r]
        cosine, sine = table[0, r, skipped:], table[1, r, skipped:]
        for k in range(samples.size):
            samples[k] += re * cosine[k] - im * sine[k]


@jit
def _copy(pairs: Array, to: Array) -> None:
    """Copy pairs (2, n), perhaps to another precision; numba takes seconds for the checks of an assignment."""
    for k in range(2):
        for r in range(to.shape[1]):
            to[k, r] = pairs[k, r]


@jit
def _size(pairs: Array, r: int) -> float:
    """Return the absolute values of complex numbers in pairs (2, n)."""
    return math.sqrt(pairs[0, r] * pairs[0, r] + pairs[1, r] * pairs[1, r])


@jit
def ring(
    frames: Array, begin: Array, order: Array, start: Array, ringing: Array, table: Array, hop: Array, silence: float
) -> None:
    """Add free ringing to frames (n_rows, n_samples)."""
    # Of row i the pulses order[begin[i]:begin[i + 1]] begin to ring at sample start. hop (2, n_poles) is exp(p length).
    # Poles are sorted, the slowest decay first: the last ones are omitted while their sum is below silence.
    length, n_poles = table.shape[2], table.shape[1]
    kind = table[0, 0, :1]
    state = np.empty((2, n_poles))
    quiet = np.empty((2, n_poles), kind.dtype)
    for row in range(frames.shape[0]):
        following, last = begin[row], begin[row + 1]
        if following == last:
            continue
        state[:] = 0.0
        alive, loudest, left_out = 0, 0.0, 0.0
        here, samples = start[order[following]], frames[row]
        while here < samples.size and (alive > 0 or following < last):
            if alive == 0:
                here = start[order[following]]
            end = min(here + length, samples.size)
            if alive > 0 and end > 0:
                skipped = max(-here, 0)
                _copy(state, quiet)
                _add_ring(samples[here + skipped : end], quiet, alive, table, skipped)
            for r in range(alive):
                re = state[0, r] * hop[0, r] - state[1, r] * hop[1, r]
                state[1, r] = state[0, r] * hop[1, r] + state[1, r] * hop[0, r]
                state[0, r] = re
            while following < last and start[order[following]] < here + length:
                new, at = ringing[order[following]], start[order[following]]
                skipped = max(-at, 0)
                if end > at + skipped:
                    _copy(new, quiet)
                    _add_ring(samples[at + skipped : end], quiet, n_poles, table, skipped)
                left = here + length - at
                for r in range(n_poles):
                    if left == length:
                        re, im = hop[0, r], hop[1, r]
                    else:
                        re, im = table[0, r, left], table[1, r, left]
                    if r >= alive:
                        state[0, r], state[1, r] = 0.0, 0.0
                    state[0, r] += new[0, r] * re - new[1, r] * im
                    state[1, r] += new[0, r] * im + new[1, r] * re
                alive, left_out = n_poles, 0.0
                following += 1
            for k in range(max(here, 0), end):
                loudest = max(loudest, abs(samples[k]))
            if alive < n_poles:
                left_out *= _size(hop, alive)  # the slowest of them
            while alive > 0:
                more = _size(state, alive - 1)
                if left_out + more > silence * loudest:
                    break
                left_out += more
                alive -= 1
            here += length

"""Numba kernels of white noise: a normal number for every (key, address, sample), whichever are requested.

Philox4x32-10 (Salmon, Moraes, Dror & Shaw 2011) turns a counter of four words and a key of two into four random
words; Box and Muller's (1958) transform turns two words into two normal numbers. There is no state, so any samples can
be generated without earlier ones. Only correctly rounded operations (+, -, *, /, square root) are used and no
`fastmath`: every machine gives the same bits up to those of its sine, logarithm and root.

The loops run over short arrays that stay in the cache, from their start and of a fixed length, which is what lets the
compiler take several at once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import jit

Array = NDArray[Any]
Word = np.uint64  # it holds 32 bits, and their products

#: Counters processed at once.
LANES = 128
#: Samples from these, four per counter.
TILE = 4 * LANES

_real = np.float32
_LOW, _HALF = Word(0xFFFFFFFF), Word(32)
# Multipliers and increments of the key, Salmon et al., section 3.3.
_MULTIPLIER_0, _MULTIPLIER_1 = Word(0xD2511F53), Word(0xCD9E8D57)
_WEYL_0, _WEYL_1 = Word(0x9E3779B9), Word(0xBB67AE85)
_FURTHER_ROUNDS = 9  # after the first: ten, as Salmon et al. recommend

_ONE, _TWO, _HALF_STEP = _real(1), _real(2), _real(0.5)
_RADIANS = _real(math.pi / 2**32)
_LN_2 = _real(0.6931471805599453)
_SQRT_HALF_BITS, _FRACTION_BITS = np.int32(0x3F3504F3), np.int32(23)  # float32 of 1/sqrt 2; bits of a fraction
# Series that end below 1e-7: ln((1 + s)/(1 - s)) for |s| < .172, sine and cosine up to a quarter turn.
_L3, _L5, _L7 = _real(1 / 3), _real(1 / 5), _real(1 / 7)
_S3, _S5, _S7, _S9, _S11 = (_real((-1) ** (k // 2) / math.factorial(k)) for k in (3, 5, 7, 9, 11))
_C2, _C4, _C6, _C8, _C10, _C12 = (_real((-1) ** (k // 2) / math.factorial(k)) for k in (2, 4, 6, 8, 10, 12))


@jit
def random_words(first: int, row: Word, block: Word, high: Word, key_0: Word, key_1: Word, words: Array) -> None:
    """Write the random words of the counters (first + lane, row, block, high) to words (4, `LANES`)."""
    for lane in range(LANES):
        a, b, c, d = Word(first + lane), row, block, high
        k, m = key_0, key_1
        p, q = _MULTIPLIER_0 * a, _MULTIPLIER_1 * c
        a, b, c, d = (q >> _HALF) ^ b ^ k, q & _LOW, (p >> _HALF) ^ d ^ m, p & _LOW
        for _ in range(_FURTHER_ROUNDS):
            k, m = (k + _WEYL_0) & _LOW, (m + _WEYL_1) & _LOW
            p, q = _MULTIPLIER_0 * a, _MULTIPLIER_1 * c
            a, b, c, d = (q >> _HALF) ^ b ^ k, q & _LOW, (p >> _HALF) ^ d ^ m, p & _LOW
        words[0, lane], words[1, lane], words[2, lane], words[3, lane] = a, b, c, d


@jit
def to_normal(words: Array, angles: Array, scratch: Array, normal: Array) -> None:
    """Convert words and angles (`LANES`) of 32 random bits to normal numbers (2, `LANES`), using scratch."""
    # u = (word + 1/2)/2^32; sqrt(-2 ln u) (cos, sin) of the angle. Its last bit is the half turn, the others the
    # position in it.
    uniform, fraction = scratch[0], scratch[1]
    for k in range(LANES):
        uniform[k] = _real(words[k]) + _HALF_STEP
    # uniform = 2^exponent times a fraction within sqrt(1/2) and sqrt(2), taken apart by its bits
    bits, fraction_bits = uniform.view(np.int32), fraction.view(np.int32)
    for k in range(LANES):
        fraction_bits[k] = bits[k] - (((bits[k] - _SQRT_HALF_BITS) >> _FRACTION_BITS) << _FRACTION_BITS)
    for k in range(LANES):
        exponent = _real(np.int32((bits[k] - _SQRT_HALF_BITS) >> _FRACTION_BITS) - np.int32(32))
        s = (fraction[k] - _ONE) / (fraction[k] + _ONE)
        t = s * s
        log = exponent * _LN_2 + _TWO * s * (_ONE + t * (_L3 + t * (_L5 + t * _L7)))
        radius = _real(math.sqrt(-_TWO * log))
        radius *= _ONE - _TWO * _real(np.int32(angles[k]) & np.int32(1))
        x = _real(np.int32(angles[k])) * _RADIANS
        y = x * x
        cosine = _ONE + y * (_C2 + y * (_C4 + y * (_C6 + y * (_C8 + y * (_C10 + y * _C12)))))
        sine = x * (_ONE + y * (_S3 + y * (_S5 + y * (_S7 + y * (_S9 + y * _S11)))))
        normal[0, k], normal[1, k] = radius * cosine, radius * sine


@jit
def add_normal(
    frames: Array, level: Array, first_sample: int, block: Word, high: Word, key_0: Word, key_1: Word
) -> None:
    """Add level (n,) times normal numbers to frames (n, n_samples), which begin with sample `first_sample`."""
    words, scratch = np.empty((4, LANES), np.uint32), np.empty((2, LANES), np.float32)
    normal = np.empty((4, LANES), np.float32)
    flat = normal.reshape(-1)
    n_samples = frames.shape[1]
    for row in range(frames.shape[0]):
        for tile in range(first_sample // TILE, -((-first_sample - n_samples) // TILE)):
            random_words(tile * LANES, Word(row), block, high, key_0, key_1, words)
            to_normal(words[0], words[1], scratch, normal[:2])
            to_normal(words[2], words[3], scratch, normal[2:])
            begin = max(tile * TILE - first_sample, 0)
            end = min((tile + 1) * TILE - first_sample, n_samples)
            samples, numbers = frames[row, begin:end], flat[begin + first_sample - tile * TILE :]
            for k in range(samples.size):
                samples[k] += level[row] * numbers[k]

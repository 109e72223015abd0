"""Checksummed chunks as HDF5's own filter stores them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import jit

#: A checksum in a file.
CHECKSUM = np.dtype("<u4")


def close_chunk(chunk: NDArray[np.uint8]) -> None:
    """Write the checksum of a stored chunk into its last four bytes."""
    size = chunk.size - CHECKSUM.itemsize
    # A last odd byte is a high one.
    words = chunk[:size] if size % 2 == 0 else np.append(chunk[:size], np.uint8(0))
    chunk[size:] = np.frombuffer(np.array(fletcher32(words.view("<u2")), CHECKSUM), np.uint8)


# ---- Fletcher's checksum as HDF5 computes it: over 16-bit words with the high byte first, modulo 65535 ---------------

# This many words, each times its index, still fit 32 bits.
_STEP = 256
_Sum, _Word = np.uint64, np.uint32
_MODULUS, _ONE, _HALF = _Sum(65535), _Sum(1), _Sum(16)
_BYTE, _LOW_BYTE = _Word(8), _Word(255)


@jit
def _reduce(total: np.uint64) -> np.uint64:
    """Return the sum modulo 65535 as HDF5 stores it: 0 for 0 alone, 65535 for its multiples."""
    return (total - _ONE) % _MODULUS + _ONE if total else total


@jit
def fletcher32(words: NDArray[Any]) -> np.uint64:
    """Return the checksum of little-endian 16-bit words (n,): the sum of the sums above the sum."""
    total, total_of_totals = _Sum(0), _Sum(0)
    for start in range(0, words.size, _STEP):
        part = words[start : start + _STEP]
        some, some_of_sums = _Word(0), _Word(0)
        for k in range(part.size):
            word = _Word(part[k])
            swapped = _Word((word & _LOW_BYTE) << _BYTE | word >> _BYTE)
            some = _Word(some + swapped)
            some_of_sums = _Word(some_of_sums + _Word(part.size - k) * swapped)
        total_of_totals = _reduce(total_of_totals + _Sum(part.size) * total + _Sum(some_of_sums))
        total = _reduce(total + _Sum(some))
    return total_of_totals << _HALF | total

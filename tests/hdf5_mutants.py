"""Changed HDF5 files with valid checksums, so that HDF5 accepts the changes.

Since version 1.10, HDF5 ends each piece of its headers and indices with a checksum (Bob Jenkins' lookup3, see its file
format specification). It detects a flipped bit, but an attacker can recompute it. The pieces of a sound file are found
by their signatures and the place where the checksum fits.
"""

from __future__ import annotations

import re
import struct

import numba
import numpy as np
from numpy.typing import NDArray

#: Signatures of file format specification 3.0: superblock, object headers, heaps, B-trees, arrays of chunks.
_SIGNATURES = re.compile(
    rb"\x89HDF\r\n\x1a\n|OHDR|OCHK|FRHP|FHDB|FHIB|FSHD|FSSE|BTHD|BTIN|BTLF|FAHD|FADB|EAHD|EAIB|EASB|EADB|SMTB|SMLI"
)
#: Longest piece of a small file [bytes].
_LONGEST = 4096
_EXTREMES = tuple(
    value.to_bytes(width, "little")
    for width in (1, 2, 4, 8)
    for value in (0, 1, (1 << 8 * width - 1) - 1, 1 << 8 * width - 1, (1 << 8 * width) - 1)
)


@numba.njit(cache=False)
def _rotated(value: int, by: int) -> int:
    return ((value << by) | (value >> (32 - by))) & 0xFFFFFFFF


@numba.njit(cache=False)
def lookup3(content: NDArray[np.uint8]) -> int:
    """Return the checksum of bytes."""
    word = 0xFFFFFFFF
    length = len(content)
    a = b = c = (0xDEADBEEF + length) & word
    place = 0
    while length > 12:
        a = (a + _word(content, place)) & word
        b = (b + _word(content, place + 4)) & word
        c = (c + _word(content, place + 8)) & word
        a = ((a - c) & word) ^ _rotated(c, 4)
        c = (c + b) & word
        b = ((b - a) & word) ^ _rotated(a, 6)
        a = (a + c) & word
        c = ((c - b) & word) ^ _rotated(b, 8)
        b = (b + a) & word
        a = ((a - c) & word) ^ _rotated(c, 16)
        c = (c + b) & word
        b = ((b - a) & word) ^ _rotated(a, 19)
        a = (a + c) & word
        c = ((c - b) & word) ^ _rotated(b, 4)
        b = (b + a) & word
        place, length = place + 12, length - 12
    if length == 0:
        return c
    a = (a + _word(content, place)) & word
    b = (b + _word(content, place + 4)) & word
    c = (c + _word(content, place + 8)) & word
    c = ((c ^ b) - _rotated(b, 14)) & word
    a = ((a ^ c) - _rotated(c, 11)) & word
    b = ((b ^ a) - _rotated(a, 25)) & word
    c = ((c ^ b) - _rotated(b, 16)) & word
    a = ((a ^ c) - _rotated(c, 4)) & word
    b = ((b ^ a) - _rotated(a, 14)) & word
    return ((c ^ b) - _rotated(b, 24)) & word


@numba.njit(cache=False)
def _word(content: NDArray[np.uint8], place: int) -> int:
    value = 0
    for k in range(4):
        if place + k < len(content):
            value |= np.int64(content[place + k]) << (8 * k)
    return value


def pieces(content: bytes) -> list[tuple[int, int]]:
    """Return the start of each piece of a sound file, and the position of its checksum."""
    found = []
    numbers = np.frombuffer(content, np.uint8)
    for match in _SIGNATURES.finditer(content):
        first = match.start()
        for end in range(first + 8, min(first + _LONGEST, len(content) - 3)):
            if lookup3(numbers[first:end]) == struct.unpack_from("<I", content, end)[0]:
                found.append((first, end))
                break
    return found


def mutant(content: bytes, places: list[tuple[int, int]], random: np.random.Generator) -> bytes:
    """Return a changed file with valid checksums in the changed pieces.

    `places` are its `pieces`; without any, only bytes outside checksums are changed.
    """
    changed = bytearray(content)
    for _ in range(int(random.integers(1, 4))):
        if places and random.random() < 0.9:
            first, end = places[int(random.integers(len(places)))]
            place = int(random.integers(first, end))
        else:
            place = int(random.integers(min(len(content), 4096) if random.random() < 0.7 else len(content)))
        kind = random.integers(4)
        if kind == 0:
            changed[place] ^= 1 << int(random.integers(8))
        elif kind == 1:
            value = _EXTREMES[int(random.integers(len(_EXTREMES)))]
            changed[place : place + len(value)] = value
        elif kind == 2:
            other = int(random.integers(len(content) - 8))
            changed[place : place + 8] = content[other : other + 8]
        else:
            changed[place] = int(random.integers(256))
    del changed[len(content) :]
    for first, end in places:
        if changed[first:end] != content[first:end]:
            struct.pack_into("<I", changed, end, lookup3(np.frombuffer(bytes(changed[first:end]), np.uint8)))
    return bytes(changed)

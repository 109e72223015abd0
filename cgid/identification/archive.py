"""The container of a model file: a zip archive of NumPy arrays, read so strictly that nothing in it can surprise.

zipfile believes the directory at the end of an archive (overlapping entries, a million of them, sizes that are not
true), and NumPy hands the header of an array to Python's own parser. A model needs neither: its entries stand one
behind the other, stored as they are, and `numpy.savez` writes the head of an array in one way only. So both are read
here, by the rules of PKWARE's APPNOTE 6.3 (sections 4.3.7, 4.3.12, 4.3.16, 4.5.3) and of NumPy's NEP 1, and whatever
differs is refused. No array is copied: each is a view of the file's content.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData

#: More arrays than this no model has.
MOST_ENTRIES = 64
_LOCAL, _CENTRAL, _END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
#: Behind the signature: version, flags, method, time, date, CRC-32, packed and plain size, lengths of name and extra.
_LOCAL_HEAD = struct.Struct("<4s5H3L2H")
#: Made by, version, flags, method, time, date, CRC-32, sizes, name, extra, comment, disk, attributes (2), offset.
_CENTRAL_HEAD = struct.Struct("<4s6H3L5H2L")
#: Disks (2), entries (2), size and offset of the directory, length of the comment.
_END_RECORD = struct.Struct("<4s4H2LH")
#: Tag 1, 16 bytes: the plain and the packed size, where the short fields say "see there".
_ZIP64 = struct.Struct("<2H2Q")
_SEE_THERE = 0xFFFFFFFF
#: The kind of a file in the upper half of the attributes: none said, or a plain one; never a link.
_PLAIN_FILE = (0, 0o100000)
#: Names as ours are: no folder, no drive, nothing that any system takes for more than a name.
_NAME = re.compile(rb"[a-z0-9_.]{1,64}\.npy")
_MOST_AXES = 3
#: Version 1.0 of the array format, and its head as NumPy writes it.
_MAGIC = b"\x93NUMPY\x01\x00"
_HEAD = re.compile(
    rb"\{'descr': '(<f8|<i4|<i8|\|b1|\|u1)', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,9}, )*\d{1,9},?)?\), \} *\n"
)


@dataclass(frozen=True)
class _Entry:
    """What the local head of an entry says."""

    name: bytes
    crc: int
    size: int
    offset: int


def arrays_of(content: bytes) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and array of each entry of an archive in its order; what comes first can be used before the rest.

    Raises
    ------
    BadData
        The archive or an array is not as `numpy.savez` writes it, or damaged.
    """
    if not content.startswith(_LOCAL):
        raise BadData("it must be an .npz archive of numbers")
    entries: list[_Entry] = []
    place = 0
    while content[place : place + 4] == _LOCAL:
        entry, start = _entry(content, place)
        if len(entries) == MOST_ENTRIES or entry.name in {known.name for known in entries}:
            raise BadData(f"its archive must hold at most {MOST_ENTRIES} arrays, each once")
        entries.append(entry)
        place = start + entry.size
        held = memoryview(content)[start:place]
        if zlib.crc32(held) != entry.crc:
            raise BadData(f"array {entry.name.decode()} must match its checksum, it is damaged")
        yield entry.name.decode().removesuffix(".npy"), _array(held, entry.name.decode())
    _check_directory(content, place, entries)


def _entry(content: bytes, place: int) -> tuple[_Entry, int]:
    """Return the entry whose local head stands at a place, and where what it holds begins."""
    head = content[place : place + _LOCAL_HEAD.size]
    if len(head) < _LOCAL_HEAD.size:
        raise BadData("its archive must be whole, it is cut off")
    _, _, flags, method, _, _, crc, packed, size, n_name, n_extra = _LOCAL_HEAD.unpack(head)
    place_of_name = place + _LOCAL_HEAD.size
    place_of_extra = place_of_name + n_name
    start = place_of_extra + n_extra
    name = content[place_of_name:place_of_extra]
    if not _NAME.fullmatch(name):
        raise BadData("its arrays must have plain names of at most 64 letters")
    if method or flags:
        raise BadData(f"array {name.decode()} must be stored uncompressed and plain")
    extra = content[place_of_extra:start]
    if size == packed == _SEE_THERE and extra[:4] == b"\x01\x00\x10\x00" and len(extra) == _ZIP64.size:
        _, _, size, packed = _ZIP64.unpack(extra)
        extra = b""
    # Stored, not packed: what is declared cannot be larger than the file.
    if extra or size != packed or size > len(content) - start:
        raise BadData(f"array {name.decode()} must have the size that its archive declares")
    return _Entry(name, crc, size, place), start


def _check_directory(content: bytes, place: int, entries: list[_Entry]) -> None:
    """Raise unless the directory at a place says of the entries what they say themselves, and ends the file."""
    first = place
    for entry in entries:
        head = content[place : place + _CENTRAL_HEAD.size]
        if len(head) < _CENTRAL_HEAD.size:
            raise BadData("its archive must be whole, it is cut off")
        signature, _, _, flags, method, _, _, crc, packed, size, *lengths, disk, _, attributes, offset = (
            _CENTRAL_HEAD.unpack(head)
        )
        name = content[place + _CENTRAL_HEAD.size : place + _CENTRAL_HEAD.size + len(entry.name)]
        said = signature, flags, method, crc, packed, size, lengths, disk, offset, name
        true = _CENTRAL, 0, 0, entry.crc, entry.size, entry.size, [len(name), 0, 0], 0, entry.offset, entry.name
        if said != true or (attributes >> 16) & 0o170000 not in _PLAIN_FILE:
            raise BadData(f"the directory of its archive must agree with array {entry.name.decode()}")
        place += _CENTRAL_HEAD.size + len(name)
    end = _END_RECORD.pack(_END, 0, 0, len(entries), len(entries), place - first, first, 0)
    if content[place:] != end:
        raise BadData("its archive must be whole, and end where its directory does")


def _array(held: memoryview, name: str) -> NDArray[Any]:
    """Return the array of an entry, as a view that cannot be written to."""
    length = int.from_bytes(held[8:10], "little")
    head = _HEAD.fullmatch(held[10 : 10 + length]) if held[:8] == _MAGIC else None
    if head is None:
        raise BadData(f"array {name} must hold numbers as numpy.savez writes them (float64, int32, int64 or bool)")
    descr, fortran, sides = (part.decode() for part in head.groups(b""))
    dtype, shape = np.dtype(descr), tuple(int(side) for side in sides.rstrip(",").split(", ") if side)
    # Exact: a product of Python's integers cannot overflow.
    if math.prod(shape) * dtype.itemsize != len(held) - 10 - length or 0 in shape or len(shape) > _MOST_AXES:
        raise BadData(f"array {name} must declare as many numbers as it holds, and one at least, it declares {shape}")
    array = np.frombuffer(held, dtype, offset=10 + length).reshape(shape, order="F" if fortran == "True" else "C")
    if dtype.kind == "b" and (array.view(np.uint8) > 1).any():
        raise BadData(f"array {name} must hold truths, bytes 0 and 1")
    return array

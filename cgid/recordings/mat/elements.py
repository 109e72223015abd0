"""The elements of a MATLAB file of version 5 to 7.2, packed or plain, each read only as far as it is asked for.

Layout: MathWorks, "MAT-File Format" (the level 5 chapter). scipy reads such files whole; a recording should not have to
fit in memory, and what a header declares is here held against the bytes that follow.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

import numpy as np

from cgid.errors import BadData

Order = Literal["little", "big"]

#: Types of elements that are not numbers.
MATRIX, PACKED = 14, 15
#: Types of elements -> numpy's.
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
#: Types of elements that hold text.
TEXTS = {16: "utf-8", 17: "utf-16", 18: "utf-32", 1: "latin-1", 2: "latin-1", 4: "utf-16"}
_HEADER = 128
#: Version and mark at the end of the header -> byte order. Version 7.3 says 2 and is HDF5.
MAT_ORDERS: dict[bytes, Order] = {b"\x00\x01IM": "little", b"\x01\x00MI": "big"}
#: No packing of zlib's is better.
_BEST_RATIO = 1032
_PIECE = 1 << 18
#: Unpacked bytes kept in memory before they go to a temporary file.
_IN_MEMORY = 1 << 20


@dataclass(frozen=True)
class Element:
    """Type, first byte and size of the content of an element, and the first byte behind it."""

    kind: int
    start: int
    size: int
    end: int


class Stored(Protocol):
    """Bytes that can be read from anywhere."""

    size: int

    def read_at(self, start: int, count: int) -> bytes:
        """Return so many bytes from there; raises `BadData` where there are fewer."""
        ...

    def finish(self) -> None:
        """Hold what was read against the checksum, where there is one; raises `BadData` where it does not fit."""
        ...


class Plain:
    """The bytes of a file as they are; it is open from the first reading until that is finished."""

    def __init__(self, path: Path, source: str) -> None:
        self._path, self._source = path, source
        self._file: BinaryIO | None = None
        self.size = path.stat().st_size

    def read_at(self, start: int, count: int) -> bytes:
        """Return so many bytes from there."""
        if self._file is None:
            self._file = self._path.open("rb")
        self._file.seek(start)
        # Never asks for more than there is: the size may come from a damaged header.
        found = self._file.read(count) if start + count <= self.size else b""
        if len(found) < count:
            raise _cut(self._source)
        return found

    def finish(self) -> None:
        """Close the file: what is not packed has no checksum, and many recordings may be open at once."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self.finish()


class Unpacked:
    """The content of a packed element; it is unpacked, once, as far as it is asked for."""

    def __init__(self, packed: Stored, element: Element, order: Order, source: str) -> None:
        self._packed, self._from, self._until, self._source = packed, element.start, element.end, source
        self._unpacker = zlib.decompressobj()
        self._out: BinaryIO = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # type: ignore[assignment]  # noqa: SIM115
        self._filled = 0
        self.size = 8
        self.size += int.from_bytes(self.read_at(4, 4), order)
        if self.size > _BEST_RATIO * (element.size + 8):
            raise BadData(
                f"{source}: a variable declares {self.size} bytes and {element.size} are there; the file is damaged"
            )

    def read_at(self, start: int, count: int) -> bytes:
        """Return so many bytes from there."""
        if start + count > self.size:
            raise _cut(self._source)
        while self._filled < start + count:
            self._unpack()
        self._out.seek(start)
        return self._out.read(count)

    def finish(self) -> None:
        """Unpack what is left, so that the checksum at the end is held against all that was read."""
        while not self._unpacker.eof:
            self._unpack()
        self._packed.finish()

    def _unpack(self) -> None:
        unpacker = self._unpacker
        given = unpacker.unconsumed_tail
        if not given and self._from < self._until:
            count = min(_PIECE, self._until - self._from)
            given = self._packed.read_at(self._from, count)
            self._from += count
        try:
            found = unpacker.decompress(given, _PIECE)
        except zlib.error:
            raise BadData(
                f"{self._source}: a packed variable must fit its checksum, it does not; copy the file again"
            ) from None
        if not found and (unpacker.eof or not given):
            raise _cut(self._source)
        self._out.seek(self._filled)
        self._out.write(found)
        self._filled += len(found)

    def __del__(self) -> None:
        if hasattr(self, "_out"):
            self._out.close()


def byte_order(head: bytes) -> Order | None:
    """Return the byte order of a file that begins like this, None if it is none of these files."""
    return MAT_ORDERS.get(head[124:128])


def top_elements(stored: Stored, order: Order, warnings: list[str]) -> Iterator[Element]:
    """Yield the elements of a file; a last one that is cut off is left out with a warning."""
    place = _HEADER
    while place < stored.size:
        if place + 8 > stored.size:
            warnings.append(f"the file is cut off at byte {stored.size}; what is not whole is left out")
            return
        element = element_at(stored, place, order)
        if element.kind == PACKED:
            element = Element(element.kind, element.start, element.size, element.start + element.size)
        if element.start + element.size > stored.size:
            warnings.append(f"the file is cut off at byte {stored.size}; the variable at byte {place} is left out")
            return
        yield element
        place = element.end


def element_at(stored: Stored, place: int, order: Order) -> Element:
    """Return what is said by the tag at this place, long or short; the content need not be there."""
    tag = stored.read_at(place, 4)
    first = int.from_bytes(tag, order)
    if first >> 16:
        return Element(first & 0xFFFF, place + 4, first >> 16, place + 8)
    size = int.from_bytes(stored.read_at(place + 4, 4), order)
    return Element(first, place + 8, size, place + 8 + size + -size % 8)


def integers(stored: Stored, element: Element, order: Order, most: int) -> list[int]:
    """Return the few whole numbers of an element of 32 bits each."""
    count = min(element.size // 4, most)
    numbers = np.frombuffer(stored.read_at(element.start, 4 * count), "<i4" if order == "little" else ">i4")
    return [int(number) for number in numbers]


def _cut(source: str) -> BadData:
    return BadData(f"{source}: the MATLAB file ends too early or is damaged; copy it again")

"""A file that lies in memory, whose content is looked at where it is."""

from __future__ import annotations

import io
from typing import Any

import numpy as np


class MemoryFile(io.RawIOBase):
    """A file in one piece of memory; what was never written is zero.

    HDF5's own file in memory (driver `core`) gives its content as a copy only, and grows by copying.

    Parameters
    ----------
    capacity : int
        Bytes it is likely to hold; beyond, it grows by copying.
    """

    def __init__(self, capacity: int) -> None:
        self._memory = np.zeros(max(capacity, 1), np.uint8)
        self._size = self._position = 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        self._position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer as far as there is content."""
        end = max(min(self._position + len(buffer), self._size), self._position)
        count = end - self._position
        buffer[:count] = self._memory[self._position : end].data
        self._position = end
        return count

    def write(self, content: Any) -> int:
        """Write bytes at this place."""
        if not len(content):
            return 0  # nothing written past the end is nothing
        end = self._position + len(content)
        self._require(end)
        self._memory[self._position : end] = np.frombuffer(content, np.uint8)
        self._position, self._size = end, max(self._size, end)
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Make the content so long."""
        size = self._position if size is None else size
        self._require(size)
        self._memory[size : self._size] = 0
        self._size = size
        return size

    def content(self) -> memoryview:
        """Return what it holds, without a copy."""
        return self._memory[: self._size].data

    def _require(self, size: int) -> None:
        if size > self._memory.size:
            grown = np.zeros(max(size, self._memory.size * 5 // 4), np.uint8)
            grown[: self._size] = self._memory[: self._size]
            self._memory = grown

"""Python files that HDF5 writes to: in memory, or on a disk that may be full or broken."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import h5py
import numpy as np

#: Oldest and newest version of the HDF5 file format that is written.
VERSIONS = ("v110", "v110")


class _RawFile(io.RawIOBase):
    """A Python file that HDF5 writes to."""

    def __init__(self) -> None:
        self._size = self._position = 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position."""
        self._position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        return self._position


class MemoryFile(_RawFile):
    """A file in contiguous memory; unwritten bytes are zero.

    HDF5's own file in memory (driver `core`) copies its content to return it and to grow.
    `capacity` is the likely size [bytes]; growing beyond it copies the content.
    """

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self._memory = np.zeros(max(capacity, 1), np.uint8)

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer up to the end of the content."""
        end = max(min(self._position + len(buffer), self._size), self._position)
        count = end - self._position
        buffer[:count] = self._memory[self._position : end].data
        self._position = end
        return count

    def write(self, content: Any) -> int:
        """Write bytes at the position."""
        if not len(content):
            return 0  # an empty write past the end does not extend the file
        end = self._position + len(content)
        self._require(end)
        self._memory[self._position : end] = np.frombuffer(content, np.uint8)
        self._position, self._size = end, max(self._size, end)
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the size."""
        size = self._position if size is None else size
        self._require(size)
        self._memory[size : self._size] = 0
        self._size = size
        return size

    def content(self) -> memoryview:
        """Return the content without a copy."""
        return self._memory[: self._size].data

    def _require(self, size: int) -> None:
        if size > self._memory.size:
            grown = np.zeros(max(size, self._memory.size * 5 // 4), np.uint8)
            grown[: self._size] = self._memory[: self._size]
            self._memory = grown


class DiskFile(_RawFile):
    """A file on disk that never reports a failed write; opens the existing empty file `path`.

    HDF5 cannot handle a failed write: it keeps the unwritten data in its caches, and the interpreter crashes at exit.
    So `failure` keeps the first error of the disk, or the reason for abandoning the file. All later data are kept in
    memory, where they can be read back, until HDF5 has closed the file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._disk = path.open("rb+", buffering=0)
        self._kept: list[tuple[int, bytes]] = []
        self.failure: BaseException | None = None

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer up to the end of the content, including data that the disk did not take."""
        count = max(min(len(buffer), self._size - self._position), 0)
        buffer[:count] = bytes(count)
        try:
            self._disk.seek(self._position)
            content = self._disk.read(count) or b""
            buffer[: len(content)] = content
        except BaseException as error:  # HDF5 cannot handle any error
            self.failure = self.failure or error
        for place, kept in self._kept:
            first, stop = max(place, self._position), min(place + len(kept), self._position + count)
            if first < stop:
                buffer[first - self._position : stop - self._position] = kept[first - place : stop - place]
        self._position += count
        return count

    def write(self, content: Any) -> int:
        """Write all bytes at the position."""
        if self.failure is None:
            try:
                self._disk.seek(self._position)
                left = memoryview(content)
                while left:
                    left = left[self._disk.write(left) :]
            except BaseException as error:
                self.failure = error
        if self.failure is not None:
            self._kept.append((self._position, bytes(content)))
        self._position += len(content)
        self._size = max(self._size, self._position)
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Set the size."""
        self._size = self._position if size is None else size
        if self.failure is None:
            try:
                self._disk.truncate(self._size)
            except BaseException as error:
                self.failure = error
        return self._size

    def close(self) -> None:
        """Close the file; its content is safe on the disk if there is no `failure`."""
        if not self._disk.closed:
            try:
                if self.failure is None:
                    os.fsync(self._disk.fileno())
                self._disk.close()
            except OSError as error:
                self.failure = self.failure or error
        self._kept.clear()
        super().close()


class Hdf5OnDisk:
    """An HDF5 file that is being written to the disk; made by `hdf5_on_disk`."""

    def __init__(self, path: Path) -> None:
        self._disk = DiskFile(path)
        with undisturbed():
            self._file = h5py.File(self._disk, "w", libver=VERSIONS)

    @contextmanager
    def step(self) -> Iterator[h5py.File]:
        """Yield the file for a few calls of h5py, without long work between them.

        Raises `OSError` if the disk has refused data in this or an earlier step; `KeyboardInterrupt` if Ctrl-C was
        pressed.
        """
        with undisturbed():
            yield self._file
        self._require_success()

    def close(self) -> None:
        """Write everything and close the file; raises as `step`."""
        with undisturbed():
            self._file.close()
            self._disk.close()
        self._require_success()

    def abandon(self, reason: BaseException) -> None:
        """Close the file, which will not be used."""
        with undisturbed():
            self._disk.failure = self._disk.failure or reason  # nothing more goes to the disk
            with contextlib.suppress(OSError, RuntimeError):
                self._file.close()
            self._disk.close()

    def _require_success(self) -> None:
        if self._disk.failure is not None:
            raise self._disk.failure


@contextmanager
def hdf5_on_disk(path: Path) -> Iterator[Hdf5OnDisk]:
    """Yield a new HDF5 file in an empty file; it is whole and flushed when this context ends without an error.

    Used within `cgid.files.whole_file`, which names the file in its errors.
    Raises `OSError` if the disk is full or broken.

    Examples
    --------
    >>> import h5py, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "some.h5"
    ...     path.touch()
    ...     with hdf5_on_disk(path) as output, output.step() as file:
    ...         file["numbers"] = [1, 2, 3]
    ...     with h5py.File(path) as file:
    ...         file["numbers"][:].tolist()
    [1, 2, 3]
    """
    output = Hdf5OnDisk(path)
    try:
        yield output
        output.close()
    except BaseException as error:
        output.abandon(error)
        raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C until this context ends: an exception within a callback of HDF5 breaks its file."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    pressed: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        pressed.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pressed:
            signal.raise_signal(signal.SIGINT)

"""HDF5 files written to a disk that may be full or faulty."""

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

from cgid.errors import INTERRUPTIONS

#: Oldest and newest version of the HDF5 file format that is written.
VERSIONS = ("v110", "v110")


class DiskFile(io.RawIOBase):
    """A file on disk that never reports a failed write; opens the existing empty file `path`."""

    # HDF5 cannot handle a failed write: it keeps the unwritten data in its caches, and the interpreter crashes at exit.
    # So `failure` keeps the first error, and all later data stay in memory until HDF5 has closed the file.

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._disk = path.open("rb+", buffering=0)
        self._unwritten: list[tuple[int, bytes]] = []
        self._size = self._position = 0
        self.failure: BaseException | None = None

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position."""
        self._position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        return self._position

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
        for position, unwritten in self._unwritten:
            first, stop = max(position, self._position), min(position + len(unwritten), self._position + count)
            if first < stop:
                buffer[first - self._position : stop - self._position] = unwritten[first - position : stop - position]
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
            self._unwritten.append((self._position, bytes(content)))
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
        """Close the file; its content is on the disk if there is no `failure`."""
        if not self._disk.closed:
            try:
                if self.failure is None:
                    os.fsync(self._disk.fileno())
                self._disk.close()
            except OSError as error:
                self.failure = self.failure or error
        self._unwritten.clear()
        super().close()


class Hdf5OnDisk:
    """An HDF5 file that is being written to the disk; made by `hdf5_on_disk`."""

    def __init__(self, path: Path) -> None:
        self._disk = DiskFile(path)
        with undisturbed():
            self._file = h5py.File(self._disk, "w", libver=VERSIONS)

    @contextmanager
    def step(self) -> Iterator[h5py.File]:
        """Yield the file for a few quick calls of h5py; raises the first error of the disk, or a delayed Ctrl-C."""
        with undisturbed():
            yield self._file
        if self._disk.failure is not None:
            raise self._disk.failure

    def close(self) -> None:
        """Write everything and close the file; raises as `step`."""
        with self.step() as file:
            file.close()
            self._disk.close()

    def abandon(self, reason: BaseException) -> None:
        """Close the file without keeping it."""
        with undisturbed():
            self._disk.failure = self._disk.failure or reason  # nothing more goes to the disk
            with contextlib.suppress(OSError, RuntimeError):
                self._file.close()
            self._disk.close()


@contextmanager
def hdf5_on_disk(path: Path) -> Iterator[Hdf5OnDisk]:
    """Yield a new HDF5 file in the empty file `path`, flushed when this context ends; used within `whole_file`."""
    output = Hdf5OnDisk(path)
    try:
        yield output
        output.close()
    except BaseException as error:
        output.abandon(error)
        raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delay interruptions until this context ends: an exception within a callback of HDF5 breaks its file."""
    handlers = {number: signal.getsignal(number) for number in INTERRUPTIONS}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    if threading.current_thread() is not threading.main_thread() or not handlers:
        yield
        return
    noted: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        noted.append(number)

    for number in handlers:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if noted:
            signal.raise_signal(noted[0])

"""HDF5 written straight to the disk, however full or broken the disk is.

HDF5 cannot bear that a write fails: what it could not put away stays in its caches, and the interpreter crashes when it
ends. Nor may Ctrl-C break into a call of it. So it writes to a file that takes everything: the first failure is
remembered and whatever comes after it is kept in memory, to be read back, until HDF5 has let go; then it is raised.
"""

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
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import h5py


class DiskFile(io.RawIOBase):
    """A file on disk that never refuses.

    Parameters
    ----------
    path : Path
        It exists and is empty.

    Attributes
    ----------
    failure : BaseException or None
        Why the file on disk is not what was written: the first error of the disk, or why it was given up.
    """

    def __init__(self, path: Path) -> None:
        self._disk = path.open("rb+", buffering=0)
        self._size = self._position = 0
        self._kept: list[tuple[int, bytes]] = []
        self.failure: BaseException | None = None

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        self._position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer as far as there is content, with what the disk did not take as well."""
        count = max(min(len(buffer), self._size - self._position), 0)
        buffer[:count] = bytes(count)
        try:
            self._disk.seek(self._position)
            content = self._disk.read(count) or b""
            buffer[: len(content)] = content
        except BaseException as error:  # whatever it is, HDF5 must not see it
            self.failure = self.failure or error
        for place, kept in self._kept:
            first, stop = max(place, self._position), min(place + len(kept), self._position + count)
            if first < stop:
                buffer[first - self._position : stop - self._position] = kept[first - place : stop - place]
        self._position += count
        return count

    def write(self, content: Any) -> int:
        """Write bytes at this place, all of them."""
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
        """Make the content so long."""
        self._size = self._position if size is None else size
        if self.failure is None:
            try:
                self._disk.truncate(self._size)
            except BaseException as error:
                self.failure = error
        return self._size

    def close(self) -> None:
        """Let go of the file; what it holds is safe on the disk if there is no `failure`."""
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
    """An HDF5 file on its way to the disk; made by `hdf5_on_disk`."""

    def __init__(self, path: Path) -> None:
        # Who reads recordings and tables does without.
        import h5py

        self._disk = DiskFile(path)
        with undisturbed():
            self._file = h5py.File(self._disk, "w", libver=("v110", "v110"))

    @contextmanager
    def step(self) -> Iterator[h5py.File]:
        """Yield the file for some calls of h5py, without long work between them.

        Raises
        ------
        OSError
            The disk has refused something, in this step or before.
        KeyboardInterrupt
            Ctrl-C was pressed in the meantime.
        """
        with undisturbed():
            yield self._file
        self._require_success()

    def close(self) -> None:
        """Have everything written, and let go of the file; raises what `step` raises."""
        with undisturbed():
            self._file.close()
            self._disk.close()
        self._require_success()

    def abandon(self, reason: BaseException) -> None:
        """Let go of the file, which nobody wants."""
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
    """Yield a new HDF5 file, whole and flushed to the disk when this context is left without an error.

    For what may be larger than memory; `ShardBuilder` builds in memory, which is quicker. Used within
    `cgid.files.whole_file`, which names the file in its errors.

    Parameters
    ----------
    path : Path
        It exists and is empty.

    Raises
    ------
    OSError
        The disk is full or broken.

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
    """Put off Ctrl-C until this context is left: what is raised within a callback of HDF5 breaks its file."""
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

"""A file that lies in memory, whose content is looked at where it is.

HDF5 written straight to the disk, however full or broken the disk is.

HDF5 cannot bear that a write fails: what it could not put away stays in its caches, and the interpreter crashes when it
ends. Nor may Ctrl-C break into a call of it. So it writes to a file that takes everything: the first failure is
remembered and whatever comes after it is kept in memory, to be read back, until HDF5 has let go; then it is raised.

One shard: an HDF5 file that is a whole dataset by itself.

Every dataset is chunked and carries a checksum (fletcher32), strings are of fixed length, and the file uses the
checksummed headers of HDF5 1.10: a flipped bit is found when it is read.

A long recording with the truth of its impacts: one HDF5 file, written in parts and whole or not at all.

    /samples            (n_samples,), checksummed chunks; attributes sampling_rate, start, unit, quantity
    /impacts/<column>   (n_impacts,), one row for each impact; attribute unit
    root attributes     format, schema_version, n_impacts, and how the recording was made

Unlike a shard, which is built in memory, it is written to the disk as it comes: an hour may be larger than memory.
It lies beside its name until it is finished and flushed, and only then bears it.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import threading
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.counting import count
from cgid.errors import BadData, InvalidValue
from cgid.files import require_room, whole_file
from cgid.signals import Batch
from cgid.store.compression import BY_PLUGIN, deflated, keywords
from cgid.store.description import LARGEST_RECORDING, RECORDING_FORMAT, RECORDING_SCHEMA_VERSION
from cgid.units import quantity_of

if TYPE_CHECKING:
    import h5py


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


#: Bytes of a chunk of signals, about.
_CHUNK_BYTES = 1 << 19
#: Of a chunk of the other columns.
_COLUMN_ROWS = 4096
_CHECKSUM = np.dtype("<u4")
#: Bytes that headers and indices may take before the memory of a shard has to grow.
_MARGIN = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ShardPlan:
    """What all shards of a dataset have in common.

    Attributes
    ----------
    n_samples : int
    dtype : str
        Of the signals.
    label_width : int
        Bytes of the longest label.
    parameter_units : dict
        The stored parameters and their units.
    attributes : dict
        Root attributes: numbers and strings that say how the data was made.
    compression : {"none", "gzip", "zstd", "blosc2"}
    """

    n_samples: int
    dtype: str
    label_width: int
    parameter_units: Mapping[str, str]
    attributes: Mapping[str, Any]
    compression: str = "none"

    def size(self, n_signals: int) -> int:
        """Return what so many signals take before they are packed [bytes]."""
        return n_signals * self.n_samples * np.dtype(self.dtype).itemsize


def lay_out(file: h5py.File, plan: ShardPlan, first: int, n_signals: int) -> h5py.Dataset:
    """Make all datasets of a shard, still empty, with the attributes of its root, and return that of the signals.

    Parameters
    ----------
    file : h5py.File
        A new one, of `libver` v110.
    plan : ShardPlan
    first, n_signals : int
        Number of the first signal, and how many there are.
    """
    for name, value in {**plan.attributes, "first_signal": first}.items():
        file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value

    def create(name: str, tail: tuple[int, ...], dtype: str, chunk_rows: int, **extra: Any) -> h5py.Dataset:
        chunks = (min(chunk_rows, n_signals), *tail)
        return file.create_dataset(name, (n_signals, *tail), dtype, chunks=chunks, fletcher32=True, **extra)

    rows = _chunk_rows(plan, n_signals)
    signals = create("signals", (plan.n_samples,), plan.dtype, rows, **keywords(plan.compression))
    create("labels", (), f"S{plan.label_width}", _COLUMN_ROWS)
    create("specimen", (), "uint64", _COLUMN_ROWS)
    for name, unit in plan.parameter_units.items():
        create(f"parameters/{name}", (), "float64", _COLUMN_ROWS).attrs["unit"] = np.bytes_(unit.encode())
    return signals


def say_kind(signals: h5py.Dataset, batch: Batch) -> None:
    """Attach to stored signals what a batch of them is."""
    signals.attrs["sampling_rate"] = batch.sampling_rate
    signals.attrs["pre_trigger"] = batch.pre_trigger
    signals.attrs["unit"] = np.bytes_(batch.unit.encode())
    signals.attrs["quantity"] = np.bytes_(quantity_of(batch.unit).encode())


def _chunk_rows(plan: ShardPlan, n_signals: int) -> int:
    """Return how many signals a chunk holds."""
    return min(max(1, _CHUNK_BYTES // (plan.n_samples * np.dtype(plan.dtype).itemsize)), n_signals)


class ShardBuilder:
    """A shard in memory, filled batch by batch."""

    def __init__(self, plan: ShardPlan, first: int, n_signals: int) -> None:
        self._plan, self._filled, self._n_signals = plan, 0, n_signals
        self._columns: list[Batch] = []
        row = plan.n_samples * np.dtype(plan.dtype).itemsize
        rows = _chunk_rows(plan, n_signals)
        columns = plan.label_width + 8 * (1 + len(plan.parameter_units))
        self._memory = MemoryFile(n_signals * row + rows * row + (n_signals + _COLUMN_ROWS) * columns + _MARGIN)
        self._file = h5py.File(self._memory, "w", libver=("v110", "v110"))
        # HDF5 writes to the memory when it closes, which must not be left to the end of the interpreter.
        self._close = weakref.finalize(self, self._file.close)
        self._signals = lay_out(self._file, plan, first, n_signals)
        # Room for a chunk as it lies in the file: the signals and their checksum.
        self._chunk = np.zeros(rows * row + _CHECKSUM.itemsize, np.uint8)
        self._chunk_signals = self._chunk[: rows * row].view(plan.dtype).reshape(rows, plan.n_samples)

    def add(self, batch: Batch) -> None:
        """Append the signals of a batch."""
        count("stored_signals", len(batch))
        if self._filled + len(batch) > self._n_signals:
            raise BadData(f"a shard of {self._n_signals} signals was given {self._filled + len(batch)}")
        if not self._filled:
            say_kind(self._signals, batch)
        done, rows = 0, len(self._chunk_signals)
        while done < len(batch):
            place = self._filled % rows
            some = batch.signals[done : done + rows - place]
            self._chunk_signals[place : place + len(some)] = some
            done, self._filled = done + len(some), self._filled + len(some)
            if self._filled % rows == 0 or self._filled == self._n_signals:
                self._write_chunk()
        # The short columns are kept and written once: a call of HDF5 costs more than they are long.
        self._columns.append(replace(batch, signals=np.empty((len(batch), 0))))

    def _write_chunk(self) -> None:
        """Write the chunk that is full, or the last one."""
        rows = len(self._chunk_signals)
        first = (self._filled - 1) // rows * rows
        filled = self._filled - first
        if self._plan.compression in BY_PLUGIN:
            self._signals[first : self._filled] = self._chunk_signals[:filled]  # HDF5 asks its plugin
            self._signals.flush()  # now, so that chunks lie in the order of the signals whatever HDF5 remembers
            return
        self._chunk_signals[filled:] = 0
        packed = self._chunk if self._plan.compression == "none" else self._deflated()
        # numba is not for those who only read datasets.
        from cgid.store._fletcher import fletcher32

        # What HDF5 would write after four copies and a checksum four times slower. An odd byte counts as a high one.
        size = packed.size - _CHECKSUM.itemsize
        words = packed[:size] if size % 2 == 0 else np.append(packed[:size], np.uint8(0))
        packed[size:] = np.frombuffer(np.array(fletcher32(words.view("<u2")), _CHECKSUM), np.uint8)
        self._signals.id.write_direct_chunk((first, 0), packed)

    def _deflated(self) -> NDArray[np.uint8]:
        """Return the chunk packed, with room for the checksum."""
        samples = self._chunk_signals.reshape(-1)
        planes = samples.view(np.uint8).reshape(samples.size, samples.itemsize).T
        return np.frombuffer(bytearray(deflated(np.ascontiguousarray(planes)) + bytes(_CHECKSUM.itemsize)), np.uint8)

    def image(self) -> memoryview:
        """Return the finished file; it lies where it was built."""
        if self._filled != self._n_signals:
            raise BadData(f"a shard of {self._n_signals} signals was given {self._filled}")
        self._write("labels", np.char.encode(np.concatenate([part.labels for part in self._columns]), "utf-8"))
        self._write("specimen", np.concatenate([part.specimen for part in self._columns]))
        for name in self._plan.parameter_units:
            self._write(f"parameters/{name}", np.concatenate([part.parameters[name] for part in self._columns]))
        self._close()
        return self._memory.content()

    def _write(self, name: str, column: NDArray[Any]) -> None:
        dataset = self._file[name]
        dataset[:] = column
        # Its place in the file is that of its turn. HDF5 would give it one when the last that knows the dataset lets go
        # of it, and who looks at frames from another thread, as profilers do, holds on to it a while.
        dataset.flush()


_CHUNK_SAMPLES, _CHUNK_IMPACTS = 1 << 16, 4096


@dataclass(frozen=True, kw_only=True)
class RecordingPlan:
    """What a recording will be.

    Attributes
    ----------
    n_samples : int
    dtype : str
        Of the samples.
    sampling_rate : float
        [Hz].
    unit : str
        Of the samples.
    attributes : dict
        Root attributes: numbers and strings that say how it was made.
    """

    n_samples: int
    dtype: str
    sampling_rate: float
    unit: str
    attributes: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Of the samples [bytes]."""
        return self.n_samples * np.dtype(self.dtype).itemsize

    def require_room(self, folder: Path, n_recordings: int = 1) -> None:
        """Raise `CannotCreate` if the disk has less room than the samples alone will take."""
        require_room(folder, folder, n_recordings * self.size, "samples", "make room, or a shorter recording")


class RecordingWriter:
    """A recording on its way to the disk; see `writing`."""

    def __init__(self, output: Hdf5OnDisk, plan: RecordingPlan) -> None:
        self._output, self._plan, self._filled = output, plan, 0
        stored = {"format": RECORDING_FORMAT, "schema_version": RECORDING_SCHEMA_VERSION, **plan.attributes}
        with output.step() as file:
            for name, value in stored.items():
                file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
            chunks = (min(_CHUNK_SAMPLES, plan.n_samples),)
            samples = file.create_dataset("samples", (plan.n_samples,), plan.dtype, chunks=chunks, fletcher32=True)
            samples.attrs["sampling_rate"] = plan.sampling_rate
            samples.attrs["start"] = 0.0
            samples.attrs["unit"] = np.bytes_(plan.unit.encode())
            samples.attrs["quantity"] = np.bytes_(quantity_of(plan.unit).encode())
        self._samples = samples

    def add(self, samples: NDArray[Any]) -> None:
        """Append samples."""
        behind = self._filled + samples.size
        if behind > self._plan.n_samples:
            raise BadData(f"a recording of {self._plan.n_samples} samples was given {behind}")
        if samples.size:
            with self._output.step():
                self._samples[self._filled : behind] = samples
        self._filled = behind

    def add_impacts(self, impacts: Mapping[str, NDArray[Any]], units: Mapping[str, str]) -> None:
        """Write the truth of all impacts: columns of one length, numbers in `units`, and text."""
        (count,) = {len(column) for column in impacts.values()}
        with self._output.step() as file:
            file.attrs["n_impacts"] = count
            for name, column in impacts.items():
                values = np.char.encode(column, "utf-8") if column.dtype.kind == "U" else column
                # A chunk has a row even where there are no impacts.
                chunks = (min(_CHUNK_IMPACTS, max(count, 1)),)
                stored = file.create_dataset(
                    f"impacts/{name}", (count,), values.dtype, chunks=chunks, maxshape=(None,), fletcher32=True
                )
                stored[:] = values
                stored.attrs["unit"] = np.bytes_(units.get(name, "").encode())

    def require_whole(self) -> None:
        """Raise `BadData` unless all samples have come."""
        if self._filled != self._plan.n_samples:
            raise BadData(f"a recording of {self._plan.n_samples} samples was given {self._filled}")


@contextmanager
def writing(path: str | Path, plan: RecordingPlan, *, overwrite: bool = True) -> Iterator[RecordingWriter]:
    """Yield the writer of a recording that bears its name when this context is left without an error.

    Parameters
    ----------
    path : str or Path
    plan : RecordingPlan
    overwrite : bool
        Whether it may take the place of what bears the name when it is whole.

    Raises
    ------
    InvalidValue
        It would be larger than a recording may be.
    CannotCreate
        The folder is missing or not writable, or the name was taken meanwhile.
    WriteFailed
        The disk is full or broken; what was there before is untouched.
    """
    path = Path(path)
    if plan.size > LARGEST_RECORDING:
        raise InvalidValue(
            f"{path}: a recording must be at most {LARGEST_RECORDING / 2**30:g} GiB of samples, "
            f"{plan.n_samples} of {plan.dtype} make {plan.size / 2**30:.3g} GiB; make several"
        )
    with whole_file(path, overwrite=overwrite) as temporary, hdf5_on_disk(temporary) as output:
        writer = RecordingWriter(output, plan)
        yield writer
        writer.require_whole()

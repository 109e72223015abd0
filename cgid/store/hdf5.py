"""Writing HDF5: the shards of datasets, recordings, and the columns of tables.

Every dataset is chunked and has a checksum (fletcher32), strings have a fixed length, and files use HDF5 1.10's
checksummed headers. So reading detects any flipped bit.

    dataset     /signals (n_signals, n_samples); /labels, /specimen and /parameters/<name>, one value per signal
    recording   /samples (n_samples,); /impacts/<column>, one row per impact
    table       /labels, /specimen and /columns/<name>, one value per row

Datasets name their axes as netCDF-4 does: /signal (numbers of the signals) and /time [s] from the first sample are
dimension scales of all that is above, so xarray (engine h5netcdf) opens a shard with dimensions and coordinates.

A shard is built in memory, which is faster. Recordings and tables may exceed memory and are written to the disk
directly (`hdf5_on_disk`). Nothing is compressed: noise does not shrink. `python benchmarks/speed/store.py` measures the
speed.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid._lib.files import whole_file
from cgid.errors import BadData, InvalidValue
from cgid.signals import Batch
from cgid.store.description import MAX_RECORDING, RECORDING_FORMAT, RECORDING_SCHEMA_VERSION
from cgid.store.disk import VERSIONS, Hdf5OnDisk, hdf5_on_disk, undisturbed
from cgid.units import quantity_of

#: Approximate size of a chunk of signals [bytes]; rows in a chunk of other columns; samples in a chunk of a recording.
_CHUNK_BYTES, CHUNK_ROWS, _CHUNK_SAMPLES = 1 << 19, 4096, 1 << 16
#: Size of the checksum of a chunk, and room for all but the signals of a shard [bytes].
_CHECKSUM, _ABOUT = 4, 1 << 20


# ---- common to all files --------------------------------------------------------------------------------------------


def put_attributes(item: h5py.HLObject, values: Mapping[str, Any]) -> None:
    """Write attributes; text has a fixed length."""
    for name, value in values.items():
        item.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value


def put_column(
    group: h5py.Group,
    name: str,
    length: int,
    dtype: Any,
    unit: str | None = None,
    *,
    chunk: int | None = None,
    grows: bool = False,
) -> h5py.Dataset:
    """Create a column with one value per row, and with the attribute `unit` unless that is None."""
    chunks = (chunk or min(CHUNK_ROWS, max(length, 1)),)  # HDF5 does not allow empty chunks
    maxshape = (None,) if grows else None
    column = group.create_dataset(name, (length,), dtype, chunks=chunks, maxshape=maxshape, fletcher32=True)
    if unit is not None:
        put_attributes(column, {"unit": unit})
    return column


# ---- shards ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ShardPlan:
    """The data common to all shards of a dataset; `label_width` is in bytes."""

    n_samples: int
    dtype: str
    label_width: int
    parameter_units: Mapping[str, str]
    attributes: Mapping[str, Any]

    def size(self, n_signals: int) -> int:
        """Return the size of this many signals [bytes]."""
        return n_signals * self.n_samples * np.dtype(self.dtype).itemsize


def lay_out(file: h5py.File, plan: ShardPlan, first: int, n_signals: int) -> h5py.Dataset:
    """Create attributes and empty datasets of a shard in a new file; return the dataset of the signals."""
    put_attributes(file, {**plan.attributes, "first_signal": first})
    shape = (n_signals, plan.n_samples)
    chunks = (_chunk_rows(plan, n_signals), plan.n_samples)
    signals = file.create_dataset("signals", shape, plan.dtype, chunks=chunks, fletcher32=True)
    put_column(file, "labels", n_signals, f"S{plan.label_width}")
    put_column(file, "specimen", n_signals, "uint64")
    for name, unit in plan.parameter_units.items():
        put_column(file, f"parameters/{name}", n_signals, "float64", unit)
    numbers = put_column(file, "signal", n_signals, "int64")
    numbers[:] = np.arange(first, first + n_signals)
    for order, scale in enumerate((numbers, put_column(file, "time", plan.n_samples, "float64", "s"))):
        name = scale.name[1:]
        scale.make_scale(name)
        scale.attrs["_Netcdf4Dimid"] = np.int32(order)
        scale.flush()  # see `ShardBuilder.image`
        signals.dims[order].attach_scale(scale)
    for name in ("labels", "specimen", *(f"parameters/{name}" for name in plan.parameter_units)):
        file[name].dims[0].attach_scale(numbers)
    return signals


def say_kind(signals: h5py.Dataset, batch: Batch) -> None:
    """Write sampling rate, pre-trigger, unit and quantity of signals as their attributes, and the time of samples."""
    put_attributes(
        signals,
        {
            "sampling_rate": batch.sampling_rate,
            "pre_trigger": batch.pre_trigger,
            "unit": batch.unit,
            "quantity": quantity_of(batch.unit),
        },
    )
    times = signals.file["time"]
    times[:] = np.arange(len(times)) / batch.sampling_rate
    times.flush()


def _chunk_rows(plan: ShardPlan, n_signals: int) -> int:
    """Return the number of signals in a chunk."""
    return min(max(1, _CHUNK_BYTES // (plan.n_samples * np.dtype(plan.dtype).itemsize)), n_signals)


class ShardMemory:
    """A file in memory for one shard after the other: fresh memory takes longer than what is written there."""

    def __init__(self) -> None:
        self._buffer, self._size, self._at = np.empty(0, np.uint8), 0, 0

    def clear(self, room: int) -> None:
        """Forget the content, and make room for some bytes."""
        self._size = self._at = 0
        if self._buffer.size < room:
            self._buffer = np.empty(room, np.uint8)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to an offset from the start, from here or from the end."""
        self._at = (0, self._at, self._size)[whence] + offset
        return self._at

    def tell(self) -> int:
        """Return the offset."""
        return self._at

    def readinto(self, target: Any) -> int:
        """Read what fits into the target."""
        part = self._buffer[self._at : min(self._at + len(target), self._size)]
        target[: part.size] = part.data
        self._at += part.size
        return int(part.size)

    read = readinto  # h5py looks for it, and calls the other

    def write(self, content: Any) -> int:
        """Write bytes here; what was skipped is 0."""
        end = self._at + len(content)
        if end > self._buffer.size:
            self._buffer = np.append(self._buffer, np.empty(max(end // 2, end - self._buffer.size), np.uint8))
        self._buffer[self._size : self._at] = 0
        self._buffer[self._at : end] = np.frombuffer(content, np.uint8)
        self._at, self._size = end, max(self._size, end) if len(content) else self._size
        return len(content)

    def truncate(self, size: int) -> int:
        """Cut the content off."""
        self._size = min(self._size, size)
        return self._size

    def flush(self) -> None:
        """Do nothing."""

    def getbuffer(self) -> memoryview:
        """Return the content, without a copy."""
        return self._buffer[: self._size].data


class ShardBuilder:
    """A shard in memory, filled batch by batch."""

    def __init__(self, plan: ShardPlan, first: int, n_signals: int, memory: ShardMemory | None = None) -> None:
        self._plan, self._filled, self._n_signals = plan, 0, n_signals
        self._columns: list[Batch] = []
        row = plan.size(1)
        rows = _chunk_rows(plan, n_signals)
        self._memory = memory or ShardMemory()
        self._memory.clear(plan.size(n_signals) + _ABOUT)
        with undisturbed():
            self._file = h5py.File(self._memory, "w", libver=VERSIONS)
            # HDF5 writes to the memory on closing, which must not wait until the interpreter exits.
            self._close = weakref.finalize(self, self._file.close)
            self._signals = lay_out(self._file, plan, first, n_signals)
        # Room for a stored chunk: the signals and their checksum.
        self._chunk = np.zeros(rows * row + _CHECKSUM, np.uint8)
        self._chunk_signals = self._chunk[: rows * row].view(plan.dtype).reshape(rows, plan.n_samples)

    def add(self, batch: Batch) -> None:
        """Append the signals of a batch."""
        if self._filled + len(batch) > self._n_signals:
            raise BadData(f"a shard of {self._n_signals} signals received {self._filled + len(batch)}")
        if not self._filled:
            with undisturbed():
                say_kind(self._signals, batch)
        done, rows = 0, len(self._chunk_signals)
        while done < len(batch):
            start = self._filled % rows
            some = batch.signals[done : done + rows - start]
            self._chunk_signals[start : start + len(some)] = some
            done, self._filled = done + len(some), self._filled + len(some)
            if self._filled % rows == 0 or self._filled == self._n_signals:
                self._write_chunk()
        # Keep the short columns to write them once: a call of HDF5 takes longer than the writing itself.
        self._columns.append(replace(batch, signals=np.empty((len(batch), 0)), pre_trigger=0))

    def _write_chunk(self) -> None:
        """Write the full or the last chunk."""
        rows = len(self._chunk_signals)
        first = (self._filled - 1) // rows * rows
        # Reading datasets does not need numba.
        from cgid.store._packing import close_chunk

        self._chunk_signals[self._filled - first :] = 0
        close_chunk(self._chunk)
        with undisturbed():
            self._signals.id.write_direct_chunk((first, 0), self._chunk)

    def image(self) -> memoryview:
        """Return the content of the finished file, without a copy."""
        if self._filled != self._n_signals:
            raise BadData(f"a shard of {self._n_signals} signals received {self._filled}")
        columns: dict[str, list[Any]] = {
            "labels": [np.char.encode(part.labels, "utf-8") for part in self._columns],
            "specimen": [part.specimen for part in self._columns],
        }
        for name in self._plan.parameter_units:
            columns[f"parameters/{name}"] = [part.parameters[name] for part in self._columns]
        with undisturbed():
            for name, parts in columns.items():
                dataset = self._file[name]
                dataset[:] = np.concatenate(parts)
                # Flush now to fix the dataset's position in the file. Otherwise HDF5 assigns it when the last reference
                # to the dataset is dropped, which a thread that inspects frames, such as a profiler, may delay.
                dataset.flush()
            self._close()
        return self._memory.getbuffer()


# ---- recordings ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RecordingPlan:
    """The description of a recording; `attributes` describe how it was made."""

    n_samples: int
    dtype: str
    sampling_rate: float
    unit: str
    attributes: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Size of the samples [bytes]."""
        return self.n_samples * np.dtype(self.dtype).itemsize


class RecordingWriter:
    """A recording that is being written; see `writing`."""

    def __init__(self, output: Hdf5OnDisk, plan: RecordingPlan) -> None:
        self._output, self._plan, self.filled = output, plan, 0
        with output.step() as file:
            head = {"format": RECORDING_FORMAT, "schema_version": RECORDING_SCHEMA_VERSION}
            put_attributes(file, {**head, **plan.attributes})
            chunks = (min(_CHUNK_SAMPLES, plan.n_samples),)
            self._samples = file.create_dataset(
                "samples", (plan.n_samples,), plan.dtype, chunks=chunks, fletcher32=True
            )
            about = {"sampling_rate": plan.sampling_rate, "start": 0.0, "unit": plan.unit}
            put_attributes(self._samples, {**about, "quantity": quantity_of(plan.unit)})

    def add(self, samples: NDArray[Any]) -> None:
        """Append samples."""
        first, self.filled = self.filled, self.filled + samples.size
        self.require(self.filled <= self._plan.n_samples)
        if samples.size:
            with self._output.step():
                self._samples[first : self.filled] = samples

    def add_impacts(self, impacts: Mapping[str, NDArray[Any]], units: Mapping[str, str]) -> None:
        """Write the truth of all impacts: columns of one length, numbers in `units`, and text."""
        (n_impacts,) = {len(column) for column in impacts.values()}
        with self._output.step() as file:
            file.attrs["n_impacts"] = n_impacts
            for name, column in impacts.items():
                values = np.char.encode(column, "utf-8") if column.dtype.kind == "U" else column
                stored = put_column(file, f"impacts/{name}", n_impacts, values.dtype, grows=True)
                stored[:] = values
                put_attributes(stored, {"unit": units.get(name, "")})

    def require(self, sound: bool) -> None:
        """Raise `BadData` unless the number of samples is sound."""
        if not sound:
            raise BadData(f"a recording of {self._plan.n_samples} samples received {self.filled}")


@contextmanager
def writing(path: str | Path, plan: RecordingPlan, *, overwrite: bool = True) -> Iterator[RecordingWriter]:
    """Yield the writer of a recording; the file appears under its name if this context ends without an error."""
    path = Path(path)
    if plan.size > MAX_RECORDING:
        raise InvalidValue(
            f"{path}: a recording must be at most {MAX_RECORDING / 2**30:g} GiB of samples, "
            f"{plan.n_samples} of {plan.dtype} make {plan.size / 2**30:.3g} GiB; make several"
        )
    with whole_file(path, overwrite=overwrite) as temporary, hdf5_on_disk(temporary) as output:
        writer = RecordingWriter(output, plan)
        yield writer
        writer.require(writer.filled == plan.n_samples)

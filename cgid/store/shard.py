"""One shard: an HDF5 file that is a whole dataset by itself.

Every dataset is chunked and carries a checksum (fletcher32), strings are of fixed length, and the file uses the
checksummed headers of HDF5 1.10: a flipped bit is found when it is read.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.counting import count
from cgid.errors import BadData
from cgid.signals import Batch
from cgid.store.compression import BY_PLUGIN, keywords
from cgid.store.deflate import deflated
from cgid.store.memory import MemoryFile
from cgid.units import quantity_of

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

"""A long recording with the truth of its impacts: one HDF5 file, written in parts and whole or not at all.

    /samples            (n_samples,), checksummed chunks; attributes sampling_rate, start, unit, quantity
    /impacts/<column>   (n_impacts,), one row for each impact; attribute unit
    root attributes     format, schema_version, n_impacts, and how the recording was made

Unlike a shard, which is built in memory, it is written to the disk as it comes: an hour may be larger than memory.
It lies beside its name until it is finished and flushed, and only then bears it.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue, NoInput
from cgid.files import half_written, require_room, whole_file
from cgid.signals import Signal
from cgid.store import apart
from cgid.store.disk import Hdf5OnDisk, hdf5_on_disk
from cgid.store.header import LARGEST_SHARD, RECORDING_FORMAT, RECORDING_SCHEMA_VERSION, text_of
from cgid.store.identity import Identity
from cgid.units import quantity_of

#: No longer recording is made.
LARGEST_RECORDING = LARGEST_SHARD
#: What a folder of recordings holds, with what a killed run leaves behind.
RECORDING_NAME = r"recording-[0-9]{5,}\.h5"
OURS = re.compile(f"{RECORDING_NAME}|{half_written(RECORDING_NAME)}")
_CHUNK_SAMPLES, _CHUNK_IMPACTS = 1 << 16, 4096
#: Samples, and impacts, that are read at once.
_BLOCK, _ROWS = 1 << 20, 1 << 16


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


def is_recording(path: str | Path) -> bool:
    """Return whether this is an HDF5 file that says it is a recording; False for what cannot be read."""
    return apart.format_said(Path(path)) == RECORDING_FORMAT


class Recording:
    """A recording on disk, with the truth of its impacts.

    Parameters
    ----------
    path : str or Path

    Attributes
    ----------
    n_samples : int
    dtype : str
        Of the samples.
    n_impacts : int
    sampling_rate : float
        [Hz].
    start : float
        Time of the first sample [s]; times of impacts count from the first sample.
    unit : str
        Of the samples.
    impact_units : dict of str
        The columns of the truth and their units, "" for text.
    attributes : dict
        How it was made.

    Raises
    ------
    NoInput
        There is nothing.
    BadData
        It is no recording, or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise NoInput(f"{path}: no such file; give a recording made by cgid generate")
        self._identity = Identity(self.path)
        about = apart.call("recording_header", self.path)
        self.attributes: dict[str, Any] = about["attributes"]
        self.n_samples: int = about["n_samples"]
        self.dtype: str = about["dtype"]
        self.n_impacts: int = about["n_impacts"]
        self.sampling_rate: float = about["sampling_rate"]
        self.start: float = about["start"]
        self.unit: str = about["unit"]
        self.impact_units: dict[str, str] = about["impact_units"]

    def samples(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples from number `first` up to, without, `stop`.

        Raises
        ------
        InvalidValue
            The range is not one of the recording.
        BadData
            A checksum does not fit: the file is damaged. Or another has its name by now.
        """
        stop = self._checked_stop(first, stop)
        found = np.empty(stop - first, self.dtype)
        place = 0
        for block in self.blocks(_BLOCK, first, stop):
            found[place : place + block.size] = block
            place += block.size
        return found

    def blocks(self, length: int, first: int = 0, stop: int | None = None) -> Generator[NDArray[Any], None, None]:
        """Yield samples in order, at most `length` at once; `first`, `stop` and errors as those of `samples`."""
        last = self._checked_stop(first, stop)
        size = np.dtype(self.dtype).itemsize * length
        largest = max(apart.LARGEST_ANSWER, size)
        with closing(apart.stream("rows", self.path, ["samples"], first, last, length, largest=largest)) as parts:
            for number, part in enumerate(parts):
                if not number:  # the file is open by now, and stays the one it is
                    self._identity.require()
                yield part["samples"]

    def _checked_stop(self, first: int, stop: int | None) -> int:
        stop = self.n_samples if stop is None else stop
        if not 0 <= first <= stop <= self.n_samples:
            raise InvalidValue(
                f"{self.path}: samples must be asked for between 0 and {self.n_samples}, got {first} to {stop}"
            )
        return stop

    def impacts(self) -> dict[str, NDArray[Any]]:
        """Return the truth of all impacts, one column for each of `impact_units`; raises `BadData` where damaged."""
        names = {name: f"impacts/{name}" for name in self.impact_units}
        found = list(apart.stream("rows", self.path, list(names.values()), 0, self.n_impacts, _ROWS))
        self._identity.require()
        columns = {name: np.concatenate([part[stored] for part in found]) for name, stored in names.items()}
        return {name: text_of(column) if column.dtype.kind == "S" else column for name, column in columns.items()}

    def signal(self) -> Signal:
        """Return the whole recording as a signal."""
        return Signal(samples=self.samples(), sampling_rate=self.sampling_rate, unit=self.unit, source=str(self.path))

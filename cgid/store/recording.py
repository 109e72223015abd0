"""A long recording with the truth of its impacts: one HDF5 file, written in parts and whole or not at all.

    /samples            (n_samples,), checksummed chunks; attributes sampling_rate, start, unit, quantity
    /impacts/<column>   (n_impacts,), one row for each impact; attribute unit
    root attributes     format, schema_version, n_impacts, and how the recording was made

Unlike a shard, which is built in memory, it is written to the disk as it comes: an hour may be larger than memory.
It lies beside its name until it is finished and flushed, and only then bears it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CannotCreate, InvalidValue, NoInput
from cgid.files import whole_file
from cgid.signals import UNITS, Signal, quantity_of
from cgid.store.dataset import opened
from cgid.store.disk import Hdf5OnDisk, hdf5_on_disk
from cgid.store.header import LARGEST_SHARD, attributes_of, is_inside, plain_dataset, require_scene, text_of

RECORDING_FORMAT = "cgid-recording"
RECORDING_SCHEMA_VERSION = 1
#: A file of more samples is not read back: a recording is analysed in memory.
LARGEST_RECORDING = LARGEST_SHARD
#: What a folder of recordings holds, with what a killed run leaves behind.
RECORDING_NAME = r"recording-[0-9]{5,}\.h5"
OURS = re.compile(rf"{RECORDING_NAME}|\.{RECORDING_NAME}\.[0-9a-f]+\.part")
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
        free, needed = shutil.disk_usage(folder).free, n_recordings * self.size
        if needed > free:
            raise CannotCreate(
                f"{folder}: the disk must have room for {needed / 1e9:.3g} GB of samples, {free / 1e9:.3g} GB are "
                "free; make room, or a shorter recording"
            )


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
    try:
        with h5py.File(path, "r") as file:
            return attributes_of(file).get("format") == RECORDING_FORMAT
    except (OSError, RuntimeError, LookupError, ValueError, TypeError):
        return False


class Recording:
    """A recording on disk, with the truth of its impacts.

    Parameters
    ----------
    path : str or Path

    Attributes
    ----------
    n_samples : int
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
        with opened(self.path) as file:
            self._read_header(file)

    def _read_header(self, file: h5py.File) -> None:
        path = str(self.path)
        self.attributes = attributes_of(file)
        if self.attributes.get("format") != RECORDING_FORMAT:
            raise BadData(
                f"{path}: this HDF5 file must be a cgid recording (attribute format = {RECORDING_FORMAT!r}); it is not"
            )
        version = self.attributes.get("schema_version")
        if version != RECORDING_SCHEMA_VERSION:
            raise BadData(
                f"{path}: schema_version must be {RECORDING_SCHEMA_VERSION}, got {version}: use the cgid that wrote it"
            )
        require_scene(self.attributes, path)
        samples = plain_dataset(file, "samples", path)
        if samples.ndim != 1 or samples.dtype not in (np.float32, np.float64) or not samples.size:
            raise BadData(f"{path}: samples must be a row of floats, got shape {samples.shape} of {samples.dtype}")
        about = attributes_of(samples)
        rate, start, unit = about.get("sampling_rate"), about.get("start"), about.get("unit")
        for name, value, holds in (
            ("sampling_rate", rate, isinstance(rate, float) and 0 < rate < np.inf),
            ("start", start, isinstance(start, float) and np.isfinite(start)),
            ("unit", unit, any(unit in units for units in UNITS.values())),
        ):
            if not holds:
                raise BadData(f"{path}: samples must have a sound attribute {name}, got {value!r}")
        self.n_samples: int = samples.size
        self.sampling_rate: float = about["sampling_rate"]
        self.start: float = about["start"]
        self.unit: str = about["unit"]
        self.n_impacts, self.impact_units = self._read_columns(file, path)

    def _read_columns(self, file: h5py.File, path: str) -> tuple[int, dict[str, str]]:
        if not is_inside(file, "impacts") or not isinstance(file["impacts"], h5py.Group):
            raise BadData(f"{path}: impacts must be a group of the file itself; it is missing or a link")
        count = self.attributes.get("n_impacts")
        units = {}
        for name in file["impacts"]:
            column = plain_dataset(file, f"impacts/{name}", path)
            if column.shape != (count,) or column.dtype.kind not in "fiuS":
                raise BadData(f"{path}: impacts/{name} must be one value an impact, got shape {column.shape}")
            units[name] = str(attributes_of(column).get("unit", ""))
        if type(count) is not int or "time" not in units:
            raise BadData(f"{path}: impacts must have a column time and their number in n_impacts; generate it again")
        return count, units

    def samples(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples from number `first` up to, without, `stop`.

        Raises
        ------
        InvalidValue
            The range is not one of the recording.
        BadData
            A checksum does not fit: the file is damaged.
        """
        stop = self.n_samples if stop is None else stop
        if not 0 <= first <= stop <= self.n_samples:
            raise InvalidValue(
                f"{self.path}: samples must be asked for between 0 and {self.n_samples}, got {first} to {stop}"
            )
        return self._read("samples", slice(first, stop))

    def impacts(self) -> dict[str, NDArray[Any]]:
        """Return the truth of all impacts, one column for each of `impact_units`; raises `BadData` where damaged."""
        found = {name: self._read(f"impacts/{name}", slice(None)) for name in self.impact_units}
        return {name: text_of(column) if column.dtype.kind == "S" else column for name, column in found.items()}

    def signal(self) -> Signal:
        """Return the whole recording as a signal."""
        return Signal(samples=self.samples(), sampling_rate=self.sampling_rate, unit=self.unit, source=str(self.path))

    def _read(self, name: str, rows: slice) -> NDArray[Any]:
        with opened(self.path) as file:
            try:
                found: NDArray[Any] = file[name][rows]
            except OSError:
                raise BadData(
                    f"{self.path}: {name} must fit its checksums, it does not: the file is damaged; generate it again"
                ) from None
        return found

"""Reading datasets and recordings."""

from __future__ import annotations

import hashlib
import os
from bisect import bisect_right
from collections.abc import Generator, Iterator
from contextlib import closing
from functools import cached_property
from itertools import accumulate, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.notebook import facts_table
from cgid._lib.terminal import counted
from cgid.errors import BadData, InvalidValue, NoInput
from cgid.signals import Batch, Signal
from cgid.store.description import DIGEST, FORMAT, RECORDING_FORMAT, ShardHeader, hdf5_format, text_of
from cgid.store.folder import LINKED, SUMS, Folder, read_folder
from cgid.store.gates import Identity, identity_of, opened
from cgid.store.headers import recording_header, rows, shard_header
from cgid.units import quantity_of

if TYPE_CHECKING:
    import pandas

#: Maximum number of signals read at once, and their largest size [bytes].
_ROWS, _MAX_BATCH = 1024, 32 << 20
#: Samples and impacts of a recording read at once.
_BLOCK, _IMPACTS = 1 << 20, 1 << 16
#: What all shards of a dataset have in common.
_COMMON = ("n_samples", "dtype", "sampling_rate", "pre_trigger", "unit", "parameter_units", "label_width")


def state_of(path: Path, sha256: str | None = None) -> Identity:
    """Return the state of a file; raises `BadData` if it has another SHA-256 than is listed."""
    try:
        if not path.is_file():
            raise BadData(f"{path}: must be a regular file; copy it to one first")
        with path.open("rb") as stream:
            state = identity_of(os.fstat(stream.fileno()))
            if sha256 is not None and hashlib.file_digest(stream, "sha256").hexdigest() != sha256:
                raise BadData(
                    f"{path}: must match the SHA-256 in {SUMS}, it is damaged or another file; see cgid verify"
                )
            return state
    except PermissionError as error:
        raise NoInput(f"{path}: cannot be read ({error.strerror}); see to its permissions") from None
    except OSError as error:
        raise BadData(f"{path}: cannot be accessed ({error.strerror}); read it again") from None


def require_own(path: Path, folder: Folder, number: int, about: dict[str, Any]) -> None:
    """Raise `BadData` unless a file with these attributes, and `n_signals`, is that of this number in a folder."""
    if about.get(DIGEST) != folder.description.sha256:
        attributes = folder.description.content["attributes"]
        name = next((name for name in attributes if attributes[name] != about.get(name)), "description")
        values = [f"{attributes_of.get(name, 'another')!s:.80}" for attributes_of in (attributes, about)]
        raise BadData(
            f"{path}: {name} must be that of its folder, {values[0]}, got {values[1]}: the file belongs to another "
            "description, or a run that replaces it is not finished; continue with cgid generate ... --resume, or "
            "restore the right file"
        )
    for name, value in folder.description.part(number).items():
        if about.get(name) != value:
            raise BadData(
                f"{path}: {name} must be {value}, got {about.get(name)!s:.80}: it is another file of the folder"
            )


class Dataset:
    """A dataset on disk: a file or a folder of shards.

    The SHA-256 of a shard is checked when the shard is first read.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    NoInput
        The path does not exist.
    BadData
        It is not a dataset, is unfinished or damaged, or its shards do not fit the description.
    """

    #: The header of the first shard; the others differ from it only in the number of signals.
    header: ShardHeader

    def __init__(self, path: str | Path) -> None:
        validation.instance("path", path, str, os.PathLike)
        self.path = Path(path)
        try:
            is_there = self.path.exists()
        except OSError as error:
            raise NoInput(f"{path}: cannot be accessed ({error.strerror}); check the name") from None
        if not is_there:
            raise NoInput(f"{path}: no such file or folder; give a dataset made by cgid generate")
        self._folder: Folder | None = None
        self._shards, self._states = [self.path], dict[int, Identity]()
        if not self.path.is_dir():
            self._state(0)
            self._counts = [self.header.n_signals]
            return
        folder = self._folder = read_folder(self.path)
        if folder.description.kind != FORMAT:
            raise BadData(f"{path}: must be a dataset, it is a folder of {folder.description.noun}; give one of them")
        self._shards = [self.path / name for name in _complete(folder)]
        self._counts = [folder.description.part(number)["n_signals"] for number in range(len(self._shards))]
        # Without a sum only the header shows whether a shard belongs to the dataset.
        for number in [0, *(number for number, shard in enumerate(self._shards) if shard.name not in folder.sums)]:
            self._state(number)

    def _state(self, number: int) -> Identity:
        """Return the state of a shard, whose sum and header are checked when it is first requested."""
        if number in self._states:
            return self._states[number]
        shard, folder = self._shards[number], self._folder
        if folder is not None and shard.is_symlink():
            raise BadData(f"{shard}: {LINKED}")
        state = state_of(shard) if folder is None else state_of(shard, folder.sums.get(shard.name))
        with opened(shard, str(shard), state) as file:
            header = shard_header(file, str(shard))
        if not self._states:
            self.header = header
        if folder is not None:
            require_own(shard, folder, number, {"first_signal": 0, **header.attributes, "n_signals": header.n_signals})
        for name in _COMMON:
            got, expected = getattr(header, name), getattr(self.header, name)
            if got != expected:
                raise BadData(f"{shard}: {name} must be that of the other shards, {expected}, got {got}")
        self._states[number] = state
        return state

    def __len__(self) -> int:
        return sum(self._counts)

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.path)!r}: {counted(len(self), 'signal')} of {self.header.n_samples} samples at "
            f"{self.sampling_rate:g} Hz [{self.unit}])"
        )

    ndim = 2

    @property
    def shape(self) -> tuple[int, int]:
        """Number of signals, and of samples of each."""
        return len(self), self.header.n_samples

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the samples."""
        return np.dtype(self.header.dtype)

    def __getitem__(self, index: Any) -> Any:
        """Return one signal, of a negative index from the end; of a slice or list samples of signals, as an array."""
        picked, *samples = index if isinstance(index, tuple) else (index,)
        if isinstance(picked, list | np.ndarray) and np.ndim(picked) == 1:
            numbers = np.arange(len(self))[picked].tolist()
            return np.array([self.signal(number).samples for number in numbers] or self[:0])[:, *samples]
        if not isinstance(picked, slice):
            return self.signal(picked).samples[samples[0]] if samples else self.signal(picked)
        numbers, parts, begin = range(len(self))[picked], [np.empty((0, self.shape[1]), self.dtype)], 0
        first, stop = (min(numbers), max(numbers) + 1) if numbers else (0, 0)
        for shard, count in enumerate(self._counts):
            low, high = max(first - begin, 0), min(stop - begin, count)
            parts += [batch.signals for batch in self._read(shard, low, high, None)] if low < high else []
            begin += count
        return np.concatenate(parts)[[number - first for number in numbers]][:, *samples]

    def _repr_html_(self) -> str:
        header = self.header
        facts = {
            "signals": f"{len(self)} of {header.n_samples} samples at {self.sampling_rate:g} Hz [{self.unit}]",
            "parameters": ", ".join(f"{name} [{unit}]" for name, unit in header.parameter_units.items()) or "none",
        }
        return facts_table(f"Dataset {self.path.name}", facts)

    def plot(self, n: int = 20, axes: Any = None) -> Any:
        """Draw the first signals of each label over time.

        Parameters
        ----------
        n : int
            Number of signals of each label, at most 200; fewer of a label that is rare at the beginning of the dataset.
        axes : matplotlib.axes.Axes, optional
            New ones by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        MissingExtra
            matplotlib is not installed.
        """
        from cgid.plots.objects import plot_batches

        return plot_batches(islice(self.batches(), 4), n, self.path.name, axes)

    @cached_property
    def parameters(self) -> pandas.DataFrame:
        """Label, specimen and stored parameters of each signal, one row a signal; `attrs["units"]` has the units."""
        import pandas as pd

        units = dict(self.header.parameter_units)
        stored = {"label": "labels", "specimen": "specimen", **{name: f"parameters/{name}" for name in units}}
        parts = []
        for number, count in enumerate(self._counts):
            state = self._state(number)
            with closing(rows(self._shards[number], list(stored.values()), 0, count, _IMPACTS, state)) as read:
                parts += list(read)
        columns = {name: np.concatenate([part[column] for part in parts]) for name, column in stored.items()}
        table = pd.DataFrame(columns | {"label": text_of(columns["label"]).astype(object)})
        table.attrs["units"] = units
        return table

    @property
    def sampling_rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.header.sampling_rate

    @property
    def unit(self) -> str:
        """Unit of the signals."""
        return self.header.unit

    @property
    def quantity(self) -> str:
        """Quantity of the signals."""
        return quantity_of(self.header.unit)

    @property
    def pre_trigger(self) -> int:
        """Samples before onset."""
        return self.header.pre_trigger

    @property
    def source(self) -> str:
        """SHA-256 of the scene of the signals; empty if they were not made from one."""
        return str(self.header.attributes.get("scene_sha256", ""))

    def __iter__(self) -> Iterator[Signal]:
        """Yield the signals in order, as by index; `batches` reads their labels, too."""
        rows = (row for batch in self.batches() for row in batch.signals)
        return (self._named(row, index) for index, row in enumerate(rows))

    def batches(self, n_rows: int | None = None) -> Iterator[Batch]:
        """Yield the signals in order.

        Parameters
        ----------
        n_rows : int, optional
            Maximum number of signals in a batch; by default 1024, fewer for long signals.

        Raises
        ------
        BadData
            A shard has another SHA-256 or a wrong checksum, another file has its name, or a label breaks the rule of
            `cgid._lib.validation.label`.
        InvalidValue
            `n_rows` is not a whole number of 1 or more.
        """
        if n_rows is not None:
            validation.count("n_rows", n_rows)
        return (part for number, count in enumerate(self._counts) for part in self._read(number, 0, count, n_rows))

    def _read(self, number: int, first: int, stop: int, n_rows: int | None) -> Iterator[Batch]:
        state = self._state(number)
        row = self.header.n_samples * np.dtype(self.header.dtype).itemsize
        length = n_rows or max(1, min(_ROWS, _MAX_BATCH // row))
        names = ["signals", "labels", "specimen", *(f"parameters/{name}" for name in self.header.parameter_units)]
        with closing(rows(self._shards[number], names, first, stop, length, state)) as parts:
            for part in parts:
                yield self._batch(part)

    def _batch(self, part: dict[str, NDArray[Any]]) -> Batch:
        try:
            batch = Batch(
                signals=part["signals"],
                labels=text_of(part["labels"]),
                sampling_rate=self.sampling_rate,
                unit=self.unit,
                pre_trigger=self.pre_trigger,
                specimen=part["specimen"].astype(np.uint64),
                parameters={name: part[f"parameters/{name}"] for name in self.header.parameter_units},
                source=self.source,
            )
            validation.label("label", batch.labels[0].item())  # not left open
        except InvalidValue as error:
            raise BadData(f"{self.path}: {error}") from None
        return batch

    def impact(self, index: int) -> Batch:
        """Return one signal with all its stored data.

        Parameters
        ----------
        index : int
            Number of the signal, from 0; a negative one counts from the end.

        Returns
        -------
        Batch
            Of one signal.

        Raises
        ------
        InvalidValue
            There is no such signal.
        """
        index = validation.whole(f"{self.path}: index", index, -len(self), len(self) - 1) % len(self)
        number = bisect_right(list(accumulate(self._counts)), index)
        row = index - sum(self._counts[:number])
        (batch,) = self._read(number, row, row + 1, 1)
        return batch

    def signal(self, index: int) -> Signal:
        """Return one signal.

        Parameters
        ----------
        index : int
            As `impact`.

        Returns
        -------
        Signal

        Raises
        ------
        InvalidValue
            As `impact`.
        """
        return self._named(self.impact(index).signals[0], index % len(self))

    def _named(self, samples: NDArray[Any], index: int) -> Signal:
        return Signal(
            samples=samples,
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            source=f"{self.path} index {index}",
            pre_trigger=self.pre_trigger,
        )


def _complete(folder: Folder) -> list[str]:
    """Return the names of the files of a folder; raises `BadData` unless all are there."""
    names, expected = folder.description.names, {entry.name for entry in folder.path.iterdir()}
    missing = [name for name in names if name not in expected]
    if missing:
        raise BadData(
            f"{folder.path}: {len(names) - len(missing)} of {len(names)} {folder.description.noun} are there, "
            f"{missing[0]} is missing; continue with cgid generate ... --resume"
        )
    return names


def is_recording(path: str | Path) -> bool:
    """Return whether this is an HDF5 file with the format of a recording; False if it cannot be read."""
    return hdf5_format(Path(path)) == RECORDING_FORMAT


class Recording:
    """A recording on disk, with the truth of its impacts, whose times count from the first sample."""

    n_samples: int
    dtype: str
    n_impacts: int
    sampling_rate: float
    start: float
    unit: str
    impact_units: dict[str, str]
    attributes: dict[str, Any]

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise NoInput(f"{path}: no such file; give a recording made by cgid generate")
        self._identity = state_of(self.path)
        with opened(self.path, str(self.path), self._identity) as file:
            self.__dict__.update(recording_header(file, str(self.path)))

    def __repr__(self) -> str:
        return (
            f"Recording({str(self.path)!r}: {self.n_samples} samples at {self.sampling_rate:g} Hz [{self.unit}], "
            f"{counted(self.n_impacts, 'impact')})"
        )

    def samples(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples in [first, stop)."""
        stop = self._checked_stop(first, stop)
        samples = np.empty(stop - first, self.dtype)
        position = 0
        for block in self.blocks(_BLOCK, first, stop):
            samples[position : position + block.size] = block
            position += block.size
        return samples

    def blocks(self, length: int, first: int = 0, stop: int | None = None) -> Generator[NDArray[Any], None, None]:
        """Yield samples in order, at most `length` at once; `first`, `stop` and errors as those of `samples`."""
        last = self._checked_stop(first, stop)
        with closing(rows(self.path, ["samples"], first, last, length, self._identity)) as parts:
            for part in parts:
                yield part["samples"]

    def _checked_stop(self, first: int, stop: int | None) -> int:
        stop = self.n_samples if stop is None else stop
        if not 0 <= first <= stop <= self.n_samples:
            raise InvalidValue(f"{self.path}: samples must be within 0 and {self.n_samples}, got {first} to {stop}")
        return stop

    def impacts(self) -> dict[str, NDArray[Any]]:
        """Return the truth of all impacts, one column for each of `impact_units`; raises `BadData` if damaged."""
        names = {name: f"impacts/{name}" for name in self.impact_units}
        parts = list(rows(self.path, list(names.values()), 0, self.n_impacts, _IMPACTS, self._identity))
        columns = {name: np.concatenate([part[stored] for part in parts]) for name, stored in names.items()}
        return {name: text_of(column) if column.dtype.kind == "S" else column for name, column in columns.items()}

    def signal(self) -> Signal:
        """Return the complete recording as a signal."""
        return Signal(samples=self.samples(), sampling_rate=self.sampling_rate, unit=self.unit, source=str(self.path))

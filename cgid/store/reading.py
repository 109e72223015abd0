"""Reading datasets, recordings, and HDF5 files of other programs; everything is checked before use.

A separate process reads the HDF5 files; see `cgid.store.sandbox`.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue, NoInput
from cgid.signals import Batch, Signal
from cgid.store import sandbox
from cgid.store.description import (
    LINKED,
    MANIFEST,
    RECORDING_FORMAT,
    Manifest,
    ShardEntry,
    ShardHeader,
    has_sum,
    read_manifest,
    text_of,
)
from cgid.terminal import counted
from cgid.units import quantity_of

#: Most signals read at once, and their largest size [bytes].
_ROWS, _LARGEST_BATCH = 1024, 32 << 20
#: Samples and impacts of a recording read at once.
_BLOCK, _IMPACTS = 1 << 20, 1 << 16


class Identity:
    """Identity of a file or folder that may be replaced during reading; raises `BadData` if it cannot be examined."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found = self._look()

    def require(self) -> None:
        """Raise `BadData` if the name now belongs to another file or folder, as after an overwriting run."""
        if self._look() != self._found:
            raise BadData(f"{self._path}: has been replaced by another while it was read; read it again")

    def _look(self) -> tuple[int, int]:
        found = _stat(self._path)
        return found.st_dev, found.st_ino


def _stat(path: Path) -> os.stat_result:
    try:
        return path.stat()
    except OSError as error:
        raise BadData(f"{path}: cannot be looked at ({error.strerror}); read it again") from None


def stored_rows(
    path: Path, names: Sequence[str], first: int, stop: int, length: int, row_bytes: int, identity: Identity
) -> Generator[dict[str, NDArray[Any]], None, None]:
    """Yield the rows [first, stop) of several datasets of a file, at most `length` of `row_bytes` [bytes] at once.

    Raises `BadData` if a checksum is wrong, or `identity` is now that of another file.
    """
    largest = max(sandbox.LARGEST_ANSWER, length * row_bytes)
    with closing(sandbox.stream("rows", path, names, first, stop, length, largest=largest)) as parts:
        for number, part in enumerate(parts):
            if not number:  # the file is open now, and cannot be replaced any more
                identity.require()
            yield part


class Dataset:
    """A dataset on disk: a file or a folder of shards.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    NoInput
        The path does not exist.
    BadData
        It is no dataset, unfinished (no manifest) or damaged, or its shards do not fit each other or the manifest.
    """

    #: The header of the first shard; the others differ from it only in the number of signals.
    header: ShardHeader

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            is_there = self.path.exists()
        except OSError as error:
            raise NoInput(f"{path}: cannot be looked at ({error.strerror}); check the name") from None
        if not is_there:
            raise NoInput(f"{path}: no such file or folder; give a dataset made by cgid generate")
        self._identity = Identity(self.path)
        manifest = read_manifest(self.path) if self.path.is_dir() else None
        # A single file has no manifest.
        self._entries: tuple[ShardEntry | None, ...] = (None,) if manifest is None else manifest.shards
        self._shards = [self.path if entry is None else self.path / entry.file for entry in self._entries]
        self._counts: list[int] = []
        try:
            for shard, entry in zip(self._shards, self._entries, strict=True):
                if entry is not None and shard.is_symlink():
                    raise BadData(f"{shard}: {LINKED}")
                header = ShardHeader(**sandbox.call("shard_header", shard))
                if not self._counts:
                    self.header = header
                self._require_fit(shard, header)
                if manifest is not None and entry is not None:
                    _require_listed(shard, header, manifest, entry)
                self._counts.append(header.n_signals)
        except BadData:
            self._identity.require()
            raise
        self._identity.require()  # shards of an overwriting run have the same names

    def _require_fit(self, shard: Path, header: ShardHeader) -> None:
        for name in ("n_samples", "sampling_rate", "pre_trigger", "unit", "parameter_units", "label_width"):
            here, there = getattr(header, name), getattr(self.header, name)
            if here != there:
                raise BadData(f"{shard}: {name} must be that of the other shards, {there}, got {here}")

    def __len__(self) -> int:
        return sum(self._counts)

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.path)!r}: {len(self)} signals of {self.header.n_samples} samples at "
            f"{self.sampling_rate:g} Hz [{self.unit}])"
        )

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
        """Samples before touch."""
        return self.header.pre_trigger

    @property
    def source(self) -> str:
        """SHA-256 of the scene of the signals; empty if they were not made from one."""
        return str(self.header.attributes.get("scene_sha256", ""))

    def __iter__(self) -> Iterator[Batch]:
        return self.batches()

    def batches(self, n_rows: int | None = None, *, check_sums: bool = False) -> Iterator[Batch]:
        """Yield the signals in order.

        Parameters
        ----------
        n_rows : int, optional
            Maximal number of signals in a batch; by default 1024, fewer for long signals.
        check_sums : bool
            Whether to compare each shard of a folder with the SHA-256 in the manifest. The comparison follows its last
            batch: reading reports damaged rows first, and the file is then still in the system's cache.

        Raises
        ------
        BadData
            A checksum is wrong, another file has the name, or a label breaks the rule of `cgid.validation.label`.
        """
        for shard, entry, count in zip(self._shards, self._entries, self._counts, strict=True):
            yield from self._read(shard, 0, count, n_rows)
            if check_sums and entry is not None and not has_sum(shard, entry.sha256):
                self._identity.require()
                raise BadData(
                    f"{shard}: must have the SHA-256 that {MANIFEST} says, it has not: it is damaged or another file; "
                    "see cgid verify"
                )

    def _read(self, shard: Path, first: int, stop: int, n_rows: int | None) -> Iterator[Batch]:
        row = self.header.n_samples * np.dtype(self.header.dtype).itemsize
        length = n_rows or max(1, min(_ROWS, _LARGEST_BATCH // row))
        names = ["signals", "labels", "specimen", *(f"parameters/{name}" for name in self.header.parameter_units)]
        with closing(stored_rows(shard, names, first, stop, length, 2 * row, self._identity)) as parts:
            for part in parts:
                yield self._batch(part)

    def _batch(self, part: dict[str, NDArray[Any]]) -> Batch:
        try:
            return Batch(
                signals=part["signals"],
                labels=text_of(part["labels"]),
                sampling_rate=self.sampling_rate,
                unit=self.unit,
                pre_trigger=self.pre_trigger,
                specimen=part["specimen"].astype(np.uint64),
                parameters={name: part[f"parameters/{name}"] for name in self.header.parameter_units},
                source=self.source,
            )
        except InvalidValue as error:
            raise BadData(f"{self.path}: {error}") from None

    def impact(self, index: int) -> Batch:
        """Return one signal with all its stored data.

        Parameters
        ----------
        index : int
            Number of the signal, from 0.

        Returns
        -------
        Batch
            Of one signal.

        Raises
        ------
        InvalidValue
            The index is negative, or not below the number of signals.
        """
        if not 0 <= index < len(self):
            raise InvalidValue(f"{self.path}: index must lie between 0 and {len(self) - 1}, got {index}")
        number = bisect_right(list(accumulate(self._counts)), index)
        place = index - sum(self._counts[:number])
        (batch,) = self._read(self._shards[number], place, place + 1, 1)
        return batch

    def signal(self, index: int) -> Signal:
        """Return one signal.

        Parameters
        ----------
        index : int
            Number of the signal, from 0.

        Returns
        -------
        Signal

        Raises
        ------
        InvalidValue
            As `impact`.
        """
        return Signal(
            samples=self.impact(index).signals[0],
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            source=f"{self.path} index {index}",
            pre_trigger=self.pre_trigger,
        )


def _require_listed(shard: Path, header: ShardHeader, manifest: Manifest, entry: ShardEntry) -> None:
    """Raise `BadData` unless the header of a shard fits its entry in the manifest."""
    if header.n_signals != entry.n_signals:
        raise BadData(
            f"{shard}: must hold as many signals as {MANIFEST} says, {entry.n_signals}, got {header.n_signals}; see "
            "cgid verify"
        )
    manifest.require_own(shard, header.attributes)
    size, first = _stat(shard).st_size, header.attributes.get("first_signal", 0)
    for name, wanted, got in (("first_signal", entry.first_signal, first), ("bytes", entry.bytes, size)):
        if got != wanted:
            raise BadData(
                f"{shard}: {name} must be {wanted} as {MANIFEST} says, got {got!s:.80}: the shard has been exchanged "
                "for another or changed; see cgid verify"
            )


def is_recording(path: str | Path) -> bool:
    """Return whether this is an HDF5 file with the format of a recording; False if it cannot be read."""
    return sandbox.format_said(Path(path)) == RECORDING_FORMAT


class Recording:
    """A recording on disk, with the truth of its impacts.

    start : time of the first sample [s]; times of impacts count from the first sample
    impact_units : the columns of the truth and their units, "" for text
    attributes : how it was made

    Raises `NoInput` if the path does not exist, `BadData` if it is no recording or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise NoInput(f"{path}: no such file; give a recording made by cgid generate")
        self._identity = Identity(self.path)
        about = sandbox.call("recording_header", self.path)
        self.attributes: dict[str, Any] = about["attributes"]
        self.n_samples: int = about["n_samples"]
        self.dtype: str = about["dtype"]
        self.n_impacts: int = about["n_impacts"]
        self.sampling_rate: float = about["sampling_rate"]
        self.start: float = about["start"]
        self.unit: str = about["unit"]
        self.impact_units: dict[str, str] = about["impact_units"]

    def __repr__(self) -> str:
        return (
            f"Recording({str(self.path)!r}: {self.n_samples} samples at {self.sampling_rate:g} Hz [{self.unit}], "
            f"{counted(self.n_impacts, 'impact')})"
        )

    def samples(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples in [first, stop).

        Raises `InvalidValue` for a range outside the recording; `BadData` if a checksum is wrong or another file has
        the name.
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
        size = np.dtype(self.dtype).itemsize
        with closing(stored_rows(self.path, ["samples"], first, last, length, size, self._identity)) as parts:
            for part in parts:
                yield part["samples"]

    def _checked_stop(self, first: int, stop: int | None) -> int:
        stop = self.n_samples if stop is None else stop
        if not 0 <= first <= stop <= self.n_samples:
            raise InvalidValue(
                f"{self.path}: samples must be asked for between 0 and {self.n_samples}, got {first} to {stop}"
            )
        return stop

    def impacts(self) -> dict[str, NDArray[Any]]:
        """Return the truth of all impacts, one column for each of `impact_units`; raises `BadData` if damaged."""
        names = {name: f"impacts/{name}" for name in self.impact_units}
        found = list(stored_rows(self.path, list(names.values()), 0, self.n_impacts, _IMPACTS, 0, self._identity))
        columns = {name: np.concatenate([part[stored] for part in found]) for name, stored in names.items()}
        return {name: text_of(column) if column.dtype.kind == "S" else column for name, column in columns.items()}

    def signal(self) -> Signal:
        """Return the whole recording as a signal."""
        return Signal(samples=self.samples(), sampling_rate=self.sampling_rate, unit=self.unit, source=str(self.path))


# ---- HDF5 files of other programs ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ForeignArray:
    """A numeric array of at least two values in an HDF5 file of another program, such as MATLAB v7.3.

    name : its path, separated by slashes
    attributes : numbers, texts, and lists of texts
    is_integer : whether it holds integers
    fault : why the samples cannot be read, "" if they can
    warning : the missing parts, "" if there are none
    """

    name: str
    shape: tuple[int, ...]
    attributes: dict[str, Any]
    is_integer: bool
    fault: str
    warning: str


def survey(
    path: Path, source: str, wanted: Callable[[str], bool]
) -> tuple[list[ForeignArray], dict[str, dict[str, Any]], list[str]]:
    """Return the arrays, the values beside them and the warnings of a foreign HDF5 file.

    The values are those whose names satisfy `wanted`: path of a group ("" for the root) -> its attributes and the
    single values in it. `source` is the file's name in messages. Raises `BadData` if the file is not HDF5, truncated,
    damaged, or has more objects than a recording.
    """
    names = [name for name in sandbox.call("foreign_names", path, source=source) if wanted(name)]
    about = sandbox.call("foreign_survey", path, names, source=source)
    arrays = [ForeignArray(**{**one, "shape": tuple(one["shape"])}) for one in about["arrays"]]
    said, asked = about["said"], about["texts"]
    # One flipped bit in a value of variable length can make HDF5 loop for ever. Such values are read last and
    # separately, so that their loss does not affect the samples.
    try:
        texts = sandbox.call("foreign_texts", path, asked, source=source) if asked else []
    except BadData:
        lost = ", ".join(sorted({name or place for place, name in asked})[:5])
        return arrays, said, [f"texts of variable length ({lost}) could not be read; the file may be damaged"]
    attributes = {array.name: array.attributes for array in arrays}
    for (place, attribute), value in zip(asked, texts, strict=True):
        # Without an attribute name it is a value in a group.
        owner, _, name = (place, "", attribute) if attribute else place.rpartition("/")
        if value is not None:
            (attributes[owner] if owner in attributes else said.setdefault(owner, {}))[name] = value
    return arrays, said, []


def array_blocks(
    path: Path, source: str, array: ForeignArray, axes: tuple[int | None, int], length: int, channels: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield the samples of these channels in order, (len(channels), at most length), float32 or float64.

    `axes` are the axis of the channels, None if there is only one channel, and the axis of the samples. `source` is the
    file's name in messages. Raises `BadData` if a checksum or a compressed chunk is wrong.
    """
    # The declared size was checked against the stored bytes; a sample takes at most eight bytes.
    largest = max(sandbox.LARGEST_ANSWER, 8 * length * len(channels))
    arguments = (array.name, array.shape, axes, length, list(channels))
    with closing(sandbox.stream("foreign_blocks", path, *arguments, source=source, largest=largest)) as blocks:
        for block in blocks:
            yield block[""]

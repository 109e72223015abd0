"""Writing a dataset: one file, a folder of shards, or an existing dataset as one plain file for other tools."""

from __future__ import annotations

import copy
import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.files import check_new, clear_half_written, require_room, whole_file, write_whole
from cgid.signals import Batch
from cgid.store.description import (
    DATASET_FILES,
    FORMAT,
    LARGEST_SHARD,
    MANIFEST,
    Manifest,
    ShardEntry,
    is_entry,
    read_manifest,
)
from cgid.store.disk import hdf5_on_disk
from cgid.store.hdf5 import ShardBuilder, ShardPlan, lay_out, say_kind
from cgid.store.reading import Dataset
from cgid.store.run import SUFFIXES, Goal, Run, begun, is_single_file, taking_part
from cgid.store.verification import compression_of, examine_whole

#: The manifest of this many shards takes some 100 MB, which readers hold in memory.
MOST_SHARDS = 300_000


class DatasetWriter:
    """Divides signals into shards and writes them in any order and from any process.

    Parameters
    ----------
    output : Path
        A file ending in .h5 or .hdf5 (a single shard), else a folder.
    plan : ShardPlan
    n_signals : int
    shard_signals : int
        Signals per shard of a folder.

    Raises
    ------
    InvalidValue
        A shard would be too large to be built in memory, or there would be too many shards.
    """

    def __init__(self, output: Path, plan: ShardPlan, n_signals: int, shard_signals: int) -> None:
        self.output, self.plan, self.n_signals = output, plan, n_signals
        self._folder: Path | None = None
        self._run: str | None = None
        self._overwrites = False
        self.shard_signals = n_signals if is_single_file(output) else min(shard_signals, n_signals)
        size = plan.size(self.shard_signals)
        if size > LARGEST_SHARD:
            cure = "give a name that does not end in .h5, for a folder" if is_single_file(output) else "ask for smaller"
            raise InvalidValue(
                f"a shard must be at most {LARGEST_SHARD >> 30} GiB, {self.shard_signals} signals make "
                f"{size / 2**30:.3g} GiB: {cure}"
            )
        if len(self._starts) > MOST_SHARDS:
            raise InvalidValue(
                f"shard_signals must be at least {-(-n_signals // MOST_SHARDS)} for {n_signals} signals, got "
                f"{self.shard_signals}: a manifest lists {MOST_SHARDS} shards at most"
            )

    @property
    def shards(self) -> list[tuple[int, int, int]]:
        """Number, first signal and number of signals of each shard."""
        return [(k, first, min(self.shard_signals, self.n_signals - first)) for k, first in enumerate(self._starts)]

    @property
    def _starts(self) -> range:
        return range(0, self.n_signals, self.shard_signals)

    @property
    def folder(self) -> Path:
        """The folder of the new files; for a folder of shards, only within `begun`."""
        return self.output.parent if self._folder is None else self._folder

    def from_anywhere(self) -> DatasetWriter:
        """Return the same writer with absolute paths, for processes with another working directory."""
        found = copy.copy(self)
        found.output = self.output.absolute()
        found._folder = None if self._folder is None else self._folder.absolute()
        return found

    @contextmanager
    def begun(self, *, overwrite: bool = False, resume: bool = False) -> Iterator[Run]:
        """Yield the run that makes the shards; see `cgid.store.run.begun`.

        Parameters
        ----------
        overwrite : bool
            Whether to replace an old dataset; it stays until the new one is complete.
        resume : bool
            Whether to continue an unfinished run; a complete dataset of the same description is kept.

        Raises
        ------
        CannotCreate
            The output exists, another run writes there, the run to resume had other options, or the disk has no room.
        BadData
            The journal of the run to resume, or the existing file, is damaged.
        WriteFailed
            The disk is full or broken; the run can be resumed.
        """
        self._overwrites = overwrite
        shards = self.shards
        names = tuple(f"shard-{number:05d}.h5" for number, _, _ in shards)
        goal = Goal(
            output=self.output,
            description=self._manifest(()).description,
            names=(self.output.name,) if is_single_file(self.output) else names,
            noun="shards",
            ours=DATASET_FILES,
            description_of=_description_of,
            closing=lambda entries: {MANIFEST: self._manifest(ShardEntry(**entry) for entry in entries).to_bytes()},
            fits=lambda number, entry: (
                is_entry(entry) and (entry["first_signal"], entry["n_signals"]) == shards[number][1:]
            ),
        )
        with begun(goal, overwrite=overwrite, resume=resume) as run:
            if run.token is not None:
                self._folder, self._run = run.folder, run.token
                self._require_room(sum(shards[number][2] for number in run.missing))
            yield run

    def _require_room(self, n_signals: int) -> None:
        """Raise `CannotCreate` if the disk has less room than this many signals need; skipped with compression."""
        if self.plan.compression == "none":
            needed = self.plan.size(n_signals)
            require_room(self.output, self.output.parent, needed, "signals", "make room, or fewer signals")

    def _manifest(self, shards: Iterable[ShardEntry]) -> Manifest:
        return Manifest(
            n_signals=self.n_signals,
            shard_signals=self.shard_signals,
            n_samples=self.plan.n_samples,
            dtype=self.plan.dtype,
            compression=self.plan.compression,
            attributes=self.plan.attributes,
            shards=tuple(shards),
        )

    def write(self, number: int, first: int, n_signals: int, batches: Iterable[Batch]) -> ShardEntry:
        """Build a shard in memory, write it atomically, and return its entry in the manifest."""
        builder = ShardBuilder(self.plan, first, n_signals)
        labels: Counter[str] = Counter()
        for batch in batches:
            builder.add(batch)
            labels.update(batch.labels.tolist())
        content = builder.image()
        if self._folder is None or self._run is None:
            path = self.output
            write_whole(path, content, overwrite=self._overwrites)
        else:
            path = self._folder / f"shard-{number:05d}.h5"
            with taking_part(self._folder, self._run):
                write_whole(path, content)
        digest = hashlib.sha256(content).hexdigest()
        return ShardEntry(path.name, first, n_signals, len(content), digest, dict(sorted(labels.items())))


def _description_of(path: Path) -> Mapping[str, Any] | None:
    """Return the description of an existing dataset; None for a folder without a manifest."""
    if path.is_dir():
        return read_manifest(path).description if (path / MANIFEST).exists() else None
    compression = compression_of(examine_whole(path, FORMAT))
    there = Dataset(path)
    return {**vars(there.header), "n_signals": len(there), "compression": compression}


# ---- export ----------------------------------------------------------------------------------------------------------


def export(
    data: Dataset | str | Path,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset of any compression as one plain HDF5 file and return its path.

    `output` ends in .h5 or .hdf5. Memory does not grow with the number of signals; `progress` receives the number of
    signals written since the last call. Raises `NoInput` or `BadData` for the dataset, `CannotCreate` if the output
    exists, cannot be made or has no room, `WriteFailed` if the disk is full (an existing file stays).
    """
    dataset = data if isinstance(data, Dataset) else Dataset(data)
    path = check_new(Path(output), "an exported dataset", SUFFIXES, overwrite=overwrite)
    if dataset.path.resolve() in (path.resolve(), path.resolve().parent):
        raise CannotCreate(f"{path}: must not be part of what it is made from; choose another name")
    clear_half_written(path)
    plan = ShardPlan(
        n_samples=dataset.header.n_samples,
        dtype=dataset.header.dtype,
        label_width=dataset.header.label_width,
        parameter_units=dataset.header.parameter_units,
        attributes={name: value for name, value in dataset.header.attributes.items() if name != "first_signal"},
    )
    first = dataset.header.attributes.get("first_signal", 0)
    require_room(path, path.parent, plan.size(len(dataset)), "signals", "make room")
    with whole_file(path, overwrite=overwrite) as temporary:
        write_dataset(temporary, plan, first, len(dataset), dataset.batches(check_sums=True), progress)
    return path


def write_dataset(
    path: Path,
    plan: ShardPlan,
    first: int,
    n_signals: int,
    batches: Iterable[Batch],
    progress: Callable[[int], object] | None = None,
) -> None:
    """Write a dataset uncompressed into an empty file; used within `cgid.files.whole_file`.

    Raises `OSError` if the disk is full or broken, and `BadData` if the batches hold fewer than `n_signals` signals.
    """
    done, plain = 0, replace(plan, compression="none")
    with hdf5_on_disk(path) as output:
        for batch in batches:
            with output.step() as file:
                if not done:
                    say_kind(lay_out(file, plain, first, n_signals), batch)
                rows = slice(done, done + len(batch))
                file["signals"][rows] = batch.signals
                file["labels"][rows] = np.char.encode(batch.labels, "utf-8")
                file["specimen"][rows] = batch.specimen
                for name, values in batch.parameters.items():
                    file[f"parameters/{name}"][rows] = values
            done += len(batch)
            if progress is not None:
                progress(len(batch))
        if done != n_signals:
            raise BadData(f"a dataset of {n_signals} signals was given {done}")

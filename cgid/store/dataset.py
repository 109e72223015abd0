"""Writing a dataset: one file, or a folder of shards with a manifest that is written last.

A dataset of any size as one plain file: what other tools open, and what cgid reads as a dataset, too.

It is laid out as a shard is (`cgid.store.hdf5`), without compression, but goes to the disk as it comes: memory does
not grow with it.
"""

from __future__ import annotations

import copy
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.files import check_new, clear_half_written, half_written, looking_at, require_room, whole_file, write_whole
from cgid.signals import Batch
from cgid.store.description import (
    FORMAT,
    LARGEST_SHARD,
    MANIFEST,
    SHARD_NAME,
    Manifest,
    ShardEntry,
    first_difference,
    is_entry,
    read_manifest,
    require_same,
)
from cgid.store.hdf5 import ShardBuilder, ShardPlan, hdf5_on_disk, lay_out, say_kind
from cgid.store.reading import Dataset
from cgid.store.run import JOURNAL_FILES, Goal, Run, begun, exists_already, real_folder, taking_part
from cgid.store.verification import compression_of, examine_whole

#: What a dataset folder may hold beside a journal, with what a killed run leaves behind.
_WHOLE = rf"{re.escape(MANIFEST)}|{SHARD_NAME}"
_OURS = re.compile(f"{_WHOLE}|{half_written(_WHOLE)}")
#: Bytes of a manifest in which it says its format.
_HEAD = 4096
SUFFIXES = (".h5", ".hdf5")
#: Their manifest has some 100 MB, which readers hold in memory.
MOST_SHARDS = 300_000


@dataclass(frozen=True)
class BuiltShard:
    """A shard in memory: the content of its file, and what the manifest says of it."""

    number: int
    first: int
    n_signals: int
    content: memoryview
    labels: dict[str, int]


def is_single_file(output: str | Path) -> bool:
    """Return whether this name asks for one file and not for a folder."""
    return Path(output).suffix.lower() in SUFFIXES


def check_output(output: str | Path, overwrite: bool = False, ours: re.Pattern[str] = _OURS) -> Path:
    """Return the output as a path if it may be written, before any work is done; a folder by its own name.

    In a folder nothing may lie but files whose names are `ours`.

    Raises
    ------
    CannotCreate
        Something is there already, or the folder above is missing.
    """
    path = Path(output)
    with looking_at(path):
        path = path if is_single_file(path) else real_folder(path)
        _require_room(path, overwrite, ours)
    return path


def _require_room(path: Path, overwrite: bool, ours: re.Pattern[str]) -> None:
    if not path.parent.is_dir():
        raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
    if path.is_dir() and is_single_file(path):
        raise CannotCreate(f"{path}: is a folder; choose another name for the file")
    if path.exists() and not path.is_dir() and not is_single_file(path):
        raise CannotCreate(f"{path}: is a file; choose another name for the folder, or one ending in .h5")
    content = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else None
    foreign = [name for name in content or () if not ours.fullmatch(name) and not JOURNAL_FILES.fullmatch(name)]
    if (path / MANIFEST).is_file():
        with (path / MANIFEST).open("rb") as stream:
            if f'"{FORMAT}"'.encode() not in stream.read(_HEAD):
                foreign.append(MANIFEST)
    if foreign:
        raise CannotCreate(
            f"{path}: is a folder with other things in it, such as {foreign[0]}, and is not overwritten; "
            "choose another name"
        )
    if path.exists() and content != [] and not overwrite:
        raise exists_already(path)


class DatasetWriter:
    """Cuts a run of signals into shards and writes them; shards may be written in any order, by any process.

    Parameters
    ----------
    output : Path
        A file ending in .h5 (a single shard), else a folder.
    plan : ShardPlan
    n_signals : int
    shard_signals : int
        Signals of a shard of a folder.

    Raises
    ------
    InvalidValue
        A shard would be too large to be built in memory, or there would be too many.
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
        """Where files are written; for a folder of shards, within `begun`."""
        return self.output.parent if self._folder is None else self._folder

    def from_anywhere(self) -> DatasetWriter:
        """Return the same for processes that stand in another folder."""
        found = copy.copy(self)
        found.output = self.output.absolute()
        found._folder = None if self._folder is None else self._folder.absolute()
        return found

    def require_room(self, n_signals: int) -> None:
        """Raise `CannotCreate` if the disk has less room than so many signals alone will take."""
        if self.plan.compression != "none":
            return
        needed = self.plan.size(n_signals)
        require_room(self.output, self.output.parent, needed, "signals", "make room, or fewer signals")

    @contextmanager
    def begun(self, *, overwrite: bool = False, resume: bool = False) -> Iterator[DatasetRun]:
        """Yield the run that makes the shards; when this context is left without an error the dataset is whole.

        Parameters
        ----------
        overwrite : bool
            Whether an older dataset may be replaced; it stays whole until the new one is.
        resume : bool
            Whether an unfinished run may go on; a dataset that is whole and the same is left as it is.

        Raises
        ------
        CannotCreate
            Something is there already, another run is writing there, or the one to be resumed had other options.
        BadData
            What is to be resumed is damaged.
        WriteFailed
            The disk is full or broken; finished shards stay, and the run can be resumed.
        """
        self._overwrites = overwrite
        if is_single_file(self.output):
            clear_half_written(self.output)
            yield DatasetRun(self.shards if self._must_be_made(overwrite, resume) else [])
            return
        goal = Goal(
            output=self.output,
            plan=self._manifest(()).plan,
            n_files=len(self.shards),
            noun="shards",
            ours=_OURS,
            plan_of=lambda folder: read_manifest(folder).plan if (folder / MANIFEST).exists() else None,
        )
        with begun(goal, overwrite=overwrite, resume=resume) as run:
            if run is None:
                yield DatasetRun([])
                return
            self._folder, self._run = run.folder, run.token
            made = DatasetRun(self.shards, run)
            self.require_room(sum(n_signals for _, _, n_signals in made.missing))
            yield made
            listed = tuple(sorted(made.entries, key=lambda entry: entry.first_signal))
            write_whole(run.folder / MANIFEST, self._manifest(listed).to_bytes())

    def _must_be_made(self, overwrite: bool, resume: bool) -> bool:
        """Return whether a single file is not there already."""
        if not resume or not self.output.exists():
            return True
        try:
            compression = compression_of(examine_whole(self.output, FORMAT))
        except BadData:
            if overwrite:
                return True
            raise
        there = Dataset(self.output)
        found = {**vars(there.header), "n_signals": len(there), "compression": compression}
        asked = self._manifest(()).plan
        plan = {name: value for name, value in found.items() if name in asked}
        if not overwrite:
            require_same(self.output, plan, asked)
        return first_difference(plan, asked) is not None

    def _manifest(self, shards: tuple[ShardEntry, ...]) -> Manifest:
        return Manifest(
            n_signals=self.n_signals,
            shard_signals=self.shard_signals,
            n_samples=self.plan.n_samples,
            dtype=self.plan.dtype,
            compression=self.plan.compression,
            attributes=self.plan.attributes,
            shards=shards,
        )

    def build_shard(self, number: int, first: int, n_signals: int, batches: Iterable[Batch]) -> BuiltShard:
        """Build one shard in memory."""
        builder = ShardBuilder(self.plan, first, n_signals)
        labels: Counter[str] = Counter()
        for batch in batches:
            builder.add(batch)
            labels.update(batch.labels.tolist())
        return BuiltShard(number, first, n_signals, builder.image(), dict(sorted(labels.items())))

    def put(self, shard: BuiltShard) -> ShardEntry:
        """Put a built shard on the disk whole, and return its line of the manifest."""
        if self._folder is None or self._run is None:
            path = self.output
            write_whole(path, shard.content, overwrite=self._overwrites)
        else:
            path = self._folder / f"shard-{shard.number:05d}.h5"
            with taking_part(self._folder, self._run):
                write_whole(path, shard.content)
        digest = hashlib.sha256(shard.content).hexdigest()
        return ShardEntry(path.name, shard.first, shard.n_signals, len(shard.content), digest, shard.labels)


class DatasetRun:
    """A run that makes a dataset.

    Attributes
    ----------
    missing : list of tuple
        Number, first signal and number of signals of each shard that is not there yet.
    entries : list of ShardEntry
        Of the shards that are there.
    """

    def __init__(self, shards: list[tuple[int, int, int]], run: Run | None = None) -> None:
        self._run = run
        self.entries = [] if run is None else [ShardEntry(**entry) for entry in run.finished if is_entry(entry)]
        there = {(entry.first_signal, entry.n_signals) for entry in self.entries}
        self.missing = [shard for shard in shards if shard[1:] not in there]

    def add(self, entry: ShardEntry) -> None:
        """Note that a shard is finished."""
        self.entries.append(entry)
        if self._run is not None:
            self._run.add(vars(entry))


def export(
    data: Dataset | str | Path,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset as one HDF5 file and return its path; memory stays the same however many signals there are.

    Parameters
    ----------
    data : Dataset, str or Path
        A dataset, or where it lies: a folder, or a file of any compression.
    output : str or Path
        Ending in .h5 or .hdf5.
    overwrite : bool
        Whether an old file may be replaced.
    progress : callable, optional
        Called with a number of signals whenever so many more are done.

    Raises
    ------
    NoInput, BadData
        There is no dataset, or it is damaged.
    CannotCreate
        The output exists, or cannot be made, or has no room.
    WriteFailed
        The disk is full; nothing is left behind, an old file is untouched.
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
    """Write the signals of a dataset to an empty file, batch by batch; within `cgid.files.whole_file`.

    Parameters
    ----------
    path : Path
        It exists and is empty.
    plan : ShardPlan
        Its compression is passed over.
    first, n_signals : int
        Number of the first signal, and how many there are.
    batches : iterable of Batch
        All of them, in order.
    progress : callable, optional
        As of `export`.

    Raises
    ------
    OSError
        The disk is full or broken.
    BadData
        The batches hold less than `n_signals`.
    """
    done, plain = 0, replace(plan, compression="none")
    with hdf5_on_disk(path) as output:
        for batch in batches:
            with output.step() as file:
                if not done:
                    say_kind(lay_out(file, plain, first, n_signals), batch)
                _put(file, batch, done)
            done += len(batch)
            if progress is not None:
                progress(len(batch))
        if done != n_signals:
            raise BadData(f"a dataset of {n_signals} signals was given {done}")


def _put(file: h5py.File, batch: Batch, first: int) -> None:
    """Write the signals of a batch and what is known of them, from row `first` on."""
    rows = slice(first, first + len(batch))
    file["signals"][rows] = batch.signals
    file["labels"][rows] = np.char.encode(batch.labels, "utf-8")
    file["specimen"][rows] = batch.specimen
    for name, values in batch.parameters.items():
        file[f"parameters/{name}"][rows] = values

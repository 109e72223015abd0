"""Writing a dataset: one file, or a folder of shards with a manifest that is written last."""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cgid.errors import CannotCreate, InvalidValue
from cgid.files import write_whole
from cgid.signals import Batch
from cgid.store.header import FORMAT, LARGEST_SHARD
from cgid.store.manifest import MANIFEST, SHARD_NAME, Manifest, ShardEntry
from cgid.store.shard import ShardBuilder, ShardPlan

#: What a dataset folder may hold, with what a killed run leaves behind.
_OURS = re.compile(rf"(manifest\.json|{SHARD_NAME})|\.(manifest\.json|{SHARD_NAME})\.[0-9a-f]+\.part")
SUFFIXES = (".h5", ".hdf5")


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
    """Return the output as a path if it may be written, before any work is done.

    In a folder nothing may lie but files whose names are `ours`.

    Raises
    ------
    CannotCreate
        Something is there already, or the folder above is missing.
    """
    path = Path(output)
    try:
        _require_room(path, overwrite, ours)
    except CannotCreate:
        raise
    except OSError as error:
        raise CannotCreate(f"{path}: cannot be looked at ({error.strerror}); choose another name") from None
    return path


def _require_room(path: Path, overwrite: bool, ours: re.Pattern[str]) -> None:
    if not path.parent.is_dir():
        raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
    if path.is_dir() and is_single_file(path):
        raise CannotCreate(f"{path}: is a folder; choose another name for the file")
    if path.exists() and not path.is_dir() and not is_single_file(path):
        raise CannotCreate(f"{path}: is a file; choose another name for the folder, or one ending in .h5")
    content = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else None
    if path.exists() and content != [] and not overwrite:
        raise CannotCreate(f"{path}: exists already; choose another name or say --overwrite")
    foreign = [name for name in content or () if not ours.fullmatch(name)]
    if (path / MANIFEST).is_file() and f'"{FORMAT}"'.encode() not in (path / MANIFEST).read_bytes():
        foreign.append(MANIFEST)
    if foreign:
        raise CannotCreate(
            f"{path}: is a folder with other things in it, such as {foreign[0]}, and is not overwritten; "
            "choose another name"
        )


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
        The shard would be too large to be built in memory.
    """

    def __init__(self, output: Path, plan: ShardPlan, n_signals: int, shard_signals: int) -> None:
        self.output, self.plan, self.n_signals = output, plan, n_signals
        self.shard_signals = n_signals if is_single_file(output) else min(shard_signals, n_signals)
        size = self.shard_signals * plan.n_samples * (8 if plan.dtype == "float64" else 4)
        if size > LARGEST_SHARD:
            cure = "give a name that does not end in .h5, for a folder" if is_single_file(output) else "ask for smaller"
            raise InvalidValue(
                f"a shard must be at most {LARGEST_SHARD >> 30} GiB, {self.shard_signals} signals make "
                f"{size / 2**30:.3g} GiB: {cure}"
            )

    @property
    def shards(self) -> list[tuple[int, int, int]]:
        """Number, first signal and number of signals of each shard."""
        starts = range(0, self.n_signals, self.shard_signals)
        return [(k, first, min(self.shard_signals, self.n_signals - first)) for k, first in enumerate(starts)]

    def require_room(self) -> None:
        """Raise `CannotCreate` if the disk has less room than the signals alone will take."""
        if self.plan.compression != "none":
            return
        needed = self.n_signals * self.plan.n_samples * (8 if self.plan.dtype == "float64" else 4)
        free = shutil.disk_usage(self.output.parent).free
        if needed > free:
            raise CannotCreate(
                f"{self.output}: the disk must have room for {needed / 1e9:.3g} GB of signals, {free / 1e9:.3g} GB are "
                "free; make room, or fewer signals"
            )

    def begin(self, overwrite: bool) -> None:
        """Make room: an old manifest goes first, so that no mixture looks whole."""
        if is_single_file(self.output):
            return
        try:
            self.output.mkdir(exist_ok=True)
            if overwrite:
                (self.output / MANIFEST).unlink(missing_ok=True)
                for old in self.output.iterdir():
                    if _OURS.fullmatch(old.name):
                        old.unlink()
        except OSError as error:
            raise CannotCreate(f"{self.output}: cannot be written ({error.strerror}); choose another place") from None

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
        path = self.output if is_single_file(self.output) else self.output / f"shard-{shard.number:05d}.h5"
        write_whole(path, shard.content)
        digest = hashlib.sha256(shard.content).hexdigest()
        return ShardEntry(path.name, shard.first, shard.n_signals, len(shard.content), digest, shard.labels)

    def abandon(self) -> None:
        """Remove what a worker that was stopped has left half-written; finished shards stay."""
        if not is_single_file(self.output):
            for part in self.output.glob(".*.part"):
                if _OURS.fullmatch(part.name):
                    part.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.output.rmdir()  # only if nothing is in it

    def finish(self, entries: Iterable[ShardEntry]) -> None:
        """Write the manifest of a folder; only now it is a dataset."""
        if is_single_file(self.output):
            return
        manifest = Manifest(
            n_signals=self.n_signals,
            shard_signals=self.shard_signals,
            n_samples=self.plan.n_samples,
            dtype=self.plan.dtype,
            compression=self.plan.compression,
            attributes=self.plan.attributes,
            shards=tuple(sorted(entries, key=lambda entry: entry.first_signal)),
        )
        write_whole(self.output / MANIFEST, manifest.to_bytes())

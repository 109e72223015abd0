"""Who makes the shards of a dataset: this process, several at once, or those of a cluster that share the folder."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from cgid.errors import CannotCreate
from cgid.scene.overlap import write_in_turn
from cgid.scene.schema import Scene
from cgid.store import DatasetWriter
from cgid.store.journal import JOURNAL
from cgid.store.manifest import ShardEntry
from cgid.store.writing import is_single_file
from cgid.workers import Workers

#: What another machine has written may be seen here so much later [s]: network file systems remember what was missing.
PATIENCE = 30.0


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What all shards have in common."""

    writer: DatasetWriter
    scene: Scene
    seed: int
    dtype: Literal["float32", "float64"]


def write_shards(
    writer: DatasetWriter,
    scene: Scene,
    seed: int,
    dtype: Literal["float32", "float64"],
    shards: list[tuple[int, int, int]],
    crew: Workers,
    progress: Callable[[int], object] | None,
) -> Generator[ShardEntry, None, None]:
    """Make these shards of a dataset and write them; yield each one's line of the manifest as it is done.

    On a cluster each worker writes into the same folder by the same name, and ends the shard it is at when the others
    are called off.
    """
    if crew.alone:
        yield from write_in_turn(writer, scene, seed, dtype, shards, progress)
        return
    # Processes that are kept from an earlier run stand in the folder of that time.
    asked = _anywhere(_Asked(writer=writer, scene=scene, seed=seed, dtype=dtype))
    write = _write_shared if crew.elsewhere else _write_one
    with closing(crew.each(write, asked, shards, ordered=False)) as entries:
        for entry in entries:
            if crew.elsewhere:
                _require_shared(writer, entry)
            yield entry


def _anywhere(asked: _Asked) -> _Asked:
    """Return the same for processes that stand in another folder."""
    scene = asked.scene.model_copy()
    scene.__dict__["folder"] = scene.folder.absolute()
    return replace(asked, writer=asked.writer.from_anywhere(), scene=scene)


def _write_one(asked: _Asked, shard: tuple[int, int, int]) -> ShardEntry:
    (entry,) = write_in_turn(asked.writer, asked.scene, asked.seed, asked.dtype, [shard])
    return entry


def _write_shared(asked: _Asked, shard: tuple[int, int, int]) -> ShardEntry:
    folder = asked.writer.folder
    if not folder.is_dir() or not (is_single_file(asked.writer.output) or (folder / JOURNAL).exists()):
        raise CannotCreate(
            f"{folder}: must be a folder that all workers share, {platform.node()} has none; choose one they share, or "
            "mount it there by the same name"
        )
    return _write_one(asked, shard)


def _require_shared(writer: DatasetWriter, entry: ShardEntry) -> None:
    """Raise `CannotCreate` unless a shard that a worker has written lies here, too."""
    path, until = writer.folder / entry.file, time.monotonic() + PATIENCE
    while (size := _size(path)) != entry.bytes:
        if time.monotonic() > until:
            raise CannotCreate(
                f"{path}: must be here with the {entry.bytes} bytes a worker has written, "
                f"{'is not' if size is None else f'has {size}'}; choose a folder that all machines share"
            )
        time.sleep(0.2)
        next(path.parent.iterdir(), None)  # it is read anew


def _size(path: Path) -> int | None:
    """Return the bytes of a file, None where there is none."""
    try:
        return path.stat().st_size
    except OSError:
        return None

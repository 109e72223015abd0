"""How a file says it was made: the scene, the seed, and the plan of its shards.

Shards that go to the disk while the next signals are made.

What packs, hashes and writes a shard and waits for the disk is not what makes signals, and neither holds Python's lock
for long. So a thread makes signals ahead, past the end of the shard, and neither waits for the other.

Who makes the shards of a dataset: this process, several at once, or those of a cluster that share the folder.

From a scene to a dataset on disk.

From a scene to a table on disk: features, closed forms or parameters, and no signals.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from cgid import __version__, validation
from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.files import require_room
from cgid.scene.plan import Plan
from cgid.scene.population import parameter_units
from cgid.scene.randomness import BLOCK
from cgid.scene.scene import Scene, parse_scene
from cgid.scene.synthesis import synthesise
from cgid.scene.tables import columns_of
from cgid.signals import Batch
from cgid.store import (
    FORMAT,
    SCHEMA_VERSION,
    DatasetWriter,
    Rows,
    TableHeader,
    check_output,
    check_table_output,
    table_writer,
)
from cgid.store.compression import COMPRESSIONS, library, require
from cgid.store.dataset import is_single_file
from cgid.store.description import ShardEntry
from cgid.store.hdf5 import ShardPlan
from cgid.store.run import JOURNAL
from cgid.store.verification import compression_of
from cgid.workers import Workers, workers

#: In which root attributes are written: bytes depend on it, and HDF5 does not keep it.
_ORDER = ("format", "schema_version", "seed", "scene_name", "scene", "scene_sha256", "versions", "background_sha256")


def attributes_of(scene: Scene, seed: int, compression: str = "none") -> dict[str, Any]:
    """Return the root attributes of a dataset: how it was made, and by what its bytes were."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "h5py"))
    if compression != "none":
        packages += f", {library(compression)}"
    found = {
        "seed": seed,
        "scene_name": scene.name,
        "scene": scene.text,
        "scene_sha256": scene.sha256,
        "versions": f"cgid {__version__}, Python {platform.python_version()}, {packages}",
    }
    if scene.background is not None and scene.background.recorded is not None:
        # The scene names the file only, and the samples depend on what is in it.
        with scene.background.recorded.file(scene.folder).open("rb") as stream:
            found["background_sha256"] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def scene_of(path: Path, attributes: Mapping[str, Any], given: Scene | None) -> Scene:
    """Return the scene that a file was made of.

    Parameters
    ----------
    path : Path
        For messages.
    attributes : dict
        What the file says.
    given : Scene or None
        From the scene's own file.

    Raises
    ------
    BadData
        The file does not say it, another scene is given, or none where the scene names a recording to be read.
    """
    if given is not None:
        if given.sha256 != attributes.get("scene_sha256"):
            raise BadData(
                f"{path}: the scene must be the one it was made of, with SHA-256 {attributes.get('scene_sha256')}, got "
                f"{given.sha256} ({given.name}); give that scene's file"
            )
        background = attributes_of(given, 0).get("background_sha256")
        if background != attributes.get("background_sha256", background):
            raise BadData(
                f"{path}: the recorded background must be the one it was made with, with SHA-256 "
                f"{attributes['background_sha256']}, got {background}; put that file in its place"
            )
        return given
    try:
        content = json.loads(attributes["scene"])
    except (KeyError, TypeError, ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise BadData(f"{path}: does not say of what scene it was made; make it again by cgid generate")
    scene = parse_scene(content, source=str(path))
    if scene.background is not None and scene.background.recorded is not None:
        # What a file names, which may come from a stranger, is not opened for him.
        raise BadData(
            f"{path}: was made with the recorded background {scene.background.recorded.path}; give the scene file that "
            "lies beside it by --scene FILE"
        )
    return scene


def whole_number(path: Path, attributes: Mapping[str, Any], name: str) -> int:
    """Return an attribute that must be a whole number of 0 or more; raises `BadData`."""
    number = attributes.get(name)
    if type(number) is not int or number < 0:
        raise BadData(
            f"{path}: {name} must be a whole number of 0 or more, got {number!r:.40}; generate the file again"
        )
    return number


def plan_of(scene: Scene, examined: Mapping[str, Any]) -> ShardPlan:
    """Return the plan of a shard that `cgid.store.verification.examine_file` has looked at."""
    stored = {name: value for name, value in examined["attributes"].items() if name != "first_signal"}
    return shard_plan(scene, stored, examined["dtype"], compression_of(examined))


def shard_plan(scene: Scene, attributes: Mapping[str, Any], dtype: str, compression: str) -> ShardPlan:
    """Return the plan of the shards of a dataset with these root attributes."""
    return ShardPlan(
        n_samples=scene.sampling.samples,
        dtype=dtype,
        label_width=max(len(label.encode()) for label in scene.labels),
        parameter_units=parameter_units(scene),
        attributes=in_order(attributes),
        compression=compression,
    )


def in_order(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes in the order in which they are written, which HDF5 does not keep, and bytes depend on."""
    return {name: attributes[name] for name in _ORDER if name in attributes} | dict(attributes)


#: Signals made ahead take at most so much memory [bytes], or one block, and are at most so many blocks.
_AHEAD_BYTES, _AHEAD_BLOCKS = 32 << 20, 16

_T = TypeVar("_T")


def write_in_turn(
    writer: DatasetWriter,
    scene: Scene,
    seed: int,
    dtype: Literal["float32", "float64"],
    shards: Sequence[tuple[int, int, int]],
    progress: Callable[[int], object] | None = None,
) -> Generator[ShardEntry, None, None]:
    """Make shards one after another and write them; yield each one's line of the manifest as it is done.

    Parameters
    ----------
    writer : DatasetWriter
    scene : Scene
    seed : int
    dtype : {"float32", "float64"}
    shards : sequence of (number, first signal, number of signals)
    progress : callable, optional
        Called with a number of signals whenever so many more are in their shard.
    """
    made = (batch for _, first, count in shards for batch in synthesise(scene, count, seed, first=first, dtype=dtype))
    block = BLOCK * scene.sampling.samples * np.dtype(dtype).itemsize
    with closing(ahead(made, min(max(1, _AHEAD_BYTES // block), _AHEAD_BLOCKS))) as batches:
        for number, first, count in shards:
            yield writer.put(writer.build_shard(number, first, count, _next_signals(batches, count, progress)))


def ahead(items: Iterable[_T], most: int) -> Generator[_T, None, None]:
    """Yield what a thread makes before it is asked for, so many at most; what making one raises, asking for it raises.

    Examples
    --------
    >>> list(ahead("abc", 2))
    ['a', 'b', 'c']
    """
    source, context = iter(items), copy_context()  # counters count in the thread, too
    with ThreadPoolExecutor(max_workers=1) as maker:

        def make() -> _T | None:
            return next(source, None)

        def ask() -> Future[_T | None]:
            return maker.submit(context.run, make)

        asked = deque(ask() for _ in range(most))
        try:
            while (item := asked.popleft().result()) is not None:
                asked.append(ask())
                yield item
        finally:
            maker.shutdown(wait=False, cancel_futures=True)


def _next_signals(batches: Iterator[Batch], count: int, progress: Callable[[int], object] | None) -> Iterator[Batch]:
    """Yield the batches of the next so many signals; no batch reaches past the end of a shard."""
    while count:
        batch = next(batches)
        yield batch
        count -= len(batch)
        if progress is not None:
            progress(len(batch))


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


#: Signals of a shard: 32 MiB of 2048 float32 samples, built in memory.
SHARD_SIGNALS = 4096
#: More would need a manifest larger than memory.
MOST_SIGNALS = 10**9


def generate(
    scene: Scene,
    output: str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    jobs: int = 1,
    dtype: Literal["float32", "float64"] = "float32",
    shard_signals: int = SHARD_SIGNALS,
    compression: Literal["none", "gzip", "zstd", "blosc2"] = "none",
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset and return its path.

    Parameters
    ----------
    scene : Scene
    output : str or Path
        Ending in .h5 or .hdf5: one file. Else a folder of shards.
    n_signals, seed : int
    jobs : int
        Worker processes, each with a shard of its own in memory.
    dtype : {"float32", "float64"}
        Of the samples.
    shard_signals : int
        Signals in each shard of a folder; the signals themselves do not depend on it.
    compression : {"none", "gzip", "zstd", "blosc2"}
        gzip takes two to three times as long and saves a seventh of noisy signals; without noise little is left of
        them. Everything that reads HDF5 reads it. zstd and blosc2 (lz4) need the extra `compression`, here and wherever
        the data are read. The bytes depend on the version of what packs, too, which the attribute `versions` names.
    overwrite : bool
        Whether an old dataset may be replaced; it stays whole until the new one is.
    resume : bool
        Go on with a run that was not finished, to the bytes it would have made; nothing is done where all is there.
    scheduler : str, optional
        Address of a dask scheduler, such as tcp://192.168.0.7:8786, whose workers make the shards in place of `jobs`;
        the output lies in a folder that all of them share, by the same name.
    progress : callable, optional
        Called with a number of signals whenever so many more are done.

    Raises
    ------
    CannotCreate
        The output exists, cannot be made, another run writes there, the run to be resumed had other options, or a
        worker does not share the folder.
    BadData
        What is to be resumed is damaged.
    ClusterFailed
        The scheduler does not answer, has no workers, or has lost them.
    MissingExtra
        dask.distributed is not installed.
    WriteFailed
        The disk is full; finished shards stay, but without a manifest they are no dataset. The run can be resumed.
    InvalidValue
        A number breaks its rule, or the scene randomises its sampling rate.
    """
    for name, value in (("n_signals", n_signals), ("jobs", jobs), ("shard_signals", shard_signals)):
        if value < 1:
            raise InvalidValue(f"{name} must be 1 or more, got {value}")
    if scene.randomise is not None and scene.randomise.sampling_rate is not None:
        low, high = scene.randomise.sampling_rate.extremes
        raise InvalidValue(
            f"scene {scene.name}: randomise.sampling_rate must be left out for a dataset, which has one sampling rate, "
            f"got {low:g} to {high:g} Hz; train on the scene itself (cgid train SCENE -o MODEL)"
        )
    require(validation.choice("compression", compression, COMPRESSIONS))
    path = check_output(output, overwrite or resume)
    next(synthesise(scene, 1, seed))  # what is wrong with the scene or the seed shows before anything is written
    plan = shard_plan(
        scene,
        {"format": FORMAT, "schema_version": SCHEMA_VERSION} | attributes_of(scene, seed, compression),
        validation.choice("dtype", dtype, ("float32", "float64")),
        compression,
    )
    if n_signals > MOST_SIGNALS:
        raise InvalidValue(f"n_signals must be at most {MOST_SIGNALS}, got {n_signals}; make several datasets")
    writer = DatasetWriter(path, plan, n_signals, shard_signals)
    # More workers than shards or processors only cost memory.
    jobs = min(jobs, len(writer.shards), os.cpu_count() or 1)
    # A cluster that does not answer is told before anything is written.
    with workers(jobs, scheduler) as crew, writer.begun(overwrite=overwrite, resume=resume) as run:
        if progress is not None and run.entries:
            progress(sum(entry.n_signals for entry in run.entries))
        with closing(write_shards(writer, scene, seed, dtype, run.missing, crew, progress)) as written:
            for entry in written:
                run.add(entry)
                if progress is not None and not crew.alone:
                    progress(entry.n_signals)
    return path


#: Bytes of a number in the file, at most; in CSV with its comma.
_BYTES, _BYTES_OF_TEXT = 8, 25


@dataclass(frozen=True)
class Tabulated:
    """What was written.

    Attributes
    ----------
    path : Path
    n_signals : int
    n_unmeasured : int
        Rows in which a feature could not be measured and is nan.
    """

    path: Path
    n_signals: int
    n_unmeasured: int


def tabulate(
    asked: Plan,
    output: str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Tabulated:
    """Write what a plan asks for as a table, with labels and specimens, and return what was written.

    Memory stays the same however many signals there are: they come in batches of a thousand.

    Parameters
    ----------
    asked : Plan
        For features, closed forms or parameters; see `cgid.scene.plan.plan`.
    output : str or Path
        Ending in .h5, .hdf5, .parquet (with the extra `parquet`) or .csv.
    n_signals, seed : int
    overwrite : bool
        Whether an old file may be replaced.
    progress : callable, optional
        Called with a number of signals whenever so many more are done.

    Raises
    ------
    CannotCreate
        The output exists, or cannot be made, or has no room.
    WriteFailed
        The disk is full; nothing is left behind.
    MissingExtra
        Parquet is asked for, and its library is not installed.
    InvalidValue
        A number breaks its rule, or the plan is one for signals.
    """
    if not 1 <= n_signals <= MOST_SIGNALS:
        raise InvalidValue(f"n_signals must lie between 1 and {MOST_SIGNALS}, got {n_signals}")
    request = asked.request
    path = check_table_output(output, overwrite)
    next(iter(columns_of(asked, 1, seed)))  # what is wrong with the plan or the seed shows before anything is written
    size = n_signals * (2 + len(request.column_units)) * (_BYTES_OF_TEXT if path.suffix == ".csv" else _BYTES)
    require_room(path, path.parent, size, "rows", "make room, or fewer signals")
    header = TableHeader(
        kind=asked.kind,
        units=request.column_units,
        attributes={"n_signals": n_signals} | attributes_of(request.scene, seed),
    )
    unmeasured = 0
    width = max(len(label.encode()) for label in request.scene.labels)
    with table_writer(path, header, width, overwrite=overwrite) as writer:
        for columns in columns_of(asked, n_signals, seed):
            writer.add(Rows(labels=columns.labels, specimen=columns.specimen, columns=columns.values))
            unmeasured += columns.n_unmeasured
            if progress is not None:
                progress(len(columns))
    return Tabulated(path, n_signals, unmeasured)

"""From a scene to files: a dataset of signals, or a table of features, closed forms or parameters."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info

from cgid import __version__
from cgid._lib import validation
from cgid._lib.files import require_room, write_whole
from cgid._lib.spelling import spelled
from cgid._lib.workers import SERIAL, Workers, workers
from cgid.errors import BadData, InvalidValue
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.synthesis.draws import BLOCK, parameter_units, require_seed
from cgid.scene.synthesis.plan import Plan
from cgid.scene.synthesis.synthesis import columns_of, synthesise
from cgid.signals import Batch
from cgid.store.dataset import describe_dataset, shard_content
from cgid.store.description import DIGEST, FORMAT, SCHEMA_VERSION
from cgid.store.folder import Description, sha256_of
from cgid.store.hdf5 import ShardMemory, ShardPlan
from cgid.store.reading import Dataset
from cgid.store.run import Run, begun, check_output, is_single_file, require_description
from cgid.store.table import TableHeader, check_table_output, table_writer

#: Signals per shard: 32 MiB of 2048 float32 samples, built in memory.
SHARD_SIGNALS = 4096
#: Maximum number of signals of a dataset or table.
MAX_SIGNALS = 10**9
#: Largest error of a signal made again, over its peak; processors differ less.
SAME = 1e-6
#: Limits of the signals made in advance: memory [bytes], but at least one block, and number of blocks.
_AHEAD_BYTES, _AHEAD_BLOCKS = 8 << 20, 4
#: Largest size of a number in a table, and in CSV with its comma [bytes].
_BYTES, _BYTES_OF_TEXT = 8, 25
#: The order in which root attributes are written: the bytes depend on it, and HDF5 does not store it.
_ORDER = (
    "format",
    "schema_version",
    "seed",
    "scene_name",
    "scene",
    "scene_sha256",
    "versions",
    "background_sha256",
    "laws",
)

_T = TypeVar("_T")


def generate(  # noqa: PLR0913
    scene: Scene | str | Path,
    output: str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    jobs: int = 1,
    dtype: Literal["float32", "float64"] = "float32",
    shard_signals: int = SHARD_SIGNALS,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset and return its path.

    Parameters
    ----------
    scene : Scene, str or Path
    output : str or Path
        Ending in .h5 or .hdf5 for one file, else a folder of shards.
    n_signals, seed : int
    jobs : int
        Worker processes; each has one shard in memory.
    dtype : {"float32", "float64"}
        Type of the samples.
    shard_signals : int
        Signals per shard of a folder; does not affect the signals.
    overwrite : bool
        Whether to replace an old dataset. A folder is no dataset until all of its shards are replaced.
    resume : bool
        Whether to complete an unfinished run, with the same bytes as an unbroken one; a complete dataset is kept.
    scheduler : str, optional
        Address of a dask scheduler, such as tcp://192.168.0.7:8786, whose workers replace `jobs`. All of them must see
        the output folder under the same name.
    progress : callable, optional
        Called with the number of signals finished since the last call.

    Returns
    -------
    Path

    Raises
    ------
    CannotCreate
        The output exists or cannot be made, another run writes there, the run to resume had other options, or a worker
        does not share the folder.
    BadData
        The run to resume is damaged, or its signals do not follow from the scene and its laws any more.
    ClusterFailed
        The scheduler does not answer, has no workers, or lost them.
    MissingExtra
        dask.distributed is not installed.
    WriteFailed
        The disk is full. Finished shards stay; the run can be resumed.
    InvalidValue
        A number is out of range, or the scene randomises its sampling rate.
    """
    scene = load_scene(scene)
    n_signals, seed = validation.count("n_signals", n_signals), require_seed(seed)
    jobs, shard_signals = validation.count("jobs", jobs), validation.count("shard_signals", shard_signals)
    if scene.randomise is not None and scene.randomise.sampling_rate is not None:
        low, high = scene.randomise.sampling_rate.extremes
        raise InvalidValue(
            f"scene {scene.name}: randomise.sampling_rate must be left out for a dataset, which has one sampling rate, "
            f"got {low:g} to {high:g} Hz; train on the scene itself (cgid train SCENE -o MODEL)"
        )
    path = check_output(output, FORMAT, overwrite or resume)
    next(synthesise(scene, 1, seed))  # raises errors of the scene or the seed before anything is written
    if n_signals > MAX_SIGNALS:
        raise InvalidValue(f"n_signals must be at most {MAX_SIGNALS}, got {n_signals}; make several datasets")
    validation.choice("dtype", dtype, ("float32", "float64"))
    plan, description = planned(path, scene, seed, n_signals, shard_signals, dtype)
    single = is_single_file(path)
    # More workers than shards or processors would only cost memory.
    jobs = min(jobs, description.n_files, os.cpu_count() or 1)
    if not single:
        # Existing files are kept or replaced by as much.
        size = plan.size(n_signals) - sum(file.stat().st_size for file in path.glob("shard-*.h5"))
        require_room(path, path.parent, size, "signals", "free some space, or make fewer signals")
    # The workers are created first, so that a missing cluster is reported before anything is written.
    with workers(jobs, scheduler) as pool, begun(path, description, overwrite=overwrite, resume=resume) as run:
        n_missing = sum(description.part(number)["n_signals"] for number in run.missing)
        if progress is not None and n_missing < n_signals:
            progress(n_signals - n_missing)
        make_shards(run, scene, seed, plan, pool, progress, overwrite=overwrite or not single)
    return path


def planned(
    path: Path, scene: Scene, seed: int, n_signals: int, shard_signals: int, dtype: str
) -> tuple[ShardPlan, Description]:
    """Return the plan of the shards of a dataset and its description; raises as `describe_dataset`."""
    attributes = {"format": FORMAT, "schema_version": SCHEMA_VERSION} | attributes_of(scene, seed)
    plan = ShardPlan(
        n_samples=scene.sampling.samples,
        dtype=dtype,
        label_width=max(len(label.encode()) for label in scene.labels),
        parameter_units=parameter_units(scene),
        attributes=in_order(attributes),
    )
    description = describe_dataset(path, plan, n_signals, shard_signals)
    return replace(plan, attributes={**plan.attributes, DIGEST: description.sha256}), description


def attributes_of(scene: Scene, seed: int) -> dict[str, Any]:
    """Return the root attributes of a dataset: scene, seed, and the versions and processor that its bytes depend on."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "h5py"))
    packages += f", {_processor()}"
    instructions = {
        "seed": seed,
        "scene_name": scene.name,
        "scene": scene.text,
        "scene_sha256": scene.sha256,
        "versions": f"cgid {__version__}, Python {platform.python_version()}, {packages}",
    }
    if scene.own_laws:
        instructions["laws"] = json.dumps(scene.own_laws)
    if scene.background is not None and scene.background.recorded is not None:
        # The scene contains only the name of the file; the samples depend on its content.
        instructions["background_sha256"] = sha256_of(scene.background.recorded.file(scene.folder))
    return instructions


def _processor() -> str:
    """Return the instructions that numpy uses here and the kernel of BLAS: the last digits depend on them."""
    instructions = np.show_config(mode="dicts").get("SIMD Extensions", {}).get("found") or ["baseline"]
    kernels = {str(library.get("architecture")) for library in threadpool_info() if library["user_api"] == "blas"}
    return f"instructions {instructions[-1]}, BLAS {'/'.join(sorted(kernels)) or 'unknown'}"


def in_order(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return root attributes in the order in which they are written."""
    return {name: attributes[name] for name in _ORDER if name in attributes} | dict(attributes)


# ---- shards ----------------------------------------------------------------------------------------------------------


class _Shard(NamedTuple):
    file: str
    first_signal: int
    n_signals: int


@dataclass(frozen=True, kw_only=True)
class _Work:
    """The data common to all shards: `place` is their folder, `digest` that of its description, if it has one."""

    scene: Scene
    seed: int
    plan: ShardPlan
    place: Path
    digest: str | None
    overwrite: bool


def make_shards(
    run: Run,
    scene: Scene,
    seed: int,
    plan: ShardPlan,
    pool: Workers = SERIAL,
    progress: Callable[[int], object] | None = None,
    *,
    overwrite: bool = True,
) -> None:
    """Make the missing shards of a run, and list their sums.

    Raises `BadData` if the first signals of a whole shard do not follow from the scene any more.
    """
    if run.missing and run.first_whole is not None:
        require_shard(run.first_whole, scene, seed)
    place, digest = (run.output.parent, None) if run.is_single else (run.output, run.description.sha256)
    names = [run.output.name] if run.is_single else run.description.names
    shards = [_Shard(names[number], **run.description.part(number)) for number in run.missing]
    work = _Work(scene=scene, seed=seed, plan=plan, place=place, digest=digest, overwrite=overwrite)
    if run.is_single or pool.is_serial:
        _write_in_turn(work, shards, run.add, progress)
        return
    with closing(pool.each(_write_one, _anywhere(work), shards, ordered=False)) as written:
        for file, sha256, n_signals in written:
            run.add(file, sha256)
            if progress is not None:
                progress(n_signals)


def require_shard(file: Path, scene: Scene, seed: int) -> None:
    """Raise `BadData` unless the first signals of a whole shard follow from the scene, made again."""
    dataset = Dataset(file)
    first, dtype = int(dataset.header.attributes.get("first_signal", 0)), cast(Any, dataset.header.dtype)
    # A block, since each population may have a law of its own.
    n = min(BLOCK, len(dataset))
    made = [batch.signals for batch in synthesise(scene, n, seed, first=first, dtype=dtype)]
    require_same_samples(file, next(dataset.batches(n)).signals, np.concatenate(made), scene)


def require_same_samples(file: Path, stored: NDArray[Any], made: NDArray[Any], scene: Scene) -> None:
    """Raise `BadData` unless signals (n, n_samples) of a file are those made again, within `SAME` of their peaks.

    The description of a folder names the module of a custom law, but not what that imports or reads.
    """
    for signal, again in zip(stored.astype(np.float64), made.astype(np.float64), strict=True):
        peak, error = np.abs(signal).max(initial=0), np.abs(signal - again).max(initial=0)
        allowed = SAME * peak
        if scene.sensor.bits is not None or scene.draws("bits"):  # a sample may fall on the next number
            allowed += 1.001 * np.diff(np.unique(signal)).min(initial=peak)
        if not error <= allowed:
            cause = "a library, or what the scene reads,"
            if scene.own_laws:
                cause = f"the module of {', '.join(scene.own_laws)}, or what it imports or reads,"
            raise BadData(
                f"{file}: its signals must follow from the scene, made again they differ by {error / peak:.2g} of the "
                f"peak; {cause} has changed: restore it, or generate all again with {spelled('overwrite', 'true')}"
            )


def _anywhere(work: _Work) -> _Work:
    """Return the same work with absolute paths, for processes with another working directory."""
    scene = work.scene.model_copy()
    scene.__dict__["folder"] = scene.folder.absolute()
    return replace(work, place=work.place.absolute(), scene=scene)


def _write_in_turn(
    work: _Work,
    shards: Sequence[_Shard],
    add: Callable[[str, str], object],
    progress: Callable[[int], object] | None = None,
) -> None:
    """Make shards one by one in this process, and `add` the name and the sum of each once it is on the disk.

    A shard is written and hashed beside the making of the next one.
    """
    dtype: Any = work.plan.dtype
    made = (
        batch
        for shard in shards
        for batch in synthesise(work.scene, shard.n_signals, work.seed, first=shard.first_signal, dtype=dtype)
    )
    n_ahead = min(max(1, _AHEAD_BYTES // work.plan.size(BLOCK)), _AHEAD_BLOCKS)
    memory, written_from = ShardMemory(), ShardMemory()
    with closing(ahead(made, n_ahead)) as batches, ThreadPoolExecutor(max_workers=1) as writer:
        written: Future[None] | None = None
        for shard in shards:
            signals = next_signals(batches, shard.n_signals, progress)
            content = shard_content(work.plan, shard.first_signal, shard.n_signals, signals, memory)
            if written is not None:
                written.result()
            written = writer.submit(_write, work, shard, content, add)
            memory, written_from = written_from, memory
        if written is not None:
            written.result()


def _write(work: _Work, shard: _Shard, content: memoryview, add: Callable[[str, str], object]) -> None:
    """Write a shard atomically, if the folder still has the description, and add its sum."""
    check = None if work.digest is None else partial(require_description, work.place, work.digest)
    with ThreadPoolExecutor(max_workers=1) as hasher:
        found = hasher.submit(hashlib.sha256, content)  # beside the writing, which waits for the disk
        write_whole(work.place / shard.file, content, overwrite=work.overwrite, check=check)
    add(shard.file, found.result().hexdigest())


def _write_one(work: _Work, shard: _Shard) -> tuple[str, str, int]:
    """Make one shard in a worker, and return its name, its sum and its number of signals."""
    if work.digest is not None:
        require_description(work.place, work.digest)  # a worker of a cluster may not share the folder
    sums: dict[str, str] = {}
    _write_in_turn(work, [shard], sums.__setitem__)
    return shard.file, sums[shard.file], shard.n_signals


def ahead(items: Iterable[_T], max_items: int) -> Generator[_T, None, None]:
    """Yield items that a thread makes in advance, at most `max_items`; raise the error of an item in its place."""
    source = iter(items)
    with ThreadPoolExecutor(max_workers=1) as maker:
        asked = deque(maker.submit(next, source, None) for _ in range(max_items))
        try:
            while (item := asked.popleft().result()) is not None:
                asked.append(maker.submit(next, source, None))
                yield item
        finally:
            maker.shutdown(wait=False, cancel_futures=True)


def next_signals(batches: Iterator[Batch], count: int, progress: Callable[[int], object] | None) -> Iterator[Batch]:
    """Yield the batches of the next `count` signals; no batch extends beyond the end of a shard."""
    while count:
        batch = next(batches)
        yield batch
        count -= len(batch)
        if progress is not None:
            progress(len(batch))


# ---- tables ----------------------------------------------------------------------------------------------------------


class Tabulated(NamedTuple):
    """The path of a table, and the number of rows in which a feature could not be measured and is nan."""

    path: Path
    n_unmeasured: int


def tabulate(
    requested: Plan,
    output: str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Tabulated:
    """Write a plan for features, closed forms or parameters as a table, with labels and specimens."""
    n_signals, seed = validation.whole("n_signals", n_signals, 1, MAX_SIGNALS), require_seed(seed)
    path = check_table_output(output, overwrite)
    next(iter(columns_of(requested, 1, seed)))  # raises errors of the plan or the seed before anything is written
    size = n_signals * (2 + len(requested.column_units)) * (_BYTES_OF_TEXT if path.suffix == ".csv" else _BYTES)
    require_room(path, path.parent, size, "rows", "free some space, or make fewer signals")
    header = TableHeader(
        kind=requested.kind,
        units=requested.column_units,
        attributes={"n_signals": n_signals} | attributes_of(requested.scene, seed),
    )
    unmeasured = 0
    width = max(len(label.encode()) for label in requested.scene.labels)
    with table_writer(path, header, width, overwrite=overwrite) as writer:
        for rows in columns_of(requested, n_signals, seed):
            writer.add(rows)
            measured = [np.isfinite(rows.columns[name]) for name in requested.features]
            unmeasured += len(rows) - int(np.count_nonzero(np.logical_and.reduce(measured))) if measured else 0
            if progress is not None:
                progress(len(rows))
    return Tabulated(path, unmeasured)

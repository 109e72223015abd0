"""From a scene to a dataset on disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Literal

from cgid import validation
from cgid.errors import InvalidValue
from cgid.scene.provenance import attributes_of, shard_plan
from cgid.scene.schema import Scene
from cgid.scene.synthesis import synthesise
from cgid.scene.workers import write_shards
from cgid.store import FORMAT, SCHEMA_VERSION, DatasetWriter, check_output
from cgid.store.compression import COMPRESSIONS, require
from cgid.workers import workers

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

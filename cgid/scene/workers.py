"""Who makes the shards of a dataset: this process, or several at once."""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Generator
from typing import Literal

from cgid.scene.overlap import write_in_turn
from cgid.scene.scene import Scene
from cgid.store import DatasetWriter
from cgid.store.manifest import ShardEntry


def write_shards(
    writer: DatasetWriter,
    scene: Scene,
    seed: int,
    dtype: Literal["float32", "float64"],
    shards: list[tuple[int, int, int]],
    jobs: int,
    progress: Callable[[int], object] | None,
) -> Generator[ShardEntry, None, None]:
    """Make these shards of a dataset and write them; yield each one's line of the manifest as it is done."""
    if jobs == 1:
        yield from write_in_turn(writer, scene, seed, dtype, shards, progress)
        return
    import joblib

    work = (joblib.delayed(_write_one)(writer, scene, seed, dtype, shard) for shard in shards)
    results = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(work)
    try:
        for entry in results:  # noqa: UP028 - `yield from` would pass an interruption on before the warning is off
            yield entry
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that work is cancelled is what an interruption is for
            results.close()


def _write_one(
    writer: DatasetWriter, scene: Scene, seed: int, dtype: Literal["float32", "float64"], shard: tuple[int, int, int]
) -> ShardEntry:
    # Ctrl-C reaches every process of the group; the one that waits for the workers answers it.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    (entry,) = write_in_turn(writer, scene, seed, dtype, [shard])
    return entry

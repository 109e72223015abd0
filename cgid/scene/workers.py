"""Who makes the shards of a dataset: this process, or several at once."""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Literal

from cgid.scene.scene import Scene
from cgid.scene.synthesis import synthesise
from cgid.signals import Batch
from cgid.store import DatasetWriter
from cgid.store.manifest import ShardEntry
from cgid.store.writing import BuiltShard


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
        # One thread hashes and writes a shard while the next one is made: neither holds Python's lock.
        with ThreadPoolExecutor(max_workers=1) as disk:
            waiting: Future[ShardEntry] | None = None
            for shard in shards:
                built = _build(writer, scene, seed, dtype, shard, progress)
                if waiting is not None:
                    yield waiting.result()
                waiting = disk.submit(writer.put, built)
                del built  # the thread alone keeps it, until it is written
            if waiting is not None:
                yield waiting.result()
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
    return writer.put(_build(writer, scene, seed, dtype, shard))


def _build(
    writer: DatasetWriter,
    scene: Scene,
    seed: int,
    dtype: Literal["float32", "float64"],
    shard: tuple[int, int, int],
    progress: Callable[[int], object] | None = None,
) -> BuiltShard:
    number, first, count = shard

    def batches() -> Iterator[Batch]:
        for batch in synthesise(scene, count, seed, first=first, dtype=dtype):
            yield batch
            if progress is not None:
                progress(len(batch))

    return writer.build_shard(number, first, count, batches())

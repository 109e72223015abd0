"""Shards that go to the disk while the next signals are made.

What packs, hashes and writes a shard and waits for the disk is not what makes signals, and neither holds Python's lock
for long. So a thread makes signals ahead, past the end of the shard, and neither waits for the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from typing import Literal, TypeVar

import numpy as np

from cgid.scene.draws import BLOCK
from cgid.scene.schema import Scene
from cgid.scene.synthesis import synthesise
from cgid.signals import Batch
from cgid.store import DatasetWriter
from cgid.store.manifest import ShardEntry

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

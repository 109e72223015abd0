"""Recordings that cgid itself made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cgid.recordings.contents import Contents

#: What to do with a dataset where a recording is wanted.
DATASET_CURE = "read it with cgid.store, or pick one of its signals with --index"


def read_own(path: Path) -> Contents:
    """Return the one channel of a recording made by `cgid generate`."""
    from cgid.store.reading import Recording

    recording = Recording(path)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with closing(recording.blocks(length)) as rows:
            for row in rows:
                yield row[None][list(channels)]

    return Contents(
        n_channels=1,
        blocks=blocks,
        n_samples=recording.n_samples,
        units=[recording.unit],
        sampling_rate=recording.sampling_rate,
    )

"""Training on a dataset that has no room in memory."""

import sys
from pathlib import Path

import pytest

from benchmarks.identification.streamed_training import made, trained_within


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits and tells the memory of a process so")
def test_training_takes_no_more_memory_for_more_signals(tmp_path: Path) -> None:
    n_signals, room = 16_384, 36 * 10**6
    little, large = made(tmp_path, n_signals)
    size = sum(file.stat().st_size for file in large.iterdir())
    assert size > 3.5 * room
    found = trained_within(room, little, large)  # fails where it has no room
    assert found["fails_at_once"]
    _, quarter, whole = found["peaks"]
    assert whole - quarter < size / 10

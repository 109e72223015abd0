"""Read recordings of many formats as signals, at once or block by block."""

from __future__ import annotations

from cgid.recordings.formats import MAX_STREAM, is_dataset, open_recording, read_recording
from cgid.recordings.recording import BLOCK_LENGTH, Blocks, Channel, RecordingFile
from cgid.recordings.sep005 import from_sep005, to_sep005

__all__ = [
    "BLOCK_LENGTH",
    "MAX_STREAM",
    "Blocks",
    "Channel",
    "RecordingFile",
    "from_sep005",
    "is_dataset",
    "open_recording",
    "read_recording",
    "to_sep005",
]


def __dir__() -> list[str]:
    return __all__

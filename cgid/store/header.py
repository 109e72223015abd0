"""What a shard says about itself; nothing in it is believed before it is checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData

FORMAT = "cgid-dataset"
SCHEMA_VERSION = 1
RECORDING_FORMAT, RECORDING_SCHEMA_VERSION = "cgid-recording", 1
TABLE_FORMAT, TABLE_VERSION = "cgid-table", 1
#: No larger shard is written: it is held in memory.
LARGEST_SHARD = 2 << 30


@dataclass(frozen=True)
class ShardHeader:
    """What a shard says about itself, checked."""

    n_signals: int
    n_samples: int
    dtype: str
    sampling_rate: float
    pre_trigger: int
    unit: str
    parameter_units: Mapping[str, str]
    attributes: Mapping[str, Any]


def require_schema(source: str, version: Any, known: int) -> None:
    """Raise `BadData` unless a file is of the version that is read."""
    if type(version) is int and version > known:
        raise BadData(f"{source}: schema_version {version} is newer than this cgid, which reads {known}: upgrade cgid")
    if version != known:
        raise BadData(f"{source}: schema_version must be {known}, got {version!r}: use the cgid that wrote it")


def text_of(labels: NDArray[np.bytes_]) -> NDArray[np.str_]:
    """Return stored labels as text."""
    return np.char.decode(labels, "utf-8", errors="replace")

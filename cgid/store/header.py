"""What a shard says about itself; nothing in it is believed before it is checked."""

from __future__ import annotations

import hashlib
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
    #: Bytes of a stored label.
    label_width: int


def require_schema(source: str, version: Any, known: int) -> None:
    """Raise `BadData` unless a file is of the version that is read."""
    if type(version) is int and version > known:
        raise BadData(f"{source}: schema_version {version} is newer than this cgid, which reads {known}: upgrade cgid")
    if version != known:
        raise BadData(f"{source}: schema_version must be {known}, got {version!r:.80}: use the cgid that wrote it")


def require_scene(source: str, attributes: Mapping[str, Any]) -> None:
    """Raise `BadData` if the text of the scene is not the one that was hashed: HDF5 does not check long attributes."""
    scene, digest = attributes.get("scene"), attributes.get("scene_sha256")
    if scene is not None and hashlib.sha256(str(scene).encode()).hexdigest() != digest:
        raise BadData(f"{source}: the text of the scene must fit scene_sha256, it does not; generate the file again")


def text_of(labels: NDArray[np.bytes_]) -> NDArray[np.str_]:
    """Return stored labels as text."""
    return np.char.decode(labels, "utf-8", errors="replace")

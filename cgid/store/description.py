"""Common to all files of cgid: names, versions, digests, and the header of a shard."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData

FORMAT, SCHEMA_VERSION = "cgid-dataset", 1
RECORDING_FORMAT, RECORDING_SCHEMA_VERSION = "cgid-recording", 1
TABLE_FORMAT, TABLE_VERSION = "cgid-table", 1
#: Largest shard [bytes]; a shard is built in memory.
MAX_SHARD_SIZE = 2 << 30
MAX_RECORDING = MAX_SHARD_SIZE
#: The compression that a description of a dataset states.
PLAIN = "none"
#: Root attribute of a file: the SHA-256 of its description.
DIGEST = "description_sha256"
#: Errors of h5py, pandas and pyarrow on damaged files.
DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError)
_MAGIC = b"\x89HDF\r\n\x1a\n"
_DIGEST = "digest"


@dataclass(frozen=True)
class ShardHeader:
    """The checked header of a shard."""

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
    """Raise `BadData` unless a file has the schema version that this cgid reads."""
    if type(version) is int and version > known:
        raise BadData(f"{source}: schema_version {version!s:.20} is newer than this cgid ({known}): upgrade cgid")
    if type(version) is not int or version != known:
        raise BadData(
            f"{source}: schema_version must be {known}, got {version!r:.40}, of an earlier development version of "
            "cgid; make the file anew"
        )


def require_scene(source: str, attributes: Mapping[str, Any]) -> None:
    """Raise `BadData` unless the scene's text has its SHA-256: HDF5 does not check long attributes."""
    scene, digest = attributes.get("scene"), attributes.get("scene_sha256")
    if scene is not None and hashlib.sha256(str(scene).encode()).hexdigest() != digest:
        raise BadData(f"{source}: the text of the scene must fit scene_sha256, it does not; generate the file again")


def text_of(labels: NDArray[np.bytes_]) -> NDArray[np.str_]:
    """Return stored labels as text."""
    return np.char.decode(labels, "utf-8", errors="replace")


def hdf5_format(path: Path) -> str | None:
    """Return the attribute `format` of an HDF5 file, "" if it has none; None if it cannot be opened."""
    if not is_hdf5(path):
        return None
    from cgid.store.gates import format_of  # loads h5py

    with suppress(BadData):
        return format_of(path)
    return None


def is_hdf5(path: Path) -> bool:
    """Return whether a regular file has HDF5's signature at 0, 512, 1024, 2048, ..."""
    try:
        if not path.is_file():
            return False
        size, offset = path.stat().st_size, 0
        with path.open("rb") as file:
            while offset + len(_MAGIC) <= size:
                file.seek(offset)
                if file.read(len(_MAGIC)) == _MAGIC:
                    return True
                offset = max(512, 2 * offset)
    except (OSError, ValueError):
        pass
    return False


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its SHA-256 in the additional field `digest`."""
    return {**content, _DIGEST: _sha256(content)}


def is_sound(content: Mapping[str, Any]) -> bool:
    """Return whether the content fits its digest."""
    try:
        return content.get(_DIGEST) == _sha256({name: value for name, value in content.items() if name != _DIGEST})
    except RecursionError:  # JSON just shallow enough to read may be too deep to write
        return False


def _sha256(content: Mapping[str, Any]) -> str:
    # Sorted and without spaces, so that the layout of the file does not matter.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()

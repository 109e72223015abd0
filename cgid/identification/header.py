"""The header of a model file: JSON that is read as strictly as it is written, and the digest over header and arrays."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData

FORMAT = "cgid-model"
#: 2: what must be known, guards, the calibration of prediction sets, networks.
#: 3: windows, several channels, reference spectra of sensors, linear discriminants.
#: 4: a digest over header and arrays.
SCHEMA_VERSION = 4
#: What an older header does not say, by its version.
_UNSAID: dict[int, dict[str, Any]] = {
    2: {"window_time": 0.0, "hop_time": 0.0, "n_channels": 1, "sensors": []},
    3: {},
    4: {},
}
#: A longer header is none: it would say a hundred bytes of each of twenty thousand recordings.
LARGEST_HEADER = 2 << 20
#: Lists and objects within each other; ours have seven.
_DEEPEST = 32
#: Numbers beyond this in either direction measure nothing, and squares of them are still numbers.
_LARGEST_NUMBER = 1e100
#: What the header must say beside the format, and as what.
_KINDS: dict[str, type] = {
    "family": str,
    "labels": list,
    "features": list,
    "known": list,
    "guards": list,
    "guard_limits": list,
    "unit": str,
    "sampling_rates": list,
    "temperature": float,
    "neighbourhood_limit": float,
    "training": dict,
    "window_time": float,
    "hop_time": float,
    "n_channels": int,
    "sensors": list,
}
_LISTS_OF_NUMBERS = ("guard_limits", "sampling_rates")
#: What it says beside these: the quantity follows from the unit, the rest has been looked at when they are read.
_BESIDE = {"format", "schema_version", "quantity", "sha256"}


class NewerSchema(BadData):
    """A file of a version that this cgid does not know yet; training again would not help."""


def read_header(stored: NDArray[Any]) -> dict[str, Any]:
    """Return what the header of a model file says, as it stands, once its version is one that is known.

    Raises
    ------
    NewerSchema
        It was written by a later cgid.
    BadData
        It is no JSON, says a thing twice, or is of another format or an older version.
    """
    if stored.size > LARGEST_HEADER:
        raise BadData(f"its header must be at most {LARGEST_HEADER >> 20} MiB, it is {stored.size / 2**20:.1f} MiB")
    try:
        header = json.loads(stored.tobytes(), object_pairs_hook=_each_once)
    except BadData:
        raise
    except (ValueError, RecursionError):
        raise BadData("it must have a header of JSON") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise BadData(f"format must be {FORMAT!r}")
    _check_depth(header)
    version = header.get("schema_version")
    oldest = min(_UNSAID)
    if type(version) is not int or version < oldest:
        raise BadData(f"schema_version must be {oldest} to {SCHEMA_VERSION}, got {repr(version)[:20]}")
    if version > SCHEMA_VERSION:
        reads = f"{oldest} to {SCHEMA_VERSION}"
        raise NewerSchema(f"schema_version {str(version)[:20]} is newer than this cgid (reads {reads}): upgrade cgid")
    return header


def fields_of(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return what a header says of a model, lists as tuples, once it is whole and of the right kinds.

    Raises
    ------
    BadData
        Something is missing, unheard of or of a wrong kind; or header and arrays do not match the digest.
    """
    version = header["schema_version"]
    if version >= 4 and header.get("sha256") != digest(header, arrays):
        raise BadData("header and arrays must match the SHA-256 in the header, they were changed")
    said = _UNSAID[version] | dict(header)
    if unheard := said.keys() - _KINDS.keys() - _BESIDE:
        raise BadData(f"the header must say nothing but what a model needs, got {min(unheard)[:40]!r}")
    for name, kind in _KINDS.items():
        if not _is(said.get(name), kind) or (
            name in _LISTS_OF_NUMBERS and not all(_is(number, float) for number in said[name])
        ):
            raise BadData(f"{name} is missing or of a wrong kind in the header")
    return {name: tuple(said[name]) if kind is list else said[name] for name, kind in _KINDS.items()}


def signed(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the header as text, with the digest over it and the arrays."""
    return json.dumps({**header, "sha256": digest(header, arrays)}, sort_keys=True).encode()


def digest(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 over all that a header says but for its digest, and over names, types, shapes and numbers.

    It finds every accidental change: a flipped bit, features in another order. Who changes a file on purpose can
    compute it anew.
    """
    said = {name: value for name, value in header.items() if name != "sha256"}
    found = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        found.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise BadData("its header must say each thing once")
    return found


def _is(value: Any, kind: type) -> bool:
    """Return whether a value out of JSON is of a kind; a whole number may stand for a float, a truth for nothing."""
    if kind in (int, float):
        number = type(value) is int or (kind is float and type(value) is float)
        return number and abs(value) <= _LARGEST_NUMBER  # false for nan
    return isinstance(value, kind)


def _check_depth(value: Any) -> None:
    """Raise unless lists and objects stand within each other no deeper than those of a model."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            inner
            for outer in level
            if isinstance(outer, (dict, list))
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise BadData(f"its header must not nest deeper than {_DEEPEST}")

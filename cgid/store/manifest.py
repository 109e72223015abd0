"""The manifest of a dataset folder: what the dataset is, and the size and SHA-256 of each of its shards."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

from cgid.errors import BadData, NoInput
from cgid.store.compression import COMPRESSIONS
from cgid.store.digest import is_sound, sealed
from cgid.store.folder_text import read_text
from cgid.store.header import FORMAT
from cgid.store.journal import read_journal
from cgid.store.sameness import first_difference

MANIFEST = "manifest.json"
#: Version 1 had neither digest nor the fields that `_ADDED` names.
MANIFEST_VERSION = 2
SHARD_NAME = r"shard-[0-9]{5,}\.h5"
_ADDED = ("shard_signals", "n_samples", "dtype", "compression")
_WORDS = {"dtype": ("float32", "float64"), "compression": tuple(COMPRESSIONS)}
#: What a folder holds may come from a stranger: where a link leads nobody looks.
LINKED = "must lie in the folder itself, it is a link; copy the file there"
#: Of what HDF5 counts.
_LARGEST_COUNT = 1 << 63


@dataclass(frozen=True)
class ShardEntry:
    """A shard in the manifest: its file, which signals are in it, its size and SHA-256, its signals by label."""

    file: str
    first_signal: int
    n_signals: int
    bytes: int
    sha256: str
    labels: dict[str, int]

    def fits(self, path: Path) -> bool:
        """Return whether a file has the SHA-256 of this shard; the file is read once, block by block.

        Raises
        ------
        NoInput
            One may not read it: it may be sound.
        """
        try:
            with path.open("rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest() == self.sha256
        except PermissionError as error:
            raise NoInput(f"{path}: cannot be read ({error.strerror}); see to its permissions") from None
        except OSError:
            return False


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a dataset folder holds.

    Attributes
    ----------
    n_signals : int
        In all shards.
    attributes : dict
        Root attributes of every shard: format, schema_version, seed, scene, its SHA-256, versions of libraries.
    shards : tuple of ShardEntry
        In the order of their signals, which they hold without a gap.
    shard_signals : int, optional
        Signals of each shard but the last.
    n_samples : int, optional
        Of a signal.
    dtype : str, optional
        Of the signals.
    compression : str, optional
        The last four are missing in manifests of version 1.
    """

    n_signals: int
    attributes: Mapping[str, Any]
    shards: tuple[ShardEntry, ...]
    shard_signals: int | None = None
    n_samples: int | None = None
    dtype: str | None = None
    compression: str | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All but the shards: what is settled before the first of them is made."""
        named = {name: getattr(self, name) for name in ("n_signals", *_ADDED)}
        return {"format": FORMAT, "schema_version": MANIFEST_VERSION, **named, "attributes": dict(self.attributes)}

    def require_own(self, shard: Path, attributes: Mapping[str, Any]) -> None:
        """Raise `BadData` if a shard names another seed, scene or the like: shard or manifest is another dataset's."""
        name = first_difference({"attributes": attributes}, {"attributes": self.attributes})
        if name is not None:
            wanted, got = (f"{said[name]!s:.80}" for said in (self.attributes, attributes))
            raise BadData(
                f"{shard}: {name} must be that of {MANIFEST}, {wanted}, got {got}: one of the two files belongs to "
                "another dataset; put the right one in its place, or move the shard away"
            )

    def to_bytes(self) -> bytes:
        """Return the content of the file, with the SHA-256 of all that it says."""
        content = sealed({**self.plan, "shards": [vars(entry) for entry in self.shards]})
        return (json.dumps(content, indent=1) + "\n").encode()


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a dataset folder, checked.

    Raises
    ------
    BadData
        There is none (an unfinished run is told as such), it is damaged, of a newer version, or another program's.
    NoInput
        It cannot be read.
    """
    file = folder / MANIFEST
    content = read_text(file)
    if content is None:
        unfinished = read_journal(folder)
        if unfinished is not None:
            raise BadData(f"{folder}: the run that makes it is not finished: {unfinished.progress}")
        raise BadData(
            f"{folder}: a dataset folder must hold {MANIFEST}; without it the run that made it was not "
            "finished: generate it again"
        )
    return parse_manifest(content, file)


def parse_manifest(content: bytes, file: Path) -> Manifest:
    """Return what the content of a manifest says; `file` is for messages. Raises as `read_manifest`."""
    found = _read_json(content, file)
    if found.get("format") != FORMAT:
        raise BadData(f"{file}: must have format {FORMAT!r}; this is another manifest")
    version = found.get("schema_version")
    if type(version) is not int or version < 1:
        raise BadData(f"{file}: schema_version must be a whole number of 1 or more, got {version!r:.40}")
    if version > MANIFEST_VERSION:
        raise BadData(f"{file}: schema {version} is newer than this cgid (reads 1 to {MANIFEST_VERSION}): upgrade cgid")
    if version > 1 and not is_sound(found):
        raise BadData(f"{file}: must fit the SHA-256 that it says of itself, it does not: it is damaged; copy it again")
    shards = found.get("shards")
    if not isinstance(shards, list) or not shards or not all(map(is_entry, shards)):
        raise BadData(f"{file}: shards must be a list of file, n_signals, sha256; generate the dataset again")
    entries = tuple(ShardEntry(**entry) for entry in shards)
    _require_all(entries, found.get("n_signals"), file)
    named = _added(found, file) if version > 1 else {}
    attributes = found.get("attributes")
    if not isinstance(attributes, dict) or not all(map(_is_attribute, attributes, attributes.values())):
        raise BadData(f"{file}: attributes must say how the dataset was made; generate it again")
    return Manifest(n_signals=found["n_signals"], attributes=attributes, shards=entries, **named)


def _read_json(content: bytes, file: Path) -> dict[str, Any]:
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        raise BadData(f"{file}: must be JSON, it is not; copy it again, or generate the dataset again") from None
    if not isinstance(found, dict):
        raise BadData(f"{file}: must have format {FORMAT!r}; this is another manifest")
    return found


def _require_all(entries: tuple[ShardEntry, ...], n_signals: Any, file: Path) -> None:
    starts = [0, *accumulate(entry.n_signals for entry in entries)]
    whole = (
        type(n_signals) is int and starts[-1] == n_signals and starts[:-1] == [entry.first_signal for entry in entries]
    )
    if not whole or len({entry.file for entry in entries}) < len(entries):
        raise BadData(
            f"{file}: every shard must be listed, and once, {n_signals!r:.20} signals in all; generate it again"
        )


def _added(found: Mapping[str, Any], file: Path) -> dict[str, Any]:
    named = {name: found.get(name) for name in _ADDED}
    for name, value in named.items():
        sound = value in _WORDS[name] if name in _WORDS else type(value) is int and 0 < value < _LARGEST_COUNT
        if not sound:
            raise BadData(f"{file}: {name} must be that of the shards, got {value!r:.40}; generate the dataset again")
    return named


def _is_attribute(name: str, value: Any) -> bool:
    """Return whether HDF5 can hold this as an attribute: a number, or a text that is Unicode."""
    try:
        name.encode()
        return (
            isinstance(value, float) or (isinstance(value, int) and abs(value) < _LARGEST_COUNT) or bool(value.encode())
        )
    except (AttributeError, UnicodeEncodeError):
        return False


def is_entry(entry: Any) -> bool:
    """Return whether this is what `ShardEntry` holds; its file lies in no other folder."""
    if not isinstance(entry, dict) or set(entry) != {field.name for field in fields(ShardEntry)}:
        return False
    counts, labels = [entry[name] for name in ("first_signal", "n_signals", "bytes")], entry["labels"]
    if not all(type(count) is int and 0 <= count < _LARGEST_COUNT for count in counts) or not entry["n_signals"]:
        return False
    if not isinstance(labels, dict) or not all(type(count) is int for count in labels.values()):
        return False
    return all(
        isinstance(text, str) and re.fullmatch(rule, text) is not None
        for text, rule in ((entry["file"], SHARD_NAME), (entry["sha256"], "[0-9a-f]{64}"))
    )

"""JSON that says its own SHA-256, so that a flipped bit in it is found.

What a shard says about itself; nothing in it is believed before it is checked.

Whether two runs make the same: by their plans, which say all that the bytes depend on.

The texts that lie in a folder of files, a manifest or a journal: read if they are what the folder bears out.

A folder may come from a stranger, too. A pipe in it would hold its reader up for ever, a link would have another file
read, and a hundred megabytes of JSON are gigabytes of lists.

The manifest of a dataset folder: what the dataset is, and the size and SHA-256 of each of its shards.
"""

from __future__ import annotations

import hashlib
import json
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CannotCreate, NoInput
from cgid.files import half_written
from cgid.store.compression import COMPRESSIONS

_DIGEST = "digest"


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its SHA-256 as one more field, `digest`."""
    return {**content, _DIGEST: _sha256(content)}


def is_sound(content: Mapping[str, Any]) -> bool:
    """Return whether content that was read back is what was sealed.

    Examples
    --------
    >>> content = sealed({"seed": 7})
    >>> is_sound(content), is_sound({**content, "seed": 6}), is_sound({"seed": 7})
    (True, False, False)
    """
    try:
        return content.get(_DIGEST) == _sha256({name: value for name, value in content.items() if name != _DIGEST})
    except RecursionError:  # what can just be read may be too deep to be written
        return False


def _sha256(content: Mapping[str, Any]) -> str:
    # Sorted and without spaces: the same text however the file is laid out.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


FORMAT = "cgid-dataset"
SCHEMA_VERSION = 1
RECORDING_FORMAT, RECORDING_SCHEMA_VERSION = "cgid-recording", 1
TABLE_FORMAT, TABLE_VERSION = "cgid-table", 1
#: No larger shard is written: it is held in memory.
LARGEST_SHARD = 2 << 30
#: No longer recording is made.
LARGEST_RECORDING = LARGEST_SHARD
#: What a folder of recordings holds, with what a killed run leaves behind.
RECORDING_NAME = r"recording-[0-9]{5,}\.h5"
OURS = re.compile(f"{RECORDING_NAME}|{half_written(RECORDING_NAME)}")


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


def require_same(output: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise `CannotCreate`, naming the first option that differs, unless a run makes what is there, too."""
    name = first_difference(there, asked)
    if name is not None:
        values = [flat.get(name, "nothing") for flat in (_flat(there), _flat(asked))]
        raise CannotCreate(
            f"{output}: {name} must be that of the run to be resumed, {values[0]!s:.80}, got {values[1]!s:.80}; give "
            "the options of the first run, or start again with --overwrite"
        )


def first_difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    """Return the name of the first option in which two plans differ; what one of them leaves open does not count.

    Examples
    --------
    >>> first_difference({"n_signals": 9, "attributes": {"seed": 1}}, {"n_signals": 9, "attributes": {"seed": 2}})
    'seed'
    >>> first_difference({"n_signals": 9, "dtype": None}, {"n_signals": 9, "dtype": "float32"})
    """
    here, other = _flat(asked), _flat(there)
    # The text of a scene comes last: its name and its SHA-256 say it shorter.
    names = sorted({*here, *other}, key=lambda name: (name == "scene", list(here).index(name) if name in here else 0))
    pairs = ((name, here.get(name), other.get(name)) for name in names)
    return next((name for name, one, two in pairs if None not in (one, two) and one != two), None)


def _flat(plan: Mapping[str, Any]) -> dict[str, Any]:
    attributes = plan.get("attributes")
    found = {**plan, **(attributes if isinstance(attributes, dict) else {})}
    return {name: value for name, value in found.items() if name != "attributes"}


#: What may be said beside the files [bytes], of which the scene is most, and of each file.
_ROOM, _ROOM_OF_FILE = 16 << 20, 4096
#: Likewise, in values of JSON.
_VALUES, _VALUES_OF_FILE = 100_000, 100


def read_text(file: Path) -> bytes | None:
    """Return the content of a plain file that is as large as the files beside it make it, at most; None without one.

    Raises
    ------
    BadData
        It is a link, no plain file, or larger.
    NoInput
        It cannot be read: what it says may be sound.
    """
    try:
        return _content(file)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise NoInput(f"{file}: cannot be read ({error.strerror}); see to its permissions, or to the disk") from None


def _content(file: Path) -> bytes:
    about = file.lstat()  # of a link, where it leads is not looked at
    if not stat.S_ISREG(about.st_mode):
        raise BadData(
            f"{file}: must be a regular file of its folder, it is a link, a pipe or the like; generate it again"
        )
    n_files = sum(1 for _ in file.parent.iterdir())
    most = _ROOM + n_files * _ROOM_OF_FILE
    content = b""
    if about.st_size <= most:
        with file.open("rb") as stream:
            content = stream.read(about.st_size + 1)  # room is made for all that is asked for
    if max(about.st_size, len(content)) > most:
        raise BadData(f"{file}: must be at most {most >> 20} MiB beside {n_files} files; it is not what cgid wrote")
    if sum(content.count(sign) for sign in (b",", b"[", b"{", b"\n")) > _VALUES + n_files * _VALUES_OF_FILE:
        raise BadData(f"{file}: says more than {n_files} files beside it bear out; it is not what cgid wrote")
    return content


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


JOURNAL = "unfinished.jsonl"


#: Bytes of the first line at most.
FIRST_LINE = 4096


#: Letters of what is told of a run.
_LONGEST_WORD = 400


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    """What a journal says.

    Attributes
    ----------
    run : str
        Tells this run from every other.
    process : str
        Who wrote it last.
    plan : dict
        What the run makes.
    n_files : int
        How many files it makes, and what they are called:
    noun : str
    entries : tuple of dict
        The finished files, in the order in which they were finished.
    """

    run: str
    process: str
    plan: dict[str, Any]
    n_files: int
    noun: str
    entries: tuple[dict[str, Any], ...]

    @property
    def progress(self) -> str:
        """How far it has come, and how it goes on."""
        done = len({entry["file"] for entry in self.entries})
        return f"{done} of {self.n_files} {self.noun} are there; go on with cgid generate ... --resume"


def read_journal(folder: Path) -> Unfinished | None:
    """Return what the journal of a folder says, or None where there is none.

    Raises
    ------
    BadData
        Its first lines are damaged, so that nobody knows what the run was to make; or it is no file of such a size.
    NoInput
        It cannot be read.
    """
    file = folder / JOURNAL
    content = read_text(file)
    if content is None:
        return None
    lines = content.split(b"\n")
    first, second = (content_of(line) for line in [*lines, b""][:2])
    found = {**first, **second}
    for name, kind in (("run", str), ("process", str), ("plan", dict), ("n_files", int), ("noun", str)):
        if not isinstance(found.get(name), kind) or not _is_short(found[name]):
            raise BadData(
                f"{file}: is damaged or not of cgid, so that no run can go on; choose another name, or start again "
                "with --overwrite"
            )
    # A line that is torn or damaged is passed over: its file is made again.
    entries = [content_of(line).get("entry") for line in lines[2:]]
    sound = tuple(entry for entry in entries if isinstance(entry, dict) and isinstance(entry.get("file"), str))
    named = {name: found[name] for name in ("run", "process", "plan", "n_files", "noun")}
    return Unfinished(entries=sound, **named)


def line_of(content: Mapping[str, Any]) -> bytes:
    """Return content as a line of JSON with its own SHA-256."""
    return (json.dumps(sealed(content)) + "\n").encode()


def _is_short(value: Any) -> bool:
    """Return whether a value can be said in a line, if it is a text."""
    return not isinstance(value, str) or (len(value) <= _LONGEST_WORD and value.isprintable())


def content_of(line: bytes) -> dict[str, Any]:
    """Return what a line says; nothing where it is torn or damaged."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and is_sound(found) else {}

"""Descriptions in dataset folders: the manifest, the sums of the files, the journal of a run.

A file follows from the description of its dataset and from its number. `manifest.json` holds the description and the
size and SHA-256 of each shard; `SHA256SUMS` repeats the sums for `sha256sum -c SHA256SUMS`. During a run
`unfinished.jsonl` holds the description and the finished files, one JSON object per line:

    {"run": ..., "process": ..., "digest": ...}     the run and the process that writes it
    {"plan": ..., "n_files": ..., "noun": ..., ...} the description of its output
    {"entry": ..., "digest": ...}                   a finished file, its size and SHA-256; one line per file

All of these are untrusted: they are checked before use.
"""

from __future__ import annotations

import hashlib
import json
import re
import stat
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CannotCreate, NoInput
from cgid.files import half_written

FORMAT, SCHEMA_VERSION = "cgid-dataset", 1
RECORDING_FORMAT, RECORDING_SCHEMA_VERSION = "cgid-recording", 1
TABLE_FORMAT, TABLE_VERSION = "cgid-table", 1
#: Largest shard [bytes]; a shard is built in memory.
LARGEST_SHARD = 2 << 30
LARGEST_RECORDING = LARGEST_SHARD
#: See `cgid.store.hdf5`.
COMPRESSIONS = ("none", "gzip", "zstd", "blosc2")
MANIFEST, SUMS, JOURNAL = "manifest.json", "SHA256SUMS", "unfinished.jsonl"
#: Version 1 lacked the digest and the fields in `_ADDED`.
MANIFEST_VERSION = 2
SHARD_NAME, RECORDING_NAME = r"shard-[0-9]{5,}\.h5", r"recording-[0-9]{5,}\.h5"
#: Names of files in a folder of shards or of recordings, including half-written ones of a killed run.
DATASET_FILES, RECORDING_FILES = (
    re.compile(f"{names}|{half_written(names)}")
    for names in (f"{re.escape(MANIFEST)}|{SUMS}|{SHARD_NAME}", f"{SUMS}|{RECORDING_NAME}")
)
#: Links in folders are not followed, because folders are untrusted.
LINKED = "must lie in the folder itself, it is a link; copy the file there"
#: Largest first line of a journal [bytes].
FIRST_LINE = 4096

_ADDED = ("shard_signals", "n_samples", "dtype", "compression")
_WORDS = {"dtype": ("float32", "float64"), "compression": COMPRESSIONS}
#: HDF5's counts are smaller.
_LARGEST_COUNT = 1 << 63
_DIGEST = "digest"
#: Largest text file [bytes], mostly for the scene, and additional bytes per file in its folder.
_ROOM, _ROOM_OF_FILE = 16 << 20, 4096
#: The same for JSON values.
_VALUES, _VALUES_OF_FILE = 100_000, 100
#: Longest text that a journal supplies for messages.
_LONGEST_WORD = 400


# ---- headers of files ------------------------------------------------------------------------------------------------


def is_dataset_folder(folder: Path) -> bool:
    """Return whether a folder is a dataset, even an unfinished or damaged one: by its manifest, journal or shards."""
    return any(mark.exists() for mark in (folder / MANIFEST, folder / JOURNAL, *folder.glob("shard-*.h5")))


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
        raise BadData(f"{source}: schema_version {version} is newer than this cgid, which reads {known}: upgrade cgid")
    if version != known:
        raise BadData(f"{source}: schema_version must be {known}, got {version!r:.80}: use the cgid that wrote it")


def require_scene(source: str, attributes: Mapping[str, Any]) -> None:
    """Raise `BadData` unless the scene's text has its SHA-256: HDF5 does not check long attributes."""
    scene, digest = attributes.get("scene"), attributes.get("scene_sha256")
    if scene is not None and hashlib.sha256(str(scene).encode()).hexdigest() != digest:
        raise BadData(f"{source}: the text of the scene must fit scene_sha256, it does not; generate the file again")


def text_of(labels: NDArray[np.bytes_]) -> NDArray[np.str_]:
    """Return stored labels as text."""
    return np.char.decode(labels, "utf-8", errors="replace")


# ---- JSON with a digest, in files of a plausible size ----------------------------------------------------------------


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its SHA-256 in the additional field `digest`."""
    return {**content, _DIGEST: _sha256(content)}


def is_sound(content: Mapping[str, Any]) -> bool:
    """Return whether the content fits its digest.

    Examples
    --------
    >>> content = sealed({"seed": 7})
    >>> is_sound(content), is_sound({**content, "seed": 6}), is_sound({"seed": 7})
    (True, False, False)
    """
    try:
        return content.get(_DIGEST) == _sha256({name: value for name, value in content.items() if name != _DIGEST})
    except RecursionError:  # JSON that is just shallow enough to read may be too deep to write
        return False


def _sha256(content: Mapping[str, Any]) -> str:
    # Sorted and without spaces, so that the layout of the file does not matter.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def read_text(file: Path) -> bytes | None:
    """Return the content of a text file in a dataset folder, None if it does not exist.

    The size limit grows with the number of files in the folder: 100 MB of JSON would take gigabytes of memory. Raises
    `BadData` for a link, a pipe or the like, or a file that is too large; `NoInput` if it cannot be read but may be
    sound.
    """
    try:
        about = file.lstat()
        if not stat.S_ISREG(about.st_mode):
            raise BadData(
                f"{file}: must be a regular file of its folder, it is a link, a pipe or the like; generate it again"
            )
        n_files = sum(1 for _ in file.parent.iterdir())
        most = _ROOM + n_files * _ROOM_OF_FILE
        content = b""
        if about.st_size <= most:
            with file.open("rb") as stream:
                content = stream.read(about.st_size + 1)  # no more: `read` allocates the requested size
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise NoInput(f"{file}: cannot be read ({error.strerror}); see to its permissions, or to the disk") from None
    if max(about.st_size, len(content)) > most:
        raise BadData(f"{file}: must be at most {most >> 20} MiB beside {n_files} files; it is not what cgid wrote")
    if sum(content.count(sign) for sign in (b",", b"[", b"{", b"\n")) > _VALUES + n_files * _VALUES_OF_FILE:
        raise BadData(f"{file}: says more than {n_files} files beside it bear out; it is not what cgid wrote")
    return content


# ---- comparing descriptions ------------------------------------------------------------------------------------------


def require_same(output: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise `CannotCreate` with the first option that differs, unless two descriptions agree."""
    name = first_difference(there, asked)
    if name is not None:
        values = [flat.get(name, "nothing") for flat in (_flat(there), _flat(asked))]
        raise CannotCreate(
            f"{output}: {name} must be that of the run to be resumed, {values[0]!s:.80}, got {values[1]!s:.80}; give "
            "the options of the first run, or start again with --overwrite"
        )


def first_difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    """Return the first option in which two descriptions differ; skip options that one of them lacks.

    Examples
    --------
    >>> first_difference({"n_signals": 9, "attributes": {"seed": 1}}, {"n_signals": 9, "attributes": {"seed": 2}})
    'seed'
    >>> first_difference({"n_signals": 9, "dtype": None}, {"n_signals": 9, "dtype": "float32"})
    """
    here, other = _flat(asked), _flat(there)
    # Report the scene's text last: its name and its SHA-256 are shorter.
    names = sorted({*here, *other}, key=lambda name: (name == "scene", list(here).index(name) if name in here else 0))
    pairs = ((name, here.get(name), other.get(name)) for name in names)
    return next((name for name, one, two in pairs if None not in (one, two) and one != two), None)


def _flat(description: Mapping[str, Any]) -> dict[str, Any]:
    attributes = description.get("attributes")
    found = {**description, **(attributes if isinstance(attributes, dict) else {})}
    return {name: value for name, value in found.items() if name != "attributes"}


# ---- the manifest of a dataset ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShardEntry:
    """A shard in the manifest; `labels` holds its number of signals per label."""

    file: str
    first_signal: int
    n_signals: int
    bytes: int
    sha256: str
    labels: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The description of a dataset folder and its shards.

    attributes : root attributes of every shard: format, schema_version, seed, scene, its SHA-256, library versions
    shards : in the order of their signals, without a gap
    shard_signals : signals of each shard except the last

    Manifests of version 1 lack the last four fields.
    """

    n_signals: int
    attributes: Mapping[str, Any]
    shards: tuple[ShardEntry, ...]
    shard_signals: int | None = None
    n_samples: int | None = None
    dtype: str | None = None
    compression: str | None = None

    @property
    def description(self) -> dict[str, Any]:
        """All fields except the shards; known before the first shard is made."""
        named = {name: getattr(self, name) for name in ("n_signals", *_ADDED)}
        return {"format": FORMAT, "schema_version": MANIFEST_VERSION, **named, "attributes": dict(self.attributes)}

    def require_own(self, shard: Path, attributes: Mapping[str, Any]) -> None:
        """Raise `BadData` if a shard names another seed or scene: shard or manifest belong to another dataset."""
        name = first_difference({"attributes": attributes}, {"attributes": self.attributes})
        if name is not None:
            wanted, got = (f"{said[name]!s:.80}" for said in (self.attributes, attributes))
            raise BadData(
                f"{shard}: {name} must be that of {MANIFEST}, {wanted}, got {got}: one of the two files belongs to "
                "another dataset; put the right one in its place, or move the shard away"
            )

    def to_bytes(self) -> bytes:
        """Return the content of the file, with its digest."""
        content = sealed({**self.description, "shards": [vars(entry) for entry in self.shards]})
        return (json.dumps(content, indent=1) + "\n").encode()


def read_manifest(folder: Path) -> Manifest:
    """Return the checked manifest of a dataset folder.

    Raises `BadData` if it is missing (perhaps because a run is unfinished), damaged, newer, or of another program;
    `NoInput` if it cannot be read.
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
    """Return the manifest with this content; `file` is for messages. Raises as `read_manifest`."""
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        raise BadData(f"{file}: must be JSON, it is not; copy it again, or generate the dataset again") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
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
    named = {name: found.get(name) for name in _ADDED if version > 1}
    for name, value in named.items():
        sound = value in _WORDS[name] if name in _WORDS else type(value) is int and 0 < value < _LARGEST_COUNT
        if not sound:
            raise BadData(f"{file}: {name} must be that of the shards, got {value!r:.40}; generate the dataset again")
    attributes = found.get("attributes")
    if not isinstance(attributes, dict) or not all(map(_is_attribute, attributes, attributes.values())):
        raise BadData(f"{file}: attributes must say how the dataset was made; generate it again")
    return Manifest(n_signals=found["n_signals"], attributes=attributes, shards=entries, **named)


def _require_all(entries: tuple[ShardEntry, ...], n_signals: Any, file: Path) -> None:
    """Raise `BadData` unless the shards hold `n_signals` signals, in order and without a gap."""
    starts = [0, *accumulate(entry.n_signals for entry in entries)]
    whole = (
        type(n_signals) is int and starts[-1] == n_signals and starts[:-1] == [entry.first_signal for entry in entries]
    )
    if not whole or len({entry.file for entry in entries}) < len(entries):
        raise BadData(
            f"{file}: every shard must be listed, and once, {n_signals!r:.20} signals in all; generate it again"
        )


def _is_attribute(name: str, value: Any) -> bool:
    """Return whether HDF5 can store an attribute: a number or Unicode text."""
    try:
        name.encode()
        return (
            isinstance(value, float) or (isinstance(value, int) and abs(value) < _LARGEST_COUNT) or bool(value.encode())
        )
    except (AttributeError, UnicodeEncodeError):
        return False


def is_entry(entry: Any) -> bool:
    """Return whether JSON is a `ShardEntry` of a file in the folder itself."""
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


# ---- sums of files ---------------------------------------------------------------------------------------------------


def file_facts(path: Path) -> dict[str, Any]:
    """Return `file`, `bytes` and `sha256` of a file, read block by block."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"file": path.name, "bytes": stream.tell(), "sha256": digest}


def has_sum(path: Path, sha256: str) -> bool:
    """Return whether a file has this SHA-256; raises `NoInput` without permission to read it, since it may be sound."""
    try:
        return bool(file_facts(path)["sha256"] == sha256)
    except PermissionError as error:
        raise NoInput(f"{path}: cannot be read ({error.strerror}); see to its permissions") from None
    except OSError:
        return False


def sums_text(sums: Mapping[str, str]) -> bytes:
    r"""Return the content of `SHA256SUMS` for names and their SHA-256.

    Examples
    --------
    >>> sums_text({"shard-00000.h5": "5e1f"})
    b'5e1f  shard-00000.h5\n'
    """
    return "".join(f"{digest}  {name}\n" for name, digest in sums.items()).encode()


def sums_of(shards: Iterable[ShardEntry], manifest: bytes) -> dict[str, str]:
    """Return the SHA-256 of each file of a dataset folder; `manifest` is the content of its file."""
    return {entry.file: entry.sha256 for entry in shards} | {MANIFEST: hashlib.sha256(manifest).hexdigest()}


def read_sums(folder: Path) -> dict[str, str] | None:
    """Return the SHA-256 of each file in `SHA256SUMS`; None if it is missing, as in folders of older versions.

    Raises `BadData` if it is damaged, `NoInput` if it cannot be read.
    """
    content = read_text(folder / SUMS)
    if content is None:
        return None
    lines = [re.fullmatch(r"([0-9a-f]{64})  ([\w.-]+)", line) for line in content.decode("latin-1").split("\n")[:-1]]
    sums = {line[2]: line[1] for line in lines if line}
    if not content.endswith(b"\n") or len(sums) < len(lines):
        raise BadData(f"{folder / SUMS}: must list a SHA-256 and a name on each line, it does not: it is damaged")
    return sums


# ---- the journal of an unfinished run --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    """The content of a journal.

    process : the process that last wrote the journal
    description : description of the output
    noun : plural noun for the files
    entries : finished files, in the order in which they were finished
    """

    process: str
    description: dict[str, Any]
    n_files: int
    noun: str
    entries: tuple[dict[str, Any], ...]

    @property
    def progress(self) -> str:
        """The progress of the run, and how to continue it."""
        done = len({entry["file"] for entry in self.entries})
        return f"{done} of {self.n_files} {self.noun} are there; go on with cgid generate ... --resume"


def read_journal(folder: Path) -> Unfinished | None:
    """Return the content of the journal in a folder, None if there is none.

    Raises `BadData` if the file is too large or its first lines, with the description, are damaged; `NoInput` if it
    cannot be read.
    """
    file = folder / JOURNAL
    content = read_text(file)
    if content is None:
        return None
    lines = content.split(b"\n")
    first, second = (content_of(line) for line in [*lines, b""][:2])
    found = {**first, **second}
    for name, kind in (("run", str), ("process", str), ("plan", dict), ("n_files", int), ("noun", str)):
        value = found.get(name)
        is_short = not isinstance(value, str) or (len(value) <= _LONGEST_WORD and value.isprintable())
        if not isinstance(value, kind) or not is_short:
            raise BadData(
                f"{file}: is damaged or not of cgid, so that no run can go on; choose another name, or start again "
                "with --overwrite"
            )
    # Skip torn and damaged lines: their files are made again.
    entries = [content_of(line).get("entry") for line in lines[2:]]
    sound = tuple(entry for entry in entries if isinstance(entry, dict) and isinstance(entry.get("file"), str))
    named = {name: found[name] for name in ("process", "n_files", "noun")}
    return Unfinished(entries=sound, description=found["plan"], **named)


def line_of(content: Mapping[str, Any]) -> bytes:
    """Return a line of a journal."""
    return (json.dumps(sealed(content)) + "\n").encode()


def content_of(line: bytes) -> dict[str, Any]:
    """Return the content of a line of a journal, empty if it is torn or damaged."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and is_sound(found) else {}

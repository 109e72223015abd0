"""A folder is a description, files that follow from it and carry its digest, and `SHA256SUMS`.

    description.json    everything that the files depend on
    shard-00000.h5 ...  the signals of a dataset; or recording-00000.h5 ..., the recordings of a stream
    SHA256SUMS          the sum of the description, then a line for each complete file
    .lock               held by the run that writes into the folder

If the first sum is not that of the description, all are void. A file is complete if its sum fits, or, without a sum, if
its digest, number and checksums do. All of these are untrusted: they are checked before use. `python
benchmarks/safety/kills.py` kills runs at any moment.
"""

from __future__ import annotations

import hashlib
import json
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cgid._lib.files import half_written
from cgid._lib.spelling import spelled
from cgid._lib.validation import RATES
from cgid.errors import BadData, CannotCreate, NoInput
from cgid.store.description import FORMAT, PLAIN, RECORDING_FORMAT, require_schema

DESCRIPTION, SUMS, LOCK = "description.json", "SHA256SUMS", ".lock"
FOLDER_VERSION = 3
#: What earlier development versions wrote instead of a description.
_FORMER = ("manifest.json", "unfinished.jsonl")
#: Links in folders are not followed, because folders are untrusted.
LINKED = "must be in the folder itself, it is a link; copy the file there"
#: Maximum number of files of a description.
MAX_FILES = 300_000
#: The beginning of the names of the files, and the field that counts them.
_STEMS = {FORMAT: "shard", RECORDING_FORMAT: "recording"}
#: HDF5's counts are smaller.
_MAX_COUNT = 1 << 63
#: Largest text file [bytes], mostly for the scene, and the increase of that limit per file in its folder.
_MAX_TEXT, _MAX_TEXT_PER_FILE = 16 << 20, 4096
_VALUES, _VALUES_OF_FILE = 100_000, 100


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 < value < _MAX_COUNT


#: The fields of each kind, besides the attributes of all files, and their rules.
_FIELDS: Mapping[str, Mapping[str, Callable[[Any], bool]]] = {
    FORMAT: {
        "n_signals": _is_count,
        "shard_signals": _is_count,
        "n_samples": _is_count,
        "dtype": ("float32", "float64").__contains__,
        "compression": (PLAIN,).__contains__,
    },
    RECORDING_FORMAT: {
        "n_recordings": _is_count,
        "n_samples": _is_count,
        "dtype": ("float32", "float64").__contains__,
        "sampling_rate": lambda rate: isinstance(rate, float) and RATES[0] <= rate <= RATES[1],
        "unit": lambda unit: isinstance(unit, str) and len(unit) < 80,
    },
}


# ---- the description -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Description:
    """Everything that a single file or the files of a folder depend on; `text` is its JSON; made by `describe`."""

    content: Mapping[str, Any]
    text: bytes

    @cached_property
    def sha256(self) -> str:
        """The digest that the files carry."""
        return hashlib.sha256(self.text).hexdigest()

    @property
    def kind(self) -> str:
        """The format of its files."""
        return str(self.content["format"])

    @property
    def noun(self) -> str:
        """Plural noun for its files."""
        return f"{_STEMS[self.kind]}s"

    @property
    def n_files(self) -> int:
        """Number of files."""
        if self.kind == RECORDING_FORMAT:
            return int(self.content["n_recordings"])
        return -int(-self.content["n_signals"] // self.content["shard_signals"])

    @property
    def names(self) -> list[str]:
        """Names of the files in a folder, by number."""
        return [self.name(number) for number in range(self.n_files)]

    def name(self, number: int) -> str:
        """Return the name of a file in a folder."""
        return f"{_STEMS[self.kind]}-{number:05d}.h5"

    def part(self, number: int) -> dict[str, int]:
        """Return the attributes that locate a file in its folder: `first_signal` and `n_signals`, or `recording`."""
        if self.kind == RECORDING_FORMAT:
            return {"recording": number}
        first = number * self.content["shard_signals"]
        return {
            "first_signal": first,
            "n_signals": min(self.content["shard_signals"], self.content["n_signals"] - first),
        }


def describe(kind: str, attributes: Mapping[str, Any], **fields: Any) -> Description:
    """Return the description of files of a kind (their format); `fields` as in `_FIELDS`."""
    content = {
        "format": kind,
        "schema_version": FOLDER_VERSION,
        **{name: fields[name] for name in _FIELDS[kind]},
        "attributes": dict(sorted(attributes.items())),
    }
    return Description(content, (json.dumps(content, indent=1) + "\n").encode())


def parse_description(text: bytes, file: Path) -> Description:
    """Return the checked description with this content; `file` is for messages. Raises `BadData`."""
    content = _json(text, file)
    if content.get("format") not in _FIELDS:
        raise BadData(f"{file}: must have format {' or '.join(map(repr, _FIELDS))}; it belongs to another program")
    require_schema(str(file), content.get("schema_version"), FOLDER_VERSION)
    _require_fields(content, file)
    return Description(content, text)


def _json(text: bytes, file: Path) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise BadData(f"{file}: must be a JSON object, the file is damaged; copy it again")
    return content


def _require_fields(content: Mapping[str, Any], file: Path) -> None:
    for name, is_valid in _FIELDS[content["format"]].items():
        if not is_valid(content.get(name)):
            raise BadData(f"{file}: {name} must be that of the files, got {content.get(name)!r:.40}; generate it again")
    attributes = content.get("attributes")
    if not isinstance(attributes, dict) or not all(map(_is_attribute, attributes, attributes.values())):
        raise BadData(f"{file}: attributes must describe how the files were made; generate them again")
    if Description(content, b"").n_files > MAX_FILES:
        raise BadData(f"{file}: must describe at most {MAX_FILES} files; cgid did not write this one")


def _is_attribute(name: str, value: Any) -> bool:
    """Return whether HDF5 can store an attribute: a number or Unicode text."""
    try:
        name.encode()
        return isinstance(value, float) or (isinstance(value, int) and abs(value) < _MAX_COUNT) or bool(value.encode())
    except (AttributeError, UnicodeEncodeError):
        return False


def require_same(output: Path, present: Mapping[str, Any], required: Mapping[str, Any]) -> None:
    """Raise `CannotCreate` with the first option that differs, unless two descriptions agree."""
    name = first_difference(present, required)
    if name is not None:
        values = [flat.get(name, "nothing") for flat in (_flat(present), _flat(required))]
        raise CannotCreate(
            f"{output}: {name} must be that of the description, {values[0]!s:.200}, got {values[1]!s:.200}; "
            f"give the options of the first run, or start again with {spelled('overwrite', 'true')}"
        )


def first_difference(present: Mapping[str, Any], required: Mapping[str, Any]) -> str | None:
    """Return the first option in which two descriptions differ, None if they are equal."""
    one, two = _flat(present), _flat(required)
    # Report the scene's text last: its name and its SHA-256 are shorter.
    names = sorted({**two, **one}, key=lambda name: name == "scene")
    return next((name for name in names if one.get(name) != two.get(name)), None)


def _flat(description: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in description.items() if name != "attributes"} | dict(
        description["attributes"]
    )


# ---- a folder --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Folder:
    """The description of a folder, whose digest its files carry, and the known sums of them."""

    path: Path
    description: Description
    sums: Mapping[str, str]


def read_folder(path: Path) -> Folder:
    """Return the description and sums of a folder; raises `BadData` or `NoInput`."""
    file = path / DESCRIPTION
    text = read_text(file)
    if text is not None:
        description = parse_description(text, file)
        return Folder(path=path, description=description, sums=read_sums(path, description.sha256))
    require_not_former(path)
    cure = (
        "cgid generate ... --resume writes it again"
        if is_dataset_folder(path)
        else "of a folder of recordings, give one recording a call"
    )
    raise BadData(f"{path}: must have a {DESCRIPTION}, it has none; {cure}")


def require_not_former(path: Path) -> None:
    """Raise `BadData` if a folder without a description is of an earlier development version."""
    sums = read_sums(path, None)  # those of recordings were without a description
    if (sums and DESCRIPTION not in sums) or any((path / name).exists() for name in _FORMER):
        raise BadData(
            f"{path}: must have a {DESCRIPTION}, an earlier development version of cgid made it without; make it anew "
            "in another folder with cgid generate"
        )


def is_dataset_folder(folder: Path) -> bool:
    """Return whether a folder is a dataset, even an unfinished or damaged one: by its description or its shards."""
    is_described = (folder / DESCRIPTION).exists() and not any(folder.glob("recording-*.h5"))
    return is_described or any(folder.glob("shard-*.h5"))


def names_of(kind: str) -> re.Pattern[str]:
    """Return the names of the files that a run of this kind may replace, including half-written ones."""
    names = rf"{_STEMS[kind]}-[0-9]{{5,}}\.h5|{re.escape(DESCRIPTION)}|{SUMS}|{re.escape(LOCK)}"
    return re.compile(f"{names}|{half_written(names)}")


def read_text(file: Path) -> bytes | None:
    """Return the content of a text file in a folder, None if it does not exist; raises `BadData` or `NoInput`."""
    # The limits grow with the number of files in the folder: 100 MB of JSON would take gigabytes of memory.
    try:
        about = file.lstat()
        n_files = sum(1 for _ in file.parent.iterdir())
        is_sound = stat.S_ISREG(about.st_mode) and about.st_size <= _MAX_TEXT + n_files * _MAX_TEXT_PER_FILE
        content = b""
        if is_sound:
            with file.open("rb") as stream:
                content = stream.read(about.st_size)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise NoInput(f"{file}: cannot be read ({error.strerror}); see to its permissions, or to the disk") from None
    if not is_sound or sum(map(content.count, (b",", b"[", b"{", b"\n"))) > _VALUES + n_files * _VALUES_OF_FILE:
        raise BadData(f"{file}: must be a regular file of a size that fits {n_files} files; generate it again")
    return content


# ---- sums ------------------------------------------------------------------------------------------------------------


def sums_text(sums: Mapping[str, str]) -> bytes:
    """Return the content of `SHA256SUMS` for names and their SHA-256."""
    return "".join(f"{digest}  {name}\n" for name, digest in sums.items()).encode()


def read_sums(folder: Path, description_sha256: str | None) -> dict[str, str]:
    """Return the sums in `SHA256SUMS`; none unless the first is that of the description, if there is one."""
    # A damaged or incomplete line is ignored.
    content = read_text(folder / SUMS) or b""
    lines = [re.fullmatch(r"([0-9a-f]{64})  ([\w.-]+)", line) for line in content.decode("latin-1").split("\n")[:-1]]
    if description_sha256 is not None:
        head = lines.pop(0) if lines else None
        if head is None or head.groups() != (description_sha256, DESCRIPTION):
            return {}
    return {line[2]: line[1] for line in lines if line}


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, read block by block."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def has_sum(path: Path, sha256: str) -> bool:
    """Return whether a file has this SHA-256; raises `NoInput` without permission to read it, since it may be sound."""
    try:
        return sha256_of(path) == sha256
    except PermissionError as error:
        raise NoInput(f"{path}: cannot be read ({error.strerror}); see to its permissions") from None
    except OSError:
        return False

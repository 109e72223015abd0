"""Verification of datasets, recordings and tables: which files are damaged, and which rows of them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cgid.errors import BadData, CgidError, NoInput
from cgid.files import half_written
from cgid.store import sandbox
from cgid.store.description import (
    FORMAT,
    JOURNAL,
    LINKED,
    MANIFEST,
    RECORDING_FORMAT,
    RECORDING_NAME,
    SHARD_NAME,
    SUMS,
    TABLE_FORMAT,
    Manifest,
    ShardEntry,
    Unfinished,
    has_sum,
    is_entry,
    read_journal,
    read_manifest,
    read_sums,
    sums_of,
)
from cgid.store.run import hidden
from cgid.store.table import TABLE_SUFFIXES, read_table

#: By HDF5's numbers of filters; see `cgid.store.hdf5`.
_COMPRESSIONS = {1: "gzip", 32015: "zstd", 32026: "blosc2"}
#: Problems without damage.
_HARMLESS = ("leftover", "pending", "foreign")
_KINDS = {FORMAT: "dataset", RECORDING_FORMAT: "recording", TABLE_FORMAT: "table"}
#: Most missing recordings in a numbered series, and additional ones for each that exists.
_MOST_MISSING, _MISSING_FOR_EACH = 100, 10
#: Most runs of damaged rows that are named for one dataset.
_MOST_TOLD = 4


def examine_file(path: str | Path, steps: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return the readable content of a shard, a recording or a table in HDF5, which may be damaged.

    fault : why the file cannot be read, "" if its headers are sound
    attributes : root attributes
    filters, dtype, n_samples : of the signals or samples; filters by their HDF5 numbers
    chunks : dataset name -> list of (first row, row after the last, SHA-256 of the values, "" if the checksum fails)

    `steps` sets the number of rows hashed together in each dataset, to compare with another file; by default its
    chunks.
    """
    found: dict[str, Any] = {"fault": "", "attributes": {}, "filters": [], "dtype": "", "n_samples": 0, "chunks": {}}
    try:
        for piece in sandbox.stream("examine", Path(path), dict(steps or {})):
            if "name" in piece:
                found["chunks"].setdefault(piece["name"], []).extend(map(tuple, piece["chunks"]))
            else:
                found.update(piece)
    except BadData as error:
        found["fault"] = str(error)
    return found


def damaged_rows(chunks: Iterable[Sequence[Any]]) -> list[tuple[int, int]]:
    """Return the unreadable rows in `chunks` of `examine_file`, as (first, after the last) of each run.

    Examples
    --------
    >>> damaged_rows([(0, 4, ""), (4, 8, ""), (8, 12, "5e1f"), (12, 14, "")])
    [(0, 8), (12, 14)]
    """
    runs: list[tuple[int, int]] = []
    for first, behind, digest in chunks:
        if digest:
            continue
        if runs and runs[-1][1] == first:
            runs[-1] = (runs[-1][0], behind)
        else:
            runs.append((first, behind))
    return runs


def compression_of(examined: Mapping[str, Any]) -> str:
    """Return the compression of the signals from the result of `examine_file`."""
    return next((_COMPRESSIONS[code] for code in examined["filters"] if code in _COMPRESSIONS), "none")


def examine_whole(path: Path, kind: str) -> dict[str, Any]:
    """Return the result of `examine_file` for an existing file that a run may keep.

    Raises `BadData` if it is damaged or not of the format `kind`, `NoInput` if it cannot be read.
    """
    examined = examine_file(path)
    if examined["fault"] and not sandbox.is_hdf5(path):
        raise BadData(f"{path}: is there and is no {kind}; choose another name")
    if damage_in_words(examined):
        raise BadData(f"{path}: is there and is not whole; make it again with --overwrite, without --resume")
    if examined["attributes"].get("format") != kind:
        raise BadData(f"{path}: is there and is no {kind}; choose another name, or replace it with --overwrite")
    return examined


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A problem with a file.

    problem : "damaged", "missing" or "unfinished"; harmless are "leftover" (of a stopped run), "pending" (an unfinished
        run will replace the whole folder) and "foreign" (the file does not belong to it)
    what : description of the problem, in one line
    examined : result of `examine_file`; empty if that was not needed
    entry : the manifest entry of the file
    sha256 : expected sum, from the manifest or `SHA256SUMS`
    """

    file: Path
    problem: str
    what: str
    examined: Mapping[str, Any] = field(default_factory=dict)
    entry: ShardEntry | None = None
    sha256: str | None = None

    @property
    def harmful(self) -> bool:
        """Whether data are lost unless the file is repaired."""
        return self.problem not in _HARMLESS


@dataclass(frozen=True, kw_only=True)
class Verified:
    """The result of `verify`.

    Attributes
    ----------
    path : Path
        What was examined.
    kind : str
        "dataset", "recording", "table", or "file" if it is too damaged to know.
    n_files : int
        Number of examined files.
    findings : tuple of Finding
        Each damaged, missing or surplus file.
    manifest : Manifest or None
        Manifest of a folder of shards, if it is sound.
    """

    path: Path
    kind: str
    n_files: int
    findings: tuple[Finding, ...]
    manifest: Manifest | None = None

    @property
    def damage(self) -> tuple[Finding, ...]:
        """The harmful findings."""
        return tuple(finding for finding in self.findings if finding.harmful)


def verify(path: str | Path) -> Verified:
    """Return the damage of a dataset, a recording, a folder of recordings, or a table.

    Files in a folder are compared with their SHA-256, which finds every change. Where it differs or is unknown, every
    chunk is compared with its checksum. A CSV table has no checksums: only damage that makes it unreadable is found.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Verified
        Its `findings` are empty if nothing is damaged; `cgid.scene.repair.repair` takes it.

    Raises
    ------
    NoInput
        The path does not exist or cannot be read.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise NoInput(f"{path}: no such file or folder; give a dataset, recording, table or model of cgid")
        if not path.is_dir():
            return _verify_file(path)
        if any(re.fullmatch(RECORDING_NAME, name) for name in _names(path)):
            return _verify_recordings(path)
        return _verify_dataset(path)
    except CgidError:
        raise
    except OSError as error:
        raise NoInput(f"{path}: cannot be looked into ({error.strerror}); see to the permissions") from None


def damaged_shards(path: str | Path) -> list[str]:
    """Return the shards of a dataset folder that differ from the SHA-256 in the manifest; none for a single file.

    Raises `BadData` for a folder without a sound manifest.
    """
    folder = Path(path)
    if not folder.is_dir():
        return []
    shards = read_manifest(folder).shards
    return [str(folder / entry.file) for entry in shards if not has_sum(folder / entry.file, entry.sha256)]


# ---- a file ----------------------------------------------------------------------------------------------------------


def _verify_file(path: Path) -> Verified:
    if path.suffix.lower() in TABLE_SUFFIXES[2:]:
        kind, found = "table", _unreadable_table(path)
    else:
        examined = examine_file(path)
        kind = _KINDS.get(examined["attributes"].get("format"), "file")
        found = _damage(path, examined) or (_unreadable_table(path) if kind == "table" else [])
    part = re.compile(half_written(re.escape(path.name)))
    found += [_left(path.parent / name) for name in _names(path.parent) if part.fullmatch(name)]
    return Verified(path=path, kind=kind, n_files=1, findings=tuple(found))


def _unreadable_table(path: Path) -> list[Finding]:
    try:
        read_table(path)
    except BadData as error:
        return [Finding(file=path, problem="damaged", what=str(error))]
    return []


def _damage(path: Path, examined: Mapping[str, Any]) -> list[Finding]:
    what = damage_in_words(examined)
    return [Finding(file=path, problem="damaged", what=what, examined=examined)] if what else []


def damage_in_words(examined: Mapping[str, Any]) -> str:
    """Describe the unreadable rows of each dataset, "" if there are none.

    Examples
    --------
    >>> damage_in_words({"fault": "", "chunks": {"signals": [(0, 4, ""), (4, 8, "5e1f")], "labels": [(0, 8, "a0")]}})
    'signals 0 to 3 do not fit their checksum'
    """
    if examined["fault"]:
        return str(examined["fault"])
    told = []
    for name, chunks in examined["chunks"].items():
        runs = damaged_rows(chunks)
        rows = [f"{first} to {behind - 1}" for first, behind in runs[:_MOST_TOLD]]
        more = [f"{len(runs) - _MOST_TOLD} more runs"] if len(runs) > _MOST_TOLD else []
        if runs:
            told.append(f"{name} {', '.join(rows + more)}")
    return f"{'; '.join(told)} do not fit their checksum" if told else ""


# ---- folders ---------------------------------------------------------------------------------------------------------


def _verify_dataset(folder: Path) -> Verified:
    found: list[Finding] = []
    journal, unfinished = _journal(folder)
    manifest, entries = None, tuple[ShardEntry, ...]()
    if journal is not None:
        entries = tuple(ShardEntry(**entry) for entry in journal.entries if is_entry(entry))
    try:
        manifest = read_manifest(folder)
        entries = manifest.shards
    except BadData as error:
        if not unfinished:
            problem = "damaged" if (folder / MANIFEST).exists() else "missing"
            found.append(Finding(file=folder / MANIFEST, problem=problem, what=str(error)))
    for entry in entries:
        found += _verify_one(folder / entry.file, entry.sha256, "the manifest", entry)
    known = {entry.file for entry in entries}
    if manifest is None:  # an unfinished run may have made files that its journal does not list yet
        known |= {name for name in _names(folder) if re.fullmatch(SHARD_NAME, name)}
        for name in sorted(known) if not unfinished else ():
            found += _verify_one(folder / name)
        found += unfinished
    else:
        found += [_left(finding.file) for finding in unfinished] or _verify_sums(folder, manifest)
    found += _others(folder, {*known, MANIFEST, SUMS, JOURNAL}, SHARD_NAME)
    return Verified(path=folder, kind="dataset", n_files=len(known) + 1, findings=tuple(found), manifest=manifest)


def _verify_sums(folder: Path, manifest: Manifest) -> list[Finding]:
    """Return `SHA256SUMS` as a finding unless it agrees with the manifest; older folders have none."""
    what = "does not list the SHA-256 of the shards and of the manifest"
    try:
        if read_sums(folder) in (None, sums_of(manifest.shards, (folder / MANIFEST).read_bytes())):
            return []
    except BadData as error:
        what = str(error)
    return [Finding(file=folder / SUMS, problem="damaged", what=what)]


def _verify_recordings(folder: Path) -> Verified:
    names, found = _recordings(folder), []
    try:
        sums = read_sums(folder) or {}
        if not all(re.fullmatch(RECORDING_NAME, name) for name in sums):
            raise BadData(f"{folder / SUMS}: must list recordings, it lists other names: it is damaged")
    except BadData as error:
        sums = {}
        found = [Finding(file=folder / SUMS, problem="damaged", what=str(error))]
    for name in dict.fromkeys([*sums, *names]):
        found += _verify_one(folder / name, sums.get(name), SUMS)
    found += _journal(folder)[1]
    if not sums:  # without sums only gaps are seen
        gaps = sorted({f"recording-{k:05d}.h5" for k in range(_number(names[-1]))} - set(names)) if names else []
        found += [Finding(file=folder / name, problem="missing", what="is not there") for name in gaps]
    found += _others(folder, {*names, SUMS, JOURNAL}, RECORDING_NAME)
    return Verified(path=folder, kind="recording", n_files=len(names), findings=tuple(found))


def _recordings(folder: Path) -> list[str]:
    """Return the names of the recordings in a folder by number, without numbers far beyond the others."""
    names = sorted((name for name in _names(folder) if re.fullmatch(RECORDING_NAME, name)), key=_number)
    last = _MOST_MISSING + (1 + _MISSING_FOR_EACH) * len(names)
    return [name for name in names if _number(name) < last]


def _number(name: str) -> int:
    return int(name.removeprefix("recording-").removesuffix(".h5"))


def _verify_one(
    path: Path, sha256: str | None = None, listed_in: str = "", entry: ShardEntry | None = None
) -> list[Finding]:
    """Return the problem of a file in a folder; `sha256` is None if its sum is unknown."""
    examined: dict[str, Any] = {}
    problem, what = "damaged", ""
    if path.is_symlink():
        what = LINKED
    elif sha256 and not path.is_file():
        problem, what = "missing", "is not there"
    elif not (sha256 and has_sum(path, sha256)):
        examined = examine_file(path)
        what = damage_in_words(examined)
        if sha256 and not what:
            what = f"does not fit the SHA-256 of {listed_in}, though all of it can be read"
    if not what:
        return []
    return [Finding(file=path, problem=problem, what=what, examined=examined, entry=entry, sha256=sha256)]


def _journal(folder: Path) -> tuple[Unfinished | None, list[Finding]]:
    """Return the journal of a folder, if it is sound, and the finding that it is there."""
    try:
        journal = read_journal(folder)
    except BadData as error:
        return None, [Finding(file=folder / JOURNAL, problem="damaged", what=str(error))]
    if journal is None:
        return None, []
    return journal, [Finding(file=folder / JOURNAL, problem="unfinished", what=journal.progress)]


def _left(file: Path) -> Finding:
    return Finding(file=file, problem="leftover", what="was left behind by a run that was stopped")


def _others(folder: Path, known: set[str], own: str) -> Iterator[Finding]:
    """Yield the run that will replace a folder, and the half-written and foreign files in it; `own` matches its own."""
    for finding in _journal(hidden(folder))[1]:
        yield Finding(file=finding.file.parent, problem="pending", what=f"is to replace it; {finding.what}")
    part = re.compile(half_written(rf"{own}|{SUMS}|{re.escape(MANIFEST)}|{re.escape(JOURNAL)}"))
    for name in _names(folder):
        if part.fullmatch(name):
            yield _left(folder / name)
        elif name not in known:
            yield Finding(file=folder / name, problem="foreign", what="does not belong to it")


def _names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())

"""Verification of datasets, recordings and tables: which files are damaged, and which rows of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cgid.errors import BadData, CgidError, NoInput
from cgid.files import half_written
from cgid.store.description import DIGEST, FORMAT, RECORDING_FORMAT, TABLE_FORMAT
from cgid.store.folder import (
    DESCRIPTION,
    JOURNAL,
    LINKED,
    LOCK,
    MANIFEST,
    SUMS,
    Description,
    Folder,
    describe,
    has_sum,
    read_folder,
    read_sums,
    read_text,
)
from cgid.store.gates import attributes_of, filters_of, opened
from cgid.store.headers import KINDS, damaged_rows, recording_header, shard_header, table_header
from cgid.store.reading import require_own
from cgid.store.table import TABLE_SUFFIXES, read_table

#: By HDF5's numbers of filters; see `cgid.store.hdf5`.
_COMPRESSIONS = {1: "gzip", 32015: "zstd", 32026: "blosc2"}
#: Problems without damage.
_HARMLESS = ("leftover", "foreign")
_NOUNS = {FORMAT: "dataset", RECORDING_FORMAT: "recording", TABLE_FORMAT: "table"}
#: Most runs of damaged rows that are named for one dataset.
_MAX_RUNS = 4
#: Root attributes of a file that are not those of all files of its folder.
_OWN = {
    FORMAT: ("first_signal", DIGEST),
    RECORDING_FORMAT: ("format", "schema_version", "recording", "n_impacts", DIGEST),
}


@dataclass(frozen=True, kw_only=True)
class Examined:
    """The content of a shard, a recording or a table in HDF5, which may be damaged.

    kind : its format, "" if that cannot be read
    fault : why it cannot be read, and which rows, "" if all can
    about : root attributes, and `n_signals` of a shard
    description : what it would follow from if it were a single file; None if its headers cannot be read
    """

    kind: str = ""
    fault: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    description: Description | None = None


def examine_file(path: str | Path) -> Examined:
    """Return the content of a file, which is read to its end."""
    source, kind, about, description = str(path), "", {}, None
    try:
        with opened(Path(path), source) as file:
            about = attributes_of(file, source)
            kind = str(about.get("format"))
            if kind not in KINDS:
                return Examined(
                    fault=f"{source}: this HDF5 file must be a dataset, a recording or a table of cgid; it is none"
                )
            if kind == FORMAT:
                header = shard_header(file, source)
                about["n_signals"] = n = header.n_signals
                codes = [_COMPRESSIONS.get(code) for code, *_ in filters_of(file["signals"])]
                description = describe(
                    kind,
                    {name: value for name, value in header.attributes.items() if name not in _OWN[kind]},
                    n_signals=n,
                    shard_signals=n,
                    n_samples=header.n_samples,
                    dtype=header.dtype,
                    compression=next((code for code in codes if code), "none"),
                )
            elif kind == RECORDING_FORMAT:
                found = recording_header(file, source)
                attributes = {name: value for name, value in about.items() if name not in _OWN[kind]}
                fields = {name: found[name] for name in ("n_samples", "dtype", "sampling_rate", "unit")}
                description = describe(kind, attributes, n_recordings=1, **fields)
            else:
                table_header(file, source)
            fault = _in_words(damaged_rows(file, kind, source))
    except BadData as error:
        fault = str(error)
    return Examined(kind=kind, fault=fault, about=about, description=description)


def _in_words(damaged: Mapping[str, list[tuple[int, int]]]) -> str:
    """Describe the unreadable rows of each dataset, "" if there are none.

    Examples
    --------
    >>> _in_words({"signals": [(0, 4)]})
    'signals 0 to 3 do not fit their checksum'
    """
    parts = []
    for name, runs in damaged.items():
        rows = [f"{first} to {stop - 1}" for first, stop in runs[:_MAX_RUNS]]
        more = [f"{len(runs) - _MAX_RUNS} more runs"] if len(runs) > _MAX_RUNS else []
        parts.append(f"{name} {', '.join(rows + more)}")
    return f"{'; '.join(parts)} do not fit their checksum" if parts else ""


def why_not_whole(folder: Folder, number: int) -> str:
    """Return why a file without a sum is not whole, "" if it is: by its digest, its number and its checksums."""
    path = folder.path / folder.description.names[number]
    found = examine_file(path)
    return found.fault or _why_not_own(path, folder, number, found)


def _why_not_own(path: Path, folder: Folder, number: int, found: Examined) -> str:
    try:
        require_own(path, folder, number, {"first_signal": 0, **found.about})
    except BadData as error:
        return str(error).removeprefix(f"{path}: ")
    return ""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A problem with a file.

    problem : "damaged", "missing" or "unfinished"; harmless are "leftover" (of a stopped run) and "foreign" (the file
        does not belong to the folder)
    what : description of the problem, in one line
    number : of the file in its folder, None for the others
    """

    file: Path
    problem: str
    what: str
    number: int | None = None

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
    folder : Folder or None
        What a folder says of itself, if that is sound.
    """

    path: Path
    kind: str
    n_files: int
    findings: tuple[Finding, ...]
    folder: Folder | None = None

    @property
    def damage(self) -> tuple[Finding, ...]:
        """The harmful findings."""
        return tuple(finding for finding in self.findings if finding.harmful)


def verify(path: str | Path) -> Verified:
    """Return the damage of a dataset, a recording, a folder of recordings, or a table.

    Files in a folder are compared with their SHA-256, which finds every change; where it differs or is unknown, with
    the checksum of every chunk, and with the description. A CSV table has no checksums: only damage that makes it
    unreadable is found. Nothing is locked or written.

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
        names = sorted(entry.name for entry in path.iterdir())
        is_old = DESCRIPTION not in names and any(re.fullmatch(r"recording-\d{5,}\.h5", name) for name in names)
        if is_old and DESCRIPTION not in read_sums(path, None):
            return _verify_undescribed(path, names)
        return _verify_folder(path, names)
    except CgidError:
        raise
    except OSError as error:
        raise NoInput(f"{path}: cannot be looked into ({error.strerror}); see to the permissions") from None


def _verify_file(path: Path) -> Verified:
    if path.suffix.lower() in TABLE_SUFFIXES[2:]:
        kind, what = "table", _unreadable_table(path)
    else:
        found = examine_file(path)
        kind, what = _NOUNS.get(found.kind, "file"), found.fault
        what = what or (_unreadable_table(path) if kind == "table" else "")
    findings = [Finding(file=path, problem="damaged", what=what)] if what else []
    part = re.compile(half_written(re.escape(path.name)))
    findings += [_left(left) for left in sorted(path.parent.iterdir()) if part.fullmatch(left.name)]
    return Verified(path=path, kind=kind, n_files=1, findings=tuple(findings))


def _unreadable_table(path: Path) -> str:
    try:
        read_table(path)
    except BadData as error:
        return str(error)
    return ""


def _verify_undescribed(path: Path, names: list[str]) -> Verified:
    """Verify recordings of an earlier version, whose folder has sums but no description."""
    recordings = [name for name in names if re.fullmatch(r"recording-\d{5,}\.h5", name)]
    sums = read_sums(path, None)
    findings = []
    for name in dict.fromkeys([*sums, *recordings]):
        problem, what = _problem(path / name, sums.get(name), SUMS)
        findings += [Finding(file=path / name, problem=problem, what=what)] if what else []
    if (path / JOURNAL).exists():
        what = "an earlier cgid has not finished it; generate it again with --overwrite"
        findings.append(Finding(file=path / JOURNAL, problem="unfinished", what=what))
    findings += _others(path, names, {*sums, *recordings, JOURNAL}, "recording")
    return Verified(path=path, kind="recording", n_files=len(recordings), findings=tuple(findings))


def _verify_folder(path: Path, names: list[str]) -> Verified:
    findings: list[Finding] = []
    try:
        folder = read_folder(path)
    except BadData as error:
        file = next((file for file in (DESCRIPTION, MANIFEST, JOURNAL) if file in names), DESCRIPTION)
        problem = "unfinished" if file == JOURNAL else "damaged" if file in names else "missing"
        findings.append(Finding(file=path / file, problem=problem, what=str(error)))
        shards = [name for name in names if re.fullmatch(r"(shard|recording)-\d{5,}\.h5", name)]
        for name in shards:
            problem, what = _problem(path / name)
            findings += [Finding(file=path / name, problem=problem, what=what)] if what else []
        findings += _others(path, names, {*shards, JOURNAL}, "shard|recording")
        return Verified(path=path, kind="dataset", n_files=len(shards) + 1, findings=tuple(findings))
    unlisted, n_absent, listed = 0, 0, folder.description.names
    for number, name in enumerate(listed):
        sha256 = folder.sums.get(name)
        if sha256 is None and name not in names:
            n_absent += 1
            continue
        problem, what = _problem(path / name, sha256, folder.listing, folder, number)
        if what:
            findings.append(Finding(file=path / name, problem=problem, what=what, number=number))
        elif sha256 is None:
            unlisted += 1
    if n_absent:
        there = f"{len(listed) - n_absent} of {len(listed)} {folder.description.noun} are there"
        what = f"{there}; go on with cgid generate ... --resume"
        findings.append(Finding(file=path, problem="unfinished", what=what))
    else:
        findings += _why_unlisted(folder, unlisted)
    stem = folder.description.noun[:-1]
    findings += _others(path, names, {*listed, JOURNAL} if folder.digest is None else set(listed), stem)
    return Verified(
        path=path,
        kind=_NOUNS[folder.description.kind],
        n_files=len(listed) + 1,
        findings=tuple(findings),
        folder=folder,
    )


def _why_unlisted(folder: Folder, n_whole: int) -> list[Finding]:
    """Return the description or the sums as a finding, if one of them is not that of the files."""
    if folder.digest is None:
        return []
    if folder.sums or not (folder.path / SUMS).exists():
        what = f"lacks the SHA-256 of {n_whole} files that are whole"
        problem = "damaged" if folder.sums else "missing"
        return [Finding(file=folder.path / SUMS, problem=problem, what=what)] if n_whole else []
    head = (read_text(folder.path / SUMS) or b"")[:64].decode("latin-1")
    if head == folder.digest or n_whole:
        what = "must begin with the SHA-256 of the description and list that of each file"
        return [Finding(file=folder.path / SUMS, problem="damaged", what=what)] if n_whole else []
    what = f"must have the SHA-256 that {SUMS} begins with, it has not: it is damaged or of another folder"
    return [Finding(file=folder.path / DESCRIPTION, problem="damaged", what=what)]


def _problem(
    path: Path, sha256: str | None = None, listing: str = "", folder: Folder | None = None, number: int = 0
) -> tuple[str, str]:
    """Return the problem of a file in a folder and its description, "" if it is whole."""
    if path.is_symlink():
        return "damaged", LINKED
    if sha256 and not path.is_file():
        return "missing", "is not there"
    if sha256 and has_sum(path, sha256):
        return "", ""
    found = examine_file(path)
    what = found.fault or ("" if folder is None else _why_not_own(path, folder, number, found))
    if sha256 and not what:
        what = f"does not fit the SHA-256 of {listing}, though all of it can be read"
    return "damaged", what


def _left(file: Path) -> Finding:
    return Finding(file=file, problem="leftover", what="was left behind by a run that was stopped")


def _others(folder: Path, names: list[str], known: set[str], stem: str) -> Iterator[Finding]:
    """Yield the half-written and foreign files in a folder."""
    texts = "|".join(map(re.escape, (SUMS, DESCRIPTION, MANIFEST, JOURNAL)))
    part = re.compile(half_written(rf"(?:{stem})-\d{{5,}}\.h5|{texts}"))
    for name in names:
        if part.fullmatch(name):
            yield _left(folder / name)
        elif name not in known and name not in (SUMS, DESCRIPTION, MANIFEST, LOCK):
            yield Finding(file=folder / name, problem="foreign", what="does not belong to it")

"""Verification of datasets, recordings and tables: which files are damaged, missing or left over."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cgid._lib.files import half_written
from cgid._lib.spelling import spelled
from cgid.errors import BadData, CgidError, NoInput
from cgid.store.description import FORMAT, RECORDING_FORMAT, TABLE_FORMAT
from cgid.store.folder import (
    DESCRIPTION,
    LINKED,
    LOCK,
    SUMS,
    Folder,
    has_sum,
    read_folder,
    require_not_former,
)
from cgid.store.gates import attributes_of, opened
from cgid.store.headers import KINDS, damaged_rows, header_of
from cgid.store.reading import require_own
from cgid.store.table import TABLE_SUFFIXES, read_table

__all__ = ["Verified", "remedy", "verify"]

_NOUNS = {FORMAT: "dataset", RECORDING_FORMAT: "recording", TABLE_FORMAT: "table"}
#: Problems without damage.
_HARMLESS = ("leftover", "foreign")
#: Fields of a description that are options of `cgid generate`.
_KEYS = ("dtype", "shard_signals")
_FILE = r"(shard|recording)-\d{5,}\.h5"
_TEXTS = (DESCRIPTION, SUMS)


class Examined(NamedTuple):
    """Format, fault ("" if readable) and root attributes of an HDF5 file of cgid, which may be damaged."""

    kind: str
    fault: str
    about: Mapping[str, Any]


def examine_file(path: str | Path) -> Examined:
    """Return the content of a file, which is read to its end."""
    source, kind, about = str(path), "", dict[str, Any]()
    try:
        with opened(Path(path), source) as file:
            about = attributes_of(file, source)
            kind = str(about.get("format"))
            if kind not in KINDS:
                return Examined("", f"{source}: this HDF5 file must be a dataset, a recording or a table of cgid", {})
            header = header_of(file, source, kind)
            if kind == FORMAT:
                about |= {"n_signals": header.n_signals, "dtype": header.dtype}
            fault = f"{source}: {rows}" if (rows := damaged_rows(file, kind, source)) else ""
    except BadData as error:
        fault = str(error)
    return Examined(kind, fault, about)


def why_incomplete(folder: Folder, number: int) -> str:
    """Return why a file without a sum is incomplete, "" if it is complete: by its digest, number and checksums."""
    path = folder.path / folder.description.name(number)
    _, fault, about = examine_file(path)
    try:
        if not fault:
            require_own(path, folder, number, {"first_signal": 0, **about})
    except BadData as error:
        return str(error)
    return fault


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A problem with a file: "damaged", "missing" or "unfinished"; "leftover" and "foreign" are harmless.

    `what` begins with the file.
    """

    file: Path
    problem: str
    what: str

    @property
    def harmful(self) -> bool:
        """Whether data are lost unless the file is made again."""
        return self.problem not in _HARMLESS


@dataclass(frozen=True, kw_only=True)
class Verified:
    """The result of `verify`.

    Attributes
    ----------
    path : Path
        The path that was checked.
    kind : str
        "dataset", "recording", "table", or "file" if it is too damaged to tell.
    n_files : int
        Number of examined files.
    findings : tuple of Finding
        Each damaged, missing or surplus file.
    """

    path: Path
    kind: str
    n_files: int
    findings: tuple[Finding, ...]

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
        Its `findings` are empty if nothing is damaged; `remedy` says how to make it again.

    Raises
    ------
    NoInput
        The path does not exist or cannot be read.
    BadData
        An earlier development version made the folder.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise NoInput(f"{path}: no such file or folder; give a dataset, recording, table or model of cgid")
        return _verify_folder(path) if path.is_dir() else _verify_file(path)
    except CgidError:
        raise
    except OSError as error:
        raise NoInput(f"{path}: cannot be accessed ({error.strerror}); see to the permissions") from None


def remedy(path: str | Path, scenes: Collection[str] = ()) -> str:
    """Return the command that makes what is damaged in a dataset or recordings again, to the same bytes.

    Parameters
    ----------
    path : str or Path
        A folder, or a single file.
    scenes : collection of str
        Names that `cgid generate` knows (`cgid.shipped.SCENES`).

    Returns
    -------
    str
        As complete as what is left of the description permits. A dataset does not state the names of other scenes'
        files, and of the modules of custom laws: SCENE.toml and MODULE stand for them.
    """
    path, about = Path(path), dict[str, Any]()
    is_folder = path.is_dir()
    try:
        if is_folder:
            content = read_folder(path).description.content
            about = content["attributes"] | content
        else:
            about = dict(examine_file(path).about)
    except CgidError:
        pass
    if about.get("format") not in (FORMAT, RECORDING_FORMAT) or "seed" not in about or about.get("first_signal"):
        return f"repeat what made it, with {spelled('resume' if is_folder else 'overwrite', 'true')}"
    options = {"-n": about.get("n_signals", about.get("n_recordings", 1)), "--seed": about["seed"]}
    name, mode = str(about.get("scene_name")), "--resume" if is_folder else "--overwrite"
    words = [name if name in scenes else "SCENE.toml", *(word for option in options.items() for word in option)]
    words += [word for name in _KEYS if name in about for word in ("--set", f"{name}={about[name]}")]
    words += ["-o", path]
    words += ["--set", "laws=MODULE"] if "laws" in about else []
    stand_ins = [] if name in scenes else [f"SCENE.toml is the file of scene {name}"]
    stand_ins += ["MODULE is that of its laws"] if "laws" in about else []
    return "; ".join([shlex.join(["cgid", "generate", *map(str, words), mode]), *stand_ins])


def _verify_file(path: Path) -> Verified:
    kind, what = "table", ""
    if path.suffix.lower() not in TABLE_SUFFIXES[2:]:
        form, what, _ = examine_file(path)
        kind = _NOUNS.get(form, "file")
    if kind == "table" and not what:
        try:
            read_table(path)
        except BadData as error:
            what = str(error)
    findings = [Finding(file=path, problem="damaged", what=what)] if what else []
    return Verified(path=path, kind=kind, n_files=1, findings=tuple(findings))


def _verify_folder(path: Path) -> Verified:
    names = sorted(entry.name for entry in path.iterdir())
    files = [name for name in names if re.fullmatch(_FILE, name)]
    folder, sums, findings = None, dict[str, str](), list[Finding]()
    if DESCRIPTION not in names:
        require_not_former(path)
    try:
        folder = read_folder(path)
        files, sums = folder.description.names, dict(folder.sums)
    except BadData as error:
        problem = "damaged" if DESCRIPTION in names else "missing"
        findings.append(Finding(file=path / DESCRIPTION, problem=problem, what=str(error)))
    present, n_absent, n_unlisted = {*names}, 0, 0
    for number, name in enumerate(files):
        if name not in sums and name not in present:
            n_absent += 1
        elif finding := _finding(path / name, sums.get(name), folder, number):
            findings.append(finding)
        elif name not in sums:
            n_unlisted += 1
    if folder is not None and n_absent:
        what = f"{path}: {len(files) - n_absent} of {len(files)} {folder.description.noun} exist"
        what += "; continue with cgid generate ... --resume"
        findings.append(Finding(file=path, problem="unfinished", what=what))
    elif folder is not None and n_unlisted:
        problem = "damaged" if SUMS in present else "missing"
        what = f"{path / SUMS}: must begin with the SHA-256 of the description, and list {n_unlisted} more files"
        findings.append(Finding(file=path / SUMS, problem=problem, what=what))
    part = re.compile(half_written("|".join([_FILE, *map(re.escape, _TEXTS)])))
    for name in sorted(present - {*files, *_TEXTS, LOCK}):
        problem, what = ("leftover", "of a stopped run") if part.fullmatch(name) else ("foreign", "not part of it")
        findings.append(Finding(file=path / name, problem=problem, what=f"{path / name}: {what}"))
    looks = RECORDING_FORMAT if files and files[0].startswith("recording") else FORMAT
    form = folder.description.kind if folder else looks
    return Verified(path=path, kind=_NOUNS[form], n_files=len(files) + 1, findings=tuple(findings))


def _finding(path: Path, sha256: str | None, folder: Folder | None, number: int) -> Finding | None:
    """Return the problem of a file in a folder, None if it is complete."""
    if path.is_symlink():
        return Finding(file=path, problem="damaged", what=f"{path}: {LINKED}")
    if sha256 and not path.is_file():
        return Finding(file=path, problem="missing", what=f"{path}: does not exist")
    if sha256 and has_sum(path, sha256):
        return None
    what = examine_file(path).fault if folder is None else why_incomplete(folder, number)
    if sha256 and not what:
        what = f"{path}: does not match the SHA-256 in {SUMS}, though all of it is readable"
    return Finding(file=path, problem="damaged", what=what) if what else None

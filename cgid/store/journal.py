"""The journal of a run that fills a folder: its plan, and a line for each file that is finished.

It lies in the folder until the run is whole, one JSON object a line, each with its own SHA-256:

    {"run": ..., "process": ..., "digest": ...}     which run, by which process
    {"plan": ..., "n_files": ..., "noun": ..., ...} what is settled before the first file is made
    {"entry": ..., "digest": ...}                   a finished file, its size and SHA-256; one line for each

A line is on the disk before the next file is counted as finished. A last line that was torn by a crash does not count.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cgid.errors import BadData, CannotCreate, WriteFailed
from cgid.files import write_whole
from cgid.lock import locked
from cgid.store.digest import is_sound, sealed
from cgid.store.folder_text import read_text

JOURNAL = "unfinished.jsonl"
#: Bytes of the first line at most.
_FIRST_LINE = 4096
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


class Journal:
    """A journal that is being written; a context.

    Parameters
    ----------
    folder : Path
        In which the files are made.
    plan : dict
    n_files : int
    noun : str
        What the files are called, in the plural.
    entries : iterable of dict
        Files that are there already, in a run that goes on.

    Raises
    ------
    CannotCreate, WriteFailed
        The folder cannot be written to.
    """

    def __init__(
        self, folder: Path, plan: Mapping[str, Any], n_files: int, noun: str, entries: Iterable[Mapping[str, Any]] = ()
    ) -> None:
        self.path, self.run = folder / JOURNAL, secrets.token_hex(16)
        first = {"run": self.run, "process": f"process {os.getpid()} on {socket.gethostname()}"}
        second = {"plan": plan, "n_files": n_files, "noun": noun}
        lines = [_line(first), _line(second), *(_line({"entry": entry}) for entry in entries)]
        # Whole or not at all, and without what a crash may have torn in the one before.
        write_whole(self.path, b"".join(lines))
        try:
            self._stream = self.path.open("ab", buffering=0)
        except OSError as error:
            raise CannotCreate(f"{self.path}: cannot be written ({error.strerror}); choose another place") from None

    def add(self, entry: Mapping[str, Any]) -> None:
        """Note that a file is finished; returns when the disk has it. Raises `WriteFailed`."""
        line = _line({"entry": entry})
        try:
            if self._stream.write(line) != len(line):
                raise OSError(None, "the disk is full")
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise WriteFailed(
                f"{self.path}: writing failed ({error.strerror}); free some space, then go on with --resume"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()


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
    first, second = (_content(line) for line in [*lines, b""][:2])
    found = {**first, **second}
    for name, kind in (("run", str), ("process", str), ("plan", dict), ("n_files", int), ("noun", str)):
        if not isinstance(found.get(name), kind) or not _is_short(found[name]):
            raise BadData(
                f"{file}: is damaged or not of cgid, so that no run can go on; choose another name, or start again "
                "with --overwrite"
            )
    # A line that is torn or damaged is passed over: its file is made again.
    entries = [_content(line).get("entry") for line in lines[2:]]
    sound = tuple(entry for entry in entries if isinstance(entry, dict) and isinstance(entry.get("file"), str))
    named = {name: found[name] for name in ("run", "process", "plan", "n_files", "noun")}
    return Unfinished(entries=sound, **named)


@contextmanager
def taking_part(folder: Path, run: str) -> Iterator[None]:
    """Keep other runs from taking a folder over while a file of this run is written into it.

    A worker may outlive the process that started it. A later run waits for the file that it is just writing; the
    next one it would write is refused here.

    Raises
    ------
    CannotCreate
        The folder belongs to another run by now.
    """
    file, found = folder / JOURNAL, None
    try:
        with locked(file, shared=True):
            # Read by its name, not through the lock: another run puts a journal of its own in its place.
            with file.open("rb") as stream:
                found = _content(stream.readline(_FIRST_LINE)).get("run")
            if found == run:
                yield
    except BlockingIOError:
        found = None
    except FileNotFoundError:
        if found is not None:
            raise
    if found != run:
        raise CannotCreate(f"{folder}: another run has taken this folder over; wait for it, or choose another name")


def _line(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(sealed(content)) + "\n").encode()


def _is_short(value: Any) -> bool:
    """Return whether a value can be said in a line, if it is a text."""
    return not isinstance(value, str) or (len(value) <= _LONGEST_WORD and value.isprintable())


def _content(line: bytes) -> dict[str, Any]:
    """Return what a line says; nothing where it is torn or damaged."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and is_sound(found) else {}

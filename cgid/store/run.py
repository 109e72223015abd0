"""The journal of a run that fills a folder: its plan, and a line for each file that is finished.

It lies in the folder until the run is whole, one JSON object a line, each with its own SHA-256:

    {"run": ..., "process": ..., "digest": ...}     which run, by which process
    {"plan": ..., "n_files": ..., "noun": ..., ...} what is settled before the first file is made
    {"entry": ..., "digest": ...}                   a finished file, its size and SHA-256; one line for each

A line is on the disk before the next file is counted as finished. A last line that was torn by a crash does not count.

A run that fills a folder with files, one by one, and can go on after a crash at any moment.

The folder is locked while the run lasts. Files are made in it if it is new; if there is an older one, they are made in
a hidden folder beside it (.NAME.unfinished), which changes places with the older one when it is whole:

    new run         NAME: journal, files        -> NAME: files, manifest, journal   -> NAME: files, manifest
    overwriting     NAME: old, .NAME.unfinished: journal, files, manifest           -> the two change names
                    NAME: new, journal, .NAME.unfinished: old                       -> old files go, journal goes

So a hidden folder with a journal is newer than NAME, one without is what an overwriting run has not yet cleared away.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cgid.errors import BadData, CannotCreate, CgidError, WriteFailed
from cgid.files import exchange, half_written, locked, sync_folder, write_whole
from cgid.store.description import (
    FIRST_LINE,
    JOURNAL,
    Unfinished,
    content_of,
    first_difference,
    line_of,
    read_journal,
    require_same,
)


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
        lines = [line_of(first), line_of(second), *(line_of({"entry": entry}) for entry in entries)]
        # Whole or not at all, and without what a crash may have torn in the one before.
        write_whole(self.path, b"".join(lines))
        try:
            self._stream = self.path.open("ab", buffering=0)
        except OSError as error:
            raise CannotCreate(f"{self.path}: cannot be written ({error.strerror}); choose another place") from None

    def add(self, entry: Mapping[str, Any]) -> None:
        """Note that a file is finished; returns when the disk has it. Raises `WriteFailed`."""
        line = line_of({"entry": entry})
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
                found = content_of(stream.readline(FIRST_LINE)).get("run")
            if found == run:
                yield
    except BlockingIOError:
        found = None
    except FileNotFoundError:
        if found is not None:
            raise
    if found != run:
        raise CannotCreate(f"{folder}: another run has taken this folder over; wait for it, or choose another name")


#: The journal, and what a killed run leaves of it.
JOURNAL_FILES = re.compile(f"{re.escape(JOURNAL)}|{half_written(re.escape(JOURNAL))}")
#: How long workers that have outlived their run may take for the file they are just writing [s].
_PATIENCE = 60.0


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What a run makes.

    Attributes
    ----------
    output : Path
        The folder.
    plan : dict
        All that the content of the files depends on; a run goes on only with an equal one.
    n_files : int
    noun : str
        What the files are called, in the plural.
    ours : re.Pattern
        The names that files of such a folder have, with those of half-written ones.
    plan_of : callable
        Returns the plan of what lies in a folder if that is whole, else None.
    """

    output: Path
    plan: Mapping[str, Any]
    n_files: int
    noun: str
    ours: re.Pattern[str]
    plan_of: Callable[[Path], Mapping[str, Any] | None]

    @property
    def replaced(self) -> Path:
        """Where the older folder goes on systems that cannot let two folders change names in one step."""
        return self.output.with_name(f".{self.output.name}.replaced")

    @property
    def hidden(self) -> Path:
        """Where files are made while an older folder has the name."""
        return hidden(self.output)


class Run:
    """A run on its way; see `begun`.

    Attributes
    ----------
    folder : Path
        Where the files are to be written.
    token : str
        Which run this is, for `cgid.store.run.taking_part`.
    finished : tuple of dict
        What is said of the files that are there already, each verified by its SHA-256.
    """

    def __init__(self, goal: Goal, folder: Path, journal: Journal, finished: tuple[dict[str, Any], ...]) -> None:
        self.folder, self.finished, self.token = folder, finished, journal.run
        self._goal, self._journal, self._has_files = goal, journal, bool(finished)

    def add(self, entry: Mapping[str, Any]) -> None:
        """Note that a file is finished: its name `file`, its size `bytes`, its `sha256`, and what else is known."""
        self._has_files = True  # first: Ctrl-C may come while the line is flushed
        self._journal.add(entry)

    def finish(self) -> None:
        """Give the whole folder the name asked for. Raises `WriteFailed`; the run can then be resumed."""
        output = self._goal.output
        try:
            if self.folder != output:
                (output / JOURNAL).unlink(missing_ok=True)  # of an older run, which is not to be taken for this one
                _change_places(self._goal)
            (output / JOURNAL).unlink(missing_ok=True)
        except OSError as error:
            raise WriteFailed(f"{output}: cannot be replaced ({error.strerror}); go on with --resume") from None

    def abandon(self) -> None:
        """Remove what is half-written. Finished files stay with the journal, for the run to go on."""
        _clear(self.folder, self._goal.ours, only_parts=self._has_files)
        with contextlib.suppress(OSError):
            self.folder.rmdir()  # only if nothing is in it


@contextmanager
def begun(goal: Goal, *, overwrite: bool = False, resume: bool = False) -> Iterator[Run | None]:
    """Yield a run that fills a folder, or None where all that was to be resumed is there already.

    When this context is left without an error, the folder asked for is whole.

    Raises
    ------
    CannotCreate
        Something is there already, another run is writing there, or the run to be resumed had other options.
    BadData
        The journal of the run to be resumed is damaged.
    WriteFailed
        The disk is full or broken; what was there before is untouched, and the run can be resumed.
    """
    with ExitStack() as held:
        _hold(goal, held)
        try:
            place = _place(goal, overwrite, resume)
            if place is None:
                (goal.output / JOURNAL).unlink(missing_ok=True)
                _clear_away(goal)
                yield None
                return
            if place[0] != goal.output and goal.output.samefile("."):
                raise CannotCreate(
                    f"{goal.output}: the current folder cannot be replaced by another; go to the one above it first"
                )
            if not (goal.hidden / JOURNAL).exists():
                _clear_away(goal)  # what an earlier run could not
            run = _started(goal, *place, held)
            try:
                yield run
                run.finish()
            except BaseException:
                run.abandon()
                raise
            _clear_away(goal)
        finally:
            with contextlib.suppress(OSError):
                goal.output.rmdir()  # only if nothing is in it


def hidden(output: Path) -> Path:
    """Return where the files of a folder are made while an older one has the name."""
    real = real_folder(output)
    return real.parent / f".{real.name}.unfinished"


def real_folder(path: Path) -> Path:
    """Return a folder by a name that can be given to another one: not that of a link to it, nor `.` or `..`."""
    return path.resolve() if path.is_symlink() or path.name in ("", "..") else path


def _hold(goal: Goal, held: ExitStack) -> None:
    """Make the folder if need be, and lock it."""
    output, unfinished = goal.output, goal.hidden
    try:
        if not output.exists() and (unfinished / JOURNAL).exists():
            with locked(unfinished):  # a crash where folders cannot change names in one step
                unfinished.rename(output)
        output.mkdir(exist_ok=True)
        sync_folder(output.parent)
        held.enter_context(locked(output))
    except BlockingIOError:
        raise CannotCreate(f"{output}: {_writer(goal)} is writing there; wait for it, or choose another name") from None
    except OSError as error:
        raise CannotCreate(f"{output}: cannot be written ({error.strerror}); choose another place") from None


def _writer(goal: Goal) -> str:
    for folder in (goal.hidden, goal.output):
        with contextlib.suppress(CgidError):
            found = read_journal(folder)
            if found is not None:
                return found.process
    return "another process"


def _place(goal: Goal, overwrite: bool, resume: bool) -> tuple[Path, Unfinished | None] | None:
    """Return the folder to make the files in, with what is unfinished there; None if all is there already."""
    output = goal.output
    is_empty = all(_is_part(path, goal.ours) for path in output.iterdir())
    new = (output if is_empty else goal.hidden), None
    if resume:
        whole = goal.plan_of(output)
        for folder in (goal.hidden, output) if whole is None else (goal.hidden,):
            unfinished = read_journal(folder)
            if unfinished is not None:
                require_same(output, unfinished.plan, goal.plan)
                return folder, unfinished
        if whole is not None and first_difference(whole, goal.plan) is None:
            return None
        if whole is not None and not overwrite:
            require_same(output, whole, goal.plan)
    elif not overwrite and (goal.hidden / JOURNAL).exists():
        raise exists_already(output)
    if not is_empty and not overwrite:
        raise exists_already(output)
    return new


def exists_already(output: Path) -> CannotCreate:
    """Return what to raise where nothing may be written without a further word."""
    for folder in (hidden(output), output):
        with contextlib.suppress(BadData):
            found = read_journal(folder)
            if found is not None:
                return CannotCreate(
                    f"{output}: a run that makes it is not finished: {found.progress}, or start again with --overwrite"
                )
    return CannotCreate(f"{output}: exists already; choose another name or say --overwrite")


def _started(goal: Goal, folder: Path, unfinished: Unfinished | None, held: ExitStack) -> Run:
    """Clear a folder of what is not to stay in it, and begin its journal."""
    try:
        if folder != goal.output:
            folder.mkdir(exist_ok=True)
            held.enter_context(locked(folder))  # it will have the name that others lock
        with ExitStack() as waiting:
            if (folder / JOURNAL).exists():
                waiting.enter_context(locked(folder / JOURNAL, patience=_PATIENCE))
            _clear(folder, goal.ours, only_parts=unfinished is not None)
            finished = () if unfinished is None else tuple(_verified(folder, unfinished, goal.ours))
            journal = held.enter_context(Journal(folder, goal.plan, goal.n_files, goal.noun, finished))
    except BlockingIOError:
        raise CannotCreate(
            f"{goal.output}: a worker of an earlier run is still writing there; wait for it, or end it"
        ) from None
    except (CannotCreate, WriteFailed):
        raise
    except OSError as error:
        raise CannotCreate(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return Run(goal, folder, journal, finished)


def _verified(folder: Path, unfinished: Unfinished, ours: re.Pattern[str]) -> Iterator[dict[str, Any]]:
    """Yield what the journal says of the files that are there as it says."""
    for name, entry in {entry.get("file"): entry for entry in unfinished.entries}.items():
        if not isinstance(name, str) or not ours.fullmatch(name):
            continue
        with contextlib.suppress(OSError):
            if not stat.S_ISREG(
                (folder / name).lstat().st_mode
            ):  # a pipe would hold this run up, a link lead elsewhere
                continue
            if file_facts(folder / name) == {key: entry.get(key) for key in ("file", "bytes", "sha256")}:
                yield entry


def file_facts(path: Path) -> dict[str, Any]:
    """Return what the journal says of every file: `file`, `bytes` and `sha256`."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"file": path.name, "bytes": stream.tell(), "sha256": digest}


def _change_places(goal: Goal) -> None:
    """Give the hidden folder the name; the older one is then hidden, or out of the way."""
    if not exchange(goal.hidden, goal.output):
        _clear(goal.replaced, goal.ours)
        goal.output.rename(goal.replaced)
        goal.hidden.rename(goal.output)
    sync_folder(goal.output.parent)


def _clear_away(goal: Goal) -> None:
    """Remove the folders that have been replaced; what others have put into them meanwhile goes where it was put."""
    for folder in (goal.hidden, goal.replaced):
        with contextlib.suppress(OSError):
            if not folder.is_symlink():
                folder.chmod(stat.S_IRWXU)  # a folder that is read-only can be replaced, but not cleared
        _clear(folder, goal.ours)
        with contextlib.suppress(OSError):
            for foreign in folder.iterdir():
                foreign.rename(goal.output / foreign.name)
            folder.rmdir()


def _clear(folder: Path, ours: re.Pattern[str], *, only_parts: bool = False) -> None:
    """Remove our files, or only the half-written ones, as far as that is possible."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _is_part(path, ours) or (not only_parts and (ours.fullmatch(path.name) or path.name == JOURNAL)):
                with contextlib.suppress(OSError):
                    path.unlink()


def _is_part(path: Path, ours: re.Pattern[str]) -> bool:
    """Return whether a file is half-written, by its name."""
    return path.suffix == ".part" and bool(ours.fullmatch(path.name) or JOURNAL_FILES.fullmatch(path.name))

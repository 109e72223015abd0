"""A run writes one file or fills a folder; `--resume` completes it after a crash at any moment.

The folder is locked during the run. A new folder is filled in place. If an older folder has the name, the files go to
a hidden folder next to it (.NAME.unfinished), and the older folder stays until the new one is whole:

    new run         NAME: journal, files    ->  NAME: files, sums, manifest, journal  ->  NAME: files, sums, manifest
    overwriting     NAME: old, .NAME.unfinished: journal, files, sums, manifest
                    .NAME.replaced: old, .NAME.unfinished: new, journal
                    .NAME.replaced: old, NAME: new, journal        ->  old files are removed, then the journal

So a hidden folder with a journal is newer than NAME; one without a journal is left over from an overwriting run.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from cgid.errors import BadData, CannotCreate, CgidError, WriteFailed
from cgid.files import clear_half_written, half_written, locked, looking_at, sync_folder, write_whole
from cgid.store.description import (
    FIRST_LINE,
    FORMAT,
    JOURNAL,
    MANIFEST,
    SUMS,
    Unfinished,
    content_of,
    file_facts,
    first_difference,
    line_of,
    read_journal,
    require_same,
    sums_text,
)

#: Names with other endings are folders.
SUFFIXES = (".h5", ".hdf5")
#: The journal and its half-written files.
_JOURNAL_FILES = re.compile(f"{re.escape(JOURNAL)}|{half_written(re.escape(JOURNAL))}")
#: Longest wait for a worker that has outlived its run and still writes a file [s].
_PATIENCE = 60.0
#: The first bytes of a manifest contain its format.
_HEAD = 4096


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The goal of a run.

    output : a folder, or a single file
    description : everything the files' content depends on; a run is resumed only with the same description
    names : the files of the folder, or the name of the single file
    noun : plural noun for the files
    ours : names of files in such a folder, including half-written ones
    description_of : existing output -> its description, None for an incomplete folder; raises `BadData` for a file that
        is damaged or of another kind
    closing : entries of all files, in the order of `names` -> name and content of the files that complete the folder
    fits : number of a file and its journal entry -> whether the entry can be used
    """

    output: Path
    description: Mapping[str, Any]
    names: tuple[str, ...]
    noun: str
    ours: re.Pattern[str]
    description_of: Callable[[Path], Mapping[str, Any] | None]
    closing: Callable[[list[dict[str, Any]]], dict[str, bytes]] = lambda entries: {}
    fits: Callable[[int, Mapping[str, Any]], bool] = lambda number, entry: True


class Run:
    """A run in progress; see `begun`.

    folder : where the files are written
    token : identifier for `taking_part`; None without a journal
    missing : numbers of the files still to be made

    A journal lists the finished files, at first those of the run that is resumed (`finished`, by their names). Raises
    `CannotCreate` or `WriteFailed` if it cannot be written.
    """

    def __init__(
        self, goal: Goal, folder: Path, finished: Mapping[str, dict[str, Any]], *, journalled: bool = False
    ) -> None:
        self.folder, self.token = folder, secrets.token_hex(16) if journalled else None
        self.missing = [number for number, name in enumerate(goal.names) if name not in finished]
        self._goal, self._entries, self._path = goal, dict(finished), folder / JOURNAL
        self._journal: IO[bytes] | None = None
        if journalled:
            first = {"run": self.token, "process": f"process {os.getpid()} on {socket.gethostname()}"}
            second = {"plan": goal.description, "n_files": len(goal.names), "noun": goal.noun}
            lines = [line_of(first), line_of(second), *(line_of({"entry": entry}) for entry in finished.values())]
            # Written atomically, without the lines that a crash may have torn in the previous journal.
            write_whole(self._path, b"".join(lines))
            try:
                self._journal = self._path.open("ab", buffering=0)
            except OSError as error:
                raise CannotCreate(
                    f"{self._path}: cannot be written ({error.strerror}); choose another place"
                ) from None

    def add(self, entry: Mapping[str, Any]) -> None:
        """Record a finished file: its name `file`, its size `bytes`, its `sha256`, and further facts.

        Returns when the line is on the disk; raises `WriteFailed`.
        """
        self._entries[entry["file"]] = dict(entry)  # comes first: Ctrl-C may come while the line is flushed
        if self._journal is None:
            return
        line = line_of({"entry": entry})
        try:
            if self._journal.write(line) != len(line):
                raise OSError(None, "the disk is full")
            os.fsync(self._journal.fileno())
        except OSError as error:
            raise WriteFailed(
                f"{self._path}: writing failed ({error.strerror}); free some space, then go on with --resume"
            ) from None

    def close(self) -> None:
        """Close the journal; Windows cannot remove an open file."""
        if self._journal is not None:
            self._journal.close()

    def finish(self) -> None:
        """Write the sums and the closing files, and give the folder its name. Raises `WriteFailed`."""
        output = self._goal.output
        entries = [self._entries[name] for name in self._goal.names]
        closing = self._goal.closing(entries)
        sums = {entry["file"]: entry["sha256"] for entry in entries}
        sums |= {name: hashlib.sha256(content).hexdigest() for name, content in closing.items()}
        write_whole(self.folder / SUMS, sums_text(sums))
        for name, content in closing.items():
            write_whole(self.folder / name, content)
        self.close()
        try:
            if self.folder != output:
                (output / JOURNAL).unlink(missing_ok=True)  # an older journal must not be mistaken for this one
                _replace(self._goal)
            (output / JOURNAL).unlink(missing_ok=True)
        except OSError as error:
            raise WriteFailed(f"{output}: cannot be replaced ({error.strerror}); go on with --resume") from None

    def abandon(self) -> None:
        """Remove half-written files; finished files and the journal stay for resuming."""
        self.close()
        _clear(self.folder, self._goal.ours, only_parts=bool(self._entries))
        with contextlib.suppress(OSError):
            self.folder.rmdir()  # only if it is empty


@contextmanager
def begun(goal: Goal, *, overwrite: bool = False, resume: bool = False) -> Iterator[Run]:
    """Yield a run over the missing files; when this context ends without an error, the output is whole.

    Older files stay until the new ones are whole. With `resume`, a whole output of the same description is kept, and
    nothing is missing. Raises `CannotCreate` if the output exists, another run writes there or the run to resume had
    other options; `BadData` if its journal or the existing file is damaged; `WriteFailed`, after which the run can be
    resumed.
    """
    output = goal.output
    if is_single_file(output):
        clear_half_written(output)
        done = resume and output.exists() and _is_made(goal, overwrite)
        yield Run(goal, output.parent, {output.name: {}} if done else {})
        return
    with ExitStack() as held:
        _hold(goal, held)
        try:
            place = _place(goal, overwrite, resume)
            if place is None:
                (output / JOURNAL).unlink(missing_ok=True)
                _remove_replaced(goal)
                yield Run(goal, output, {name: {} for name in goal.names})
                return
            if place[0] != output and output.samefile("."):
                raise CannotCreate(
                    f"{output}: the current folder cannot be replaced by another; go to the one above it first"
                )
            if not (hidden(goal.output) / JOURNAL).exists():
                _remove_replaced(goal)  # left over by an earlier run
            run = _started(goal, *place, held)
            try:
                yield run
                run.finish()
            except BaseException:
                run.abandon()
                raise
            _remove_replaced(goal)
        finally:
            with contextlib.suppress(OSError):
                output.rmdir()  # only if it is empty


# ---- names of outputs ------------------------------------------------------------------------------------------------


def is_single_file(output: str | Path) -> bool:
    """Return whether a name is that of a single file, not of a folder."""
    return Path(output).suffix.lower() in SUFFIXES


def hidden(output: Path) -> Path:
    """Return the folder for new files while an older folder has the name."""
    real = _real_folder(output)
    return real.parent / f".{real.name}.unfinished"


def _replaced(output: Path) -> Path:
    """Return the name of the older folder while it is being replaced."""
    return output.with_name(f".{output.name}.replaced")


def _real_folder(path: Path) -> Path:
    """Return a folder by a name that can be renamed: not a link to it, nor `.` or `..`."""
    return path.resolve() if path.is_symlink() or path.name in ("", "..") else path


def check_output(output: str | Path, ours: re.Pattern[str], overwrite: bool = False) -> Path:
    """Return the output as a path if it may be written; run before any work is done.

    Parameters
    ----------
    output : str or Path
        Links to a folder are resolved.
    ours : re.Pattern
        Allowed names of files in an existing folder.
    overwrite : bool
        Whether an existing output is allowed.

    Returns
    -------
    Path

    Raises
    ------
    CannotCreate
        The output exists or holds other files, or the parent folder is missing.
    """
    path = Path(output)
    with looking_at(path):
        path = path if is_single_file(path) else _real_folder(path)
        if not path.parent.is_dir():
            raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
        if path.is_dir() and is_single_file(path):
            raise CannotCreate(f"{path}: is a folder; choose another name for the file")
        if path.exists() and not path.is_dir() and not is_single_file(path):
            raise CannotCreate(f"{path}: is a file; choose another name for the folder, or one ending in .h5")
        content = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else None
        foreign = [name for name in content or () if not ours.fullmatch(name) and not _JOURNAL_FILES.fullmatch(name)]
        if (path / MANIFEST).is_file():
            with (path / MANIFEST).open("rb") as stream:
                if f'"{FORMAT}"'.encode() not in stream.read(_HEAD):
                    foreign.append(MANIFEST)
        if foreign:
            raise CannotCreate(
                f"{path}: is a folder with other things in it, such as {foreign[0]}, and is not overwritten; "
                "choose another name"
            )
        if path.exists() and content != [] and not overwrite:
            raise _exists_already(path)
    return path


def _exists_already(output: Path) -> CannotCreate:
    found = _journal_of(output)
    if found is None:
        return CannotCreate(f"{output}: exists already; choose another name or say --overwrite")
    return CannotCreate(
        f"{output}: a run that makes it is not finished: {found.progress}, or start again with --overwrite"
    )


def _journal_of(output: Path) -> Unfinished | None:
    """Return the readable journal of a run that makes an output, if any."""
    for folder in (hidden(output), output):
        with contextlib.suppress(CgidError):
            found = read_journal(folder)
            if found is not None:
                return found
    return None


# ---- where a run goes on ---------------------------------------------------------------------------------------------


def _is_made(goal: Goal, overwrite: bool) -> bool:
    """Return whether the single file is whole and of this description; raise if not, unless it may be overwritten."""
    try:
        there = goal.description_of(goal.output) or {}
    except BadData:
        if overwrite:
            return False
        raise
    if not overwrite:
        require_same(goal.output, there, goal.description)
    return first_difference(there, goal.description) is None


def _hold(goal: Goal, held: ExitStack) -> None:
    """Create the folder if needed, and lock it."""
    output, unfinished = goal.output, hidden(goal.output)
    try:
        if not output.exists() and (unfinished / JOURNAL).exists():
            with locked(unfinished):  # after a crash between the two renames
                unfinished.rename(output)
        output.mkdir(exist_ok=True)
        sync_folder(output.parent)
        held.enter_context(locked(output))
    except BlockingIOError:
        found = _journal_of(output)
        writer = "another process" if found is None else found.process
        raise CannotCreate(f"{output}: {writer} is writing there; wait for it, or choose another name") from None
    except OSError as error:
        raise CannotCreate(f"{output}: cannot be written ({error.strerror}); choose another place") from None


def _place(goal: Goal, overwrite: bool, resume: bool) -> tuple[Path, Unfinished | None] | None:
    """Return the folder to write to and the journal to continue; None if the output is already whole."""
    output = goal.output
    is_empty = all(_is_part(path, goal.ours) for path in output.iterdir())
    if resume:
        whole = goal.description_of(output)
        for folder in (hidden(goal.output), output) if whole is None else (hidden(goal.output),):
            unfinished = read_journal(folder)
            if unfinished is not None:
                require_same(output, unfinished.description, goal.description)
                return folder, unfinished
        if whole is not None and first_difference(whole, goal.description) is None:
            return None
        if whole is not None and not overwrite:
            require_same(output, whole, goal.description)
    elif not overwrite and (hidden(goal.output) / JOURNAL).exists():
        raise _exists_already(output)
    if not is_empty and not overwrite:
        raise _exists_already(output)
    return output if is_empty else hidden(goal.output), None


def _started(goal: Goal, folder: Path, unfinished: Unfinished | None, held: ExitStack) -> Run:
    """Clear a folder for the run, and begin its journal."""
    try:
        if folder != goal.output:
            folder.mkdir(exist_ok=True)
            held.enter_context(locked(folder))  # others will lock it under its final name
        with ExitStack() as waiting:
            if (folder / JOURNAL).exists():
                waiting.enter_context(locked(folder / JOURNAL, patience=_PATIENCE))
            _clear(folder, goal.ours, only_parts=unfinished is not None)
            finished = {} if unfinished is None else dict(_verified(folder, unfinished, goal))
            run = Run(goal, folder, finished, journalled=True)
            held.callback(run.close)
            return run
    except BlockingIOError:
        raise CannotCreate(
            f"{goal.output}: a worker of an earlier run is still writing there; wait for it, or end it"
        ) from None
    except (CannotCreate, WriteFailed):
        raise
    except OSError as error:
        raise CannotCreate(f"{folder}: cannot be written ({error.strerror}); choose another place") from None


def _verified(folder: Path, unfinished: Unfinished, goal: Goal) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and entry of the journal's files that have the recorded SHA-256."""
    noted = {entry["file"]: entry for entry in unfinished.entries}
    for number, name in enumerate(goal.names):
        entry = noted.get(name)
        if entry is None or not goal.fits(number, entry):
            continue
        with contextlib.suppress(OSError):
            # A pipe would block this run; a link would lead elsewhere.
            if not stat.S_ISREG((folder / name).lstat().st_mode):
                continue
            if file_facts(folder / name) == {key: entry.get(key) for key in ("file", "bytes", "sha256")}:
                yield name, entry


def _replace(goal: Goal) -> None:
    """Give the hidden folder the name; the older folder keeps another name until it is removed."""
    _clear(_replaced(goal.output), goal.ours)
    with contextlib.suppress(OSError):
        _replaced(goal.output).rmdir()
    goal.output.rename(_replaced(goal.output))
    hidden(goal.output).rename(goal.output)
    sync_folder(goal.output.parent)


def _remove_replaced(goal: Goal) -> None:
    """Remove replaced folders; move files of others, added meanwhile, to the new folder."""
    for folder in (hidden(goal.output), _replaced(goal.output)):
        with contextlib.suppress(OSError):
            if not folder.is_symlink():
                folder.chmod(stat.S_IRWXU)  # a read-only folder can be replaced, but not emptied
        _clear(folder, goal.ours)
        with contextlib.suppress(OSError):
            for foreign in folder.iterdir():
                foreign.rename(goal.output / foreign.name)
            folder.rmdir()


def _clear(folder: Path, ours: re.Pattern[str], *, only_parts: bool = False) -> None:
    """Remove our files, or only the half-written ones, as far as possible."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _is_part(path, ours) or (not only_parts and (ours.fullmatch(path.name) or path.name == JOURNAL)):
                with contextlib.suppress(OSError):
                    path.unlink()


def _is_part(path: Path, ours: re.Pattern[str]) -> bool:
    """Return whether a file is half-written, by its name."""
    return path.suffix == ".part" and bool(ours.fullmatch(path.name) or _JOURNAL_FILES.fullmatch(path.name))


@contextmanager
def taking_part(folder: Path, run: str | None) -> Iterator[None]:
    """Keep other runs from taking over the folder while this run, unless None, writes a file into it.

    A worker may outlive its parent process. A later run waits for the file that the worker is writing. The worker's
    next file then raises `CannotCreate` here, because the folder belongs to another run.
    """
    if run is None:
        yield
        return
    file, found = folder / JOURNAL, None
    try:
        with locked(file, shared=True):
            # Read it by its name, not through the lock: another run replaces the journal by its own.
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

"""A run writes one file or fills a folder; `--resume` completes it after a crash at any moment."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cgid._lib.files import clear_half_written, looking_at, write_whole
from cgid._lib.spelling import spelled
from cgid.errors import BadData, CannotCreate, WriteFailed
from cgid.store.description import DIGEST, is_hdf5
from cgid.store.folder import (
    DESCRIPTION,
    LOCK,
    SUMS,
    Description,
    Folder,
    has_sum,
    names_of,
    parse_description,
    read_sums,
    read_text,
    require_not_former,
    require_same,
    sha256_of,
    sums_text,
)
from cgid.store.verification import examine_file, why_incomplete

#: Names with other endings are folders.
SUFFIXES = (".h5", ".hdf5")
#: The first bytes of a description contain its format.
_HEAD = 4096


class Run:
    """A run in progress, made by `begun`; `missing` are the numbers of the files still to be made."""

    def __init__(self, output: Path, description: Description, sums: dict[str, str] | None, is_made: bool = False):
        self.description, self.output, self._sums = description, output, sums
        names = description.names
        self.missing = [number for number, name in enumerate(names) if sums is not None and name not in sums]
        self._listing = -1
        if sums is None:
            self.missing = [] if is_made else [0]
            return
        write_whole(output / SUMS, self._text())
        try:
            self._listing = os.open(output / SUMS, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise CannotCreate(f"{output / SUMS}: cannot be written ({error.strerror})") from None

    @property
    def is_single(self) -> bool:
        """Whether the output is one file, without sums."""
        return self._sums is None

    @property
    def first_whole(self) -> Path | None:
        """The first file of a folder that is complete at the beginning, None without one."""
        missing = {*range(self.description.n_files)} if self.is_single else {*self.missing}
        names = enumerate(self.description.names)
        return next((self.output / name for number, name in names if number not in missing), None)

    def _text(self) -> bytes:
        sums = self._sums or {}
        listed = {name: sums[name] for name in self.description.names if name in sums}
        return sums_text({DESCRIPTION: self.description.sha256, **listed})

    def add(self, name: str, sha256: str) -> None:
        """Append the sum of a complete file, and flush it to the disk; raises `WriteFailed`."""
        if self._sums is None:
            return
        line = sums_text({name: sha256})
        try:
            if os.write(self._listing, line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(self._listing)
        except OSError as error:
            raise WriteFailed(
                f"{self.output / SUMS}: writing failed ({error.strerror}); free some space, then continue with "
                f"{spelled('resume', 'true')}"
            ) from None
        self._sums[name] = sha256

    def finish(self) -> None:
        """Sort the sums by file, since several processes finish files in any order; raises `WriteFailed`."""
        self.close()
        if self._sums is not None and list(self._sums) != self.description.names:
            write_whole(self.output / SUMS, self._text())

    def close(self) -> None:
        """Close the list of sums; Windows cannot replace an open file."""
        if self._listing >= 0:
            os.close(self._listing)
            self._listing = -1

    def abandon(self) -> None:
        """Close the list of sums and remove incomplete files; finished files remain for resuming."""
        self.close()
        clear(self.output, names_of(self.description.kind), only_parts=True)


@contextmanager
def begun(output: Path, description: Description, *, overwrite: bool = False, resume: bool = False) -> Iterator[Run]:
    """Yield a run over the missing files; with `resume`, complete files of the same description are kept."""
    if is_single_file(output):
        clear_half_written(output)
        yield Run(output, description, None, resume and output.exists() and _is_made(output, description, overwrite))
        return
    is_new = not output.exists()
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise CannotCreate(f"{output}: cannot be written ({error.strerror}); choose another place") from None
    with locked(output):
        is_empty = _names(output) <= {LOCK}
        try:
            run = _started(output, description, overwrite, resume)
            try:
                yield run
                run.finish()
            except BaseException:
                run.abandon()
                raise
        except BaseException:
            with contextlib.suppress(OSError):  # a run that has finished no file leaves none
                if is_empty and _names(output) <= {DESCRIPTION, SUMS, LOCK}:
                    for name in (SUMS, DESCRIPTION, LOCK):
                        (output / name).unlink(missing_ok=True)
                    if is_new:
                        output.rmdir()
            raise


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder by a file in it that remains. Raises `CannotCreate` if another process has the lock."""
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK)
    try:
        with contextlib.suppress(NotImplementedError):  # a file system without locks
            lock.acquire(timeout=0)
    except Timeout:
        raise CannotCreate(f"{folder}: another process is writing there; wait for it, or choose another name") from None
    except OSError as error:
        raise CannotCreate(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    try:
        yield
    finally:
        lock.release()


# ---- names of outputs ------------------------------------------------------------------------------------------------


def is_single_file(output: str | Path) -> bool:
    """Return whether a name is that of a single file, not of a folder."""
    return Path(output).suffix.lower() in SUFFIXES


def check_output(output: str | Path, kind: str, overwrite: bool = False) -> Path:
    """Return the output as a path, links to a folder resolved, if files of a `kind` may be written there."""
    path, ours = Path(output), names_of(kind)
    with looking_at(path):
        if not is_single_file(path) and (path.is_symlink() or path.name in ("", "..")):
            path = path.resolve()
        if not path.parent.is_dir():
            raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
        if path.is_dir() and is_single_file(path):
            raise CannotCreate(f"{path}: is a folder; choose another name for the file")
        if path.exists() and not path.is_dir() and not is_single_file(path):
            raise CannotCreate(f"{path}: is a file; choose another name for the folder, or one ending in .h5")
        content = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else None
        foreign = [name for name in content or () if not ours.fullmatch(name)]
        if (path / DESCRIPTION).is_file():
            with (path / DESCRIPTION).open("rb") as stream:
                if f'"{kind}"'.encode() not in stream.read(_HEAD):
                    foreign.append(DESCRIPTION)
        if foreign:
            raise CannotCreate(
                f"{path}: is a folder with other files in it, such as {foreign[0]}, and is not overwritten; choose "
                "another name"
            )
        if path.exists() and content not in ([], [LOCK]) and not overwrite:
            raise CannotCreate(
                f"{path}: exists already; choose another name, or use {spelled('overwrite', 'true')}, or "
                f"{spelled('resume', 'true')} if it is not finished"
            )
    return path


# ---- existing files --------------------------------------------------------------------------------------------------


def _is_made(output: Path, description: Description, overwrite: bool) -> bool:
    """Return whether a single file is complete and fits the description; raise if not, unless `overwrite`."""
    kind, fault, about = examine_file(output)
    if overwrite:
        return not fault and about.get(DIGEST) == description.sha256
    if kind not in ("", description.kind) or not is_hdf5(output):
        hint = f", or replace it with {spelled('overwrite', 'true')}" if kind else ""
        raise BadData(f"{output}: exists and is not a {description.kind}; choose another name{hint}")
    if fault:
        raise BadData(
            f"{output}: exists and is incomplete; make it again with {spelled('overwrite', 'true')}, without "
            f"{spelled('resume')}"
        )
    if about.get(DIGEST) != description.sha256:
        required = {**description.content["attributes"], **description.content}
        # In this order, since everything else depends on the versions and the scene.
        names = ("seed", "n_signals", "dtype", "scene_name", "scene_sha256", "versions")
        name = next((name for name in names if about.get(name, required.get(name)) != required.get(name)), "n_samples")
        raise CannotCreate(
            f"{output}: {name} must be that of the existing file, {about.get(name, 'another')!s:.80}, got "
            f"{required.get(name, 'another')!s:.80}; choose another name, or replace it with "
            f"{spelled('overwrite', 'true')}"
        )
    return True


def _started(output: Path, description: Description, overwrite: bool, resume: bool) -> Run:
    """Clear a folder for the run, write its description, and begin its sums."""
    try:
        keep = resume and _is_resumed(output, description, overwrite)
        if not keep:
            check_output(output, description.kind, overwrite or resume)  # another run may have written here
            # Without sums no file of an earlier description is taken for one of this run.
            (output / SUMS).unlink(missing_ok=True)
        if read_text(output / DESCRIPTION) != description.text:
            write_whole(output / DESCRIPTION, description.text)
        clear(output, names_of(description.kind), keep={*description.names, DESCRIPTION, SUMS, LOCK})
        return Run(output, description, _complete_files(output, description) if keep else {})
    except OSError as error:
        if isinstance(error, CannotCreate | WriteFailed):
            raise
        raise CannotCreate(f"{output}: cannot be written ({error.strerror}); choose another place") from None


def _is_resumed(output: Path, description: Description, overwrite: bool) -> bool:
    """Return whether files in a folder may fit this description; raise if not, unless `overwrite`."""
    text = read_text(output / DESCRIPTION)
    # A lost or damaged description is written again: sums and files show whether they fit it.
    if text == description.text or read_sums(output, description.sha256):
        return True
    if text is None:
        if not overwrite:
            require_not_former(output)
        return True
    if overwrite:
        return False
    try:
        present = parse_description(text, output / DESCRIPTION).content
    except BadData as error:
        raise BadData(f"{error}; or start again with {spelled('overwrite', 'true')}") from None
    require_same(output, present, description.content)
    # Only the layout of the text differs.
    raise BadData(f"{output / DESCRIPTION}: is damaged; start again with {spelled('overwrite', 'true')}")


def _complete_files(output: Path, description: Description) -> dict[str, str]:
    """Return the sums of the complete files in a folder."""
    listed, present = read_sums(output, description.sha256), _names(output)
    folder = Folder(path=output, description=description, sums=listed)
    sums = {}
    for number, name in enumerate(description.names):
        if name not in present or not (path := output / name).is_file() or path.is_symlink():
            continue
        if name not in listed and not why_incomplete(folder, number):
            sums[name] = sha256_of(path)
        elif name in listed and has_sum(path, listed[name]):
            sums[name] = listed[name]
    return sums


def clear(
    folder: Path, ours: re.Pattern[str], *, keep: frozenset[str] | set[str] = frozenset(), only_parts: bool = False
) -> None:
    """Remove our files except those to `keep`, or only the incomplete ones, as far as possible."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if ours.fullmatch(path.name) and path.name not in keep and (not only_parts or path.suffix == ".part"):
                with contextlib.suppress(OSError):
                    path.unlink()


def require_description(folder: Path, sha256: str) -> None:
    """Raise `CannotCreate` unless a folder still has this description: a lock dies with its process, workers do not."""
    try:
        same = sha256_of(folder / DESCRIPTION) == sha256
    except OSError:
        same = False
    if not same:
        raise CannotCreate(
            f"{folder}: must contain the {DESCRIPTION} of this run, and does not (any more, or on this machine); wait "
            "for the run that has taken over the folder, or choose a folder that all machines share"
        )

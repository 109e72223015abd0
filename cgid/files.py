"""Whole files or none: written beside their name, flushed to disk, then renamed."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Collection, Iterator
from pathlib import Path

from cgid.errors import CannotCreate, CgidError, WriteFailed


def write_whole(path: str | Path, content: bytes | memoryview) -> None:
    """Write a file so that its name only ever bears the old content or all of the new; raises as `whole_file`."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(content)


@contextlib.contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield the name of an empty file to be filled and closed, which then bears the name asked for, if all went well.

    Raises
    ------
    CannotCreate
        The folder is missing or not writable.
    WriteFailed
        The disk is full or broken; what was there before is untouched.
    """
    path = Path(path)
    try:
        # Opened like any new file, so that it gets the permissions the user's umask gives.
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
        temporary.open("xb").close()
    except OSError as error:
        raise CannotCreate(
            f"{path}: cannot be created ({error.strerror}); choose an existing folder you may write to"
        ) from None
    try:
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    except IsADirectoryError:
        _remove(temporary)
        raise CannotCreate(f"{path}: is a folder; choose another name or move it away") from None
    except CgidError:
        _remove(temporary)
        raise
    except OSError as error:
        _remove(temporary)
        raise WriteFailed(
            f"{path}: writing failed ({error.strerror or error}); nothing was left behind, free some space"
        ) from None
    except BaseException:
        _remove(temporary)
        raise


def check_new(path: Path, what: str, endings: Collection[str], *, overwrite: bool = False) -> Path:
    """Return the path if a file may be made there, before any work is done.

    Parameters
    ----------
    path : Path
    what : str
        What it will be, with its article.
    endings : collection of str
        Its name ends in one of them, in small letters or capitals.
    overwrite : bool
        Whether an old file may be replaced.

    Raises
    ------
    CannotCreate
        The name ends otherwise, the folder is missing, or there is something already.
    """
    if path.suffix.lower() not in endings:
        raise CannotCreate(
            f"{path}: the name of {what} must end in {' or '.join(endings)}, got {path.suffix or 'no ending'!r}"
        )
    if not path.parent.is_dir():
        raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
    if path.is_dir() or (path.exists() and not overwrite):
        raise CannotCreate(f"{path}: exists already; choose another name or say --overwrite")
    return path


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()

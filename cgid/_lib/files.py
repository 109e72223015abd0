"""Atomic file writes and bounded reads of untrusted files.

A file is written under a temporary name, flushed to the disk and renamed. Windows is supported but not tested.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cgid._lib.spelling import spelled
from cgid.errors import BadData, CannotCreate, CgidError, NoInput, WriteFailed

#: Errors of a full disk.
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
#: Errors of file systems without hard links.
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EINVAL}
#: A temporary file unchanged for this long was left by a killed process [s].
STALE = 3600.0
#: Limit of parts in a dotted TOML key: time and memory of Python's parser grow with their square.
_MAX_PARTS = 16
_PART = r"""\.[ \t]*+(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
#: Limit of digits in a TOML number.
_MAX_DIGITS = 1000


# ---- one file --------------------------------------------------------------------------------------------------------


def write_whole(
    path: str | Path,
    content: bytes | memoryview,
    *,
    overwrite: bool = True,
    check: Callable[[], object] | None = None,
) -> None:
    """Write a file atomically: it has the old content or all of the new. Raises as `whole_file`."""
    with whole_file(path, overwrite=overwrite, check=check) as temporary, temporary.open("wb") as stream:
        stream.write(content)


@contextmanager
def whole_file(
    path: str | Path, *, overwrite: bool = True, check: Callable[[], object] | None = None
) -> Iterator[Path]:
    """Yield a temporary file name; the file gets its final name if the context, and `check`, end without an error."""
    path = Path(path)
    # Nor is a device or pipe replaced, or a link to a descriptor: as root, that would break the system.
    is_descriptor = path.is_symlink() and str(path.readlink()).startswith("/proc/")
    if is_descriptor or (path.exists() and not (path.is_file() or path.is_dir())):
        raise CannotCreate(f"{path}: must be a regular file, it is a device or a pipe; choose another name")
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.part")
    try:
        try:
            temporary.open("xb").close()  # a plain open applies the user's umask
        except OSError as error:
            hint = "free some space" if error.errno in FULL else "choose an existing folder you may write to"
            raise CannotCreate(f"{path}: cannot be created ({error.strerror}); {hint}") from None
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        if check is not None:
            check()
        if overwrite:
            temporary.replace(path)
        else:
            _publish_new(temporary, path)
    except BaseException as error:
        _remove(temporary)
        if isinstance(error, CgidError):
            raise
        if isinstance(error, IsADirectoryError):
            raise CannotCreate(f"{path}: is a folder; choose another name or move it away") from None
        if isinstance(error, FileExistsError):
            raise CannotCreate(
                f"{path}: was created in the meantime; choose another name or give {spelled('overwrite', 'true')}"
            ) from None
        if isinstance(error, OSError):
            hint = "free some space" if error.errno in {*FULL, None} else "choose another folder, or check the disk"
            raise WriteFailed(
                f"{path}: writing failed ({error.strerror or error}), no partial file remains; {hint}"
            ) from None
        raise
    sync_folder(path.parent)


def _publish_new(temporary: Path, path: Path) -> None:
    """Rename a file unless the name is taken; raises `FileExistsError`."""
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        temporary.replace(path)
    else:
        _remove(temporary)


def sync_folder(folder: Path) -> None:
    """Flush a folder to the disk, so that a rename in it survives a power cut, where the system can do this."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def half_written(name: str) -> str:
    """Return the pattern of the temporary files of `whole_file` for names that match `name`.

    >>> import re
    >>> bool(re.fullmatch(half_written("shard-[0-9]+"), ".shard-7.0123456789ab.part"))
    True
    """
    return rf"\.(?:{name})\.[0-9a-f]+\.part"


def clear_half_written(path: Path) -> None:
    """Remove the temporary files of killed processes for this name: those unchanged for an hour."""
    pattern = re.compile(half_written(re.escape(path.name)))
    with contextlib.suppress(OSError):
        for left in path.parent.iterdir():
            if pattern.fullmatch(left.name) and time.time() - left.lstat().st_mtime > STALE:
                _remove(left)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


# ---- several files ---------------------------------------------------------------------------------------------------


def write_together(contents: Mapping[Path, bytes], *, overwrite: bool = True) -> None:
    """Write files of one folder so that all have their old content or all have the new."""
    # All are flushed before the first is renamed; a failed rename undoes the others. A process killed between two
    # renames (microseconds) may leave a mix of complete old and new files.
    made: dict[Path, int] = {}
    with contextlib.ExitStack() as stack:
        for path in contents:
            stack.enter_context(_restored(path, made))
        for path in reversed(list(contents)):  # so that the first is renamed first
            temporary = stack.enter_context(whole_file(path, overwrite=overwrite))
            temporary.write_bytes(contents[path])
            made[path] = temporary.stat().st_ino


@contextmanager
def _restored(path: Path, made: Mapping[Path, int]) -> Iterator[None]:
    """Keep an existing file, and restore it if an error follows its replacement by the file in `made`."""
    old = path.with_name(f".{path.name}.{os.urandom(6).hex()}.part")
    had, is_restorable = path.is_file(), False
    try:
        if had:
            _second_name(path, old)
        yield
    except BaseException:
        try:
            # Compare inodes instead of listing renames: Ctrl-C may come between a rename and its entry in the list.
            if path.stat().st_ino == made.get(path):
                old.replace(path) if had else path.unlink()
        except OSError:
            is_restorable = had  # keep the old file if it cannot be restored
        raise
    finally:
        if not is_restorable:
            _remove(old)


def _second_name(path: Path, other: Path) -> None:
    try:
        os.link(path, other)
    except OSError:  # not every system has hard links
        try:
            shutil.copy2(path, other)
        except OSError as error:
            raise WriteFailed(
                f"{path}: cannot be backed up while it is replaced ({error.strerror}); it is unchanged, free some space"
            ) from None


# ---- checks before any work ------------------------------------------------------------------------------------------


def check_new(path: Path, what: str, endings: Collection[str], *, overwrite: bool = False) -> Path:
    """Return the path if a file may be created there; call this before any work."""
    if path.suffix.lower() not in endings:
        raise CannotCreate(
            f"{path}: the name of {what} must end in {' or '.join(endings)}, got {path.suffix or 'no ending'!r}"
        )
    with looking_at(path):
        if not path.parent.is_dir():
            raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
        if path.is_dir() or (path.exists() and not overwrite):
            raise CannotCreate(f"{path}: exists already; choose another name or give {spelled('overwrite', 'true')}")
    return path


def require_not_input(output: str | Path, inputs: Iterable[str | Path]) -> None:
    """Raise `CannotCreate` if a file to be written is one of those to be read, by whatever name; call before any work.

    An input "-" is the standard input. Links count, too: what they name would be replaced, or is what the user means.
    """
    try:
        written = os.stat(output)  # noqa: PTH116 - also a name with a zero byte
    except (OSError, ValueError):
        return  # a new file is none of them
    for one in inputs:
        try:
            read = os.fstat(0) if one == "-" else os.stat(one)  # noqa: PTH116
        except (OSError, ValueError):
            continue
        if os.path.samestat(written, read):
            name = "the standard input" if one == "-" else str(one)
            raise CannotCreate(f"{output}: must not be one of the inputs, it is {name}; choose another name")


@contextmanager
def looking_at(path: Path) -> Iterator[None]:
    """Raise `CannotCreate` if a path cannot be examined: a folder without permission, or a link to itself."""
    try:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
        yield
    except CgidError:
        raise
    except OSError as error:
        raise CannotCreate(f"{path}: cannot be accessed ({error.strerror}); choose another name") from None


def require_room(path: Path, folder: Path, needed: int, what: str, hint: str) -> None:
    """Raise `CannotCreate` if the disk of `folder` has less than `needed` [bytes] free."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise CannotCreate(
            f"{path}: the disk must have {needed / 1e9:.3g} GB free for {what}, got {free / 1e9:.3g} GB; {hint}"
        )


# ---- untrusted files -------------------------------------------------------------------------------------------------


def require_regular(path: str | Path, what: str, largest: int) -> int:
    """Return the size of an untrusted file [bytes] if it is regular and has at most `largest` bytes."""
    # A pipe would block, a device never ends, and a large file fills memory or disk.
    about = Path(path).stat()
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(about.st_mode):
        raise BadData(f"{path}: {what} must be a regular file, it is a pipe or a device; copy it to a file first")
    if about.st_size > largest:
        raise BadData(
            f"{path}: {what} must be at most {largest >> 20} MiB, it has {about.st_size >> 20} MiB; give a smaller file"
        )
    return about.st_size


def read_regular(path: str | Path, what: str, largest: int, hint: str = "check the name") -> bytes:
    """Return the content of a regular file; raises `BadData` as `require_regular`, and `NoInput` for other errors."""
    try:
        size = require_regular(path, what, largest)
        with Path(path).open("rb") as stream:
            return stream.read(size)
    except CgidError:
        raise
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        reason = getattr(error, "strerror", None) or error
        raise NoInput(f"{path}: {what} cannot be read ({reason}); {hint}") from None


def read_cells(path: str | Path, what: str, largest: int) -> list[tuple[int, list[str]]]:
    """Return the numbered lines of a UTF-8 CSV file as cells, without empty lines and comments."""
    import csv

    try:
        text = read_regular(path, what, largest).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BadData(f"{path}: {what} must be UTF-8 text; save it as CSV in UTF-8") from None
    return [
        (number, [cell.strip() for cell in next(csv.reader([line], skipinitialspace=True))])
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip(" ,\t") and not line.lstrip().startswith("#")
    ]


def parse_toml(text: str, max_keys: int) -> dict[str, Any]:
    """Parse TOML; raise `ValueError` if it is invalid or has too many keys or levels."""
    import tomllib

    n_keys = text.count("=") + f"\n{text}".count("\n[")
    if n_keys > max_keys:
        raise ValueError(f"it must have at most {max_keys} keys and tables, got {n_keys}")
    # This also searches strings and comments: distinguishing them would need another parser.
    if long := re.search(f"(?:{_PART}){{{_MAX_PARTS}}}", text):
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"a dotted key must have at most {_MAX_PARTS} parts, that of line {line} has more")
    # Python refuses a decimal of thousands of digits as well, after hundreds of times the memory of the text.
    # Only the start of a run is matched: otherwise each of its digits would cost a search through a thousand others.
    if re.search(f"(?<![0-9A-Fa-f_])[0-9A-Fa-f_]{{{_MAX_DIGITS}}}", text):
        raise ValueError(f"a number must have fewer than {_MAX_DIGITS} digits")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it must have fewer levels of brackets") from None

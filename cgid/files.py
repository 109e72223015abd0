"""Locks of files and folders, which go with the process that holds them.

Whole files or none: written beside their name, flushed to disk, then renamed.

Several files that get their names together or not at all.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cgid.errors import BadData, CannotCreate, CgidError, NoInput, WriteFailed

#: What file systems that know no such locks say.
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EBADF, errno.EINVAL, errno.ENOSYS}
_PAUSE = 0.02


@contextmanager
def locked(path: Path, *, shared: bool = False, patience: float = 0.0) -> Iterator[bool]:
    """Hold a file or a folder within this context, alone or with others who hold it shared.

    The kernel lets go of it when the process ends, however it ends. Where there are no such locks, nothing is held.

    Parameters
    ----------
    path : Path
    shared : bool
    patience : float
        How long others are waited for [s].

    Yields
    ------
    bool
        Whether it is held.

    Raises
    ------
    BlockingIOError
        Somebody else holds it.
    OSError
        It cannot be opened.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield False
        return
    descriptor, held = os.open(path, os.O_RDONLY), True
    try:
        end = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    raise
                time.sleep(_PAUSE)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                held = False
                break
        if not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise BlockingIOError(errno.EWOULDBLOCK, "another file has its name by now")
        yield held
    finally:
        os.close(descriptor)


#: What a disk says that has no room.
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
#: What file systems without hard links say when asked for one.
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EINVAL}
#: Of renameat2(2).
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2

#: Parts of a dotted key of TOML, at most: Python's parser takes time and memory with their square.
_MOST_PARTS = 16
_PART = r"""\.[ \t]*+(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""


def parse_toml(text: str, most_keys: int) -> dict[str, Any]:
    """Return the content of a TOML text; raise `ValueError` for what is none, or has too many keys or levels."""
    import tomllib

    n_keys = text.count("=") + f"\n{text}".count("\n[")
    if n_keys > most_keys:
        raise ValueError(f"it must have at most {most_keys} keys and tables, got {n_keys}")
    # Looked for in strings and comments, too: telling them apart would take another parser.
    if long := re.search(f"(?:{_PART}){{{_MOST_PARTS}}}", text):
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"a dotted key must have at most {_MOST_PARTS} parts, that of line {line} has more")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it must have fewer levels of brackets") from None


def write_whole(path: str | Path, content: bytes | memoryview, *, overwrite: bool = True) -> None:
    """Write a file so that its name only ever bears the old content or all of the new; raises as `whole_file`."""
    with whole_file(path, overwrite=overwrite) as temporary, temporary.open("wb") as stream:
        stream.write(content)


@contextlib.contextmanager
def whole_file(path: str | Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yield the name of an empty file to be filled and closed, which then bears the name asked for, if all went well.

    Parameters
    ----------
    path : str or Path
    overwrite : bool
        Whether the file may take the place of another that has the name when this one is whole.

    Raises
    ------
    CannotCreate
        The folder is missing or not writable, or the name was taken meanwhile and is not to be overwritten.
    WriteFailed
        The disk is full or broken; what was there before is untouched.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        _create(temporary, path)
        # For `clear_half_written`; shared, so that nobody is kept from reading the file once it has its name.
        with locked(temporary, shared=True):
            yield temporary
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())
            if overwrite:
                temporary.replace(path)
            else:
                _publish_new(temporary, path)
    except IsADirectoryError:
        _remove(temporary)
        raise CannotCreate(f"{path}: is a folder; choose another name or move it away") from None
    except FileExistsError:
        _remove(temporary)
        raise CannotCreate(f"{path}: has come into being meanwhile; choose another name or say --overwrite") from None
    except CgidError:
        _remove(temporary)
        raise
    except OSError as error:
        _remove(temporary)
        cure = "free some space" if error.errno in {*FULL, None} else "choose another place, or see to the disk"
        raise WriteFailed(
            f"{path}: writing failed ({error.strerror or error}); nothing was left behind, {cure}"
        ) from None
    except BaseException:
        _remove(temporary)
        raise
    sync_folder(path.parent)


def require_regular(path: str | Path, what: str, largest: int) -> int:
    """Return the size of a regular file that may come from a stranger, or be named in a file that does [bytes].

    A pipe would be waited for, a device never ends, and a large file fills memory or disk.

    Parameters
    ----------
    path : str or Path
    what : str
        What it should be, with its article.
    largest : int
        [bytes].

    Raises
    ------
    BadData
        It is no regular file, or larger.
    OSError
        There is none, or it is a folder.
    """
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


def read_regular(path: str | Path, what: str, largest: int, cure: str = "check the name") -> bytes:
    """Return the content of a regular file; parameters and `BadData` as `require_regular`, else `NoInput`."""
    try:
        size = require_regular(path, what, largest)
        with Path(path).open("rb") as stream:
            return stream.read(size)
    except CgidError:
        raise
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        reason = getattr(error, "strerror", None) or error
        raise NoInput(f"{path}: {what} cannot be read ({reason}); {cure}") from None


def half_written(name: str) -> str:
    """Return the pattern of what a killed process leaves of files whose names have this pattern; see `whole_file`.

    Examples
    --------
    >>> import re
    >>> bool(re.fullmatch(half_written("shard-[0-9]+"), ".shard-7.0123456789ab.part"))
    True
    """
    return rf"\.(?:{name})\.[0-9a-f]+\.part"


def clear_half_written(path: Path) -> None:
    """Remove what killed processes have left of files that were to bear this name; who still writes one holds it."""
    pattern = re.compile(half_written(re.escape(path.name)))
    with contextlib.suppress(OSError):
        for found in path.parent.iterdir():
            if pattern.fullmatch(found.name) and stat.S_ISREG(found.lstat().st_mode):
                with contextlib.suppress(OSError), locked(found) as held:
                    if held:
                        found.unlink()


def _create(temporary: Path, path: Path) -> None:
    """Make the empty file that is to bear the name `path`."""
    try:
        # Opened like any new file, so that it gets the permissions the user's umask gives.
        temporary.open("xb").close()
    except OSError as error:
        cure = "free some space" if error.errno in FULL else "choose an existing folder you may write to"
        raise CannotCreate(f"{path}: cannot be created ({error.strerror}); {cure}") from None


def _publish_new(temporary: Path, path: Path) -> None:
    """Give a file its name unless another has it; raises `FileExistsError`."""
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
    """Flush a folder to the disk, so that a rename in it outlasts a power cut.

    Not every system can. What was renamed is whole under its name by then, so a failure is no reason to call it failed.
    """
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def require_room(path: Path, folder: Path, needed: int, what: str, cure: str) -> None:
    """Raise `CannotCreate` if a disk has less room than needed.

    Parameters
    ----------
    path : Path
        What is to be made, for the message.
    folder : Path
        On the disk.
    needed : int
        [bytes].
    what : str
        Which takes them.
    cure : str
    """
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise CannotCreate(
            f"{path}: the disk must have room for {needed / 1e9:.3g} GB of {what}, {free / 1e9:.3g} GB are free; {cure}"
        )


def exchange(one: Path, other: Path) -> bool:
    """Let two files or folders change names in one step, and return whether this system can."""
    import ctypes

    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False  # no Linux, or one before glibc 2.28
    done: int = rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE)
    return done == 0


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
    with looking_at(path):
        if not path.parent.is_dir():
            raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
        if path.is_dir() or (path.exists() and not overwrite):
            raise CannotCreate(f"{path}: exists already; choose another name or say --overwrite")
    return path


@contextlib.contextmanager
def looking_at(path: Path) -> Iterator[None]:
    """Raise `CannotCreate` where one may not look, in a closed folder or behind a link that leads to itself."""
    try:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
        yield
    except CgidError:
        raise
    except OSError as error:
        raise CannotCreate(f"{path}: cannot be looked at ({error.strerror}); choose another name") from None


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


#: Others that write into the same folder at this moment are waited for so long [s].
_PATIENCE = 5.0


def write_together(contents: Mapping[Path, bytes], *, overwrite: bool = True) -> None:
    """Write files of one folder so that all of them hold what they held before, or all hold the new.

    All are written and flushed before the first gets its name. If one cannot get it, the others are put back. Who kills
    the process between two renames, which take microseconds, may find some files new and some old, each of them whole.

    Parameters
    ----------
    contents : dict of bytes
        In the order in which they get their names.
    overwrite : bool
        Whether old files may be replaced.

    Raises
    ------
    CannotCreate
        The folder is missing or not writable, or a name was taken meanwhile and is not to be overwritten.
    WriteFailed
        The disk is full or broken; what was there before is there.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_together({Path(folder) / "card.md": b"# card", Path(folder) / "model": b"..."})
    ...     sorted(path.name for path in Path(folder).iterdir())
    ['card.md', 'model']
    """
    made: dict[Path, int] = {}
    with contextlib.ExitStack() as stack:
        # Where systems cannot tell of others, or these take too long, it goes on without.
        with contextlib.suppress(OSError):
            stack.enter_context(locked(next(iter(contents)).parent, patience=_PATIENCE))
        for path in contents:
            stack.enter_context(_put_back(path, made))
        _write(list(contents.items()), made, overwrite)


def _write(contents: Sequence[tuple[Path, bytes]], made: dict[Path, int], overwrite: bool) -> None:
    """Write all files, the last first, then give them their names, the first first; note their inodes before."""
    if not contents:
        return
    path, content = contents[-1]
    with whole_file(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(content)
        made[path] = temporary.stat().st_ino
        _write(contents[:-1], made, overwrite)


@contextlib.contextmanager
def _put_back(path: Path, made: Mapping[Path, int]) -> Iterator[None]:
    """Keep what bears a name, and give it back if something fails when what was `made` has the name already."""
    old = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    had, kept = path.is_file(), False
    try:
        if had:
            _second_name(path, old)
        yield
    except BaseException:
        try:
            # Not by a list of what was renamed: Ctrl-C may come between the renaming and the listing.
            if path.stat().st_ino == made.get(path):
                old.replace(path) if had else path.unlink()
        except OSError:
            kept = had  # what cannot be given back is not thrown away
        raise
    finally:
        if not kept:
            with contextlib.suppress(OSError):
                old.unlink()


def _second_name(path: Path, other: Path) -> None:
    try:
        os.link(path, other)
    except OSError:  # not every system has second names
        try:
            shutil.copy2(path, other)
        except OSError as error:
            raise WriteFailed(
                f"{path}: cannot be kept while it is replaced ({error.strerror}); it is as it was, free some space"
            ) from None

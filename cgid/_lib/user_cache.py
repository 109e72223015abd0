"""The user's cache: files that can be made again, such as compiled kernels (`compiled`).

A file is in a folder that only the user can write to. Its name contains a hash of all that its content depends on, and
it begins with the SHA-256 of its name and content. So there is neither an index nor a lock: whatever is wrong with a
file or the disk, the content is made again, in memory.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
from collections.abc import Iterable
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
_CHECKSUM = 32  # bytes


def private_folder(name: str, configured: str = "") -> Path | None:
    """Return a folder of the configured or the user's cache, created if needed; None if it cannot be trusted."""
    try:
        default = _of_user()
        if not configured and not default.is_absolute():  # there is no home folder
            return None
        folder = (Path(configured).absolute() if configured else default) / name
        if not folder.exists():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder if stat.S_ISDIR(folder.lstat().st_mode) and is_private(folder.lstat()) else None
    except (OSError, ValueError):
        return None


def _of_user() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", ""), "cgid", "Cache")
    home = Path("~").expanduser()
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "cgid"
    return Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"), "cgid")


def is_private(status: os.stat_result) -> bool:
    """Return whether only this user or the administrator can have written it: pickles of kernels run code."""
    if not hasattr(os, "getuid"):  # Windows: a user's cache folder is that user's
        return True
    return status.st_uid in (os.getuid(), 0) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def digest(files: Iterable[Path], *others: str) -> str:
    """Return a digest of the contents of files and of texts such as versions: 16 hexadecimal digits."""
    hash_ = hashlib.sha256(repr(others).encode())
    for file in files:
        hash_.update(hashlib.sha256(file.read_bytes()).digest())
    return hash_.hexdigest()[:16]


def read_payload(path: Path) -> memoryview | None:
    """Return the payload of a file, None if it is damaged or others may have written it."""
    # Do not block on a pipe or a device.
    file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(file, "rb") as stream:
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode) or not is_private(status):
            return None
        content = memoryview(stream.read())
    return content[_CHECKSUM:] if _checksum(path, content[_CHECKSUM:]) == content[:_CHECKSUM] else None


def _checksum(path: Path, payload: bytes | memoryview) -> bytes:
    hash_ = hashlib.sha256(path.name.encode())
    hash_.update(payload)
    return hash_.digest()


def write_payload(path: Path, payload: bytes) -> None:
    """Write a file atomically; it need not survive a power cut, so there is no fsync."""
    import tempfile

    file, name = tempfile.mkstemp(prefix=".", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(file, "wb") as stream:
            stream.write(_checksum(path, payload))
            stream.write(payload)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise

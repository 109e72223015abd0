"""The user's cache: files that can be made again, compiled kernels (`compiled`) and tables of beams.

A file is in a folder that only the user can write to. Its name contains a hash of all that its content depends on, and
it begins with the SHA-256 of its name and content. So there is neither an index nor a lock: whatever is wrong with a
file or the disk, the content is made again, in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKAGE = Path(__file__).parents[1]
_CHECKSUM = 32  # bytes
#: What tables are made by.
_TABLE_SOURCES = ("identification/inversion", "measure/modal", "measure/fit")
#: The oldest tables are removed beyond this size of all [bytes], of four beams or more.
_MAX_TABLES = 256 << 20
#: Arrays begin at multiples of this in a file of tables [bytes].
_ALIGNED = 64


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


# ---- tables ----------------------------------------------------------------------------------------------------------


@cache
def _table_folder() -> Path | None:
    return private_folder("tables", os.environ.get("NUMBA_CACHE_DIR", ""))


@cache
def _table_sources() -> str:
    files = [file for name in _TABLE_SOURCES for file in sorted((PACKAGE / name).iterdir()) if file.is_file()]
    return digest(files, np.__version__)


def identity_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return a digest of arrays: 16 hexadecimal digits."""
    hash_ = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        hash_.update(repr((name, array.dtype.str, array.shape)).encode() + np.ascontiguousarray(array).tobytes())
    return hash_.hexdigest()[:16]


def kept(name: str, make: Callable[[], Sequence[NDArray[Any]]]) -> Sequence[NDArray[Any]]:
    """Return tables from the cache, or make and keep them; they may be read-only."""
    path = None
    with contextlib.suppress(Exception):
        folder = _table_folder()
        path = None if folder is None else folder / f"{name}-{_table_sources()}"
        if path is not None and path.exists() and (content := read_payload(path)) is not None:
            return _unpacked(content)
    arrays = make()
    with contextlib.suppress(Exception):
        if path is not None:
            _make_room(path.parent)
            write_payload(path, _packed(arrays))
    return arrays


def _packed(arrays: Sequence[NDArray[Any]]) -> bytes:
    header = json.dumps([(array.dtype.str, array.shape) for array in arrays]).encode()
    parts = [len(header).to_bytes(8, "little") + header, *(np.ascontiguousarray(array).tobytes() for array in arrays)]
    return b"".join(part + bytes(-len(part) % _ALIGNED) for part in parts)


def _unpacked(content: memoryview) -> list[NDArray[Any]]:
    begin = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(bytes(content[8:begin]))
    arrays = []
    for dtype, shape in header:
        begin += -begin % _ALIGNED
        array = np.frombuffer(content, dtype, int(np.prod(shape)), begin).reshape(shape)
        arrays.append(array)
        begin += array.nbytes
    return arrays


def _make_room(folder: Path) -> None:
    """Remove the oldest tables beyond `_MAX_TABLES`."""
    files = sorted(((file.stat(), file) for file in folder.iterdir()), key=lambda one: -one[0].st_mtime)
    total = 0
    for status, file in files:
        total += status.st_size
        if total > _MAX_TABLES:
            file.unlink(missing_ok=True)

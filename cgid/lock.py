"""Locks of files and folders, which go with the process that holds them."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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

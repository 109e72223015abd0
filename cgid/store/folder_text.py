"""The texts that lie in a folder of files, a manifest or a journal: read if they are what the folder bears out.

A folder may come from a stranger, too. A pipe in it would hold its reader up for ever, a link would have another file
read, and a hundred megabytes of JSON are gigabytes of lists.
"""

from __future__ import annotations

import stat
from pathlib import Path

from cgid.errors import BadData, NoInput

#: What may be said beside the files [bytes], of which the scene is most, and of each file.
_ROOM, _ROOM_OF_FILE = 16 << 20, 4096
#: Likewise, in values of JSON.
_VALUES, _VALUES_OF_FILE = 100_000, 100


def read_text(file: Path) -> bytes | None:
    """Return the content of a plain file that is as large as the files beside it make it, at most; None without one.

    Raises
    ------
    BadData
        It is a link, no plain file, or larger.
    NoInput
        It cannot be read: what it says may be sound.
    """
    try:
        return _content(file)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise NoInput(f"{file}: cannot be read ({error.strerror}); see to its permissions, or to the disk") from None


def _content(file: Path) -> bytes:
    about = file.lstat()  # of a link, where it leads is not looked at
    if not stat.S_ISREG(about.st_mode):
        raise BadData(
            f"{file}: must be a regular file of its folder, it is a link, a pipe or the like; generate it again"
        )
    n_files = sum(1 for _ in file.parent.iterdir())
    most = _ROOM + n_files * _ROOM_OF_FILE
    content = b""
    if about.st_size <= most:
        with file.open("rb") as stream:
            content = stream.read(about.st_size + 1)  # room is made for all that is asked for
    if max(about.st_size, len(content)) > most:
        raise BadData(f"{file}: must be at most {most >> 20} MiB beside {n_files} files; it is not what cgid wrote")
    if sum(content.count(sign) for sign in (b",", b"[", b"{", b"\n")) > _VALUES + n_files * _VALUES_OF_FILE:
        raise BadData(f"{file}: says more than {n_files} files beside it bear out; it is not what cgid wrote")
    return content

"""The pages of an Ogg file (RFC 3533): whether all of them are there, which decoders do not tell."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

#: Bytes of a page before its table of segments.
_HEAD_SIZE = 27

_LAST_PAGE = 4


@dataclass(frozen=True, kw_only=True)
class OggPages:
    """What the pages of a file say.

    Attributes
    ----------
    is_whole : bool
        The last page is marked as such, and none is missing before.
    n_samples : int or None
        Of each channel, by the position of the last page; None where it does not count samples.
    """

    is_whole: bool
    n_samples: int | None


def ogg_pages(path: Path) -> OggPages | None:
    """Return what the pages of a file say; None if it is no Ogg file."""
    position, flags, number = 0, 0, -1
    is_vorbis = False
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        at = 0
        while len(head := file.read(_HEAD_SIZE)) == _HEAD_SIZE and head.startswith(b"OggS"):
            table = file.read(head[26])
            end = at + _HEAD_SIZE + head[26] + sum(table)
            if end > size or int.from_bytes(head[18:22], "little") != number + 1:
                break
            if not at:
                is_vorbis = file.read(7) == b"\x01vorbis"
            number, flags, at = number + 1, head[5], end
            position = int.from_bytes(head[6:14], "little", signed=True)
            file.seek(at)
        if not at and not head.startswith(b"OggS"):
            return None
    return OggPages(is_whole=at == size and bool(flags & _LAST_PAGE), n_samples=position if is_vorbis else None)

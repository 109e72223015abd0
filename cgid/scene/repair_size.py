"""How much a repair may make: who sends a small folder does not fill the disk by what it says of itself."""

from __future__ import annotations

import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData
from cgid.scene.schema import Scene, samples_of

#: So many bytes, and for each byte that lies there so many more.
_ROOM, _ROOM_FOR_EACH = 16 << 20, 100
#: What is stored of a signal beside its samples [bytes], about.
_ROW = 100


class Room:
    """How much more may be made again, by what lies there.

    Parameters
    ----------
    path : Path
        A file or a folder.
    """

    def __init__(self, path: Path) -> None:
        files = path.iterdir() if path.is_dir() else (path,)
        # A file full of holes claims any size, and what a link of a folder leads to is not there.
        abouts = map(Path.lstat, files) if path.is_dir() else map(Path.stat, files)
        plain = [about for about in abouts if stat.S_ISREG(about.st_mode)]
        stored = sum(min(about.st_size, 512 * getattr(about, "st_blocks", about.st_size)) for about in plain)
        self._left = _ROOM + _ROOM_FOR_EACH * stored

    def take(self, path: Path, size: int) -> None:
        """Take room for so many bytes of a file; raises `BadData` if there is none."""
        if size > self._left:
            raise BadData(
                f"{path}: so little of it is left that it is no repair ({size / 1e6:.3g} MB would be made, "
                f"{self._left / 1e6:.3g} MB may); if you trust it, make it anew by cgid generate"
            )
        self._left -= size


def size_made(path: Path, examined: Mapping[str, Any], scene: Scene) -> int:
    """Return what signals or samples take that are made again like those of a file [bytes].

    Raises
    ------
    BadData
        The scene makes others.
    """
    require_length(path, examined["n_samples"], scene)
    n_signals = examined["chunks"]["signals"][-1][1] if "signals" in examined["chunks"] else 1
    return size_of(n_signals, examined["n_samples"], examined["dtype"])


def size_of(n_signals: int, n_samples: int, dtype: str) -> int:
    """Return what signals take [bytes]."""
    return n_signals * (n_samples * np.dtype(dtype).itemsize + _ROW)


def require_length(path: Path, n_samples: int, scene: Scene) -> None:
    """Raise `BadData` unless a scene makes as many samples as are said to lie in a file."""
    if n_samples != samples_of(scene):
        raise BadData(
            f"{path}: must hold as many samples as its scene makes, {samples_of(scene)}, it holds {n_samples}; make it "
            "again by cgid generate"
        )

"""Texts of variable length, read in a process of its own that has a limit of time and memory.

One flipped bit in the heap such texts lie in can make HDF5 search for ever, and nothing within a process can stop it.
This file is also the script that process runs.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: [s], of the clock and of the processor; a sound file takes a tenth.
_LONGEST, _PROCESSOR = 4.0, 2
#: Address space [bytes].
_MEMORY = 2 << 30
#: Longer lists and texts are no units and no names.
_LONGEST_LIST, _LONGEST_TEXT = 4096, 200


def read_texts(path: Path, asked: Sequence[tuple[str, str]]) -> dict[tuple[str, str], Any] | None:
    """Return texts, each as text or list of texts; None if they cannot be read in time.

    Parameters
    ----------
    path : Path
        An HDF5 file.
    asked : sequence of (str, str)
        Path of the group or dataset ("" is the root) and name of the attribute, "" for the dataset's own value.
    """
    command = [sys.executable, "-P", str(Path(__file__).resolve()), str(path)]
    try:
        done = subprocess.run(
            command, input=json.dumps(list(asked)).encode(), capture_output=True, timeout=_LONGEST, check=True
        )
        found = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return {place: value for place, value in zip(asked, found, strict=True) if value is not None}


def _limit() -> None:
    try:
        import resource
    except ImportError:
        # Only Unix has it; elsewhere the caller's limit of time is all there is.
        return
    resource.setrlimit(resource.RLIMIT_CPU, (_PROCESSOR, _PROCESSOR))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _main() -> None:
    _limit()
    import h5py
    import numpy as np

    found: list[Any] = []
    with h5py.File(sys.argv[1], "r") as file:
        for path, name in json.loads(sys.stdin.read()):
            item = file[path or "/"]
            values = np.atleast_1d(np.asarray(item.attrs[name] if name else item[()], dtype=object)).ravel().tolist()
            texts = [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in values]
            sound = len(texts) <= _LONGEST_LIST and all(isinstance(t, str) and len(t) <= _LONGEST_TEXT for t in texts)
            found.append((texts[0] if len(texts) == 1 else texts) if sound and texts else None)
    print(json.dumps(found))


if __name__ == "__main__":
    _main()

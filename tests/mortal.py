"""A part of some work that ends the process doing it; by itself, for a worker must load what it is asked for."""

import os
import signal
from pathlib import Path


def fatal(marks: str, part: int) -> int:
    """End the process that does part 1, for the first so many times; `marks` is "folder|so many"."""
    folder, _, most = marks.partition("|")
    deaths = len(list(Path(folder).iterdir()))
    if part == 1 and deaths < int(most):
        (Path(folder) / str(deaths)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return part

"""A part of some work that ends its process; a separate module, because workers must be able to import it."""

import os
import signal
from pathlib import Path


def fatal(marks: str, part: int) -> int:
    """Kill the process that does part 1, the first n times; `marks` is "folder|n"."""
    folder, _, most = marks.partition("|")
    deaths = len(list(Path(folder).iterdir()))
    if part == 1 and deaths < int(most):
        (Path(folder) / str(deaths)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return part

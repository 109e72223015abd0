"""Threads that share the rows of a batch: compiled kernels let go of the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Rows below which another thread does not pay, and those after which Python may look for an interruption.
_LEAST, _MOST = 200, 1024


def in_threads(run: Callable[..., None], arguments: tuple[Any, ...], rows: NDArray[np.intp], threads: int) -> None:
    """Call a kernel, which lets go of the interpreter's lock, for parts of the rows, in threads if there are several.

    No part takes long, so that Ctrl-C is heard.
    """
    threads = max(min(threads, -(-rows.size // _LEAST)), 1)
    parts = np.array_split(rows, max(threads, -(-rows.size // _MOST)))
    each = pool(threads).map if threads > 1 else map
    list(each(lambda part: run(*arguments, part), parts))


@cache
def pool(threads: int) -> ThreadPoolExecutor:
    """Return threads that are kept: starting them anew takes as long as a hundred pulses."""
    return ThreadPoolExecutor(threads, thread_name_prefix="cgid")

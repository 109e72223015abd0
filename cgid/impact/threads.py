"""Threads that share the rows of a batch: compiled kernels let go of the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Rows below which another thread does not pay.
_LEAST = 200


def in_threads(run: Callable[..., None], arguments: tuple[Any, ...], rows: NDArray[np.intp], threads: int) -> None:
    """Call a kernel, which lets go of the interpreter's lock, for parts of the rows in threads."""
    threads = min(threads, -(-rows.size // _LEAST))
    if threads <= 1:
        run(*arguments, rows)
        return
    list(pool(threads).map(lambda part: run(*arguments, part), np.array_split(rows, threads)))


@cache
def pool(threads: int) -> ThreadPoolExecutor:
    """Return threads that are kept: starting them anew takes as long as a hundred pulses."""
    return ThreadPoolExecutor(threads, thread_name_prefix="cgid")

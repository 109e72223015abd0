"""Counters of the work done, for tests and benchmarks.

`with counted() as counts:` collects; outside of it `count` returns at once.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import SupportsInt

_counts: ContextVar[Counter[str] | None] = ContextVar("cgid_counts", default=None)
_lock = threading.Lock()


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Collect what runs inside, by name.

    It covers this thread and those that run in a copy of its context. Counts inside another `counted` are added to the
    outer one at the end.

    Examples
    --------
    >>> with counted() as counts:
    ...     count("frames", 256)
    ...     count("frames", 44)
    >>> counts["frames"], counts["spectra"]
    (300, 0)
    """
    counts: Counter[str] = Counter()
    token = _counts.set(counts)
    try:
        yield counts
    finally:
        _counts.reset(token)
        for name, number in counts.items():
            count(name, number)


def counting() -> bool:
    """Return whether counts are collected: only then is it worth computing a number to count."""
    return _counts.get() is not None


def count(name: str, number: SupportsInt = 1) -> None:
    """Add to a counter; once for a whole batch, never for each sample.

    Parameters
    ----------
    name : str
        What ran, in the plural.
    number : int
    """
    counts = _counts.get()
    if counts is not None and int(number):
        with _lock:
            counts[name] += int(number)

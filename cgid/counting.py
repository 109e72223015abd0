"""Count the work done, for tests and benchmarks.

`with counted() as counts:` collects counts; outside of it `count` returns at once.
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
    """Collect the counts of the enclosed code by name, and add them to an enclosing `counted`.

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
    """Return whether counts are being collected; otherwise do not compute numbers to count."""
    return _counts.get() is not None


def count(name: str, number: SupportsInt = 1) -> None:
    """Add `number` to the counter `name` (a plural); call once per batch, never per sample."""
    counts = _counts.get()
    if counts is not None and int(number):
        with _lock:
            counts[name] += int(number)

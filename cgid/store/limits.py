"""How much time and memory a process that reads strangers' files may take; it sets these limits on itself."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

#: Of the processor for one answer [s], and bytes of the file for a second more: the slowest packing takes a tenth.
_SECONDS, _BYTES_A_SECOND = 2, 32 << 20
#: The clock is only a wide net: a busy machine or a slow disk is no reason to break off.
_CLOCK = 30
#: Beyond what Python and its libraries take, and what an answer was allowed [bytes].
_SPARE = 128 << 20
_base = 0


def seconds_for(path: str | Path) -> int:
    """Return how long the processor may work at one answer from this file [s]."""
    with suppress(OSError):
        return _SECONDS + Path(path).stat().st_size // _BYTES_A_SECOND
    return _SECONDS


def patience_for(path: str | Path) -> float:
    """Return how long to wait for one answer from this file, by the clock [s]."""
    return float(_CLOCK * seconds_for(path))


def settle() -> None:
    """Take what this process has now as what it needs by itself; leave no core behind."""
    global _base
    with suppress(ImportError):  # only Unix has it; elsewhere the patience of the other process is all there is
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError, ValueError):
            pages = int(Path("/proc/self/statm").read_bytes().split()[5])
            _base = pages * resource.getpagesize()


def begin(path: str | Path) -> None:
    """Begin an answer from this file: its time runs from now on."""
    with suppress(ImportError):
        import resource

        used = resource.getrusage(resource.RUSAGE_SELF)
        spent = int(used.ru_utime + used.ru_stime) + seconds_for(path)
        _limit(resource.RLIMIT_CPU, spent)
    allow(0)


def allow(size: int) -> None:
    """Let this answer take so many bytes beyond the rest."""
    with suppress(ImportError):
        import resource

        if _base:
            _limit(resource.RLIMIT_DATA, _base + _SPARE + size)


def _limit(which: int, value: int) -> None:
    import resource

    _, hard = resource.getrlimit(which)
    within = value if hard == resource.RLIM_INFINITY else min(value, hard)
    with suppress(OSError, ValueError):
        resource.setrlimit(which, (within, hard))

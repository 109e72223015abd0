"""How much time and memory a process that reads strangers' files may take; it sets these limits on itself."""

from __future__ import annotations

import signal
from contextlib import suppress
from pathlib import Path

#: Of the processor for one answer [s], and bytes of the file for a second more: the slowest packing takes a tenth.
_SECONDS, _BYTES_A_SECOND = 1.0, 32 << 20
#: The clock is only a wide net [times as long]: a busy machine or a slow disk is no reason to break off.
_CLOCK = 60
#: Who asks breaks off first, and says why; so much later the process ends by itself [s].
_LATER = 5.0
#: Beyond what Python and its libraries take, and what an answer was allowed [bytes].
_SPARE = 128 << 20
_base = 0


def seconds_for(path: str | Path) -> float:
    """Return how long the processor may work at one answer from this file [s]."""
    with suppress(OSError):
        about = Path(path).stat()
        # A file full of holes claims any size; Windows does not say what lies on the disk.
        stored = min(about.st_size, 512 * getattr(about, "st_blocks", about.st_size))
        return _SECONDS + stored / _BYTES_A_SECOND
    return _SECONDS


def patience_for(path: str | Path) -> float:
    """Return how long to wait for one answer from this file, by the clock [s]."""
    return _CLOCK * seconds_for(path)


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
    if hasattr(signal, "setitimer"):
        # Its signal, which nobody waits for, ends the process; a limit of the processor's time counts whole seconds.
        signal.setitimer(signal.ITIMER_PROF, seconds_for(path))
        # A device that blocks takes no time of the processor, and who asks may be gone: nobody else would end this.
        signal.setitimer(signal.ITIMER_REAL, patience_for(path) + _LATER)
    allow(0)


def rest() -> None:
    """Let nothing but the processor's time run while an answer waits to be taken."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def allow(size: int) -> None:
    """Let this answer take so many bytes beyond the rest."""
    if not _base:
        return
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    soft = _base + _SPARE + size
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))

"""HDF5 files are read in separate processes with limits of time and memory.

The HDF5 library trusts files: one changed bit can make it loop for ever, take all memory or crash, and nothing within
a process can stop it. So this process never opens them. It sends requests through pipes to a reading process
(`_reader`). A request is a line of JSON; a reply is a line of JSON and the bytes of arrays. Unlike pickle, a reply
cannot execute code, and its size is checked before memory is allocated. The items of a stream follow each other, held
back by the pipe. A reading process is reused, and ends with this process; reading two files at once takes two.

The reading process limits its processor time per reply, its memory, and its wall-clock time, in case this process is
gone. Windows has no such limits; there only this process's timeout ends a reader (not tested).
"""

from __future__ import annotations

import _thread
import atexit
import json
import math
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cgid import errors
from cgid.errors import BadData, CgidError

#: Errors of h5py, pandas and pyarrow on damaged files.
DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError)
#: Default limit of the arrays of a reply [bytes].
LARGEST_ANSWER = 64 << 20
#: Longest line [bytes]; headers and surveys are much shorter.
LONGEST_LINE = 16 << 20
#: `dtype.str` of plain numbers and fixed-length texts.
_PLAIN = re.compile(r"[<>|][biufc][0-9]{1,2}|\|S[1-9][0-9]{0,8}")
_MOST_ARRAYS, _MOST_AXES = 100_000, 32
_MAGIC = b"\x89HDF\r\n\x1a\n"
#: Size of a pipe, where the system allows it [bytes]; idle processes that are kept.
_PIPE, _MOST_IDLE = 1 << 20, 2
#: Processor time for a reply [s], and bytes of the file per additional second; the slowest compression needs a tenth.
_SECONDS, _BYTES_A_SECOND = 1.0, 32 << 20
#: Ratio of the wall-clock limit to the processor time limit, for busy machines and slow disks.
_CLOCK = 60
#: The reader ends itself this much later [s], so that the requesting process times out first and reports why.
_LATER = 5.0
#: Longest wait for a thread to begin [s]; one without memory for its first step never does.
_BEGINS = 10.0
#: Memory in addition to the baseline and the allowance of a reply [bytes].
_SPARE = 128 << 20
#: The errors that a reply may name.
_TOLD = {
    name: value for name, value in vars(errors).items() if isinstance(value, type) and issubclass(value, CgidError)
}


# ---- questions -------------------------------------------------------------------------------------------------------


def call(function: str, path: Path, *arguments: Any, source: str | None = None, largest: int = LARGEST_ANSWER) -> Any:
    """Return the result of a function in `cgid.store._reader.FUNCTIONS` for a file: JSON, or a dict of arrays.

    The function receives the absolute path, the file's name in messages (`source`, by default `path`), and `arguments`,
    which must be JSON. The arrays may take at most `largest` [bytes]. Raises the function's `CgidError`, and `BadData`
    if HDF5 crashes or exceeds the limits of time and memory.
    """
    with _reading(function, path, source, arguments) as child:
        return child.answer(largest)


def stream(
    function: str, path: Path, *arguments: Any, source: str | None = None, largest: int = LARGEST_ANSWER
) -> Generator[dict[str, NDArray[Any]], None, None]:
    """Yield the items of a generator in the reading process; parameters and errors as `call`.

    The next item is read while this one is processed. Closing this generator ends the process.
    """
    with _reading(function, path, source, arguments) as child:
        while (item := child.answer(largest)) is not None:
            yield item


def format_said(path: Path) -> str | None:
    """Return the attribute `format` of an HDF5 file, "" if it has none; None if it cannot be opened."""
    if not is_hdf5(path):
        return None
    with suppress(BadData):
        said: str = call("format_said", path)
        return said
    return None


def is_hdf5(path: Path) -> bool:
    """Return whether a regular file has HDF5's signature at 0, 512, 1024, 2048, ..."""
    try:
        if not path.is_file():
            return False
        size, place = path.stat().st_size, 0
        with path.open("rb") as file:
            while place + len(_MAGIC) <= size:
                file.seek(place)
                if file.read(len(_MAGIC)) == _MAGIC:
                    return True
                place = max(512, 2 * place)
    except (OSError, ValueError):
        pass
    return False


# ---- reading processes -----------------------------------------------------------------------------------------------


class _Watchdog:
    """A thread that calls `bite` when a reply is late.

    Each reader has one from its creation, because without memory no thread can start when a reply is wanted, and
    `threading.Thread.start` then may wait for ever. Raises `MemoryError` if it cannot start.
    """

    def __init__(self, bite: Callable[[], None]) -> None:
        self._bite, self._ended = bite, False
        self._orders: queue.SimpleQueue[float | None] = queue.SimpleQueue()
        try:
            _thread.start_new_thread(self._watch, (begun := queue.SimpleQueue[None](),))
            begun.get(timeout=_BEGINS)
        except (RuntimeError, queue.Empty):
            raise MemoryError("no room for one more thread") from None

    def _watch(self, begun: queue.SimpleQueue[None]) -> None:
        begun.put(None)
        patience = None
        while not self._ended:
            try:
                patience = self._orders.get(timeout=patience)
            except queue.Empty:
                patience = None
                self._bite()

    def wait(self, patience: float) -> None:
        """Bite after this time [s] unless told to rest."""
        self._orders.put(patience)

    def rest(self) -> None:
        """Do not bite until told to wait again."""
        self._orders.put(None)

    def end(self) -> None:
        """End the thread."""
        self._ended = True
        self._orders.put(None)


class _Child:
    """A reading process."""

    def __init__(self) -> None:
        # The reader uses this process's library paths, but never the current folder.
        paths = [str(Path(__file__).parents[2]), *(os.path.abspath(entry) for entry in sys.path if entry)]  # noqa: PTH100
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)), "OPENBLAS_NUM_THREADS": "1"}
        # Otherwise HDF5 would load any library from the folder in which it looks for filters.
        environment["HDF5_PLUGIN_PRELOAD"] = "::"
        self.in_step, self._late = False, False
        self._source, self._patience = "", 0.0
        self._watchdog = _Watchdog(self._lose_patience)
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", "cgid.store._reader"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                # Only this process receives Ctrl-C; Windows ignores the first, the others have no second.
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        except BaseException:
            self._watchdog.end()
            raise
        sides: Any = (self.process.stdin, self.process.stdout, self.process.stderr)
        self._input, self._output, self._errors = sides
        _alive.add(self)
        with suppress(ImportError, AttributeError, OSError):  # only Linux has wide pipes
            import fcntl

            fcntl.fcntl(self._output, fcntl.F_SETPIPE_SZ, _PIPE)
        try:
            receive(self._output, 0)
        except BrokenWire:
            said = self._errors.read().decode(errors="replace").strip().rpartition("\n")[2]
            self.end()
            raise CgidError(
                f"the process that reads HDF5 files must start, it did not ({said}); see that it can import h5py"
            ) from None
        except BaseException:
            self.end()
            raise
        self.in_step = True

    def ask(self, function: str, path: Path, source: str, arguments: tuple[Any, ...]) -> None:
        """Request the result of a function for a file, or the items that it yields."""
        self.in_step, self._source, self._patience = False, source, patience_for(path)
        request = {"function": function, "arguments": [os.path.abspath(path), source, *arguments]}  # noqa: PTH100
        with suppress(OSError):  # `answer` reports the end of the process
            self._input.write(json.dumps(request).encode() + b"\n")
            self._input.flush()

    def answer(self, largest: int) -> Any:
        """Return the value or the arrays of the next reply, None after the last item, or raise its error.

        Raises `BadData` if the reply is late or the process crashes.
        """
        if self in _disowned:
            raise CgidError(
                f"{self._source}: must be read on by the process that began to, this one was forked from it meanwhile; "
                "begin anew here"
            )
        self._watchdog.wait(self._patience)
        try:
            reply, arrays = receive(self._output, largest)
        except (OSError, ValueError, BrokenWire) as error:
            raise BadData(
                f"{self._source}: the HDF5 library {self._end_told(error)} on this file; it is damaged or hostile: "
                "copy it again, or leave it out"
            ) from None
        finally:
            self._watchdog.rest()
        self.in_step = bool(reply.get("last"))
        if "error" in reply:
            kind = _TOLD.get(str(reply["error"]), BadData)
            raise kind(str(reply.get("text")))
        return reply.get("value", arrays)

    def _lose_patience(self) -> None:
        self._late = True
        self.process.kill()

    def _end_told(self, error: Exception) -> str:
        """End the process and describe how it ended."""
        self.end(patience=0.2)
        code = self.process.returncode
        if self._late or code == -getattr(signal, "SIGPROF", 0):
            return "did not come to an end"
        if isinstance(error, BrokenWire) and code == -getattr(signal, "SIGKILL", 0):
            return "gave an answer that makes no sense"
        return "crashed"

    def end(self, patience: float = 0.0) -> None:
        """End the process in any state; a crashed one gets some time [s] to set its exit code."""
        _alive.discard(self)
        with suppress(OSError):
            self._input.close()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(patience)
        self.process.kill()
        self.process.wait()
        for side in (self._output, self._errors):
            with suppress(OSError):
                side.close()
        self._watchdog.end()

    def disown(self) -> None:
        """Forget a process of the parent from which this process was forked.

        Close only the descriptors: a thread that does not exist here may hold the buffers, and their content must not
        be sent from here.
        """
        for side in (self._input, self._output, self._errors):
            with suppress(OSError):
                side.raw.close()
        self.process.returncode = 0
        self.in_step = False


_alive: set[_Child] = set()
_idle: list[_Child] = []
#: Kept alive, because deleting a buffer waits for the thread that holds it.
_disowned: list[_Child] = []
#: Reentrant: deleting a generator returns its reader at any point of this thread.
_lock = threading.RLock()


@contextmanager
def _reading(function: str, path: Path, source: str | None, arguments: tuple[Any, ...]) -> Iterator[_Child]:
    """Yield a process for exclusive use that has received a request; keep it if it has answered."""
    with _lock:
        child = _idle.pop() if _idle else None
    if child is None or child.process.poll() is not None:
        if child is not None:
            child.end()
        child = _Child()
    try:
        child.ask(function, path, str(path) if source is None else source, arguments)
        yield child
    finally:
        with _lock:
            kept = child.in_step and len(_idle) < _MOST_IDLE and child in _alive
            if kept:
                _idle.append(child)
        if not kept and child in _alive:
            child.end()


def _end_all() -> None:
    for child in list(_alive):
        child.end()


def _disown_all() -> None:
    """Forget the parent's readers in a forked process."""
    global _lock
    for child in list(_alive):
        child.disown()
        _disowned.append(child)
    _alive.clear()
    _idle.clear()
    _lock = threading.RLock()


atexit.register(_end_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disown_all)


# ---- messages, for both processes ------------------------------------------------------------------------------------


class BrokenWire(Exception):
    """The message is missing or malformed."""


def send(stream: IO[bytes], message: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write a message and its arrays; raises `BrokenWire` if it is too long or JSON cannot hold it."""
    parts = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    said = [[name, part.dtype.str, list(part.shape)] for name, part in parts.items()]
    try:
        line = json.dumps({**message, "arrays": said}, separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise BrokenWire(f"what JSON cannot hold: {error}") from None
    if len(line) >= LONGEST_LINE:
        raise BrokenWire(f"a message of {len(line)} bytes")
    stream.write(line + b"\n")
    for part in parts.values():
        if part.size:
            stream.write(part.reshape(-1).view(np.uint8).data)
    stream.flush()


def receive(stream: IO[bytes], largest: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return a message and its arrays, which may take at most `largest` [bytes] together.

    Raises `BrokenWire` if the other end is gone or the message is not allowed.
    """
    line = stream.readline(LONGEST_LINE + 1)
    if not line.endswith(b"\n"):
        raise BrokenWire("no line")
    try:
        message = json.loads(line)
        said = message.pop("arrays")
        if len(said) > _MOST_ARRAYS or not all(_is_plain(*one) for one in said):
            raise BrokenWire("no plain arrays")
        kinds = {name: (np.dtype(kind), tuple(shape)) for name, kind, shape in said}
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise BrokenWire("no message") from None
    if sum(dtype.itemsize * math.prod(shape) for dtype, shape in kinds.values()) > largest:
        raise BrokenWire("more than was asked for")
    return message, {name: _filled(stream, dtype, shape) for name, (dtype, shape) in kinds.items()}


def _is_plain(name: Any, kind: Any, shape: Any) -> bool:
    return (
        isinstance(name, str)
        and _PLAIN.fullmatch(kind) is not None
        and len(shape) <= _MOST_AXES
        and all(type(length) is int and length >= 0 for length in shape)
    )


def _filled(stream: IO[bytes], dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    array = np.empty(shape, dtype)
    if array.size and stream.readinto(array.reshape(-1).view(np.uint8).data) != array.nbytes:  # type: ignore[attr-defined]
        raise BrokenWire("cut off")
    return array


# ---- limits, which the reading process sets on itself ----------------------------------------------------------------

_base = 0


def seconds_for(path: str | Path) -> float:
    """Return the processor time limit for one reply from this file [s]."""
    with suppress(OSError):
        about = Path(path).stat()
        # A sparse file can declare any size; Windows does not report the stored size.
        stored = min(about.st_size, 512 * getattr(about, "st_blocks", about.st_size))
        return _SECONDS + stored / _BYTES_A_SECOND
    return _SECONDS


def patience_for(path: str | Path) -> float:
    """Return the wall-clock limit for one reply from this file [s]."""
    return _CLOCK * seconds_for(path)


def settle() -> None:
    """Record this process's current memory as its baseline; disable core files."""
    global _base
    with suppress(ImportError):  # only Unix has it
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError, ValueError):
            pages = int(Path("/proc/self/statm").read_bytes().split()[5])
            _base = pages * resource.getpagesize()


def begin(path: str | Path) -> None:
    """Start the time limits of one reply from this file."""
    if hasattr(signal, "setitimer"):
        # The signal ends the process; RLIMIT_CPU would count whole seconds.
        signal.setitimer(signal.ITIMER_PROF, seconds_for(path))
        # A blocking device takes no processor time, and the requesting process may be gone.
        signal.setitimer(signal.ITIMER_REAL, patience_for(path) + _LATER)
    allow(0)


def rest() -> None:
    """Stop the wall-clock limit while a reply waits to be sent."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def allow(size: int) -> None:
    """Allow this reply `size` more memory [bytes]."""
    if not _base:
        return
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    soft = _base + _SPARE + size
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))

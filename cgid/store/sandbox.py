"""What goes between a process and the one that reads for it: a line of JSON, and behind it the bytes of arrays.

Nothing in it can make the receiver run anything, as pickle could, and its sizes are looked at before room is made.

How much time and memory a process that reads strangers' files may take; it sets these limits on itself.

HDF5 files are read in processes of their own, with limits of time and memory.

The HDF5 library trusts files: one changed bit can make it search for ever, take all memory or crash, and nothing within
a process can stop it. So this process never opens them. It asks another (`_reader`), which answers with plain numbers
and texts, and whose end is a message. A reading process is kept for the next question; reading two files side by side
takes two. It ends with this one.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cgid import errors
from cgid.errors import BadData, CgidError

#: Bytes of a line; a header or a survey takes a small part of it.
LONGEST_LINE = 16 << 20
#: Plain numbers and texts of fixed length; `dtype.str` says them so.
_PLAIN = re.compile(r"[<>|][biufc][0-9]{1,2}|\|S[1-9][0-9]{0,8}")
_MOST_ARRAYS, _MOST_AXES = 100_000, 32


class BrokenWire(Exception):
    """What came is no message, or none came."""


def send(stream: IO[bytes], message: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
    """Write a message and its arrays.

    Raises
    ------
    BrokenWire
        It is longer than a message may be, or JSON cannot hold it.
    """
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
    """Return a message and its arrays.

    Parameters
    ----------
    stream : file
    largest : int
        Bytes that the arrays may take together.

    Raises
    ------
    BrokenWire
        The other end is gone, or says what it must not.
    """
    line = stream.readline(LONGEST_LINE + 1)
    if not line.endswith(b"\n"):
        raise BrokenWire("no line")
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        raise BrokenWire("no JSON") from None
    if not isinstance(message, dict):
        raise BrokenWire("no message")
    said = message.pop("arrays", None)
    if not isinstance(said, list) or len(said) > _MOST_ARRAYS or not all(map(_is_plain, said)):
        raise BrokenWire("no plain arrays")
    try:
        kinds = {name: (np.dtype(kind), tuple(shape)) for name, kind, shape in said}
    except TypeError:
        raise BrokenWire("no such type") from None
    if sum(dtype.itemsize * math.prod(shape) for dtype, shape in kinds.values()) > largest:
        raise BrokenWire("more than was asked for")
    return message, {name: _filled(stream, dtype, shape) for name, (dtype, shape) in kinds.items()}


def _is_plain(said: Any) -> bool:
    if not isinstance(said, list) or len(said) != 3:
        return False
    name, kind, shape = said
    return (
        isinstance(name, str)
        and isinstance(kind, str)
        and _PLAIN.fullmatch(kind) is not None
        and isinstance(shape, list)
        and len(shape) <= _MOST_AXES
        and all(type(length) is int and length >= 0 for length in shape)
    )


def _filled(stream: IO[bytes], dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    array = np.empty(shape, dtype)
    if array.size:
        rest = array.reshape(-1).view(np.uint8).data
        while len(rest):
            count = stream.readinto(rest)  # type: ignore[attr-defined]
            if not count:
                raise BrokenWire("cut off")
            rest = rest[count:]
    return array


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


#: Bytes of arrays of one answer, where the caller does not say more.
LARGEST_ANSWER = 64 << 20
_MAGIC = b"\x89HDF\r\n\x1a\n"
#: Bytes on their way, where the system allows it.
_PIPE = 1 << 20
#: Processes that are kept while nothing is asked of them.
_MOST_IDLE = 2
_TOLD = {name: value for name, value in vars(errors).items() if isinstance(value, type)}


def call(function: str, path: Path, *arguments: Any, source: str | None = None, largest: int = LARGEST_ANSWER) -> Any:
    """Return what a function of the reading process says of a file.

    Parameters
    ----------
    function : str
        One of `cgid.store._reader.FUNCTIONS`.
    path : Path
        The file; the function is given it absolute, and behind it its name in messages.
    *arguments
        What JSON can hold.
    source : str, optional
        The file's name in messages, else `path` as it stands here.
    largest : int
        Bytes that the arrays of the answer may take.

    Returns
    -------
    What JSON can hold, or a dict of arrays.

    Raises
    ------
    BadData
        HDF5 broke down over the file, or ran into the limits of time and memory.
    CgidError
        What the function raised.
    """
    name = str(path) if source is None else source
    with _reading() as child:
        found = child.ask(path, name, _request(function, path, name, arguments), largest)
    return _unpacked(*found)


def stream(
    function: str, path: Path, *arguments: Any, source: str | None = None, largest: int = LARGEST_ANSWER
) -> Generator[dict[str, NDArray[Any]], None, None]:
    """Yield what a generator of the reading process yields; parameters and errors as `call`.

    The next item is read while this one is worked on. When this generator is closed, so is the other.
    """
    name = str(path) if source is None else source
    message = _request(function, path, name, arguments)
    with _reading() as child:
        while True:
            found = child.ask(path, name, message, largest)
            if "end" in found[0]:
                return
            item: dict[str, NDArray[Any]] = _unpacked(*found)
            try:
                yield item
            except GeneratorExit:
                child.leave(path)
                raise
            message = {"next": True}


def format_said(path: Path) -> str | None:
    """Return what the root of an HDF5 file says it is, "" for nothing; None for what cannot be opened."""
    if not is_hdf5(path):
        return None
    try:
        said: str | None = call("format_said", path)
    except BadData:
        return None
    return said


def is_hdf5(path: Path) -> bool:
    """Return whether a regular file has HDF5's first bytes where they may lie: at 0, 512, 1024, 2048, ..."""
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


class _Child:
    """A reading process."""

    def __init__(self) -> None:
        # Where this process finds its libraries the other does, but never in the folder it happens to run in.
        paths = [str(Path(__file__).parents[2]), *(os.path.abspath(entry) for entry in sys.path if entry)]  # noqa: PTH100
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)), "OPENBLAS_NUM_THREADS": "1"}
        # HDF5 would load whatever library lies where a file's filter is looked for.
        environment["HDF5_PLUGIN_PRELOAD"] = "::"
        self.in_step, self._late = False, False
        self._left: Path | None = None
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "cgid.store._reader"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C is for this process
        )
        _alive.add(self)
        with suppress(ImportError, AttributeError, OSError):  # Linux alone has wide pipes
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

    @property
    def _input(self) -> Any:
        return self._process.stdin

    @property
    def _output(self) -> Any:
        return self._process.stdout

    @property
    def _errors(self) -> Any:
        return self._process.stderr

    def ask(
        self, path: Path, source: str, message: dict[str, Any] | None, largest: int
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Send a message, if there is one, and return the answer, which must come in time; raises `BadData` if not."""
        if self in _disowned:
            raise CgidError(
                f"{source}: must be read on by the process that began to, this one was forked from it meanwhile; begin "
                "anew here"
            )
        self.in_step = False
        patience = threading.Timer(patience_for(path), self._lose_patience)
        patience.daemon = True
        try:
            patience.start()
        except RuntimeError:
            # So Python says that a thread's stack found no room: it is memory that is short.
            raise MemoryError("no room for one more thread") from None
        try:
            if message is not None:
                self._tell(message)
            found = receive(self._output, largest)
        except (OSError, ValueError, BrokenWire) as error:
            raise BadData(
                f"{source}: the HDF5 library {self._end_told(error)} on this file; it is damaged or hostile: copy it "
                "again, or leave it out"
            ) from None
        finally:
            patience.cancel()
        self.in_step = True
        return found

    def leave(self, path: Path) -> None:
        """Have the process give up what it yields of a file; it answers when it has, which nobody waits for now."""
        with suppress(OSError, ValueError):  # it may have gone already
            self._tell({"next": False})
            self._left = path

    def is_ready(self) -> bool:
        """Return whether the process still runs, as soon as it has given up what it was to leave.

        What ends it until then is no fault of the file that it is asked for next.
        """
        if self._left is not None:
            left, self._left = self._left, None
            with suppress(BadData):
                self.ask(left, str(left), None, 0)
        return self.in_step and self._process.poll() is None

    def _tell(self, message: dict[str, Any]) -> None:
        self._input.write(json.dumps(message).encode() + b"\n")
        self._input.flush()

    def _lose_patience(self) -> None:
        self._late = True
        self._process.kill()

    def _end_told(self, error: Exception) -> str:
        """Return how the process ended."""
        self.end()
        code = self._process.returncode
        if self._late or code == -getattr(signal, "SIGPROF", 0):
            return "did not come to an end"
        if isinstance(error, BrokenWire) and code == -getattr(signal, "SIGKILL", 0):
            return "gave an answer that makes no sense"
        return "crashed"

    def end(self) -> None:
        """End the process, whatever it does."""
        _alive.discard(self)
        with suppress(OSError):
            self._input.close()
        # One that has crashed is given the time to say how.
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2 if not self.in_step else 0)
        self._process.kill()
        self._process.wait()
        for side in (self._output, self._errors):
            with suppress(OSError):
                side.close()

    def disown(self) -> None:
        """Forget a process that belongs to the one this was forked from.

        Only the descriptors are closed: a thread that is not here may hold the buffers, and what it left in them is not
        to be sent from here.
        """
        for side in (self._input, self._output, self._errors):
            with suppress(OSError):
                side.raw.close()
        self._process.returncode = 0
        self.in_step = False


_alive: set[_Child] = set()
_idle: list[_Child] = []
#: Kept, since a buffer that goes waits for whoever holds it.
_disowned: list[_Child] = []
#: A generator that is thrown away gives its reader back wherever this thread stands.
_lock = threading.RLock()


@contextmanager
def _reading() -> Iterator[_Child]:
    """Yield a process that nobody else asks meanwhile."""
    with _lock:
        child = _idle.pop() if _idle else None
    if child and not child.is_ready():
        child.end()
        child = None
    child = child or _Child()
    try:
        yield child
    finally:
        with _lock:
            kept = child.in_step and len(_idle) < _MOST_IDLE and child in _alive
            if kept:
                _idle.append(child)
        if not kept and child in _alive:
            child.end()


def _request(function: str, path: Path, source: str, arguments: tuple[Any, ...]) -> dict[str, Any]:
    return {"function": function, "arguments": [os.path.abspath(path), source, *arguments]}  # noqa: PTH100


def _unpacked(message: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Any:
    """Return the value or the arrays of an answer, or raise its error."""
    if "error" in message:
        kind, text = _TOLD.get(str(message["error"]), BadData), str(message.get("text"))
        raise (kind if issubclass(kind, CgidError) else BadData)(text)
    return message.get("value", arrays)


def _end_all() -> None:
    for child in list(_alive):
        child.end()


def _disown_all() -> None:
    """In a forked process: the parent's readers are not its own."""
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

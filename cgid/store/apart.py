"""HDF5 files are read in processes of their own, with limits of time and memory.

The HDF5 library trusts files: one changed bit can make it search for ever, take all memory or crash, and nothing within
a process can stop it. So this process never opens them. It asks another (`_reader`), which answers with plain numbers
and texts, and whose end is a message. A reading process is kept for the next question; reading two files side by side
takes two. It ends with this one.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cgid import errors
from cgid.errors import BadData, CgidError
from cgid.store import limits, wire

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
            wire.receive(self._output, 0)
        except wire.BrokenWire:
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
        patience = threading.Timer(limits.patience_for(path), self._lose_patience)
        patience.daemon = True
        try:
            patience.start()
        except RuntimeError:
            # So Python says that a thread's stack found no room: it is memory that is short.
            raise MemoryError("no room for one more thread") from None
        try:
            if message is not None:
                self._tell(message)
            found = wire.receive(self._output, largest)
        except (OSError, ValueError, wire.BrokenWire) as error:
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
        if isinstance(error, wire.BrokenWire) and code == -getattr(signal, "SIGKILL", 0):
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

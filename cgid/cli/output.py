"""The standard streams of a command, errors, progress and interruptions; all printing uses `say`."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import Any, TextIO

import click

from cgid._lib.terminal import printable
from cgid._lib.validation import finite
from cgid.errors import INTERRUPTIONS, CannotCreate, CgidError, InvalidValue, WriteFailed

#: Version of the lines of --json.
JSON_VERSION = 1
#: Up to this total a progress bar shows plain numbers, above it 1.2k, 3.4M.
_COUNTED_EXACTLY = 100_000
#: Files read in this process by a library that trusts them.
_TRUSTED_BY_LIBRARIES = (".h5", ".hdf5", ".mat")
#: Signals that asked to stop: Python loses KeyboardInterrupt in callbacks of weak references, of which h5py has many.
_noted: list[int] = []
#: The options of the running command, by the names of their parameters.
flags: dict[str, str] = {}
#: Progress bars on the terminal, the last of which is drawn.
_bars: list[Any] = []
#: The text that stands on the terminal until the next line.
_passing: list[str] = []
#: Who takes the lines of stdout instead, the last one.
_takers: list[Callable[[str], object]] = []


def open_missing() -> None:
    """Open the null device for closed standard streams, whose numbers the next opened files would get."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor: this one
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - until the process ends
    if sys.stdout is None:
        # Writing to it fails: an answer must not vanish. Descriptor 1 may be a file that a library has opened since.
        sys.stdout = open(os.open(os.devnull, os.O_RDONLY), "w", encoding="utf-8")  # noqa: PTH123, SIM115


def allow_closed_stdout() -> None:
    """Discard the standard output if it is closed: the command has another output."""
    if is_closed(sys.stdout):
        drop(sys.stdout)


def is_closed(stream: TextIO) -> bool:
    """Return whether nothing can be written to the descriptor of a stream, as to one that `open_missing` opened."""
    try:
        return os.write(stream.fileno(), b"") != 0
    except OSError as error:
        return error.errno == errno.EBADF


def drop(stream: TextIO | None) -> None:
    """Discard the buffer of a stream; otherwise Python would fail again when it closes the stream."""
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout or stderr, with control characters escaped; a full stderr is ignored."""
    if _passing and (err or sys.stdout.isatty()):
        sys.stderr.write("\r" + " " * len(_passing.pop()) + "\r")
    if _bars and (err or sys.stdout.isatty()):
        _bars[-1].clear()  # the next step draws it again, below this line
    try:
        if _takers and not err:
            _takers[-1](printable(text))
        else:
            click.echo(printable(text), err=err)
    except BrokenPipeError:
        raise
    except OSError:
        if not err:
            raise
        drop(sys.stderr)


@contextmanager
def lines_taken(take: Callable[[str], object]) -> Iterator[None]:
    """Give the lines of stdout to a function within this context."""
    _takers.append(take)
    try:
        yield
    finally:
        _takers.remove(take)


def show_compilation() -> None:
    """Show on a terminal how many kernels are compiled: the first use takes half a minute."""
    if sys.stderr is None or not sys.stderr.isatty():
        return
    import logging

    class Line(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            _passing[:] = [f"cgid: {record.getMessage()}"]
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.write(f"\r{_passing[0]}")
                sys.stderr.flush()

    told = logging.getLogger("cgid.kernels")
    told.handlers, told.propagate = [Line()], False
    told.setLevel(logging.INFO)


def warn(warning: object) -> None:
    """Print a warning on stderr."""
    say(f"cgid: warning: {warning}", err=True)


def warn_of_one_place(source: Any) -> None:
    """Warn that a scene has the modes of one place, as hammer taps give them; not of a dataset."""
    beam = getattr(source, "tail_beam", None)
    if beam is not None and beam.modes is not None and beam.shapes is None:
        warn(
            f"scene {source.name}: modes of one place: only impacts there are described; for impacts anywhere give "
            "length, width, thickness and edges of the beam, and the table as learned; or tap a grid of places, and "
            "name the shapes (cgid tap taps.wav --hammer 2 --taps places.csv --sensor X,Y -o modes.csv)"
        )


@dataclass(eq=False, repr=False)
class FileErrors(AbstractContextManager[None]):
    """Report the error of one file and continue with the next; `code` is the exit code of the first that failed."""

    # If `strict`, or with one output for all files an error of writing it, an error ends the work: it would lack rows.
    strict: bool = False
    one_output: bool = False
    code: int = 0

    def each(self, files: Iterable[str]) -> Iterator[str]:
        """Yield the files; among several, the name of one that may end or hang this process comes first on stderr."""
        files = list(files)
        for file in files:
            if len(files) > 1 and file.lower().endswith(_TRUSTED_BY_LIBRARIES):
                say(f"cgid: reading {file}", err=True)
            yield file

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        if not isinstance(error, CgidError) or self.strict:
            return False
        if self.one_output and isinstance(error, CannotCreate | WriteFailed):
            return False
        say_error(error)
        self.code = self.code or error.exit_code
        return True


def say_error(error: CgidError) -> None:
    """Print an error on stderr, with a line for each mistake; an argument of the library becomes its option."""
    for mistake in error.args:
        name, must, rule = str(mistake).partition(" must ")
        name = flags.get(name, name) if isinstance(error, InvalidValue) else name
        say(f"cgid: error: {name}{must}{rule}", err=True)


def print_json(content: dict[str, Any], version: int = JSON_VERSION) -> None:
    """Print one object as a line of JSON; values that are not finite become null."""
    # JSON escapes all other control characters, and all characters that are not ASCII.
    say(json.dumps({"version": version, **finite(content)}).replace("\x7f", "\\u007f"))


@contextmanager
def interruptions_noted() -> Iterator[None]:
    """Note interruptions within this context; no effect outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _noted.clear()
    # Python ends at once by SIGTERM and SIGHUP, and would not stop its workers. nohup has SIGHUP ignored.
    always = signal.SIGINT, signal.SIGTERM
    noted = [one for one in INTERRUPTIONS if one in always or signal.getsignal(one) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _note) for number in noted}
    hook = sys.unraisablehook
    sys.unraisablehook = lambda found: None if found.exc_type is KeyboardInterrupt else hook(found)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


def is_interrupted() -> bool:
    """Return whether the command that runs, or ran last, was interrupted."""
    return bool(_noted)


def exit_code_of_interruption() -> int:
    """Return 128 and the number of the signal that interrupted, as shells do."""
    return 128 + (_noted[0] if _noted else signal.SIGINT)


def stop_if_interrupted() -> None:
    """Raise KeyboardInterrupt if an interruption was noted and possibly lost."""
    if _noted:
        raise KeyboardInterrupt


def _note(number: int, _frame: FrameType | None) -> None:
    _noted.append(number)
    raise KeyboardInterrupt


@contextmanager
def progress_bar(
    total: int | None, what: str, task: str, *, every: float = math.inf
) -> Iterator[Callable[[int], object]]:
    """Yield a function that moves a progress bar; without a terminal it prints a line `every` so many seconds."""
    if sys.stderr is None or not sys.stderr.isatty():
        done, due = 0, time.monotonic() + every

        def count(number: int) -> None:
            nonlocal done, due
            stop_if_interrupted()
            done += number
            if time.monotonic() >= due:
                due = time.monotonic() + every
                say(f"cgid: {task}: {done} of {total} {what}", err=True)

        yield count
        return
    from tqdm import tqdm

    amount = "{n_fmt}" if total is None else "{n_fmt} of {total_fmt}"
    progress = ", {elapsed}" if total is None else " |{bar:20}| {elapsed}, {remaining} left"
    form = f"{{desc}}: {amount} {what}{progress}"
    many = total is None or total > _COUNTED_EXACTLY
    with tqdm(desc=task, total=total, bar_format=form, file=sys.stderr, unit_scale=many, leave=False) as bar:
        _bars.append(bar)

        def move(number: int) -> None:
            bar.update(number)
            stop_if_interrupted()

        try:
            yield move
        finally:
            _bars.remove(bar)


def accuracy_text(metrics: Mapping[str, Any]) -> str:
    """Return an accuracy with its interval."""
    low, high = metrics["accuracy_interval_95"]
    return f"{metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f})"

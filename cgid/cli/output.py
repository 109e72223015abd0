"""The standard streams and interruptions of a command.

Commands print only through `say`, so that no text of a file can control the terminal.

Python raises KeyboardInterrupt at an arbitrary place, and loses it where nothing can be raised, such as in callbacks of
weak references, of which h5py has many. So interruptions are also noted, and long work asks for them.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO

import click

from cgid.terminal import printable

_noted = threading.Event()


def open_missing() -> None:
    """Open the null device for every closed standard stream.

    Otherwise the next opened file, such as a dataset, becomes the standard output of every C library.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor: this one
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - until the process ends


def drop(stream: TextIO | None) -> None:
    """Discard the buffer of a stream; otherwise Python would fail again when it closes the stream."""
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout or stderr; escape characters that would control a terminal.

    A stderr that cannot be written, for example on a full disk, is ignored.
    """
    try:
        click.echo(printable(text), err=err)
    except BrokenPipeError:
        raise
    except OSError:
        if not err:
            raise
        drop(sys.stderr)


@contextmanager
def heard() -> Iterator[None]:
    """Note interruptions within this context; no effect outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _noted.clear()
    before, hook = signal.signal(signal.SIGINT, _note), sys.unraisablehook
    sys.unraisablehook = lambda found: None if found.exc_type is KeyboardInterrupt else hook(found)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook


def stop_if_asked() -> None:
    """Raise KeyboardInterrupt if an interruption was noted and possibly lost."""
    if _noted.is_set():
        raise KeyboardInterrupt


def _note(_number: int, _frame: FrameType | None) -> None:
    _noted.set()
    raise KeyboardInterrupt

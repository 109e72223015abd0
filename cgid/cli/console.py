"""The standard streams, where whoever called has closed them or they cannot be written.

Everything that a command says goes through here, so that no file's text can command the terminal.

An interruption (Ctrl-C) that is never lost.

Python raises KeyboardInterrupt wherever it stands, and swallows it where nothing can be raised: in the callbacks of
weak references, of which h5py has many. So the wish is noted as well, and long work asks for it.
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


def open_missing() -> None:
    """Put an empty device where a standard stream is closed.

    Else the next file that is opened, a dataset perhaps, becomes the standard output of every library in C.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest that is free: this one
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - until the process ends


def drop(stream: TextIO | None) -> None:
    """Send what still waits in a stream to nowhere: Python would complain again when it ends."""
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout, or on stderr; what a terminal would obey stands as its escape.

    What cannot be said on stderr, where the disk that it goes to is full, is no reason to fail otherwise.
    """
    try:
        click.echo(printable(text), err=err)
    except BrokenPipeError:
        raise
    except OSError:
        if not err:
            raise
        drop(sys.stderr)


_noted = threading.Event()


@contextmanager
def heard() -> Iterator[None]:
    """Note interruptions within this context; does nothing outside of the main thread."""
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
    """Raise KeyboardInterrupt if somebody has asked for it since, however long ago."""
    if _noted.is_set():
        raise KeyboardInterrupt


def _note(_number: int, _frame: FrameType | None) -> None:
    _noted.set()
    raise KeyboardInterrupt

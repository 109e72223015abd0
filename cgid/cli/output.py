"""Everything that a command prints goes through here, so that no text of a file can control the terminal.

The standard streams may be closed, or on a disk that is full.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TextIO

import click

from cgid.terminal import printable


def open_missing() -> None:
    """Open the null device where a standard stream is closed.

    Otherwise the next file that is opened, a dataset perhaps, becomes the standard output of every library in C.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest that is free: this one
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - until the process ends


def drop(stream: TextIO | None) -> None:
    """Discard what still waits in a stream: Python would report its error again at exit."""
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout, or on stderr, with control characters escaped.

    A line that cannot be written to stderr, where its disk is full, is no reason to fail.
    """
    try:
        click.echo(printable(text), err=err)
    except BrokenPipeError:
        raise
    except OSError:
        if not err:
            raise
        drop(sys.stderr)

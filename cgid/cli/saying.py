"""Everything that a command says goes through here, so that no file's text can command the terminal."""

from __future__ import annotations

import sys

import click

from cgid.cli.streams import drop
from cgid.terminal import printable


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

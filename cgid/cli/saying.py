"""Everything that a command says goes through here, so that no file's text can command the terminal."""

from __future__ import annotations

import click

from cgid.terminal import printable


def say(text: str, *, err: bool = False) -> None:
    """Print one line on stdout, or on stderr; what a terminal would obey stands as its escape."""
    click.echo(printable(text), err=err)

"""The command line: parse, call, print. Only here do the two wings of the package meet."""

from cgid.cli.main import cli, main

__all__ = ["cli", "main"]

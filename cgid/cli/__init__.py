"""The command line: parse, call, print. The only place where the wings of the house are joined."""

from cgid.cli.main import cli, main

__all__ = ["cli", "main"]

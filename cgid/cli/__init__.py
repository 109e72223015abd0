"""The command line: parse, call, print. Only here the two layers of the package meet."""

from cgid.cli.main import cli
from cgid.cli.main import run as main

__all__ = ["cli", "main"]

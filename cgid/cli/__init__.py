"""The command line: parse, call, print. Only here the two layers of the package meet."""

import os

# Before numpy is imported. Further threads of BLAS gain nothing on matrices as small as ours, take as much processor
# again, and on a busy machine wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cgid.cli.main import cli
from cgid.cli.main import run as main

__all__ = ["cli", "main"]

"""What cgid is compared with, beside the package: each study imports cgid and answers one question (README.md)."""

from __future__ import annotations

import sys
from collections.abc import Callable

from cgid.errors import CgidError


def run(study: Callable[[], object]) -> int:
    """Run a study and return its exit code; an error is one line on stderr."""
    try:
        study()
    except CgidError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0

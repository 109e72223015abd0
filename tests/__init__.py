"""The tests, and the marking of long parameter sets."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def few(values: Iterable[Any], n: int = 1) -> list[Any]:
    """Return parameters of which the first `n` always run and the others are long; a tuple is several arguments."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=pytest.mark.long if i >= n else ()) for i, row in enumerate(rows)]

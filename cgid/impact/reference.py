"""The kernels of the reference path: compiled, or for an impact or two the same functions interpreted.

Compiling them takes some ten seconds, once after installing; interpreted, an impact takes some tens of milliseconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from types import FunctionType
from typing import Any

import numpy as np

from cgid.impact import _taylor

#: Impacts and samples up to which nothing is compiled, until so many seconds have gone into interpreting.
_FEW_IMPACTS, _FEW_SAMPLES, _PATIENCE = 4, 4096, 2.0
_spent = 0.0


def kernel(name: str, n_impacts: int, n_samples: int = 0) -> Callable[..., None]:
    """Return a kernel of `_taylor` for so much work.

    Which one it is hangs on the whole batch and not on the rows that need it: a block of a dataset is the same
    wherever and whenever it is made.
    """
    if n_impacts > _FEW_IMPACTS or n_impacts * n_samples > _FEW_SAMPLES or _spent > _PATIENCE:
        compiled: Callable[..., None] = getattr(_taylor, name)
        return compiled
    return partial(_interpret, name)


def _interpret(name: str, *arguments: Any) -> None:
    global _spent
    start = time.perf_counter()
    with np.errstate(all="ignore"):
        _interpreted()[name](*arguments)
    _spent += time.perf_counter() - start


@cache
def _interpreted() -> dict[str, Callable[..., None]]:
    """Return the kernels as plain Python functions, which call each other as such."""
    names = dict(vars(_taylor))
    for name, function in vars(_taylor).items():
        if hasattr(function, "py_func"):
            names[name] = FunctionType(function.py_func.__code__, names)
    return names

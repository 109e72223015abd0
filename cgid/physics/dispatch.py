"""Which form of a kernel serves: compiled, or for an impact or two the same functions interpreted.

Compiling takes seconds, once after installing; interpreted, a pulse takes milliseconds to some tens of them. Both do
the same operations in the same order, so they give the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

#: Samples up to which nothing is compiled: these kernels are interpreted, and numpy evaluates the table.
FEW_SAMPLES = 4096
#: Impacts up to which kernels are interpreted, until so many seconds have gone into that.
_FEW_IMPACTS, _PATIENCE = 4, 2.0
_spent = 0.0


def kernel(module: ModuleType, name: str, n_impacts: int, n_samples: int = 0) -> Callable[..., None]:
    """Return the kernel of a module for so much work: that of the whole batch, not of the rows that need it."""
    if n_impacts > _FEW_IMPACTS or n_impacts * n_samples > FEW_SAMPLES or _spent > _PATIENCE:
        compiled: Callable[..., None] = getattr(module, name)
        return compiled
    return partial(_interpret, module, name)


def _interpret(module: ModuleType, name: str, *arguments: Any) -> None:
    global _spent
    start = time.perf_counter()
    with np.errstate(all="ignore"):
        _interpreted(module)[name](*arguments)
    _spent += time.perf_counter() - start


@cache
def _interpreted(module: ModuleType) -> dict[str, Callable[..., None]]:
    """Return the kernels of a module as plain Python functions, which call each other as such."""
    names = dict(vars(module))
    for name, function in vars(module).items():
        if hasattr(function, "py_func"):
            names[name] = FunctionType(function.py_func.__code__, names)
    return names

"""Former names of public objects: they still work for one version, with a warning that gives the new name."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from operator import attrgetter
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def warn_renamed(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that `old` is now called `new`; shown to users, as `FutureWarning` is by default."""
    warnings.warn(
        f"{old} is now called {new}; the old name goes with version 0.3", FutureWarning, stacklevel=stacklevel
    )


def renamed(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a module for old name -> new name, the new one with its module (`cgid.plots.png`)."""

    def attribute(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warn_renamed(f"{module}.{name}", names[name])
        home, _, new = names[name].rpartition(".")
        return getattr(import_module(home), new)

    return attribute


def renamed_attribute(old: str, new: str) -> Any:
    """Return a property for a former attribute of a class."""

    def read(self: Any) -> Any:
        warn_renamed(f"{type(self).__name__}.{old}", new)
        return attrgetter(new)(self)

    return property(read)


def renamed_arguments(**names: str) -> Callable[[F], F]:
    """Return a decorator of a function that also takes keyword arguments by former names (old=new)."""

    def decorate(function: F) -> F:
        @wraps(function)
        def called(*arguments: Any, **keywords: Any) -> Any:
            for old in [name for name in keywords if name in names]:
                warn_renamed(f"{function.__name__}({old}=...)", f"{names[old]}=")
                if names[old] in keywords:
                    raise TypeError(
                        f"{function.__name__}() got both {names[old]} and its former name {old}; leave {old} out"
                    )
                keywords[names[old]] = keywords.pop(old)
            return function(*arguments, **keywords)

        return called  # type: ignore[return-value]

    return decorate

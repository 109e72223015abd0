"""Public names of a package that are loaded on first use, so that importing it costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def picture_of(what: str, *arguments: Any) -> Any:
    """Return what a function of `cgid.plots.objects` draws: pictures lie above the objects whose methods draw them."""
    return getattr(import_module("cgid.plots.objects"), what)(*arguments)


def on_first_use(
    package: str, names: Mapping[str, Sequence[str]], modules: Sequence[str] = ()
) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package.

    `names` has the public names of its modules, `modules` those that are public themselves. `__all__` has the names, or
    the modules if there are none.
    """
    homes = {name: module for module, listed in names.items() for name in listed}
    public = sorted(homes) or list(modules)

    def load(name: str) -> object:
        if name in modules:
            return import_module(f"{package}.{name}")
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = vars(sys.modules[package])[name] = getattr(import_module(f"{package}.{homes[name]}"), name)
        return found

    return public, load, lambda: sorted({*public, *modules})

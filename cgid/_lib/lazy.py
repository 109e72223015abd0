"""Public names of a package that are loaded on first use, so that importing it costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def picture_of(what: str, *arguments: Any) -> Any:
    """Return what a function of `cgid.plots.objects` draws: pictures lie above the objects whose methods draw them."""
    return getattr(import_module("cgid.plots.objects"), what)(*arguments)


def on_first_use(
    package: str, names: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package; `names` has the public names of its modules."""
    homes = {name: module for module, listed in names.items() for name in listed}

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    def listed() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return load, listed

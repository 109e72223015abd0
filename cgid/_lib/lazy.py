"""Public names of a package that are loaded on first use, so that importing it costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module


def homes_of(package: str) -> dict[str, str]:
    """Return the public names of a package, each with the module that defines it, from its `__init__.pyi`.

    Type checkers and editors read the same lines, `from MODULE import NAME as NAME`. Public modules are from the
    package itself.
    """
    with open(f"{sys.modules[package].__file__}i", encoding="utf-8") as stub:  # noqa: PTH123 - pathlib loads slowly
        return {name: module for _, module, _, name, *_ in (line.split() for line in stub if line.startswith("from "))}


def on_first_use(package: str) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package, which has an `__init__.pyi` (`homes_of`).

    `__all__` has the names, or the modules if there are no others.
    """
    homes = homes_of(package)
    public = sorted(name for name, module in homes.items() if module != package) or list(homes)

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if homes[name] == package:
            return import_module(f"{package}.{name}")
        found = vars(sys.modules[package])[name] = getattr(import_module(homes[name]), name)
        return found

    return public, load, lambda: sorted({*public, *homes})

"""Public names of a package that are loaded on first use, so that importing it costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType


def homes_of(package: str) -> dict[str, str]:
    """Return the public names of a package, each with the module that defines it, from its `__init__.pyi`.

    Type checkers and editors read the same lines, `from MODULE import NAME as NAME`. Public modules are from the
    package itself.
    """
    with open(f"{sys.modules[package].__file__}i", encoding="utf-8") as stub:  # noqa: PTH123 - pathlib loads slowly
        return {name: module for _, module, _, name, *_ in (line.split() for line in stub if line.startswith("from "))}


def on_first_use(
    package: str, withdrawn: Mapping[str, str] = MappingProxyType({})
) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package, which has an `__init__.pyi` (`homes_of`).

    `__all__` has the names, or the modules if there are no others. `withdrawn` has earlier names, each with what to use
    instead.
    """
    homes = homes_of(package)
    public = sorted(name for name, module in homes.items() if module != package) or list(homes)

    def load(name: str) -> object:
        if name not in homes:
            instead = f": it is withdrawn; {withdrawn[name]}" if name in withdrawn else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{instead}")
        if homes[name] == package:
            return import_module(f"{package}.{name}")
        found = vars(sys.modules[package])[name] = getattr(import_module(homes[name]), name)
        return found

    return public, load, lambda: sorted({*public, *homes})

"""HDF5 datasets and tables. Only this package uses h5py; its names are loaded on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cgid.store.description import FORMAT, SCHEMA_VERSION
    from cgid.store.reading import Dataset
    from cgid.store.table import Table, read_table

__all__ = ["FORMAT", "SCHEMA_VERSION", "Dataset", "Table", "read_table"]

#: Where each public name lives.
_HOMES = dict.fromkeys(__all__, "table") | {
    "FORMAT": "description",
    "SCHEMA_VERSION": "description",
    "Dataset": "reading",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"cgid.store.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})

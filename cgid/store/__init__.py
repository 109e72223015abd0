"""HDF5 datasets and tables. Only this package uses h5py; its names are loaded on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cgid.deprecated import renamed

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
#: Former public name -> present one.
_MOVED = {"check_output": "cgid.store.run.check_output"} | {
    name: f"cgid.store.table.{name}"
    for name in ("Rows", "TableHeader", "check_table_output", "is_table", "table_writer")
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        return renamed(__name__, _MOVED)(name)
    return getattr(import_module(f"cgid.store.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})

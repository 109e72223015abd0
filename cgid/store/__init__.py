"""HDF5 datasets and tables. Only this package uses h5py; its names are loaded on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.store.dataset import export
    from cgid.store.description import FORMAT, SCHEMA_VERSION
    from cgid.store.reading import Dataset
    from cgid.store.table import Table, read_table
    from cgid.store.verification import Verified, remedy, verify

#: Module -> the public names that it defines.
_NAMES = {
    "dataset": ("export",),
    "description": ("FORMAT", "SCHEMA_VERSION"),
    "reading": ("Dataset",),
    "table": ("Table", "read_table"),
    "verification": ("Verified", "remedy", "verify"),
}

__all__ = ["FORMAT", "SCHEMA_VERSION", "Dataset", "Table", "Verified", "export", "read_table", "remedy", "verify"]

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)

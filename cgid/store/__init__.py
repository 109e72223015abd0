"""HDF5 datasets and tables. Only this package uses h5py; its names are loaded on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.store.dataset import export as export
    from cgid.store.description import FORMAT as FORMAT
    from cgid.store.description import SCHEMA_VERSION as SCHEMA_VERSION
    from cgid.store.reading import Dataset as Dataset
    from cgid.store.table import Table as Table
    from cgid.store.table import read_table as read_table
    from cgid.store.verification import Verified as Verified
    from cgid.store.verification import remedy as remedy
    from cgid.store.verification import verify as verify

#: Module -> the public names that it defines.
_NAMES = {
    "dataset": ("export",),
    "description": ("FORMAT", "SCHEMA_VERSION"),
    "reading": ("Dataset",),
    "table": ("Table", "read_table"),
    "verification": ("Verified", "remedy", "verify"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

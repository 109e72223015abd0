"""Features of impacts and windows: measurements on batches, and the table that names them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.measure.features.extraction import FEATURES, choose, extract

#: Module -> the public names that it defines.
_NAMES = {
    "extraction": ("FEATURES", "choose", "extract"),
}

__all__ = ["FEATURES", "choose", "extract"]

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)

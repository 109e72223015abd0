"""Features of impacts and windows: measurements on batches, and the table that names them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.measure.features.extraction import FEATURES as FEATURES
    from cgid.measure.features.extraction import choose as choose
    from cgid.measure.features.extraction import extract as extract
    from cgid.measure.features.own import own_feature as own_feature

#: Module -> the public names that it defines.
_NAMES = {
    "extraction": ("FEATURES", "choose", "extract"),
    "own": ("own_feature",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

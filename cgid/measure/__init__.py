"""Measurements on signals: frames, pulses, vibrations, windows, spectra, and the features derived from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.measure import features as features
    from cgid.measure import filters as filters
    from cgid.measure import modal as modal
else:  # a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, {}, modules=("features", "filters", "modal"))

"""Measurements on signals: frames, pulses, vibrations, windows, spectra, and the features derived from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

    from cgid.measure import features, filters, modal

#: The rooms and modules with public names, loaded on first use.
__all__ = ["features", "filters", "modal"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> ModuleType:
        from importlib import import_module

        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return import_module(f"{__name__}.{name}")

"""From a signal to a material: detect impacts, measure features, predict labels, and train models for this.

Prediction (`events`, `model`, `answers`) needs numpy alone, training (`training`, `classifier`) scikit-learn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

    from cgid.identification import answers, card, estimation, events, prediction_settings, rows, share, training

__all__ = [  # the modules with public names, loaded on first use
    "answers",
    "card",
    "estimation",
    "events",
    "prediction_settings",
    "rows",
    "share",
    "training",
]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> ModuleType:
        from importlib import import_module

        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return import_module(f"{__name__}.{name}")

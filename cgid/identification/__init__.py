"""From a signal to a material: detect impacts, measure features, predict labels, and train models for this.

All but `training`, which needs scikit-learn, is the predict path: numpy alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

    from cgid.identification import detection, model, prediction, training

#: The rooms and modules with public names, loaded on first use.
#: The rooms and modules with public names, loaded on first use.
__all__ = ["detection", "model", "prediction", "training"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> ModuleType:
        from importlib import import_module

        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return import_module(f"{__name__}.{name}")

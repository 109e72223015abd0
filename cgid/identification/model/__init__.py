"""The trained model: its classifier, prediction sets, guards, and file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.model.model import Model as Model

#: Module -> the public names that it defines.
_NAMES = {
    "model": ("Model",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

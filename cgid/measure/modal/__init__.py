"""The natural modes of a beam, and its response to a force, as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.measure.modal.modes import Modes as Modes
    from cgid.measure.modal.modes import read_modes as read_modes

#: Module -> the public names that it defines.
_NAMES = {
    "modes": ("Modes", "read_modes"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

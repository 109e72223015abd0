"""Models for machines without Python: C99 and ONNX."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.export.c99 import c_source as c_source

#: Module -> the public names that it defines.
_NAMES = {
    "c99": ("c_source",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

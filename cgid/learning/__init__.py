"""For your own learners: a transformer, scenes as endless training data; and models finished on streams."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.learning.transformer import ImpactFeatures as ImpactFeatures
    from cgid.learning.transformer import TrainingStream as TrainingStream
    from cgid.learning.transformer import stream as stream

#: Module -> the public names that it defines.
_NAMES = {
    "transformer": ("ImpactFeatures", "TrainingStream", "stream"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

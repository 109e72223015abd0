"""From labelled data to a model, its tests, and its card."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.training.card import write_card as write_card
    from cgid.identification.training.classifier import ImpactClassifier as ImpactClassifier
    from cgid.identification.training.rows import Rows as Rows
    from cgid.identification.training.rows import measure as measure
    from cgid.identification.training.training import Training as Training
    from cgid.identification.training.training import train_on_groups as train_on_groups
    from cgid.identification.training.training import train_on_specimens as train_on_specimens

#: Module -> the public names that it defines.
_NAMES = {
    "card": ("write_card",),
    "classifier": ("ImpactClassifier",),
    "rows": ("Rows", "measure"),
    "training": ("Training", "train_on_groups", "train_on_specimens"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

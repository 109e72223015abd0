"""Where impacts are: onsets, events and their frames, and windows of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.detection.detector import ImpactDetector as ImpactDetector
    from cgid.identification.detection.detector import find_impacts as find_impacts
    from cgid.identification.detection.events import Event as Event

#: Module -> the public names that it defines.
_NAMES = {
    "detector": ("ImpactDetector", "find_impacts"),
    "events": ("Event",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

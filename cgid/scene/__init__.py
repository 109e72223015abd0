"""Scene files, and the signals of many impacts that a sensor records."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.scene.file.schema import Scene, load_scene, parse_scene, varied
    from cgid.scene.file.sensor import Sensor
    from cgid.scene.output.changes import changed
    from cgid.scene.output.generation import generate
    from cgid.scene.output.recordings import generate_recordings
    from cgid.scene.synthesis.given_pulses import SolvedImpacts, synthesise_given
    from cgid.scene.synthesis.plan import Plan, plan
    from cgid.scene.synthesis.stream import record
    from cgid.scene.synthesis.synthesis import synthesise

#: Module -> the public names that it defines.
_NAMES = {
    "file.schema": ("Scene", "load_scene", "parse_scene", "varied"),
    "file.sensor": ("Sensor",),
    "output.changes": ("changed",),
    "output.generation": ("generate",),
    "output.recordings": ("generate_recordings",),
    "synthesis.given_pulses": ("SolvedImpacts", "synthesise_given"),
    "synthesis.plan": ("Plan", "plan"),
    "synthesis.stream": ("record",),
    "synthesis.synthesis": ("synthesise",),
}

__all__ = [
    "Plan",
    "Scene",
    "Sensor",
    "SolvedImpacts",
    "changed",
    "generate",
    "generate_recordings",
    "load_scene",
    "parse_scene",
    "plan",
    "record",
    "synthesise",
    "synthesise_given",
    "varied",
]

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)

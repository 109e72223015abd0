"""Scene files, and the signals of many impacts that a sensor records."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.scene.file.schema import Scene as Scene
    from cgid.scene.file.schema import load_scene as load_scene
    from cgid.scene.file.schema import parse_scene as parse_scene
    from cgid.scene.file.schema import varied as varied
    from cgid.scene.file.sensor import Sensor as Sensor
    from cgid.scene.output.changes import changed as changed
    from cgid.scene.output.generation import generate as generate
    from cgid.scene.output.recordings import generate_recordings as generate_recordings
    from cgid.scene.synthesis.given_pulses import SolvedImpacts as SolvedImpacts
    from cgid.scene.synthesis.given_pulses import synthesise_given as synthesise_given
    from cgid.scene.synthesis.plan import Plan as Plan
    from cgid.scene.synthesis.plan import plan as plan
    from cgid.scene.synthesis.stream import record as record
    from cgid.scene.synthesis.synthesis import synthesise as synthesise

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

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

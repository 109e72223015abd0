"""Many impacts and what senses them: a scene file, its populations, its signals."""

from cgid.scene.calibration import Blow, Calibration, calibrated
from cgid.scene.generation import generate
from cgid.scene.given_pulses import synthesise_given
from cgid.scene.scene import Scene, load_scene, parse_scene
from cgid.scene.sensor import Sensor
from cgid.scene.stream.generation import generate_recordings
from cgid.scene.stream.synthesis import record
from cgid.scene.synthesis import synthesise
from cgid.scene.variation import varied

__all__ = [
    "Blow",
    "Calibration",
    "Scene",
    "Sensor",
    "calibrated",
    "generate",
    "generate_recordings",
    "load_scene",
    "parse_scene",
    "record",
    "synthesise",
    "synthesise_given",
    "varied",
]

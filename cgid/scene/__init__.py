"""Scene files, and the signals of many impacts that a sensor records."""

from cgid.scene.calibration import Calibration, calibrated
from cgid.scene.generation import generate
from cgid.scene.given_pulses import synthesise_given
from cgid.scene.recordings import generate_recordings
from cgid.scene.schema import Scene, load_scene, parse_scene, varied
from cgid.scene.sensor import Sensor
from cgid.scene.stream import record
from cgid.scene.synthesis import synthesise

__all__ = [
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

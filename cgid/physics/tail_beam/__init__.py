"""The tail beam that is hit: its modes by a plate model or by a tap test, and what they carry to a sensor."""

from cgid.physics.tail_beam.beam import TailBeam
from cgid.physics.tail_beam.frequency_response import frequency_response
from cgid.physics.tail_beam.measured import MeasuredModes, read_measured_modes
from cgid.physics.tail_beam.modes import Modes
from cgid.physics.tail_beam.rigidities import Ribs

__all__ = ["MeasuredModes", "Modes", "Ribs", "TailBeam", "frequency_response", "read_measured_modes"]

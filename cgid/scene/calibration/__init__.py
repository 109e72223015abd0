"""On-site calibration: a tap test or a few drops of known mass set the gain or the modes of a scene."""

from cgid.scene.calibration.blow import Blow
from cgid.scene.calibration.on_site import Calibration, calibrated

__all__ = ["Blow", "Calibration", "calibrated"]

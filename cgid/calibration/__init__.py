"""Calibrate a beam and its sensor: modes from hammer taps or from unlabelled impacts, and the gain.

Uses both layers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.calibration.forces import ImpactForce as ImpactForce
    from cgid.calibration.forces import forces_in as forces_in
    from cgid.calibration.gain import Calibration as Calibration
    from cgid.calibration.gain import calibrated as calibrated
    from cgid.calibration.modes import SiteCalibration as SiteCalibration
    from cgid.calibration.modes import calibrate as calibrate
    from cgid.calibration.modes import usable_impacts as usable_impacts
    from cgid.calibration.roving import RovingTest as RovingTest
    from cgid.calibration.roving import roving_test as roving_test
    from cgid.calibration.taps import Flaw as Flaw
    from cgid.calibration.taps import Tap as Tap
    from cgid.calibration.taps import TapTest as TapTest
    from cgid.calibration.taps import tap_test as tap_test

#: Module -> the public names that it defines.
_NAMES = {
    "forces": ("ImpactForce", "forces_in"),
    "gain": ("Calibration", "calibrated"),
    "modes": ("SiteCalibration", "calibrate", "usable_impacts"),
    "roving": ("RovingTest", "roving_test"),
    "taps": ("Flaw", "Tap", "TapTest", "tap_test"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

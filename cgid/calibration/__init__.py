"""Calibrate a beam and its sensor: modes from hammer taps or from unlabelled impacts, and the gain.

Uses both layers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.calibration.gain import Calibration, calibrated
    from cgid.calibration.modes import SiteCalibration, calibrate, usable_impacts
    from cgid.calibration.taps import Flaw, Tap, TapTest, tap_test

#: Module -> the public names that it defines.
_NAMES = {
    "gain": ("Calibration", "calibrated"),
    "modes": ("SiteCalibration", "calibrate", "usable_impacts"),
    "taps": ("Flaw", "Tap", "TapTest", "tap_test"),
}

__all__ = [
    "Calibration",
    "Flaw",
    "SiteCalibration",
    "Tap",
    "TapTest",
    "calibrate",
    "calibrated",
    "tap_test",
    "usable_impacts",
]

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)

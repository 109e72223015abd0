"""Calibrate a beam: its modes from hammer taps or from unlabelled impacts. Uses both layers."""

from cgid.site.calibration import SiteCalibration, calibrate, usable_impacts
from cgid.site.tapping import Flaw, Tap, TapTest, tap_test

__all__ = ["Flaw", "SiteCalibration", "Tap", "TapTest", "calibrate", "tap_test", "usable_impacts"]

"""Calibrate a beam: its modes from hammer taps or from unlabelled impacts. Uses both layers."""

from cgid.deprecated import renamed
from cgid.site.calibration import SiteCalibration, calibrate, usable_impacts
from cgid.site.tapping import Tap, TapTest, tap_test

__all__ = ["SiteCalibration", "Tap", "TapTest", "calibrate", "tap_test", "usable_impacts"]

__getattr__ = renamed(__name__, {"usable_blows": "cgid.site.usable_impacts"})

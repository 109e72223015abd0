"""A site: what recordings teach of one's own beam. Joins both wings, as the ceiling does."""

from cgid.site.calibration import SiteCalibration, calibrate, usable_blows
from cgid.site.tapping import Tap, TapTest, tap_test

__all__ = ["SiteCalibration", "Tap", "TapTest", "calibrate", "tap_test", "usable_blows"]

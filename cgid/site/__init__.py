"""A site: what recordings teach of one's own beam. Joins both wings, as the ceiling does."""

from cgid.site.calibration import SiteCalibration, calibrate, usable_blows

__all__ = ["SiteCalibration", "calibrate", "usable_blows"]

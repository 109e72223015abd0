"""Calibrate a beam and its sensor: modes from hammer taps or from unlabelled impacts, and the gain.

Uses both layers.
"""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)

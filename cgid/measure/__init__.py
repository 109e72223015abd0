"""Measurements on signals: frames, pulses, vibrations, windows, spectra, and the features derived from them."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)

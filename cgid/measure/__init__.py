"""Measurements on signals: frames, pulses, vibrations, windows, spectra, and the features derived from them."""

__all__ = ["features", "filters", "modes"]  # the modules with public names

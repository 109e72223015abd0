"""Measurements on signals: frames, pulses, vibrations, windows, spectra, and the features derived from them."""

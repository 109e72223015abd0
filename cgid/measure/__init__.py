"""What is measured on a signal: frames, pulses, vibrations, windows, spectra, and the features made of them."""

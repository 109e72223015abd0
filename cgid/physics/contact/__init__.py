"""The contact of two bodies: materials, laws, pulses and their kernels."""

"""Bayes limits that need more than an integral in white noise: `python -m studies.ceilings SCENE`."""

"""Impacts in long recordings, found block by block: the detector, what is an onset, and the frames around them."""

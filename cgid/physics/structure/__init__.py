"""What is struck: plates, beams, their modes, and their response."""

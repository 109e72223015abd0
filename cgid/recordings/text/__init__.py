"""Text files: CSV, TXT and their many ways of dividing rows, writing numbers and telling time."""

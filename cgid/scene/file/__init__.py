"""The scene file: its sections, and the checks of each."""

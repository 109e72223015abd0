"""Answers for recordings as they come: impacts, windows, the gangue share, and when to shut the window."""

"""Tells coal from gangue by how a falling rock hits steel."""

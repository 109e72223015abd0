"""Datasets and recordings of a scene on disk."""

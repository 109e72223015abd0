"""Estimate mass, radius and speed of an impacting rock, with intervals, from its pulse and a scene."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)

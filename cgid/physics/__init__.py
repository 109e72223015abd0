"""Physics of an impact: pulse, peaks and rebound, from materials and geometry."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)

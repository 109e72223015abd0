"""Location and contact force of an impact, from the motion of a beam."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)

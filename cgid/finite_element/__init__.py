"""An impact by finite elements: independent of every theory of contact, to judge them by."""

from cgid.finite_element.impact import FiniteElementImpact, History
from cgid.finite_element.mesh import ElasticPlate, PenaltyContact

__all__ = ["ElasticPlate", "FiniteElementImpact", "History", "PenaltyContact"]

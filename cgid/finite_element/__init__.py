"""An impact by finite elements: an independent reference for the theories of contact."""

from cgid.finite_element.impact import FiniteElementImpact, History
from cgid.finite_element.mesh import ElasticPlate, PenaltyContact

__all__ = ["ElasticPlate", "FiniteElementImpact", "History", "PenaltyContact"]

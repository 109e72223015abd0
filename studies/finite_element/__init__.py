"""An impact by finite elements: an independent reference for the theories of contact."""

from studies.finite_element.impact import FiniteElementImpact, History
from studies.finite_element.mesh import ElasticPlate, PenaltyContact

__all__ = ["ElasticPlate", "FiniteElementImpact", "History", "PenaltyContact"]

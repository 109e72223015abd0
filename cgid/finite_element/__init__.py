"""An impact by finite elements: independent of every theory of contact, to judge them by."""

from cgid.finite_element.bodies import ElasticPlate, PenaltyContact
from cgid.finite_element.history import History
from cgid.finite_element.impact import FiniteElementImpact

__all__ = ["ElasticPlate", "FiniteElementImpact", "History", "PenaltyContact"]

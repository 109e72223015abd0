"""Estimate mass, radius and speed of an impacting rock, with intervals, from its pulse and a scene."""

from cgid.impactor.columns import ImpactorColumns, detection_of
from cgid.impactor.masses import Detection, SizeDistribution, size_distribution
from cgid.impactor.measured import MeasuredPulses
from cgid.impactor.population import population_of
from cgid.impactor.posterior import ImpactorEstimates, ImpactorPopulation
from cgid.impactor.recognition import estimate_impactors

__all__ = [
    "Detection",
    "ImpactorColumns",
    "ImpactorEstimates",
    "ImpactorPopulation",
    "MeasuredPulses",
    "SizeDistribution",
    "detection_of",
    "estimate_impactors",
    "population_of",
    "size_distribution",
]

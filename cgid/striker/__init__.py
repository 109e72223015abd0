"""What struck: mass, radius and speed with intervals. Joins both wings, as the ceiling does."""

from cgid.striker.columns import StrikerColumns, detection_of
from cgid.striker.masses import Detection, SizeDistribution, size_distribution
from cgid.striker.measured import MeasuredPulses
from cgid.striker.population import population_of
from cgid.striker.posterior import StrikerPopulation, Strikers
from cgid.striker.recognition import strikers

__all__ = [
    "Detection",
    "MeasuredPulses",
    "SizeDistribution",
    "StrikerColumns",
    "StrikerPopulation",
    "Strikers",
    "detection_of",
    "population_of",
    "size_distribution",
    "strikers",
]

"""What struck: mass, radius and speed with intervals. Joins both wings, as the ceiling does."""

from cgid.striker.measured import MeasuredPulses
from cgid.striker.population import population_of
from cgid.striker.posterior import StrikerPopulation, Strikers
from cgid.striker.recognition import strikers

__all__ = ["MeasuredPulses", "StrikerPopulation", "Strikers", "population_of", "strikers"]

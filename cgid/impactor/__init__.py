"""Estimate mass, radius and speed of an impacting rock, with intervals, from its pulse and a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.impactor.columns import ImpactorColumns as ImpactorColumns
    from cgid.impactor.columns import detection_of as detection_of
    from cgid.impactor.masses import Detection as Detection
    from cgid.impactor.masses import SizeDistribution as SizeDistribution
    from cgid.impactor.masses import size_distribution as size_distribution
    from cgid.impactor.measured import MeasuredPulses as MeasuredPulses
    from cgid.impactor.population import population_of as population_of
    from cgid.impactor.posterior import ImpactorEstimates as ImpactorEstimates
    from cgid.impactor.posterior import ImpactorPopulation as ImpactorPopulation
    from cgid.impactor.recognition import estimate_impactors as estimate_impactors

#: Module -> the public names that it defines.
_NAMES = {
    "columns": ("ImpactorColumns", "detection_of"),
    "masses": ("Detection", "SizeDistribution", "size_distribution"),
    "measured": ("MeasuredPulses",),
    "population": ("population_of",),
    "posterior": ("ImpactorEstimates", "ImpactorPopulation"),
    "recognition": ("estimate_impactors",),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

"""The former name of `cgid.impactor`."""

from cgid.deprecated import renamed

_NAMES = {
    "StrikerColumns": "ImpactorColumns",
    "StrikerPopulation": "ImpactorPopulation",
    "Strikers": "ImpactorEstimates",
    "strikers": "estimate_impactors",
    **{
        name: name
        for name in (
            "Detection",
            "MeasuredPulses",
            "SizeDistribution",
            "detection_of",
            "population_of",
            "size_distribution",
        )
    },
}

__getattr__ = renamed(__name__, {old: f"cgid.impactor.{new}" for old, new in _NAMES.items()})

"""Identify coal and gangue by the impact of a falling rock on steel.

Public names are loaded on first use: `import cgid` alone imports neither numpy nor numba, scikit-learn, pandas or
matplotlib.
"""

from __future__ import annotations

__version__ = "0.2.0.dev0"

#: Public name -> module that defines it.
_HOMES = {
    "Batch": "cgid.signals",
    "Dataset": "cgid.store",
    "Elastic": "cgid.physics",
    "HalfSpace": "cgid.physics",
    "HuntCrossley": "cgid.physics",
    "Impact": "cgid.physics",
    "ImpactClassifier": "cgid.identification.classifier",
    "ImpactFeatures": "cgid.learn",
    "ImpactDetector": "cgid.identification.detection",
    "Material": "cgid.physics.materials",
    "Model": "cgid.identification.model",
    "RIGID": "cgid.physics",
    "Scene": "cgid.scene",
    "Signal": "cgid.signals",
    "Sphere": "cgid.physics",
    "ThinPlate": "cgid.physics",
    "Viscoelastic": "cgid.physics",
    "estimate_impactors": "cgid.impactor",
    "extract": "cgid.measure.features",
    "fft_filter": "cgid.measure.filters",
    "find_impacts": "cgid.identification.detection",
    "identify_recording": "cgid.identification.stream",
    "load_model": "cgid.identification.prediction",
    "load_scene": "cgid.scene",
    "open_recording": "cgid.recordings",
    "predict": "cgid.identification.prediction",
    "read_recording": "cgid.recordings",
    "stream": "cgid.learn",
    "synthesise": "cgid.scene",
    "train": "cgid.identification.training",
}

__all__ = sorted([*_HOMES, "__version__"])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    from importlib import import_module

    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__

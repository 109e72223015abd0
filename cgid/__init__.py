"""Identify coal and gangue by the impact of a falling rock on steel.

Public names and modules are loaded on first use: `import cgid` alone imports neither numpy nor numba, scikit-learn,
pandas or matplotlib.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cgid import calibration as calibration
    from cgid import errors as errors
    from cgid import export as export
    from cgid import identification as identification
    from cgid import impactor as impactor
    from cgid import learning as learning
    from cgid import measure as measure
    from cgid import physics as physics
    from cgid import plots as plots
    from cgid import recordings as recordings
    from cgid import scene as scene
    from cgid import store as store
    from cgid.identification.detection.detector import ImpactDetector as ImpactDetector
    from cgid.identification.detection.detector import find_impacts as find_impacts
    from cgid.identification.model.model import Model as Model
    from cgid.identification.prediction.pipeline import identify_recording as identify_recording
    from cgid.identification.prediction.prediction import load_model as load_model
    from cgid.identification.prediction.prediction import predict as predict
    from cgid.identification.training.classifier import ImpactClassifier as ImpactClassifier
    from cgid.identification.training.training import train_on_groups as train_on_groups
    from cgid.identification.training.training import train_on_specimens as train_on_specimens
    from cgid.impactor import estimate_impactors as estimate_impactors
    from cgid.learning.transformer import ImpactFeatures as ImpactFeatures
    from cgid.learning.transformer import stream as stream
    from cgid.measure.features.extraction import extract as extract
    from cgid.measure.filters import fft_filter as fft_filter
    from cgid.physics.contact.bodies import RIGID as RIGID
    from cgid.physics.contact.bodies import HalfSpace as HalfSpace
    from cgid.physics.contact.bodies import Sphere as Sphere
    from cgid.physics.contact.bodies import ThinPlate as ThinPlate
    from cgid.physics.contact.impact import Impact as Impact
    from cgid.physics.contact.laws import Elastic as Elastic
    from cgid.physics.contact.laws import HuntCrossley as HuntCrossley
    from cgid.physics.contact.laws import Viscoelastic as Viscoelastic
    from cgid.physics.contact.materials import Material as Material
    from cgid.recordings import open_recording as open_recording
    from cgid.recordings import read_recording as read_recording
    from cgid.scene.file.schema import Scene as Scene
    from cgid.scene.file.schema import load_scene as load_scene
    from cgid.scene.synthesis.synthesis import synthesise as synthesise
    from cgid.signals import Batch as Batch
    from cgid.signals import Signal as Signal
    from cgid.store.reading import Dataset as Dataset

__version__ = "0.2.0"

#: Public name -> module that defines it.
_HOMES = {
    "Batch": "cgid.signals",
    "Dataset": "cgid.store.reading",
    "Elastic": "cgid.physics.contact.laws",
    "HalfSpace": "cgid.physics.contact.bodies",
    "HuntCrossley": "cgid.physics.contact.laws",
    "Impact": "cgid.physics.contact.impact",
    "ImpactClassifier": "cgid.identification.training.classifier",
    "ImpactFeatures": "cgid.learning.transformer",
    "ImpactDetector": "cgid.identification.detection.detector",
    "Material": "cgid.physics.contact.materials",
    "Model": "cgid.identification.model.model",
    "RIGID": "cgid.physics.contact.bodies",
    "Scene": "cgid.scene.file.schema",
    "Signal": "cgid.signals",
    "Sphere": "cgid.physics.contact.bodies",
    "ThinPlate": "cgid.physics.contact.bodies",
    "Viscoelastic": "cgid.physics.contact.laws",
    "estimate_impactors": "cgid.impactor",
    "extract": "cgid.measure.features.extraction",
    "fft_filter": "cgid.measure.filters",
    "find_impacts": "cgid.identification.detection.detector",
    "identify_recording": "cgid.identification.prediction.pipeline",
    "load_model": "cgid.identification.prediction.prediction",
    "load_scene": "cgid.scene.file.schema",
    "open_recording": "cgid.recordings",
    "predict": "cgid.identification.prediction.prediction",
    "read_recording": "cgid.recordings",
    "stream": "cgid.learning.transformer",
    "synthesise": "cgid.scene.synthesis.synthesis",
    "train_on_groups": "cgid.identification.training.training",
    "train_on_specimens": "cgid.identification.training.training",
}

#: Public modules.
_MODULES = (
    *("calibration", "errors", "export", "identification", "impactor", "learning"),
    *("measure", "physics", "plots", "recordings", "scene", "store"),
)

__all__ = sorted([*_HOMES, "__version__"])  # pyright: ignore[reportUnsupportedDunderAll]


if not TYPE_CHECKING:  # else a name that does not exist would have a type

    def __getattr__(name: str) -> object:
        from importlib import import_module

        if name in _MODULES:
            return import_module(f"cgid.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, *_MODULES]

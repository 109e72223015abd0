"""Identify coal and gangue by the impact of a falling rock on steel.

Public names and modules are loaded on first use: `import cgid` alone imports neither numpy nor numba, scikit-learn,
pandas or matplotlib.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

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
    from cgid.identification.training.impact_table import impact_table as impact_table
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
    from cgid.shipped import open_results as open_results
    from cgid.signals import Batch as Batch
    from cgid.signals import Signal as Signal
    from cgid.store.reading import Dataset as Dataset

__version__ = "0.2.0"

#: Module -> the public names that it defines.
_NAMES = {
    "identification.detection.detector": ("ImpactDetector", "find_impacts"),
    "identification.model.model": ("Model",),
    "identification.prediction.pipeline": ("identify_recording",),
    "identification.prediction.prediction": ("load_model", "predict"),
    "identification.training.classifier": ("ImpactClassifier",),
    "identification.training.impact_table": ("impact_table",),
    "identification.training.training": ("train_on_groups", "train_on_specimens"),
    "impactor": ("estimate_impactors",),
    "learning.transformer": ("ImpactFeatures", "stream"),
    "measure.features.extraction": ("extract",),
    "measure.filters": ("fft_filter",),
    "physics.contact.bodies": ("HalfSpace", "RIGID", "Sphere", "ThinPlate"),
    "physics.contact.impact": ("Impact",),
    "physics.contact.laws": ("Elastic", "HuntCrossley", "Viscoelastic"),
    "physics.contact.materials": ("Material",),
    "recordings": ("open_recording", "read_recording"),
    "scene.file.schema": ("Scene", "load_scene"),
    "scene.synthesis.synthesis": ("synthesise",),
    "shipped": ("open_results",),
    "signals": ("Batch", "Signal"),
    "store.reading": ("Dataset",),
}

#: Public modules.
_MODULES = (
    *("calibration", "errors", "export", "identification", "impactor", "learning"),
    *("measure", "physics", "plots", "recordings", "scene", "store"),
)

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES, _MODULES)
    __all__ += ["__version__"]

"""What makes a model file sound: nothing of a stranger's file is believed before it is checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from cgid import validation
from cgid.errors import BadData
from cgid.identification.families import BY_NAME
from cgid.identification.known import KNOWN
from cgid.identification.reference import equalisations_of
from cgid.identification.windows import require_times
from cgid.measure.bands import MEL_BANDS
from cgid.measure.features import require_known
from cgid.units import quantity_of

if TYPE_CHECKING:
    from cgid.identification.model import Model

#: More channels than this no model looks at.
MOST_CHANNELS = 64
#: Arrays of every family -> the attribute of the standardiser, and the number of axes.
SHARED = {
    "standardiser.logarithmic": ("logarithmic", 1),
    "standardiser.floor": ("floor", 1),
    "standardiser.mean": ("mean", 1),
    "standardiser.scale": ("scale", 1),
}
#: More labels, or more references of sensors, than this no model tells apart.
MOST_LABELS, _MOST_SENSORS = 1000, 1000
#: No label and no name of a sensor has more letters.
_LONGEST_WORD = 100
#: What no standardised feature, and no weight of one, is larger than: products of three of them are still numbers.
_LARGEST_NUMBER = 1e100


def check_names(model: Model) -> None:
    """Raise unless family, labels, features, guards and what is known are words we know, each once."""
    validation.choice("family", model.family, tuple(BY_NAME))
    for name, values, least in (
        ("labels", model.labels, 2),
        ("features", model.features, 1),
        ("features and guards", model.measured, 1),
        ("known", model.known, 0),
        ("sensors", model.sensors, 0),
    ):
        if len(values) < least or not all(map(_is_word, values)) or len(set(values)) != len(values):
            raise BadData(
                f"{name} must be at least {least} different words of 1 to {_LONGEST_WORD} letters that can be printed"
            )
    for label in model.labels:
        validation.label("labels", label)
    for name, values, most in (("labels", model.labels, MOST_LABELS), ("sensors", model.sensors, _MOST_SENSORS)):
        if len(values) > most:
            raise BadData(f"{name} must be at most {most}, got {len(values)}")
    for feature in model.measured:
        require_known(feature)
    for name in model.known:
        validation.choice("known", name, dict(KNOWN))
    quantity_of(model.unit)


def check_numbers(model: Model) -> None:
    """Raise unless the numbers and arrays that all families share can be used without harm."""
    lowest_highest = validation.positive("sampling_rates", model.sampling_rates, "Hz")
    if lowest_highest.shape != (2,) or lowest_highest[0] > lowest_highest[1]:
        raise BadData("sampling_rates must be the lowest and the highest")
    validation.positive("temperature", model.temperature)
    validation.positive("neighbourhood_limit", model.neighbourhood_limit)
    if validation.positive("guard_limits", model.guard_limits).shape != (len(model.guards),):
        raise BadData("guard_limits must be one number for each guard")
    _check_windows(model)
    n_features, n_classes = len(model.inputs), len(model.labels)
    shapes = {name: (n_features,) * axes for name, (_, axes) in SHARED.items()}
    shapes |= {
        "neighbourhood.centres": (n_classes, n_features),
        "neighbourhood.whitening": (n_classes, n_features, n_features),
    }
    common = (1, n_features, n_features)  # one covariance for all classes
    for name, shape in shapes.items():
        found = model.arrays[name].shape if name in model.arrays else None
        if found != shape and not (name == "neighbourhood.whitening" and found == common):
            raise BadData(f"array {name} must have shape {shape}")
    if ("conformal.scores" in model.arrays) != ("conformal.labels" in model.arrays):
        raise BadData("arrays conformal.scores and conformal.labels must both be there, or none")
    _check_arrays(model)
    if model.sensors:
        equalisations_of(model.references)  # checks their gains


def check_training(model: Model) -> None:
    """Raise unless what answers and reports take from the record of the training is of its kind."""
    training, n_labels = model.training, len(model.labels)
    metrics, recorded = training.get("metrics", {}), training.get("recorded", {})
    if not isinstance(metrics, Mapping) or not isinstance(recorded, Mapping):
        raise BadData("metrics and recorded must be objects in the header, where they are told")
    shapes: dict[str, tuple[int, ...]] = {
        "accuracy": (),
        "accuracy_interval_95": (2,),
        "confusion": (n_labels, n_labels),
    }
    for name, shape in shapes.items():
        if name in metrics:
            numbers = validation.not_negative(name, metrics[name])
            if numbers.shape != shape or numbers.max() > _LARGEST_NUMBER:
                raise BadData(f"{name} must be numbers of shape {shape} up to {_LARGEST_NUMBER:g}")
    if "confusion" in metrics and np.sum(metrics["confusion"]) < 1:
        raise BadData("confusion must count at least one impact")
    for weights in (training.get("class_weights"), recorded.get("class_weights")):
        if isinstance(weights, Mapping):
            numbers = validation.positive("class_weights", list(weights.values()))
            # Products with counts of impacts neither vanish nor overflow.
            if numbers.ndim != 1 or ((numbers > _LARGEST_NUMBER) | (numbers < 1 / _LARGEST_NUMBER)).any():
                raise BadData(
                    f"class_weights must be one number a label, {1 / _LARGEST_NUMBER:g} to {_LARGEST_NUMBER:g}"
                )
        elif weights not in (None, "balanced"):
            raise BadData("class_weights must be 'balanced' or a number for each label")


def _is_word(value: object) -> bool:
    """Return whether a value is a word that a terminal can be shown; escapes and signs that turn a line are none."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_WORD and value.isprintable()


def _check_arrays(model: Model) -> None:
    """Raise unless all arrays are those of a model of this family, and hold numbers that can be reckoned with."""
    own = {f"family.{name}" for name in BY_NAME[model.family].AXES}
    beside = {"conformal.scores", "conformal.labels", "reference.spectra", "neighbourhood.centres"}
    known = own | beside | SHARED.keys() | {"neighbourhood.whitening"}
    for name, array in model.arrays.items():
        if name not in known:
            raise BadData(f"array {name!r} must be left out, a model of family {model.family} has none such")
        kinds = "b" if name == "standardiser.logarithmic" else "fi"
        plain = array.dtype.kind in kinds and array.size > 0
        # Without the absolute values: they would be another copy of it. False for nan.
        if not plain or not (array.min() >= -_LARGEST_NUMBER and array.max() <= _LARGEST_NUMBER):
            raise BadData(f"array {name} must hold finite numbers, got {array.dtype}")
    if not (model.arrays["standardiser.scale"] > 0).all() or not (model.arrays["standardiser.floor"] > 0).all():
        raise BadData("arrays standardiser.scale and standardiser.floor must be above 0")


def _check_windows(model: Model) -> None:
    """Raise unless windows, channels and references of sensors go together."""
    if isinstance(model.n_channels, bool) or not 1 <= model.n_channels <= MOST_CHANNELS:
        raise BadData(f"n_channels must lie between 1 and {MOST_CHANNELS}, got {model.n_channels}")
    if model.n_channels > 1 and (model.guards or model.known):
        raise BadData("guards and what is known must be left out where a model looks at several channels")
    if model.kind != "window":
        if model.window_time or model.hop_time:
            raise BadData(f"window_time and hop_time must be 0 for features of a {model.kind}")
    else:
        require_times(model.window_time, model.hop_time)
    spectra = model.arrays.get("reference.spectra")
    if (spectra is not None) != bool(model.sensors):
        raise BadData("array reference.spectra must be there where sensors are named, and only there")
    shape = len(model.sensors), model.n_channels, len(MEL_BANDS)
    if spectra is not None and spectra.shape != shape:
        raise BadData(f"array reference.spectra must have shape {shape}, got {spectra.shape}")

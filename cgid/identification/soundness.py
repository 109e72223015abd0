"""What makes a model file sound: nothing of a stranger's file is believed before it is checked."""

from __future__ import annotations

import io
import json
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.bands import MEL_BANDS
from cgid.errors import BadData
from cgid.features import require_known
from cgid.identification.families import BY_NAME
from cgid.identification.known import KNOWN
from cgid.identification.windows import require_times
from cgid.signals import quantity_of

if TYPE_CHECKING:
    from cgid.identification.model import Model

FORMAT = "cgid-model"
#: 2: what must be known, guards, the calibration of prediction sets, networks.
#: 3: windows, several channels, reference spectra of sensors, linear discriminants.
SCHEMA_VERSION = 3
#: What an older header does not say, by its version.
_UNSAID: dict[int, dict[str, Any]] = {
    2: {"window_time": 0.0, "hop_time": 0.0, "n_channels": 1, "sensors": []},
    3: {},
}
#: More channels than this no model looks at.
MOST_CHANNELS = 64
#: Arrays of every family -> the attribute of the standardiser, and the number of axes.
SHARED = {
    "standardiser.logarithmic": ("logarithmic", 1),
    "standardiser.floor": ("floor", 1),
    "standardiser.mean": ("mean", 1),
    "standardiser.scale": ("scale", 1),
}
#: What the header must say beside the format, and as what.
_KINDS: dict[str, type | tuple[type, ...]] = {
    "family": str,
    "labels": list,
    "features": list,
    "known": list,
    "guards": list,
    "guard_limits": list,
    "unit": str,
    "sampling_rates": list,
    "temperature": (int, float),
    "neighbourhood_limit": (int, float),
    "training": dict,
    "window_time": (int, float),
    "hop_time": (int, float),
    "n_channels": int,
    "sensors": list,
}


def read_header(arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Take the header out of the arrays of a model file and return what it says, lists as tuples."""
    try:
        header = json.loads(arrays.pop("header").tobytes())
    except (KeyError, ValueError, RecursionError):
        raise BadData("it must have a header of JSON") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise BadData(f"format must be {FORMAT!r}")
    version = header.get("schema_version")
    if type(version) is not int or version not in _UNSAID:
        raise BadData(f"schema_version must be {' or '.join(map(str, _UNSAID))}, got {version}")
    header = _UNSAID[version] | header
    for name, kind in _KINDS.items():
        if not isinstance(header.get(name), kind):
            raise BadData(f"{name} is missing or of a wrong kind in the header")
    return {name: tuple(header[name]) if kind is list else header[name] for name, kind in _KINDS.items()}


def read_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a model file, the header among them."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
        # Stored, not deflated: what is declared cannot be larger than the file.
        if (
            any(e.compress_type != zipfile.ZIP_STORED or e.file_size > len(content) for e in entries)
            or len(entries) > 64
        ):
            raise BadData("its arrays must be stored uncompressed")
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except BadData:
        raise
    except Exception as error:  # zipfile and numpy raise many kinds on damaged archives; all mean the same here
        raise BadData(f"it must be an .npz archive of numbers ({type(error).__name__})") from None


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
        if len(values) < least or not all(isinstance(v, str) and v for v in values) or len(set(values)) != len(values):
            raise BadData(f"{name} must be at least {least} different words")
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
    for name, array in model.arrays.items():
        kinds = "b" if name == "standardiser.logarithmic" else "fi"
        if array.dtype.kind not in kinds or not np.isfinite(array).all():
            raise BadData(f"array {name} must hold finite numbers, got {array.dtype}")
    if not (model.arrays["standardiser.scale"] > 0).all() or not (model.arrays["standardiser.floor"] > 0).all():
        raise BadData("arrays standardiser.scale and standardiser.floor must be above 0")
    for sensor in model.sensors:
        model.equalisation(sensor)  # checks its gains


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

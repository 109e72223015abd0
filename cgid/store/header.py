"""What a shard says about itself; nothing in it is believed before it is checked."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.signals import UNITS

FORMAT = "cgid-dataset"
SCHEMA_VERSION = 1
#: More than this in one file is refused: a shard is held in memory.
LARGEST_SHARD = 2 << 30


@dataclass(frozen=True)
class ShardHeader:
    """What a shard says about itself, checked."""

    n_signals: int
    n_samples: int
    dtype: str
    sampling_rate: float
    pre_trigger: int
    unit: str
    parameter_units: Mapping[str, str]
    attributes: Mapping[str, Any]
    #: Bytes of a stored label.
    label_width: int


def read_header(file: h5py.File, path: str) -> ShardHeader:
    """Return the checked header of an open shard.

    Raises
    ------
    BadData
        It is no cgid dataset, of another version, incomplete, or holds what a dataset must not hold.
    """
    attributes = attributes_of(file)
    if attributes.get("format") != FORMAT:
        raise BadData(f"{path}: this HDF5 file must be a cgid dataset (attribute format = {FORMAT!r}); it is not")
    version = attributes.get("schema_version")
    if version != SCHEMA_VERSION:
        raise BadData(f"{path}: schema_version must be {SCHEMA_VERSION}, got {version}: use the cgid that wrote it")
    require_scene(attributes, path)
    signals = plain_dataset(file, "signals", path)
    if signals.ndim != 2 or signals.dtype not in (np.float32, np.float64) or not all(signals.shape):
        raise BadData(f"{path}: signals must be rows of floats, got shape {signals.shape} of {signals.dtype}")
    for name, kind in (("labels", "S"), ("specimen", "u")):
        dataset = plain_dataset(file, name, path)
        if dataset.shape != signals.shape[:1] or dataset.dtype.kind != kind:
            raise BadData(f"{path}: {name} must be one value a signal, got shape {dataset.shape} of {dataset.dtype}")
    units = _parameter_units(file, path, signals.shape[0])
    n_signals, n_samples = signals.shape
    about = attributes_of(signals)
    rate, before, unit = (about.get(name) for name in ("sampling_rate", "pre_trigger", "unit"))
    for name, value, holds in (
        ("sampling_rate", rate, isinstance(rate, float) and 0 < rate < np.inf),
        ("pre_trigger", before, type(before) is int and 0 <= before < n_samples),
        ("unit", unit, any(unit in units for units in UNITS.values())),
    ):
        if not holds:
            raise BadData(f"{path}: signals must have a sound attribute {name}, got {value!r}")
    return ShardHeader(
        n_signals,
        n_samples,
        signals.dtype.name,
        about["sampling_rate"],
        about["pre_trigger"],
        about["unit"],
        units,
        attributes,
        file["labels"].dtype.itemsize,
    )


def require_scene(attributes: Mapping[str, Any], path: str) -> None:
    """Raise `BadData` if the text of the scene is not the one that was hashed: HDF5 does not check long attributes."""
    scene, digest = attributes.get("scene"), attributes.get("scene_sha256")
    if scene is not None and hashlib.sha256(str(scene).encode()).hexdigest() != digest:
        raise BadData(f"{path}: the text of the scene must fit scene_sha256, it does not; generate the file again")


def _parameter_units(file: h5py.File, path: str, n_signals: int) -> dict[str, str]:
    if not file.id.links.exists(b"parameters"):
        return {}
    if not is_inside(file, "parameters") or not isinstance(file["parameters"], h5py.Group):
        raise BadData(f"{path}: parameters must be a group of the file itself; it is a link or a dataset")
    units = {}
    for name in file["parameters"]:
        dataset = plain_dataset(file, f"parameters/{name}", path)
        if dataset.shape != (n_signals,) or dataset.dtype.kind != "f":
            raise BadData(f"{path}: parameters/{name} must be one number a signal, got shape {dataset.shape}")
        units[name] = str(attributes_of(dataset).get("unit", ""))
    return units


def plain_dataset(file: h5py.File, name: str, path: str) -> h5py.Dataset:
    """Return a dataset that lies in this very file; links elsewhere could read other files."""
    for part in (name.split("/")[0], name):
        if not is_inside(file, part):
            raise BadData(f"{path}: {part} must be part of the file itself; it is missing or a link")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual or dataset.dtype.hasobject:
        raise BadData(f"{path}: {name} must be a plain dataset inside the file")
    size = dataset.size * dataset.dtype.itemsize if dataset.shape is not None else 0
    if size > LARGEST_SHARD:
        raise BadData(f"{path}: {name} must be at most {LARGEST_SHARD >> 30} GiB, it declares {size / 2**30:.3g} GiB")
    return dataset


def is_inside(file: h5py.File, name: str) -> bool:
    """Return whether this name is there and no soft or external link, without following it."""
    links = file.id.links
    return bool(links.exists(name.encode()) and links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD)


def attributes_of(item: h5py.HLObject) -> dict[str, Any]:
    """Return the attributes that are one number or one string of fixed length; no others are written, or even read."""
    found = {}
    for name in item.attrs:
        stored = item.attrs.get_id(name)
        if stored.shape == () and stored.dtype.kind in "biufS":
            value = item.attrs[name]
            found[name] = value.decode(errors="replace") if isinstance(value, bytes) else value.item()
    return found


def text_of(labels: NDArray[np.bytes_]) -> NDArray[np.str_]:
    """Return stored labels as text."""
    return np.char.decode(labels, "utf-8", errors="replace")

"""Checked headers and rows of shards, recordings and tables: everything in a file is checked before use."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import RATES
from cgid.errors import BadData
from cgid.store.description import (
    DAMAGE,
    FORMAT,
    RECORDING_FORMAT,
    RECORDING_SCHEMA_VERSION,
    SCHEMA_VERSION,
    TABLE_FORMAT,
    TABLE_VERSION,
    ShardHeader,
    require_scene,
    require_schema,
)
from cgid.store.gates import BEST_RATIO, Identity, attributes_of, members, opened, plain_dataset
from cgid.units import UNITS

#: Labels and names are shorter [bytes].
_WIDEST_TEXT = 4096
#: Maximum number of damaged chunks of one dataset that are named.
_MAX_CHUNKS = 4
#: Recordings and tables are uncompressed: they declare no more bytes than are stored.
_UNPACKED = 1.0
#: Noun, version, main datasets (the most important first) and the group of columns of each kind of file.
_KINDS: Mapping[str, tuple[str, int, tuple[str, ...], str]] = {
    FORMAT: ("cgid dataset", SCHEMA_VERSION, ("signals", "labels", "specimen"), "parameters"),
    RECORDING_FORMAT: ("cgid recording", RECORDING_SCHEMA_VERSION, ("samples",), "impacts"),
    TABLE_FORMAT: ("table", TABLE_VERSION, ("labels", "specimen"), "columns"),
}
KINDS = frozenset(_KINDS)


def shard_header(file: h5py.File, source: str) -> ShardHeader:
    """Return the checked header of a shard; raises `BadData`."""
    attributes = _root(file, source, FORMAT)
    signals = plain_dataset(file, "signals", source)
    about = _about(signals, source, "rows", "pre_trigger")
    n_signals = signals.shape[0]
    for name, kind in (("labels", "S"), ("specimen", "u")):
        _column(file, name, source, n_signals, kind, "value a signal")
    names = members(file, "parameters", source) if file.id.links.exists(b"parameters") else []
    return ShardHeader(
        n_signals=n_signals,
        parameter_units={
            name: _column(file, f"parameters/{name}", source, n_signals, "f", "number a signal") for name in names
        },
        attributes=attributes,
        label_width=file["labels"].dtype.itemsize,
        **about,
    )


def recording_header(file: h5py.File, source: str) -> dict[str, Any]:
    """Return the checked header of a recording, and the columns of its impacts; raises as `shard_header`."""
    attributes = _root(file, source, RECORDING_FORMAT)
    about = _about(plain_dataset(file, "samples", source, _UNPACKED), source, "a row", "start")
    n_impacts = attributes.get("n_impacts")
    units = {
        name: _column(file, f"impacts/{name}", source, n_impacts, "fiuS", "value an impact", _UNPACKED)
        for name in members(file, "impacts", source)
    }
    if type(n_impacts) is not int or "time" not in units:
        raise BadData(f"{source}: impacts must have a column time and their number in n_impacts; generate it again")
    return {"attributes": attributes, "n_impacts": n_impacts, "impact_units": units, **about}


def table_header(file: h5py.File, source: str) -> dict[str, Any]:
    """Return the checked header of a table, its columns and number of rows; raises as `shard_header`."""
    attributes = _root(file, source, TABLE_FORMAT)
    del attributes["format"], attributes["schema_version"]
    labels = plain_dataset(file, "labels", source, _UNPACKED)
    n_rows = labels.shape[0] if labels.ndim == 1 else None
    kinds = {"labels": "S", "specimen": "u"}
    kinds |= {f"columns/{name}": "f" for name in members(file, "columns", source)}
    units = {name: _column(file, name, source, n_rows, kind, "value a row", _UNPACKED) for name, kind in kinds.items()}
    return {
        "kind": str(attributes.pop("kind", "")),
        "attributes": attributes,
        "units": {name.removeprefix("columns/"): unit for name, unit in list(units.items())[2:]},
        "n_rows": n_rows,
    }


def header_of(file: h5py.File, source: str, kind: str) -> Any:
    """Return the checked header of a file of this kind; raises as `shard_header`."""
    return {FORMAT: shard_header, RECORDING_FORMAT: recording_header, TABLE_FORMAT: table_header}[kind](file, source)


def _root(file: h5py.File, source: str, form: str) -> dict[str, Any]:
    """Return the root attributes; raises `BadData` unless format and version are right."""
    noun, version, *_ = _KINDS[form]
    attributes = attributes_of(file, source)
    if attributes.get("format") != form:
        raise BadData(f"{source}: this HDF5 file must be a {noun} (attribute format = {form!r}); it is not")
    require_schema(source, attributes.get("schema_version"), version)
    require_scene(source, attributes)
    return attributes


def _about(samples: h5py.Dataset, source: str, form: str, start_name: str) -> dict[str, Any]:
    """Return length, type, rate, unit and `start_name` ("pre_trigger" or "start") of the samples; raises `BadData`."""
    name, shape, dtype = samples.name[1:], samples.shape, samples.dtype
    n_axes = 2 if form == "rows" else 1
    if samples.ndim != n_axes or dtype not in (np.float32, np.float64) or not all(shape):
        raise BadData(f"{source}: {name} must be {form} of floats, got shape {shape} of {dtype}")
    attributes = attributes_of(samples, source)
    rules: dict[str, Callable[[Any], bool]] = {
        "sampling_rate": lambda rate: isinstance(rate, float) and RATES[0] <= rate <= RATES[1],
        "unit": lambda unit: any(unit in units for units in UNITS.values()),
        "pre_trigger": lambda before: type(before) is int and 0 <= before < shape[-1],
        "start": lambda start: isinstance(start, float) and math.isfinite(start),
    }
    about = {attribute: attributes.get(attribute) for attribute in ("sampling_rate", "unit", start_name)}
    for attribute, value in about.items():
        if not rules[attribute](value):
            raise BadData(f"{source}: {name} must have a valid attribute {attribute}, got {value!r:.80}")
    return {**about, "n_samples": shape[-1], "dtype": dtype.name}


def _column(
    file: h5py.File, name: str, source: str, n_rows: Any, kinds: str, what: str, best_ratio: float = BEST_RATIO
) -> str:
    """Return the unit of a column of numbers or short texts; raises `BadData` unless it has one value per row."""
    column = plain_dataset(file, name, source, best_ratio)
    if column.shape != (n_rows,) or column.dtype.kind not in kinds or column.dtype.itemsize > _WIDEST_TEXT:
        raise BadData(f"{source}: {name} must be one {what}, got shape {column.shape} of {column.dtype}")
    return str(attributes_of(column, source).get("unit", ""))


# ---- rows ------------------------------------------------------------------------------------------------------------


def rows(
    path: Path, names: Sequence[str], first: int, stop: int, length: int, identity: Identity
) -> Generator[dict[str, NDArray[Any]], None, None]:
    """Yield the rows [first, stop) of several datasets of equal length, at most `length` at once."""
    with opened(path, str(path), identity) as file:
        stored = {name: plain_dataset(file, name, str(path)) for name in names}
        # Without rows, yield one part of length 0 with the types of all columns.
        for begin in range(first, max(stop, first + 1), length):
            part = slice(begin, min(begin + length, stop))
            yield {name: _part(one, part, path) for name, one in stored.items()}


def _part(dataset: h5py.Dataset, part: slice, path: Path) -> NDArray[Any]:
    try:
        values: NDArray[Any] = dataset[part]
    except DAMAGE:
        raise BadData(
            f"{path}: {dataset.name[1:]} {part.start} to {part.stop - 1} must match their checksums, the file is "
            "damaged; generate it again"
        ) from None
    return values


def damaged_rows(file: h5py.File, kind: str, source: str) -> str:
    """Describe the unreadable chunks of a file with sound headers, "" if there are none."""
    _, _, names, group = _KINDS[kind]
    columns = members(file, group, source) if file.id.links.exists(group.encode()) else []
    damaged = []
    scales = [name for name in ("signal", "time") if file.id.links.exists(name.encode())]
    for name in (*names, *scales, *(f"{group}/{column}" for column in columns)):
        dataset = plain_dataset(file, name, source)
        step, chunks = dataset.chunks[0] if dataset.chunks else max(len(dataset), 1), []
        for first in range(0, len(dataset), step):
            try:
                dataset[first : first + step]
            except DAMAGE:
                chunks.append(f"{first} to {min(first + step, len(dataset)) - 1}")
        if chunks:
            more = [f"{len(chunks) - _MAX_CHUNKS} more chunks"] if len(chunks) > _MAX_CHUNKS else []
            damaged.append(f"{name} {', '.join(chunks[:_MAX_CHUNKS] + more)}")
    return f"{'; '.join(damaged)} do not fit their checksum" if damaged else ""

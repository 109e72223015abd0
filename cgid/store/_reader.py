"""The process that reads HDF5 files for another one; see `cgid.store.sandbox`.

It calls the functions that are named on its standard input, within limits of time and memory, and ends when the input
closes. Everything in a file is checked before use.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from inspect import isgenerator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError
from cgid.store import _foreign, sandbox
from cgid.store._checks import (
    BEST_RATIO,
    attributes_of,
    bytes_of,
    chunk_bytes,
    filters_of,
    members,
    opened,
    plain_dataset,
)
from cgid.store.description import (
    FORMAT,
    RECORDING_FORMAT,
    RECORDING_SCHEMA_VERSION,
    SCHEMA_VERSION,
    TABLE_FORMAT,
    TABLE_VERSION,
    require_scene,
    require_schema,
)
from cgid.store.sandbox import DAMAGE
from cgid.units import UNITS
from cgid.validation import RATES

#: Labels and names are shorter [bytes].
_WIDEST_TEXT = 4096
#: Recordings and tables are uncompressed: they declare no more bytes than are stored.
_UNPACKED = 1.0
#: Chunks in one reply, few enough for its time limit.
_TOGETHER = 64
#: Noun, version, main datasets (the most important first) and the group of columns of each kind of file.
_KINDS: Mapping[str, tuple[str, int, tuple[str, ...], str]] = {
    FORMAT: ("cgid dataset", SCHEMA_VERSION, ("signals", "labels", "specimen"), "parameters"),
    RECORDING_FORMAT: ("cgid recording", RECORDING_SCHEMA_VERSION, ("samples",), "impacts"),
    TABLE_FORMAT: ("table", TABLE_VERSION, ("labels", "specimen"), "columns"),
}


# ---- headers ---------------------------------------------------------------------------------------------------------


def format_said(path: str, source: str) -> str:
    """Return the attribute `format` of the root, "" if there is none; raises `BadData` if the file cannot be opened."""
    with opened(path, source) as file:
        said = file.attrs.get_id("format") if "format" in file.attrs else None
        if said is None or said.shape != () or said.dtype.kind != "S" or said.dtype.itemsize > _WIDEST_TEXT:
            return ""
        return bytes(file.attrs["format"]).decode(errors="replace")


def shard_header(path: str, source: str) -> dict[str, Any]:
    """Return the checked header of a shard, the fields of `ShardHeader`.

    Raises `BadData` if it is no cgid dataset, of another version or incomplete, or has content that is not allowed.
    """
    with opened(path, source) as file:
        attributes = _root(file, source, FORMAT)
        signals = plain_dataset(file, "signals", source)
        about = _about(signals, source, "rows", "pre_trigger")
        n_signals = signals.shape[0]
        for name, kind in (("labels", "S"), ("specimen", "u")):
            _column(file, name, source, n_signals, kind, "value a signal")
        names = members(file, "parameters", source) if file.id.links.exists(b"parameters") else []
        units = {name: _column(file, f"parameters/{name}", source, n_signals, "f", "number a signal") for name in names}
        label_width = file["labels"].dtype.itemsize
    return {
        "n_signals": n_signals,
        "parameter_units": units,
        "attributes": attributes,
        "label_width": label_width,
        **about,
    }


def recording_header(path: str, source: str) -> dict[str, Any]:
    """Return the checked header of a recording, and the columns of its impacts; raises as `shard_header`."""
    with opened(path, source) as file:
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


def table_header(path: str, source: str) -> dict[str, Any]:
    """Return the checked header of a table, its columns and number of rows; raises as `shard_header`."""
    with opened(path, source) as file:
        attributes = _root(file, source, TABLE_FORMAT)
        del attributes["format"], attributes["schema_version"]
        labels = plain_dataset(file, "labels", source, _UNPACKED)
        n_rows = labels.shape[0] if labels.ndim == 1 else None
        kinds = {"labels": "S", "specimen": "u"}
        kinds |= {f"columns/{name}": "f" for name in members(file, "columns", source)}
        units = {
            name: _column(file, name, source, n_rows, kind, "value a row", _UNPACKED) for name, kind in kinds.items()
        }
        return {
            "kind": str(attributes.pop("kind", "")),
            "attributes": attributes,
            "units": {name.removeprefix("columns/"): unit for name, unit in list(units.items())[2:]},
            "n_rows": n_rows,
            "row_bytes": sum(bytes_of(file[name]) for name in kinds),
        }


def _root(file: h5py.File, source: str, form: str) -> dict[str, Any]:
    """Return the root attributes; raises `BadData` unless format and version are right."""
    noun, version, *_ = _KINDS[form]
    attributes = attributes_of(file, source)
    if attributes.get("format") != form:
        raise BadData(f"{source}: this HDF5 file must be a {noun} (attribute format = {form!r}); it is not")
    require_schema(source, attributes.get("schema_version"), version)
    require_scene(source, attributes)
    return attributes


def _about(samples: h5py.Dataset, source: str, form: str, place: str) -> dict[str, Any]:
    """Return length, type, sampling rate, unit and `place` ("pre_trigger" or "start") of "rows" or "a row" of samples.

    Raises `BadData` unless they are plausible.
    """
    name, shape, dtype = samples.name[1:], samples.shape, samples.dtype
    n_axes = 2 if form == "rows" else 1
    if samples.ndim != n_axes or dtype not in (np.float32, np.float64) or not all(shape):
        raise BadData(f"{source}: {name} must be {form} of floats, got shape {shape} of {dtype}")
    said = attributes_of(samples, source)
    rules: dict[str, Callable[[Any], bool]] = {
        "sampling_rate": lambda rate: isinstance(rate, float) and RATES[0] <= rate <= RATES[1],
        "unit": lambda unit: any(unit in units for units in UNITS.values()),
        "pre_trigger": lambda before: type(before) is int and 0 <= before < shape[-1],
        "start": lambda start: isinstance(start, float) and math.isfinite(start),
    }
    about = {attribute: said.get(attribute) for attribute in ("sampling_rate", "unit", place)}
    for attribute, value in about.items():
        if not rules[attribute](value):
            raise BadData(f"{source}: {name} must have a sound attribute {attribute}, got {value!r:.80}")
    return {**about, "n_samples": shape[-1], "dtype": dtype.name}


def _column(
    file: h5py.File, name: str, source: str, n_rows: Any, kinds: str, what: str, best_ratio: float = BEST_RATIO
) -> str:
    """Return the unit of a column of numbers or short texts; raises `BadData` unless it has one value per row."""
    column = plain_dataset(file, name, source, best_ratio)
    if column.shape != (n_rows,) or column.dtype.kind not in kinds or column.dtype.itemsize > _WIDEST_TEXT:
        raise BadData(f"{source}: {name} must be one {what}, got shape {column.shape} of {column.dtype}")
    return str(attributes_of(column, source).get("unit", ""))


# ---- content ---------------------------------------------------------------------------------------------------------


def rows(
    path: str, source: str, names: Sequence[str], first: int, stop: int, length: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the rows [first, stop) of several datasets of equal length, at most `length` at once.

    Raises `BadData` if a checksum is wrong.
    """
    with ExitStack() as stack:
        file = stack.enter_context(opened(path, source))
        stored = {name: plain_dataset(file, name, source) for name in names}
        row, chunk = (sum(size(one) for one in stored.values()) for size in (bytes_of, chunk_bytes))
        # Without rows, yield one part of length 0 with the types of all columns.
        for begin in range(first, max(stop, first + 1), length):
            part = slice(begin, min(begin + length, stop))
            # Three copies: as read, in another byte order, and the next part, which is read while this one exists.
            sandbox.allow(3 * (row * (part.stop - part.start) + chunk))
            yield {name: _part(one, part, source) for name, one in stored.items()}


def _part(dataset: h5py.Dataset, part: slice, source: str) -> NDArray[Any]:
    try:
        found: NDArray[Any] = dataset[part]
    except DAMAGE:
        raise BadData(
            f"{source}: {dataset.name[1:]} {part.start} to {part.stop - 1} must fit their checksums, they do not: the "
            "file is damaged; generate it again"
        ) from None
    return found


def examine(path: str, source: str, steps: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    """Yield the readable content of a shard, a recording or a table, which may be damaged, piece by piece.

    First the root `attributes`; then `filters` (HDF5's numbers), `dtype` and `n_samples` of the signals or samples;
    then `name` and some `chunks` of each dataset, as in `cgid.store.verification.examine_file`, which also explains
    `steps`. Raises `BadData` if the headers are damaged or those of another file.
    """
    with opened(path, source) as file:
        attributes = attributes_of(file, source)
        yield {"attributes": attributes}
        kind = str(attributes.get("format"))
        if kind not in _KINDS:
            raise BadData(f"{source}: this HDF5 file must be a dataset, a recording or a table of cgid; it is none")
        {FORMAT: shard_header, RECORDING_FORMAT: recording_header, TABLE_FORMAT: table_header}[kind](path, source)
        _, _, names, group = _KINDS[kind]
        main = file[names[0]]
        yield {
            "filters": [code for code, *_ in filters_of(main)],
            "dtype": main.dtype.name,
            "n_samples": main.shape[-1],
        }
        columns = members(file, group, source) if file.id.links.exists(group.encode()) else []
        for name in (*names, *(f"{group}/{column}" for column in columns)):
            dataset = plain_dataset(file, name, source)
            for chunks in _hashed(dataset, steps.get(name)):
                yield {"name": name, "chunks": chunks}


def _hashed(dataset: h5py.Dataset, step: int | None) -> Iterator[list[tuple[int, int, str]]]:
    n_rows = dataset.shape[0]
    step = step or (dataset.chunks[0] if dataset.chunks else max(n_rows, 1))
    starts = range(0, n_rows, step)
    for first in range(0, len(starts), _TOGETHER):
        sandbox.allow(3 * (step * bytes_of(dataset) + chunk_bytes(dataset)))
        yield [
            (start, min(start + step, n_rows), _digest(dataset, slice(start, start + step)))
            for start in starts[first : first + _TOGETHER]
        ]


def _digest(dataset: h5py.Dataset, part: slice) -> str:
    try:
        return hashlib.sha256(dataset[part].tobytes()).hexdigest()
    except DAMAGE:
        return ""


# ---- questions and answers -------------------------------------------------------------------------------------------

#: The available functions. Each receives the path, its name in messages, and further arguments. It returns JSON or a
#: dict of arrays, or yields such values.
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "examine": examine,
    "foreign_blocks": _foreign.foreign_blocks,
    "foreign_columns": _foreign.foreign_columns,
    "foreign_names": _foreign.foreign_names,
    "foreign_survey": _foreign.foreign_survey,
    "foreign_texts": _foreign.foreign_texts,
    "format_said": format_said,
    "recording_header": recording_header,
    "shard_header": shard_header,
    "table_header": table_header,
    "rows": rows,
}


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries may print to standard output, so replies use a duplicate of its descriptor.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sandbox.send(answers, {})
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    sandbox.settle()
    for line in sys.stdin.buffer:
        request = json.loads(line)
        for message, arrays in _replies(request["function"], request["arguments"]):
            sandbox.rest()
            try:
                sandbox.send(answers, message, arrays)  # waits while the pipe is full
            except sandbox.BrokenWire as error:
                text = f"says more of itself than a file may ({error}); copy it again, or leave it out"
                sandbox.send(answers, _error(f"{request['arguments'][1]}: {text}"))
                break


def _replies(function: str, arguments: list[Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    path, source = arguments[:2]
    try:
        sandbox.begin(path)
        found = FUNCTIONS[function](*arguments)
        if not isgenerator(found):
            message, arrays = _reply(found)
            yield {**message, "last": True}, arrays
            return
        for item in found:
            yield _reply(item)
            sandbox.begin(path)
        yield {"value": None, "last": True}, {}
    except CgidError as error:
        yield _error(str(error), type(error).__name__), {}
    except MemoryError:
        cure = "it is damaged or hostile: copy it again, or leave it out"
        yield _error(f"{source}: reading this file takes more memory than it may; {cure}"), {}
    except Exception as error:  # report any error of h5py in one line
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        yield _error(f"{source}: is damaged ({reason}); copy it again, or generate it anew"), {}


def _error(text: str, kind: str = "BadData") -> dict[str, Any]:
    return {"error": kind, "text": text, "last": True}


def _reply(found: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    if isinstance(found, dict) and found and all(isinstance(value, np.ndarray) for value in found.values()):
        return {}, found
    return {"value": found}, {}


if __name__ == "__main__":
    _main()

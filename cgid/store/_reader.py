"""What the reading process says of files that cgid made: their headers, checked, and their rows.

What the reading process finds out of a file of ours that may be damaged: what can still be read, chunk by chunk.

The process that reads HDF5 files for another, which asks by its standard input; see `apart`.

It knows a few functions and nothing else, has limits of time and memory, and ends when nobody can ask any more.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from inspect import isgenerator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError
from cgid.store import _foreign, sandbox
from cgid.store._checks import DAMAGE, attributes_of, bytes_of, chunk_bytes, members, opened, plain_dataset
from cgid.store.description import (
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
from cgid.units import UNITS
from cgid.validation import RATES

#: Labels and names are shorter [bytes].
_WIDEST_TEXT = 4096
#: Recordings and tables are not packed: they declare no more than is stored.
_UNPACKED = 1.0


def format_said(path: str, source: str) -> str | None:
    """Return what the root says it is, "" for nothing; None for what cannot be opened."""
    try:
        with opened(path, source) as file:
            said = file.attrs.get_id("format") if "format" in file.attrs else None
            if said is None or said.shape != () or said.dtype.kind != "S" or said.dtype.itemsize > _WIDEST_TEXT:
                return ""
            return bytes(file.attrs["format"]).decode(errors="replace")
    except BadData:
        return None


def shard_header(path: str, source: str) -> dict[str, Any]:
    """Return the checked header of a shard, as a dict of `ShardHeader`.

    Raises
    ------
    BadData
        It is no cgid dataset, of another version, incomplete, or holds what a dataset must not hold.
    """
    with opened(path, source) as file:
        return asdict(_read_header(file, source))


def recording_header(path: str, source: str) -> dict[str, Any]:
    """Return what a recording says of itself, checked, and its columns of impacts.

    Raises
    ------
    BadData
        It is no recording, of another version, or incomplete.
    """
    with opened(path, source) as file:
        attributes = _root_of(file, source, "cgid recording", RECORDING_FORMAT, RECORDING_SCHEMA_VERSION)
        samples = plain_dataset(file, "samples", source, _UNPACKED)
        if samples.ndim != 1 or samples.dtype not in (np.float32, np.float64) or not samples.size:
            raise BadData(f"{source}: samples must be a row of floats, got shape {samples.shape} of {samples.dtype}")
        about = attributes_of(samples, source)
        _require_rate_and_unit(source, "samples", about)
        start = about.get("start")
        if not isinstance(start, float) or not np.isfinite(start):
            raise BadData(f"{source}: samples must have a sound attribute start, got {start!r:.80}")
        n_impacts, units = _impact_columns(file, source, attributes.get("n_impacts"))
        return {
            "attributes": attributes,
            "n_samples": int(samples.size),
            "dtype": samples.dtype.name,
            "n_impacts": n_impacts,
            "sampling_rate": about["sampling_rate"],
            "start": start,
            "unit": about["unit"],
            "impact_units": units,
        }


def _impact_columns(file: h5py.File, source: str, count: Any) -> tuple[int, dict[str, str]]:
    units = {}
    for name in members(file, "impacts", source):
        column = plain_dataset(file, f"impacts/{name}", source, _UNPACKED)
        if column.shape != (count,) or not _is_column(column, "fiuS"):
            raise BadData(f"{source}: impacts/{name} must be one value an impact, got shape {column.shape}")
        units[name] = str(attributes_of(column, source).get("unit", ""))
    if type(count) is not int or "time" not in units:
        raise BadData(f"{source}: impacts must have a column time and their number in n_impacts; generate it again")
    return count, units


def table_header(path: str, source: str) -> dict[str, Any]:
    """Return what a table says of itself, checked, its columns and number of rows.

    Raises
    ------
    BadData
        It is no table, of another version, or incomplete.
    """
    with opened(path, source) as file:
        attributes = _root_of(file, source, "table", TABLE_FORMAT, TABLE_VERSION)
        del attributes["format"], attributes["schema_version"]
        columns = [f"columns/{name}" for name in members(file, "columns", source)]
        stored = {name: plain_dataset(file, name, source, _UNPACKED) for name in ("labels", "specimen", *columns)}
        n_rows = stored["labels"].shape
        for name, kinds in (("labels", "S"), ("specimen", "u"), *((name, "f") for name in columns)):
            if stored[name].shape != n_rows or not _is_column(stored[name], kinds):
                raise BadData(f"{source}: must hold all columns that it names, all of one length; {name} is not")
        return {
            "kind": str(attributes.pop("kind", "")),
            "attributes": attributes,
            "units": {name[8:]: str(attributes_of(stored[name], source).get("unit", "")) for name in columns},
            "n_rows": n_rows[0],
            "row_bytes": sum(bytes_of(one) for one in stored.values()),
        }


def rows(
    path: str, source: str, names: Sequence[str], first: int, stop: int, length: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield rows of several datasets of one length, at most `length` at once.

    Parameters
    ----------
    path, source : str
    names : sequence of str
    first, stop : int
        Rows from the first up to, without, the last.
    length : int

    Raises
    ------
    BadData
        A checksum does not fit: the file is damaged.
    """
    with ExitStack() as stack:
        file = stack.enter_context(opened(path, source))
        stored = {name: plain_dataset(file, name, source) for name in names}
        row, chunk = (sum(size(one) for one in stored.values()) for size in (bytes_of, chunk_bytes))
        # Nothing is a part, too: of no length, but of the types of all.
        for begin in range(first, max(stop, first + 1), length):
            part = slice(begin, min(begin + length, stop))
            # As read, turned round where the bytes are, and the next that is read before the last has gone.
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


def _root_of(file: h5py.File, source: str, noun: str, form: str, version: int) -> dict[str, Any]:
    """Return the attributes of the root; raises `BadData` unless they are those of such a file, of this version."""
    attributes = attributes_of(file, source)
    if attributes.get("format") != form:
        raise BadData(f"{source}: this HDF5 file must be a {noun} (attribute format = {form!r}); it is not")
    require_schema(source, attributes.get("schema_version"), version)
    require_scene(source, attributes)
    return attributes


def _read_header(file: h5py.File, source: str) -> ShardHeader:
    attributes = _root_of(file, source, "cgid dataset", FORMAT, SCHEMA_VERSION)
    signals = plain_dataset(file, "signals", source)
    if signals.ndim != 2 or signals.dtype not in (np.float32, np.float64) or not all(signals.shape):
        raise BadData(f"{source}: signals must be rows of floats, got shape {signals.shape} of {signals.dtype}")
    for name, kind in (("labels", "S"), ("specimen", "u")):
        dataset = plain_dataset(file, name, source)
        if dataset.shape != signals.shape[:1] or not _is_column(dataset, kind):
            raise BadData(f"{source}: {name} must be one value a signal, got shape {dataset.shape} of {dataset.dtype}")
    units = _parameter_units(file, source, signals.shape[0])
    n_signals, n_samples = signals.shape
    about = attributes_of(signals, source)
    before = about.get("pre_trigger")
    _require_rate_and_unit(source, "signals", about)
    if type(before) is not int or not 0 <= before < n_samples:
        raise BadData(f"{source}: signals must have a sound attribute pre_trigger, got {before!r:.80}")
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


def _require_rate_and_unit(source: str, name: str, about: dict[str, Any]) -> None:
    """Raise `BadData` unless samples have a sampling rate that something is measured at, and a known unit."""
    rate, unit = about.get("sampling_rate"), about.get("unit")
    for attribute, value, holds in (
        ("sampling_rate", rate, isinstance(rate, float) and RATES[0] <= rate <= RATES[1]),
        ("unit", unit, any(unit in units for units in UNITS.values())),
    ):
        if not holds:
            raise BadData(f"{source}: {name} must have a sound attribute {attribute}, got {value!r:.80}")


def _parameter_units(file: h5py.File, source: str, n_signals: int) -> dict[str, str]:
    if not file.id.links.exists(b"parameters"):
        return {}
    units = {}
    for name in members(file, "parameters", source):
        dataset = plain_dataset(file, f"parameters/{name}", source)
        if dataset.shape != (n_signals,) or not _is_column(dataset, "f"):
            raise BadData(f"{source}: parameters/{name} must be one number a signal, got shape {dataset.shape}")
        units[name] = str(attributes_of(dataset, source).get("unit", ""))
    return units


def _is_column(dataset: h5py.Dataset, kinds: str) -> bool:
    """Return whether these are numbers or short texts of these kinds, one a row."""
    return dataset.ndim == 1 and dataset.dtype.kind in kinds and dataset.dtype.itemsize <= _WIDEST_TEXT


#: The groups that hold the columns of each kind of file, and what lies beside them, the most important first.
_COLUMNS = {FORMAT: "parameters", RECORDING_FORMAT: "impacts", TABLE_FORMAT: "columns"}
_BESIDE = {
    FORMAT: ("signals", "labels", "specimen"),
    RECORDING_FORMAT: ("samples",),
    TABLE_FORMAT: ("labels", "specimen"),
}
_HEADERS = {
    FORMAT: shard_header,
    RECORDING_FORMAT: recording_header,
    TABLE_FORMAT: table_header,
}
#: Chunks of one answer: so many take no longer than an answer may.
_TOGETHER = 64


def examine(path: str, source: str, steps: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    """Yield what can be read of a dataset's file, a recording or a table, piece by piece.

    Parameters
    ----------
    path, source : str
    steps : dict of int
        How many rows of which dataset are looked at together; by default its own chunks.

    Yields
    ------
    dict
        First the `attributes` of the root; then `filters`, HDF5's numbers of what signals or samples are packed by,
        their `dtype` and `n_samples`; then for each dataset its `name` and some `chunks` of it: first row, row behind
        the last, and the SHA-256 of the values, "" where they do not fit their checksum.

    Raises
    ------
    BadData
        The headers are damaged, or those of another file.
    """
    with opened(path, source) as file:
        attributes = attributes_of(file, source)
        yield {"attributes": attributes}
        kind = attributes.get("format")
        if kind not in _HEADERS:
            raise BadData(f"{source}: this HDF5 file must be a dataset, a recording or a table of cgid; it is none")
        _HEADERS[kind](path, source)
        creation = file[_BESIDE[kind][0]].id.get_create_plist()
        filters = [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]
        main = file[_BESIDE[kind][0]]
        yield {"filters": filters, "dtype": main.dtype.name, "n_samples": main.shape[-1]}
        for name in _names(file, kind, source):
            dataset = plain_dataset(file, name, source)
            for chunks in _chunks(dataset, steps.get(name)):
                yield {"name": name, "chunks": chunks}


def _names(file: h5py.File, kind: str, source: str) -> list[str]:
    group = _COLUMNS[kind]
    columns = members(file, group, source) if file.id.links.exists(group.encode()) else []
    return [*_BESIDE[kind], *(f"{group}/{name}" for name in columns)]


def _chunks(dataset: h5py.Dataset, step: int | None) -> Iterator[list[tuple[int, int, str]]]:
    n_rows = dataset.shape[0]
    step = step or (dataset.chunks[0] if dataset.chunks else max(n_rows, 1))
    starts = range(0, n_rows, step)
    for first in range(0, len(starts), _TOGETHER):
        sandbox.allow(3 * (step * bytes_of(dataset) + chunk_bytes(dataset)))
        yield [
            (start, min(start + step, n_rows), _digest(dataset, slice(start, start + step)))
            for start in starts[first : first + _TOGETHER]
        ]


def _digest(dataset: h5py.Dataset, rows: slice) -> str:
    try:
        return hashlib.sha256(dataset[rows].tobytes()).hexdigest()
    except DAMAGE:
        return ""


#: What can be asked. Each is given the path, its name in messages, and what else it needs; it returns what JSON can
#: hold or a dict of arrays, or yields such dicts.
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "examine": examine,
    "foreign_blocks": _foreign.foreign_blocks,
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
    # Libraries may print; the answers have a way of their own.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sandbox.send(answers, {})
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    sandbox.settle()
    requests = sys.stdin.buffer
    for line in requests:
        request = json.loads(line)
        if "function" in request:
            _serve(request["function"], request["arguments"], requests, answers)


def _serve(function: str, arguments: list[Any], requests: Any, answers: Any) -> None:
    for number, (message, arrays) in enumerate(_replies(function, arguments)):
        sandbox.rest()
        # The next item is ready before it is asked for.
        if number and not json.loads(requests.readline() or "{}").get("next"):
            sandbox.send(answers, {"end": True})
            return
        try:
            sandbox.send(answers, message, arrays)
        except sandbox.BrokenWire as error:
            text = f"{arguments[1]}: says more of itself than a file may ({error}); copy it again, or leave it out"
            sandbox.send(answers, {"error": "BadData", "text": text})
            return


def _replies(function: str, arguments: list[Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    path, source = arguments[:2]
    try:
        sandbox.begin(path)
        found = FUNCTIONS[function](*arguments)
        if not isgenerator(found):
            yield _reply(found)
            return
        for item in found:
            yield _reply(item)
            sandbox.begin(path)
        yield {"end": True}, {}
    except CgidError as error:
        yield {"error": type(error).__name__, "text": str(error)}, {}
    except MemoryError:
        cure = "it is damaged or hostile: copy it again, or leave it out"
        yield {"error": "BadData", "text": f"{source}: reading this file takes more memory than it may; {cure}"}, {}
    except Exception as error:  # whatever h5py makes of a file, it is one line
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        yield {"error": "BadData", "text": f"{source}: is damaged ({reason}); copy it again, or generate it anew"}, {}


def _reply(found: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    if isinstance(found, dict) and found and all(isinstance(value, np.ndarray) for value in found.values()):
        return {}, found
    return {"value": found}, {}


if __name__ == "__main__":
    _main()

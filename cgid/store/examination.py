"""What of a file of ours can still be read: chunk after chunk, each held against its checksum."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py

from cgid.errors import BadData
from cgid.store.chunks import DAMAGE, missing_chunks, storage_fault
from cgid.store.header import FORMAT, RECORDING_FORMAT, TABLE_FORMAT, require_scene
from cgid.store.opening import attributes_of, inner_dataset, opened
from cgid.store.own_reading import read_header, read_recording_header

#: The groups that hold the columns of each kind of file, and what lies beside them.
_COLUMNS = {FORMAT: "parameters", RECORDING_FORMAT: "impacts", TABLE_FORMAT: "columns"}
_BESIDE = {
    FORMAT: ("signals", "labels", "specimen"),
    RECORDING_FORMAT: ("samples",),
    TABLE_FORMAT: ("labels", "specimen"),
}


def examine_file(path: str | Path, steps: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return what can be read of a dataset's file, a recording or a table in HDF5.

    Parameters
    ----------
    path : str or Path
    steps : dict of int, optional
        How many rows of which dataset are looked at together, to compare with another file; by default its own chunks.

    Returns
    -------
    dict
        Nothing but numbers, texts, lists and dicts, so that a process of its own can find it out:

        fault : str
            Why nothing of it can be read, "" if its headers are sound.
        attributes : dict
            Those of the root.
        filters : list of int
            HDF5's numbers of the filters of the signals or samples.
        dtype : str
            Of the signals or samples.
        chunks : dict
            Name of each dataset -> list of (first row, row behind the last, SHA-256 of the values; "" where they do not
            fit their checksum).
    """
    found: dict[str, Any] = {"fault": "", "attributes": {}, "filters": [], "dtype": "", "chunks": {}}
    try:
        with opened(str(path), str(path)) as file:
            found["attributes"] = attributes_of(file, str(path))
            _require_header(file, str(path), found["attributes"].get("format"))
            require_scene(found["attributes"], str(path))
            size = Path(path).stat().st_size
            for name in _names(file, found["attributes"]["format"]):
                found["chunks"][name] = _examine(inner_dataset(file, name, str(path)), size, (steps or {}).get(name))
            main = file[_BESIDE[found["attributes"]["format"]][0]]
            creation = main.id.get_create_plist()
            found["filters"] = [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]
            found["dtype"] = main.dtype.name
    except BadData as error:
        found["fault"] = str(error)
    return found


def damaged_rows(chunks: Iterable[tuple[int, int, str]]) -> list[tuple[int, int]]:
    """Return the rows that cannot be read, as (first, behind the last) of each run of them.

    Examples
    --------
    >>> damaged_rows([(0, 4, ""), (4, 8, ""), (8, 12, "5e1f"), (12, 14, "")])
    [(0, 8), (12, 14)]
    """
    runs: list[tuple[int, int]] = []
    for first, behind, digest in chunks:
        if digest:
            continue
        if runs and runs[-1][1] == first:
            runs[-1] = (runs[-1][0], behind)
        else:
            runs.append((first, behind))
    return runs


def _require_header(file: h5py.File, path: str, kind: Any) -> None:
    if kind == FORMAT:
        read_header(file, path, inner_dataset)
    elif kind == RECORDING_FORMAT:
        read_recording_header(file, path, inner_dataset)
    elif kind != TABLE_FORMAT:
        raise BadData(f"{path}: this HDF5 file must be a dataset, a recording or a table of cgid; it is none")


def _names(file: h5py.File, kind: str) -> list[str]:
    group = _COLUMNS[kind]
    columns = [f"{group}/{name}" for name in file[group]] if file.id.links.exists(group.encode()) else []
    return [*_BESIDE[kind], *columns]


def _examine(item: h5py.Dataset, file_size: int, step: int | None) -> list[tuple[int, int, str]]:
    """Return the runs of rows of a dataset that are read together, and the SHA-256 of each; see `examine_file`."""
    n_rows = item.shape[0]
    step = step or (item.chunks[0] if item.chunks else max(n_rows, 1))
    if storage_fault(item, file_size) or missing_chunks(item):
        return [(0, n_rows, "")]
    return [
        (first, min(first + step, n_rows), _digest(item, slice(first, first + step)))
        for first in range(0, n_rows, step)
    ]


def _digest(item: h5py.Dataset, rows: slice) -> str:
    try:
        return hashlib.sha256(item[rows].tobytes()).hexdigest()
    except DAMAGE:
        return ""

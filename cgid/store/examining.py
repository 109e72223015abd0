"""What the reading process finds out of a file of ours that may be damaged: what can still be read, chunk by chunk."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import h5py

from cgid.errors import BadData
from cgid.store import limits, own_reading
from cgid.store.chunks import DAMAGE, chunk_bytes
from cgid.store.header import FORMAT, RECORDING_FORMAT, TABLE_FORMAT
from cgid.store.opening import attributes_of, bytes_of, members, opened, plain_dataset

#: The groups that hold the columns of each kind of file, and what lies beside them, the most important first.
_COLUMNS = {FORMAT: "parameters", RECORDING_FORMAT: "impacts", TABLE_FORMAT: "columns"}
_BESIDE = {
    FORMAT: ("signals", "labels", "specimen"),
    RECORDING_FORMAT: ("samples",),
    TABLE_FORMAT: ("labels", "specimen"),
}
_HEADERS = {
    FORMAT: own_reading.shard_header,
    RECORDING_FORMAT: own_reading.recording_header,
    TABLE_FORMAT: own_reading.table_header,
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
        limits.allow(3 * (step * bytes_of(dataset) + chunk_bytes(dataset)))
        yield [
            (start, min(start + step, n_rows), _digest(dataset, slice(start, start + step)))
            for start in starts[first : first + _TOGETHER]
        ]


def _digest(dataset: h5py.Dataset, rows: slice) -> str:
    try:
        return hashlib.sha256(dataset[rows].tobytes()).hexdigest()
    except DAMAGE:
        return ""

"""What of a file of ours can still be read: chunk after chunk, each held against its checksum."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cgid.errors import BadData
from cgid.store import apart

#: By HDF5's numbers of filters; see `cgid.store.compression`.
_COMPRESSIONS = {1: "gzip", 32015: "zstd", 32026: "blosc2"}


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
        fault : str
            Why it cannot be read, "" if its headers are sound.
        attributes : dict
            Those of the root.
        filters : list of int
            HDF5's numbers of the filters of the signals or samples.
        dtype : str
            Of the signals or samples.
        n_samples : int
            Of a signal, or of the recording.
        chunks : dict
            Name of each dataset -> list of (first row, row behind the last, SHA-256 of the values; "" where they do not
            fit their checksum).
    """
    found: dict[str, Any] = {"fault": "", "attributes": {}, "filters": [], "dtype": "", "n_samples": 0, "chunks": {}}
    try:
        for piece in apart.stream("examine", Path(path), dict(steps or {})):
            if "name" in piece:
                found["chunks"].setdefault(piece["name"], []).extend(map(tuple, piece["chunks"]))
            else:
                found.update(piece)
    except BadData as error:
        found["fault"] = str(error)
    return found


def damaged_rows(chunks: Iterable[Sequence[Any]]) -> list[tuple[int, int]]:
    """Return the rows that cannot be read, as (first, behind the last) of each run of them.

    Parameters
    ----------
    chunks : iterable of (int, int, str)
        As of `examine_file`.

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


def compression_of(examined: Mapping[str, Any]) -> str:
    """Return how the signals of a file are compressed that `examine_file` has looked at."""
    return next((_COMPRESSIONS[code] for code in examined["filters"] if code in _COMPRESSIONS), "none")


def examine_whole(path: Path, kind: str) -> dict[str, Any]:
    """Return what `examine_file` does of a file that a run is to leave as it is.

    Raises
    ------
    BadData
        It is not whole, or of another kind than the format `kind`.
    NoInput
        It cannot be read.
    """
    examined = examine_file(path)
    if examined["fault"] and not apart.is_hdf5(path):
        raise BadData(f"{path}: is there and is no {kind}; choose another name")
    if examined["fault"] or any(damaged_rows(chunks) for chunks in examined["chunks"].values()):
        raise BadData(f"{path}: is there and is not whole; make it again with --overwrite, without --resume")
    if examined["attributes"].get("format") != kind:
        raise BadData(f"{path}: is there and is no {kind}; choose another name, or replace it with --overwrite")
    return examined

"""Reading a table, whole; nothing is believed before it is checked."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, MissingExtra, NoInput
from cgid.store import apart
from cgid.store.digest import is_sound
from cgid.store.header import TABLE_FORMAT, TABLE_VERSION, require_scene, require_schema, text_of
from cgid.store.identity import Identity
from cgid.store.table import Table, TableHeader, parquet_library

#: What a table says of itself, in whichever format.
_SAYS_SO = f'"format": "{TABLE_FORMAT}"'.encode()
#: No footer of a table is longer [bytes].
_LARGEST_FOOTER = 1 << 24
#: Rows that are read at once, at most.
_ROWS = 1 << 14
#: What readers raise on damaged files.
_DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError)


def read_table(path: str | Path) -> Table:
    """Return a table that `cgid generate --features-only` or its siblings have written.

    Raises
    ------
    NoInput
        There is no such file.
    BadData
        It is no such table, or damaged.
    MissingExtra
        It is a Parquet file, and the library is not installed.
    """
    if not Path(path).is_file():
        raise NoInput(f"{path}: no such file; give a table made by cgid generate --features-only")
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".csv":
            return _read_csv(path)
        if suffix == ".parquet":
            return _read_parquet(path)
        return _read_hdf5(path)
    except (BadData, MissingExtra):
        raise
    except _DAMAGE as error:
        raise _damaged(path, error) from None


def _damaged(path: str | Path, error: Exception) -> BadData:
    """Return what to raise where a library says, on several lines perhaps, why it cannot read a table."""
    return BadData(
        f"{path}: must be a whole table of cgid, it is damaged ({' '.join(str(error).split())}); make it again"
    )


def is_table(path: str | Path) -> bool:
    """Return whether a file says that it is a table of cgid; False for what cannot be read."""
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".parquet":
            return _is_own_parquet(path)
        if suffix == ".csv":
            with Path(path).open("rb") as stream:
                return _SAYS_SO in stream.read(200)
        return apart.format_said(Path(path)) == TABLE_FORMAT
    except _DAMAGE:
        return False


def _read_hdf5(path: str | Path) -> Table:
    identity = Identity(Path(path))
    about = apart.call("table_header", Path(path))
    header = TableHeader(kind=about["kind"], units=about["units"], attributes=about["attributes"])
    names = ["labels", "specimen", *(f"columns/{name}" for name in header.units)]
    length = max(1, min(_ROWS, apart.LARGEST_ANSWER // about["row_bytes"]))
    parts = list(apart.stream("rows", Path(path), names, 0, about["n_rows"], length))
    identity.require()
    stored = {name: np.concatenate([part[name] for part in parts]) for name in names}
    columns = {name: stored[f"columns/{name}"] for name in header.units}
    return _checked(path, header, text_of(stored["labels"]), stored["specimen"], columns)


def _is_own_parquet(path: str | Path) -> bool:
    """Return whether the footer of a Parquet file says so; the library need not be there."""
    with Path(path).open("rb") as stream:
        end = stream.seek(-8, os.SEEK_END)
        size, magic = struct.unpack("<I4s", stream.read(8))
        if magic != b"PAR1":
            return False
        stream.seek(max(end - min(size, _LARGEST_FOOTER), 0))
        return _SAYS_SO in stream.read(_LARGEST_FOOTER)


def _read_csv(path: str | Path) -> Table:
    import pandas

    with Path(path).open(encoding="utf-8") as stream:
        header = _header_of(path, stream.readline().removeprefix("# "))
        types = {"label": str, "specimen": np.uint64} | dict.fromkeys(header.units, np.float64)
        empty = {n: [""] for n in header.units}
        # Before 3.1 pandas misreads the last digit of a number now and then unless asked; later it warns when asked.
        exact = {"float_precision": "round_trip"} if np.lib.NumpyVersion(pandas.__version__) < "3.1.0" else {}
        frame = pandas.read_csv(stream, dtype=types, keep_default_na=False, na_values=empty, **exact)
    columns = {str(name): frame[name].to_numpy() for name in frame.columns}
    return _checked(path, header, columns.pop("label").astype(str), columns.pop("specimen"), columns)


def _read_parquet(path: str | Path) -> Table:
    arrow, parquet = parquet_library()
    try:
        return _read_pages(path, parquet)
    except arrow.ArrowException as error:
        raise _damaged(path, error) from None


def _read_pages(path: str | Path, parquet: Any) -> Table:
    with parquet.ParquetFile(path, page_checksum_verification=True) as file:
        header = _header_of(path, (file.schema_arrow.metadata or {}).get(b"cgid", b"").decode())
        table = file.read()
    columns = {name: table[name].to_numpy() for name in table.column_names}
    return _checked(path, header, np.array(columns.pop("label"), str), columns.pop("specimen"), columns)


def _header_of(path: str | Path, text: str) -> TableHeader:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or content.get("format") != TABLE_FORMAT:
        raise BadData(f"{path}: must begin with what cgid says of its tables; this is another file")
    require_schema(str(path), content.get("schema_version"), TABLE_VERSION)
    units, attributes = content.get("units"), content.get("attributes")
    if not isinstance(units, dict) or not isinstance(attributes, dict):
        raise BadData(f"{path}: must say its units and attributes, it does not; make it again")
    require_scene(str(path), attributes)
    # Older tables have no digest.
    if "digest" in content and not is_sound(content):
        raise BadData(f"{path}: what it says of itself must fit its SHA-256, it does not: it is damaged; make it again")
    return TableHeader(kind=str(content.get("kind")), units=units, attributes=attributes)


def _checked(
    path: str | Path, header: TableHeader, labels: Any, specimen: Any, columns: Mapping[str, NDArray[Any]]
) -> Table:
    if set(columns) != set(header.units) or {len(c) for c in (labels, specimen, *columns.values())} != {len(labels)}:
        raise BadData(f"{path}: must hold all columns that it names, all of one length; make it again")
    if header.attributes.get("n_signals", len(labels)) != len(labels):
        raise BadData(
            f"{path}: must hold {header.attributes['n_signals']} rows as it says, it has {len(labels)}; make it again"
        )
    numbers = {name: np.asarray(columns[name], np.float64) for name in header.units}
    return Table(header=header, labels=labels, specimen=np.asarray(specimen, np.uint64), columns=numbers)

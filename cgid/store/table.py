"""Tables of labelled rows in HDF5, Parquet or CSV: written batch by batch, read at once; and tables of any columns."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.files import check_new, clear_half_written, whole_file
from cgid._lib.terminal import spreadsheet_cell, text_of_cell
from cgid.errors import BadData, InvalidValue, MissingExtra, NoInput, optional
from cgid.store.description import (
    DAMAGE,
    TABLE_FORMAT,
    TABLE_VERSION,
    hdf5_format,
    is_sound,
    require_scene,
    require_schema,
    sealed,
    text_of,
)
from cgid.units import column_title

#: Rows written and read at once, at least.
_ROWS = 16384
TABLE_SUFFIXES = (".h5", ".hdf5", ".parquet", ".csv")
#: Part of the header of every table in any format.
_SAYS_SO = f'"format": "{TABLE_FORMAT}"'.encode()


@dataclass(frozen=True, kw_only=True)
class TableHeader:
    """The header of a table."""

    kind: str  # content of the rows: "features", "closed-form" or "parameters"
    units: Mapping[str, str]  # the columns besides label and specimen, and their units
    attributes: Mapping[str, Any]  # numbers and strings that describe how the data was made

    @property
    def text(self) -> str:
        """The header as one line of JSON, with its SHA-256."""
        head = {"format": TABLE_FORMAT, "schema_version": TABLE_VERSION, "kind": self.kind}
        return json.dumps(sealed(head | {"units": dict(self.units), "attributes": dict(self.attributes)}))


@dataclass(frozen=True, kw_only=True)
class TableRows:
    """Some rows of a table: labels, specimens and each column (n,)."""

    labels: NDArray[np.str_]
    specimen: NDArray[np.uint64]
    columns: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True, kw_only=True)
class Table(TableRows):
    """A complete table with its header.

    Attributes
    ----------
    labels : ndarray of str, (n,)
    specimen : ndarray of uint64, (n,)
    columns : dict of ndarray, each (n,)
    header : TableHeader
        With `kind`, `units` and `attributes`.
    """

    header: TableHeader


def check_table_output(output: str | Path, overwrite: bool = False) -> Path:
    """Return the output as a path if a table may be written there; call this before any work."""
    path = Path(output)
    if path.suffix.lower() not in TABLE_SUFFIXES:
        raise InvalidValue(f"{path}: the name of a table must end in {', '.join(TABLE_SUFFIXES)}; choose such a name")
    if path.suffix.lower() == ".parquet":
        parquet_library()
    return check_new(path, "a table", TABLE_SUFFIXES, overwrite=overwrite)


class TableWriter:
    """A table being written; made by `table_writer`. It passes complete blocks of rows to `write`."""

    def __init__(self, write: Callable[[TableRows], object]) -> None:
        self._write = write
        self._waiting: list[TableRows] = []
        self._n_waiting = 0

    def add(self, rows: TableRows) -> None:
        """Append rows, which must have all columns of the header."""
        self._waiting.append(rows)
        self._n_waiting += len(rows)
        if self._n_waiting >= _ROWS:
            self.finish()

    def finish(self) -> None:
        """Write the pending rows."""
        if self._waiting:
            columns = {
                name: np.concatenate([rows.columns[name] for rows in self._waiting])
                for name in self._waiting[0].columns
            }
            labels, specimen = (
                np.concatenate([getattr(rows, name) for rows in self._waiting]) for name in ("labels", "specimen")
            )
            self._write(TableRows(labels=labels, specimen=specimen, columns=columns))
        self._waiting, self._n_waiting = [], 0


@contextlib.contextmanager
def table_writer(
    path: str | Path, header: TableHeader, label_width: int, *, overwrite: bool = True
) -> Iterator[TableWriter]:
    """Yield the writer of a table; the file has its old content or the complete table."""
    written = {".csv": _written_csv, ".parquet": _written_parquet}.get(Path(path).suffix.lower(), _written_hdf5)
    clear_half_written(Path(path))
    with whole_file(path, overwrite=overwrite) as temporary, written(temporary, header, label_width) as write:
        writer = TableWriter(write)
        yield writer
        writer.finish()


@contextlib.contextmanager
def _written_hdf5(path: Path, header: TableHeader, label_width: int) -> Iterator[Callable[[TableRows], object]]:
    dtypes = {"labels": f"S{label_width}", "specimen": "uint64"}
    dtypes |= {f"columns/{name}": "float64" for name in header.units}
    units = {f"columns/{name}": unit for name, unit in header.units.items()}
    head = {"format": TABLE_FORMAT, "schema_version": TABLE_VERSION, "kind": header.kind}
    with _hdf5_columns(path, dtypes, units, {**header.attributes, **head}) as write:

        def write_rows(rows: TableRows) -> None:
            values: dict[str, Any] = {f"columns/{name}": rows.columns[name] for name in header.units}
            write(values | {"labels": np.char.encode(rows.labels, "utf-8"), "specimen": rows.specimen})

        yield write_rows


@contextlib.contextmanager
def _hdf5_columns(
    path: Path, dtypes: Mapping[str, Any], units: Mapping[str, str], attributes: Mapping[str, Any]
) -> Iterator[Callable[[Mapping[str, Any]], object]]:
    """Yield a function that appends values to columns."""
    from cgid.store.disk import hdf5_on_disk  # reading tables does not need h5py
    from cgid.store.hdf5 import CHUNK_ROWS, put_attributes, put_column

    with hdf5_on_disk(path) as output:
        with output.step() as file:
            put_attributes(file, attributes)
            file.create_group("columns", track_order=True)
            for name, dtype in dtypes.items():
                put_column(file, name, 0, dtype, chunk=CHUNK_ROWS, grows=True)
            for name, unit in units.items():
                put_attributes(file[name], {"unit": unit})

        def write(values: Mapping[str, Any]) -> None:
            with output.step() as file:
                for name, column in values.items():
                    filled = len(file[name])
                    file[name].resize((filled + len(column),))
                    file[name][filled:] = column

        yield write


@contextlib.contextmanager
def _written_csv(path: Path, header: TableHeader, _label_width: int) -> Iterator[Callable[[TableRows], object]]:
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.write(f"# {header.text}\n")
        stream.write(",".join(["label", "specimen", *header.units]) + "\n")

        def write(rows: TableRows) -> None:
            import pandas

            labels = [spreadsheet_cell(label) for label in rows.labels.tolist()]
            columns = {"label": labels, "specimen": rows.specimen}
            frame = pandas.DataFrame(columns | {name: rows.columns[name] for name in header.units})
            frame.to_csv(stream, header=False, index=False, lineterminator="\n")

        yield write


@contextlib.contextmanager
def _written_parquet(path: Path, header: TableHeader, _label_width: int) -> Iterator[Callable[[TableRows], object]]:
    types = {"label": "string", "specimen": "uint64"} | dict.fromkeys(header.units, "float64")
    with _parquet_columns(path, types, {"cgid": header.text}) as write:
        yield lambda rows: write([rows.labels.tolist(), rows.specimen, *(rows.columns[name] for name in header.units)])


@contextlib.contextmanager
def _parquet_columns(
    path: Path, types: Mapping[str, str], metadata: Mapping[str, str]
) -> Iterator[Callable[[Sequence[Any]], object]]:
    """Yield a function that appends a row group, given by its columns."""
    arrow, parquet = parquet_library()
    fields = [(name, arrow.type_for_alias(dtype)) for name, dtype in types.items()]
    schema = arrow.schema(fields, metadata=metadata)
    with parquet.ParquetWriter(path, schema, write_page_checksum=True) as file:
        yield lambda columns: file.write_table(arrow.table(list(columns), schema=schema))


@contextlib.contextmanager
def plain_writer(
    path: Path, suffix: str, types: Mapping[tuple[str, str], str]
) -> Iterator[Callable[[Sequence[Any]], object]]:
    """Yield a function that appends a row to a table of any columns, in Parquet or HDF5."""
    titles = {column_title(name, unit): dtype for (name, unit), dtype in types.items()}
    written = _parquet_columns(path, titles, {}) if suffix == ".parquet" else _plain_hdf5(path, types)
    rows: list[Sequence[Any]] = []
    with written as write:

        def add(row: Sequence[Any]) -> None:
            rows.append(row)
            if len(rows) == _ROWS:
                write(list(zip(*rows, strict=True)))
                rows.clear()

        yield add
        if rows:
            write(list(zip(*rows, strict=True)))


@contextlib.contextmanager
def _plain_hdf5(path: Path, types: Mapping[tuple[str, str], str]) -> Iterator[Callable[[Sequence[Any]], object]]:
    from h5py import string_dtype

    missing = {"float64": np.nan, "int64": -1, "bool": False}
    blocks = [[np.empty(0, "S1" if dtype == "string" else dtype)] for dtype in types.values()]

    def write(columns: Sequence[Any]) -> None:
        for column, dtype, parts in zip(columns, types.values(), blocks, strict=True):
            if dtype == "string":
                parts.append(np.array([(value or "").encode() for value in column], "S"))
            else:
                parts.append(np.array([missing[dtype] if value is None else value for value in column], dtype))

    yield write
    titles = [column_title(name, unit) for name, unit in types]
    paths = [f"columns/{title.replace('/', '|')}" for title in titles]  # a slash would make a group
    joined = dict(zip(paths, map(np.concatenate, blocks), strict=True))
    units = {path_: unit for path_, (_name, unit) in zip(paths, types, strict=True) if unit}
    # Else HDF5 takes texts for ASCII.
    joined |= {
        path_: column.astype(string_dtype("utf-8", column.itemsize))
        for path_, column in joined.items()
        if column.dtype.kind == "S"
    }
    with _hdf5_columns(path, {path_: column.dtype for path_, column in joined.items()}, units, {}) as append:
        append(joined)


def parquet_library() -> tuple[Any, Any]:
    """Return pyarrow and its Parquet module; raises `MissingExtra`."""
    arrow, parquet = (
        optional(name, "Parquet files need", "parquet", name="pyarrow", hint=", or choose .h5 or .csv")
        for name in ("pyarrow", "pyarrow.parquet")
    )
    return arrow, parquet


def read_table(path: str | Path) -> Table:
    """Return a table written by `cgid generate --features-only` or its siblings.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Table

    Raises
    ------
    NoInput
        The file does not exist.
    BadData
        It is damaged or not such a table.
    MissingExtra
        It is a Parquet file and the library is not installed.
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
    except DAMAGE as error:
        raise _damaged(path, error) from None


def _damaged(path: str | Path, error: Exception) -> BadData:
    """Return the error for a table that a library cannot read, with its message in one line."""
    return BadData(
        f"{path}: must be a complete table of cgid, it is damaged ({' '.join(str(error).split())}); make it again"
    )


def is_table(path: str | Path) -> bool:
    """Return whether a file has the header of a cgid table; False if it cannot be read."""
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".parquet":
            _, parquet = parquet_library()
            return _SAYS_SO in (parquet.read_schema(path).metadata or {}).get(b"cgid", b"")
        if suffix == ".csv":
            with Path(path).open("rb") as stream:
                return _SAYS_SO in stream.read(200)
        return hdf5_format(Path(path)) == TABLE_FORMAT
    except (*DAMAGE, MissingExtra):
        return False


def _read_hdf5(path: str | Path) -> Table:
    from cgid.store.gates import opened  # these load h5py
    from cgid.store.headers import rows, table_header
    from cgid.store.reading import state_of

    file = Path(path)
    state = state_of(file)
    with opened(file, str(path), state) as stored:
        about = table_header(stored, str(path))
    header = TableHeader(kind=about["kind"], units=about["units"], attributes=about["attributes"])
    names = ["labels", "specimen", *(f"columns/{name}" for name in header.units)]
    parts = list(rows(file, names, 0, about["n_rows"], _ROWS, state))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in names}
    columns = {name: joined[f"columns/{name}"] for name in header.units}
    return _checked(path, header, text_of(joined["labels"]), joined["specimen"], columns)


def _read_csv(path: str | Path) -> Table:
    import pandas

    with Path(path).open(encoding="utf-8") as stream:
        header = _header_of(path, stream.readline().removeprefix("# "))
        types = {"label": str, "specimen": np.uint64} | dict.fromkeys(header.units, np.float64)
        empty = {n: [""] for n in header.units}
        # Without this option pandas before 3.1 may misread the last digit of a number; later versions warn of it.
        exact = {"float_precision": "round_trip"} if np.lib.NumpyVersion(pandas.__version__) < "3.1.0" else {}
        frame = pandas.read_csv(stream, dtype=types, keep_default_na=False, na_values=empty, **exact)
    columns = {str(name): frame[name].to_numpy() for name in frame.columns}
    labels = np.array([text_of_cell(label) for label in columns.pop("label").tolist()], str)
    return _checked(path, header, labels, columns.pop("specimen"), columns)


def _read_parquet(path: str | Path) -> Table:
    arrow, parquet = parquet_library()
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            header = _header_of(path, (file.schema_arrow.metadata or {}).get(b"cgid", b"").decode())
            table = file.read()
    except arrow.ArrowException as error:
        raise _damaged(path, error) from None
    columns = {name: table[name].to_numpy() for name in table.column_names}
    return _checked(path, header, np.array(columns.pop("label"), str), columns.pop("specimen"), columns)


def _header_of(path: str | Path, text: str) -> TableHeader:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or content.get("format") != TABLE_FORMAT:
        raise BadData(f"{path}: must begin with the header of a cgid table; this is another file")
    require_schema(str(path), content.get("schema_version"), TABLE_VERSION)
    units, attributes = content.get("units"), content.get("attributes")
    if not isinstance(units, dict) or not isinstance(attributes, dict):
        raise BadData(f"{path}: must state units and attributes, it does not; make it again")
    require_scene(str(path), attributes)
    if not is_sound(content):
        raise BadData(f"{path}: the header must match its SHA-256, it is damaged; make it again")
    return TableHeader(kind=str(content.get("kind")), units=units, attributes=attributes)


def _checked(
    path: str | Path, header: TableHeader, labels: Any, specimen: Any, columns: Mapping[str, NDArray[Any]]
) -> Table:
    if set(columns) != set(header.units) or {len(c) for c in (labels, specimen, *columns.values())} != {len(labels)}:
        raise BadData(f"{path}: must have all columns of its header, all of one length; make it again")
    if header.attributes.get("n_signals", len(labels)) != len(labels):
        raise BadData(
            f"{path}: must have {header.attributes['n_signals']} rows as declared, got {len(labels)}; make it again"
        )
    numbers = {name: np.asarray(columns[name], np.float64) for name in header.units}
    return Table(header=header, labels=labels, specimen=np.asarray(specimen, np.uint64), columns=numbers)

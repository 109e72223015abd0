"""The table that a command prints: CSV on stdout, which pandas reads without arguments, or one file."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, NamedTuple

import click

from cgid._lib.terminal import counted, spreadsheet_cell
from cgid._lib.validation import finite
from cgid.cli.options import OUTPUT, overwrite_option
from cgid.cli.output import say
from cgid.errors import BadData
from cgid.units import Column

#: Suffixes of table files.
ENDINGS = (".csv", ".jsonl", ".parquet", ".h5", ".hdf5")
#: Maximum line of JSON that is read as a row [characters].
_MAX_LINE_LENGTH = 1 << 20
#: Upper bound of the length of the first column names in CSV [characters].
_MAX_HEAD_LENGTH = 40


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for the file of the table."""
    ends = ", ".join(ENDINGS[:-1])
    description = f"Write the table to this file ({ends}) instead of stdout (-)."
    return click.option("-o", "--output", type=OUTPUT, metavar="FILE", help=description)(overwrite_option(command))


class TableOutput(AbstractContextManager["TableOutput"]):
    """A table on stdout, or in a file, which is written when the context ends without an error."""

    def __init__(self, output: str | None = None, *, overwrite: bool = False, as_json: bool = False) -> None:
        self.columns: tuple[Column, ...] = ()
        self._titles: list[str] = []
        self._path = None if output in (None, "-") else Path(str(output))
        self._overwrite, self._files = overwrite, ExitStack()
        self._write: Callable[[list[Any]], object] | None = None
        if self._path is not None:
            from cgid._lib.files import check_new

            if as_json:
                raise click.UsageError("--json prints lines of several kinds, -o writes one table; give one of them")
            check_new(self._path, "a table", ENDINGS, overwrite=overwrite)
            if self._path.suffix.lower() == ".parquet":
                from cgid.store.table import parquet_library

                parquet_library()

    @property
    def is_file(self) -> bool:
        """Whether the table is a file, not on stdout."""
        return self._path is not None

    def begin(self, columns: Iterable[Column]) -> list[Column]:
        """Set the columns if none are set yet; return those of these that the table lacks."""
        new_columns = tuple(columns)
        if not self.columns:
            self.columns = new_columns
            self._titles = [column.title for column in new_columns]
        return [column for column in new_columns if column not in self.columns]

    def add(self, row: Mapping[str, Any]) -> None:
        """Write a row, given by the titles of its columns; missing ones are empty."""
        if self._write is None:
            self._write = self._opened()
        self._write([_plain(row.get(title)) for title in self._titles])

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is None and self.columns and self._write is None:
            with self._files:
                self._opened()  # no rows, but the columns
        else:
            self._files.__exit__(kind, error, at)
        if error is None and self.columns and self._path is not None:
            say(f"wrote {self._path}", err=True)

    def _opened(self) -> Callable[[list[Any]], object]:
        """Write the head of the table, and return the function that writes a row."""
        titles, columns = self._titles, self.columns
        if self._path is None:
            return _csv_writer(_print_line, columns)
        from cgid._lib.files import clear_half_written, whole_file

        clear_half_written(self._path)
        file = self._files.enter_context(whole_file(self._path, overwrite=self._overwrite))
        suffix = self._path.suffix.lower()
        if suffix not in (".csv", ".jsonl"):
            from cgid.store.table import plain_writer

            types = {(column.name, column.unit): column.dtype for column in columns}
            return self._files.enter_context(plain_writer(file, suffix, types))
        stream = self._files.enter_context(file.open("w", encoding="utf-8", newline=""))
        if suffix == ".jsonl":
            return lambda row: stream.write(json.dumps(finite(dict(zip(titles, row, strict=True)))) + "\n")
        return _csv_writer(lambda line: stream.write(line + "\n"), columns)


class WrittenTable(NamedTuple):
    """A table written by `cgid predict` or `cgid features`: type of its rows, columns, and number of rows."""

    kind: str
    columns: list[str]
    n_rows: int


#: First columns of these tables.
_HEAD = ("source", "channel", "time_s")


def written_table(path: str) -> WrittenTable | None:
    """Return the content of a table of answers or features, read to its end; None for any other file."""
    readers = {".csv": _csv_table, ".jsonl": _json_table, ".parquet": _parquet_table}
    readers |= dict.fromkeys((".h5", ".hdf5"), _hdf5_table)
    file = Path(path)
    try:
        read = readers.get(file.suffix.lower()) if file.is_file() else None
        columns, n_rows = ([], 0) if read is None else read(file)
    except OSError:  # opening it later reports the error
        return None
    if not set(_HEAD) <= set(columns):
        return None
    return WrittenTable(f"table of {'answers' if 'novelty' in columns else 'features'}", columns, n_rows)


def _csv_table(file: Path) -> tuple[list[str], int]:
    with file.open(encoding="utf-8", errors="replace", newline="") as stream:
        if not stream.read(_MAX_HEAD_LENGTH).startswith(",".join(_HEAD)):
            return [], 0
        stream.seek(0)
        rows = csv.reader(stream)
        columns, n_rows = next(rows), 0
        try:
            for n_rows, row in enumerate(rows, start=1):
                if len(row) != len(columns):
                    raise _damaged(file, f"row {n_rows} has {counted(len(row), 'cell')} for {len(columns)} columns")
        except csv.Error as error:
            raise _damaged(file, str(error)) from None
    return columns, n_rows


def _json_table(file: Path) -> tuple[list[str], int]:
    columns: list[str] = []
    n_rows = 0
    with file.open(encoding="utf-8", errors="replace") as stream:
        for n_rows, line in enumerate(iter(lambda: stream.readline(_MAX_LINE_LENGTH), ""), start=1):
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                row = None
            if n_rows == 1 and not (isinstance(row, dict) and tuple(row)[:3] == _HEAD):
                return [], 0
            columns = columns or list(row)
            if not isinstance(row, dict) or list(row) != columns:
                raise _damaged(file, f"line {n_rows} is no row of its {len(columns)} columns")
    return columns, n_rows


def _parquet_table(file: Path) -> tuple[list[str], int]:
    from cgid.recordings.parquet import parquet_columns

    return parquet_columns(file, str(file), _HEAD)


def _hdf5_table(file: Path) -> tuple[list[str], int]:
    from cgid.store.description import hdf5_format

    if hdf5_format(file) != "":
        return [], 0
    from cgid.store.foreign import foreign_columns

    return foreign_columns(file, _HEAD)


def _damaged(file: Path, fault: str) -> BadData:
    return BadData(f"{file}: the table must be unchanged, {fault}; write it again")


def _print_line(line: str) -> None:
    """Print one row of CSV; a quoted line break stays one, all else that controls a terminal is escaped."""
    for part in line.split("\n"):
        say(part)


def _csv_writer(put: Callable[[str], object], columns: Sequence[Column]) -> Callable[[list[Any]], None]:
    """Write the titles of a CSV table, and return the function that writes a row, without the end of the line."""
    lines: list[str] = []
    # The writer quotes only those line breaks that end its own lines.
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")

    def put_row(texts: Iterable[str]) -> None:
        writer.writerow(texts)
        put(lines.pop().removesuffix("\r\n"))

    put_row(column.title for column in columns)
    return lambda row: put_row(_cell(column, value) for column, value in zip(columns, row, strict=True))


def _cell(column: Column, value: Any) -> str:
    """Return a value for CSV; empty if missing."""
    if value is None:
        return ""
    if column.dtype == "bool":
        return "true" if value else "false"
    return spreadsheet_cell(value) if isinstance(value, str) else format(value, column.form)


def _plain(value: Any) -> Any:
    """Return a value, None if it is missing; in a file name, bytes that are no text are escaped."""
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()
    return None if value != value else value

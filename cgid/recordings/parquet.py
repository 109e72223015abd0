"""Read Parquet tables by row groups, with pyarrow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import LABELS, Asked, Blocks, Remark, library, library_errors, places_of, stretches
from cgid.recordings.text_layout import ColumnHeader, column_of
from cgid.recordings.times import is_time_name
from cgid.recordings.variables import Value, Variable, contents_of, full_scale_of
from cgid.units import seconds_of

#: Limits of texts [bytes] and lists [entries] in the footer.
_MAX_TEXT_LENGTH, _MAX_LIST_LENGTH = 16 << 20, 1 << 20
#: Bytes of one column of a row group to read at once.
_BUFFER = 1 << 20
#: Rows read at once, of all columns.
_ROWS = 1 << 14
#: Longest metadata value [bytes] that may state a rate or a unit.
_MAX_VALUE_LENGTH = 200
#: Only rows of equal numbers are packed more densely, and they are not a recording.
_MAX_ROWS_A_BYTE = 1000
#: Prefix of the name that pandas gives to an unnamed index.
_INDEX = "__index_level_"


def read_parquet(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the columns of a Parquet file as channels; those without numbers are skipped with a warning."""
    file = _Parquet(path, source)
    warnings, variables, names, label = list[str](), list[Variable](), list[str](), ""
    for name, kind, values in file.columns():
        column = column_of(name)
        if kind == "list":
            raise BadData(
                f"{source}: a row must be one sample of each channel, those of column {name} are whole signals; write "
                "one signal a file, as DataFrame({'x': row}), or the rows as an array NPY"
            )
        if kind == "other":
            warnings.append(Remark(f"column {name} contains no numbers and is skipped"))
            label = name if name.lower() in LABELS else label
        elif name.startswith(_INDEX) and kind == "number":
            warnings.append(Remark(f"column {name} is an index without a name and is left out"))
        else:
            variables.append(_variable(file, name, kind, values, column))
            names.append(name)
    is_time = [one.is_time for one in variables]
    if all(is_time) or not file.n_rows:
        raise BadData(
            f"{source}: a recording must have a column of numbers besides time, there is none; export it again"
        )
    start = [file.first_time(name) for name in names[: is_time.index(True) + 1][-1:]] if any(is_time) else [None]
    blocks = contents_of(variables, {"": file.messages}, source, asked, warnings, group_is_one=True)
    numeric = [name for name, is_one in zip(names, is_time, strict=True) if not is_one]

    def read(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        return file.blocks([numeric[channel] for channel in channels], length)

    def labels() -> Iterator[tuple[int, int, str]]:
        words = list(file.words(label))
        return stretches(zip(places_of(np.arange(len(words)), blocks.gaps).tolist(), words, strict=True))

    if not any(values for _, _, values in file.columns()):  # else a column may have a scale or a start of its own
        blocks = replace(blocks, read=read)
    return replace(blocks, start_time=blocks.start_time or start[0], labels=labels if label else None)


def _variable(file: _Parquet, name: str, kind: str, values: dict[str, Value], column: ColumnHeader) -> Variable:
    is_number = kind == "number"
    if not is_number:
        column = ColumnHeader(unit="s")
    is_time = column.is_named_time or (not column.name and column.has_time_unit)
    return Variable(
        name="time" if is_time and not is_time_name(column.name) else column.name or column.unit,
        n_channels=1,
        n_samples=file.n_rows,
        read=lambda length, channels: file.blocks([name], length),
        # Metadata take precedence over the unit in the name.
        about={**values, **({"unit": column.unit} if column.unit and "unit" not in values else {})},
        full_scale=full_scale_of(file.dtype(name)) if is_number else None,
        is_integer=is_number and file.dtype(name).kind in "iu",
    )


def parquet_columns(path: Path, source: str, first: Sequence[str]) -> tuple[list[str], int]:
    """Return names and number of rows of a table that begins with the columns `first`, read to its end; else none."""
    file = _Parquet(path, source)
    names = [name for name, *_ in file.columns()]
    if names[: len(first)] != [*first]:
        return [], 0
    with file._opened() as rows:
        return names, sum(part.num_rows for part in rows.iter_batches(_ROWS, use_threads=False))


class _Parquet:
    """A table in a file, which is open only during reading."""

    def __init__(self, path: Path, source: str) -> None:
        library("pyarrow", "Parquet files", source, extra="parquet")
        self._path, self._source = path, source
        with self._opened() as file:
            self.n_rows: int = file.metadata.num_rows
            schema = file.schema_arrow
        self._schema = schema
        self.messages = _texts(schema.metadata)
        size = path.stat().st_size
        if self.n_rows > _MAX_ROWS_A_BYTE * size:
            raise BadData(
                f"{source}: the footer declares {self.n_rows} rows in {size} bytes, the file is damaged; copy it again"
            )
        # pyarrow reads neither of two columns of one name.
        twice = next((name for name, count in Counter(schema.names).items() if count > 1), None)
        if twice is not None:
            raise BadData(f"{source}: columns must differ in name, {twice!r} is there twice; rename one")

    def columns(self) -> Iterator[tuple[str, str, dict[str, Value]]]:
        """Yield name, kind ("number", "timestamp", "list" or "other") and metadata of each column."""
        import pyarrow as pa

        for one in self._schema:
            is_number = pa.types.is_integer(one.type) or pa.types.is_floating(one.type)
            is_stamp = pa.types.is_timestamp(one.type) or pa.types.is_duration(one.type)
            is_list = pa.types.is_nested(one.type) and not pa.types.is_struct(one.type)
            kind = "number" if is_number else "timestamp" if is_stamp else "list" if is_list else "other"
            yield one.name, kind, _texts(one.metadata)

    def dtype(self, name: str) -> np.dtype[Any]:
        """Return the type of a column of numbers."""
        dtype: np.dtype[Any] = np.dtype(self._schema.field(name).type.to_pandas_dtype())
        return dtype

    def first_time(self, name: str) -> datetime | None:
        """Return the first timestamp of a column."""
        with self._opened() as file:
            value = next(file.iter_batches(1, columns=[name], use_threads=False)).column(0)[0].as_py()
        return value if isinstance(value, datetime) else None

    def blocks(self, names: Sequence[str], length: int) -> Iterator[NDArray[Any]]:
        """Yield columns, (len(names), at most `length`), float32 or float64; timestamps in s from the first."""
        done, origins = 0, dict[str, int]()
        with self._opened() as file:
            for batch in file.iter_batches(length, columns=list(dict.fromkeys(names)), use_threads=False):
                rows = [_numbers(batch.column(name), origins, name) for name in names]
                done += batch.num_rows
                yield np.stack(rows)
        if done != self.n_rows:
            raise BadData(
                f"{self._source}: the footer declares {self.n_rows} rows, the file contains {done}; copy it again"
            )

    def words(self, name: str) -> Iterator[str]:
        """Yield the texts of a column, "" without one."""
        with self._opened() as file:
            for batch in file.iter_batches(_ROWS, columns=[name], use_threads=False):
                yield from (str(value or "").strip() for value in batch.column(name).to_pylist())

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        import pyarrow.parquet as pq

        with (
            library_errors(self._source, "the Parquet file is cut off or damaged"),
            # An open file, because pyarrow takes no name that is not UTF-8.
            self._path.open("rb") as content,
            pq.ParquetFile(
                content,
                buffer_size=_BUFFER,
                pre_buffer=False,
                thrift_string_size_limit=_MAX_TEXT_LENGTH,
                thrift_container_size_limit=_MAX_LIST_LENGTH,
                page_checksum_verification=True,
            ) as file,
        ):
            yield file


def _numbers(column: Any, origins: dict[str, int], name: str) -> NDArray[Any]:
    import pyarrow as pa

    if pa.types.is_timestamp(column.type) or pa.types.is_duration(column.type):
        if column.null_count:
            return np.full(len(column), np.nan)
        counts = column.cast(pa.int64()).to_numpy()
        origin = origins.setdefault(name, int(counts[0]) if len(counts) else 0)
        seconds: NDArray[np.float64] = (counts - origin) * (seconds_of(column.type.unit) or 1.0)
        return seconds
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)


def _texts(metadata: dict[bytes, bytes] | None) -> dict[str, Value]:
    """Return the metadata values that are short, as text."""
    return {
        key.decode("utf-8", "replace"): value.decode("utf-8", "replace")
        for key, value in (metadata or {}).items()
        if len(value) <= _MAX_VALUE_LENGTH
    }

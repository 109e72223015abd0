"""The rows of a text file, read by numpy's parser and gone through by line only where that one fails."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.layout import Layout, is_comment

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Body:
    """The rows of a text: where they begin and how they are divided."""

    data: bytes
    encoding: str
    start: int
    first_line: int
    layout: Layout

    def lines(self) -> Iterator[str]:
        """Return the lines from the first row on, each with a line feed as its end."""
        file = io.BytesIO(self.data)
        file.seek(self.start)
        return io.TextIOWrapper(file, encoding=self.encoding)


def load_rows(body: Body, source: str) -> Floats:
    """Return all rows as numbers, (n_samples, n_columns).

    Raises
    ------
    BadData
        A row has more or fewer fields than the first, or a field is no finite number; sample and line are named.
    """
    rows = _parsed_at_once(body)
    if rows is None or not np.isfinite(rows).all():
        # Going through the lines either finds the fault or leaves out what numpy's parser stumbled over.
        rows = np.loadtxt(_checked_rows(body, source), comments=None, ndmin=2)
    return rows


def _parsed_at_once(body: Body) -> Floats | None:
    layout = body.layout
    if layout.decimal_comma and body.data.find(b".", body.start) >= 0:
        return None
    delimiter, exchange = layout.parser()
    exchange = {old: new for old, new in exchange.items() if body.data.find(old.encode(), body.start) >= 0}
    data = body.data
    if exchange:
        data = data.translate(bytes.maketrans("".join(exchange).encode(), "".join(exchange.values()).encode()))
    comments = "#" if data.find(b"#", body.start) >= 0 else None
    try:
        rows = np.loadtxt(replace(body, data=data).lines(), delimiter=delimiter, comments=comments, ndmin=2)
    except ValueError:
        return None
    if rows.shape[1] != layout.n_columns:
        return None
    # Exchanged for blanks, an empty field leaves no trace but its delimiter.
    lost = delimiter is None and layout.trailing
    if lost and body.data.count((layout.delimiter or "").encode(), body.start) != rows.size:
        return None
    return rows


def _checked_rows(body: Body, source: str) -> Iterator[str]:
    sample = 0
    for number, line in enumerate(body.lines(), body.first_line):
        if is_comment(line):
            continue
        text = line.partition("#")[0]
        fields = body.layout.fields(text)
        # The very last line is the only one that may lack its end.
        cut = "" if line.endswith("\n") else "; the file looks cut off"
        if len(fields) != body.layout.n_columns:
            ending = cut if len(fields) < body.layout.n_columns else ""
            raise BadData(
                f"{source}: every row must have {body.layout.n_columns} fields as the first one has, sample {sample} "
                f"(line {number}) has {len(fields)}{ending}; repair or cut the recording there"
            )
        values = [body.layout.number(field) for field in fields]
        for column, (field, value) in enumerate(zip(fields, values, strict=True), 1):
            if value is None or not math.isfinite(float(value)):
                raise BadData(
                    f"{source}: every field must be a finite number, sample {sample} (line {number}) column {column} "
                    f"is {_shown(field)}{cut if value is None else ''}; repair or cut the recording there"
                )
        yield " ".join(filter(None, values))
        sample += 1


def _shown(field: str) -> str:
    return repr(field[:40]) if field else "empty"

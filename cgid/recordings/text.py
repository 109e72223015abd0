"""Text files: encoding, the first row and the layout are found out, then header, rows and time are put together."""

from __future__ import annotations

import io
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np

from cgid.errors import BadData
from cgid.recordings.contents import MAX_CHANNELS, Contents, rates_agree
from cgid.recordings.header import Column, Header, read_header
from cgid.recordings.layout import Layout, is_comment, layout_of
from cgid.recordings.rows import Body, Floats, load_rows
from cgid.recordings.time_axis import rate_of, seconds, time_column

# Bytes that no text holds: all controls but tab, line and page breaks, and the end mark of DOS.
_CONTROLS = bytes(set(range(32)) - set(b"\t\n\v\f\r\x1a") | {127})


def read_text(path: Path, source: str, variable: str | None) -> Contents:
    r"""Return the channels of a text file, with what its header and its time column say.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        Not used: such a file holds one recording.

    Raises
    ------
    BadData
        It is no text or holds no numbers; a row is uneven, cut off, or has a field that is no finite number
        (sample and line are named); the time column is not even or contradicts the stated sampling rate.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "hit.csv"
    ...     _ = file.write_text("t [ms];force (N)\n0,0;1,5\n0,5;2,5\n")
    ...     contents = read_text(file, "hit.csv", None)
    >>> contents.n_samples, contents.units, contents.sampling_rate
    (2, ['N'], 2000.0)
    """
    data, encoding = _decoded(path.read_bytes(), source)
    header, body = _found(data, encoding, source)
    if body.layout.n_columns > MAX_CHANNELS:
        raise BadData(
            f"{source}: at most {MAX_CHANNELS} columns, line {body.first_line} has {body.layout.n_columns}; "
            "transpose it: one sample a row, one channel a column"
        )
    return _assembled(header, load_rows(body, source), source)


def _decoded(raw: bytes, source: str) -> tuple[bytes, str]:
    data, encoding = raw.removeprefix(b"\xef\xbb\xbf"), "utf-8"
    try:
        if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
            data = raw.decode("utf-16").encode()
        elif not data.isascii():
            data.decode()
    except UnicodeDecodeError:
        encoding = "latin-1"
    # What is left undecoded of UTF-16 holds NUL bytes.
    if b"\0" in data or len(data[:65536].translate(None, _CONTROLS)) < len(data[:65536]):
        raise BadData(f"{source}: the file is neither text, NPY nor WAV; export it as one of these")
    return data.rstrip(b"\x1a"), encoding


def _found(data: bytes, encoding: str, source: str) -> tuple[Header, Body]:
    above: deque[str] = deque()
    start, layout = 0, None
    # newline="" keeps the line ends, so that the bytes above the first row can be counted.
    lines = io.TextIOWrapper(io.BytesIO(data), encoding=encoding, newline="")
    for line in lines:
        layout = None if is_comment(line) else layout_of(line)
        if layout is not None:
            break
        above.append(line)
        start += len(line.encode(encoding))
    if layout is None:
        raise BadData(f"{source}: a recording must hold numbers, no line of the text does; export it again")
    layout = _settled(layout, line, next(lines, line), above, data, start)
    while above and _is_damaged_row(above[-1], layout):
        start -= len(above.pop().encode(encoding))
    body = Body(data=data, encoding=encoding, start=start, first_line=len(above) + 1, layout=layout)
    header = read_header(above, layout)
    _refuse_doubtful_comma(body, header, line, above, source)
    return header, body


def _settled(layout: Layout, first: str, second: str, above: deque[str], data: bytes, start: int) -> Layout:
    """Return the layout of the first row, corrected by what the other lines show."""
    if layout.trailing:
        wider = replace(layout, n_columns=layout.n_columns + 1, trailing=False)
        named = read_header(above, wider).columns
        # An empty last field is a missing number if other rows have one there or the header names it.
        if (named and named[-1].name) or wider.fields(second)[-1]:
            layout = wider
    divided = layout.delimiter not in (",", ", ") and (layout.n_columns > 1 or layout.trailing)
    if divided and data.find(b",", start) >= 0:
        layout = replace(layout, decimal_comma=True)
    return layout


def _is_damaged_row(line: str, layout: Layout) -> bool:
    """Return whether a line above the first row begins with a number as a row does, and breaks off into text."""
    fields = layout.fields(line)
    # "2000 samples" above two columns of blanks is a remark.
    least = 3 if layout.delimiter is None else 2
    is_row = len(fields) == layout.n_columns >= least and not is_comment(line)
    return is_row and layout.number(fields[0]) is not None


def _refuse_doubtful_comma(body: Body, header: Header, first: str, above: deque[str], source: str) -> None:
    if body.layout.delimiter != "," or body.layout.n_columns != 2 or header.columns:
        return
    whole, part = body.layout.fields(first)
    single = read_header(above, replace(body.layout, delimiter=None, n_columns=1)).columns
    names_one = bool(single) and single[0].known_unit is not None
    if whole.lstrip("+-").isdigit() and part.isdigit() and (names_one or (len(part) > 1 and part.startswith("0"))):
        raise BadData(
            f"{source}: the comma of {first.strip()[:40]!r} may divide columns or decimals; "
            "write decimal points, or name both columns in a header"
        )


def _assembled(header: Header, rows: Floats, source: str) -> Contents:
    columns = header.columns
    at = time_column(columns, rows)
    rate, rate_from = header.sampling_rate, "header"
    if at is not None and len(rows) > 1:
        unit = seconds(columns[at] if columns else Column(), source)
        measured = rate_of(rows[:, at] * unit, source)
        if rate is not None and rate > 0 and not rates_agree(measured, rate):
            raise BadData(
                f"{source}: the sampling rate must be one to 0.1 %, the header says {rate:.10g} Hz and the time column "
                f"{measured:.10g} Hz; correct one"
            )
        rate, rate_from = measured, "time column"
    kept = [index for index in range(rows.shape[1]) if index != at]
    if not kept:
        raise BadData(f"{source}: a recording must hold a channel beside time, there is none; export it again")
    named = [columns[index] for index in kept] if columns else []
    units = [column.known_unit or (None if column.unit else header.unit) for column in named]
    return Contents.of_array(
        np.ascontiguousarray(rows.T[kept]),
        names=[column.name for column in named],
        units=units or [header.unit] * len(kept),
        sampling_rate=rate,
        rate_from=rate_from,
    )

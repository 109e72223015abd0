"""Text files: encoding, the first row and the layout are found out, then header, rows and time are put together."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.contents import MAX_CHANNELS, Contents, rates_agree
from cgid.recordings.text.clock_stamps import stamped_layout_of, stamped_moment, with_seconds
from cgid.recordings.text.encodings import SNIFFED, encoding_of
from cgid.recordings.text.header import Column, Header, read_header
from cgid.recordings.text.layout import Layout, is_comment, layout_of
from cgid.recordings.text.rows import PIECE, Body, Floats, with_decimal_mark
from cgid.recordings.text.time_axis import EvenTimes, rate_of, refined_rate, seconds, time_columns

#: What programs call the number of a row, if they call it anything.
_NAMES_OF_COUNTERS = ("", "index", "no", "nr", "n", "i", "sample", "samples", "sample no", "point", "row", "序号")


def read_text(path: Path, source: str, variable: str | None) -> Contents:
    r"""Return the channels of a text file, with what its header and its time column say.

    A file longer than `cgid.recordings.text.rows.PIECE` is read by pieces: its layout and the way its time runs are
    those of the first piece, and each further one is checked as it comes.

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
    with path.open("rb") as file:
        encoding = encoding_of(file.read(SNIFFED), source)
    header, body = _found(path, encoding, source)
    if body.layout.n_columns > MAX_CHANNELS:
        raise BadData(
            f"{source}: at most {MAX_CHANNELS} columns, line {body.first_line} has {body.layout.n_columns}; "
            "transpose it: one sample a row, one channel a column"
        )
    return _assembled(header, body)


def _found(path: Path, encoding: str, source: str) -> tuple[Header, Body]:
    """Return the header and where the rows begin, both from the first piece."""
    with path.open(encoding=encoding, errors="replace") as file:
        piece = file.read(PIECE)
        if file.read(1):
            # The last line of the piece may go on.
            piece = piece[: piece.rfind("\n") + 1] or piece
    above: deque[str] = deque()
    start, layout = 0, None
    lines = _lines(piece)
    line = next(lines, "")
    while line:
        following = next(lines, "")
        layout = None if is_comment(line) else layout_of(line) or stamped_layout_of(line, following)
        if layout is not None:
            break
        above.append(line)
        start += len(line)
        line = following
    if layout is None:
        raise BadData(f"{source}: a recording must hold numbers, no line of the text does; export it again")
    moment = None if layout.stamp is None else stamped_moment(line)
    layout = _settled(layout, following or line, above)
    layout = with_decimal_mark(layout, with_seconds(piece[start:], layout))
    while above and _is_damaged_row(above[-1], layout):
        start -= len(above.pop())
    body = Body(path=path, encoding=encoding, start=start, first_line=len(above) + 1, layout=layout, source=source)
    header = read_header(above, layout)
    if moment is not None:
        header = replace(header, start_time=moment)
    _refuse_doubtful_comma(body, header, line, above)
    return header, body


def _lines(piece: str) -> Iterator[str]:
    # Other than `str.splitlines` at line feeds only, so that lines are counted as the rows are.
    start = 0
    while start < len(piece):
        end = piece.find("\n", start) + 1 or len(piece)
        yield piece[start:end]
        start = end


def _settled(layout: Layout, second: str, above: deque[str]) -> Layout:
    """Return the layout of the first row, corrected by what the other lines show."""
    if layout.trailing:
        wider = replace(layout, n_columns=layout.n_columns + 1, trailing=False)
        named = read_header(above, wider).columns
        # An empty last field is a missing number if other rows have one there or the header names it.
        if (named and named[-1].name) or wider.fields(second)[-1]:
            layout = wider
    return layout


def _is_damaged_row(line: str, layout: Layout) -> bool:
    """Return whether a line above the first row begins with a number as a row does, and breaks off into text."""
    fields = layout.fields(line)
    # "2000 samples" above two columns of blanks is a remark.
    least = 3 if layout.delimiter is None else 2
    is_row = len(fields) == layout.n_columns >= least and not is_comment(line)
    return is_row and layout.number(fields[0]) is not None


def _refuse_doubtful_comma(body: Body, header: Header, first: str, above: deque[str]) -> None:
    if body.layout.delimiter != "," or body.layout.n_columns != 2 or header.columns:
        return
    whole, part = body.layout.fields(first)
    single = read_header(above, replace(body.layout, delimiter=None, n_columns=1)).columns
    names_one = bool(single) and single[0].known_unit is not None
    if whole.lstrip("+-").isdigit() and part.isdigit() and (names_one or (len(part) > 1 and part.startswith("0"))):
        raise BadData(
            f"{body.source}: the comma of {first.strip()[:40]!r} may divide columns or decimals; "
            "write decimal points, or name both columns in a header"
        )


def _assembled(header: Header, body: Body) -> Contents:
    """Return the contents of a text from its header and the rows of its first piece."""
    columns, source = header.columns, body.source
    rows, is_whole = next(body.pieces(()))
    times = time_columns(columns, rows) if body.layout.stamp is None else [body.layout.stamp]
    kept = [index for index in range(rows.shape[1]) if index not in times and not _counts(columns, rows, index)]
    if not kept:
        raise BadData(f"{source}: a recording must hold a channel beside time, there is none; export it again")
    # Whether a channel has gaps matters only to those who ask for it, but times must be whole.
    finite: NDArray[np.bool_] = np.all(np.isfinite(rows), axis=0)
    if not finite[times].all():
        next(body.pieces(times))
    measured = None
    if times and len(rows) > 1:
        measured = _measured_rate(columns, times, rows, None if is_whole else body.last_row(), body)
    rate = _agreed_rate(header.sampling_rates, measured, source)
    if rate is None or not finite[kept].any():
        next(body.pieces(kept))
    named = [columns[index] for index in kept] if columns else []
    units = [column.known_unit or (None if column.unit else header.unit) for column in named]
    about: dict[str, Any] = {
        "names": [column.name for column in named],
        "units": units or [header.unit] * len(kept),
        "sampling_rate": rate,
        "rate_from": "header" if measured is None else "time column",
        "start_time": header.start_time,
    }
    if is_whole and finite.all():
        return Contents.of_array(np.ascontiguousarray(rows.T[kept]), **about)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        picked = [kept[channel] for channel in channels]
        clock = None if measured is None else EvenTimes(measured, source)
        factor = _factor(columns, times[0], body) if times else 1.0
        for piece, _ in body.pieces([*times, *picked]):
            if clock is not None:
                clock.feed(piece[:, times[0]] * factor)
            samples = np.ascontiguousarray(piece.T[picked])
            for first in range(0, len(piece), length):
                yield samples[:, first : first + length]

    return Contents(n_channels=len(kept), blocks=blocks, **about)


def _counts(columns: tuple[Column, ...], rows: Floats, index: int) -> bool:
    """Return whether a column only numbers the rows: named as such, and growing by one."""
    is_named = bool(columns) and columns[index].name.lower().strip(" .:#") in _NAMES_OF_COUNTERS
    with np.errstate(all="ignore"):
        return is_named and len(rows) > 1 and bool((np.diff(rows[:, index]) == 1).all())


def _factor(columns: tuple[Column, ...], at: int, body: Body) -> float:
    """Return the factor from a time column to seconds, which stamps have become already."""
    return 1.0 if at == body.layout.stamp else seconds(columns[at] if columns else Column(), body.source)


def _measured_rate(
    columns: tuple[Column, ...], times: Sequence[int], rows: Floats, last: Floats | None, body: Body
) -> float:
    """Return the sampling rate [Hz] of the time columns, which must agree."""
    rates = []
    for at in times:
        factor = _factor(columns, at, body)
        rate = rate_of(rows[:, at] * factor, body.source)
        rates.append(rate if last is None else refined_rate(rate, rows[0, at] * factor, last[at] * factor))
    for (earlier, a), (later, b) in pairwise(zip(times, rates, strict=True)):
        if not rates_agree(a, b):
            raise BadData(
                f"{body.source}: the sampling rate must be one to 0.1 %, time column {columns[earlier].name!r} gives "
                f"{a:.10g} Hz and {columns[later].name!r} {b:.10g} Hz; export the channels of one rate only"
            )
    return rates[0]


def _agreed_rate(stated: Sequence[float], measured: float | None, source: str) -> float | None:
    """Return the rate [Hz] of the time column, else that of the header; what both say must agree."""
    if not stated:
        return measured
    if measured is None:
        for rate in stated[1:]:
            if min(rate, stated[0]) > 0 and not rates_agree(rate, stated[0]):
                raise BadData(
                    f"{source}: the sampling rate must be one to 0.1 %, the header says {stated[0]:.10g} Hz and "
                    f"{rate:.10g} Hz; correct one"
                )
        return stated[0]
    # Of several statements, such as those before and after decimation, the one that the times bear out is meant.
    if min(stated) > 0 and not any(rates_agree(measured, rate) for rate in stated):
        raise BadData(
            f"{source}: the sampling rate must be one to 0.1 %, the header says {stated[0]:.10g} Hz and the time "
            f"column {measured:.10g} Hz; correct one"
        )
    return measured

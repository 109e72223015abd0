"""Read text files (CSV, TXT, ...): the first piece shows header and layout, numpy parses the rows piece by piece."""

from __future__ import annotations

import io
import math
import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import MAX_CHANNELS, Blocks, Remark, rates_agree, require_one_rate
from cgid.recordings.text_layout import (
    MIXED,
    SNIFFED,
    Column,
    Header,
    Layout,
    encoding_of,
    is_comment,
    layout_of,
    read_header,
    stamped_layout_of,
    stamped_moment,
    with_seconds,
)
from cgid.recordings.times import EvenTimes, Floats, rate_of, refined_rate, runs_evenly, seconds

#: Characters to read at once; the header must end within the first piece.
PIECE = 1 << 20

#: Longest line [characters]: a longer row would have too many channels.
_MAX_LINE_LENGTH = 1 << 18

#: End mark of DOS texts.
_END_MARK = "\x1a"

#: A comma in a row, before any comment.
_COMMA = re.compile(r"^[^#%/\n]*,", re.MULTILINE)

#: Names of columns that only number the rows.
_NAMES_OF_COUNTERS = ("", "index", "no", "nr", "n", "i", "sample", "samples", "sample no", "point", "row", "序号")


def read_text(path: Path, source: str) -> Blocks:
    """Return the channels of a text file, with the statements of its header and its time column."""
    encoding, warnings = encoding_and_end(path, source)
    header, body = _header_and_body(path, encoding, source)
    if body.layout.n_columns > MAX_CHANNELS:
        raise BadData(
            f"{source}: at most {MAX_CHANNELS} columns, line {body.first_line} has {body.layout.n_columns}; "
            "transpose it: one sample a row, one channel a column"
        )
    return replace(assembled(header, body), warnings=warnings)


def encoding_and_end(path: Path, source: str) -> tuple[str, list[str]]:
    """Return the encoding of a text, and a warning if its last line has no end."""
    with path.open("rb") as file:
        encoding = encoding_of(file.read(SNIFFED), source)
        file.seek(max(0, file.seek(0, io.SEEK_END) - 4))
        # UTF-16 has zeros next to the line feed.
        is_ended = file.read().rstrip(b"\0\x1a").endswith((b"\n", b"\r"))
    unended = "the last line has no line end; if the file was cut off, its last row is wrong or rows are missing"
    return encoding, [] if is_ended else [Remark(unended)]


# ---- rows ------------------------------------------------------------------------------------------------------------


class Piece(NamedTuple):
    """Complete lines of rows; `line` is the number of the first; `is_restart`: whether times may restart."""

    text: str
    line: int
    is_last: bool = False
    is_restart: bool = False


@dataclass(frozen=True, kw_only=True)
class Body:
    """The rows of a text file: their start [characters, lines] and their layout."""

    path: Path
    encoding: str
    start: int
    first_line: int
    layout: Layout
    source: str

    def texts(self) -> Iterator[Piece]:
        """Yield the rows as they are written."""
        line = self.first_line
        for text, is_last in whole_lines(self.path, self.encoding, self.source, self.start):
            yield Piece(text, line, is_last)
            line += text.count("\n")

    def pieces(self, times: Sequence[int], samples: Sequence[int] = ()) -> Iterator[tuple[Floats, Piece]]:
        """Yield rows (n, n_columns) in order, and as they are written; raises `BadData` with sample and line."""
        # Times must be finite; in columns of samples nan and inf stand for a lost sample; elsewhere invalid fields
        # become nan.
        needed = [*times, *samples]
        layout, sample, points = self.layout, 0, bool(self.layout.picked)
        comment: tuple[int, str] | None = None
        for piece in self.texts():
            # Comments are allowed after the last row; among the rows they may replace samples.
            without_end = _without_end(piece.text)
            if without_end and comment is not None and not piece.is_restart:
                raise _among_rows(*comment, sample, self.source)
            if comment is None and len(without_end) < len(piece.text):
                comment = piece.line + without_end.count("\n"), piece.text[len(without_end) :].partition("\n")[0]
            text = with_seconds(without_end, layout)
            if not points:
                # The decimal mark is unknown while all numbers are integers.
                layout = with_decimal_mark(layout, text)
            points = points or "." in text
            rows = _parsed_at_once(text, layout) if text else np.empty((0, layout.n_columns))
            if rows is None or len(rows) < n_lines(text) or not np.isfinite(rows[:, needed]).all():
                # Parsing line by line either finds the error or skips the text that numpy could not parse.
                checked = list(_checked_rows(text, layout, times, needed, sample, piece.line, self.source))
                rows = np.loadtxt(checked, comments=None, ndmin=2) if checked else np.empty((0, layout.n_columns))
            yield rows, piece
            sample += len(rows)

    def last_row(self) -> Floats | None:
        """Return the last row, (n_columns,), None if the end of the file does not show it."""
        with self.path.open("rb") as file:
            mark = file.read(2)
            size = file.seek(0, io.SEEK_END)
            # An even offset keeps both bytes of a UTF-16 character together.
            file.seek(max(0, size - 2 * _MAX_LINE_LENGTH) // 2 * 2)
            raw = file.read()
        encoding = self.encoding
        if encoding == "utf-16":
            encoding = "utf-16-le" if mark == b"\xff\xfe" else "utf-16-be"
        text = raw.decode(encoding, "replace")
        for line in reversed(text.replace("\r", "\n").rstrip(_END_MARK).split("\n")):
            if not is_comment(line):
                fields = self.layout.fields(with_seconds(line.partition("#")[0], self.layout))
                values = [self.layout.number(field) for field in fields]
                complete = len(values) == self.layout.n_columns and None not in values
                return np.array([float(value or "nan") for value in values]) if complete else None
        return None


def whole_lines(path: Path, encoding: str, source: str, start: int = 0) -> Iterator[tuple[str, bool]]:
    """Yield complete lines, about `PIECE` characters from character `start` on, and whether they are the last."""
    with path.open(encoding=encoding, errors="replace") as file:
        incomplete, following = "", file.read(start + PIECE)[start:]
        while following:
            text, following = incomplete + following, file.read(PIECE)
            if not following:
                yield text.rstrip(_END_MARK), True
                return
            end = text.rfind("\n") + 1
            incomplete = text[end:]
            if len(incomplete) > _MAX_LINE_LENGTH:
                raise BadData(
                    f"{source}: a line must be of at most {_MAX_LINE_LENGTH} characters, one is longer; "
                    "transpose it: one sample a row, one channel a column"
                )
            yield text[:end], False


def with_decimal_mark(layout: Layout, text: str) -> Layout:
    """Return the layout with a decimal comma if the rows contain commas that do not separate columns."""
    divided = layout.delimiter not in (",", MIXED) and (layout.n_columns > 1 or layout.trailing)
    is_decimal = divided and "," in text and _COMMA.search(text) is not None
    return replace(layout, decimal_comma=True) if is_decimal else layout


def _parsed_at_once(text: str, layout: Layout) -> Floats | None:
    if layout.decimal_comma and "." in text:
        return None
    delimiter, replacements = layout.parser()
    parsed = text
    for old, new in replacements.items():
        parsed = parsed.replace(old, new)
    try:
        comments, picked = "#" if "#" in text else None, layout.picked or None
        rows = np.loadtxt(io.StringIO(parsed), delimiter=delimiter, comments=comments, usecols=picked, ndmin=2)
    except ValueError:
        return None
    if rows.shape[1] != layout.n_columns:
        return None
    # If blanks replace the delimiter, only the count of delimiters reveals an empty field.
    lost = delimiter is None and layout.trailing
    if lost and text.count(layout.delimiter or "") != rows.size:
        return None
    return rows


def _checked_rows(
    text: str, layout: Layout, times: Sequence[int], needed: Sequence[int], sample: int, first_line: int, source: str
) -> Iterator[str]:
    # Only the last line of the file may lack its line feed.
    unended = first_line + text.count("\n")
    for number, line in enumerate(text.removesuffix("\n").split("\n"), first_line):
        if is_comment(line):
            raise _among_rows(number, line, sample, source)
        fields = layout.fields(line.partition("#")[0])
        cut = "; the file looks cut off" if number == unended else ""
        if len(fields) != layout.n_columns:
            ending = cut if len(fields) < layout.n_columns else ""
            raise BadData(
                f"{source}: every row must have {layout.n_columns} fields as the first one has, sample {sample} "
                f"(line {number}) has {len(fields)}{ending}; repair or cut the recording there"
            )
        values = [layout.number(field) for field in fields]
        for column in needed:
            value = values[column]
            if value is None or (column in times and not math.isfinite(float(value))):
                place = (layout.picked or range(layout.n_columns))[column]
                shown = repr(fields[column][:40]) if fields[column] else "empty"
                raise BadData(
                    f"{source}: every field must be a finite number, sample {sample} (line {number}) column "
                    f"{place + 1} is {shown}{cut if value is None else ''}; repair or cut the recording there"
                )
        yield " ".join(value or "nan" for value in values)
        sample += 1


def _among_rows(number: int, line: str, sample: int, source: str) -> BadData:
    shown = repr(line.strip()[:40]) if line.strip() else "empty"
    return BadData(
        f"{source}: every line among the numbers must be a row, since a sample may be missing, line {number} before "
        f"sample {sample} is {shown}; repair or cut the recording there, or take the line out"
    )


def _without_end(text: str) -> str:
    """Return lines without the comments and empty lines after the last row."""
    end = len(text)
    while end and is_comment(text[(start := text.rfind("\n", 0, end - 1) + 1) : end]):
        end = start
    return text[:end]


def n_lines(text: str) -> int:
    """Return the number of lines."""
    return text.removesuffix("\n").count("\n") + 1 if text else 0


# ---- the first piece -------------------------------------------------------------------------------------------------


def _header_and_body(path: Path, encoding: str, source: str) -> tuple[Header, Body]:
    with path.open(encoding=encoding, errors="replace") as file:
        piece = file.read(PIECE)
        if file.read(1):
            # The last line of the piece may be incomplete.
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
        raise BadData(f"{source}: a recording must contain numbers, no line of the text does; export it again")
    moment = None if layout.stamp is None else stamped_moment(line)
    layout = _corrected(layout, following or line, above)
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
    # `str.splitlines` also splits at other characters: line numbers would differ from those of the rows.
    start = 0
    while start < len(piece):
        end = piece.find("\n", start) + 1 or len(piece)
        yield piece[start:end]
        start = end


def _corrected(layout: Layout, second: str, above: deque[str]) -> Layout:
    """Return the layout of the first row, corrected by the other lines."""
    if layout.trailing:
        wider = replace(layout, n_columns=layout.n_columns + 1, trailing=False)
        named = read_header(above, wider).columns
        # An empty last field is a missing number if the next row has one there or the header names the column.
        if (named and named[-1].name) or wider.fields(second)[-1]:
            layout = wider
    return layout


def _is_damaged_row(line: str, layout: Layout) -> bool:
    """Return whether a line above the first row is a row with text among its numbers rather than a header."""
    fields = layout.fields(line)
    # "2000 samples" above two columns divided by blanks is a comment.
    least = 3 if layout.delimiter is None else 2
    is_row = len(fields) == layout.n_columns >= least and not is_comment(line)
    # Names of columns may be whole numbers.
    return is_row and any(layout.number(field) and (not field.isdigit() or field is fields[0]) for field in fields)


def _refuse_doubtful_comma(body: Body, header: Header, first: str, above: deque[str]) -> None:
    if body.layout.delimiter != "," or body.layout.n_columns != 2 or header.columns:
        return
    before_comma, after_comma = body.layout.fields(first)
    single = read_header(above, replace(body.layout, delimiter=None, n_columns=1)).columns
    names_one = bool(single) and single[0].known_unit is not None
    if (
        before_comma.lstrip("+-").isdigit()
        and after_comma.isdigit()
        and (names_one or (len(after_comma) > 1 and after_comma.startswith("0")))
    ):
        raise BadData(
            f"{body.source}: the comma of {first.strip()[:40]!r} may divide columns or decimals; "
            "write decimal points, or name both columns in a header"
        )


# ---- header, rows and time together ----------------------------------------------------------------------------------


def assembled(header: Header, body: Body, times: list[int] | None = None) -> Blocks:
    """Return the channels of rows below a header; `times` are the columns of times if they are known."""
    columns, source = header.columns, body.source
    rows, beginning = next(body.pieces(()))
    counters = []
    if times is None:
        times = time_columns(columns, rows) if body.layout.stamp is None else [body.layout.stamp]
        counters = [index for index in range(rows.shape[1]) if _counts(columns, rows, index)]
    samples_columns = [index for index in range(rows.shape[1]) if index not in (*times, *counters)]
    if not samples_columns:
        raise BadData(f"{source}: a recording must have a channel besides time, there is none; export it again")
    # Gaps in a channel matter only if it is read, but times must be complete.
    finite: NDArray[np.bool_] = np.all(np.isfinite(rows), axis=0)
    if not finite[times].all():
        next(body.pieces(times))
    measured = None
    if times and len(rows) > 1:
        measured = _measured_rate(columns, times, rows, None if beginning.is_last else body.last_row(), body)
    rate = _agreed_rate(header.sampling_rates, measured, source)
    if rate is None or not finite[samples_columns].any():
        next(body.pieces((), samples_columns))
    named = [columns[index] for index in samples_columns] if columns else []
    units = [column.known_unit or (None if column.unit else header.unit) for column in named]
    about: dict[str, Any] = {
        "names": [column.name for column in named],
        "units": units or [header.unit] * len(samples_columns),
        "sampling_rate": rate,
        "rate_from": "header" if measured is None else "time column",
        "start_time": header.start_time,
        "sensitivities": _for_each(header.sensitivities, len(samples_columns)),
        "gains": _for_each(header.gains, len(samples_columns)),
    }
    if beginning.is_last and finite.all():
        return Blocks.of_array(np.ascontiguousarray(rows.T[samples_columns]), **about)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        picked = [samples_columns[channel] for channel in channels]
        clock = None if measured is None else EvenTimes(measured, source)
        factor = _factor(columns, times[0], body) if times else 1.0
        for rows, piece in body.pieces(times, picked):
            if clock is not None:
                clock = EvenTimes(measured or 0.0, source) if piece.is_restart else clock
                clock.feed(rows[:, times[0]] * factor)
            samples = np.ascontiguousarray(rows.T[picked])
            for first in range(0, len(rows), length):
                yield samples[:, first : first + length]

    return Blocks(n_channels=len(samples_columns), read=blocks, **about)


def _for_each(stated: tuple[str, ...], n_channels: int) -> Sequence[str]:
    """Return the value of each channel, from one for all or one for each; none if there are others."""
    return stated * n_channels if len(stated) == 1 else stated if len(stated) == n_channels else ()


def time_columns(columns: tuple[Column, ...], rows: Floats) -> list[int]:
    """Return the indices of the time columns, of which the first one counts; `rows` are (n_samples, n_columns)."""
    # Named for time, else in a unit of time; without a header, the first of several if it increases in even steps.
    # Others named for time count, too, if they do so: some programs write one for each channel.
    if len(columns) == 1 and " " in columns[0].name:
        # Any comment above a single column looks like its name, even "time of day unknown".
        return []
    named = [index for index, column in enumerate(columns) if column.is_named_time and column.known_unit in (None, "m")]
    if named:
        return named[:1] + [index for index in named[1:] if runs_evenly(rows[:, index])]
    for index, column in enumerate(columns):
        if column.has_time_unit:
            return [index]
    return [0] if not columns and rows.shape[1] > 1 and runs_evenly(rows[:, 0]) else []


def _counts(columns: tuple[Column, ...], rows: Floats, index: int) -> bool:
    """Return whether a column only numbers the rows: its name indicates so, and it grows by one."""
    is_named = bool(columns) and columns[index].name.lower().strip(" .:#") in _NAMES_OF_COUNTERS
    with np.errstate(all="ignore"):
        return is_named and len(rows) > 1 and bool((np.diff(rows[:, index]) == 1).all())


def _factor(columns: tuple[Column, ...], at: int, body: Body) -> float:
    """Return the factor from a time column to seconds; stamps are in seconds already."""
    return 1.0 if at == body.layout.stamp or not columns else seconds(columns[at].unit, body.source)


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
    """Return the rate [Hz] of the time column, else that of the header; the two must agree."""
    if not stated:
        return measured
    if measured is None:
        for rate in stated[1:]:
            if min(rate, stated[0]) > 0:
                require_one_rate((stated[0], "the header"), (rate, "the header"), source)
        return stated[0]
    # Of several stated rates, such as before and after decimation, one must agree with the times.
    if min(stated) > 0 and not any(rates_agree(measured, rate) for rate in stated):
        require_one_rate((stated[0], "the header"), (measured, "the time column"), source)
    return measured

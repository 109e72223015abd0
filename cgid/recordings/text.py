"""Read text files (CSV, TXT, ...): the first piece shows header and layout, numpy parses the rows piece by piece."""

from __future__ import annotations

import io
import math
import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import STATED_RATE, rates_agree
from cgid.errors import BadData
from cgid.recordings.gaps import counts
from cgid.recordings.recording import (
    LABELS,
    MAX_CHANNELS,
    Asked,
    Blocks,
    Remark,
    require_one_rate,
    stretches,
    with_gaps,
)
from cgid.recordings.text_layout import (
    MIXED,
    SNIFFED,
    ColumnHeader,
    Header,
    Layout,
    column_of,
    encoding_of,
    has_ambiguous_date,
    is_comment,
    layout_of,
    loose_layout_of,
    plain_rows,
    quoted_layout_of,
    read_header,
    simpler,
    stamped_layout_of,
    stamped_moment,
)
from cgid.recordings.times import Clock, EvenTimes, Floats, clocks_of, rate_of, refined_rate, seconds
from cgid.units import known_unit

#: Characters to read at once; the header must end within the first piece.
PIECE = 1 << 20

#: Longest line [characters]: a longer row would have too many channels.
_MAX_LINE_LENGTH = 1 << 18

#: End mark of DOS texts.
_END_MARK = "\x1a"

#: A decimal comma in a head whose fields semicolons divide.
_DECIMAL_COMMA = re.compile(r";\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*(?:[;A-Za-z]|$)")
#: A comma in a row, before any comment.
_COMMA = re.compile(r"^[^#%/\n]*,", re.MULTILINE)

#: A line of a head that states a scale, such as "tscale,0.001".
_SCALED = re.compile(r"\s*[a-z]?scale\s*[,;:=]\s*[\d.]", re.IGNORECASE)
_DAY = 86_400.0
#: A column with fewer numbers than this part of the first rows is a slow channel.
_SLOW = 0.5


def read_text(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of a text file, with the statements of its header and its time column."""
    encoding, warnings = encoding_and_end(path, source)
    header, body = _header_and_body(path, encoding, source, warnings, asked)
    if body.layout.n_columns > MAX_CHANNELS:
        raise BadData(
            f"{source}: at most {MAX_CHANNELS} columns, line {body.first_line} has {body.layout.n_columns}; "
            "transpose it: one sample a row, one channel a column"
        )
    return assembled(header, body, warnings, asked)


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


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Body:
    """The rows of a text file: their start [characters, lines] and their layout."""

    path: Path
    encoding: str
    start: int
    first_line: int
    layout: Layout
    source: str
    is_dated: bool = True
    skip_broken: bool = False
    warnings: list[str] = field(default_factory=list)
    broken: set[int] = field(default_factory=set)

    def texts(self) -> Iterator[Piece]:
        """Yield the rows as they are written."""
        line = self.first_line
        for text, is_last in whole_lines(self.path, self.encoding, self.source, self.start):
            yield Piece(text, line, is_last)
            line += text.count("\n")

    def pieces(self, times: Sequence[int] | None, samples: Sequence[int] = ()) -> Iterator[tuple[Floats, Piece]]:
        """Yield rows (n, n_columns) in order, and as they are written; raises `BadData` with sample and line."""
        # Times must be finite; in columns of samples nan and inf stand for a lost sample; elsewhere invalid fields
        # become nan. Whether there are times is not known from the beginning.
        needed = [*(times or ()), *samples]
        layout, sample, points = self.layout, 0, bool(self.layout.picked)
        comment: tuple[int, str] | None = None
        for piece in self.texts():
            # Comments are allowed after the last row; among the rows they may replace samples.
            without_end = _without_end(piece.text)
            if without_end and comment is not None and not (piece.is_restart or (self.skip_broken and times != [])):
                raise _among_rows(*comment, sample, self.source)
            if comment is None and len(without_end) < len(piece.text):
                comment = piece.line + without_end.count("\n"), piece.text[len(without_end) :].partition("\n")[0]
            text = plain_rows(without_end, layout)
            if not points:
                # The decimal mark is unknown while all numbers are integers.
                layout = with_decimal_mark(layout, text)
            points = points or "." in text
            rows = _parsed_at_once(text, layout) if text else np.empty((0, layout.n_columns))
            if rows is None or len(rows) < n_lines(text) or not np.isfinite(rows[:, needed]).all():
                # Parsing line by line either finds the error or skips the text that numpy could not parse.
                checked = list(self._checked_rows(text, layout, times, needed, sample, piece))
                rows = np.loadtxt(checked, comments=None, ndmin=2) if checked else np.empty((0, layout.n_columns))
            yield rows, piece
            sample += len(rows)

    def _checked_rows(
        self, text: str, layout: Layout, times: Sequence[int] | None, needed: Sequence[int], sample: int, piece: Piece
    ) -> Iterator[str]:
        # Only the last line of the file may lack its line feed.
        unended = piece.line + text.count("\n") if piece.is_last else 0
        for number, line in enumerate(text.removesuffix("\n").split("\n"), piece.line):
            try:
                yield _checked_row(line, layout, times or (), needed, number, sample, self.source)
            except BadData:
                if number == unended and sample:
                    self.warnings.append(f"the last line ({number}) is cut off and was left out")
                    return
                # Times show where a sample is missing; without them a comment may or may not stand for one.
                if not self.skip_broken or (is_comment(line) and times == []):
                    raise
                self.broken.add(number)
                if times or is_comment(line):
                    continue
                yield " ".join(["nan"] * layout.n_columns)
            sample += 1

    @property
    def message(self) -> list[str]:
        """How many broken lines were skipped, one line at most."""
        lines = counted(len(self.broken), "broken line")
        return [f"{lines} skipped, the first is line {min(self.broken)}; samples are missing"] if self.broken else []

    def words(self, piece: Piece) -> list[str]:
        """Return the labels of the rows of a piece."""
        lines = enumerate(piece.text.split("\n"), piece.line)
        delimiter, at = self.layout.delimiter, self.layout.label or 0
        rows = [line.split(delimiter) for number, line in lines if number not in self.broken]
        return [row[at].strip("\"' \r") if at < len(row) else "" for row in rows]

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
                fields = self.layout.fields(plain_rows(line.partition("#")[0], self.layout))
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


def _checked_row(
    line: str, layout: Layout, times: Sequence[int], needed: Sequence[int], number: int, sample: int, source: str
) -> str:
    """Return a row as Python writes numbers; raise `BadData` unless it has all fields, and numbers where needed."""
    if is_comment(line):
        raise _among_rows(number, line, sample, source)
    fields = layout.fields(line.partition("#")[0])
    n_needed, n_fields = layout.n_columns, len(fields)
    if layout.words:
        n_needed, n_fields = max(layout.picked) + 1, line.count(layout.delimiter or "") + 1
    if n_fields < n_needed or (n_fields > n_needed and not layout.words):
        raise BadData(
            f"{source}: every row must have {n_needed} fields as the first one has, sample {sample} "
            f"(line {number}) has {n_fields}{_decimal_hint(fields, layout)}; repair or cut the recording there, or "
            f"leave such lines out by {spelled('skip_broken', 'true')}"
        )
    values = [layout.number(field) for field in fields]
    for column in needed:
        value = values[column]
        if value is None or (column in times and not math.isfinite(float(value))):
            place = (layout.picked or range(layout.n_columns))[column]
            shown = repr(fields[column][:40]) if fields[column] else "empty"
            raise BadData(
                f"{source}: every field must be a finite number, sample {sample} (line {number}) column "
                f"{place + 1} is {shown}; repair or cut the recording there, or leave such lines out by "
                f"{spelled('skip_broken', 'true')}"
            )
    return " ".join(value or "nan" for value in values)


def _decimal_hint(fields: Sequence[str], layout: Layout) -> str:
    """Return what more fields than columns may be: numbers with a decimal comma, divided by commas."""
    is_likely = layout.delimiter in (",", MIXED) and layout.n_columns < len(fields) <= 2 * layout.n_columns
    return ", since a decimal comma divides fields, too" if is_likely else ""


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


def _header_and_body(path: Path, encoding: str, source: str, warnings: list[str], asked: Asked) -> tuple[Header, Body]:
    with path.open(encoding=encoding, errors="replace") as file:
        piece = file.read(PIECE)
        if file.read(1):
            # The last line of the piece may be incomplete.
            piece = piece[: piece.rfind("\n") + 1] or piece
    above: deque[str] = deque()
    start, layout, loose = 0, None, None
    # `str.splitlines` also splits at other characters: line numbers would differ from those of the rows.
    lines = io.StringIO(piece, newline="\n")
    line = next(lines, "")
    while line:
        following = next(lines, "")
        layout = None if is_comment(line) else _layout(line, following, piece, start)
        if layout is not None:
            break
        # Words and units beside the numbers count only where no row is without.
        if loose is None and not is_comment(line):
            found = loose_layout_of(simpler(line), simpler(following), above)
            loose = None if found is None else (found, line, following, start, deque(above))
        above.append(line)
        start += len(line)
        line = following
    # A broken row among such rows may have numbers alone.
    if loose is not None and (layout is None or loose_layout_of(simpler(above[-1]), simpler(loose[1]), loose[-1])):
        layout, line, following, start, above = loose
    if layout is None:
        raise _not_understood(above, source)
    if layout.quoted == "unclear":
        raise BadData(
            f"{source}: a comma between quotes must be decimal or between thousands, that of {line.strip()[:40]!r} may "
            "be both; write decimal points, and no commas between thousands"
        )
    line = simpler(line)
    moment = None if layout.stamp is None else stamped_moment(line)
    is_ambiguous = layout.stamp is not None and has_ambiguous_date(line)
    if is_ambiguous:
        warnings.append(
            Remark(f"the date of {line.strip()[:40]!r} may begin with day or month; no start time was read")
        )
    if layout.delimiter == "," and layout.n_columns == 2 and any(map(_DECIMAL_COMMA.search, above)):
        layout = Layout(delimiter=";", n_columns=1, decimal_comma=True)
    if layout.trailing:
        layout = _corrected(layout, following or line, above)
    layout = with_decimal_mark(layout, plain_rows(piece[start:], layout))
    while above and _is_damaged_row(above[-1], layout):
        start -= len(above.pop())
    header = read_header(above, layout)
    if any("scale" in line.lower() and _SCALED.match(line) for line in above):
        raise BadData(
            f"{source}: the numbers of a text must be in their units, its head states scales to multiply them by "
            "(GCSV); export them multiplied"
        )
    if layout.words or layout.units:
        header, layout = _without_words(header, layout, source, warnings)
    narrow = _without_slow(layout, piece[start:])
    if narrow is not layout:
        names = [column.name for column in header.columns[narrow.n_columns :]]
        named = ", ".join(filter(None, names)) or f"from {narrow.n_columns + 1} on"
        warnings.append(Remark(f"columns {named} have no value in most rows and are left out"))
        header = replace(header, columns=header.columns[: narrow.n_columns])
    body = Body(
        path=path,
        encoding=encoding,
        start=start,
        first_line=len(above) + 1,
        layout=narrow,
        source=source,
        is_dated=moment is not None or is_ambiguous,
        skip_broken=asked.skip_broken,
        warnings=warnings,
    )
    if moment is not None:
        header = replace(header, start_time=moment)
    _refuse_doubtful_comma(body, header, line, above)
    n_names = 0 if header.columns else _n_names(above, layout)
    if n_names > layout.n_columns:
        raise BadData(
            f"{source}: a row must have a number below each name, the line above the numbers has {n_names} fields and "
            f"rows have {layout.n_columns}; correct the names"
        )
    if n_names:
        warnings.append(
            Remark(
                f"the line above the numbers has {counted(n_names, 'field')} and rows have {layout.n_columns}; names "
                "and units were not read"
            )
        )
    return header, body


def _without_words(header: Header, layout: Layout, source: str, warnings: list[str]) -> tuple[Header, Layout]:
    """Return header and layout of the columns of numbers, with the units behind the numbers."""
    columns = list(header.columns or [ColumnHeader()] * layout.n_columns)
    for at, unit in layout.units:
        stated = columns[at].unit
        if stated and (known_unit(stated) or stated) != (known_unit(unit) or unit):
            raise BadData(
                f"{source}: column {columns[at].name or at + 1} must be in one unit, its header states {stated} and "
                f"its numbers {unit}; correct one"
            )
        columns[at] = replace(columns[at], unit=unit)
    picked = tuple(at for at in range(layout.n_columns) if at not in layout.words)
    named = ", ".join(columns[at].name or str(at + 1) for at in layout.words)
    warnings += [Remark(f"column {named} contains words and is left out")] if layout.words else []
    stamp = None if layout.stamp is None else picked.index(layout.stamp)
    narrow = replace(layout, n_columns=len(picked), picked=picked if layout.words else (), stamp=stamp)
    label = [at for at in layout.words if columns[at].name.lower() in LABELS]
    has_names = bool(header.columns or layout.units)
    header = replace(header, columns=tuple(columns[at] for at in picked) if has_names else ())
    return header, replace(narrow, label=label[0] if label else None)


def _layout(line: str, following: str, piece: str, start: int) -> Layout | None:
    line, following = simpler(line), simpler(following)
    quoted = quoted_layout_of(line, piece, start) if '"' in piece else None
    return quoted or layout_of(line) or (stamped_layout_of(line, following) if ":" in line else None)


def _not_understood(lines: Sequence[str], source: str) -> BadData:
    """Return the error of a text without rows; it quotes the first line that looks like one."""
    shapes = [re.sub(r"[\d.]+", "0", line) if not is_comment(line) else "" for line in lines]
    alike = (at for at, (one, other) in enumerate(pairwise([*shapes, ""])) if "0" in one and one == other)
    at = next(alike, next((at for at, shape in enumerate(shapes) if "0" in shape), None))
    if at is None:
        return BadData(f"{source}: a recording must contain numbers, no line of the text does; export it again")
    fields = [field.strip() for field in re.split(r"[;,|\t]", lines[at])]
    field = next((one for one in fields if layout_of(one) is None), fields[0])
    return BadData(
        f"{source}: a row must consist of numbers and one time, line {at + 1} is {lines[at].strip()[:60]!r}, where "
        f"{field[:40]!r} is not understood; export numbers only, and times in seconds or as 2026-03-04T10:11:12.500"
    )


def _without_slow(layout: Layout, rows: str) -> Layout:
    """Return the layout of the columns that all rows have, if only the first rows have further ones."""
    if layout.delimiter is None or len(layout.delimiter) > 1 or layout.picked or layout.quoted:
        return layout
    n_fields = [line.count(layout.delimiter) + 1 for line in _without_end(rows).splitlines()]
    shortest = min(n_fields)
    n_long = sum(number > shortest for number in n_fields)
    is_slow = len(n_fields) - n_long > 1 and n_fields == [n_fields[0]] * n_long + [shortest] * (len(n_fields) - n_long)
    # A last row that is shorter is cut off.
    if not n_long or not is_slow or shortest < 2 or layout.trailing:
        return layout
    return replace(layout, n_columns=shortest, picked=tuple(range(shortest)))


def _n_names(above: Sequence[str], layout: Layout) -> int:
    """Return the number of names in the last line above the rows, 0 if it is no list of names."""
    last = above[-1] if above else ""
    if layout.delimiter is None or len(layout.delimiter) > 1 or is_comment(last):
        return 0
    fields = last.strip().strip(layout.delimiter).split(layout.delimiter)
    is_list = (
        len(fields) > 1 and all(column_of(one) != ColumnHeader() for one in fields) and not re.search("[:=]", last)
    )
    return len(fields) if is_list else 0


def _corrected(layout: Layout, second: str, above: deque[str]) -> Layout:
    """Return the layout of the first row, which ends in a delimiter, corrected by the other lines."""
    wider = replace(layout, n_columns=layout.n_columns + 1, trailing=False)
    named = read_header(above, wider).columns
    # An empty last field is a missing number if the next row has one there or the header names the column.
    return wider if (named and named[-1].name) or wider.fields(second)[-1] else layout


def _is_damaged_row(line: str, layout: Layout) -> bool:
    """Return whether a line above the first row is a row with text among its numbers rather than a header."""
    fields = layout.fields(line)
    # "2000 samples" above two columns divided by blanks is a comment.
    least = 3 if layout.delimiter is None else 2
    is_row = len(fields) == layout.n_columns >= least and not is_comment(line)
    # Names of columns may be whole numbers.
    return is_row and any(layout.number(field) and (not field.isdigit() or field is fields[0]) for field in fields)


def _refuse_doubtful_comma(body: Body, header: Header, first: str, above: deque[str]) -> None:
    layout = body.layout
    if layout.delimiter != "," or layout.n_columns % 2 or header.columns or layout.picked:
        return
    fields = layout.fields(first)
    half = replace(layout, delimiter=None if layout.n_columns == 2 else ",", n_columns=layout.n_columns // 2)
    names = read_header(above, half).columns
    names_half = bool(names) and (layout.n_columns > 2 or names[0].known_unit is not None)
    has_decimals = all(len(field) > 1 for field in fields[1::2]) and any(field[0] == "0" for field in fields[1::2])
    if all(field.lstrip("+-").isdigit() for field in fields) and (names_half or has_decimals):
        raise BadData(
            f"{body.source}: the commas of {first.strip()[:40]!r} may divide columns or decimals; "
            "write decimal points, or name all columns in a header"
        )


# ---- header, rows and time together ----------------------------------------------------------------------------------


def assembled(header: Header, body: Body, warnings: list[str], asked: Asked, times: list[int] | None = None) -> Blocks:
    """Return the channels of rows below a header; `times` are the columns of times if they are known."""
    columns, source = header.columns, body.source
    rows, beginning = next(body.pieces(None))
    left_out = []
    stamp = body.layout.stamp
    if times is None and stamp is not None:
        clocks = [Clock(columns=(stamp,), factors=(1.0,), period=math.inf if body.is_dated else _DAY)]
    elif times is None:
        # Any comment above a single column looks like its name, even "time of day unknown".
        is_comment_above = len(columns) == 1 and " " in columns[0].name
        clocks = [] if is_comment_above else clocks_of(columns, rows, source)
    else:
        clocks = [Clock(columns=(at,), factors=(1.0,)) for at in times]
    clock = clocks[0] if clocks else None
    of_times = [at for one in clocks for at in one.columns]
    written = body.layout.fields(plain_rows(beginning.text.partition("\n")[0], body.layout))
    for index in set(range(rows.shape[1])).difference(of_times) if times is None else ():
        name, n_numbers = columns[index].name if columns else "", int(np.isfinite(rows[:, index]).sum())
        # A channel of nan is a dead one.
        is_slow = n_numbers < _SLOW * len(rows) and (n_numbers > 0 or body.layout.number(written[index]) is None)
        if is_slow or ((not columns or columns[index].known_unit is None) and counts(name, rows[:, index])):
            what = f"has numbers in {n_numbers} of {len(rows)} rows" if is_slow else "only counts"
            warnings.append(Remark(f"column {name or index + 1} {what} and is left out"))
            left_out.append(index)
    times = of_times
    samples_columns = [index for index in range(rows.shape[1]) if index not in (*times, *left_out)]
    if not samples_columns:
        raise BadData(f"{source}: a recording must have a channel besides time, there is none; export it again")
    # Gaps in a channel matter only if it is read, but times must be complete.
    finite: NDArray[np.bool_] = np.all(np.isfinite(rows), axis=0)
    if not finite[times].all() or body.skip_broken:
        rows, beginning = next(body.pieces(times, samples_columns if body.skip_broken else ()))
        finite = np.all(np.isfinite(rows), axis=0)
    measured = None
    if clock is not None and len(rows) > 1:
        last = None if beginning.is_last else body.last_row()
        measured = _measured_rate([one.name for one in columns], clocks, rows, last, source, asked.sampling_rate)
        unit = column_of(columns[times[0]].name).unit if columns and len(clock.columns) == 1 else ""
        if unit and seconds(unit, source) != clock.factors[0]:
            warnings.append(
                f"the time column {columns[times[0]].name!r} is stated to be in {columns[times[0]].unit or 's'}; check "
                f"the sampling rate of {measured:.6g} Hz"
            )
    rate = _agreed_rate(header.sampling_rates, measured, source)
    if rate is None or not finite[samples_columns].any():
        next(body.pieces(times, samples_columns))
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
        "warnings": warnings,
    }

    def new_times() -> EvenTimes:
        return EvenTimes(measured or 0.0, source, asked.sampling_rate, clock.period if clock else math.inf)

    def placed(picked: Sequence[int]) -> Iterator[tuple[NDArray[np.int64], Floats, Piece]]:
        even, count, end = None if measured is None else new_times(), 0, 0
        for rows, piece in body.pieces(times, picked):
            places = np.arange(end, end + len(rows))
            if even is not None and clock is not None:
                if piece.is_restart:
                    even, count = new_times(), end
                places = count + even.feed(clock.times(rows))
            yield places, rows, piece
            end = int(places[-1]) + 1 if len(rows) else end
        warnings.extend([*([] if even is None else even.message), *body.message])

    def blocks(length: int, channels: Sequence[int]) -> Iterator[tuple[int, NDArray[Any]]]:
        picked = [samples_columns[channel] for channel in channels]
        for places, rows, _ in placed(picked):
            for at, samples in with_gaps(places, np.ascontiguousarray(rows.T[picked])):
                for first in range(0, samples.shape[1], length):
                    yield at + first, samples[:, first : first + length]

    def labels() -> Iterator[tuple[int, int, str]]:
        pieces = (zip(places.tolist(), body.words(piece), strict=False) for places, _, piece in placed(()))
        return stretches(chain.from_iterable(pieces))

    about["labels"] = None if body.layout.label is None else labels
    if beginning.is_last and finite[[*times, *samples_columns]].all():
        if measured is not None and clock is not None:
            even = EvenTimes(measured, source, asked.sampling_rate, clock.period)
            places = even.feed(clock.times(rows))
            lost = np.diff(places, prepend=-1) - 1
            about["gaps"] = [(at, int(lost[at])) for at in np.flatnonzero(lost).tolist()]
            about["n_samples"] = int(places[-1]) + 1
            warnings += even.message
        warnings += body.message
        return Blocks.of_array(np.ascontiguousarray(rows.T[samples_columns]), **about)

    return Blocks(n_channels=len(samples_columns), read=blocks, **about)


def _for_each(stated: tuple[str, ...], n_channels: int) -> Sequence[str]:
    """Return the value of each channel, from one for all or one for each; none if there are others."""
    return stated * n_channels if len(stated) == 1 else stated if len(stated) == n_channels else ()


def _measured_rate(
    names: Sequence[str], clocks: Sequence[Clock], rows: Floats, last: Floats | None, source: str, given: float | None
) -> float:
    """Return the sampling rate [Hz] of the time columns, which must agree."""
    rates = []
    for clock in clocks:
        times = clock.times(rows)
        rate = rate_of(times, source, given)
        if last is not None and rate != given:
            rate = refined_rate(rate, float(times[0]), float(clock.times(last[None])[0]))
        rates.append(rate)
    for (earlier, a), (later, b) in pairwise(zip(clocks, rates, strict=True)):
        first, second = ((rate, f"time column {names[one.columns[0]]!r}") for one, rate in ((earlier, a), (later, b)))
        require_one_rate(first, second, source)
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
    if min(stated) > 0 and not any(rates_agree(measured, rate, STATED_RATE) for rate in stated):
        require_one_rate((stated[0], "the header"), (measured, "the time column"), source)
    return measured

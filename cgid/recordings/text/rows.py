"""The rows of a text file by pieces, read by numpy's parser and gone through by line only where that one fails."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.text.clock_stamps import with_seconds
from cgid.recordings.text.layout import MIXED, Layout, is_comment

Floats = NDArray[np.float64]

#: Characters that are read at once; the header must lie within so many.
PIECE = 1 << 20

#: Characters of a row of more channels than there may be; a longer line is no row.
_LONGEST_LINE = 1 << 18

#: The end mark of DOS and the line end before it.
_END_MARK = "\x1a"

#: A comma in a row: before any mark of a comment.
_COMMA = re.compile(r"^[^#%/\n]*,", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class Body:
    """The rows of a text file: where they begin and how they are divided.

    Parameters
    ----------
    path : Path
    encoding : str
    start : int
        Characters above the first row.
    first_line : int
        Number of the line of the first row, from 1.
    layout : Layout
    source : str
        Name of the file in messages.
    """

    path: Path
    encoding: str
    start: int
    first_line: int
    layout: Layout
    source: str

    def pieces(self, needed: Sequence[int]) -> Iterator[tuple[Floats, bool]]:
        """Yield rows (n, n_columns) in order, and whether they are the last ones.

        Parameters
        ----------
        needed : sequence of int
            Columns whose fields must be finite numbers; what is none elsewhere becomes nan.

        Raises
        ------
        BadData
            A row has more or fewer fields than the first, a field that is needed is no finite number, or a remark or
            an empty line stands among the rows, where a sample may be missing; sample and line are named.
        """
        wanted = list(needed)
        layout, sample, line = self.layout, 0, self.first_line
        points, remark = False, None
        for written, is_last in whole_lines(self.path, self.encoding, self.source, self.start):
            # Remarks behind the last row are remarks; among the rows they may stand for samples.
            held = _without_end(written)
            if held and remark is not None:
                raise _among_rows(*remark, sample, self.source)
            if remark is None and len(held) < len(written):
                remark = line + held.count("\n"), written[len(held) :].partition("\n")[0]
            text = with_seconds(held, layout)
            if not points:
                # As long as all numbers were whole ones, nobody could know the decimal mark.
                layout = with_decimal_mark(layout, text)
            points = points or "." in text
            rows = _parsed_at_once(text, layout) if text else np.empty((0, layout.n_columns))
            if rows is None or len(rows) < _n_lines(text) or not np.isfinite(rows[:, wanted]).all():
                # Going through the lines either finds the fault or leaves out what numpy's parser stumbled over.
                checked = list(_checked_rows(text, layout, wanted, sample, line, self.source))
                rows = np.loadtxt(checked, comments=None, ndmin=2) if checked else np.empty((0, layout.n_columns))
            yield rows, is_last
            sample += len(rows)
            line += written.count("\n")

    def last_row(self) -> Floats | None:
        """Return the last row, (n_columns,), None where it cannot be told from the end of the file alone."""
        with self.path.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            # An even distance keeps the two bytes of a character of UTF-16 together.
            file.seek(max(0, size - 2 * _LONGEST_LINE) // 2 * 2)
            raw = file.read()
        if self.encoding == "utf-16":
            with self.path.open("rb") as file:
                text = raw.decode("utf-16-le" if file.read(2) == b"\xff\xfe" else "utf-16-be", "replace")
        else:
            text = raw.decode(self.encoding, "replace")
        for line in reversed(text.replace("\r", "\n").rstrip(_END_MARK).split("\n")):
            if not is_comment(line):
                fields = self.layout.fields(with_seconds(line.partition("#")[0], self.layout))
                values = [self.layout.number(field) for field in fields]
                complete = len(values) == self.layout.n_columns and None not in values
                return np.array([float(value or "nan") for value in values]) if complete else None
        return None


def whole_lines(path: Path, encoding: str, source: str, start: int = 0) -> Iterator[tuple[str, bool]]:
    """Yield a text file from the character `start` on by whole lines, and whether they are the last ones.

    Line ends are line feeds; only the very last line may lack its own.

    Raises
    ------
    BadData
        A line is longer than any row.
    """
    with path.open(encoding=encoding, errors="replace") as file:
        rest, following = "", file.read(start + PIECE)[start:]
        while following:
            text, following = rest + following, file.read(PIECE)
            if not following:
                yield text.rstrip(_END_MARK), True
                return
            end = text.rfind("\n") + 1
            rest = text[end:]
            if len(rest) > _LONGEST_LINE:
                raise BadData(
                    f"{source}: a line must be of at most {_LONGEST_LINE} characters, one is longer; "
                    "transpose it: one sample a row, one channel a column"
                )
            yield text[:end], False


def with_decimal_mark(layout: Layout, text: str) -> Layout:
    """Return the layout with a decimal comma if rows hold commas that do not divide columns."""
    divided = layout.delimiter not in (",", MIXED) and (layout.n_columns > 1 or layout.trailing)
    is_decimal = divided and "," in text and _COMMA.search(text) is not None
    return replace(layout, decimal_comma=True) if is_decimal else layout


def _parsed_at_once(text: str, layout: Layout) -> Floats | None:
    if layout.decimal_comma and "." in text:
        return None
    delimiter, exchange = layout.parser()
    parsed = text
    for old, new in exchange.items():
        parsed = parsed.replace(old, new)
    try:
        rows = np.loadtxt(io.StringIO(parsed), delimiter=delimiter, comments="#" if "#" in text else None, ndmin=2)
    except ValueError:
        return None
    if rows.shape[1] != layout.n_columns:
        return None
    # Exchanged for blanks, an empty field leaves no trace but its delimiter.
    lost = delimiter is None and layout.trailing
    if lost and text.count(layout.delimiter or "") != rows.size:
        return None
    return rows


def _checked_rows(
    text: str, layout: Layout, needed: Sequence[int], sample: int, first_line: int, source: str
) -> Iterator[str]:
    # The very last line is the only one that may lack its end.
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
            if value is None or not math.isfinite(float(value)):
                raise BadData(
                    f"{source}: every field must be a finite number, sample {sample} (line {number}) column "
                    f"{column + 1} is {_shown(fields[column])}{cut if value is None else ''}; repair or cut the "
                    "recording there"
                )
        yield " ".join(value or "nan" for value in values)
        sample += 1


def _without_end(text: str) -> str:
    """Return lines without the remarks and empty lines behind the last row."""
    end = len(text)
    while end and is_comment(text[(start := text.rfind("\n", 0, end - 1) + 1) : end]):
        end = start
    return text[:end]


def _n_lines(text: str) -> int:
    return text.removesuffix("\n").count("\n") + 1 if text else 0


def _among_rows(number: int, line: str, sample: int, source: str) -> BadData:
    return BadData(
        f"{source}: every line among the numbers must be a row, or a sample may be missing, line {number} before "
        f"sample {sample} is {_shown(line.strip())}; repair or cut the recording there, or take the line out"
    )


def _shown(field: str) -> str:
    return repr(field[:40]) if field else "empty"

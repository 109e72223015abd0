"""Times of day, with or without a date, as the time of each row of a text; they become seconds before anything else."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date, datetime, timedelta

from cgid.recordings.text.layout import Layout, layout_of

#: Days are counted from here, so that seconds keep their digits: 2^-23 s in our century.
_FIRST_DAY = date(2000, 1, 1)

_STAMP = re.compile(
    r"(?<![\d.:])(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)[ T])?(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))?Z?(?![\d.:])", re.ASCII
)
_STAMP_BEFORE_COMMA = re.compile(_STAMP.pattern.replace("[.,](", "[.]("), re.ASCII)


def stamped_layout_of(line: str, following: str) -> Layout | None:
    """Return how `line` is divided if it is a row with one stamp, as is the next one; else None.

    Examples
    --------
    >>> stamped_layout_of("10:00:00.001;1,5", "10:00:00.002;1,6")
    Layout(delimiter=';', n_columns=2, decimal_comma=True, trailing=False, stamp=0)
    >>> stamped_layout_of("2026-03-04 10:00:00", "time;force") is None
    True
    """
    layouts = [_layout(each) for each in (line, following)]
    first, second = layouts
    alike = (
        first is not None and second is not None and (first.n_columns, first.stamp) == (second.n_columns, second.stamp)
    )
    return first if alike else None


def with_seconds(text: str, layout: Layout) -> str:
    """Return text whose stamps are seconds.

    Examples
    --------
    >>> with_seconds("2000-01-02 00:00:01.25,7", Layout(delimiter=",", n_columns=2, stamp=0))
    '86401.25,7'
    """
    if layout.stamp is None:
        return text
    mark = "," if layout.decimal_comma else "."
    pattern = _STAMP_BEFORE_COMMA if layout.delimiter == "," else _STAMP
    return pattern.sub(lambda found: _seconds(found, mark), text)


def stamped_moment(line: str) -> datetime | None:
    """Return the moment of a row's stamp; None if it has no date.

    Examples
    --------
    >>> stamped_moment("7;2026-03-04T10:11:12,5;8")
    datetime.datetime(2026, 3, 4, 10, 11, 12, 500000)
    """
    found = _STAMP.search(line)
    if found is None or found[1] is None:
        return None
    try:
        day = datetime(int(found[1]), int(found[2]), int(found[3]))
    except ValueError:
        return None
    parts = (int(found[4]), int(found[5]), int(found[6]), int((found[7] or "0")[:6].ljust(6, "0")))
    return day + timedelta(hours=parts[0], minutes=parts[1], seconds=parts[2], microseconds=parts[3])


def _layout(line: str) -> Layout | None:
    """Return the layout of a row with one stamp and one number at least."""
    for pattern in (_STAMP_BEFORE_COMMA, _STAMP):
        # As a whole number the stamp says nothing of the decimal mark, which the other columns show.
        layout = layout_of(pattern.sub("0", line)) if len(pattern.findall(line)) == 1 else None
        if (
            layout is not None
            and layout.n_columns > 1
            and (pattern is _STAMP_BEFORE_COMMA) == (layout.delimiter == ",")
        ):
            fields = layout.fields(pattern.sub("!", line))
            return replace(layout, stamp=fields.index("!")) if "!" in fields else None
    return None


def _seconds(found: re.Match[str], mark: str) -> str:
    try:
        days = (date(int(found[1]), int(found[2]), int(found[3])) - _FIRST_DAY).days if found[1] else 0
    except ValueError:
        # No such day: left as it is, it is told as a field that is no number.
        return found[0]
    whole = 86400 * days + 3600 * int(found[4]) + 60 * int(found[5]) + int(found[6])
    if whole < 0:
        return found[0]
    return f"{whole}{mark}{found[7]}" if found[7] else str(whole)

"""Parse the lines above the numbers of a text file: names, units, sampling rate, start."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime

from cgid.recordings.text_layout import Layout
from cgid.units import KNOWN_UNITS, hertz_of, known_unit, seconds_of

_TIME_NAME = re.compile(r"(?i:time|zeit|temps|tiempo|tempo|时间|時間)|t(?![^\W\d_])")
_IN_BRACKETS = re.compile(r"(.*)[(\[{<]([^()\[\]{}<>]*)[)\]}>]")
_STATED_RATE = re.compile(
    r"[\s#%;/\"]*(?i:(?:sampling|sample)[ _-]?(?:rate|frequency|freq)|fs|abtastrate|abtastfrequenz|采样率|采样频率)"
    r"[\s\"]*(?:[(\[]\s*([kKMG]?(?i:hz))\s*[)\]])?"
    r"[\s\":=,;]+([+-]?\d[\d.]*(?:[eE][+-]?\d+)?)[\s\",;]*([kKMG]?(?i:hz)|(?i:s/s|sps))?[\s\",;.]*"
)
_STATED_INTERVAL = re.compile(
    r"[\s#%;/\"]*(?i:(?:sampling|sample|time)[ _-]?(?:interval|period|step)|delta[ _]?[tx]|dt|采样间隔|采样周期)[\s\"]*"
    r"(?:[(\[]\s*([mnuµ]?s)\s*[)\]])?[\s\":=,;]+([+-]?\d[\d.]*(?:[eE][+-]?\d+)?)[\s\",;]*([mnuµ]?s(?:ec)?)?[\s\",;.]*"
)
_STATED_START = re.compile(
    r"[\s#%;/\"]*(?i:start[ _-]?(?:date[ _-]?)?time|start(?:ed)?|recorded|date[ _-]?time)[\s\"]*[:=,;\t][\s\"]*"
    r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d[\d:.+Z-]*)[\s\",;]*"
)
_STATED_UNIT = re.compile(r"[\s#%;/\"]*(?i:units?|单位)[\s\"]*[:=][\s\"]*([^\s\",;]+)[\s\",;]*")
_COLUMNS_FOLLOW = re.compile(r"(?i:columns?|fields?|channels?|header)\s*[:=]\s*")
_WORDS_WITH_BRACKETS = re.compile(r'"[^"]*"|[^\s()\[\]]+(?:\s*[(\[][^()\[\]]*[)\]])?|[(\[][^()\[\]]*[)\]]')

#: Greek mu to the micro sign, full-width punctuation of Chinese headers to ASCII.
_SAME = str.maketrans("\u03bc（）［］：；，＝　", "µ()[]:;,= ")

#: Longest name of a column.
_LONGEST_NAME = 200


@dataclass(frozen=True, kw_only=True)
class Column:
    """Name and unit of a column from its header, "" if missing."""

    name: str = ""
    unit: str = ""

    @property
    def is_named_time(self) -> bool:
        """Whether the name means time."""
        return bool(_TIME_NAME.match(self.name))

    @property
    def has_time_unit(self) -> bool:
        """Whether the unit is one of time."""
        return _is_time_unit(self.unit)

    @property
    def known_unit(self) -> str | None:
        """The unit if it is in `cgid.units.UNITS`, else None."""
        return known_unit(self.unit)


@dataclass(frozen=True, kw_only=True)
class Header:
    """Statements above the numbers; no columns if no line has as many fields as the rows.

    Several lines may state a sampling rate [Hz].
    """

    columns: tuple[Column, ...] = ()
    sampling_rates: tuple[float, ...] = ()
    unit: str | None = None
    start_time: datetime | None = None


def column_of(text: str) -> Column:
    """Return name and unit of a field of a header.

    Examples
    --------
    >>> [(c.name, c.unit) for c in map(column_of, ["force [kN]", "F/kN", "time_s", "a (m/s^2)", "(ms)", "left"])]
    [('force', 'kN'), ('F', 'kN'), ('time', 's'), ('a', 'm/s^2'), ('', 'ms'), ('left', '')]
    """
    text = " ".join(text.translate(_SAME).strip("\"' \t\r\n").split())
    if len(text) > _LONGEST_NAME:
        return Column(name=text[:_LONGEST_NAME])
    if text in KNOWN_UNITS or _is_time_unit(text):
        return Column(unit=text)
    if found := _IN_BRACKETS.fullmatch(text):
        return Column(name=found[1].rstrip(" /_"), unit=found[2].strip())
    for mark in "/_ ":
        # Units contain slashes, names rarely do: split at the first slash, but at the last underscore or blank.
        name, _, unit = text.partition(mark) if mark == "/" else text.rpartition(mark)
        name, unit = name.strip(), unit.strip()
        is_time = _is_time_unit(unit) and _TIME_NAME.match(name)
        if any(character.isalpha() for character in name) and (unit in KNOWN_UNITS or is_time):
            return Column(name=name, unit=unit)
    return Column(name=text)


def read_header(lines: Iterable[str], layout: Layout) -> Header:
    """Parse `lines`, those above the first row, for rows of this layout.

    The last line with as many fields as the rows names the columns; a line with a known unit or a name for time is
    preferred. A line of units may follow the line of names.
    """
    header = Header()
    best: tuple[Column, ...] = ()
    before: tuple[Column, ...] = ()
    for written in lines:
        line = written.translate(_SAME)
        comment = line[:_LONGEST_NAME]
        if (rate := _stated_rate(comment)) is not None:
            header = replace(header, sampling_rates=(*header.sampling_rates, rate))
        elif found := _STATED_START.fullmatch(comment):
            with suppress(ValueError):
                header = replace(header, start_time=datetime.fromisoformat(found[1]))
        elif found := _STATED_UNIT.fullmatch(comment):
            header = replace(header, unit=known_unit(found[1]))
        elif columns := _columns(line, layout):
            columns = _under(before, columns)
            if _has_unit_or_time(columns) or not _has_unit_or_time(best):
                best = columns
            before = columns
    named = tuple(replace(column, name=column.name or column.unit) for column in best)
    return replace(header, columns=named)


def _is_time_unit(text: str) -> bool:
    return bool(text) and seconds_of(text) is not None


def _stated_rate(comment: str) -> float | None:
    """Return the sampling rate [Hz] that a line states, directly or by its interval."""
    with suppress(ValueError):  # a number with two points
        if found := _STATED_RATE.fullmatch(comment):
            return float(found[2]) * (hertz_of(found[3] or found[1] or "") or 1.0)
        if found := _STATED_INTERVAL.fullmatch(comment):
            interval = float(found[2]) * (seconds_of(found[3] or found[1] or "") or 1.0)
            return 1 / interval if interval else math.inf
    return None


def _columns(line: str, layout: Layout) -> tuple[Column, ...]:
    text = re.sub(r"^\s*(?:#+|%+|//+)", "", line).strip(" \r\n")
    if text.startswith(";") and text.count(";") != layout.n_columns - 1:
        text = text.lstrip("; ")
    text = _COLUMNS_FOLLOW.sub("", text, count=1) if _COLUMNS_FOLLOW.match(text) else text
    for fields in _divisions(text, layout):
        while len(fields) > layout.n_columns and not fields[-1].strip():
            fields = fields[:-1]
        # "Operator: somebody" is a comment, not a name.
        if len(fields) == layout.n_columns and any(map(str.strip, fields)) and not re.search("[:=]", "".join(fields)):
            return tuple(map(column_of, fields))
    return ()


def _divisions(text: str, layout: Layout) -> Iterator[list[str]]:
    marks = dict.fromkeys([layout.delimiter or "\t", ",", ";", "\t", "|"])
    for mark in marks:
        if len(mark) == 1 and mark in text:
            try:
                yield next(csv.reader([text], delimiter=mark, skipinitialspace=True))
            except (csv.Error, StopIteration):
                yield text.split(mark)
    if layout.n_columns == 1:
        yield [text]
    yield re.split(r"\s\s+|\t", text)
    if layout.delimiter in (None, "\t"):
        yield _WORDS_WITH_BRACKETS.findall(text)
        yield re.findall(r'"[^"]*"|\S+', text)


def _under(names: tuple[Column, ...], units: tuple[Column, ...]) -> tuple[Column, ...]:
    if not names or any(column.name for column in units):
        return units
    return tuple(Column(name=name.name, unit=unit.unit or name.unit) for name, unit in zip(names, units, strict=True))


def _has_unit_or_time(columns: tuple[Column, ...]) -> bool:
    return any(column.is_named_time or column.known_unit or column.has_time_unit for column in columns)

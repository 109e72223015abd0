"""Encoding, row layout and header of text files; times of day in rows."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import lru_cache

from cgid.errors import BadData
from cgid.recordings.times import begins_as_time, is_time_name
from cgid.units import KNOWN_UNITS, hertz_of, known_unit, number_and_unit, ratio_of, seconds_of

#: First bytes, enough to recognise the encoding; the header ends within them.
SNIFFED = 1 << 18

# Characters not found in texts: all control characters except tab, line and page breaks, and the DOS end mark.
_CONTROL = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f\x7f]")

_HIGH = re.compile(rb"[\x80-\xff]")

#: Full-width punctuation and common Chinese characters: GB 2312 rows 1 to 9 and its first level, rows 16 to 55.
_COMMON_CHINESE = re.compile(rb"[\xa1-\xa9\xb0-\xd7][\xa1-\xfe]")


def encoding_of(start: bytes, source: str) -> str:
    """Return the encoding of a text from its first `SNIFFED` bytes; raises `BadData` if they are not text."""
    # LabVIEW writes in the code page of the system: gb18030 if most bytes beyond ASCII are common Chinese characters.
    if start.startswith(codecs.BOM_UTF8):
        encoding = "utf-8-sig"
    elif start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif start.isascii() or _decodes(start, "utf-8"):
        encoding = "utf-8"
    else:
        # In western texts, nearly every character beyond ASCII is next to ASCII letters: two in a row that form a
        # common Chinese character are rare. Chinese texts contain hardly any others beyond ASCII.
        common = sum(map(len, _COMMON_CHINESE.findall(start)))
        chinese = common > 0.7 * len(_HIGH.findall(start)) and _decodes(start, "gb18030")
        encoding = "gb18030" if chinese else "latin-1"
    # UTF-16 without a mark is recognised by its zero bytes.
    if _CONTROL.search(start.decode(encoding, "replace")):
        raise BadData(f"{source}: the file is neither text nor of a known format; export it as text, WAV or HDF5")
    return encoding


def _decodes(start: bytes, encoding: str) -> bool:
    try:
        # Decode incrementally, as the last character may be incomplete.
        codecs.getincrementaldecoder(encoding)().decode(start)
    except UnicodeDecodeError:
        return False
    return True


#: Numbers that C and Python both parse; no underscores, no digits of other scripts.
NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.ASCII | re.IGNORECASE)

#: Delimiter of columns divided by commas, blanks or both.
MIXED = ", "

_COMMENT = ("#", "%", "//")
_QUOTES = str.maketrans("\"'", "  ")
#: Fortran writes exponents of double precision with a D.
_EXPONENTS = str.maketrans("Dd", "ee")
#: A number between quotes, and one with commas between thousands.
_QUOTED = re.compile(r'"\s*([+-]?\d[\d,.]*(?:[eE][+-]?\d+)?)\s*"', re.ASCII)
_QUOTES_SEARCHED = 1 << 16
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+(?:\.\d*)?")


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Division of a row into fields.

    delimiter : one character, `MIXED`, or None for any run of blanks
    n_columns : without the empty one after a trailing delimiter
    decimal_comma : whether the decimal mark is a comma
    trailing : whether each row ends in a delimiter
    stamp : column with times of day, which become seconds before a row is divided
    picked : the fields of a row that count, in a row that may have others; all if there are none
    quoted : what a comma means within quotes, "decimal" or "thousands"; "" if there is none
    has_date_column : whether the date of the times of day is in a column before them
    words, units, label : columns of words, units behind the numbers of others, and the column of labels
    """

    delimiter: str | None
    n_columns: int
    decimal_comma: bool = False
    trailing: bool = False
    stamp: int | None = None
    picked: tuple[int, ...] = ()
    quoted: str = ""
    has_date_column: bool = False
    words: tuple[int, ...] = ()
    units: tuple[tuple[int, str], ...] = ()
    label: int | None = None

    def fields(self, line: str) -> list[str]:
        """Return the fields of a row without quotes and surrounding blanks."""
        line = line.translate(_QUOTES)
        if self.delimiter is None:
            return line.split()
        if self.delimiter == MIXED:
            return re.split(r"[,\s]+", line.strip(" \t\r\n,"))
        fields = [field.strip() for field in line.split(self.delimiter)]
        if self.picked:
            return [fields[index] if index < len(fields) else "" for index in self.picked]
        return fields[:-1] if self.trailing and not fields[-1] else fields

    def number(self, field: str) -> str | None:
        """Return a field in Python notation, None if it is not a number."""
        if self.decimal_comma:
            # With both a point and a comma, one would be a thousands separator.
            field = "" if "." in field else field.replace(",", ".")
        field = field.translate(_EXPONENTS)
        return field if NUMBER.fullmatch(field) else None

    def parser(self) -> tuple[str | None, dict[str, str]]:
        """Return the delimiter for `numpy.loadtxt`, and the characters to replace first."""
        replacements = {'"': " ", "'": " ", "D": "e", "d": "e"}
        if self.decimal_comma:
            replacements[","] = "."
        if self.delimiter == MIXED or (self.trailing and self.delimiter is not None):
            replacements[self.delimiter[0]] = " "
            return None, replacements
        return self.delimiter, replacements


def is_comment(line: str) -> bool:
    """Return whether a line is blank or a comment: #, %, //, or ; without any digit after it."""
    line = line.strip()
    if line.startswith(";"):
        return not any(character.isdigit() for character in line)
    return not line or line.startswith(_COMMENT)


def layout_of(line: str) -> Layout | None:
    """Return the layout of `line` if it is a row of numbers, else None; empty fields are damage, not a header."""
    for layout in _candidates(line.translate(_QUOTES)):
        fields = layout.fields(line)
        if any(fields) and all(layout.number(field) for field in fields if field):
            trailing = len(fields) > 1 and not fields[-1]
            return replace(layout, n_columns=len(fields) - trailing, trailing=trailing)
    return None


def quoted_layout_of(line: str, piece: str, start: int) -> Layout | None:
    """Return the layout of `line`, at `start` of a piece of rows, if numbers between quotes contain commas, else None.

    Its `quoted` is "unclear" if the commas may be decimal as well as between thousands.
    """
    layout = layout_of(_QUOTED.sub("0", line))
    if layout is None or layout.delimiter not in (",", None):
        return None
    numbers = [number for number in _QUOTED.findall(piece, start, start + _QUOTES_SEARCHED) if "," in number]
    if not numbers:
        return None
    if all(map(_THOUSANDS.fullmatch, numbers)):
        is_clear = any("." in number or number.count(",") > 1 for number in numbers)
        return replace(layout, quoted="thousands" if is_clear else "unclear")
    is_clear = all(number.count(",") == 1 and "." not in number for number in numbers)
    return replace(layout, quoted="decimal" if is_clear else "unclear")


def _candidates(line: str) -> Iterator[Layout]:
    for mark in ";|":
        if mark in line:
            yield Layout(delimiter=mark, n_columns=0, decimal_comma="," in line and "." not in line)
            return
    if "," not in line:
        tabbed = line.rstrip(" \r\n").split("\t")
        # Blanks next to tabs, and several tabs in a row, only align columns.
        by_tab = len(tabbed) > 1 and all(len(field.split()) == 1 for field in tabbed)
        yield Layout(delimiter="\t" if by_tab else None, n_columns=0)
        return
    # A comma next to a blank ends a field; one between digits, in a line with blanks, is a decimal comma.
    if len(line.split()) > 1 and not re.search(r",\s|\s,", line.strip()):
        yield Layout(delimiter=None, n_columns=0, decimal_comma=True)
    yield Layout(delimiter=",", n_columns=0)
    yield Layout(delimiter=MIXED, n_columns=0)


#: Epoch: float64 seconds from it resolve 2^-23 s until 2034.
_EPOCH = datetime(2000, 1, 1)

_STAMP = re.compile(
    r"(?<![\d.:])(?:(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)([-/.])(\d\d?)\5(\d{4}))(?:[ T]|[,;\t|] ?))?"
    r"(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))?(?:\s?([AaPp])[Mm])?(Z|[+-]\d\d:?\d\d)?(?![\d.:])",
    re.ASCII,
)
_STAMP_BEFORE_COMMA = re.compile(_STAMP.pattern.replace("[.,](", "[.]("), re.ASCII)


#: Names of months in dates such as 04-Mar-2024, English and German, by their first letters.
_MONTHS = ("jan", "feb", "mar|mär", "apr", "may|mai", "jun", "jul", "aug", "sep", "oct|okt", "nov", "dec|dez")
_MONTH_NAMED = re.compile(
    r"(?<!\d)(\d\d?)([-/. ])(?:" + "|".join(f"({names})" for names in _MONTHS) + r")[a-zä]*\.?\2(\d{4})(?!\d)",
    re.IGNORECASE,
)
#: Marks between thousands other than commas: apostrophes and narrow or fixed blanks.
_MARKS = "'\u2019\u2009\u202f\u00a0"
_BETWEEN_THOUSANDS = re.compile(rf"(?<=\d)[{_MARKS}](?=\d{{3}}(?!\d))")


def simpler(text: str) -> str:
    """Return rows with months as numbers, and no marks between thousands."""
    if any(mark in text for mark in _MARKS):
        text = _BETWEEN_THOUSANDS.sub("", text)
    return _MONTH_NAMED.sub(_as_numbers, text) if ":" in text else text


def _as_numbers(date: re.Match[str]) -> str:
    month = next(number for number in range(1, 13) if date[number + 2])
    return f"{date[15]}-{month}-{date[1]}"


def stamped_layout_of(line: str, following: str) -> Layout | None:
    """Return the layout of `line` if it is a row with one stamp, like the next one; else None."""
    return _like(_layout(line), _layout(following))


def _like(first: Layout | None, second: Layout | None) -> Layout | None:
    """Return the layout of a row if that of the next has as many columns, and the stamp in the same."""
    same = first and second and (first.n_columns, first.stamp) == (second.n_columns, second.stamp)
    return first if same else None


def plain_rows(text: str, layout: Layout) -> str:
    """Return rows with seconds instead of stamps, and without quotes around numbers with commas."""
    text = simpler(text)
    if layout.quoted and '"' in text:
        mark = "." if layout.quoted == "decimal" else ""
        text = _QUOTED.sub(lambda match: match[1].replace(",", mark), text)
    for _, unit in layout.units:
        text = re.sub(rf"(?<=[\d.])\s*{re.escape(unit)}(?=\s*[\"']?\s*(?:[;,\t|\r\n]|$))", "", text)
    if layout.stamp is None:
        return text
    mark = "," if layout.decimal_comma else "."
    pattern = _STAMP_BEFORE_COMMA if layout.delimiter == "," else _STAMP
    return pattern.sub(lambda match: _seconds(match, mark), text)


def stamped_moment(line: str, *, is_only_field: bool = False) -> datetime | None:
    """Return the datetime of the stamp in a line, None without a date; `is_only_field`: the line is the stamp."""
    match = _STAMP.fullmatch(line) if is_only_field else _STAMP.search(line)
    if match is None or not (match[1] or match[4]) or _is_ambiguous(match):
        return None
    try:
        moment = _EPOCH + timedelta(days=_day(*match.groups()[:7]), seconds=_second(match))
        moment += timedelta(microseconds=int((match[11] or "0")[:6].ljust(6, "0")))
    except (OverflowError, ValueError):
        return None
    if match[13] is None:
        return moment
    hours, minutes = (0, 0) if match[13] == "Z" else (int(match[13][1:3]), int(match[13][-2:]))
    offset = timedelta(hours=hours, minutes=minutes) * (-1 if match[13][0] == "-" else 1)
    return moment.replace(tzinfo=timezone(offset)) if abs(offset) < timedelta(days=1) else None


def has_ambiguous_date(line: str) -> bool:
    """Return whether the date of the stamp in a line may begin with the day or with the month."""
    match = _STAMP.search(line)
    return match is not None and _is_ambiguous(match)


def _is_ambiguous(match: re.Match[str]) -> bool:
    return match[5] == "/" and not match[12] and max(int(match[4]), int(match[6])) <= 12 and match[4] != match[6]


@lru_cache(maxsize=64)
def _day(year: str | None, month: str, day: str, first: str | None, mark: str, second: str, last: str) -> int:
    """Return the days from the epoch to the date of a stamp, 0 without a date."""
    if year is None and first is None:
        return 0
    if first is not None:
        # Dates with slashes begin with the month (United States), others with the day; a 13th month is a day.
        year, month, day = (last, first, second) if mark == "/" and int(first) <= 12 else (last, second, first)
    return (datetime(int(year or 0), int(month), int(day)) - _EPOCH).days


def _second(match: re.Match[str]) -> int:
    """Return the seconds from midnight to a stamp, without the fraction."""
    hour = int(match[8])
    if match[12]:
        hour = hour % 12 + 12 * (match[12] in "Pp")
    return 3600 * hour + 60 * int(match[9]) + int(match[10])


def _layout(line: str) -> Layout | None:
    """Return the layout of a row with one stamp and at least one number."""
    for pattern in (_STAMP_BEFORE_COMMA, _STAMP):
        # With an integer instead of the stamp, the other columns show the decimal mark.
        layout = layout_of(pattern.sub("0", line)) if len(pattern.findall(line)) == 1 else None
        if (
            layout is not None
            and layout.n_columns > 1
            and (pattern is _STAMP_BEFORE_COMMA) == (layout.delimiter == ",")
        ):
            fields = layout.fields(pattern.sub("!", line))
            return _stamped(layout, pattern, line, fields.index("!")) if "!" in fields else None
    return None


def _stamped(layout: Layout, pattern: re.Pattern[str], line: str, stamp: int) -> Layout:
    found = pattern.search(line)
    date = found[0][: found.start(8) - found.start()] if found else ""
    return replace(layout, stamp=stamp, has_date_column=any(mark in date for mark in ",;\t|"))


_WITH_UNIT = re.compile(r"(.*[\d.])\s*([^\d\s.][^\d]*\d?)")


def loose_layout_of(line: str, following: str, above: Sequence[str]) -> Layout | None:
    """Return the layout of `line` if it has words or units beside its numbers, as the next row; else None."""
    if (first := _loose(line)) is None or (second := _loose(following)) is None:
        return None
    if not _like(first, second) or {*first.words} != {*second.words}:
        return None
    # Lines such as "serial, 123" above each other are no rows; names above rows or words that repeat show a table.
    repeats = all(first.fields(line)[at] == first.fields(following)[at] for at in first.words)
    names = [column.name for column in read_header(above, first).columns]
    return first if repeats or (names and not any(map(first.number, names))) else None


def _loose(line: str) -> Layout | None:
    for mark in ";\t|,":
        if mark not in line:
            continue
        pattern = _STAMP_BEFORE_COMMA if mark == "," else _STAMP
        layout = Layout(delimiter=mark, n_columns=0, decimal_comma=mark != "," and "," in line and "." not in line)
        fields = layout.fields(pattern.sub("!", line))
        words, units, n_numbers = list[int](), list[tuple[int, str]](), 0
        for at, text in enumerate(fields):
            match = _WITH_UNIT.fullmatch(text)
            if text in ("", "!") or layout.number(text):
                n_numbers += text not in ("", "!")
            elif match and layout.number(match[1]) and (known_unit(match[2]) or _is_time_unit(match[2])):
                units.append((at, match[2].strip()))
            elif text[0].isalpha():
                words.append(at)
            else:
                return None
        if fields.count("!") > 1 or n_numbers + len(units) == 0:
            return None
        layout = replace(layout, n_columns=len(fields), words=tuple(words), units=tuple(units))
        return _stamped(layout, pattern, line, fields.index("!")) if "!" in fields else layout
    return None


def _seconds(match: re.Match[str], mark: str) -> str:
    try:
        total_seconds = 86400 * _day(*match.groups()[:7]) + _second(match)
    except (OverflowError, ValueError):
        # No such day: the unchanged stamp is later reported as a field that is not a number.
        return match[0]
    if total_seconds < 0:
        return match[0]
    return f"{total_seconds}{mark}{match[11]}" if match[11] else str(total_seconds)


# ---- the lines above the numbers: names, units, sampling rate, start -------------------------------------------------

_IN_BRACKETS = re.compile(r"(.*)[(\[{<]([^()\[\]{}<>]*)[)\]}>]")
#: A decimal comma has not three digits behind it, which might be thousands.
_STATED_NUMBER = r"([+-]?\d[\d.]*(?:,\d{1,2}|,\d{4,})?(?:[eE][+-]?\d+)?)"
_STATED_RATE = re.compile(
    r"[\s#%;/\"]*(?i:(?:sampling|sample|data)[ _-]?(?:rate|frequency|freq)|fs|abtast(?:rate|frequenz)|采样率|采样频率)"
    r"[\s\"]*(?:[(\[]\s*([kKMG]?(?i:hz))\s*[)\]])?"
    rf"[\s\":=,;]+{_STATED_NUMBER}[\s\",;]*([kKMG]?(?i:hz)|(?i:s/s|sps))?[\s\",;.]*"
)
_STATED_INTERVAL = re.compile(
    r"[\s#%;/\"]*(?i:(?:sampling|sample|time)[ _-]?(?:interval|period|step)|delta[ _]?[tx]|dt|采样间隔|采样周期)[\s\"]*"
    rf"(?:[(\[]\s*([mnuµ]?s)\s*[)\]])?[\s\":=,;]+{_STATED_NUMBER}[\s\",;]*([mnuµ]?s(?:ec)?)?[\s\",;.]*"
)
#: Between several statements of one comment, as in "config: fs = 1000 Hz, filter = 488 Hz".
_PARTS = re.compile(r"(?:[,;]|(?<=[A-Za-z]):)\s+(?=[^\W\d])")
_STATED_START = re.compile(
    r"[\s#%;/\"]*(?i:start[ _-]?(?:date[ _-]?)?time|start(?:ed)?|recorded|date[ _-]?time)[\s\"]*[:=,;\t][\s\"]*"
    r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d[\d:.+Z-]*)[\s\",;]*"
)
_STATED_UNIT = re.compile(r"[\s#%;/\"]*(?i:units?|einheit|单位)[\s\"]*[:=;][\s\"]*([^\s\",;]+)[\s\",;]*")
#: A sensitivity or a gain of all channels, or one of each with commas or semicolons between them.
_STATED_CHAIN = re.compile(
    r"[\s#%;/\"]*(?:sensor[\s_-]*|transducer[\s_-]*|charge[\s_-]*)?(sensitivity|sensitivities|gain|gains)\s*"
    r"(?:[\[(]\s*(.+?)\s*[\])]\s*)?[:=]\s*(.*?)[\s\";,]*",
    re.IGNORECASE,
)
#: Numbers with a decimal comma and a unit, semicolons between them.
_DECIMAL_COMMAS = re.compile(r"\s*\d+,\d+\s*[^\d\s,;][^,;]*(?:;\s*\d+(?:,\d+)?\s*[^\d\s,;][^,;]*)*")
_COLUMNS_FOLLOW = re.compile(
    r"(?i:columns?|fields?|channels?|header|(?:channel[ _]?)?names?|units?|einheiten)\s*[:=]\s*"
)
_WORDS_WITH_BRACKETS = re.compile(r'"[^"]*"|[^\s()\[\]]+(?:\s*[(\[][^()\[\]]*[)\]])?|[(\[][^()\[\]]*[)\]]')

#: Greek mu to the micro sign, full-width punctuation of Chinese headers to ASCII.
_SAME = str.maketrans("\u03bc（）［］：；，＝　", "µ()[]:;,= ")

#: Longest name of a column.
_MAX_NAME_LENGTH = 200


@dataclass(frozen=True, kw_only=True)
class ColumnHeader:
    """Name and unit of a column from its header, "" if missing."""

    name: str = ""
    unit: str = ""

    @property
    def is_named_time(self) -> bool:
        """Whether the name means time."""
        return begins_as_time(self.name)

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
    """Metadata above the numbers; no columns if no line has as many fields as the rows."""

    columns: tuple[ColumnHeader, ...] = ()
    sampling_rates: tuple[float, ...] = ()
    unit: str | None = None
    start_time: datetime | None = None
    sensitivities: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()


def stated_chain(line: str) -> tuple[str, tuple[str, ...]] | None:
    """Return "sensitivities" or "gains" and the values that a line states, None for any other line."""
    match = _STATED_CHAIN.fullmatch(line)
    if match is None:
        return None
    listed = re.split("[,;]", match[3])
    if not match[2] and _DECIMAL_COMMAS.fullmatch(match[3]):
        listed = match[3].replace(",", ".").split(";")
    values = [f"{value.strip()} {match[2] or ''}".strip() for value in listed]
    if match[1].lower().startswith("gain"):
        return "gains", tuple(values)
    numbers = [number_and_unit(value) for value in values]
    is_whole = all(number is not None and ratio_of(number[1]) is not None for number in numbers)
    return ("sensitivities", tuple(values)) if is_whole else None


def column_of(text: str) -> ColumnHeader:
    """Return name and unit of a field of a header."""
    text = " ".join(text.translate(_SAME).strip("\"' \t\r\n").split())
    if len(text) > _MAX_NAME_LENGTH:
        return ColumnHeader(name=text[:_MAX_NAME_LENGTH])
    # Alone, S may be a channel as well as X and Y.
    if text in KNOWN_UNITS or (_is_time_unit(text) and not text.isupper()):
        return ColumnHeader(unit=text)
    if match := _IN_BRACKETS.fullmatch(text):
        return ColumnHeader(name=match[1].rstrip(" /_"), unit=match[2].strip())
    for mark in "/_ ":
        # Units contain slashes, names rarely do: split at the first slash, but at the last underscore or blank.
        name, _, unit = text.partition(mark) if mark == "/" else text.rpartition(mark)
        name, unit = name.strip(), unit.strip()
        is_time = _is_time_unit(unit) and (begins_as_time(name) or is_time_name(name))
        if any(character.isalpha() for character in name) and (
            unit in KNOWN_UNITS or is_time or (known_unit(unit) and not unit.isalpha())
        ):
            return ColumnHeader(name=name, unit=unit)
    return ColumnHeader(name=text)


def read_header(lines: Iterable[str], layout: Layout) -> Header:
    """Parse `lines`, those above the first row, for rows of this layout."""
    # The last line with as many fields as the rows names the columns; a known unit or a name for time is preferred. A
    # line of units may follow.
    header = Header()
    best: tuple[ColumnHeader, ...] = ()
    before: tuple[ColumnHeader, ...] = ()
    fields: list[str] = []
    for written in lines:
        line = written.translate(_SAME)
        comment = line[:_MAX_NAME_LENGTH]
        above, fields = fields, list(map(str.strip, line.split(layout.delimiter)))
        if step := _increment(above, fields):
            # Some oscilloscopes write start and increment of the times above columns that do not exist.
            header = replace(header, sampling_rates=(*header.sampling_rates, 1 / step))
            names = tuple(column_of(name) for name in above if name.lower() not in ("", "start", "increment"))
            if len(names) == layout.n_columns:
                best = _under(names, tuple(map(column_of, fields[: len(names)])))
        elif (rate := _stated_rate(comment)) is not None:
            header = replace(header, sampling_rates=(*header.sampling_rates, rate))
        elif match := _STATED_START.fullmatch(comment):
            with suppress(ValueError):
                header = replace(header, start_time=datetime.fromisoformat(match[1]))
        elif match := _STATED_UNIT.fullmatch(comment):
            header = replace(header, unit=known_unit(match[1]))
        elif chain := stated_chain(comment):
            what, values = chain
            header = replace(header, gains=values) if what == "gains" else replace(header, sensitivities=values)
        elif columns := _columns(line, layout):
            columns = _under(before, columns) if before else columns
            if not best or _has_unit_or_time(columns) or not _has_unit_or_time(best):
                best = columns
            before = columns
    named = tuple(replace(column, name=column.name or column.unit) for column in best)
    return replace(header, columns=named)


def _increment(names: list[str], values: list[str]) -> float | None:
    """Return the number above 0 below the name Increment, None without one."""
    found = [value for name, value in zip(names, values, strict=False) if name.lower() == "increment"]
    step = float(found[0]) if found and NUMBER.fullmatch(found[0]) else 0.0
    return step if 0 < step < math.inf else None


def _is_time_unit(text: str) -> bool:
    return bool(text) and seconds_of(text) is not None


def _stated_rate(comment: str) -> float | None:
    """Return the sampling rate [Hz] that a line states, directly or by its interval."""
    if len(parts := _PARTS.split(comment)) > 1 and is_comment(comment):
        return next((rate for part in parts if (rate := _stated_rate(part)) is not None), None)
    with suppress(ValueError):  # a number with two points
        if match := _STATED_RATE.fullmatch(comment):
            return float(match[2].replace(",", ".")) * (hertz_of(match[3] or match[1] or "") or 1.0)
        if match := _STATED_INTERVAL.fullmatch(comment):
            interval = float(match[2].replace(",", ".")) * (seconds_of(match[3] or match[1] or "") or 1.0)
            return 1 / interval if interval else math.inf
    return None


def _columns(line: str, layout: Layout) -> tuple[ColumnHeader, ...]:
    text = re.sub(r"^\s*(?:#+|%+|//+)", "", line).strip(" \r\n")
    if text.startswith(";") and text.count(";") != layout.n_columns - 1:
        text = text.lstrip("; ")
    follow = _COLUMNS_FOLLOW.match(text)
    text = text[follow.end() :] if follow else text
    for fields in _divisions(text, layout):
        while len(fields) > layout.n_columns and not fields[-1].strip():
            fields = fields[:-1]
        if follow and len(fields) == layout.n_columns - 1 and len(fields) > 1:
            # Names and units of the channels, none of the times before them.
            fields = ["s", *fields]
        if layout.has_date_column and layout.stamp is not None and len(fields) == layout.n_columns + 1:
            del fields[layout.stamp]
        # "Operator: Smith" is a comment, not a name.
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


def _under(names: tuple[ColumnHeader, ...], units: tuple[ColumnHeader, ...]) -> tuple[ColumnHeader, ...]:
    # Written out ("Volt") or unknown, a unit looks like a name.
    is_units = all(not one.name for one in units) or (
        all(not one.name or not (one.unit or one.is_named_time) for one in units)
        and any(not one.name or known_unit(one.name) for one in units)
    )
    if not is_units:
        return units
    pairs = zip(names, units, strict=True)
    return tuple(ColumnHeader(name=name.name, unit=unit.unit or unit.name or name.unit) for name, unit in pairs)


def _has_unit_or_time(columns: tuple[ColumnHeader, ...]) -> bool:
    return any(column.is_named_time or column.known_unit or column.has_time_unit for column in columns)

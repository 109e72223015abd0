"""What the lines above the numbers say: names, units, sampling rate.

The time column of a text file: which one it is, and the sampling rate it gives.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.text_layout import Layout
from cgid.signals import KNOWN_UNITS

#: Time units of a column -> factor to seconds.
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "second", "seconds", "Sekunden"), 1.0),
    **dict.fromkeys(("ms", "msec", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "µsec", "microseconds"), 1e-6),
}

_TIME_NAME = re.compile(r"(?i:time|zeit|temps|tiempo|tempo|时间|時間)|t(?![^\W\d_])")
_IN_BRACKETS = re.compile(r"(.*)[(\[{<]([^()\[\]{}<>]*)[)\]}>]")
_STATED_RATE = re.compile(
    r"[\s#%;/\"]*(?i:(?:sampling|sample)[ _-]?(?:rate|frequency|freq)|fs|abtastrate|abtastfrequenz|采样率|采样频率)"
    r"[\s\"]*(?:[(\[]\s*([kKMG]?)(?i:hz)\s*[)\]])?"
    r"[\s\":=,;]+([+-]?\d[\d.]*(?:[eE][+-]?\d+)?)[\s\",;]*(?:([kKMG]?)(?i:hz)|(?i:s/s|sps))?[\s\",;.]*"
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
_PREFIXES = {"": 1.0, "k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}

#: Greek mu to the micro sign, full-width marks of Chinese headers to those of ASCII.
_SAME = str.maketrans("\u03bc（）［］：；，＝　", "µ()[]:;,= ")

#: Longer texts are no names of columns.
_LONGEST_NAME = 200


@dataclass(frozen=True, kw_only=True)
class Column:
    """Name and unit of a column as its header gives them, "" where it does not."""

    name: str = ""
    unit: str = ""

    @property
    def is_named_time(self) -> bool:
        """Whether the name is one for time."""
        return bool(_TIME_NAME.match(self.name))

    @property
    def known_unit(self) -> str | None:
        """The unit if it is one of `cgid.signals.UNITS`."""
        return self.unit if self.unit in KNOWN_UNITS else None


@dataclass(frozen=True, kw_only=True)
class Header:
    """What the lines above the numbers say; no columns if none of them has as many fields as the rows.

    Several lines may state a sampling rate [Hz].
    """

    columns: tuple[Column, ...] = ()
    sampling_rates: tuple[float, ...] = ()
    unit: str | None = None
    start_time: datetime | None = None


def column_of(text: str) -> Column:
    """Return name and unit of one field of a header.

    Examples
    --------
    >>> [(c.name, c.unit) for c in map(column_of, ["force [kN]", "F/kN", "time_s", "a (m/s^2)", "(ms)", "left"])]
    [('force', 'kN'), ('F', 'kN'), ('time', 's'), ('a', 'm/s^2'), ('', 'ms'), ('left', '')]
    """
    text = " ".join(text.translate(_SAME).strip("\"' \t\r\n").split())
    if len(text) > _LONGEST_NAME:
        return Column(name=text[:_LONGEST_NAME])
    if text in KNOWN_UNITS or text in TIME_UNITS:
        return Column(unit=text)
    if found := _IN_BRACKETS.fullmatch(text):
        return Column(name=found[1].rstrip(" /_"), unit=found[2].strip())
    for mark in "/_ ":
        # A unit may hold a slash itself, a name rarely; so the first slash divides, but the last _ or blank.
        name, _, unit = text.partition(mark) if mark == "/" else text.rpartition(mark)
        name, unit = name.strip(), unit.strip()
        is_time = unit in TIME_UNITS and _TIME_NAME.match(name)
        if any(character.isalpha() for character in name) and (unit in KNOWN_UNITS or is_time):
            return Column(name=name, unit=unit)
    return Column(name=text)


def read_header(lines: Iterable[str], layout: Layout) -> Header:
    """Return what `lines`, those above the first row, say about rows of that layout.

    The last line that has as many fields as the rows names the columns; one with a known unit or a name for
    time is preferred. A line of units alone may follow the line of the names.
    """
    header = Header()
    best: tuple[Column, ...] = ()
    before: tuple[Column, ...] = ()
    for written in lines:
        line = written.translate(_SAME)
        remark = line[:_LONGEST_NAME]
        if (rate := _stated_rate(remark)) is not None:
            header = replace(header, sampling_rates=(*header.sampling_rates, rate))
        elif found := _STATED_START.fullmatch(remark):
            header = replace(header, start_time=_date(found[1]) or header.start_time)
        elif found := _STATED_UNIT.fullmatch(remark):
            unit = found[1].strip("()[]")
            header = replace(header, unit=unit if unit in KNOWN_UNITS else None)
        elif columns := _columns(line, layout):
            columns = _under(before, columns)
            if _is_telling(columns) or not _is_telling(best):
                best = columns
            before = columns
    named = tuple(replace(column, name=column.name or column.unit) for column in best)
    return replace(header, columns=named)


def _stated_rate(remark: str) -> float | None:
    """Return the sampling rate [Hz] that a line states, by itself or by its interval."""
    try:
        if found := _STATED_RATE.fullmatch(remark):
            return float(found[2]) * _PREFIXES[found[3] or found[1] or ""]
        if found := _STATED_INTERVAL.fullmatch(remark):
            interval = float(found[2]) * _SECONDS[(found[3] or found[1] or "").removesuffix("ec")]
            return 1 / interval if interval else math.inf
    except ValueError:
        # Two points in one number.
        pass
    return None


def _date(text: str) -> datetime | None:
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None


def _columns(line: str, layout: Layout) -> tuple[Column, ...]:
    text = re.sub(r"^\s*(?:#+|%+|//+)", "", line).strip(" \r\n")
    if text.startswith(";") and text.count(";") != layout.n_columns - 1:
        text = text.lstrip("; ")
    text = _COLUMNS_FOLLOW.sub("", text, count=1) if _COLUMNS_FOLLOW.match(text) else text
    for fields in _divisions(text, layout):
        while len(fields) > layout.n_columns and not fields[-1].strip():
            fields = fields[:-1]
        # "Operator: somebody" is a remark, not a name.
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


def _is_telling(columns: tuple[Column, ...]) -> bool:
    return any(column.is_named_time or column.known_unit or column.unit in TIME_UNITS for column in columns)


Floats = NDArray[np.float64]

#: Steps may differ from each other by this part of a step.
EVENNESS = 0.01

#: A step must be this many printed digits long before uneven steps are taken for their rounding.
_COARSEST_STEP = 1.5


def time_columns(columns: tuple[Column, ...], rows: Floats) -> list[int]:
    """Return the indices of the columns of time, of which the first one counts.

    Parameters
    ----------
    columns : tuple of Column
        From the header; empty without one.
    rows : ndarray, (n_samples, n_columns)

    Returns
    -------
    list of int
        The first column whose name is one for time, else the first in a unit of time. Without a header, the
        first of several columns if it increases in even steps. Then those further ones that are named time and
        increase in even steps, as programs write that give each channel a time of its own.
    """
    if len(columns) == 1 and " " in columns[0].name:
        # Above a single column any remark passes for its name, even "time of day unknown".
        return []
    named = [index for index, column in enumerate(columns) if column.is_named_time and column.known_unit in (None, "m")]
    if named:
        return named[:1] + [index for index in named[1:] if _runs_evenly(rows[:, index])]
    for index, column in enumerate(columns):
        if column.unit in TIME_UNITS:
            return [index]
    return [0] if not columns and rows.shape[1] > 1 and _runs_evenly(rows[:, 0]) else []


def _runs_evenly(times: Floats) -> bool:
    # Two rows have one step, which is even whatever it is.
    if len(times) < 3:
        return False
    with np.errstate(all="ignore"):
        steps = np.diff(times)
    return bool(np.isfinite(steps).all() and (steps > 0).all() and _typical_if_uneven(times, steps) is None)


def seconds(column: Column, source: str) -> float:
    """Return the factor from the unit of a time column to seconds; without a unit it is 1.

    Raises
    ------
    BadData
        The unit is none of s, ms, us.
    """
    if not column.unit:
        return 1.0
    if column.unit not in TIME_UNITS:
        raise BadData(f"{source}: the time column must be in s, ms or us, its header says {column.unit!r}; convert it")
    return TIME_UNITS[column.unit]


def rate_of(times: Floats, source: str) -> float:
    """Return the sampling rate [Hz] of even times [s], (n - 1) / (last - first).

    Parameters
    ----------
    times : ndarray, (n_samples,)
        [s], two or more.
    source : str
        Name of the file in messages.

    Raises
    ------
    BadData
        The times do not increase, or their steps differ by more than 1 % beyond the rounding of the printed
        digits; the sample is named.

    Examples
    --------
    >>> rate_of(np.array([0.0, 0.5, 1.0]), "example")
    2.0
    """
    require_even(times, source)
    with np.errstate(all="ignore"):
        rate = float((len(times) - 1) / (times[-1] - times[0]))
    if not (np.isfinite(rate) and rate > 0):
        raise BadData(f"{source}: the time column gives a sampling rate of {rate:g} Hz; check its unit")
    return rate


def require_even(times: Floats, source: str, *, first: int = 0, step: float | None = None) -> None:
    """Raise `BadData` as `rate_of` does; of a piece of a recording, its `first` sample and the usual step [s] are told.

    Examples
    --------
    >>> require_even(np.array([2.5, 3.0, 3.5]), "example", first=5, step=0.5)
    """
    with np.errstate(all="ignore"):
        steps = np.diff(times)
    rising = steps > 0
    if not rising.all():
        at = int(np.argmin(rising)) + 1
        raise BadData(
            f"{source}: the time column must increase, sample {first + at} is at {times[at]:.9g} s after "
            f"{times[at - 1]:.9g} s; print more digits, or sort and cut the recording there"
        )
    if not np.isfinite(steps).all():
        raise BadData(
            f"{source}: the time column must span a finite time, it goes from {times[0]:g} to {times[-1]:g} s; "
            "correct it"
        )
    typical = _typical_if_uneven(times, steps, step)
    if typical is not None:
        at = int(np.argmax(np.abs(steps - typical))) + 1
        raise BadData(
            f"{source}: the time column must have even steps to 1 %, sample {first + at} at {times[at]:.9g} s comes "
            f"{steps[at - 1]:.6g} s after the one before, the usual step is {typical:.6g} s; resample the recording"
        )


def is_resolved(times: Floats, step: float) -> bool:
    """Return whether times are printed so finely that their steps can be told to be even."""
    return bool(np.isfinite(times).all() and np.any(times)) and _COARSEST_STEP * _printed_digit(times) <= step


class EvenTimes:
    """The times of a recording, checked as they come piece by piece.

    Parameters
    ----------
    sampling_rate : float
        [Hz], of the whole recording.
    source : str
        Name of the file in messages.
    """

    def __init__(self, sampling_rate: float, source: str) -> None:
        self._step, self._source = 1 / sampling_rate, source
        self._count, self._last = 0, np.empty(0)

    def feed(self, times: Floats) -> None:
        """Take the times [s] of the next samples; raises as `require_even`."""
        joined = np.concatenate([self._last, times])
        if len(joined) > 1:
            require_even(joined, self._source, first=self._count - len(self._last), step=self._step)
        self._count += len(times)
        self._last = joined[-1:]


def refined_rate(rate: float, first: float, last: float) -> float:
    """Return the sampling rate [Hz] from the first and last time [s] of a recording, near the `rate` of its beginning.

    The times of a recording lie a whole number of steps apart. The printed digits of n samples give the rate to
    1 / n at worst, and what is refined cannot be worse than that.

    Examples
    --------
    >>> refined_rate(1000.01, 0.0, 20.0)
    1000.0
    """
    span = last - first
    if not (np.isfinite(span) and span * rate > 1):
        return rate
    return round(span * rate) / span


@np.errstate(all="ignore")
def _typical_if_uneven(times: Floats, steps: Floats, typical: float | None = None) -> float | None:
    """Return None if the steps are even, else the typical step."""
    shortest, longest = float(steps.min()), float(steps.max())
    typical = typical or float(np.median(steps))
    # One percent either side of the typical step.
    if longest - typical <= EVENNESS * typical and typical - shortest <= EVENNESS * typical:
        return None
    # Even times rounded to a digit q have steps of two neighbouring multiples of q and no third one. A gap where
    # the step is one q long looks the same; then the rounding is not believed.
    digit = _printed_digit(times)
    if shortest >= _COARSEST_STEP * digit and longest - shortest <= digit + EVENNESS * typical:
        return None
    return typical


def _printed_digit(times: Floats) -> float:
    """Return the last decimal place to which the latest times are printed, such as 1e-5."""
    sizes = np.abs(times)
    largest = float(sizes.max())
    # Times printed to a fixed number of significant digits lose one at each power of ten. The few behind the last
    # power may all end in zeros by chance, so they count for one place only.
    last_power = 10.0 ** math.floor(math.log10(largest))
    return min(_last_digit(sizes[sizes >= last_power]), 10 * _last_digit(sizes[sizes >= largest / 2]))


def _last_digit(sizes: Floats) -> float:
    places = math.floor(math.log10(float(sizes.max())))
    for place in range(places, max(places - 17, -300), -1):
        in_digits = sizes * 10.0**-place
        if (np.abs(in_digits - np.rint(in_digits)) <= 4e-16 * in_digits).all():
            return float(10.0**place)
    return 0.0

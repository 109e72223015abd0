"""What the times of samples are and the rate that they give, for all readers: columns of a table, arrays, stamps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import STATED_RATE
from cgid.errors import BadData
from cgid.recordings.gaps import counts
from cgid.units import hertz_of, seconds_of

if TYPE_CHECKING:
    from cgid.recordings.text_layout import ColumnHeader

Floats = NDArray[np.float64]

#: Largest difference from the usual step, relative to it.
EVENNESS = 0.01

#: Uneven steps may be due to rounding only if a step spans at least this many units of the last printed digit.
_COARSEST_STEP = 1.5

#: Longest gap [s], most of them for each sample, and how well the usual step is known.
MAX_GAP, MOST_GAPS, RATE_ERROR = 10.0, 0.05, 1e-4

#: A jump of rounded times is at most so many of their last digits.
_ROUNDED = 1.5

#: Numbers of this size count from 1970 in s; each thousandth of a second makes them a thousand times as large.
_EPOCH = 1e9
#: No time is later [s since 1970]: the year 5138.
_LATEST = 1e11
#: Days since 1900 (spreadsheets), since the year 0 (MATLAB), and the longest step of samples in days.
_SPREADSHEET_DAYS = (20_000.0, 80_000.0)
_MATLAB_DAYS = (690_000.0, 800_000.0)
_STEP_IN_DAYS = 1e-6
_DAY = 86_400.0
#: Counters of microcontrollers begin again after so many of their units.
_COUNTER = 2.0**32

#: Last words of names: units of time, the greatest first; a year or a month does not change within a recording.
_WORDS = (
    (0.0, "year|yyyy"),
    (0.0, "month|mon|mm"),
    (_DAY, "day|dd"),
    (3600.0, "hours?|hh"),
    (60.0, "minutes?|min"),
    (1.0, "seconds?|secs?|s"),
    (1e-3, "milliseconds?|millisecs?|msecs?|millis|ms"),
    (1e-6, "microseconds?|microsecs?|usecs?|micros|us|µs"),
    (1e-9, "nanoseconds?|nanosecs?|nsecs?|ns"),
)
_LAST_WORD = re.compile(r"(?:.*[\s_./-])?([a-zµ]+)", re.IGNORECASE)

#: Names of times; a capital T may as well be a temperature or a torque.
_TIME_NAME = re.compile(
    r"(?i:(?:.*[\s_./%-])?(?:times?|timestamps?|stamps?|zeit|zeitstempel|temps|tiempo|时间|時間)(?:[\s_.(\[-].*)?"
    r"|micros|millis|(?:nano|micro|milli)?sec(?:ond)?s?|[nmu]secs?)"
    r"|t(?:\s*[(\[].*|_(?:m|u|µ|n)?s)?"
)
#: How names of the columns of a text begin.
_BEGINS_AS_TIME = re.compile(r"(?i:time|zeit|temps|tiempo|tempo|时间|時間)|t(?![^\W\d_])")


def is_time_name(name: str) -> bool:
    """Return whether the name of an array means the times of samples."""
    return _TIME_NAME.fullmatch(name) is not None


def begins_as_time(name: str) -> bool:
    """Return whether the name of a column may mean times."""
    return _BEGINS_AS_TIME.match(name) is not None


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Columns whose sum is the time, each times its factor [s], and after how long [s] they begin again."""

    columns: tuple[int, ...]
    factors: tuple[float, ...]
    period: float = math.inf

    def times(self, rows: Floats) -> Floats:
        """Return the times [s] of rows (n_samples, n_columns)."""
        times = sum(factor * rows[:, at] for at, factor in zip(self.columns, self.factors, strict=True))
        return unwrapped(np.asarray(times), self.period)


def unwrapped(times: Floats, period: float) -> Floats:
    """Return times [s] that go on where a clock begins again, such as at midnight."""
    if not math.isfinite(period):
        return times
    back = np.rint(-np.diff(times, prepend=times[:1]) / period)
    return times + period * np.cumsum(back)


def clocks_of(columns: Sequence[ColumnHeader], rows: Floats, source: str) -> list[Clock]:
    """Return the times among columns, by their headers and first rows (n_samples, n_columns); several must agree.

    Some programs write one column of times for each channel. Without headers it is the first of several columns, if it
    increases in even steps.
    """
    if not columns:
        is_time = rows.shape[1] > 1 and runs_evenly(rows[:, 0]) and not counts("", rows[:, 0])
        return [Clock(columns=(0,), factors=(_by_size(rows[:, 0], source),))] if is_time else []
    if len(columns) > 1 and (parts := _parts(columns, rows)):
        return [Clock(columns=tuple(parts), factors=tuple(_WORDS[part][0] for part in parts.values()))]
    named = [at for at, column in enumerate(columns) if column.is_named_time and column.known_unit in (None, "m")]
    loose = [at for at, one in enumerate(columns) if is_time_name(one.name) and one.known_unit in (None, "m")]
    named = named or [at for at in loose if len(rows) < 3 or runs_evenly(rows[:, at])] or loose[:1]
    named = named[:1] + [at for at in named[1:] if runs_evenly(rows[:, at])]
    named = named or [at for at, column in enumerate(columns) if column.has_time_unit][:1]
    if not named and hertz_of(columns[0].unit or "-") is not None and runs_evenly(rows[:, 0]):
        seconds(columns[0].unit, source)
    return [clock_of(columns[at], rows[:, at], source, at) for at in named]


def clock_of(column: ColumnHeader, times: Floats, source: str, at: int = 0) -> Clock:
    """Return the clock of one column of times: its unit is stated, else in its name, else told by the numbers."""
    place = None if column.unit else part(column.name)
    factor = _WORDS[place][0] if place is not None else 0.0
    if not 0 < factor < 1:
        factor = _by_size(times, source) if not column.unit else seconds(column.unit, source)
        finite = times[np.isfinite(times)]
        if column.unit and finite.size and abs(finite[0]) * factor > _LATEST:
            raise BadData(
                f"{source}: the time column must be in its unit, {finite[0]:.10g} is no time in {column.unit}; since "
                "1970 in ms, us or ns it may be one: correct the unit"
            )
    is_counter = column.name.lower() in ("micros", "millis")
    return Clock(columns=(at,), factors=(factor,), period=_COUNTER * factor if is_counter else math.inf)


@np.errstate(all="ignore")
def _by_size(times: Floats, source: str) -> float:
    """Return the factor to s of times without a unit: numbers as large as times since 1970 are such ones."""
    finite = times[np.isfinite(times)]
    first, step = (float(finite[0]), float(np.median(np.diff(finite)))) if finite.size > 1 else (0.0, 0.0)
    is_days = any(low <= first <= high for low, high in (_SPREADSHEET_DAYS, _MATLAB_DAYS))
    if is_days and 0 < step < _STEP_IN_DAYS:
        return _DAY
    if first < _EPOCH:
        return 1.0
    factor = next((one for one in (1.0, 1e-3, 1e-6, 1e-9) if first * one <= _LATEST), 0.0)
    if step * factor > 1 or not factor:
        raise BadData(
            f"{source}: times of {first:.10g} without a unit must be since 1970, in s, ms, us or ns by their size, but "
            f"then they are {step * factor:.6g} s apart; state their unit in the header"
        )
    return factor


def part(name: str) -> int | None:
    """Return the place in `_WORDS` of the last word of a name, None for another word."""
    match = _LAST_WORD.fullmatch(name)
    return next((at for at, (_, words) in enumerate(_WORDS) if match and re.fullmatch(words, match[1].lower())), None)


def _parts(columns: Sequence[ColumnHeader], rows: Floats) -> dict[int, int]:
    """Return columns that are one time, such as Hour, Minute, Second or sec, nanosec, and their places in `_WORDS`."""
    parts: dict[int, int] = {}
    seconds_at = next(at for at, (factor, _) in enumerate(_WORDS) if factor == 1)
    for at, column in enumerate(columns):
        place = part(f"{column.name} {column.unit}".strip())
        last = list(parts.values())[-1:]
        if place is not None and (not last or (last[0] < place and at - 1 in parts)):
            parts[at] = place
        elif len(parts) < 2:
            parts = {} if place is None else {at: place}
    whole = [at for at, part in parts.items() if part <= seconds_at]
    # Each column that runs evenly is a time of its own.
    if len(parts) < 2 or seconds_at not in parts.values() or runs_evenly(rows[:, whole[0]]):
        return {}
    return parts


def seconds(unit: str, source: str) -> float:
    """Return the factor from a unit of times to seconds, 1 for ""; raise `BadData` for other units."""
    factor = seconds_of(unit)
    if factor is None and hertz_of(unit) is not None:
        raise BadData(
            f"{source}: a recording must be samples over time, this is a spectrum over {unit}; export the time signal"
        )
    if factor is None:
        raise BadData(f"{source}: the time column must be in s, ms or us, its header states {unit!r}; convert it")
    return factor


def rate_of(times: Floats, source: str, given: float | None = None) -> float:
    """Return the sampling rate [Hz] of two or more even times [s]; steps may differ by 1 % and the printed digits.

    It is the `given` rate if the times are only rounded.
    """
    if given is not None and not runs_evenly(times) and _is_rounded(times, 1 / given):
        return given
    n_lost = lost_before(times, source)
    if np.count_nonzero(n_lost) > MOST_GAPS * len(times):
        raise _uneven(times, float(np.median(np.diff(times))), source, 0)
    with np.errstate(all="ignore"):
        rate = float((len(times) - 1 + n_lost.sum()) / (times[-1] - times[0]))
    if not (np.isfinite(rate) and rate > 0):
        raise BadData(f"{source}: the time column gives a sampling rate of {rate:g} Hz; check its unit")
    return rate


def lost_before(
    times: Floats, source: str, *, first: int = 0, step: float | None = None, given: float | None = None
) -> NDArray[np.int64]:
    """Return the number of samples missing before each time but the first, (len(times) - 1,), where others are even.

    Raises `BadData` as `rate_of`, for a piece of a recording from sample `first` on, of a usual step [s].
    """
    with np.errstate(all="ignore"):
        steps = np.diff(times)
    if given is not None and _is_rounded(times, 1 / given):
        return np.zeros(len(steps), np.int64)
    rising = steps > 0
    if not rising.all():
        at = int(np.argmin(rising)) + 1
        raise BadData(
            f"{source}: the time column must increase, sample {first + at} is at {times[at]:.9g} s after "
            f"{times[at - 1]:.9g} s; print more digits, sort or cut the recording there, or give its "
            f"{spelled('sampling_rate')} if the "
            "times are only rounded"
        )
    if not np.isfinite(steps).all():
        raise BadData(
            f"{source}: the time column must span a finite time, it goes from {times[0]:g} to {times[-1]:g} s; "
            "correct it"
        )
    typical = _typical_if_uneven(times, steps, step)
    n_lost = np.zeros(len(steps), np.int64)
    if typical is None:
        return n_lost
    digit = _printed_digit(times)
    long = steps > 1.5 * typical + digit
    if long.all() and step is None:
        raise _uneven(times, typical, source, first)
    # The mean of the others is known better than the printed digits show one of them.
    usual = step or float(steps[~long].mean())
    whole = np.rint(steps[long] / usual)
    off = np.abs(steps[long] - whole * usual)
    if (
        _typical_if_uneven(times, steps[~long], typical, digit) is not None
        or (off > (EVENNESS + RATE_ERROR * whole) * usual + digit).any()
        or float(steps.max()) > MAX_GAP
    ):
        raise _uneven(times, typical, source, first)
    n_lost[long] = whole - 1
    return n_lost


def _uneven(times: Floats, typical: float, source: str, first: int) -> BadData:
    steps = np.diff(times)
    at = int(np.argmax(np.abs(steps - typical))) + 1
    return BadData(
        f"{source}: the time column must have even steps to 1 %, sample {first + at} at {times[at]:.9g} s comes "
        f"{steps[at - 1]:.6g} s after the one before, the usual step is {typical:.6g} s; cut the recording there, "
        f"or give its {spelled('sampling_rate')} if the times are only rounded"
    )


@np.errstate(all="ignore")
def _is_rounded(times: Floats, step: float) -> bool:
    """Return whether times [s] are those of a step [s] but for the rounding to their last digit."""
    if len(times) < 2 or not np.isfinite(times).all():
        return False
    n, off = np.arange(len(times)), times - times[0]
    digit = _printed_digit(times)
    slope = float(np.polyfit(n, off, 1)[0])
    allowed = _ROUNDED * digit + EVENNESS * step
    agrees = abs(slope - step) <= STATED_RATE * step + 2 * digit / n[-1]
    return bool(agrees and np.ptp(off - slope * n) <= allowed and (np.diff(times) >= 0).all())


def runs_evenly(times: Floats) -> bool:
    """Return whether numbers could be times: three or more, increasing in even steps."""
    # Two times have one step, which is always even.
    if len(times) < 3:
        return False
    with np.errstate(all="ignore"):
        steps = np.diff(times)
    return bool(np.isfinite(steps).all() and (steps > 0).all() and _typical_if_uneven(times, steps) is None)


class EvenTimes:
    """Check of the times of a recording, piece by piece; `sampling_rate` [Hz] is that of the complete recording."""

    def __init__(self, sampling_rate: float, source: str, given: float | None = None, period: float = math.inf) -> None:
        self._step, self._source, self._given, self._period = 1 / sampling_rate, source, given, period
        self._count, self._last = 0, np.empty(0)
        self._n_lost = self._n_gaps = 0
        self._first_lost = 0.0

    def feed(self, times: Floats) -> NDArray[np.int64]:
        """Return the index of each of the next times [s], whose differences above 1 are gaps; raises `BadData`."""
        joined = unwrapped(np.concatenate([self._last, times]), self._period)
        lost = np.zeros(len(times), np.int64)
        if len(joined) > 1:
            behind = len(joined) - 1
            first = self._count - len(self._last)
            lost[-behind:] = lost_before(joined, self._source, first=first, step=self._step, given=self._given)
        if lost.any():
            if not self._n_lost:
                self._first_lost = float(times[np.argmax(lost > 0)])
            self._n_gaps += int(np.count_nonzero(lost))
        places = self._count + self._n_lost + np.arange(len(times)) + np.cumsum(lost)
        self._count, self._n_lost = self._count + len(times), self._n_lost + int(lost.sum())
        self._last = joined[-1:]
        return places

    @property
    def message(self) -> list[str]:
        """What is missing so far, one line at most."""
        if not self._n_lost:
            return []
        return [
            f"{counted(self._n_lost, 'sample')} in {counted(self._n_gaps, 'gap')} of the times "
            f"{'is' if self._n_lost == 1 else 'are'} missing, the first before {self._first_lost:.6g} s"
        ]


def refined_rate(rate: float, first: float, last: float) -> float:
    """Return the sampling rate [Hz] from the first and last time [s] and the `rate` of the beginning."""
    # The times are a whole number of steps apart: the printed digits give the rate of n samples to 1 / n at worst.
    span = last - first
    if not (np.isfinite(span) and span * rate > 1):
        return rate
    return round(span * rate) / span


def rate_of_blocks(
    blocks: Iterable[Floats], precision: float, source: str, given: float | None = None
) -> tuple[float, list[tuple[int, int]]]:
    """Return the sampling rate [Hz] of even times [s], read once by blocks, and their gaps.

    Times of float32 may be rounded: `precision` is that of their type. A gap is the index of the time after it, and the
    number of samples missing.
    """
    gaps: list[tuple[int, int]] = []
    first = last = step = 0.0
    count = 0
    for block in blocks:
        part = np.concatenate([[last], block]) if count else block
        first = first if count else float(part[0])
        if not np.isfinite(part).all():
            raise BadData(f"{source}: times must be finite, one of the first {count + len(block)} is not; correct it")
        if len(part) > 1:
            usual = step or float(part[1:65537][-1] - part[0]) / (len(part[1:65537]))
            if not _is_even(part, usual, precision):
                # Times rounded to printed digits may still be even.
                usual = step or 1 / rate_of(part, source, given)
                first_index = count + len(block) - len(part)
                n_lost = lost_before(part, source, first=first_index, step=usual, given=given)
                gaps += [(first_index + 1 + at, int(n_lost[at])) for at in np.flatnonzero(n_lost).tolist()]
            step = usual
        last = float(part[-1])
        count += len(block)
    if not last > first:
        raise BadData(f"{source}: times must increase, they go from {first:g} to {last:g} s; correct them")
    rate = (count - 1 + sum(number for _, number in gaps)) / (last - first)
    return given if given is not None and step == 1 / given else rate, gaps


def _is_even(times: Floats, step: float, precision: float) -> bool:
    """Return whether all steps are equal within the rounding of the times."""
    rounding = 2 * precision * float(np.abs(times).max())
    # With rounding as large as a step, a missing sample would go unnoticed.
    return step > 2 * rounding and bool(np.abs(np.diff(times) - step).max() <= EVENNESS * step + rounding)


@np.errstate(all="ignore")
def _typical_if_uneven(
    times: Floats, steps: Floats, typical: float | None = None, digit: float | None = None
) -> float | None:
    """Return the typical step if the steps are uneven, else None; `digit` is the last printed one of the times."""
    if not steps.size:
        return None
    shortest, longest = float(steps.min()), float(steps.max())
    typical = typical or float(np.median(steps))
    if longest - typical <= EVENNESS * typical and typical - shortest <= EVENNESS * typical:
        return None
    # Even times rounded to a digit q have steps of two adjacent multiples of q and no others. If a step is only one q
    # long, a gap looks the same, so such times count as uneven.
    digit = _printed_digit(times) if digit is None else digit
    if shortest >= _COARSEST_STEP * digit and longest - shortest <= digit + EVENNESS * typical:
        return None
    return typical


def _printed_digit(times: Floats) -> float:
    """Return the last printed decimal place of the latest times, such as 1e-5."""
    sizes = np.abs(times)
    largest = float(sizes.max())
    if not largest:
        return 0.0
    # Times with a fixed number of significant digits lose a decimal place at each power of ten. The few after the last
    # power may all end in zeros by chance, so they remove one place only.
    last_power = 10.0 ** math.floor(math.log10(largest))
    digit = min(_last_digit(sizes[sizes >= last_power]), 10 * _last_digit(sizes[sizes >= largest / 2]))
    if largest >= _DAY * _SPREADSHEET_DAYS[0]:
        digit = max(digit, _DAY * _last_digit(sizes / _DAY))
    # Nor are they known better than their type holds them.
    return digit + 2 * float(np.spacing(largest))


def _last_digit(sizes: Floats) -> float:
    highest = math.floor(math.log10(float(sizes.max())))
    for digit in range(highest, max(highest - 17, -300), -1):
        in_digits = sizes * 10.0**-digit
        if (np.abs(in_digits - np.rint(in_digits)) <= 4e-16 * in_digits).all():
            return float(10.0**digit)
    return 0.0

"""Sampling rates from the times of samples, in a table column or in an array next to the samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid._lib.terminal import counted
from cgid.errors import BadData
from cgid.units import seconds_of

if TYPE_CHECKING:
    from cgid.recordings.variables import Variable

Floats = NDArray[np.float64]

#: Largest difference from the usual step, relative to it.
EVENNESS = 0.01

#: Uneven steps may be due to rounding only if a step spans at least this many units of the last printed digit.
_COARSEST_STEP = 1.5

#: Longest gap [s], most of them for each sample, and how well the usual step is known.
MAX_GAP, MOST_GAPS, RATE_ERROR = 10.0, 0.05, 1e-4

_BLOCK_LENGTH = 1 << 18


def seconds(unit: str, source: str) -> float:
    """Return the factor from the unit of a time column to seconds, 1 for ""; raise `BadData` for other units."""
    factor = seconds_of(unit)
    if factor is None:
        raise BadData(f"{source}: the time column must be in s, ms or us, its header states {unit!r}; convert it")
    return factor


def rate_of(times: Floats, source: str) -> float:
    """Return the sampling rate [Hz] of two or more even times [s]; steps may differ by 1 % and the printed digits."""
    n_lost = lost_before(times, source)
    if np.count_nonzero(n_lost) > MOST_GAPS * len(times):
        raise _uneven(times, float(np.median(np.diff(times))), source, 0)
    with np.errstate(all="ignore"):
        rate = float((len(times) - 1 + n_lost.sum()) / (times[-1] - times[0]))
    if not (np.isfinite(rate) and rate > 0):
        raise BadData(f"{source}: the time column gives a sampling rate of {rate:g} Hz; check its unit")
    return rate


def lost_before(times: Floats, source: str, *, first: int = 0, step: float | None = None) -> NDArray[np.int64]:
    """Return the number of samples missing before each time but the first, (len(times) - 1,), where others are even.

    Raises `BadData` as `rate_of`, for a piece of a recording from sample `first` on, of a usual step [s].
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
        f"{steps[at - 1]:.6g} s after the one before, the usual step is {typical:.6g} s; resample the recording"
    )


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

    def __init__(self, sampling_rate: float, source: str) -> None:
        self._step, self._source = 1 / sampling_rate, source
        self._count, self._last = 0, np.empty(0)
        self._n_lost = self._n_gaps = 0
        self._first_lost = 0.0

    def feed(self, times: Floats) -> NDArray[np.int64]:
        """Return the index of each of the next times [s], whose differences above 1 are gaps; raises `BadData`."""
        joined = np.concatenate([self._last, times])
        lost = np.zeros(len(times), np.int64)
        if len(joined) > 1:
            behind = len(joined) - 1
            lost[-behind:] = lost_before(joined, self._source, first=self._count - len(self._last), step=self._step)
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


def rate_of_vector(times: Variable, unit: str, source: str) -> tuple[float, list[tuple[int, int]]]:
    """Return the sampling rate [Hz] of an array of even times, read once by blocks, and its gaps.

    Times in float32 may be rounded. A gap is the index of the time after it, and the number of samples missing.
    """
    factor = seconds(unit, source)
    gaps: list[tuple[int, int]] = []
    first = last = step = 0.0
    count = 0
    for (block,) in times.read(_BLOCK_LENGTH, (0,)):
        part = factor * block.astype(np.float64)
        if count:
            part = np.concatenate([[last], part])
        else:
            first = float(part[0])
        if not np.isfinite(part).all():
            raise BadData(f"{source}: times must be finite, one of the first {count + len(block)} is not; correct it")
        if len(part) > 1:
            usual = step or float(part[1:65537][-1] - part[0]) / (len(part[1:65537]))
            if not _is_even(part, usual, float(np.finfo(block.dtype).eps)):
                # Times rounded to printed digits may still be even.
                usual = step or 1 / rate_of(part, source)
                first_index = count + len(block) - len(part)
                n_lost = lost_before(part, source, first=first_index, step=usual)
                gaps += [(first_index + 1 + at, int(n_lost[at])) for at in np.flatnonzero(n_lost).tolist()]
            step = usual
        last = float(part[-1])
        count += len(block)
    if not last > first:
        raise BadData(f"{source}: times must increase, they go from {first:g} to {last:g} s; correct them")
    return (count - 1 + sum(number for _, number in gaps)) / (last - first), gaps


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
    # Times with a fixed number of significant digits lose a decimal place at each power of ten. The few after the last
    # power may all end in zeros by chance, so they remove one place only.
    last_power = 10.0 ** math.floor(math.log10(largest))
    return min(_last_digit(sizes[sizes >= last_power]), 10 * _last_digit(sizes[sizes >= largest / 2]))


def _last_digit(sizes: Floats) -> float:
    highest = math.floor(math.log10(float(sizes.max())))
    for digit in range(highest, max(highest - 17, -300), -1):
        in_digits = sizes * 10.0**-digit
        if (np.abs(in_digits - np.rint(in_digits)) <= 4e-16 * in_digits).all():
            return float(10.0**digit)
    return 0.0

"""Sampling rates from the times of samples, in a table column or in an array next to the samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.units import seconds_of

if TYPE_CHECKING:
    from cgid.recordings.variables import Variable

Floats = NDArray[np.float64]

#: Largest difference from the usual step, relative to it.
EVENNESS = 0.01

#: Uneven steps may be due to rounding only if a step spans at least this many units of the last printed digit.
_COARSEST_STEP = 1.5

_BLOCK_LENGTH = 1 << 18


def seconds(unit: str, source: str) -> float:
    """Return the factor from the unit of a time column to seconds, 1 for ""; raise `BadData` for other units."""
    factor = seconds_of(unit)
    if factor is None:
        raise BadData(f"{source}: the time column must be in s, ms or us, its header states {unit!r}; convert it")
    return factor


def rate_of(times: Floats, source: str) -> float:
    """Return the sampling rate [Hz] of two or more even times [s]; steps may differ by 1 % and the printed digits."""
    require_even(times, source)
    with np.errstate(all="ignore"):
        rate = float((len(times) - 1) / (times[-1] - times[0]))
    if not (np.isfinite(rate) and rate > 0):
        raise BadData(f"{source}: the time column gives a sampling rate of {rate:g} Hz; check its unit")
    return rate


def require_even(times: Floats, source: str, *, first: int = 0, step: float | None = None) -> None:
    """Raise `BadData` as `rate_of`, for a piece of a recording from sample `first` on, of a usual step [s]."""
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

    def feed(self, times: Floats) -> None:
        """Check the times [s] of the next samples; raises as `require_even`."""
        joined = np.concatenate([self._last, times])
        if len(joined) > 1:
            require_even(joined, self._source, first=self._count - len(self._last), step=self._step)
        self._count += len(times)
        self._last = joined[-1:]


def refined_rate(rate: float, first: float, last: float) -> float:
    """Return the sampling rate [Hz] from the first and last time [s] and the `rate` of the beginning."""
    # The times are a whole number of steps apart: the printed digits give the rate of n samples to 1 / n at worst.
    span = last - first
    if not (np.isfinite(span) and span * rate > 1):
        return rate
    return round(span * rate) / span


def rate_of_vector(times: Variable, unit: str, source: str) -> float:
    """Return the sampling rate [Hz] of an array of even times, read once by blocks; float32 may be rounded."""
    factor = seconds(unit, source)
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
            step = step or float(part[1:65537][-1] - part[0]) / (len(part[1:65537]))
            if not _is_even(part, step, float(np.finfo(block.dtype).eps)):
                # Times rounded to printed digits may still be even; if not, this names the sample.
                rate_of(part, source)
        last = float(part[-1])
        count += len(block)
    if not last > first:
        raise BadData(f"{source}: times must increase, they go from {first:g} to {last:g} s; correct them")
    return (count - 1) / (last - first)


def _is_even(times: Floats, step: float, precision: float) -> bool:
    """Return whether all steps are equal within the rounding of the times."""
    rounding = 2 * precision * float(np.abs(times).max())
    # With rounding as large as a step, a missing sample would go unnoticed.
    return step > 2 * rounding and bool(np.abs(np.diff(times) - step).max() <= EVENNESS * step + rounding)


@np.errstate(all="ignore")
def _typical_if_uneven(times: Floats, steps: Floats, typical: float | None = None) -> float | None:
    """Return the typical step if the steps are uneven, else None."""
    shortest, longest = float(steps.min()), float(steps.max())
    typical = typical or float(np.median(steps))
    if longest - typical <= EVENNESS * typical and typical - shortest <= EVENNESS * typical:
        return None
    # Even times rounded to a digit q have steps of two adjacent multiples of q and no others. If a step is only one q
    # long, a gap looks the same, so such times count as uneven.
    digit = _printed_digit(times)
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

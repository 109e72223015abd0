"""The time column of a text file: which one it is, and the sampling rate it gives."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.text.header import TIME_UNITS, Column

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

"""The sampling rate from an array of times, looked through once by blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.statements import stated_time_unit
from cgid.recordings.text.header import Column
from cgid.recordings.text.time_axis import EVENNESS, rate_of, seconds

if TYPE_CHECKING:
    from cgid.recordings.variables import Variable

_LENGTH = 1 << 18


def rate_of_vector(times: Variable, source: str) -> float:
    """Return the sampling rate [Hz] of even times [s], (n - 1) / (last - first).

    Parameters
    ----------
    times : Variable
        One channel of two samples or more. An array written as float32 may be as uneven as its rounding makes it.
    source : str
        What the times are called in messages.

    Raises
    ------
    BadData
        The times do not increase in even steps of 1 %, or are rounded so coarsely that this cannot be told.
    """
    factor = seconds(Column(name=times.name, unit=stated_time_unit(times.name, times.about)), source)
    first = last = step = 0.0
    count = 0
    for (block,) in times.blocks(_LENGTH, (0,)):
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
                # What was rounded to printed digits may still be even; else this says where it is not.
                rate_of(part, source)
        last = float(part[-1])
        count += len(block)
    if not last > first:
        raise BadData(f"{source}: times must increase, they go from {first:g} to {last:g} s; correct them")
    return (count - 1) / (last - first)


def _is_even(times: NDArray[np.float64], step: float, precision: float) -> bool:
    """Return whether all steps are equal but for the rounding of the times."""
    rounding = 2 * precision * float(np.abs(times).max())
    # Where rounding is as large as a step, a missing sample could not be seen.
    return step > 2 * rounding and bool(np.abs(np.diff(times) - step).max() <= EVENNESS * step + rounding)

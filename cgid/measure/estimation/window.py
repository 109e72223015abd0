"""The samples that a fit looks at: those around each pulse, pulses of like width together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid.measure.estimation.template import relative_times
from cgid.validation import Floats

if TYPE_CHECKING:
    from cgid.measure.estimation.fit import Start

#: The first, coarse window reaches this far before and behind the peak, in widths (impulse over peak).
BEFORE, BEHIND = 1.5, 3.0
#: The final one goes this far beyond the contact that the coarse fit found, but not further behind the peak than the
#: second number: there less than 0.2 % of the peak is left at any restitution.
_MARGIN, _FURTHEST = 0.35, 4.5
#: Lengths are powers of this number.
_STEP = 1.5
#: Longer windows are averaged over equal runs of samples: hundreds of points say all about a smooth curve.
_LONGEST = 320
#: Points of a coarse window.
_COARSE = 48


@dataclass(frozen=True)
class Window:
    """Samples of some rows.

    Attributes
    ----------
    rows : ndarray of int, (n,)
        Of the frames they are from.
    values : ndarray, (n, n_points)
    times : ndarray, (n, n_points)
        [samples of the frame].
    averaged : ndarray, (n,)
        Samples in one point.
    outside : ndarray of bool, (n, n_points), or None
        Points beyond the frame; None where there are none.
    clipped : ndarray of bool, (n, n_points), or None
    beside : ndarray, (n,)
        The largest magnitude of the samples that are not looked at.
    run : int
        Samples in one point where all rows have as many by design; else 1.
    reach : ndarray of int, (n,)
        The last column that was asked for, in the frame or beyond it.
    """

    rows: NDArray[np.intp]
    values: Floats
    times: Floats
    averaged: Floats
    outside: NDArray[np.bool_] | None
    clipped: NDArray[np.bool_] | None
    beside: Floats
    run: int
    reach: NDArray[np.intp]

    def part(self, rows: NDArray[np.intp] | slice) -> Window:
        """Return some of its rows."""
        return Window(
            self.rows[rows],
            self.values[rows],
            self.times[rows],
            self.averaged[rows],
            None if self.outside is None else self.outside[rows],
            None if self.clipped is None else self.clipped[rows],
            self.beside[rows],
            self.run,
            self.reach[rows],
        )


def windows(
    samples: NDArray[np.floating],
    guess: Floats,
    offset: Floats | None,
    clip_level: Floats | None,
    averaged: bool = True,
    unit: Floats | None = None,
) -> Iterator[Window]:
    """Yield windows around pulses (peak, ln width, place, shape, baseline), those of like length together.

    Values are over `unit`, (n,), where it is given; offset and limit are in that of the samples.
    """
    width = np.exp(guess[:, 1])
    duration, lead, _, _ = relative_times(guess[:, 3])
    first = guess[:, 2] - (lead + _MARGIN) * width
    lengths = np.minimum(duration + 2 * _MARGIN, lead + _MARGIN + _FURTHEST) * width
    # Lengths come in steps: what a row is compared with must not depend on the other rows.
    step = np.ceil(np.log(np.maximum(lengths, 1.0)) / np.log(_STEP)).astype(np.intp)
    for chosen in np.unique(step):
        rows = np.flatnonzero(step == chosen)
        length = int(np.ceil(_STEP**chosen)) + 4
        yield _window(
            samples, rows, np.floor(first[rows]).astype(np.intp) - 2, length, offset, clip_level, averaged, unit
        )


def coarse_window(
    samples: NDArray[np.floating], start: Start, offset: Floats | None, clip_level: Floats | None
) -> Window:
    """Return few points of every pulse over its first peak, each the mean of as many samples as its width allows."""
    n, n_samples = samples.shape
    run = np.maximum(np.ceil((BEFORE + BEHIND) * start.width / _COARSE), 1).astype(np.intp)
    first = np.floor(start.place - BEFORE * start.width).astype(np.intp) - 1
    edges = first[:, None] + run[:, None] * np.arange(_COARSE + 1)
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples, axis=1, dtype=np.float64, out=total[:, 1:])
    at_edges = np.take_along_axis(total, np.clip(edges, 0, n_samples), axis=1)
    values = np.diff(at_edges, axis=1) / run[:, None]
    if offset is not None:
        values -= offset[:, None]
    outside = (edges[:, :-1] < 0) | (edges[:, 1:] > n_samples)
    clipped = None
    if clip_level is not None:  # a point near the limit holds clipped samples
        near = ~outside & (values >= 0.97 * clip_level[:, None])
        clipped = near if near.any() else None
    values /= start.peak[:, None]
    times = 0.5 * (edges[:, :-1] + edges[:, 1:] - 1.0)
    rows = np.arange(n)
    return Window(rows, values, times, run.astype(np.float64), outside, clipped, np.zeros(n), 1, edges[:, -1] - 1)


def _window(
    samples: NDArray[np.floating],
    rows: NDArray[np.intp],
    first: NDArray[np.intp],
    length: int,
    offset: Floats | None,
    clip_level: Floats | None,
    averaged: bool,
    unit: Floats | None,
) -> Window:
    n_samples = samples.shape[1]
    run = max(-(-length // _LONGEST), 1) if averaged else 1
    length = -(-length // run) * run
    columns = first[:, None] + np.arange(length)
    beyond = (columns < 0) | (columns >= n_samples)
    values = samples[rows[:, None], np.clip(columns, 0, n_samples - 1)].astype(np.float64)
    if offset is not None:
        values -= offset[rows][:, None]
    beside = _largest_beside(samples, rows, first, length, offset)
    outside = beyond if beyond.any() else None
    clipped = None
    if clip_level is not None:
        at_limit = ~beyond & (values >= clip_level[rows][:, None])
        clipped = at_limit if at_limit.any() else None
    if unit is not None:
        values /= unit[rows][:, None]
        beside /= unit[rows]
    times, reach = columns.astype(np.float64), first + length - 1
    if run > 1:
        shape = (len(rows), length // run, run)
        values, times = values.reshape(shape).mean(axis=2), times.reshape(shape).mean(axis=2)
        outside = None if outside is None else outside.reshape(shape).any(axis=2)
        clipped = None if clipped is None else clipped.reshape(shape).any(axis=2)
    return Window(rows, values, times, np.full(len(rows), float(run)), outside, clipped, beside, run, reach)


def _largest_beside(
    samples: NDArray[np.floating], rows: NDArray[np.intp], first: NDArray[np.intp], length: int, offset: Floats | None
) -> Floats:
    out = np.zeros(len(rows))
    for place, (row, column) in enumerate(zip(rows.tolist(), first.tolist(), strict=True)):
        frame = samples[row]
        for part in (frame[: max(column, 0)], frame[max(column + length, 0) :]):
            if part.size:
                base = 0.0 if offset is None else offset[row]
                out[place] = max(out[place], float(part.max()) - base, base - float(part.min()))
    return out

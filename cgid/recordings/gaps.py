"""Gaps of a recording: impossible samples become nan, whatever the format.

Later stages treat nan as missing: no noise level, frame or window contains one. So neither the value that a logger
writes for a lost sample nor a flipped bit affects filters or levels.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.terminal import counted
from cgid.errors import BadData
from cgid.units import LARGEST, UNITS, quantity_of

if TYPE_CHECKING:
    from cgid.recordings.recording import Channel

#: Maximum number of channels that are named.
_MAX_NAMED = 5
#: Numbers that converters write for a lost sample, and those that loggers write for many.
_END_STOPS = (-(2.0**15), -(2.0**23), -(2.0**31))
_FILLERS = (-999.0, -999.25, -9999.0, -99999.0)
#: Samples beside them must not exceed this part of them; fillers come at least so many in a row.
_NEAR = 0.5
_FILLED = 3
#: In a live stream, the gaps of a channel are over after this time without any [s].
_OVER = 60.0


#: Names of channels that only count samples; without one of these, so many samples must show it, of so many first ones.
_NAMES_OF_COUNTERS = re.compile(
    "index|no|nr|n|i|x|counte?r?|samples?|sample[ _]no|point|row|seq|sequence|packet|序号", re.IGNORECASE
)
_MIN_COUNTED = 50
COUNTED = 256
#: Steps of a counter in a stream are equal to this part of them, since samples may be rounded to float32.
_ALIKE = 1e-2


def is_name_of_counter(name: str) -> bool:
    """Return whether a channel of this name, or without one, may only count samples."""
    return not name or _NAMES_OF_COUNTERS.fullmatch(name.strip(" .:#")) is not None


@np.errstate(all="ignore")
def counts(name: str, samples: NDArray[Any], *, whole: bool = True) -> bool:
    """Return whether samples, `whole` numbers, only count: they stay or grow by one step, or begin again."""
    steps = np.diff(samples)
    step = float(steps.max(initial=0.0))
    is_step = np.abs(steps - step) <= (0 if whole else _ALIKE * step)
    begins_again = (samples[1:] == samples.min(initial=np.inf)) & (samples[:-1] == samples.max(initial=-np.inf))
    least = 1 if name and is_name_of_counter(name) else _MIN_COUNTED
    # Of so many steps, too: 50, 0, 1 is one.
    is_long = np.ptp(samples) >= least * step and np.count_nonzero(is_step) >= least
    is_counter = step > 0 and (is_step | (steps == 0) | begins_again).all()
    return bool(is_counter and is_long and not (whole and (step % 1 or samples[0] % 1)))


class Gaps:
    """Replace impossible samples by nan and count them.

    With `give_up` the blocks end when no channel (if `joint`: not every channel) has given a sample for this time [s].
    In a live stream (`at_once`) a line says for each channel when its gaps begin, and another when they are over.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        sampling_rate: float,
        say: Callable[[str], object],
        *,
        give_up: float = math.inf,
        joint: bool = False,
        at_once: bool = False,
    ) -> None:
        self._channels, self._rate, self._say, self._at_once = channels, sampling_rate, say, at_once
        self._longest = max(math.ceil(min(give_up * sampling_rate, 2.0**60)), 1)
        self._limits = np.array([largest(channel.unit) for channel in channels])
        n_channels = len(channels)
        self.n_seen = 0  # samples of each channel so far
        self._joint = joint
        # Missing samples up to the end so far: of each channel if joint, else of all at once.
        self._running = np.zeros(n_channels if joint else 1, np.int64)
        self._goes_on = np.zeros(n_channels, bool)  # whether the last sample so far is missing
        self._end: int | None = None  # sample at which all was given up
        self.n_samples, self.n_gaps = np.zeros((2, n_channels), np.int64)
        self._n_told = np.zeros((2, n_channels), np.int64)  # of these
        self._latest = np.zeros(n_channels, np.int64)  # the sample after the latest gap
        # The first samples of a live stream, until they show which channels only count.
        self._beginning: NDArray[Any] | None = np.empty((n_channels, 0)) if at_once else None
        self._counting: list[int] = []
        self._first: dict[int, tuple[int, float]] = {}  # by channel: sample and value of its first gap

    def marked(self, blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield blocks (n_channels, n_samples), float32 or float64, in the units of the channels with nan in gaps."""
        for block in blocks:
            first, known = self.n_seen, set(self._first)
            if self._beginning is not None:
                self._look_for_counters(np.concatenate([self._beginning, block], axis=1)[:, :COUNTED])
            low, high = block.min(axis=1, initial=0.0), block.max(axis=1, initial=0.0)
            # False for nan.
            sound = (-self._limits <= low) & (high <= self._limits)
            if sound.all():
                if block.shape[1]:
                    self._running[:], self._goes_on[:] = 0, False
            else:
                missing = ~(np.abs(block) <= self._limits[:, None])
                self._end = self._given_up(missing, first)
                if self._end is not None:
                    missing, block = missing[:, : self._end - first], block[:, : self._end - first]
                for row in np.flatnonzero(missing.any(axis=1)).tolist():
                    self._count(row, missing[row], block[row], first)
                self._goes_on = missing[:, -1].copy()
                block = np.where(missing, block.dtype.type(np.nan), block)
            if self._counting:
                block = block.copy()
                block[self._counting] = np.nan
            self.n_seen += block.shape[1]
            if self._at_once:
                self._say_changes([row for row in self._first if row not in known])
            yield block
            if self._end is not None:
                break
        self.finish()

    def finish(self) -> None:
        """Warn of what is missing, once."""
        if self._first:
            self._say_missing(sorted(self._first))

    def require(self, source: str) -> None:
        """Raise `BadData` if the blocks ended because channels were given up, or contained no valid sample."""
        lost = self.n_samples == self.n_seen
        if self.n_seen and (self._end is not None or (lost.any() if self._joint else lost.all())):
            end = (self.n_seen if self._end is None else self._end) / self._rate
            raise BadData(
                f"{source}: samples must be finite and what a sensor can give, none is in the "
                f"{min(self._longest / self._rate, end):.6g} s before {end:.6g} s; check sensor, cable and sample "
                "format"
            )

    def _say_missing(self, rows: Sequence[int]) -> None:
        """Say what is missing in some channels, and forget it."""
        channel = min(rows, key=lambda row: self._first[row])
        sample, value = self._first[channel]
        counts = np.stack([self.n_samples, self.n_gaps])
        total, n_gaps = (counts - self._n_told)[:, rows].sum(axis=1).tolist()
        self._n_told[:, rows] = counts[:, rows]
        limit = f"; no sensor gives more than {self._limits[channel]:.3g} {self._channels[channel].unit or ''}".rstrip()
        self._say(
            f"{counted(total, 'sample')} in {counted(n_gaps, 'gap')} of channel "
            f"{self._named(rows)} {'is' if total == 1 else 'are'} no reading and left out, the first at "
            f"{sample / self._rate:.6g} s ({value:.3g}{limit if math.isfinite(value) else ''}); check sensor, cable "
            "and sample format"
        )
        for row in rows:
            del self._first[row]

    def _named(self, rows: Sequence[int]) -> str:
        more = f" and {len(rows) - _MAX_NAMED} more" if len(rows) > _MAX_NAMED else ""
        return ", ".join(self._channels[row].name for row in rows[:_MAX_NAMED]) + more

    def _look_for_counters(self, beginning: NDArray[Any]) -> None:
        """Name the channels of a live stream that only count by its first samples, which are given up."""
        self._beginning = beginning
        if beginning.shape[1] == COUNTED:
            self._counting = [row for row, samples in enumerate(beginning) if counts("", samples, whole=False)]
            self._beginning = None
            if self._counting:
                self._say(f"channel {self._named(self._counting)} only counts and is given up; leave it out")

    def _given_up(self, missing: NDArray[np.bool_], first: int) -> int | None:
        """Return the sample at which nothing has been readable for too long; None without."""
        ends = []
        masks = missing if self._joint else np.all(missing, axis=0)[np.newaxis]
        for number, mask in enumerate(masks):
            starts, stops = _runs(mask)
            lengths = stops - starts
            if mask[0]:
                lengths[0] += self._running[number]
            self._running[number] = lengths[-1] if mask[-1] else 0
            over = np.flatnonzero(lengths >= self._longest)
            ends += [first + int(stops[k] - lengths[k]) + self._longest for k in over[:1]]
        return min(ends, default=None)

    def _say_changes(self, began: Sequence[int]) -> None:
        """Say of which channels gaps have begun in a live stream, and of which they are over."""
        if began:
            row = min(began, key=lambda row: self._first[row])
            sample, value = self._first[row]
            self._say(
                f"samples of channel {self._named(began)} are no reading and left out, the first at "
                f"{sample / self._rate:.6g} s ({value:.3g}); check sensor, cable and sample format"
            )
        over = self.n_seen - _OVER * self._rate
        if gone := [row for row in sorted(self._first) if self._latest[row] < over]:
            self._say_missing(gone)

    def _count(self, row: int, missing: NDArray[np.bool_], samples: NDArray[Any], first: int) -> None:
        """Count the gaps of a channel in a block."""
        starts, stops = _runs(missing)
        self.n_samples[row] += int(np.sum(stops - starts))
        self.n_gaps[row] += starts.size - (bool(self._goes_on[row] and missing[0]) and row in self._first)
        self._latest[row] = first + int(stops[-1])
        self._first.setdefault(row, (first + int(starts[0]), float(samples[starts[0]])))


def _runs(missing: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first sample of each run of missing samples, and the one after it."""
    edges = np.flatnonzero(np.diff(missing, prepend=False, append=False))
    return edges[::2], edges[1::2]


@cache
def largest(unit: str | None) -> float:
    """Return the largest sample that a sensor can give, in a unit; without one, that of full scale."""
    quantity = "level" if unit is None else quantity_of(unit)
    return LARGEST[quantity] / (1.0 if unit is None else UNITS[quantity][unit])


def without_fillers(blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Yield blocks of the numbers of a file with nan for what stands for no reading, unless others come near it."""
    for block in blocks:
        lowest = np.fmin.reduce(block, axis=1, initial=np.inf)
        rows = np.flatnonzero(np.isin(lowest, (*_END_STOPS, *_FILLERS)))
        block = block.copy() if rows.size else block
        for row, low in zip(rows, lowest[rows], strict=True):
            is_filler = block[row] == low
            starts, stops = _runs(is_filler)
            is_run = low in _END_STOPS or (stops - starts).min() >= _FILLED
            if is_run and not (block[row][~is_filler] < _NEAR * low).any():
                block[row][is_filler] = np.nan
        yield block

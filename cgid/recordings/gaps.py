"""Gaps of a recording: impossible samples become nan, whatever the format.

Later stages treat nan as missing: no noise level, frame or window contains one. So neither the value that a logger
writes for a lost sample nor a flipped bit affects filters or levels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.terminal import counted
from cgid.units import LARGEST, UNITS, quantity_of

if TYPE_CHECKING:
    from cgid.recordings.recording import Channel

#: A channel is given up after being unreadable for this long [s].
GIVE_UP = 10.0
#: Maximum number of channels that are named.
_MAX_NAMED = 5


class Gaps:
    """Replace impossible samples by nan and count them; give up channels with none other for `give_up` [s]."""

    def __init__(
        self,
        channels: Sequence[Channel],
        sampling_rate: float,
        say: Callable[[str], object],
        *,
        give_up: float | None = None,
        joint: bool = False,
        at_once: bool = False,
    ) -> None:
        time = GIVE_UP if give_up is None else validation.number("give_up", give_up, "s", validation.positive)
        self._channels, self._rate, self._say, self._at_once = channels, sampling_rate, say, at_once
        self._give_up_after, self._longest = time, max(math.ceil(min(time * sampling_rate, 2.0**60)), 1)
        self._limits = np.array([largest(channel.unit) for channel in channels])
        n_channels = len(channels)
        self.n_seen = 0  # samples of each channel so far
        self._running = np.zeros(n_channels, np.int64)  # missing samples up to the end so far
        self._given_up = np.zeros(n_channels, bool)
        self._end = np.zeros(n_channels, np.int64)  # sample at which each channel was given up
        # Of the channels given up, for an end.
        self._enough, self._last = (np.any, np.min) if joint else (np.all, np.max)
        self.n_samples, self.n_gaps = np.zeros((2, n_channels), np.int64)
        self._first: tuple[int, int, float] | None = None  # sample, channel, value
        self._n_reported = 0

    def marked(self, blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield blocks (n_channels, n_samples), float32 or float64, in the units of the channels with nan in gaps."""
        for block in blocks:
            yield self._marked(block)
            if self._enough(self._given_up):
                break
        self.finish()

    def finish(self) -> None:
        """Warn of what is missing, once."""
        total = int(self.n_samples.sum())
        if total == self._n_reported or self._first is None:
            return
        self._n_reported = total
        sample, channel, value = self._first
        missing = np.flatnonzero(self.n_samples)
        named = ", ".join(self._channels[row].name for row in missing[:_MAX_NAMED])
        more = f" and {missing.size - _MAX_NAMED} more" if missing.size > _MAX_NAMED else ""
        unit = self._channels[channel].unit or ""
        limit = f"; no sensor gives more than {self._limits[channel]:.3g} {unit}".rstrip()
        self._say(
            f"{counted(total, 'sample')} in {counted(int(self.n_gaps.sum()), 'gap')} of channel {named}{more} "
            f"{'is' if total == 1 else 'are'} no reading and left out, the first at {sample / self._rate:.6g} s "
            f"({value:.3g}{limit if math.isfinite(value) else ''}); check sensor, cable and sample format"
        )

    def require(self, source: str) -> None:
        """Raise `BadData` if the blocks ended because channels were given up, or contained no valid sample."""
        if self.n_seen and self._enough(self._given_up | (self.n_samples == self.n_seen)):
            # The number of samples seen depends on the length of the blocks where a channel was given up.
            end = float(self._last(np.where(self._given_up, self._end, self.n_seen))) / self._rate
            raise BadData(
                f"{source}: samples must be finite and what a sensor can give, none is in the "
                f"{min(self._give_up_after, end):.6g} s before {end:.6g} s; check sensor, cable and sample format"
            )

    def _marked(self, block: NDArray[Any]) -> NDArray[Any]:
        limits = self._limits[:, None]
        first = self.n_seen
        self.n_seen += block.shape[1]
        low, high = block.min(axis=1, initial=0.0), block.max(axis=1, initial=0.0)
        # False for nan.
        sound = (-self._limits <= low) & (high <= self._limits) & ~self._given_up
        self._running[sound] = 0 if block.shape[1] else self._running[sound]
        if sound.all():
            return block
        missing = ~(np.abs(block) <= limits)
        for row in np.flatnonzero(~sound).tolist():
            missing[row] |= self._given_up[row]
            if not self._given_up[row]:
                self._count(row, missing[row], block[row], first)
        if self._at_once and not self._n_reported:
            self.finish()
        return np.where(missing, block.dtype.type(np.nan), block)

    def _count(self, row: int, missing: NDArray[np.bool_], samples: NDArray[Any], first: int) -> None:
        """Count the gaps of a channel in a block, and give it up where one is too long."""
        edges = np.flatnonzero(np.diff(missing, prepend=False, append=False))
        starts, stops = edges[::2], edges[1::2]
        lengths = stops - starts
        goes_on = bool(self._running[row] and missing[0])
        if goes_on:
            lengths[0] += self._running[row]
        over = np.flatnonzero(lengths >= self._longest)
        if over.size:
            given_up = int(stops[over[0]] - lengths[over[0]]) + self._longest
            missing[given_up:] = True
            self._given_up[row], self._end[row] = True, first + given_up
            starts, stops = starts[: over[0] + 1], np.append(stops[: over[0]], given_up)
            self._give_up(row, first + given_up, samples[max(given_up - 1, 0)])
        self._running[row] = lengths[-1] if lengths.size and missing[-1] else 0
        self.n_samples[row] += int(np.sum(stops - starts))
        self.n_gaps[row] += starts.size - goes_on
        if starts.size and (self._first is None or first + int(starts[0]) < self._first[0]):
            self._first = first + int(starts[0]), row, float(samples[starts[0]])

    def _give_up(self, row: int, sample: int, value: float) -> None:
        self._say(
            f"channel {self._channels[row].name} is given up at {sample / self._rate:.6g} s: unreadable for "
            f"{self._give_up_after:g} s ({value:.3g}); check sensor and cable, --give-up sets the time"
        )


def largest(unit: str | None) -> float:
    """Return the largest sample that a sensor can give, in a unit; without one, that of full scale."""
    quantity = "level" if unit is None else quantity_of(unit)
    return LARGEST[quantity] / (1.0 if unit is None else UNITS[quantity][unit])

"""Whether the sensor of each channel is alive: when it last gave a sound sample, and why none since.

A sensor is dead where its samples are missing, constant, or far below the channel's own earlier noise; it may be deaf
where they are far above it. Samples are judged in stretches that count from the first one, so the result does not
depend on the blocks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData

#: Duration of a stretch [s], and how many of its samples show its noise.
_STRETCH, _N_SAMPLES = 0.1, 256
#: Noise is far below that of the quietest earlier stretch at this fraction of it, 30 dB, and far above it by as much.
FAR_BELOW = 10**-1.5
#: The quietest stretch is sought in so many periods of so many sound stretches: ten minutes.
_PERIODS, _PERIOD = 10, 600


class Lack(IntEnum):
    """What a stretch lacks to be sound."""

    NOTHING = 0
    SAMPLES = 1
    CHANGE = 2
    NOISE = 3


class _Stretch(NamedTuple):
    """The end of a stretch [s]; by channel what it lacks, its middle value, and whether it is loud."""

    end: float
    lack: NDArray[np.int8]
    middle: Floats
    loud: NDArray[np.bool_]


class SensorWatch:
    """Watch the samples of a recording; `advance` follows at the time of the predictions.

    With `give_up` the blocks end when no channel has been sound for this time [s].
    """

    def __init__(self, n_channels: int, sampling_rate: float, give_up: float = math.inf) -> None:
        self._give_up, self._alive = give_up, 0.0
        self._rate, self._length = sampling_rate, max(round(_STRETCH * sampling_rate), 2)
        self._step = -(-self._length // _N_SAMPLES)
        self._remaining: NDArray[Any] = np.empty((n_channels, 0))
        self._n_taken = 0
        self._waiting: deque[_Stretch] = deque()
        # Of each channel: the noise of its quietest sound stretch in each period; dead stretches change nothing.
        self._floors = np.full((n_channels, _PERIODS), np.inf)
        self._n_sound = np.zeros(n_channels, np.int64)
        self.last_sound = np.full(n_channels, np.nan)
        self.last_usual = np.zeros(n_channels)  # when the noise was last not far above that of the quietest stretch [s]
        #: Stretches of each channel that were dead, and of all; of `stretch` [s] each.
        self.n_dead, self.n_all, self.stretch = np.zeros(n_channels, np.int64), 0, self._length / sampling_rate
        self.lack = np.zeros(n_channels, np.int8)
        self.middle = np.zeros(n_channels)

    def watching(self, blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield the blocks (n_channels, n_samples), nan where samples are missing, and watch them."""
        for block in blocks:
            self.feed(block)
            yield block
            if self._is_given_up:
                break

    @property
    def _is_given_up(self) -> bool:
        return self._n_taken / self._rate - self._alive >= self._give_up

    def require(self, source: str) -> None:
        """Raise `BadData` if the blocks ended because no channel was sound."""
        if self._is_given_up:
            raise BadData(
                f"{source}: a channel must change and have no gaps, none did in the {self._give_up:g} s after "
                f"{self._alive:.6g} s; check sensors and cables"
            )

    def feed(self, block: NDArray[Any]) -> None:
        """Take the next samples (n_channels, n_samples)."""
        samples = np.concatenate([self._remaining, block], axis=1) if self._remaining.size else block
        count = samples.shape[1] // self._length
        self._remaining = samples[:, count * self._length :].copy()
        stretches = samples[:, : count * self._length].reshape(len(samples), count, self._length)
        low, high = stretches.min(axis=2), stretches.max(axis=2)  # nan where a sample is missing
        part = stretches[:, :, :: self._step].astype(np.float64)
        middle = _middle(part)
        noise = _middle(np.abs(part - middle[:, :, None]))
        for each in zip(low.T, high.T, middle.T, noise.T, strict=True):
            self._n_taken += self._length
            self._waiting.append(self._judged(*each, self._n_taken / self._rate))

    def _judged(self, low: Floats, high: Floats, middle: Floats, noise: Floats, end: float) -> _Stretch:
        floor = self._floors.min(axis=1)
        # An impact in it shows that the sensor is alive, however quiet it is besides.
        faint = (noise < FAR_BELOW * floor) & (high - low < floor) & np.isfinite(floor)
        lack = np.where(faint, Lack.NOISE, Lack.NOTHING).astype(np.int8)
        lack[~(low < high)] = Lack.CHANGE
        lack[np.isnan(low)] = Lack.SAMPLES
        is_sound, loud = lack == Lack.NOTHING, noise * FAR_BELOW > floor
        self._alive = end if is_sound.any() else self._alive
        sound = np.flatnonzero(is_sound & ~loud)
        period = self._n_sound[sound] // _PERIOD % _PERIODS
        begins = self._n_sound[sound] % _PERIOD == 0
        before = np.where(begins, np.inf, self._floors[sound, period])
        self._floors[sound, period] = np.minimum(before, noise[sound])
        self._n_sound[sound] += 1
        return _Stretch(end, lack, middle, loud)

    def advance(self, time: float) -> None:
        """Take into account all stretches up to a time [s]."""
        while self._waiting and self._waiting[0].end <= time:
            stretch = self._waiting.popleft()
            self.lack, self.middle = stretch.lack, stretch.middle
            self.last_sound[stretch.lack == Lack.NOTHING] = stretch.end
            self.last_usual[~stretch.loud] = stretch.end
            self.n_dead += stretch.lack != Lack.NOTHING
            self.n_all += 1

    def why_blind(self, rows: Sequence[int], channels: Sequence[str]) -> str:
        """Return in words what the latest stretch of some channels lacks."""
        reasons = {
            Lack.NOTHING: "was dead for most of the last seconds",
            Lack.SAMPLES: "gives no samples",
            Lack.CHANGE: "is constant at {:.4g}",
            Lack.NOISE: "is far below its earlier noise",
        }
        return "; ".join(
            f"channel {channels[row]} {reasons[Lack(int(self.lack[row]))].format(self.middle[row])}" for row in rows
        )


def _middle(values: Floats) -> Floats:
    """Return the medians along the last axis, the upper one of two; numpy's own would load masked arrays."""
    place = values.shape[-1] // 2
    return np.asarray(np.partition(values, place, axis=-1)[..., place])

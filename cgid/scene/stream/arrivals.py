"""When the rocks of a recording arrive, and what they are: stretch by stretch of the time axis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.elementary import exp
from cgid.scene.randomness import ARRIVALS, BLOCK, uniforms
from cgid.scene.scene import Scene
from cgid.scene.stream.sections import RateTable, StreamSection
from cgid.validation import Floats

#: Rocks expected in a stretch at most. As numbers are drawn by the inverse of their distribution at no more than
#: 1 - 2^-53, a stretch then never holds more than a block of 256.
EXPECTED_ROCKS = 128.0
#: A stretch is no longer [s]: its samples are held in memory.
LONGEST_STRETCH = 16.0


@dataclass(frozen=True)
class Stretch:
    """A part of the time axis and the rocks that arrive in it.

    Attributes
    ----------
    start, stop : float
        [s].
    times : ndarray, (n,)
        Of the arrivals [s], in order.
    block : int
        Where the numbers of these rocks are drawn,
    rows : ndarray of int, (n,)
        and which rows of the block are theirs.
    """

    start: float
    stop: float
    times: Floats
    block: int
    rows: NDArray[np.intp]


@dataclass(frozen=True)
class PoissonTimes:
    """Arrivals of a Poisson process whose rate is linear between the rows of a table."""

    table: RateTable

    @cached_property
    def _knots(self) -> tuple[Floats, Floats, Floats]:
        """Times, rates and the expected number of arrivals up to each time; the last rate holds for ever."""
        times, values = np.array(self.table.times), np.array(self.table.values)
        if times[0] > 0:
            times, values = np.append(0.0, times), np.append(values[0], values)
        steps = np.diff(times) * (values[1:] + values[:-1]) / 2
        return times, values, np.append(0.0, np.cumsum(steps))

    def expected(self, times: Any) -> Floats:
        """Return the number of arrivals to be expected before these times [s]."""
        knots, values, before = self._knots
        at = np.asarray(times, np.float64)
        piece = np.searchsorted(knots, at, side="right") - 1
        return np.asarray(before[piece] + (at - knots[piece]) * (values[piece] + np.interp(at, knots, values)) / 2)

    def time_of(self, expected: Floats) -> Floats:
        """Return when so many arrivals are to be expected: the inverse of `expected`."""
        knots, values, before = self._knots
        slopes = np.append(np.diff(values) / np.diff(knots), 0.0)
        piece = np.clip(np.searchsorted(before, expected, side="right") - 1, 0, knots.size - 1)
        more, rate = expected - before[piece], values[piece]
        # The root of rate s + slope s^2 / 2 = more, written without cancellation.
        root = np.sqrt(np.maximum(rate * rate + 2 * slopes[piece] * more, 0.0))
        return np.asarray(knots[piece] + 2 * more / np.maximum(rate + root, np.finfo(np.float64).tiny))

    @property
    def length(self) -> float:
        """Of a stretch [s]. It does not depend on the duration, so a longer recording begins with a shorter one."""
        return min(EXPECTED_ROCKS / max(self.table.values), LONGEST_STRETCH)

    def stretches(self, duration: float, seed: int, recording: int) -> Iterator[Stretch]:
        """Yield the stretches of a recording in order."""
        for block in range(int(np.ceil(duration / self.length))):
            start, stop = block * self.length, (block + 1) * self.length
            first, last = self.expected([start, stop])
            counting, placing = uniforms(seed, block, 2, ARRIVALS, recording)
            count = int(np.searchsorted(_poisson_shares(float(last - first)), counting[0]))
            # Given their number, the arrivals of a Poisson process lie independently of each other.
            times = np.clip(self.time_of(first + (last - first) * np.sort(placing[:count])), start, stop)
            yield Stretch(start, stop, times, block, np.arange(count))


def _poisson_shares(expected: float) -> Floats:
    """Return the shares of a Poisson distribution up to each number below `BLOCK`."""
    terms = np.cumprod(np.append(exp(-expected), expected / np.arange(1.0, BLOCK)))
    return np.asarray(np.minimum(np.cumsum(terms), 1.0))


@dataclass(frozen=True)
class GivenTimes:
    """Arrivals that the scene file lists."""

    times: tuple[float, ...]

    def expected(self, times: Any) -> Floats:
        """Return the number of arrivals before these times [s]."""
        return np.asarray(np.searchsorted(self.times, times, side="left"), np.float64)

    def stretches(self, duration: float, seed: int, recording: int) -> Iterator[Stretch]:
        """Yield the stretches of a recording in order: at most a block of arrivals, and not too long."""
        listed = np.array(self.times)
        start, next_row = 0.0, 0
        while start < duration:
            block = next_row // BLOCK
            stop = start + LONGEST_STRETCH
            behind = min(int(np.searchsorted(listed, stop)), (block + 1) * BLOCK)
            if behind < listed.size:
                stop = min(stop, float(listed[behind]))
            yield Stretch(start, stop, listed[next_row:behind], block, np.arange(next_row, behind) - block * BLOCK)
            start, next_row = stop, behind


def arrivals_of(stream: StreamSection) -> PoissonTimes | GivenTimes:
    """Return what says when the rocks of a stream arrive."""
    arrivals = stream.arrivals
    if arrivals.times is not None:
        return GivenTimes(arrivals.times)
    assert arrivals.rate is not None  # the section has checked that it has one of the two
    return PoissonTimes(arrivals.rate)


def populations_of(scene: Scene, times: Floats, uniform: Floats) -> NDArray[np.intp]:
    """Return the number of the population of each arriving rock.

    Parameters
    ----------
    scene : Scene
        Of a stream.
    times : ndarray, (n,)
        Of the arrivals [s].
    uniform : ndarray, (n,)
        Between 0 and 1.

    Returns
    -------
    ndarray of int, (n,)
        By the mixture at that time, by weight within a label.
    """
    shares = population_shares(scene, times)
    edges = np.cumsum(shares, axis=0)
    edges /= edges[-1]
    return np.asarray(np.sum(edges <= uniform, axis=0))


def population_shares(scene: Scene, times: Floats) -> Floats:
    """Return the share of every population among the arriving rocks, (n_populations, n_times)."""
    assert scene.stream is not None
    mixture = scene.stream.mixture
    given = {} if mixture is None else {label: mixture.at(label, times) for label in mixture.shares}
    rest = np.clip(1 - sum(given.values(), np.zeros(times.shape)), 0.0, None)
    without = sum(population.weight for population in scene.populations if population.label not in given)
    of_label = {
        label: sum(population.weight for population in scene.populations if population.label == label)
        for label in given
    }
    return np.array(
        [
            given[population.label] * (population.weight / of_label[population.label])
            if population.label in given
            else rest * (population.weight / without)
            for population in scene.populations
        ]
    )

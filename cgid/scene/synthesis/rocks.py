"""The rocks of a stream: their arrivals, properties and rebounds.

Arrivals are drawn stretch by stretch of the time axis. Rocks move from impact to impact by formula, one generation of
rebounds at a time, without time steps. They do not collide or spin, and keep their speed along the beam.

x runs along the length from the clamped edge, down the slope of an inclined beam, and y across. A beam of measured
modes and a half space have no points, so nothing falls off these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.scene.file.schema import Scene
from cgid.scene.file.sections import CONTACT_SHAPE
from cgid.scene.file.stream_section import RateTable, StreamSection
from cgid.scene.synthesis.draws import (
    ARRIVALS,
    BLOCK,
    FALL,
    PARTICLE,
    POINT_UNITS,
    SPHERE_SHAPE,
    laws_of,
    optional_numbers,
    points_of_impact,
    quantities_of,
    specimen_of,
    uniforms,
)
from cgid.units import STANDARD_GRAVITY

#: Largest expected number of rocks in a stretch. Because their number is drawn by inversion at no more than 1 - 2^-53,
#: a stretch never exceeds a block of 256.
EXPECTED_ROCKS = 128.0
#: Longest stretch [s]: its samples are in memory.
MAX_STRETCH = 16.0


@dataclass(frozen=True)
class ArrivalStretch:
    """A part of the time axis and the rocks that arrive in it."""

    start: float  # [s]
    stop: float
    times: Floats  # of the arrivals [s], in order, (n,)
    block: int  # address of the random numbers
    rows: NDArray[np.intp]  # rows in the block, (n,)


@dataclass(frozen=True)
class PoissonTimes:
    """Arrivals of a Poisson process whose rate is linear between the rows of a table."""

    table: RateTable

    @cached_property
    def _knots(self) -> tuple[Floats, Floats, Floats]:
        """Times, rates and expected number of arrivals before each time; the last rate continues."""
        times, values = np.array(self.table.times), np.array(self.table.values)
        if times[0] > 0:
            times, values = np.append(0.0, times), np.append(values[0], values)
        steps = np.diff(times) * (values[1:] + values[:-1]) / 2
        return times, values, np.append(0.0, np.cumsum(steps))

    def expected(self, times: Any) -> Floats:
        """Return the expected number of arrivals before these times [s]."""
        knots, values, before = self._knots
        at = np.asarray(times, np.float64)
        piece = np.searchsorted(knots, at, side="right") - 1
        return np.asarray(before[piece] + (at - knots[piece]) * (values[piece] + np.interp(at, knots, values)) / 2)

    def time_of(self, expected: Floats) -> Floats:
        """Return the time at which this many arrivals are expected [s]: the inverse of `expected`."""
        knots, values, before = self._knots
        slopes = np.append(np.diff(values) / np.diff(knots), 0.0)
        piece = np.clip(np.searchsorted(before, expected, side="right") - 1, 0, knots.size - 1)
        more, rate = expected - before[piece], values[piece]
        # Solves rate s + slope s^2 / 2 = more, without cancellation.
        root = np.sqrt(np.maximum(rate * rate + 2 * slopes[piece] * more, 0.0))
        return np.asarray(knots[piece] + 2 * more / np.maximum(rate + root, np.finfo(np.float64).tiny))

    @property
    def length(self) -> float:
        """Length of a stretch [s], independent of the duration, so a longer recording begins like a shorter one."""
        return min(EXPECTED_ROCKS / max(self.table.values), MAX_STRETCH)

    def stretches(self, duration: float, seed: int, recording: int) -> Iterator[ArrivalStretch]:
        """Yield the stretches of a recording in order."""
        for block in range(int(np.ceil(duration / self.length))):
            start, stop = block * self.length, (block + 1) * self.length
            first, last = self.expected([start, stop])
            counting, placing = uniforms(seed, block, 2, ARRIVALS, recording)
            number = int(np.searchsorted(_poisson_shares(float(last - first)), counting[0]))
            # Given their number, Poisson arrivals are independent.
            times = np.clip(self.time_of(first + (last - first) * np.sort(placing[:number])), start, stop)
            yield ArrivalStretch(start, stop, times, block, np.arange(number))


def _poisson_shares(expected: float) -> Floats:
    """Return the cumulative Poisson distribution at each number below `BLOCK`."""
    terms = np.cumprod(np.append(np.exp(-expected), expected / np.arange(1.0, BLOCK)))
    return np.asarray(np.minimum(np.cumsum(terms), 1.0))


@dataclass(frozen=True)
class GivenTimes:
    """Arrivals listed in the scene file."""

    times: tuple[float, ...]

    def expected(self, times: Any) -> Floats:
        """Return the number of arrivals before these times [s]."""
        return np.asarray(np.searchsorted(self.times, times, side="left"), np.float64)

    def stretches(self, duration: float, seed: int, recording: int) -> Iterator[ArrivalStretch]:
        """Yield the stretches of a recording in order: at most a block of arrivals, and at most `MAX_STRETCH`."""
        listed = np.array(self.times)
        start, next_row = 0.0, 0
        while start < duration:
            block = next_row // BLOCK
            stop = start + MAX_STRETCH
            end = min(int(np.searchsorted(listed, stop)), (block + 1) * BLOCK)
            if end < listed.size:
                stop = min(stop, float(listed[end]))
            yield ArrivalStretch(start, stop, listed[next_row:end], block, np.arange(next_row, end) - block * BLOCK)
            start, next_row = stop, end


def arrivals_of(stream: StreamSection) -> PoissonTimes | GivenTimes:
    """Return the arrival times of a stream."""
    arrivals = stream.arrivals
    if arrivals.times is not None:
        return GivenTimes(arrivals.times)
    assert arrivals.rate is not None  # checked by the section
    return PoissonTimes(arrivals.rate)


def populations_of(scene: Scene, times: Floats, uniform: Floats) -> NDArray[np.intp]:
    """Return the population of rocks that arrive at these times [s], (n,), from one uniform number per rock."""
    shares = population_shares(scene, times)
    edges = np.cumsum(shares, axis=0)
    edges /= edges[-1]
    return np.asarray(np.sum(edges <= uniform, axis=0))


def population_shares(scene: Scene, times: Floats) -> Floats:
    """Return the fraction of every population among the arriving rocks, (n_populations, n_times)."""
    assert scene.stream is not None
    mixture = scene.stream.mixture
    given = {} if mixture is None else {label: mixture.at(label, times) for label in mixture.shares}
    remaining = np.clip(1 - sum(given.values(), np.zeros(times.shape)), 0.0, None)
    without = sum(population.weight for population in scene.populations if population.label not in given)
    of_label = {
        label: sum(population.weight for population in scene.populations if population.label == label)
        for label in given
    }
    return np.array(
        [
            given[population.label] * (population.weight / of_label[population.label])
            if population.label in given
            else remaining * (population.weight / without)
            for population in scene.populations
        ]
    )


def on_beam(scene: Scene, x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Return which points [m] are on the beam; all, for a beam without points."""
    if scene.region is None:
        return np.ones(x.shape, bool)
    x_low, x_high, y_low, y_high = scene.region
    return np.asarray((x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high))


_QUANTITIES = (*FALL, *SPHERE_SHAPE, *CONTACT_SHAPE, "yield_pressure", "strength", "viscous_restitution", "velocity")
#: The state of a rock before an impact.
COLUMNS = {
    "time": np.float64,  # of onset [s]
    "rock": np.int64,  # number in the recording
    "bounce": np.int64,  # number of its earlier impacts
    "population": np.int64,
    "specimen": np.uint64,
    **dict.fromkeys(
        (
            *(*PARTICLE, *SPHERE_SHAPE, *CONTACT_SHAPE, "restitution", "yield_pressure", "viscous_restitution"),
            *("drop_height", "velocity", "dissipation"),
        ),
        np.float64,
    ),
    "slip": np.float64,  # speed down the slope [m/s]
    "impact_x": np.float64,  # point of impact on the beam [m]
    "impact_y": np.float64,
}


@dataclass(frozen=True)
class Rocks:
    """Rocks before an impact, by the names of `COLUMNS`, each (n,); nan where a rock has no such number."""

    # The velocity is the normal one; a rock has a restitution or a yield pressure and keeps its shape.

    columns: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.columns["time"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def taken(self, rows: NDArray[Any]) -> Self:
        """Return some of the rocks, by index or mask."""
        return type(self)({name: column[rows] for name, column in self.columns.items()})

    @classmethod
    def joined(cls, parts: Iterable[Rocks]) -> Self:
        """Concatenate the rocks of any number of batches."""
        listed = list(parts)
        return cls(
            {
                name: np.concatenate([np.empty(0, kind), *(part[name] for part in listed)])
                for name, kind in COLUMNS.items()
            }
        )


def arriving(scene: Scene, stretch: ArrivalStretch, first: int, seed: int, recording: int) -> Rocks:
    """Return the rocks that arrive in a stretch, before their first impact; `first` is the number of the first one."""
    assert scene.stream is not None
    rows, n = stretch.rows, len(stretch.rows)
    numbers = uniforms(seed, stretch.block, len(FALL) + 1, recording=recording)[:, rows]
    which = populations_of(scene, stretch.times, numbers[0])
    optional = optional_numbers(scene.populations, seed, stretch.block, recording)
    columns = dict(zip(FALL, numbers[1:], strict=True)) | {name: column[rows] for name, column in optional.items()}
    values = quantities_of(scene.populations, which, columns, _QUANTITIES)
    nowhere = dict.fromkeys(POINT_UNITS, np.full(n, np.nan))
    points = {name: at[rows] for name, at in points_of_impact(scene, seed, stretch.block, recording).items()}
    slope = scene.stream.inclination
    known = {
        "dissipation": np.zeros(n),
        **values,
        **laws_of(scene, which),
        **(points or nowhere),
        "time": stretch.times,
        "rock": first + np.arange(n),
        "bounce": np.zeros(n, np.int64),
        "population": which,
        "specimen": specimen_of([values[name] for name in PARTICLE]),
        "slip": values["velocity"] * np.sin(slope),
        "velocity": values["velocity"] * np.cos(slope),
    }
    return Rocks({name: known[name].astype(kind, copy=False) for name, kind in COLUMNS.items()})


def thrown_back(
    scene: Scene, rocks: Rocks, delivered: Floats, contact_duration: Floats, audible: NDArray[Any]
) -> Rocks:
    """Return the rocks still followed after an impact, before their next one; `delivered` is the restitution."""
    # A rock leaves with the normal speed u = e v, flies for `2 u / (g cos alpha)` and returns with it; it moves down
    # the slope by `u t + g sin(alpha) t^2 / 2`. An eccentric impact by the share r of its mass leaves its centre `u =
    # ((1 + e) r - 1) v`; if that is not above 0 the rock topples over and is dropped.
    assert scene.stream is not None
    rebounds, slope = scene.stream.rebounds, scene.stream.inclination
    assert rebounds is not None  # guaranteed by the plan
    aside = (1 - rocks["effective_mass"]) * (1 + delivered)
    velocity = (delivered - aside) * rocks["velocity"]
    between = contact_duration + 2 * velocity / (STANDARD_GRAVITY * np.cos(slope))
    pull = STANDARD_GRAVITY * np.sin(slope)
    after = Rocks(
        {
            **rocks.columns,
            "time": rocks["time"] + between,
            "bounce": rocks["bounce"] + 1,
            "velocity": velocity,
            "drop_height": np.full(len(rocks), np.nan),
            "slip": rocks["slip"] + pull * between,
            "impact_x": rocks["impact_x"] + rocks["slip"] * between + pull * between * between / 2,
        }
    )
    followed = audible & (after["bounce"] <= rebounds.most) & (velocity >= rebounds.least_speed)
    return after.taken(followed & on_beam(scene, after["impact_x"], after["impact_y"]))

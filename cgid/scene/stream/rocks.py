"""Rocks on their way: drawn when they arrive, thrown back by each impact, in flight by formula until the next.

All of a batch are treated together, one generation of rebounds after the other; nothing steps through time. Rocks
do not meet each other, do not spin, and the beam takes nothing of their speed along it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cgid.elementary import cos, sin
from cgid.physics import free_fall_velocity
from cgid.scene.impacts import PARTICLE
from cgid.scene.population import FALL, specimen_of
from cgid.scene.randomness import uniforms
from cgid.scene.scene import Scene
from cgid.scene.stream.arrivals import Stretch, populations_of
from cgid.scene.stream.places import impact_points, on_beam
from cgid.units import STANDARD_GRAVITY
from cgid.validation import Floats

#: What is known of a rock before an impact, beside what it is made of.
COLUMNS = {
    "time": np.float64,  # of touch [s]
    "rock": np.int64,  # its number in the recording
    "bounce": np.int64,  # how many impacts it has behind it
    "population": np.int64,
    "specimen": np.uint64,
    **dict.fromkeys((*PARTICLE, "restitution", "drop_height", "velocity"), np.float64),
    "slip": np.float64,  # speed down the slope [m/s]
    "impact_x": np.float64,  # where it hits the beam [m]
    "impact_y": np.float64,
}


@dataclass(frozen=True)
class Rocks:
    """Rocks before an impact.

    Attributes
    ----------
    columns : dict of ndarray, each (n,)
        `COLUMNS`. The restitution is the one asked for, the velocity the normal one, drop_height is nan but for
        a first fall from a height, impact_x and impact_y are nan where a beam has no points.
    """

    columns: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.columns["time"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def taken(self, rows: NDArray[Any]) -> Self:
        """Return some of the rocks, by number or by a mask."""
        return type(self)({name: column[rows] for name, column in self.columns.items()})

    @classmethod
    def joined(cls, parts: Iterable[Rocks]) -> Self:
        """Return the rocks of several batches in one; of none, no rocks."""
        listed = list(parts)
        return cls(
            {
                name: np.concatenate([np.empty(0, kind), *(part[name] for part in listed)])
                for name, kind in COLUMNS.items()
            }
        )


def arriving(scene: Scene, stretch: Stretch, first: int, seed: int, recording: int) -> Rocks:
    """Return the rocks that arrive in a stretch, before their first impact; `first` is the number of the first one."""
    assert scene.stream is not None
    rows, count = stretch.rows, len(stretch.rows)
    numbers = uniforms(seed, stretch.block, len(FALL) + 1, recording=recording)[:, rows]
    which = populations_of(scene, stretch.times, numbers[0])
    drawn = dict(zip(FALL, numbers[1:], strict=True))
    drawn["velocity"] = drawn["drop_height"]  # a fall has one number, whether it is a height or a speed
    values = {name: np.full(count, np.nan) for name in (*FALL, "velocity")}
    for index, population in enumerate(scene.populations):
        own = np.flatnonzero(which == index)
        for name, law in population.laws.items():
            values[name][own] = law.quantile(drawn[name][own])
    fell = np.isfinite(values["drop_height"])
    values["velocity"][fell] = free_fall_velocity(values["drop_height"][fell])
    slope = scene.stream.inclination
    points = impact_points(scene, seed, stretch.block, recording)
    x, y = (np.full(count, np.nan),) * 2 if points is None else (points[0][rows], points[1][rows])
    columns = {
        **values,
        "time": stretch.times,
        "rock": first + np.arange(count),
        "bounce": np.zeros(count, np.int64),
        "population": which,
        "specimen": specimen_of([values[name] for name in PARTICLE]),
        "slip": values["velocity"] * sin(slope),
        "velocity": values["velocity"] * cos(slope),
        "impact_x": x,
        "impact_y": y,
    }
    return Rocks({name: columns[name].astype(kind, copy=False) for name, kind in COLUMNS.items()})


def thrown_back(
    scene: Scene, rocks: Rocks, delivered: Floats, contact_duration: Floats, audible: NDArray[Any]
) -> Rocks:
    """Return the rocks as they come back from an impact, before the next one.

    A rock leaves with the normal speed `e v`, flies for `2 e v / (g cos alpha)`, and comes back with the same normal
    speed, while gravity carries it down the slope: by `u t + g sin(alpha) t^2 / 2` from touch to touch.

    Parameters
    ----------
    scene : Scene
    rocks : Rocks
        n of them, before the impact.
    delivered : ndarray, (n,)
        Restitution of the impact, whatever took the energy.
    contact_duration : ndarray, (n,)
        [s].
    audible : ndarray of bool, (n,)
        Whether the impact is above the noise; a rock that is not is followed no further.

    Returns
    -------
    Rocks
        Those that are still followed.
    """
    assert scene.stream is not None
    rebounds, slope = scene.stream.rebounds, scene.stream.inclination
    if rebounds is None:
        return rocks.taken(np.empty(0, np.intp))
    velocity = delivered * rocks["velocity"]
    between = contact_duration + 2 * velocity / (STANDARD_GRAVITY * cos(slope))
    pull = STANDARD_GRAVITY * sin(slope)
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

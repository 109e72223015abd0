"""How much is to be expected of a stream, so that its plan can say what it costs."""

from __future__ import annotations

import numpy as np

from cgid.elementary import cos, sin
from cgid.scene.population import given
from cgid.scene.scene import Scene
from cgid.scene.stream.arrivals import arrivals_of, population_shares
from cgid.scene.stream.rocks import COLUMNS, Rocks, thrown_back
from cgid.validation import Floats

#: In so many parts the mixture is averaged over a recording.
_PARTS = 200


def expected_rocks(scene: Scene) -> Floats:
    """Return how many rocks of each population will arrive in a recording, (n_populations,)."""
    assert scene.stream is not None
    edges = np.linspace(0.0, scene.stream.duration, _PARTS + 1)
    arriving = np.diff(arrivals_of(scene.stream).expected(edges))
    return np.asarray(population_shares(scene, (edges[1:] + edges[:-1]) / 2) @ arriving)


def impacts_of_rock(scene: Scene) -> float:
    """Return how often a rock hits the target: the mean over a block of 256.

    Each bounces by the restitution of its first impact; none of them drowns in the noise.
    """
    assert scene.stream is not None
    drawn, slope = given(scene, 0, 0), scene.stream.inclination
    nothing = np.zeros(len(drawn.labels))
    columns = dict.fromkeys(COLUMNS, nothing) | drawn.values
    columns |= {"slip": columns["velocity"] * sin(slope), "velocity": columns["velocity"] * cos(slope)}
    rocks = Rocks(columns | {"rock": np.arange(nothing.size)})
    restitution, impacts = np.broadcast_to(drawn.impact.restitution, nothing.shape), 0
    while len(rocks):
        impacts += len(rocks)
        zero = np.zeros(len(rocks))
        rocks = thrown_back(scene, rocks, restitution[rocks["rock"]], zero, zero == 0)
    return impacts / nothing.size

"""Where on the beam a rock comes down, where it slides to between its bounces, and when it is off the beam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.scene.distributions import Distribution
from cgid.scene.scene import Scene
from cgid.validation import Floats


@dataclass(frozen=True)
class Beam:
    """What a stream must know of the beam: its size, and where rocks first hit it.

    Attributes
    ----------
    length, width : float
        [m]. x runs along the length, down the slope where the beam is inclined, y along the width.
    x, y : Distribution
        Of the first point of impact [m].
    """

    length: float
    width: float
    x: Distribution
    y: Distribution

    def points(self, uniform: Floats) -> tuple[Floats, Floats]:
        """Return the first points of impact x and y [m] for uniform numbers (2, n)."""
        return self.x.quantile(uniform[0]), self.y.quantile(uniform[1])

    def holds(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Return which points [m] lie on the beam."""
        return np.asarray((x >= 0) & (x <= self.length) & (y >= 0) & (y <= self.width))


def beam_of(scene: Scene) -> Beam | None:
    """Return the beam of a scene; None for a target without edges, on which no point is told from another."""
    return None

"""Where on the beam a rock comes down, and when it is off the beam.

x runs from the held edge along the length, down the slope where the beam is inclined, y along the width. A beam known
by its measured modes alone has no points, and neither has a half space: nothing falls off these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid.scene.randomness import IMPACT_POINTS, uniforms
from cgid.scene.scene import Scene
from cgid.validation import Floats


def impact_points(scene: Scene, seed: int, block: int, recording: int) -> tuple[Floats, Floats] | None:
    """Return where the rocks of a block first hit the beam, x and y [m], each (256,); None if there are no points."""
    if scene.panel is None:
        return None
    assert scene.tail_beam is not None and scene.tail_beam.impact_point is not None  # a panel has both
    along, across = uniforms(seed, block, 2, IMPACT_POINTS, recording)
    point = scene.tail_beam.impact_point
    return point.x.quantile(along), point.y.quantile(across)


def on_beam(scene: Scene, x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Return which points [m] lie on the beam: all, where there are no points."""
    if scene.panel is None:
        return np.ones(x.shape, bool)
    return np.asarray((x >= 0) & (x <= scene.panel.length) & (y >= 0) & (y <= scene.panel.width))

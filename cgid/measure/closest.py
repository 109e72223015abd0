"""The pulse of the damped-Hertz family that comes closest to a pulse of another kind."""

from __future__ import annotations

from functools import cache

import numpy as np

from cgid.measure.template import curve
from cgid.validation import Floats

#: Points of a pulse from touch to separation, less one.
POINTS = 512
#: Least and largest shape s = ln e; above 0 a pulse rises more slowly than it falls.
SHAPES = (float(np.log(0.06)), 1.2)
#: Times at which pulses are compared, in widths.
_TIMES = np.linspace(-8, 8, 801)


def closest(pulse: Floats) -> tuple[Floats, Floats, Floats]:
    """Return width over duration, shape, and distance of the closest pulses of the family, each (n,).

    Those with the same peak, impulse and mean time that come closest to pulses of peak 1, (n, `POINTS` + 1). The
    distance is root mean square, over that of the pulse.
    """
    width, own = _centred(pulse)
    shapes, others = _nodes()
    apart = np.square(own).sum(axis=1)[:, None] + np.square(others).sum(axis=1) - 2 * own @ others.T
    best = np.clip(apart.argmin(axis=1), 1, shapes.size - 2)
    before, here, after = (apart[np.arange(len(own)), best + step] for step in (-1, 0, 1))
    bend = before + after - 2 * here
    offset = np.clip((before - after) / (2 * bend), -1, 1)  # the lowest point of a parabola
    least = np.maximum(here - 0.5 * bend * offset**2, 0.0) / np.square(own).sum(axis=1)
    return width, shapes[best] + offset * (shapes[1] - shapes[0]), np.sqrt(least)


@cache
def _nodes() -> tuple[Floats, Floats]:
    """Return shapes and their pulses as of `_centred`."""
    shapes, share = np.linspace(*SHAPES, 129), np.linspace(0, 1, POINTS + 1)
    return shapes, _centred(curve(np.broadcast_to(share, (shapes.size, share.size)), shapes)[0])[1]


def _centred(pulse: Floats) -> tuple[Floats, Floats]:
    """Return the width of pulses over their duration, (n,), and the pulses by widths from their mean time."""
    share = np.linspace(0, 1, pulse.shape[1])
    width, middle = pulse.sum(axis=1) / (share.size - 1), (pulse @ share) / pulse.sum(axis=1)
    places = middle[:, None] + width[:, None] * _TIMES
    rows = zip(places, pulse, strict=True)
    return width, np.array([np.interp(at, share, one, left=0.0, right=0.0) for at, one in rows])

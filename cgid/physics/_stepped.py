"""Numba kernel of the quick path: one impact, stepped in time as finely as an error allows.

The equations are those of `_taylor`, in plain time, by the classic Runge-Kutta method. Touch and separation
are not smooth there, so the error falls with the power 5/2 of the number of steps: a few hundred steps serve where
1e-6 of the peak is enough, at a twentieth of the cost of the reference path.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from cgid.compiled import jit

Array = NDArray[Any]


@jit
def _force(x: float, y: float, damping: float, zeta: float, inelasticity: float) -> float:
    if x <= 0.0:
        return 0.0
    root = math.sqrt(x)
    loss = damping * x * root + zeta * root
    return (x * root + loss * y) / (1.0 + inelasticity * loss)


@jit
def _step(x: float, y: float, h: float, parameters: Array) -> tuple[float, float]:
    """Return displacement and velocity of the sphere a step h later."""
    damping, zeta, inelasticity, weight = parameters[0], parameters[1], parameters[2], parameters[3]
    f1 = _force(x, y, damping, zeta, inelasticity)
    u1, a1 = y - inelasticity * f1, weight - f1
    x2, y2 = x + 0.5 * h * u1, y + 0.5 * h * a1
    f2 = _force(x2, y2, damping, zeta, inelasticity)
    u2, a2 = y2 - inelasticity * f2, weight - f2
    x3, y3 = x + 0.5 * h * u2, y + 0.5 * h * a2
    f3 = _force(x3, y3, damping, zeta, inelasticity)
    u3, a3 = y3 - inelasticity * f3, weight - f3
    x4, y4 = x + h * u3, y + h * a3
    f4 = _force(x4, y4, damping, zeta, inelasticity)
    u4, a4 = y4 - inelasticity * f4, weight - f4
    return x + h * (u1 + 2.0 * (u2 + u3) + u4) / 6.0, y + h * (a1 + 2.0 * (a2 + a3) + a4) / 6.0


@jit
def add_to_frames(
    frames: Array,
    onset: Array,
    step: Array,
    parameters: Array,
    amplitude: Array,
    contact_time: Array,
    n_steps: int,
    rows: Array,
) -> None:
    """Add one force pulse to some rows of frames (n, n_samples); only contact is touched.

    onset [samples] is where touch falls on the sample grid, step is the sampling interval over T0. A contact, which
    lasts contact_time, takes n_steps or more.
    """
    for i in rows:
        samples, numbers = frames[i], parameters[i]
        finest = contact_time[i] / n_steps
        n_samples = float(samples.size)
        here = int(min(max(math.floor(onset[i]) + 1.0, 0.0), n_samples))
        end = int(min(max(math.ceil(onset[i] + contact_time[i] / step[i]), 0.0), n_samples))
        x, y, tau = 0.0, 1.0, 0.0
        for k in range(here, end):
            left = (k - onset[i]) * step[i] - tau
            for m in range(max(math.ceil(left / finest), 1), 0, -1):
                h = left / m
                x, y = _step(x, y, h, numbers)
                left -= h
            tau = (k - onset[i]) * step[i]
            if tau >= contact_time[i]:
                break
            samples[k] += amplitude[i] * max(_force(x, y, numbers[0], numbers[1], numbers[2]), 0.0)

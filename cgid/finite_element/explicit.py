"""Explicit central differences: the way through time for bodies without much damping."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cgid.errors import CgidError, InvalidValue
from cgid.finite_element._stepping import advance
from cgid.finite_element.limits import require_enough_time
from cgid.finite_element.pair import Pair
from cgid.finite_element.records import AT_ONCE, N_VALUES, PER_DURATION, Progress, Records, collected
from cgid.validation import Floats

#: Part of the stable step that is taken unless told otherwise, and the fewest steps between records: a contact that
#: begins or ends within a step costs energy like the square of the step, and few elements would allow large ones.
_CAUTION, _FEWEST = 0.9, 2


def stable_time_step(pair: Pair, retardation: tuple[float, float]) -> float:
    """Return the largest step that is stable [s].

    That of central differences with velocities half a step late in the damping, `2 / w (sqrt(1 + z^2) - z)`, `w` the
    highest frequency of a body and `z = b w / 2` (Belytschko, Liu & Moran, Nonlinear Finite Elements, section 6.2).
    That nodes in contact have no mass, and lean on each other, only lowers frequencies.
    """
    limits = []
    for frequency, delay in zip(pair.highest_frequencies, retardation, strict=True):
        ratio = delay * frequency / 2
        limits.append(2 / frequency / (np.hypot(1, ratio) + ratio))
    return float(min(limits))


def explicit(
    pair: Pair,
    velocity: float,
    duration: float,
    *,
    retardation: tuple[float, float],
    time_step: float | None,
    progress: Progress | None,
) -> Records:
    """Return the motion after the sphere touches at `velocity` [m/s], where it is about in contact for `duration` [s].

    Raises
    ------
    InvalidValue
        The step is beyond the limit of stability, or the bodies never part.
    """
    limit = stable_time_step(pair, retardation)
    require_enough_time(limit, duration)
    step, stride = _step_and_stride(limit, duration / PER_DURATION, time_step)
    chunks = _chunks(pair, velocity, np.array(retardation), step, stride)
    return collected(chunks, pair, step * stride, step, duration, progress)


def _step_and_stride(limit: float, interval: float, time_step: float | None) -> tuple[float, int]:
    if time_step is None:
        stride = max(_FEWEST, int(np.ceil(interval / (_CAUTION * limit))))
        return interval / stride, stride
    if time_step > limit:
        raise InvalidValue(
            f"time_step must not pass the limit of stability, {limit:.4g} s, got {time_step:.4g} s; take a smaller "
            "step, or method implicit, which has no such limit"
        )
    return time_step, max(1, round(interval / time_step))


def _chunks(
    pair: Pair, velocity: float, retardation: Floats, step: float, stride: int
) -> Iterator[tuple[Floats, Floats]]:
    matrix = (pair.stiffness.indptr, pair.stiffness.indices, pair.stiffness.data.reshape(-1, 4))
    touch = np.stack(pair.touching)
    size, n = pair.mass.size, touch.shape[1]
    stiffness = pair.stiffness.tocsr()
    inverse = np.stack([np.linalg.inv(stiffness[rows][:, rows].toarray()) for rows in touch])
    lag = retardation / step
    compliance = inverse[0] / (1 + lag[0]) + inverse[1] / (1 + lag[1]) + np.diag(pair.soft_part)
    moving = (pair.mass > 0) & ~pair.fixed
    inertia = (
        pair.mass,
        np.divide(1.0, pair.mass, out=np.zeros(size), where=moving),
        step,
        retardation,
        pair.n_sphere,
        pair.centre,
    )
    v = np.zeros(size)
    v[1 : pair.n_sphere : 2] = -velocity
    v[touch.ravel()] = 0.0
    state = (np.zeros(size), v, np.zeros((2, n)), np.zeros(n), np.zeros(n, np.bool_), np.zeros(1))
    while True:
        rows = (np.empty((AT_ONCE, n)), np.empty((AT_ONCE, N_VALUES)))
        if not advance(matrix, (touch, inverse, compliance, pair.gap), inertia, state, rows, stride):
            raise CgidError("the contact found no set of nodes that press and do not pull; use another time_step")
        yield rows

"""The step of DOP853 for a contact on modes: loops over tables of its coefficients, with the stages in `cells`.

Unrolled, as in `_step`, it takes five seconds to compile and is no quicker beside the motion of the modes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import bare_jit, by_address, constants
from cgid.physics.contact._dop853 import DENSE, END, ERROR_3, ERROR_5, HISTORY, LAST, STAGES, TAU, W, Y
from cgid.physics.contact._modes import IMPULSE, PLACE, RATE, STAGE, TURN_W, TURN_Y, velocity
from cgid.physics.contact._step import STEP

Array = NDArray[Any]

_TABLE = (*STAGES, *DENSE, ERROR_5, ERROR_3)
#: Of each row of the table: where its weights begin, the weights and the stages that they are of.
_BEGIN = np.cumsum([0, *map(len, _TABLE)])
_WEIGHT = np.array([weight for weights in _TABLE for weight in weights.values()])
_OF = np.array([STAGE + stage for weights in _TABLE for stage in weights])
_START, _DENSE, _ERROR_5, _ERROR_3 = constants(0, LAST, LAST + len(DENSE), LAST + len(DENSE) + 1)
_W, _Y, _TAU = constants(W, Y, TAU)


@bare_jit
def _sums(cells: Array, line: int) -> tuple[float, float, float]:
    """Return the changes of w, y and tau by a row of the table."""
    w, y, tau = 0.0, 0.0, 0.0
    for k in range(_BEGIN[line], _BEGIN[line + 1]):
        stage, weight = _OF[k], _WEIGHT[k]
        w += weight * cells[stage, TURN_W]
        y += weight * cells[stage, TURN_Y]
        tau += weight * cells[stage, PLACE]
    return w, y, tau


@bare_jit
def _stage(
    force: Any,
    p: Array,
    history: Array,
    weight: float,
    cells: Array,
    h: float,
    w: float,
    y: float,
    tau: float,
    stage: int,
) -> tuple[float, ...]:
    """Fill a stage; return its w, y, tau, x', g, c and f."""
    dw, dy, dt = _sums(cells, stage)
    w, y, tau = w + h * dw, y + h * dy, tau + h * dt
    u = y - velocity(cells, stage, tau, h)
    g, c = force(p, history, w)
    f = g + c * u
    cells[STAGE + stage, IMPULSE], cells[STAGE + stage, RATE] = w * f, u
    _keep(cells, stage, w, u, w * (weight - f))
    return w, y, tau, u, g, c, f


@bare_jit
def _keep(cells: Array, stage: int, w: float, u: float, change: float) -> None:
    """Keep w of a stage, and the rates of w and y."""
    row = STAGE + stage
    cells[row, PLACE], cells[row, TURN_W], cells[row, TURN_Y] = w, 0.5 * u, change


@bare_jit
def _ends(row: Array, column: int, before: float, after: float, h: float, first: float, last: float) -> None:
    """Fill the first four coefficients of a dense output from the values and rates at both ends."""
    change = after - before
    row[column], row[column + 1] = before, change
    row[column + 2], row[column + 3] = h * first - change, 2.0 * change - h * (first + last)


@by_address(STEP)
def modal_step(
    force: Any,
    p: Array,
    history: Array,
    inelasticity: float,
    weight: float,
    cells: Array,
    h: float,
    w: float,
    y: float,
    tau: float,
    u: float,
    f: float,
    top: float,
    peak: float,
    tolerance: float,
    row: Array,
) -> tuple[float, ...]:
    """Take a step as `_step.step`, whose results these are, with the stages in `cells`; nothing else yields."""
    place, speed, later = w, y, tau
    _keep(cells, _START, w, u, w * (weight - f))
    g = c = 0.0
    for stage in range(1, END + 1):
        place, speed, later, u, g, c, f = _stage(force, p, history, weight, cells, h, w, y, tau, stage)
    scale = max(top, abs(place))
    size = 1.0 / (1.0 + c / max(peak, f)) if f > 0.0 or peak > 0.0 else 1.0
    ew5, ey5, et5 = _sums(cells, _ERROR_5)
    ew3, ey3, et3 = _sums(cells, _ERROR_3)
    ew5, ey5, et5, ew3, ey3, et3 = ew5 / scale, ey5 / size, et5 / later, ew3 / scale, ey3 / size, et3 / later
    e5, e3 = ew5 * ew5 + ey5 * ey5 + et5 * et5, ew3 * ew3 + ey3 * ey3 + et3 * et3
    error = h * e5 / math.sqrt(3.0 * (e5 + 0.01 * e3)) / tolerance if e5 > 0.0 else e5
    if error <= 1.0:
        for stage in range(END + 1, LAST):
            _stage(force, p, history, weight, cells, h, w, y, tau, stage)
        row[0] = h
        for k in range(4):
            row[HISTORY + k] = history[k]
        first, last = cells[STAGE], cells[STAGE + END]
        _ends(row, _W, w, place, h, first[TURN_W], last[TURN_W])
        _ends(row, _Y, y, speed, h, first[TURN_Y], last[TURN_Y])
        _ends(row, _TAU, tau, later, h, w, place)
        for k in range(4):
            dw, dy, dt = _sums(cells, _DENSE + k)
            row[W + 4 + k], row[Y + 4 + k], row[TAU + 4 + k] = h * dw, h * dy, h * dt
    return error, place, speed, later, u, g, c, f

"""Numba kernels of a sphere that hits a structure given by its modes: contacts and the flights between them.

`_contact` follows each contact. Where the force would become attractive the structure runs from the sphere faster than
the material recovers: the sphere is released until it parts or is pressed again.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float64, int64
from numpy.typing import NDArray

from cgid._lib.compiled import FLOATS, LAW, bare_jit, by_address, constants, inner_jit, jit
from cgid.physics.contact import _contact, _dop853
from cgid.physics.contact._contact import OUT_OF_REACH, SEPARATED, find_peak, integrate
from cgid.physics.contact._modal_step import modal_step
from cgid.physics.contact._modes import (
    ANGULAR,
    CELLS,
    LEVEL,
    LOSS,
    SHARE,
    STRUCTURE,
    TOTALS,
    Structure,
    advance,
    aloft,
    energy,
    rise,
    settle,
    structure,
    tabulate,
    width_of,
)

Array = NDArray[Any]

#: Largest numbers of steps and of contacts of an impact.
MAX_STEPS, MAX_CONTACTS = _contact.MAX_STEPS, 64
COLUMNS = _dop853.COLUMNS
#: Columns of the results, in units of L, T0, v, m and K L^(3/2); the contact time is that of the first contact.
RESULTS = (*_contact.RESULTS, "contacts", "end", "impulse", "material_loss", "modal_energy", "end_level")
#: What ends a flight: nothing, an onset, or the material catches up with a sphere that was released.
_NEVER, _TOUCH, _CAUGHT_UP, _CREST = constants(*range(4))


@bare_jit
def _sought(event: int, force: Any, p: Array, history: Array, x: float, u: float) -> float:
    """Return what rises through 0 at the end of a flight."""
    if event == _TOUCH:
        way: float = x - history[0]
        return way
    if event == _CREST:
        return -u
    g, c = force(p, history, math.sqrt(max(x - history[0], 0.0)))
    push: float = g + c * u
    return push


@bare_jit
def _between(
    event: int, force: Any, p: Array, history: Array, m: Structure, flight: tuple[float, ...], low: float, high: float
) -> float:
    """Return when in a flight an event falls, by bisection."""
    sphere, y, weight = flight
    for _ in range(60):
        middle = 0.5 * (low + high)
        x, u = aloft(m, sphere, y, weight, middle)
        if _sought(event, force, p, history, x, u) > 0.0:
            high = middle
        else:
            low = middle
    return high


@bare_jit
def _event(
    force: Any, p: Array, history: Array, m: Structure, flight: tuple[float, ...], released: bool
) -> tuple[int, float]:
    """Return what happens first while the free motion is known, and when."""
    sphere, y, weight = flight
    width = width_of(m.cells)
    before = aloft(m, sphere, y, weight, 0.0)[1]
    for k in range(1, CELLS + 1):
        low, high = (k - 1) * width, k * width
        x, u = aloft(m, sphere, y, weight, high)
        if released:
            if x > history[0] and _sought(_CAUGHT_UP, force, p, history, x, u) > 0.0:
                return _CAUGHT_UP, _between(_CAUGHT_UP, force, p, history, m, flight, low, high)
            released = x > history[0]
        elif x >= history[0]:
            return _TOUCH, _between(_TOUCH, force, p, history, m, flight, low, high)
        elif before > 0.0 > u:
            crest = _between(_CREST, force, p, history, m, flight, low, high)
            if aloft(m, sphere, y, weight, crest)[0] > history[0]:
                return _TOUCH, _between(_TOUCH, force, p, history, m, flight, low, crest)
        before = u
    return _NEVER, CELLS * width


@by_address(int64(LAW[0], FLOATS, FLOATS, float64, float64, STRUCTURE, FLOATS, FLOATS))
def _fly(
    force: Any, p: Array, history: Array, weight: float, window: float, m: Structure, state: Array, result: Array
) -> int:
    """Follow sphere and modes without a force until they meet again or the window ends."""
    w, y, tau = state
    x, first = history[0] + w * w, True
    while True:
        largest = rise(m)
        sphere = x + m.cells[LEVEL, 0]
        if first:
            result[-1], first = sphere, False
        left = window - tau
        if x <= history[0]:
            far = max(sphere, sphere + left * (y + 0.5 * weight * left)) + largest < history[0]
            if left <= 0.0 or far:
                return _NEVER
        event, t = _event(force, p, history, m, (sphere, y, weight), x > history[0])
        if event == _TOUCH and tau + t > window:
            return _NEVER
        x = aloft(m, sphere, y, weight, t)[0]
        y, tau = y + weight * t, tau + t
        advance(m, tau)
        if event != _NEVER:
            state[0], state[1], state[2] = math.sqrt(max(x - history[0], 0.0)) if event == _CAUGHT_UP else 0.0, y, tau
            return event


#: What the kernel gets of here and elsewhere behind the flags of the law: as arguments they are compiled once.
PARTS = (integrate, modal_step, find_peak, _fly)


@inner_jit
def _follow(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    p: Array,
    weight: float,
    window: float,
    tolerance: float,
    m: Structure,
    steps: Array,
    result: Array,
) -> int:
    """Fill the steps and the results of one impact; return the number of steps."""
    result[:] = 0.0
    history, state = np.zeros(4), np.zeros(3)
    n: int = 0
    state[1], contacts, lasts = 1.0, 1, 0.0
    while contacts <= MAX_CONTACTS:
        first = n
        n = parts[1](
            force,
            corner_of,
            turn,
            parts[2],
            parts[0],
            p,
            0.0,
            weight,
            tolerance,
            True,
            m,
            history,
            state,
            steps,
            n,
            result,
        )
        if result[0] != SEPARATED:
            return n
        parts[3](force, p, 0.0, True, steps[first:n], result)
        advance(m, state[2])
        lasts = state[2] if contacts == 1 else lasts
        result[2], result[8], result[9], result[10] = lasts, m.cells[TOTALS, 1], contacts, state[2]
        result[11], result[12], result[13] = m.cells[TOTALS, 0], m.cells[TOTALS, 2], energy(m.modes)
        event = parts[4](force, p, history, weight, window, m, state, result)
        if event == _NEVER:
            return n
        contacts += int(event == _TOUCH)
        result[9] = contacts
    result[0] = OUT_OF_REACH
    return n


@jit
def follow(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    numbers: Array,
    decay: Array,
    angular: Array,
    loss: Array,
    participation: Array,
    parameters: Array,
    tolerance: float,
    rows: Array,
    steps: Array,
    first_step: Array,
    results: Array,
) -> None:
    """Follow some impacts, in this order, until all are done or the steps are full.

    decay, angular and loss (modes,) are z w [1/s], w_d [1/s] and z / sqrt(1 - z^2), participation (impacts, modes) is
    in 1/kg, parameters (impacts, 5) are gamma, window over T0, mass [kg], T0 [s] and width of cells [s]. steps holds
    the steps one after the other, those of rows[i] from first_step[i] to first_step[i + 1].
    """
    m, here, tabulated = structure(angular.size), 0, 0.0
    first_step[0] = 0
    for r in range(angular.size):
        m.modes[LOSS, r] = loss[r]
    for i in range(rows.size):
        if len(steps) - here < MAX_STEPS:
            return
        row = rows[i]
        weight, window, mass, unit, width = parameters[row]
        if width != tabulated:
            tabulate(decay, angular, width, m.modes)
            tabulated = width
        for r in range(angular.size):
            m.modes[SHARE, r], m.modes[ANGULAR, r] = participation[row, r] * mass, angular[r] * unit
        settle(m, width / unit)
        room = steps[here : here + MAX_STEPS]
        here += _follow(force, corner_of, turn, parts, numbers[row], weight, window, tolerance, m, room, results[row])
        first_step[i + 1] = here

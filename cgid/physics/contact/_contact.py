"""Numba kernels that integrate one contact: any law against a half-space, a plate or modes, with or without weight.

Dimensionless (x approach, y velocity of the sphere, u = x', f force, all in units of L, T0, v and `K L^(3/2)`):

    x' = y - lambda f,  y' = gamma - f,  f = g + c x',  hence  f = (g + c y) / (1 + lambda c).

A structure given by its modes moves with a velocity v, which the past of the force settles (`_modes`): there x' = y - v
and lambda = 0, and the scheme is Pouzet's form of a Runge-Kutta method for Volterra equations.

A law gives g and c, the force at rest and the damping, from w with `x = origin + w^2`; with `d tau = w d sigma` the
contact passes smoothly through w = 0 at both ends: `w' = u / 2, y' = w (gamma - f), tau' = w`. DOP853 integrates these
in sigma. Where the law has another path or slope (a corner on the way in, the turn) the step is repeated to end there.

`law` stands for three compiled functions of the numbers p of an impact and of its history, four numbers that begin
at 0, of which the first is the origin:

    force(p, history, w) -> g, c;  corner(p, history) -> x at which the path changes on the way in, infinite for none;
    turn(p, history, x) -> x less the new origin: change the history, at a corner and where the sphere turns at x.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from cgid._lib.compiled import FLOATS, LAW, ROWS, bare_jit, by_address, constants, inner_jit, jit
from cgid.physics.contact._dop853 import COLUMNS, HISTORY, LAST, TAU, W, Y
from cgid.physics.contact._modes import (
    IMPULSE,
    LONGEST,
    RATE,
    SPARE,
    STAGE,
    STRUCTURE,
    THROUGH,
    WITHIN,
    Structure,
    advance,
    dot,
    known,
    remember,
    structure,
    sway,
    velocity,
    width_of,
)
from cgid.physics.contact._step import STEP, step

Array = NDArray[Any]

#: Largest number of steps of an impact, and of attempts at them.
MAX_STEPS = 4096
#: Outcomes of an impact. The last three are the fault of its law: a number that is not finite, a force that attracts
#: where it may not, a turn that moves the sphere.
SEPARATED, STAYS, OUT_OF_REACH, NOT_FINITE, ATTRACTS, TORN = 0, 1, 2, 3, 4, 5
DISPLACEMENT, FORCE = constants(0, 1)
#: Columns of `summaries`.
RESULTS = (
    "status",
    "restitution",
    "contact_time",
    "peak_force",
    "time_of_peak",
    "peak_displacement",
    "compression_time",
    "end_displacement",
    "plate_energy",
)
#: What a law has: another path after a corner or the turn; a force that may become attractive, which ends the contact.
HYSTERETIC, PULLS = 1, 2
#: The share of the tolerance that the step control gets: the error of a pulse is 2 to 9 times its own.
_SHARE = 0.03
#: Below this tolerance on modes it gets less, since within a step they need a higher order; the least it can get.
_LOOSE, _LEAST = 1e-6, 3e-13
#: The least it can get where a weight above the force of the impact needs more digits.
_FINEST = 1e-15
#: A force of less than this share of the tolerance times that at rest is none: the rest is free flight.
_FREE = 1e-4
#: A contact that lasts longer than this under its weight on modes does not end [T0].
_FOR_GOOD = 1e3
#: A force below 0 by less than so many times the tolerance is an error of the integration: 6 times were found.
_ATTRACTION = 30.0
#: The force jumps at a turn if it changes by more than so many times the tolerance; the rest is that of a turn's place.
_JUMP = 100.0
#: Largest rounding error of the approach at a turn, over the approach.
_ROUNDING = 1e-9
#: Less than this, in speed and force, is no rebound.
_NOTHING = 1e-16
#: Slowest rebound that can be told from rounding, of a sphere that is released by the force.
_MIN_REBOUND = 1e-12
_FIRST, _NO_MODES = constants(0, 0)
_NO_EVENT, _END, _RELEASE, _TURN, _CORNER = constants(*range(5))
#: Gauss-Lobatto nodes on [0, 1] and their weights.
_INNER, _OUTER = (math.sqrt((7 - sign * 2 * math.sqrt(7)) / 21) / 2 for sign in (1, -1))
_NODES = np.array([0.0, 0.5 - _OUTER, 0.5 - _INNER, 0.5 + _INNER, 0.5 + _OUTER, 1.0])
_WEIGHTS = np.array([2, 14 - math.sqrt(7), 14 + math.sqrt(7), 14 + math.sqrt(7), 14 - math.sqrt(7), 2]) / 60


@jit
def no_corner(p: Array, history: Array) -> float:
    """Return infinity: the corner of a law without one."""
    return math.inf


@jit
def no_turn(p: Array, history: Array, x: float) -> float:
    """Change nothing: the turn of a law with one path."""
    below: float = x - history[0]
    return below


def flags_of(law: Any) -> int:
    """Return what a law has of `HYSTERETIC` and `PULLS`."""
    return HYSTERETIC * int(law.corner is not None or law.turn is not None) + PULLS * int(law.pulls)


@bare_jit
def value(row: Array, first: int, s: float) -> float:
    """Return the dense output whose columns begin at `first`, at the share s of a step."""
    r = 1.0 - s
    total: float = row[first] + s * (
        row[first + 1]
        + r
        * (
            row[first + 2]
            + s
            * (row[first + 3] + r * (row[first + 4] + s * (row[first + 5] + r * (row[first + 6] + s * row[first + 7]))))
        )
    )
    return total


@bare_jit
def state_at(
    force: Any, p: Array, history: Array, inelasticity: float, modal: bool, row: Array, s: float
) -> tuple[float, float, float]:
    """Return w, x' and the force at the share s of a step; whether it is one on modes."""
    w = value(row, W, s)
    g, c = force(p, history, w)
    if modal:
        u = 0.0
        for k in range(7, -1, -1):
            u = u * s + row[Y + k]
        return w, u, g + c * u
    y = value(row, Y, s)
    f = (g + c * y) / (1.0 + inelasticity * c)
    return w, y - inelasticity * f, f


@bare_jit
def _refine(cells: Array, row: Array, first: float, last: float) -> None:
    """Replace the dense output of y by that of x', a polynomial: the slope of w is of a lower order."""
    u = cells[SPARE]
    u[0], u[WITHIN.size - 1] = first, last
    for k in range(1, WITHIN.size - 1):
        u[k] = value(row, Y, WITHIN[k]) - velocity(cells, LAST + k, value(row, TAU, WITHIN[k]), row[0])
    for degree in range(WITHIN.size):
        row[Y + degree] = dot(THROUGH[degree], u)


@bare_jit
def _watched(
    event: int,
    force: Any,
    p: Array,
    history: Array,
    inelasticity: float,
    modal: bool,
    row: Array,
    s: float,
    corner: float,
    least: float,
) -> float:
    """Return what falls to 0 at an event, at the share s of a step."""
    w = value(row, W, s)
    if event == _END:
        return w
    if event == _CORNER:
        left: float = corner - history[0] - w * w
        return left
    w, u, f = state_at(force, p, history, inelasticity, modal, row, s)
    push: float = u if event == _TURN else min(w, f - least)
    return push


@bare_jit
def _place(
    event: int,
    force: Any,
    p: Array,
    history: Array,
    inelasticity: float,
    modal: bool,
    row: Array,
    low: float,
    high: float,
    corner: float,
    least: float,
) -> float:
    """Return the share of a step, within bounds, at which an event falls: regula falsi (Illinois), or bisection."""
    before = _watched(event, force, p, history, inelasticity, modal, row, low, corner, least)
    after, side = _watched(event, force, p, history, inelasticity, modal, row, high, corner, least), 0
    for k in range(100):
        middle = 0.5 * (low + high)
        if before > 0.0 > after and k % 4 != 3:
            middle = low + (high - low) * before / (before - after)
        now = _watched(event, force, p, history, inelasticity, modal, row, middle, corner, least)
        if abs(now) < 1e-18 or high - low < 1e-14:
            return middle
        if now > 0.0:
            low, before = middle, now
            after = 0.5 * after if side == 1 else after
            side = 1
        else:
            high, after = middle, now
            before = 0.5 * before if side == 2 else before
            side = 2
    return high


@bare_jit
def _first_step(force: Any, p: Array, history: Array, inelasticity: float, weight: float, w: float, u: float) -> float:
    """Return the length of the first step: one that changes the velocity by some per cent."""
    h = 1.0
    for _ in range(2000):
        ahead = w + 0.5 * h * u
        g, c = force(p, history, ahead)
        change = h * ahead * (g + c) / (1.0 + inelasticity * c)
        if weight > 1.0:
            change = max(change, h * ahead * weight)
        if change > 0.5 or not math.isfinite(change):
            h *= 0.5
        elif change < 0.02 and h < 1e100:
            h *= 2.0
        else:
            break
    return h


@bare_jit
def _creeps(force: Any, p: Array, history: Array, weight: float, w: float) -> bool:
    """Return whether a sphere that its weight all but holds at w comes to rest without swinging beyond."""
    low, high = 0.0, w
    for _ in range(50):
        middle = 0.5 * (low + high)
        if force(p, history, middle)[0] > weight:
            high = middle
        else:
            low = middle
    c, stiffness = force(p, history, high)[1], _stiffness(force, p, history, high)
    return bool(stiffness > 0.0 and c * c > 67.0 * stiffness)


@bare_jit
def _stiffness(force: Any, p: Array, history: Array, w: float) -> float:
    """Return the slope of the force at rest."""
    slope: float = (force(p, history, 1.001 * w)[0] - force(p, history, w)[0]) / (0.002 * w * w)
    return slope


@bare_jit
def _is_free(force: Any, p: Array, history: Array, w: float, y: float, negligible: float) -> bool:
    """Return whether no force acts on the sphere from w on, if it goes on at y."""
    for k in range(4):
        g, c = force(p, history, 0.25 * k * w)
        if not abs(g + c * y) <= negligible:
            return False
    return True


@bare_jit
def _rests(force: Any, p: Array, history: Array, weight: float, modes: Structure, w: float, u: float, f: float) -> bool:
    """Return whether neither contact nor modes swing so far that a sphere leaves which its weight holds."""
    swing = abs(f - weight) + math.sqrt(max(_stiffness(force, p, history, w), 0.0)) * abs(u) if w > 0.0 else weight
    return bool(swing < 0.5 * weight and swing + sway(modes.modes, weight) < 0.5 * weight)


@by_address(
    int64(*LAW, STEP, int64, FLOATS, float64, float64, float64, boolean, STRUCTURE, FLOATS, FLOATS, ROWS, int64, FLOATS)
)
def integrate(
    force: Any,
    corner_of: Any,
    turn: Any,
    step: Any,
    flags: int,
    p: Array,
    inelasticity: float,
    weight: float,
    tolerance: float,
    modal: bool,
    modes: Structure,
    history: Array,
    state: Array,
    steps: Array,
    n: int,
    result: Array,
) -> int:
    """Fill the steps (n, `COLUMNS`) of one contact from the nth on, and its results; return how many are filled.

    The contact begins at the state w, y and tau, which becomes that at its end. Unless it is one on modes, those
    only lend their space.
    """
    cells = modes.cells
    hysteretic, pulls = flags & HYSTERETIC != 0, flags & PULLS != 0
    releases = pulls or modal
    permitted = _SHARE * tolerance
    w, y, tau = state
    top, peak, compressing, begin = 0.0, 0.0, True, tau
    result[0] = OUT_OF_REACH
    corner = corner_of(p, history) if hysteretic else math.inf
    v, cuts, part, longest, least = 0.0, 1, 1.0, math.inf, 0.0
    if weight > 1.0:
        # The fall into the contact outweighs the energy of the impact, from which the rebound is what remains.
        permitted = max(permitted * math.pow(weight, -5.0 / 3.0), _FINEST)
    if modal:
        # More than one event may fall in a step.
        permitted = max(permitted * math.pow(min(tolerance / _LOOSE, 1.0), 1.25), _LEAST)
        v, cuts, part, longest = velocity(cells, _FIRST, tau, 0.0), 8, 0.125, LONGEST * width_of(cells)
    g, c = force(p, history, w)
    f = (g + c * (y - v)) / (1.0 + inelasticity * c)
    u = y - v - inelasticity * f
    h = _first_step(force, p, history, inelasticity, weight, w, u)
    attempts = 0
    while n < steps.shape[0]:
        row = steps[n]
        attempts += 1
        if attempts > 3 * steps.shape[0]:
            return 0
        if modal:
            cells[STAGE, IMPULSE], cells[STAGE, RATE] = w * f, u
            while h * (w + 0.25 * h * u) > longest:
                h *= 0.8
            if known(cells, tau) < h * (w + 0.25 * h * u):
                advance(modes, tau)
                if weight > 0.0 and (tau - begin > _FOR_GOOD or _rests(force, p, history, weight, modes, w, u, f)):
                    result[0] = STAYS
                    return 0
        error, w1, y1, tau1, u1, g1, c1, f1 = step(
            force, p, history, inelasticity, weight, cells, h, w, y, tau, u, f, top, peak, permitted, row
        )
        if not error <= 1.0 or tau1 - tau > longest:
            h *= max(0.2, min(0.8, 0.9 * math.pow(max(error, 1e-30), -0.125))) if error < 1e300 else 0.2
            if tau + w * h + h * h == tau:
                result[0] = OUT_OF_REACH if math.isfinite(g1 + c1) else NOT_FINITE
                return 0
            continue
        following = h * min(2.0, 0.9 * math.pow(max(error, 1e-30), -0.125))
        if modal:
            _refine(cells, row, u, u1)
        event, share, low = _NO_EVENT, 1.0, 0.0
        for cut in range(1, cuts + 1):
            share, w2, u2, f2 = cut * part, w1, u1, f1
            if modal:
                w2, u2, f2 = state_at(force, p, history, inelasticity, modal, row, share)
                # The structure may run from the sphere faster than the material recovers; rounding is no attraction.
                least = 0.0 if pulls else -permitted * peak
                compressing = compressing or u2 > 0.0
            if not (w2 > 0.0 and (f2 > least or not releases)):
                event = _RELEASE if releases else _END
                share = _place(event, force, p, history, inelasticity, modal, row, low, share, corner, least)
            ending, until = event, share
            if compressing and u2 <= 0.0:
                at = _place(_TURN, force, p, history, inelasticity, modal, row, low, share, corner, least)
                if at < share or event == _NO_EVENT:
                    event, share = _TURN, at
            if corner < math.inf and compressing:
                deepest = value(row, W, share)
                if corner <= history[0] + deepest * deepest:
                    event = _CORNER
                    share = _place(event, force, p, history, inelasticity, modal, row, low, share, corner, least)
            if event == _TURN:
                deepest = value(row, W, share)
                depth = history[0] + deepest * deepest
                if depth > result[5]:
                    result[5], result[6] = depth, value(row, TAU, share)
                compressing = False
                if not hysteretic:
                    event, share = ending, until
            if event != _NO_EVENT:
                break
            low = cut * part
        if share < 1.0:
            error, w1, y1, tau1, u1, g1, c1, f1 = step(
                force,
                p,
                history,
                inelasticity,
                weight,
                cells,
                share * h,
                w,
                y,
                tau,
                u,
                f,
                top,
                peak,
                math.inf,
                row,
            )
            following = min(following, h)
            if modal:
                _refine(cells, row, u, u1)
        if modal:
            remember(modes, row[0])
        n += 1
        w, y, tau, u, g, c, f = w1, y1, tau1, u1, g1, c1, f1
        top, peak = max(top, abs(w)), max(peak, f)
        if not modal and (event == _RELEASE and compressing if pulls else f < -_ATTRACTION * tolerance * peak):
            result[0] = ATTRACTS
            return 0
        if event in (_END, _RELEASE):
            if not modal and pulls and y > -_MIN_REBOUND:
                return 0
            result[0], result[1], result[2] = SEPARATED, -y, tau
            state[0], state[1], state[2] = w if releases and w > 1e-9 * top else 0.0, y, tau
            result[7] = history[0] + state[0] * state[0]
            return n
        if event != _NO_EVENT:
            v = y - u - inelasticity * f
            depth = corner
            if event == _TURN:
                depth = history[0] + w * w
                if depth >= corner:  # by rounding
                    depth = corner - 1e-15 * abs(corner)
            w = math.sqrt(max(turn(p, history, depth), 0.0))
            if not abs(history[0] + w * w - depth) <= _ROUNDING * (abs(depth) + w * w):
                result[0] = TORN
                return 0
            g, c = force(p, history, w)
            if event == _TURN:
                # At rest, on a scale of its own.
                jumps = inelasticity > 0.0 and abs(g - f) > _JUMP * tolerance * peak
                f, top = g, w
                if not modal and not jumps:
                    y = inelasticity * f
                following = min(1.0 / math.sqrt(max(f, 1e-300)), h)
            f = (g + c * (y - v)) / (1.0 + inelasticity * c)
            u = y - v - inelasticity * f
            if event == _TURN and jumps:
                compressing = u > 0.0  # the plate springs back, or gives way
            corner = corner_of(p, history)
        if weight > 0.0 and not modal:
            at_rest = (u > 0.0 and not compressing) or abs(u) < 1e-13
            creeps = abs(f - weight) < 1e-3 * weight and _creeps(force, p, history, weight, w)
            if event == _NO_EVENT and (at_rest or creeps):
                result[0], result[1] = STAYS, 0.0
                return n
        elif not modal and inelasticity > 0.0 and abs(y) + f < _NOTHING:
            return 0  # it comes to rest in a plate
        elif not modal and not (compressing or pulls) and n < steps.shape[0] and g + c * y < _FREE * permitted * g:
            free = -g / c if g > 0.0 and c > 0.0 else 0.0  # what y tends to
            if free < 0.0 and _is_free(force, p, history, w, free, permitted * peak):
                _fly(steps[n], history, w, free, tau)
                end = steps[n, TAU] + steps[n, TAU + 1]
                result[0], result[1], result[2], result[7] = SEPARATED, -free, end, history[0]
                return n + 1
        h = following
    return 0


@bare_jit
def _fly(row: Array, history: Array, w: float, y: float, tau: float) -> None:
    """Fill the last step of a sphere that feels no more force."""
    row[:] = 0.0
    h = -2.0 * w / y
    row[0], row[W], row[W + 1], row[Y] = h, w, -w, y
    for k in range(4):
        row[HISTORY + k] = history[k]
    row[TAU], row[TAU + 1], row[TAU + 2] = tau, 0.5 * h * w, 0.5 * h * w


@jit
def summaries(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, len(`RESULTS`)). Where there is no rebound the restitution is 0."""
    steps, lent = np.empty((MAX_STEPS, COLUMNS)), structure(_NO_MODES)
    for i in rows:
        p, yields = numbers[i], inelasticity[i]
        n = _follow(force, corner_of, turn, parts, p, yields, weight[i], tolerance, lent, steps, out[i])
        if n > 0:
            squared, least = parts[3](force, p, yields, False, steps[:n], out[i])
            out[i, 8] = yields * squared
            if least < -_ATTRACTION * tolerance * out[i, 3]:
                out[i, 0] = ATTRACTS


@inner_jit
def _follow(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    p: Array,
    inelasticity: float,
    weight: float,
    tolerance: float,
    lent: Structure,
    steps: Array,
    result: Array,
) -> int:
    """Integrate an impact without modes."""
    result[:] = 0.0
    history, state = np.zeros(4), np.zeros(3)
    state[1] = 1.0
    n: int = parts[1](
        force,
        corner_of,
        turn,
        parts[2],
        parts[0],
        p,
        inelasticity,
        weight,
        tolerance,
        False,
        lent,
        history,
        state,
        steps,
        0,
        result,
    )
    return n if result[0] == SEPARATED else 0


@by_address(types.UniTuple(float64, 2)(LAW[0], FLOATS, float64, boolean, ROWS, FLOATS))
def find_peak(
    force: Any, p: Array, inelasticity: float, modal: bool, steps: Array, result: Array
) -> tuple[float, float]:
    """Find the peak force and its time, where it is above that of the result.

    By golden sections near the largest force at the nodes, then a parabola. Return the integral of the force squared
    and the least force at the nodes.
    """
    best, place, total, lowest, n = -1, 0.0, 0.0, 0.0, len(steps)
    for k in range(n):
        row, energy = steps[k], 0.0
        for node in range(_NODES.size):
            w, _, f = state_at(force, p, row[HISTORY : HISTORY + 4], inelasticity, modal, row, _NODES[node])
            energy += _WEIGHTS[node] * w * f * f
            lowest = min(lowest, f)
            if f > result[3]:
                result[3], best, place = f, k, _NODES[node]
        total += row[0] * energy
    for k in range(max(best - 1, 0), min(best + 2, n) if best >= 0 else 0):
        row, low, high = steps[k], 0.0, 1.0
        if k == best:
            low, high = max(place - 0.36, 0.0), min(place + 0.36, 1.0)
        elif (k < best and place > 0.0) or (k > best and place < 1.0):
            continue
        history = row[HISTORY : HISTORY + 4]
        for _ in range(20):
            first, second = low + 0.3819660112501051 * (high - low), low + 0.6180339887498949 * (high - low)
            if (
                state_at(force, p, history, inelasticity, modal, row, first)[2]
                < state_at(force, p, history, inelasticity, modal, row, second)[2]
            ):
                low = first
            else:
                high = second
        middle = 0.5 * (low + high)
        f0 = state_at(force, p, history, inelasticity, modal, row, low)[2]
        f1 = state_at(force, p, history, inelasticity, modal, row, middle)[2]
        f2 = state_at(force, p, history, inelasticity, modal, row, high)[2]
        bend = f0 - 2.0 * f1 + f2
        if bend < 0.0:
            middle = min(max(middle + 0.25 * (high - low) * (f0 - f2) / bend, low), high)
        for s in (middle, 0.0, 1.0):
            f = state_at(force, p, history, inelasticity, modal, row, s)[2]
            if f >= result[3]:
                result[3], result[4] = f, value(row, TAU, s)
    return total, lowest


#: What the kernels get of here and of `_step` behind the flags of the law: as arguments they are compiled once.
PARTS = (integrate, step, find_peak)


@bare_jit
def _end(steps: Array) -> float:
    """Return when the last step ends."""
    end: float = steps[-1, TAU] + steps[-1, TAU + 1] if len(steps) else 0.0
    return end


@bare_jit
def _march(steps: Array, n: int, s: float, tau: float) -> tuple[int, float]:
    """Return the step and the share of it at time tau, seeking from (n, s): Newton in a bracket; -1 in a flight."""
    if tau < steps[n, TAU]:
        n, s = 0, 0.0
    while n < len(steps) - 1 and steps[n + 1, TAU] <= tau:
        n, s = n + 1, 0.0
    # By rounding a time just before the next step may lie behind the end of this one.
    if tau - steps[n, TAU] > (1.0 + 1e-12) * steps[n, TAU + 1]:
        return n, -1.0
    s = max(s, 0.0)
    row, low, high = steps[n], 0.0, 1.0
    h = row[0]
    w, past = value(row, W, s), tau - value(row, TAU, s)
    # From onset on time goes like sigma^2 / 4.
    s = min(max(s + (past / w if past < 10.0 * w * w else 2.0 * math.sqrt(past)) / h, 0.0), 1.0)
    for _ in range(60):
        error = value(row, TAU, s) - tau
        if error < 0.0:
            low = s
        else:
            high = s
        rate = h * value(row, W, s)
        following = s - error / rate if rate > 0.0 else 0.5 * (low + high)
        if abs(following - s) <= 1e-6 or high - low <= 1e-15:
            return n, min(max(following, low), high)
        s = following if low < following < high else 0.5 * (low + high)
    return n, s


@bare_jit
def _quantity(force: Any, p: Array, inelasticity: float, modal: bool, row: Array, s: float, quantity: int) -> float:
    w, _, f = state_at(force, p, row[HISTORY : HISTORY + 4], inelasticity, modal, row, s)
    return row[HISTORY] + w * w if quantity == DISPLACEMENT else max(f, 0.0)


@jit
def at_times(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    solved: Array,
    begin: Array,
    end: Array,
    times: Array,
    time_scale: Array,
    amplitude: Array,
    quantity: int,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, k) at times (n, k) [s] with `DISPLACEMENT` or `FORCE`, zero outside contact.

    Impacts on modes are solved before: the steps of row i are those from begin[i] to end[i]; without these there are
    none.
    """
    room, result, lent, modal = (
        np.empty((MAX_STEPS, COLUMNS)),
        np.empty(len(RESULTS)),
        structure(_NO_MODES),
        begin.size > 0,
    )
    for i in rows:
        p, yields, steps = numbers[i], inelasticity[i], room
        if modal:
            steps = solved[begin[i] : end[i]]
        else:
            n = _follow(force, corner_of, turn, parts, p, yields, weight[i], tolerance, lent, room, result)
            steps = room[:n]
        last = _end(steps)
        n, s = 0, 0.0
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            out[i, k] = 0.0
            if 0.0 < tau < last:
                n, s = _march(steps, n, s, tau)
                if s >= 0.0:
                    out[i, k] = amplitude[i] * _quantity(force, p, yields, modal, steps[n], s, quantity)


@jit
def add_to_frames(
    force: Any,
    corner_of: Any,
    turn: Any,
    parts: Any,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    solved: Array,
    begin: Array,
    end: Array,
    frames: Array,
    onset: Array,
    step: Array,
    amplitude: Array,
    rows: Array,
) -> None:
    """Add one force pulse to some rows of frames (n, n_samples); only contact is touched.

    onset [samples] is where the onset falls on the sample grid, step is the sampling interval over T0.
    """
    room, result, lent, modal = (
        np.empty((MAX_STEPS, COLUMNS)),
        np.empty(len(RESULTS)),
        structure(_NO_MODES),
        begin.size > 0,
    )
    for i in rows:
        p, yields, steps = numbers[i], inelasticity[i], room
        if modal:
            steps = solved[begin[i] : end[i]]
        else:
            n = _follow(force, corner_of, turn, parts, p, yields, weight[i], tolerance, lent, room, result)
            steps = room[:n]
        last, n_samples = _end(steps), float(frames.shape[1])
        here = int(min(max(math.floor(onset[i]) + 1.0, 0.0), n_samples))
        stop = int(min(max(math.ceil(onset[i] + last / step[i]) + 1.0, 0.0), n_samples))
        n, s = 0, 0.0
        for k in range(here, stop):
            tau = (k - onset[i]) * step[i]
            if 0.0 < tau < last:
                n, s = _march(steps, n, s, tau)
                if s >= 0.0:
                    frames[i, k] += amplitude[i] * _quantity(force, p, yields, modal, steps[n], s, FORCE)

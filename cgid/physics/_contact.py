"""Numba kernels that integrate one impact: any contact law against a half-space or a plate, with or without weight.

Dimensionless (x approach, y velocity of the sphere, u = x', f force, all in units of L, T0, v and `K L^(3/2)`):

    x' = y - lambda f,  y' = gamma - f,  f = g + c x',  hence  f = (g + c y) / (1 + lambda c).

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
from numpy.typing import NDArray

from cgid.compiled import inner_jit, jit
from cgid.physics._dop853 import END, ERROR_3, ERROR_5, LAST, STAGES, dense, stages, weighted

Array = NDArray[Any]

#: Largest number of steps of an impact, and of attempts at them.
MAX_STEPS = 4096
#: Outcomes of an impact; the law gave a number that is not finite.
SEPARATED, STAYS, OUT_OF_REACH, NOT_FINITE = 0, 1, 2, 3
#: Columns of a step: its length in sigma, the history, and the dense output of w, y and tau.
HISTORY, W, Y, TAU, COLUMNS = 1, 5, 13, 21, 29
DISPLACEMENT, FORCE = 0, 1
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
#: A force of less than this share of the tolerance times that at rest is none: the rest is free flight.
_FREE = 1e-4
#: Slowest rebound that can be told from rounding, of a sphere that is released by the force.
_MIN_REBOUND = 1e-12
_NO_EVENT, _END, _RELEASE, _TURN, _CORNER = 0, 1, 2, 3, 4
#: Gauss-Lobatto nodes on [0, 1] and their weights.
_INNER, _OUTER = (math.sqrt((7 - sign * 2 * math.sqrt(7)) / 21) / 2 for sign in (1, -1))
_NODES = np.array([0.0, 0.5 - _OUTER, 0.5 - _INNER, 0.5 + _INNER, 0.5 + _OUTER, 1.0])
_WEIGHTS = np.array([2, 14 - math.sqrt(7), 14 + math.sqrt(7), 14 + math.sqrt(7), 14 - math.sqrt(7), 2]) / 60

_STAGE = """
    w{i} = w + h * ({w})
    y{i} = y + h * ({y})
    g, c = force(p, history, w{i})
    f = (g + c * y{i}) / (1.0 + inelasticity * c)
    dw{i} = 0.5 * (y{i} - inelasticity * f)
    dy{i} = w{i} * (weight - f)
"""
_INDENTED = _STAGE.replace("\n    ", "\n        ")
#: Returns the error over the permitted one, w, y, tau, g, c and f at the end; if the step is good, fills its row.
_STEP = f"""
def step(force, p, history, inelasticity, weight, h, w, y, tau, f, top, peak, tolerance, row):
    w0, dw0, dy0 = w, 0.5 * (y - inelasticity * f), w * (weight - f)
{stages(_STAGE, 1, END + 1)}
    later = tau + h * ({weighted(STAGES[END], "w")})
    scale = max(top, abs(w{END}))
    size = 1.0 / (1.0 + c / max(peak, f)) if f > 0.0 or peak > 0.0 else 1.0
    ew5, ey5, et5 = {", ".join(f"({weighted(ERROR_5, name)})" for name in ("dw", "dy", "w"))}
    ew3, ey3, et3 = {", ".join(f"({weighted(ERROR_3, name)})" for name in ("dw", "dy", "w"))}
    ew5, ey5, et5, ew3, ey3, et3 = ew5 / scale, ey5 / size, et5 / later, ew3 / scale, ey3 / size, et3 / later
    e5, e3 = ew5 * ew5 + ey5 * ey5 + et5 * et5, ew3 * ew3 + ey3 * ey3 + et3 * et3
    error = h * e5 / math.sqrt(3.0 * (e5 + 0.01 * e3)) / tolerance if e5 > 0.0 else e5
    if error <= 1.0:
        at_end = g, c, f
{stages(_INDENTED, END + 1, LAST)}
        row[0] = h
        for k in range(4):
            row[HISTORY + k] = history[k]
{dense("w", "dw", f"w{END} - w", W)}{dense("y", "dy", f"y{END} - y", Y)}{dense("tau", "w", "later - tau", TAU)}
        g, c, f = at_end
    return error, w{END}, y{END}, later, g, c, f
"""
exec(compile(_STEP, __file__, "exec"), globals())
step = inner_jit(globals()["step"])


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


@inner_jit
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


@inner_jit
def _state(
    force: Any, p: Array, history: Array, inelasticity: float, row: Array, s: float
) -> tuple[float, float, float]:
    """Return w, x' and the force at the share s of a step."""
    w, y = value(row, W, s), value(row, Y, s)
    g, c = force(p, history, w)
    f = (g + c * y) / (1.0 + inelasticity * c)
    return w, y - inelasticity * f, f


@inner_jit
def _watched(
    event: int, force: Any, p: Array, history: Array, inelasticity: float, row: Array, s: float, corner: float
) -> float:
    """Return what falls to 0 at an event, at the share s of a step."""
    w = value(row, W, s)
    if event == _END:
        return w
    if event == _CORNER:
        left: float = corner - history[0] - w * w
        return left
    g, c = force(p, history, w)
    y = value(row, Y, s)
    push: float = y - inelasticity * g if event == _TURN else min(w, g + c * y)
    return push


@inner_jit
def _place(
    event: int, force: Any, p: Array, history: Array, inelasticity: float, row: Array, high: float, corner: float
) -> float:
    """Return the share of a step, at most high, at which an event falls: regula falsi (Illinois), or bisection."""
    low, before = 0.0, _watched(event, force, p, history, inelasticity, row, 0.0, corner)
    after, side = _watched(event, force, p, history, inelasticity, row, high, corner), 0
    for k in range(100):
        middle = 0.5 * (low + high)
        if before > 0.0 > after and k % 4 != 3:
            middle = low + (high - low) * before / (before - after)
        now = _watched(event, force, p, history, inelasticity, row, middle, corner)
        if abs(now) < 1e-15 or high - low < 1e-14:
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


@inner_jit
def _first_step(force: Any, p: Array, history: Array, inelasticity: float) -> float:
    """Return the length of the first step: one that changes the velocity by some per cent."""
    h = 1.0
    for _ in range(2000):
        w = 0.5 * h
        g, c = force(p, history, w)
        change = h * w * (g + c) / (1.0 + inelasticity * c)
        if change > 0.5 or not math.isfinite(change):
            h *= 0.5
        elif change < 0.02 and h < 1e100:
            h *= 2.0
        else:
            break
    return h


@inner_jit
def _creeps(force: Any, p: Array, history: Array, weight: float, w: float) -> bool:
    """Return whether a sphere that its weight all but holds at w comes to rest without swinging beyond."""
    low, high = 0.0, w
    for _ in range(50):
        middle = 0.5 * (low + high)
        if force(p, history, middle)[0] > weight:
            high = middle
        else:
            low = middle
    g, c = force(p, history, high)
    slope = (force(p, history, 1.001 * high)[0] - g) / (0.002 * high * high)
    return bool(c * c > 67.0 * slope)


@inner_jit
def _integrate(
    force: Any,
    corner_of: Any,
    turn: Any,
    flags: int,
    p: Array,
    inelasticity: float,
    weight: float,
    tolerance: float,
    steps: Array,
    result: Array,
) -> int:
    """Fill the steps (n, `COLUMNS`) of one impact and its first results; return the number of steps."""
    history = np.zeros(4)
    hysteretic, pulls = flags & HYSTERETIC != 0, flags & PULLS != 0
    permitted = _SHARE * tolerance
    w, y, tau = 0.0, 1.0, 0.0
    top, peak, compressing = 0.0, 0.0, True
    result[:] = 0.0
    result[0] = OUT_OF_REACH
    corner = corner_of(p, history) if hysteretic else math.inf
    g, c = force(p, history, w)
    f = (g + c * y) / (1.0 + inelasticity * c)
    h = _first_step(force, p, history, inelasticity)
    n, attempts = 0, 0
    while n < steps.shape[0]:
        row = steps[n]
        attempts += 1
        if attempts > 3 * steps.shape[0]:
            return 0
        error, w1, y1, tau1, g1, c1, f1 = step(
            force, p, history, inelasticity, weight, h, w, y, tau, f, top, peak, permitted, row
        )
        if not error <= 1.0:
            h *= max(0.2, 0.9 * math.pow(error, -0.125)) if error < 1e300 else 0.2
            if tau + w * h + h * h == tau:
                result[0] = OUT_OF_REACH if math.isfinite(g1 + c1) else NOT_FINITE
                return 0
            continue
        following = h * min(2.0, 0.9 * math.pow(max(error, 1e-30), -0.125))
        event, share = _NO_EVENT, 1.0
        if not (w1 > 0.0 and (f1 > 0.0 or not pulls)):
            event = _RELEASE if pulls else _END
            share = _place(event, force, p, history, inelasticity, row, share, corner)
        if compressing and y1 - inelasticity * f1 <= 0.0:
            at = _place(_TURN, force, p, history, inelasticity, row, share, corner)
            if at < share:
                event, share = _TURN, at
        if corner < math.inf and compressing:
            deepest = value(row, W, share)
            if corner <= history[0] + deepest * deepest:
                event = _CORNER
                share = _place(event, force, p, history, inelasticity, row, share, corner)
        if event == _TURN:
            result[6] = value(row, TAU, share)
            deepest = value(row, W, share)
            result[5] = history[0] + deepest * deepest
            compressing = False
            if not hysteretic:
                event, share = _NO_EVENT, 1.0
        if share < 1.0:
            error, w1, y1, tau1, g1, c1, f1 = step(
                force, p, history, inelasticity, weight, share * h, w, y, tau, f, top, peak, math.inf, row
            )
            following = min(following, h)
        n += 1
        w, y, tau, g, c, f = w1, y1, tau1, g1, c1, f1
        top, peak = max(top, abs(w)), max(peak, f)
        if event in (_END, _RELEASE):
            if pulls and y > -_MIN_REBOUND:
                return 0
            result[0], result[1], result[2] = SEPARATED, -y, tau
            result[7] = history[0] + (w * w if pulls else 0.0)
            return n
        if event != _NO_EVENT:
            depth = corner
            if event == _TURN:
                depth = history[0] + w * w
                if depth >= corner:  # by rounding
                    depth = corner - 1e-15 * abs(corner)
            w = math.sqrt(max(turn(p, history, depth), 0.0))
            g, c = force(p, history, w)
            if event == _TURN:
                # At rest, on a scale of its own.
                f, top = g, w
                y = inelasticity * f
                following = min(1.0 / math.sqrt(max(f, 1e-300)), h)
            f = (g + c * y) / (1.0 + inelasticity * c)
            corner = corner_of(p, history)
        u = y - inelasticity * f
        if weight > 0.0:
            at_rest = (u > 0.0 and not compressing) or abs(u) < 1e-13
            creeps = abs(f - weight) < 1e-3 * weight and _creeps(force, p, history, weight, w)
            if event == _NO_EVENT and (at_rest or creeps):
                result[0], result[1] = STAYS, 0.0
                return n
        elif not (compressing or pulls) and n < steps.shape[0] and g + c * y < _FREE * permitted * g:
            y = -g / c  # what f tends to 0 at
            _fly(steps[n], history, w, y, tau)
            result[0], result[1], result[2], result[7] = SEPARATED, -y, steps[n, TAU] + steps[n, TAU + 1], history[0]
            return n + 1
        h = following
    return 0


@inner_jit
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
    flags: int,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, len(`RESULTS`)). Where there is no rebound the restitution is 0."""
    steps = np.empty((MAX_STEPS, COLUMNS))
    for i in rows:
        p, yields = numbers[i], inelasticity[i]
        n = _integrate(force, corner_of, turn, flags, p, yields, weight[i], tolerance, steps, out[i])
        best, place = 0, 0.0
        for k in range(n if out[i, 0] == SEPARATED else 0):
            row, energy = steps[k], 0.0
            for node in range(_NODES.size):
                w, _, f = _state(force, p, row[HISTORY : HISTORY + 4], yields, row, _NODES[node])
                energy += _WEIGHTS[node] * w * f * f
                if f > out[i, 3]:
                    out[i, 3], best, place = f, k, _NODES[node]
            out[i, 8] += yields * row[0] * energy
        if n > 0 and out[i, 0] == SEPARATED:
            _crest(force, p, yields, steps, n, best, place, out[i])


@inner_jit
def _crest(
    force: Any, p: Array, inelasticity: float, steps: Array, n: int, best: int, place: float, result: Array
) -> None:
    """Find the peak force and its time near the largest force at the nodes, by golden sections."""
    for k in range(max(best - 1, 0), min(best + 2, n)):
        row, low, high = steps[k], 0.0, 1.0
        if k == best:
            low, high = max(place - 0.36, 0.0), min(place + 0.36, 1.0)
        elif (k < best and place > 0.0) or (k > best and place < 1.0):
            continue
        history = row[HISTORY : HISTORY + 4]
        for _ in range(45):
            first, second = low + 0.3819660112501051 * (high - low), low + 0.6180339887498949 * (high - low)
            if (
                _state(force, p, history, inelasticity, row, first)[2]
                < _state(force, p, history, inelasticity, row, second)[2]
            ):
                low = first
            else:
                high = second
        for s in (0.5 * (low + high), 0.0, 1.0):
            f = _state(force, p, history, inelasticity, row, s)[2]
            if f >= result[3]:
                result[3], result[4] = f, value(row, TAU, s)


@inner_jit
def _march(steps: Array, count: int, n: int, s: float, tau: float) -> tuple[int, float]:
    """Return the step and the share of it at time tau, seeking from (n, s): Newton in a bracket."""
    if tau < steps[n, TAU]:
        n, s = 0, 0.0
    while n < count - 1 and steps[n + 1, TAU] <= tau:
        n, s = n + 1, 0.0
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
        if abs(following - s) <= 1e-9 or high - low <= 1e-15:
            return n, min(max(following, low), high)
        s = following if low < following < high else 0.5 * (low + high)
    return n, s


@inner_jit
def _quantity(force: Any, p: Array, inelasticity: float, row: Array, s: float, quantity: int) -> float:
    w, _, f = _state(force, p, row[HISTORY : HISTORY + 4], inelasticity, row, s)
    return row[HISTORY] + w * w if quantity == DISPLACEMENT else max(f, 0.0)


@jit
def at_times(
    force: Any,
    corner_of: Any,
    turn: Any,
    flags: int,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    times: Array,
    time_scale: Array,
    amplitude: Array,
    quantity: int,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, k) at times (n, k) [s] with `DISPLACEMENT` or `FORCE`, zero outside contact."""
    steps, result = np.empty((MAX_STEPS, COLUMNS)), np.empty(len(RESULTS))
    for i in rows:
        p, yields = numbers[i], inelasticity[i]
        count = _integrate(force, corner_of, turn, flags, p, yields, weight[i], tolerance, steps, result)
        n, s = 0, 0.0
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            out[i, k] = 0.0
            if 0.0 < tau < result[2]:
                n, s = _march(steps, count, n, s, tau)
                out[i, k] = amplitude[i] * _quantity(force, p, yields, steps[n], s, quantity)


@jit
def add_to_frames(
    force: Any,
    corner_of: Any,
    turn: Any,
    flags: int,
    numbers: Array,
    inelasticity: Array,
    weight: Array,
    tolerance: float,
    frames: Array,
    onset: Array,
    step: Array,
    amplitude: Array,
    rows: Array,
) -> None:
    """Add one force pulse to some rows of frames (n, n_samples); only contact is touched.

    onset [samples] is where the onset falls on the sample grid, step is the sampling interval over T0.
    """
    steps, result = np.empty((MAX_STEPS, COLUMNS)), np.empty(len(RESULTS))
    for i in rows:
        p, yields = numbers[i], inelasticity[i]
        count = _integrate(force, corner_of, turn, flags, p, yields, weight[i], tolerance, steps, result)
        n_samples = float(frames.shape[1])
        here = int(min(max(math.floor(onset[i]) + 1.0, 0.0), n_samples))
        end = int(min(max(math.ceil(onset[i] + result[2] / step[i]) + 1.0, 0.0), n_samples))
        n, s = 0, 0.0
        for k in range(here, end):
            tau = (k - onset[i]) * step[i]
            if 0.0 < tau < result[2]:
                n, s = _march(steps, count, n, s, tau)
                frames[i, k] += amplitude[i] * _quantity(force, p, yields, steps[n], s, FORCE)

"""Numba kernels of a sphere that hits a structure given by its modes: contacts, flights, and the course of the force.

`_coupled_step` solves contact and modes together, step by step. Where 1 + D x' would become negative the beam runs from
the sphere faster than the material recovers: the sphere is released, without attraction, until it parts or is pressed
again.
"""

from __future__ import annotations

import math

import numpy as np

from cgid.compiled import inner_jit, jit
from cgid.physics._coupled_step import (
    N_STATE,
    Array,
    Problem,
    Scratch,
    T,
    X,
    Y,
    accept,
    advance_modes,
    cardinal,
    cubed_root,
    dot,
    find_step,
    legendre,
    passed,
    tabulate,
)
from cgid.physics.collocation import FROM_TOUCH, TO_SEPARATION, WITHIN, Collocation

#: Outcomes of an impact.
SEPARATED, STAYS, OUT_OF_REACH = 0, 1, 2
#: Largest numbers of steps and of contacts of an impact.
MAX_STEPS, MAX_CONTACTS = 4096, 64
#: A contact that lasts longer than this under its weight does not end [T0].
_FOR_GOOD = 1e3
#: Columns of the results, in units of L, T0, v, m and K L^(3/2).
RESULTS = (
    "status",
    "restitution",
    "contacts",
    "peak_force",
    "time_of_peak",
    "contact_time",
    "end",
    "peak_displacement",
    "compression_time",
    "impulse",
    "plate_energy",
    "material_loss",
    "modal_energy",
    "end_displacement",
    "end_level",
)
(
    _STATUS, _RESTITUTION, _CONTACTS, _PEAK, _TIME_OF_PEAK, _FIRST, _END, _DEPTH,
    _TIME_OF_DEPTH, _IMPULSE, _WORK, _LOSS, _MODAL, _END_DEPTH, _LEVEL,
) = range(len(RESULTS))  # fmt: skip
#: Columns of a step in the course of an impact: kind, time of its start, its length, then n Legendre coefficients
#: of the force and n of the displacement.
KIND, START, LENGTH, COEFFICIENTS = 0, 1, 2, 3
#: What ends a flight: nothing, an onset, or the material catches up with a sphere that was released.
_NEVER, _TOUCH, _CAUGHT_UP = 0, 1, 2
_FIRST_STEP = 0.4  # of an elastic contact that lasts 3.22


@inner_jit
def _crest(coefficients: Array, values: Array, rule: Collocation) -> tuple[float, float]:
    """Return the largest value of a Legendre series, and where: near the largest at the Gauss nodes."""
    n = values.size
    best = 0
    for i in range(n):
        if values[i] > values[best]:
            best = i
    place = rule.place[WITHIN]
    low = place[best - 1] if best > 0 else 0.0
    high = place[best + 1] if best < n - 1 else 1.0
    # The slope falls through zero there, or the largest value lies at the end of the step.
    if legendre(coefficients, low)[1] <= 0.0:
        return legendre(coefficients, low)[0], low
    if legendre(coefficients, high)[1] >= 0.0:
        return legendre(coefficients, high)[0], high
    for _ in range(52):
        middle = 0.5 * (low + high)
        if legendre(coefficients, middle)[1] > 0.0:
            low = middle
        else:
            high = middle
    return legendre(coefficients, low)[0], low


@inner_jit
def _energy(p: Problem, s: Scratch) -> float:
    """Return what the modes hold: mu (Q'^2 + w^2 Q^2) / 2."""
    total = 0.0
    for r in range(p.share.size):
        a, b, loss = s.amplitude[r, 0], s.amplitude[r, 1], p.loss[r]
        rate = a - loss * b
        total += 0.5 * p.share[r] * (rate * rate + b * b * (1.0 + loss * loss))
    return total


@inner_jit
def _level(p: Problem, s: Scratch) -> tuple[float, float]:
    """Return the displacement of the point of impact, and its largest one without a force."""
    level, most = 0.0, 0.0
    for r in range(p.share.size):
        a, b = s.amplitude[r, 0], s.amplitude[r, 1]
        level += p.share[r] * b / p.angular[r]
        most += p.share[r] * math.sqrt(a * a + b * b) / p.angular[r]
    return level, most


@inner_jit
def _between(rule: Collocation, values: Array, low: float, high: float, sign: float, room: Array) -> float:
    """Return where sign times the polynomial through values rises through zero between two times, by bisection."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        cardinal(rule, middle, room)
        if sign * dot(room, values) > 0.0:
            high = middle
        else:
            low = middle
        if high - low < 1e-17:
            break
    return high


@inner_jit
def _event(p: Problem, depth: Array, rate: Array, released: bool, room: Array) -> tuple[int, float]:
    """Return what happens first in an interval of flight, and when over its length."""
    caught = np.empty(rate.size)
    for k in range(rate.size):
        caught[k] = 1.0 + p.damping * rate[k]
    for k in range(1, depth.size):
        low, high = p.rule.times[k - 1], p.rule.times[k]
        if released:
            if caught[k] > 0.0 and depth[k] > 0.0:
                return _CAUGHT_UP, _between(p.rule, caught, low, high, 1.0, room)
            released = depth[k] > 0.0
        elif depth[k] >= 0.0:
            return _TOUCH, _between(p.rule, depth, low, high, 1.0, room)
        elif rate[k - 1] > 0.0 > rate[k]:
            crest = _between(p.rule, rate, low, high, -1.0, room)
            cardinal(p.rule, crest, room)
            if dot(room, depth) > 0.0:
                return _TOUCH, _between(p.rule, depth, low, crest, 1.0, room)
    return _NEVER, 1.0


@inner_jit
def _fly(p: Problem, state: Array, s: Scratch) -> int:
    """Follow sphere and modes without a force until they meet again or the window ends."""
    n_times = p.rule.times.size
    rate, depth, turn = np.empty(n_times), np.empty(n_times), np.empty(n_times)
    s.moments[:] = 0.0
    released = state[X] > 0.0
    while True:
        for k in range(n_times):
            rate[k] = state[Y] + p.weight * p.longest * p.rule.times[k] - s.free[k]
        for k in range(n_times):
            depth[k] = state[X] + p.longest * dot(p.rule.flight[k], rate)
        event, at = _event(p, depth, rate, released, turn)
        if event == _TOUCH and state[T] + at * p.longest > p.window:
            return _NEVER
        cardinal(p.rule, at, turn)
        state[X] = dot(turn, depth) if event != _TOUCH else 0.0
        state[Y] += p.weight * at * p.longest
        state[T] += at * p.longest
        advance_modes(p, s.moments, turn, event == _NEVER, s)
        if event != _NEVER:
            return event
        released = state[X] > 0.0
        left = p.window - state[T]
        if not released:
            if left <= 0.0:
                return _NEVER
            level, most = _level(p, s)
            sphere = state[X] + level
            if max(sphere, sphere + left * (state[Y] + 0.5 * p.weight * left)) + most < 0.0:
                return _NEVER


@inner_jit
def _book(p: Problem, kind: int, h: float, state: Array, s: Scratch, result: Array) -> None:
    """Enter a step into the results: work, loss, impulse and the largest values."""
    measure = p.rule.measure[kind]
    for i in range(s.force.size):
        depth = max(s.depth[i], 0.0)
        result[_IMPULSE] += h * measure[i] * s.force[i]
        result[_WORK] += h * measure[i] * s.force[i] * s.beam[i]
        result[_LOSS] += h * measure[i] * p.damping * depth * math.sqrt(depth) * s.rate[i] * s.rate[i]
    value, place = _crest(s.coefficients, s.force, p.rule)
    if value > result[_PEAK]:
        result[_PEAK], result[_TIME_OF_PEAK] = value, state[T] + h * passed(kind, place)
    for i in range(s.depth.size):
        s.depths[i] = dot(p.rule.legendre[i], s.depth)
    value, place = _crest(s.depths, s.depth, p.rule)
    if value > result[_DEPTH]:
        result[_DEPTH], result[_TIME_OF_DEPTH] = value, state[T] + h * passed(kind, place)


@inner_jit
def _follow(p: Problem, course: Array, result: Array, s: Scratch) -> int:
    """Fill course and result of one impact; return the number of steps."""
    state = np.zeros(N_STATE)
    state[Y] = 1.0
    s.amplitude[:] = 0.0
    s.free[:] = 0.0
    s.answer[:] = 0.0
    s.known[:] = -1.0
    result[:] = 0.0
    result[_STATUS], result[_CONTACTS] = OUT_OF_REACH, 1.0
    total = 0.0
    for r in range(p.share.size):
        total += p.share[r]
        for k in range(s.answer.size):
            s.answer[k] += p.share[r] * (p.table[r, 0, k] - p.loss[r] * p.table[r, 1, k])
    first = _FIRST_STEP * math.pow((1.0 + total) * (1.0 + p.damping), -0.4)
    wish, touch = first, 0.0
    for n in range(MAX_STEPS):
        kind, h, free_after, wish = find_step(p, wish, result[_PEAK], state, s)
        if h == 0.0:
            return n
        course[n, KIND], course[n, START], course[n, LENGTH] = kind, state[T], h
        _book(p, kind, h, state, s, result)
        for i in range(s.force.size):
            course[n, COEFFICIENTS + i] = s.coefficients[i]
            course[n, COEFFICIENTS + s.force.size + i] = s.depths[i]
        accept(p, kind, h, state, s)
        if kind == FROM_TOUCH:
            touch = state[T] - h
        if not free_after:
            if p.weight > 0.0 and state[T] - touch > _FOR_GOOD:
                result[_STATUS] = STAYS
                return n + 1
            continue
        level, _ = _level(p, s)
        result[_END], result[_RESTITUTION] = state[T], -state[Y]
        result[_END_DEPTH], result[_LEVEL] = state[X], state[X] + level
        result[_MODAL] = _energy(p, s)
        if result[_CONTACTS] == 1.0:
            result[_FIRST] = state[T]
        result[_LOSS] += 0.4 * state[X] * cubed_root(state[X])  # what is still compressed relaxes without a force
        event = _fly(p, state, s)
        if event == _NEVER:
            result[_STATUS] = SEPARATED
            return n + 1
        if event == _TOUCH:
            result[_CONTACTS] += 1.0
            wish = first
            if result[_CONTACTS] > MAX_CONTACTS:
                return n + 1
        else:
            result[_LOSS] -= 0.4 * state[X] * cubed_root(state[X])
    return MAX_STEPS


@inner_jit
def _scratch(n_modes: int, n: int, k: int) -> Scratch:
    return Scratch(
        np.empty((n_modes, 2)),
        np.empty(k),
        np.empty(k),
        np.empty(k),
        np.empty(k),
        np.empty((k, k)),
        np.empty(k),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty((n, n)),
        np.empty((n, n)),
        np.empty((n, n + 1)),
        np.empty(2),
        np.empty(3),
    )


@jit
def follow(
    rule: Collocation,
    decay: Array,
    angular: Array,
    loss: Array,
    participation: Array,
    parameters: Array,
    tolerance: float,
    rows: Array,
    course: Array,
    first_step: Array,
    results: Array,
) -> int:
    """Solve some impacts, in this order, until all are done or the course is full; return how many are done.

    decay, angular and loss (modes,) are z w [1/s], w_d [1/s] and z / sqrt(1 - z^2), participation (impacts, modes) is
    in 1/kg, parameters (impacts, 6) are D, gamma, window over T0, mass [kg], T0 [s] and longest step [s]. course
    (steps, 3 + 2 n) holds the steps one after the other, those of rows[i] from first_step[i] to first_step[i + 1].
    """
    n_modes, k_times = angular.size, rule.times.size
    s = _scratch(n_modes, rule.place.shape[1], k_times)
    table, share, scaled = np.empty((n_modes, 2, k_times)), np.empty(n_modes), np.empty(n_modes)
    tabulated, here = -1.0, 0
    for i in range(rows.size):
        if course.shape[0] - here < MAX_STEPS:
            return i
        row = rows[i]
        damping, weight, window, mass, unit, longest = parameters[row]
        if longest != tabulated:
            tabulate(decay, angular, longest, rule.times, table)
            tabulated = longest
        for r in range(n_modes):
            share[r] = participation[row, r] * mass
            scaled[r] = angular[r] * unit
        first_step[i] = here
        problem = Problem(rule, table, share, loss, scaled, longest / unit, damping, weight, window, tolerance)
        here += _follow(problem, course[here:], results[row], s)
        first_step[i + 1] = here
    return rows.size


@inner_jit
def _seek(course: Array, here: int, begin: int, end: int, tau: float) -> int:
    """Return the last step that has begun at time tau, seeking from here."""
    if here < begin or course[here, START] > tau:
        here = begin
    while here + 1 < end and course[here + 1, START] <= tau:
        here += 1
    return here


@inner_jit
def _quantity(step: Array, first: int, last: int, tau: float) -> float:
    """Return force or displacement, zero between two contacts."""
    share = (tau - step[START]) / step[LENGTH]
    if share >= 1.0:
        # By rounding a time just before the next step may be the end of this one.
        if step[KIND] == TO_SEPARATION or share > 1.0 + 1e-12:
            return 0.0
        share = 1.0
    if step[KIND] == FROM_TOUCH:
        share = math.sqrt(share)
    elif step[KIND] == TO_SEPARATION:
        share = 1.0 - math.sqrt(1.0 - share)
    return max(legendre(step[first:last], share)[0], 0.0)


@jit
def at_times(
    times: Array,
    course: Array,
    begin: Array,
    end: Array,
    time_scale: Array,
    amplitude: Array,
    displacement: bool,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, k) at times (n, k) [s] with force or displacement, zero outside contact.

    The steps of row i are those of course from begin[i] to end[i].
    """
    n = (course.shape[1] - COEFFICIENTS) // 2
    first = COEFFICIENTS + n if displacement else COEFFICIENTS
    for i in rows:
        here = begin[i]
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            out[i, k] = 0.0
            if tau > 0.0:
                here = _seek(course, here, begin[i], end[i], tau)
                out[i, k] = amplitude[i] * _quantity(course[here], first, first + n, tau)


@jit
def add_to_frames(
    frames: Array, onset: Array, step: Array, course: Array, begin: Array, end: Array, amplitude: Array, rows: Array
) -> None:
    """Add the force of all contacts to some rows of frames (n, n_samples); only contact is touched.

    onset [samples] is where the first the onset falls on the sample grid, step is the sampling interval over T0.
    """
    n = (course.shape[1] - COEFFICIENTS) // 2
    n_samples = float(frames.shape[1])
    for i in rows:
        for here in range(begin[i], end[i]):
            start, length = course[here, START], course[here, LENGTH]
            first = int(min(max(math.floor(onset[i] + start / step[i]), 0.0), n_samples))
            last = int(min(max(math.ceil(onset[i] + (start + length) / step[i]) + 1.0, 0.0), n_samples))
            for k in range(first, last):
                tau = (k - onset[i]) * step[i]
                if tau > 0.0 and tau >= start:
                    # A time between the end of this step by its sum and the start of the next is of the next.
                    if here + 1 < end[i] and tau >= course[here + 1, START]:
                        break
                    value = _quantity(course[here], COEFFICIENTS, COEFFICIENTS + n, tau)
                    frames[i, k] += amplitude[i] * value

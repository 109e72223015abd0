"""Numba kernels of a sphere that hits a structure given by its modes, contact and modes solved together.

Dimensionless as in `_taylor` (x approach, y velocity of the sphere, f force, mu = participation times mass):

    y' = gamma - f,  Q_r'' + 2 z w Q_r' + w^2 Q_r = f,  x' = y - sum of mu_r Q_r',  f = x^(3/2) (1 + D x')

The modes are linear and need no integration: with a = Q' + (z w + i w_d) Q, a' = lambda a + f is exact to any
step, lambda = i w_d - z w, and all they return is one number, the velocity of the point of impact. Each step
sums over the modes what that velocity is without a force (polynomial through Chebyshev times), solves the force at
Gauss nodes against it and against the modes' answer to a unit impulse, and gives every mode its integral of the
force. The cost of the nonlinear part does not depend on the number of modes.

Where 1 + D x' would become negative the beam runs from the sphere faster than the material recovers: the sphere is
released, without attraction, until it parts or is pressed again.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._elementary import exp, power, sincos
from cgid.compiled import inner_jit, jit
from cgid.physics.collocation import FROM_TOUCH, TO_SEPARATION, WITHIN, Collocation

Array = NDArray[Any]

#: Outcomes of an impact.
SEPARATED, STAYS, OUT_OF_REACH = 0, 1, 2
#: Largest numbers of steps and of contacts of an impact, and of trials of a step.
MOST_STEPS, MOST_CONTACTS, _MOST_TRIALS = 4096, 64, 60
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
#: State of sphere and contact.
_T, _X, _Y, _N_STATE = 0, 1, 2, 3
#: What ends a flight: nothing, a touch, or the material catches up with a sphere that was released.
_NEVER, _TOUCH, _CAUGHT_UP = 0, 1, 2
_FIRST_STEP = 0.4  # of an elastic contact that lasts 3.22


class Problem(NamedTuple):
    """One impact, in units of L, T0 and v, and the weights of a step."""

    rule: Collocation
    table: Array  # (modes, 2, k) real and imaginary part of exp(lambda t) over the longest step
    share: Array  # (modes,) mu
    loss: Array  # (modes,) z / sqrt(1 - z^2)
    angular: Array  # (modes,) w_d
    longest: float  # step
    damping: float  # D
    weight: float  # gamma
    window: float  # within which a new contact may begin
    tolerance: float  # of the force in a step, over its peak


class Scratch(NamedTuple):
    """Arrays of one impact."""

    amplitude: Array  # (modes, 2) of a
    free: Array  # (k,) velocity of the point without a force, at the Chebyshev times of the longest step
    answer: Array  # (k,) the same after a unit impulse
    free_now: Array  # (k,) both at those of this step
    answer_now: Array
    restriction: Array  # (k, k) from the longest step to this one
    moments: Array  # (k,) of the force
    force: Array  # (n,) at the Gauss nodes, like the next three
    rate: Array
    depth: Array
    beam: Array
    coefficients: Array  # (n,) Legendre's of the force
    depths: Array  # (n,) and of the displacement
    first: Array  # (n, n) x' = b - first f
    second: Array  # (n, n) x = c - second f
    jacobian: Array  # (n, n + 1)
    ends: Array  # x and x' at the end of the step
    known: Array  # kind and length that the matrices belong to, length of the restriction


@jit
def tabulate(decay: Array, angular: Array, longest: float, times: Array, table: Array) -> None:
    """Fill table (modes, 2, k) with the real and imaginary part of exp(lambda t) over the longest step [s]."""
    for r in range(decay.size):
        for k in range(times.size):
            t = longest * times[k]
            size, (sine, cosine) = exp(-decay[r] * t), sincos(angular[r] * t)
            table[r, 0, k], table[r, 1, k] = size * cosine, size * sine


@inner_jit
def _cubed_root(x: float) -> float:
    """Return x^(3/2), 0 below 0."""
    return x * math.sqrt(x) if x > 0.0 else 0.0


@inner_jit
def _dot(a: Array, b: Array) -> float:
    """Return the scalar product in four sums, which are independent and so run side by side."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    n = a.size - a.size % 4
    for k in range(0, n, 4):
        s0 += a[k] * b[k]
        s1 += a[k + 1] * b[k + 1]
        s2 += a[k + 2] * b[k + 2]
        s3 += a[k + 3] * b[k + 3]
    for k in range(n, a.size):
        s0 += a[k] * b[k]
    return (s0 + s1) + (s2 + s3)


@inner_jit
def _advance_modes(p: Problem, moments: Array, turn: Array, whole: bool, s: Scratch) -> None:
    """Take the modes over a step and sum what the point of impact will do without a force."""
    amplitude, free, last = s.amplitude, s.free, s.free.size - 1
    free[:] = 0.0
    for r in range(p.share.size):
        real, imaginary = p.table[r, 0], p.table[r, 1]
        a, b = amplitude[r, 0], amplitude[r, 1]
        if whole:
            cosine, sine = real[last], imaginary[last]
        else:
            cosine, sine = _dot(real, turn), _dot(imaginary, turn)
        a, b = cosine * a - sine * b + _dot(real, moments), cosine * b + sine * a + _dot(imaginary, moments)
        amplitude[r, 0], amplitude[r, 1] = a, b
        # Q' is the real part of (1 + i z / sqrt(1 - z^2)) a.
        to_real, to_imaginary = p.share[r] * (a - p.loss[r] * b), p.share[r] * (b + p.loss[r] * a)
        for k in range(free.size):
            free[k] += to_real * real[k] - to_imaginary * imaginary[k]


@inner_jit
def _cardinal(rule: Collocation, at: float, out: Array) -> None:
    """Fill out (k,) with the polynomials that are 1 at one Chebyshev time and 0 at the others."""
    total = 0.0
    for k in range(out.size):
        distance = at - rule.times[k]
        if distance == 0.0:
            out[:] = 0.0
            out[k] = 1.0
            return
        out[k] = rule.barycentric[k] / distance
        total += out[k]
    total = 1.0 / total
    for k in range(out.size):
        out[k] *= total


@inner_jit
def _prepare(p: Problem, kind: int, h: float, s: Scratch) -> None:
    """Bring what modes do into the time of a step of length h, and fill its matrices."""
    k_times, n = p.rule.times.size, p.rule.place.shape[1]
    if h == p.longest:
        for j in range(k_times):
            s.free_now[j] = s.free[j]
    else:
        if s.known[2] != h:
            for j in range(k_times):
                _cardinal(p.rule, h / p.longest * p.rule.times[j], s.restriction[j])
            s.known[2] = h
        for j in range(k_times):
            s.free_now[j] = _dot(s.restriction[j], s.free)
    if s.known[0] == kind and s.known[1] == h:
        return
    s.known[0], s.known[1] = kind, h
    for j in range(k_times):
        s.answer_now[j] = s.answer[j] if h == p.longest else _dot(s.restriction[j], s.answer)
    integral = p.rule.integral[kind]
    for i in range(n):
        for j in range(n):
            s.first[i, j] = integral[i, j]
    for k in range(k_times):
        answer, memory = s.answer_now[k], p.rule.memory[kind, k]
        for i in range(n):
            for j in range(n):
                s.first[i, j] += answer * memory[i, j]
    for i in range(n):
        for j in range(n):
            s.first[i, j] *= h
            s.second[i, j] = 0.0
    for i in range(n):
        for k in range(n):
            weight = h * integral[i, k]
            for j in range(n):
                s.second[i, j] += weight * s.first[k, j]


@inner_jit
def _eliminate(matrix: Array) -> None:
    """Solve a system (n, n + 1) in place, its solution in the last column."""
    n = matrix.shape[0]
    for p in range(n):
        best = p
        for i in range(p + 1, n):
            if abs(matrix[i, p]) > abs(matrix[best, p]):
                best = i
        if best != p:
            for j in range(p, n + 1):
                matrix[p, j], matrix[best, j] = matrix[best, j], matrix[p, j]
        inverse = 1.0 / matrix[p, p]
        for i in range(p + 1, n):
            factor = matrix[i, p] * inverse
            for j in range(p + 1, n + 1):
                matrix[i, j] -= factor * matrix[p, j]
    for p in range(n - 1, -1, -1):
        value = matrix[p, n]
        for j in range(p + 1, n):
            value -= matrix[p, j] * matrix[j, n]
        matrix[p, n] = value / matrix[p, p]


@inner_jit
def _attempt(p: Problem, kind: int, h: float, state: Array, s: Scratch) -> bool:
    """Solve one step of length h by Newton's method, from the force in s.force; return whether it converged."""
    _prepare(p, kind, h, s)
    n = s.force.size
    place, integral, measure = p.rule.place[kind], p.rule.integral[kind], p.rule.measure[kind]
    base, level = np.empty(n), np.empty(n)
    for i in range(n):
        base[i] = state[_Y] + p.weight * h * place[i] - _dot(p.rule.cardinal[kind, i], s.free_now)
    for i in range(n):
        level[i] = state[_X] + h * _dot(integral[i], base)
    converged = False
    for _ in range(20):
        largest, change = 0.0, 0.0
        for i in range(n):
            rate, depth = base[i] - _dot(s.first[i], s.force), level[i] - _dot(s.second[i], s.force)
            root = math.sqrt(max(depth, 0.0))
            spring = root * max(depth, 0.0)
            of_depth, of_rate = 1.5 * root * (1.0 + p.damping * rate), p.damping * spring
            for j in range(n):
                s.jacobian[i, j] = of_depth * s.second[i, j] + of_rate * s.first[i, j]
            s.jacobian[i, i] += 1.0
            s.jacobian[i, n] = spring * (1.0 + p.damping * rate) - s.force[i]
        _eliminate(s.jacobian)
        for i in range(n):
            s.force[i] += s.jacobian[i, n]
            largest, change = max(largest, abs(s.force[i])), max(change, abs(s.jacobian[i, n]))
        if not largest < 1e100:
            return False
        # Newton squares the error, so what is left is rounding.
        if change <= 1e-8 * largest:
            converged = True
            break
    for i in range(n):
        s.rate[i], s.depth[i] = base[i] - _dot(s.first[i], s.force), level[i] - _dot(s.second[i], s.force)
        s.beam[i] = state[_Y] + h * (p.weight * place[i] - _dot(integral[i], s.force)) - s.rate[i]
    answer = s.free_now[s.free_now.size - 1]
    for k in range(s.moments.size):
        s.moments[k] = h * _dot(p.rule.moment[kind, k], s.force)
        answer += s.answer_now[k] * s.moments[k]
    s.ends[0] = state[_X] + h * _dot(measure, s.rate)
    s.ends[1] = state[_Y] + h * (p.weight - _dot(measure, s.force)) - answer
    for i in range(n):
        s.coefficients[i] = _dot(p.rule.legendre[i], s.force)
    return converged


@inner_jit
def _legendre(coefficients: Array, s: float) -> tuple[float, float]:
    """Return value and slope of a Legendre series of 2 s - 1."""
    x = 2.0 * s - 1.0
    before, now, slope_before, slope = 1.0, x, 0.0, 1.0
    value, rate = coefficients[0] + coefficients[1] * x, coefficients[1]
    for k in range(1, coefficients.size - 1):
        following = ((2 * k + 1) * x * now - k * before) / (k + 1)
        slope_following = slope_before + (2 * k + 1) * now
        before, now, slope_before, slope = now, following, slope, slope_following
        value += coefficients[k + 1] * now
        rate += coefficients[k + 1] * slope
    return value, 2.0 * rate


@inner_jit
def _passed(kind: int, s: float) -> float:
    """Return the time passed at s over the length of the step."""
    if kind == FROM_TOUCH:
        return s * s
    return s * (2.0 - s) if kind == TO_SEPARATION else s


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
    if _legendre(coefficients, low)[1] <= 0.0:
        return _legendre(coefficients, low)[0], low
    if _legendre(coefficients, high)[1] >= 0.0:
        return _legendre(coefficients, high)[0], high
    for _ in range(52):
        middle = 0.5 * (low + high)
        if _legendre(coefficients, middle)[1] > 0.0:
            low = middle
        else:
            high = middle
    return _legendre(coefficients, low)[0], low


@inner_jit
def _tail(s: Scratch, scale: float) -> float:
    """Return the truncation error of the series of the force, over the largest force."""
    n = s.force.size
    for i in range(n):
        scale = max(scale, abs(s.force[i]))
    left: float = abs(s.coefficients[n - 1]) + abs(s.coefficients[n - 2]) + abs(s.coefficients[n - 3])
    return left / scale


@inner_jit
def _separate(p: Problem, kind: int, guess: float, state: Array, s: Scratch) -> float:
    """Solve the step up to separation; return its length, or 0 if the sphere does not leave in the longest step."""
    h = min(guess, p.longest)
    for _ in range(12):
        if not _attempt(p, kind, h, state, s) or s.ends[1] >= 0.0:
            return 0.0
        change = -s.ends[0] / s.ends[1]
        if abs(change) <= 4e-16 * (state[_T] + h):
            for i in range(s.depth.size):
                if s.depth[i] <= 0.0:
                    return 0.0
            return h
        h += change
        if not 0.0 < h <= p.longest:
            return 0.0
    return 0.0


@inner_jit
def _release(p: Problem, kind: int, h: float, s: Scratch) -> float:
    """Return when in this step the force would become attractive, 0 if it does not."""
    n = s.rate.size
    first = -1
    for i in range(n):
        if 1.0 + p.damping * s.rate[i] < 0.0:
            first = i
            break
    if first < 0 and 1.0 + p.damping * s.ends[1] >= 0.0:
        return 0.0
    series = np.empty(n)
    for i in range(n):
        series[i] = _dot(p.rule.legendre[i], s.rate)
    low = p.rule.place[WITHIN, first - 1] if first > 0 else (0.0 if first == 0 else p.rule.place[WITHIN, n - 1])
    high = p.rule.place[WITHIN, first] if first >= 0 else 1.0
    for _ in range(52):
        middle = 0.5 * (low + high)
        if 1.0 + p.damping * _legendre(series, middle)[0] > 0.0:
            low = middle
        else:
            high = middle
    return h * _passed(kind, high)


@inner_jit
def _to_release(p: Problem, kind: int, guess: float, state: Array, s: Scratch) -> float:
    """Solve the step up to where the force has fallen to zero within contact; return its length, or 0."""
    n, h = s.rate.size, guess
    series = np.empty(n)
    for _ in range(12):
        if not _attempt(p, kind, h, state, s):
            return 0.0
        for i in range(n):
            series[i] = _dot(p.rule.legendre[i], s.rate)
        slope = _legendre(series, 1.0)[1] / (h if kind == WITHIN else 2.0 * h)
        change = -(s.ends[1] + 1.0 / p.damping) / slope
        if abs(change) <= 1e-14 * (state[_T] + h):
            return h
        h += change
        if slope >= 0.0 or not 0.0 < h <= p.longest:
            return 0.0
    return 0.0


@inner_jit
def _pressed(s: Scratch) -> bool:
    """Return whether the sphere is in contact all through the step."""
    for i in range(s.depth.size):
        if s.depth[i] <= 0.0:
            return False
    return bool(s.ends[0] > 0.0)


@inner_jit
def _guess(p: Problem, kind: int, h: float, state: Array, s: Scratch) -> None:
    """Fill s.force with a start for Newton: the sphere braked by the present force, the beam at constant velocity."""
    rate = state[_Y] - s.free[0]
    start = _cubed_root(state[_X]) * (1.0 + p.damping * rate)
    for i in range(s.force.size):
        t = h * p.rule.place[kind, i]
        depth = state[_X] * (1.0 - t / h) if kind == TO_SEPARATION else state[_X] + t * (rate - 0.5 * start * t)
        s.force[i] = _cubed_root(depth) * max(1.0 + p.damping * (rate - start * t), 0.0)


@inner_jit
def _parting(p: Problem, state: Array, s: Scratch) -> float:
    """Return about when the sphere leaves, infinity while it is pressed deeper.

    Exact for a force that falls with the power 3/2 of the time left, and moves the sphere alone.
    """
    away = s.free[0] - state[_Y]
    if away <= 0.0:
        return math.inf
    push = 2.0 / 7.0 * _cubed_root(state[_X]) * max(1.0 - p.damping * away, 0.0)
    parting: float = 2.0 * state[_X] / (away + math.sqrt(away * away + 4.0 * push * state[_X]))
    return parting


@inner_jit
def _step(p: Problem, wish: float, peak: float, state: Array, s: Scratch) -> tuple[int, float, bool, float]:
    """Find a step that the nodes resolve: kind, length, whether the sphere is free after it, length to try next.

    A length of 0 means that there is none.
    """
    n = s.force.size
    h, kind = min(wish, p.longest), FROM_TOUCH if state[_X] == 0.0 else WITHIN
    for _ in range(_MOST_TRIALS):
        parting = _parting(p, state, s)
        last = TO_SEPARATION if kind == WITHIN and parting <= h else kind
        if last == TO_SEPARATION:
            _guess(p, last, parting, state, s)
            found = _separate(p, last, parting, state, s)
            if found > 0.0:
                released = _release(p, last, found, s) if p.damping > 0.0 else 0.0
                if released == 0.0:
                    if _tail(s, peak) <= p.tolerance:
                        return last, found, True, wish
                else:
                    h = min(h, 1.05 * released)
        if kind == WITHIN and 0.5 * parting < h < parting * 1.5:
            h = 0.5 * parting
        _guess(p, kind, h, state, s)
        fine = _attempt(p, kind, h, state, s) and _pressed(s)
        tail = _tail(s, peak) if fine else math.inf
        if fine and tail <= p.tolerance:
            factor = min(2.0, power(0.2 * p.tolerance / max(tail, 1e-18), 2.0 / n))
            released = _release(p, kind, h, s) if p.damping > 0.0 else 0.0
            if released == 0.0:
                return kind, h, False, max(factor * h, 0.5 * wish if h < wish else 0.0)
            found = _to_release(p, kind, released, state, s)
            if found > 0.0 and _tail(s, peak) <= p.tolerance:
                return kind, found, True, wish
            h = 0.5 * released
        elif fine:
            h *= max(0.3, power(0.2 * p.tolerance / tail, 2.0 / n))
        else:
            h *= 0.4
        if h < 1e-13:
            break
    return kind, 0.0, False, wish


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
        _cardinal(rule, middle, room)
        if sign * _dot(room, values) > 0.0:
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
            _cardinal(p.rule, crest, room)
            if _dot(room, depth) > 0.0:
                return _TOUCH, _between(p.rule, depth, low, crest, 1.0, room)
    return _NEVER, 1.0


@inner_jit
def _fly(p: Problem, state: Array, s: Scratch) -> int:
    """Follow sphere and modes without a force until they meet again or the window ends."""
    n_times = p.rule.times.size
    rate, depth, turn = np.empty(n_times), np.empty(n_times), np.empty(n_times)
    s.moments[:] = 0.0
    released = state[_X] > 0.0
    while True:
        for k in range(n_times):
            rate[k] = state[_Y] + p.weight * p.longest * p.rule.times[k] - s.free[k]
        for k in range(n_times):
            depth[k] = state[_X] + p.longest * _dot(p.rule.flight[k], rate)
        event, at = _event(p, depth, rate, released, turn)
        if event == _TOUCH and state[_T] + at * p.longest > p.window:
            return _NEVER
        _cardinal(p.rule, at, turn)
        state[_X] = _dot(turn, depth) if event != _TOUCH else 0.0
        state[_Y] += p.weight * at * p.longest
        state[_T] += at * p.longest
        _advance_modes(p, s.moments, turn, event == _NEVER, s)
        if event != _NEVER:
            return event
        released = state[_X] > 0.0
        left = p.window - state[_T]
        if not released:
            if left <= 0.0:
                return _NEVER
            level, most = _level(p, s)
            sphere = state[_X] + level
            if max(sphere, sphere + left * (state[_Y] + 0.5 * p.weight * left)) + most < 0.0:
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
        result[_PEAK], result[_TIME_OF_PEAK] = value, state[_T] + h * _passed(kind, place)
    for i in range(s.depth.size):
        s.depths[i] = _dot(p.rule.legendre[i], s.depth)
    value, place = _crest(s.depths, s.depth, p.rule)
    if value > result[_DEPTH]:
        result[_DEPTH], result[_TIME_OF_DEPTH] = value, state[_T] + h * _passed(kind, place)


@inner_jit
def _accept(p: Problem, kind: int, h: float, state: Array, s: Scratch) -> None:
    """Take sphere and modes over the step that was solved."""
    k_times = s.moments.size
    moments, turn = s.moments, s.moments
    if h != p.longest:
        turn = s.restriction[k_times - 1]
        moments = np.zeros(k_times)
        for j in range(k_times):
            for k in range(k_times):
                moments[k] += s.moments[j] * s.restriction[j, k]
    state[_X] = 0.0 if kind == TO_SEPARATION else s.ends[0]
    state[_Y] += h * (p.weight - _dot(p.rule.measure[kind], s.force))
    state[_T] += h
    _advance_modes(p, moments, turn, h == p.longest, s)


@inner_jit
def _follow(p: Problem, course: Array, result: Array, s: Scratch) -> int:
    """Fill course and result of one impact; return the number of steps."""
    state = np.zeros(_N_STATE)
    state[_Y] = 1.0
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
    first = _FIRST_STEP * power((1.0 + total) * (1.0 + p.damping), -0.4)
    wish, touch = first, 0.0
    for n in range(MOST_STEPS):
        kind, h, free_after, wish = _step(p, wish, result[_PEAK], state, s)
        if h == 0.0:
            return n
        course[n, KIND], course[n, START], course[n, LENGTH] = kind, state[_T], h
        _book(p, kind, h, state, s, result)
        for i in range(s.force.size):
            course[n, COEFFICIENTS + i] = s.coefficients[i]
            course[n, COEFFICIENTS + s.force.size + i] = s.depths[i]
        _accept(p, kind, h, state, s)
        if kind == FROM_TOUCH:
            touch = state[_T] - h
        if not free_after:
            if p.weight > 0.0 and state[_T] - touch > _FOR_GOOD:
                result[_STATUS] = STAYS
                return n + 1
            continue
        level, _ = _level(p, s)
        result[_END], result[_RESTITUTION] = state[_T], -state[_Y]
        result[_END_DEPTH], result[_LEVEL] = state[_X], state[_X] + level
        result[_MODAL] = _energy(p, s)
        if result[_CONTACTS] == 1.0:
            result[_FIRST] = state[_T]
        result[_LOSS] += 0.4 * state[_X] * _cubed_root(state[_X])  # what is still compressed relaxes without a force
        event = _fly(p, state, s)
        if event == _NEVER:
            result[_STATUS] = SEPARATED
            return n + 1
        if event == _TOUCH:
            result[_CONTACTS] += 1.0
            wish = first
            if result[_CONTACTS] > MOST_CONTACTS:
                return n + 1
        else:
            result[_LOSS] -= 0.4 * state[_X] * _cubed_root(state[_X])
    return MOST_STEPS


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
        if course.shape[0] - here < MOST_STEPS:
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
    return max(_legendre(step[first:last], share)[0], 0.0)


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

    onset [samples] is where the first touch falls on the sample grid, step is the sampling interval over T0.
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

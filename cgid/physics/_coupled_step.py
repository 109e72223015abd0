"""Numba kernels of one step of a sphere that hits a structure given by its modes; `_coupled` follows the impact.

Dimensionless as in `_contact` (x approach, y velocity of the sphere, f force, mu = participation times mass):

    y' = gamma - f,  Q_r'' + 2 z w Q_r' + w^2 Q_r = f,  x' = y - sum of mu_r Q_r',  f = x^(3/2) (1 + D x')

The modes are linear and need no integration: with a = Q' + (z w + i w_d) Q, a' = lambda a + f is exact to any
step, lambda = i w_d - z w, and all they return is one number, the velocity of the point of impact. Each step
sums over the modes what that velocity is without a force (polynomial through Chebyshev times), solves the force at
Gauss nodes against it and against the modes' answer to a unit impulse, and gives every mode its integral of the
force. The cost of the nonlinear part does not depend on the number of modes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid.compiled import inner_jit, jit
from cgid.physics.collocation import FROM_TOUCH, TO_SEPARATION, WITHIN, Collocation

Array = NDArray[Any]

#: Largest number of trials of a step.
_MAX_TRIALS = 60
#: State of sphere and contact: time, approach, velocity of the sphere.
T, X, Y, N_STATE = 0, 1, 2, 3


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
            size, sine, cosine = math.exp(-decay[r] * t), math.sin(angular[r] * t), math.cos(angular[r] * t)
            table[r, 0, k], table[r, 1, k] = size * cosine, size * sine


@inner_jit
def cubed_root(x: float) -> float:
    """Return x^(3/2), 0 below 0."""
    return x * math.sqrt(x) if x > 0.0 else 0.0


@inner_jit
def dot(a: Array, b: Array) -> float:
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
def advance_modes(p: Problem, moments: Array, turn: Array, whole: bool, s: Scratch) -> None:
    """Take the modes over a step and sum what the point of impact will do without a force."""
    amplitude, free, last = s.amplitude, s.free, s.free.size - 1
    free[:] = 0.0
    for r in range(p.share.size):
        real, imaginary = p.table[r, 0], p.table[r, 1]
        a, b = amplitude[r, 0], amplitude[r, 1]
        if whole:
            cosine, sine = real[last], imaginary[last]
        else:
            cosine, sine = dot(real, turn), dot(imaginary, turn)
        a, b = cosine * a - sine * b + dot(real, moments), cosine * b + sine * a + dot(imaginary, moments)
        amplitude[r, 0], amplitude[r, 1] = a, b
        # Q' is the real part of (1 + i z / sqrt(1 - z^2)) a.
        to_real, to_imaginary = p.share[r] * (a - p.loss[r] * b), p.share[r] * (b + p.loss[r] * a)
        for k in range(free.size):
            free[k] += to_real * real[k] - to_imaginary * imaginary[k]


@inner_jit
def cardinal(rule: Collocation, at: float, out: Array) -> None:
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
                cardinal(p.rule, h / p.longest * p.rule.times[j], s.restriction[j])
            s.known[2] = h
        for j in range(k_times):
            s.free_now[j] = dot(s.restriction[j], s.free)
    if s.known[0] == kind and s.known[1] == h:
        return
    s.known[0], s.known[1] = kind, h
    for j in range(k_times):
        s.answer_now[j] = s.answer[j] if h == p.longest else dot(s.restriction[j], s.answer)
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
        base[i] = state[Y] + p.weight * h * place[i] - dot(p.rule.cardinal[kind, i], s.free_now)
    for i in range(n):
        level[i] = state[X] + h * dot(integral[i], base)
    converged = False
    for _ in range(20):
        largest, change = 0.0, 0.0
        for i in range(n):
            rate, depth = base[i] - dot(s.first[i], s.force), level[i] - dot(s.second[i], s.force)
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
        s.rate[i], s.depth[i] = base[i] - dot(s.first[i], s.force), level[i] - dot(s.second[i], s.force)
        s.beam[i] = state[Y] + h * (p.weight * place[i] - dot(integral[i], s.force)) - s.rate[i]
    answer = s.free_now[s.free_now.size - 1]
    for k in range(s.moments.size):
        s.moments[k] = h * dot(p.rule.moment[kind, k], s.force)
        answer += s.answer_now[k] * s.moments[k]
    s.ends[0] = state[X] + h * dot(measure, s.rate)
    s.ends[1] = state[Y] + h * (p.weight - dot(measure, s.force)) - answer
    for i in range(n):
        s.coefficients[i] = dot(p.rule.legendre[i], s.force)
    return converged


@inner_jit
def legendre(coefficients: Array, s: float) -> tuple[float, float]:
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
def passed(kind: int, s: float) -> float:
    """Return the time passed at s over the length of the step."""
    if kind == FROM_TOUCH:
        return s * s
    return s * (2.0 - s) if kind == TO_SEPARATION else s


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
        if abs(change) <= 4e-16 * (state[T] + h):
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
        series[i] = dot(p.rule.legendre[i], s.rate)
    low = p.rule.place[WITHIN, first - 1] if first > 0 else (0.0 if first == 0 else p.rule.place[WITHIN, n - 1])
    high = p.rule.place[WITHIN, first] if first >= 0 else 1.0
    for _ in range(52):
        middle = 0.5 * (low + high)
        if 1.0 + p.damping * legendre(series, middle)[0] > 0.0:
            low = middle
        else:
            high = middle
    return h * passed(kind, high)


@inner_jit
def _to_release(p: Problem, kind: int, guess: float, state: Array, s: Scratch) -> float:
    """Solve the step up to where the force has fallen to zero within contact; return its length, or 0."""
    n, h = s.rate.size, guess
    series = np.empty(n)
    for _ in range(12):
        if not _attempt(p, kind, h, state, s):
            return 0.0
        for i in range(n):
            series[i] = dot(p.rule.legendre[i], s.rate)
        slope = legendre(series, 1.0)[1] / (h if kind == WITHIN else 2.0 * h)
        change = -(s.ends[1] + 1.0 / p.damping) / slope
        if abs(change) <= 1e-14 * (state[T] + h):
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
    rate = state[Y] - s.free[0]
    start = cubed_root(state[X]) * (1.0 + p.damping * rate)
    for i in range(s.force.size):
        t = h * p.rule.place[kind, i]
        depth = state[X] * (1.0 - t / h) if kind == TO_SEPARATION else state[X] + t * (rate - 0.5 * start * t)
        s.force[i] = cubed_root(depth) * max(1.0 + p.damping * (rate - start * t), 0.0)


@inner_jit
def _parting(p: Problem, state: Array, s: Scratch) -> float:
    """Return about when the sphere leaves, infinity while it is pressed deeper.

    Exact for a force that falls with the power 3/2 of the time left, and moves the sphere alone.
    """
    away = s.free[0] - state[Y]
    if away <= 0.0:
        return math.inf
    push = 2.0 / 7.0 * cubed_root(state[X]) * max(1.0 - p.damping * away, 0.0)
    parting: float = 2.0 * state[X] / (away + math.sqrt(away * away + 4.0 * push * state[X]))
    return parting


@inner_jit
def find_step(p: Problem, wish: float, peak: float, state: Array, s: Scratch) -> tuple[int, float, bool, float]:
    """Find a step that the nodes resolve: kind, length, whether the sphere is free after it, length to try next.

    A length of 0 means that there is none.
    """
    n = s.force.size
    h, kind = min(wish, p.longest), FROM_TOUCH if state[X] == 0.0 else WITHIN
    for _ in range(_MAX_TRIALS):
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
            factor = min(2.0, math.pow(0.2 * p.tolerance / max(tail, 1e-18), 2.0 / n))
            released = _release(p, kind, h, s) if p.damping > 0.0 else 0.0
            if released == 0.0:
                return kind, h, False, max(factor * h, 0.5 * wish if h < wish else 0.0)
            found = _to_release(p, kind, released, state, s)
            if found > 0.0 and _tail(s, peak) <= p.tolerance:
                return kind, found, True, wish
            h = 0.5 * released
        elif fine:
            h *= max(0.3, math.pow(0.2 * p.tolerance / tail, 2.0 / n))
        else:
            h *= 0.4
        if h < 1e-13:
            break
    return kind, 0.0, False, wish


@inner_jit
def accept(p: Problem, kind: int, h: float, state: Array, s: Scratch) -> None:
    """Take sphere and modes over the step that was solved."""
    k_times = s.moments.size
    moments, turn = s.moments, s.moments
    if h != p.longest:
        turn = s.restriction[k_times - 1]
        moments = np.zeros(k_times)
        for j in range(k_times):
            for k in range(k_times):
                moments[k] += s.moments[j] * s.restriction[j, k]
    state[X] = 0.0 if kind == TO_SEPARATION else s.ends[0]
    state[Y] += h * (p.weight - dot(p.rule.measure[kind], s.force))
    state[T] += h
    advance_modes(p, moments, turn, h == p.longest, s)

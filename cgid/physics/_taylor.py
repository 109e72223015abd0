"""Numba kernels that integrate one impact in time: by Taylor series, and by Runge-Kutta where less accuracy is enough.

The contact (dimensionless: x displacement, y velocity of the sphere, f force)

    x' = y - lambda f,  y' = gamma - f,  f = x^(3/2) + (D x^(3/2) + zeta x^(1/2)) x'

is not smooth at touch. With x = w^2 and d tau = w d sigma it becomes polynomial, and passes smoothly through
w = 0 at both ends of the contact (the reference path, accurate to rounding):

    w' = (y - lambda f) / 2,  y' = w (gamma - f),  tau' = w,  f = w r - lambda c f,  r = w^2 q + zeta y,

with q = 1 + D y (a state of its own: where it decays to nothing, it keeps its digits and its sign) and
c = D w^3 + zeta w.

The quick path (`add_stepped`) integrates the same equations in plain time by the classic Runge-Kutta method. Touch and
separation are not smooth there, so the error falls with the power 5/2 of the number of steps: a few hundred steps
reach 1e-6 of the peak, at a twentieth of the cost of the reference path.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.compiled import jit

Array = NDArray[Any]

#: Order of the series (an argument of every kernel: as a constant it would be compiled once more), and the share of
#: their radius of convergence that a step takes: .15^20 is 1e-16.5.
ORDER, SHARE = 20, 0.15
#: Largest number of steps of one impact; beyond it this path gives up.
MOST_STEPS = 4096
#: Outcomes of an impact.
SEPARATED, STAYS, OUT_OF_REACH = 0, 1, 2
#: Rows of a step: w, its rate of displacement u = x', force, time, plate energy, w^2 q + zeta y, sphere velocity.
_W, _U, _F, _TAU, _PLATE, _R, _Y, _ROWS = 0, 1, 2, 3, 4, 5, 6, 7
DISPLACEMENT, FORCE = _W, _F
#: What happens in the course of an impact: w = 0, the force of a viscoelastic sphere 0, the peak, the turn.
_END, _RELEASE, _PEAK, _TURN = 0, 1, 2, 3
#: Columns of the parameters: D, zeta, lambda and gamma above.
PARAMETERS = ("damping", "zeta", "inelasticity", "weight")
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
_LEAST_POWER = 1e-30  # below it the force is negligible, and the rest is free flight


@jit
def _value(series: Array, row: int, order: int, s: float) -> float:
    value: float = series[row, order]
    for k in range(order - 1, -1, -1):
        value = value * s + series[row, k]
    return value


@jit
def _slope(series: Array, row: int, order: int, s: float) -> float:
    value: float = order * series[row, order]
    for k in range(order - 1, 0, -1):
        value = value * s + k * series[row, k]
    return value


@jit
def _expand(
    step: Array, scratch: Array, order: int, q0: float, damping: float, zeta: float, inelasticity: float, weight: float
) -> None:
    """Fill the series of one step from its values of order zero (w, y, tau and plate energy in step, q0)."""
    w, u, f, tau, plate, r, y = step[0], step[1], step[2], step[3], step[4], step[5], step[6]
    q, square, c, wf = scratch[0], scratch[1], scratch[2], scratch[3]
    q[0] = q0
    for k in range(order + 1):
        # Coefficient k of a product is a sum over i of a_i b_(k - i). The terms known beforehand go in one loop.
        of_square, of_r, of_f, of_wf, of_cube, of_c, of_plate = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(k):
            of_r += square[i] * q[k - i]
            of_f += r[i] * w[k - i]
            of_wf += f[i] * w[k - i]
            of_square += w[i] * w[k - i]
        square[k] = of_square + w[k] * w[0]
        r[k] = of_r + square[k] * q[0] + zeta * y[k]
        f[k] = of_f + r[k] * w[0]
        if inelasticity > 0.0:
            for i in range(k):
                of_cube += square[i] * w[k - i]
            c[k] = damping * (of_cube + square[k] * w[0]) + zeta * w[k]
            # f (1 + lambda c) = w r, solved for f[k].
            for i in range(k):
                of_c += f[i] * c[k - i]
            f[k] = (f[k] - inelasticity * of_c) / (1.0 + inelasticity * c[0])
        u[k] = y[k] - inelasticity * f[k]
        wf[k] = of_wf + f[k] * w[0]
        if k == order:
            break
        w[k + 1] = 0.5 * u[k] / (k + 1)
        y[k + 1] = (weight * w[k] - wf[k]) / (k + 1)
        q[k + 1] = damping * y[k + 1]
        tau[k + 1] = w[k] / (k + 1)
        plate[k + 1] = 0.0
        if inelasticity > 0.0:
            for i in range(k + 1):
                of_plate += wf[i] * f[k - i]
            plate[k + 1] = inelasticity * of_plate / (k + 1)


@jit
def _inverse_radius(series: Array, row: int, order: int, scale: float) -> float:
    """Return 1 / radius of convergence from the last coefficients (six: at touch only each fifth is not zero)."""
    largest = 0.0
    for k in range(max(order - 5, 1), order + 1):
        size = abs(series[row, k]) / scale
        if size > 0.0:
            largest = max(largest, math.exp(math.log(size) / k))
    return largest


@jit
def _step_length(step: Array, scratch: Array, order: int, share: float) -> float:
    # w needs its digits relative to its largest value; at touch that is still to come, at a rate of 1/2.
    inverse = max(_inverse_radius(step, _Y, order, 1.0), _inverse_radius(step, _W, order, max(step[_W, 0], 0.1)))
    if scratch[0, 0] != 1.0:
        inverse = max(inverse, _inverse_radius(scratch, 0, order, scratch[0, 0]))
    return share / max(inverse, 1e-3)


@jit
def _root(series: Array, row: int, order: int, high: float) -> float:
    """Return where a series, positive just after 0 and not above 0 at high, falls to zero: Newton in a bracket."""
    low, s = 0.0, 0.5 * high
    for _ in range(100):
        value = _value(series, row, order, s)
        if value > 0.0:
            low = s
        else:
            high = s
        rate = _slope(series, row, order, s)
        following = s - value / rate if rate < 0.0 else low
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - s) <= 2e-16 * s:
            break
        s = following
    return s


@jit
def _watch(
    step: Array, scratch: Array, order: int, watched: Array, viscoelastic: bool, rising: bool, compressing: int
) -> None:
    """Fill watched (4, order + 1) with the series that fall to zero at the events `_END`, `_RELEASE`, `_PEAK`, `_TURN`.

    compressing: 0 if the sphere has turned, 1 if it turns where q = 1, 2 if where x' = 0.
    """
    for k in range(order + 1):
        nothing = 1.0 if k == 0 else 0.0  # what need not be watched stays positive
        watched[_END, k] = step[_W, k]
        watched[_RELEASE, k] = step[_R, k] if viscoelastic else nothing
        watched[_PEAK, k] = nothing
        if rising:
            watched[_PEAK, k] = (k + 1) * step[_F, k + 1] if k < order else 0.0
        watched[_TURN, k] = nothing
        if compressing == 1:
            watched[_TURN, k] = scratch[0, k] - nothing
        elif compressing == 2:
            watched[_TURN, k] = step[_U, k]


@jit
def _happen(watched: Array, order: int, h: float, at: Array) -> float:
    """Fill at with where each event falls in a step of length h, -1 if it does not; return where the step ends."""
    for event in range(4):
        at[event] = -1.0
        if _value(watched, event, order, h) <= 0.0:
            at[event] = _root(watched, event, order, h)
            # Contact ends there. (A viscoelastic sphere is released before w = 0: beyond, its force would be
            # positive again.)
            if event in (_END, _RELEASE):
                h = at[event]
    return h


@jit
def _stays(step: Array, order: int, h: float, damping: float, zeta: float, weight: float, turned: bool) -> bool:
    """Return whether gravity holds the sphere for good, judged at the end of a step."""
    u = _value(step, _U, order, h)
    if abs(u) < 1e-13 or (turned and u > 0.0):
        return True
    # Force and weight are in balance, and where the sphere can rest (x^(3/2) = gamma) it is so damped that it creeps
    # there: it will not swing beyond.
    root = math.pow(weight, 1.0 / 3.0)
    loss = damping * weight + zeta * root
    return loss * loss > 100.0 * root and abs(_value(step, _F, order, h) - weight) < 1e-3 * weight


@jit
def _integrate(parameters: Array, order: int, fixed: float, steps: Array, lengths: Array, result: Array) -> int:
    """Fill steps (n, 7, order + 1) and lengths (n) of one impact, and its results; return the number of steps.

    fixed is the length of every step, or 0 for the length that the series allow.
    """
    damping, zeta, inelasticity, weight = parameters[0], parameters[1], parameters[2], parameters[3]
    scratch, watched, at = np.zeros((4, order + 1)), np.empty((4, order + 1)), np.empty(4)
    for row in range(_ROWS):
        steps[0, row, 0] = 1.0 if row == _Y else 0.0
    q0 = 1.0 + damping
    # Where x' = y the sphere turns at q = 1, which keeps its digits when D is large.
    rising, compressing = True, 1 if damping > 1.0 and inelasticity == 0.0 else 2
    result[:] = 0.0
    result[0] = OUT_OF_REACH
    for n in range(steps.shape[0] - 1):
        step, following = steps[n], steps[n + 1]
        _expand(step, scratch, order, q0, damping, zeta, inelasticity, weight)
        if q0 == 0.0 and step[_W, 1] < 0.0:
            h = -1.001 * step[_W, 0] / step[_W, 1]
        elif fixed > 0.0:
            h = fixed
        else:
            h = _step_length(step, scratch, order, SHARE)
        _watch(step, scratch, order, watched, zeta > 0.0, rising, compressing)
        h = _happen(watched, order, h, at)
        if at[_PEAK] >= 0.0:
            rising = False
            result[3], result[4] = _value(step, _F, order, at[_PEAK]), _value(step, _TAU, order, at[_PEAK])
        if at[_TURN] >= 0.0:
            compressing = 0
            w = _value(step, _W, order, at[_TURN])
            result[5], result[6] = w * w, _value(step, _TAU, order, at[_TURN])
        lengths[n] = h
        for row in (_W, _TAU, _PLATE, _Y):
            following[row, 0] = _value(step, row, order, h)
        if at[_END] >= 0.0 or at[_RELEASE] >= 0.0:
            result[0] = SEPARATED
            result[1], result[2] = -following[_Y, 0], following[_TAU, 0]
            result[7] = following[_W, 0] * following[_W, 0] if zeta > 0.0 else 0.0
            result[8] = following[_PLATE, 0]
            return n + 1
        if weight > 0.0 and _stays(step, order, h, damping, zeta, weight, compressing == 0):
            result[0] = STAYS
            return n + 1
        q0 = _value(scratch, 0, order, h)
        if zeta == 0.0 and weight == 0.0 and q0 < _LEAST_POWER:
            q0, following[_Y, 0] = 0.0, -1.0 / damping
    return 0


@jit
def summaries(parameters: Array, order: int, fixed: float, out: Array, rows: Array) -> None:
    """Fill some rows of out (n, len(RESULTS)) for impacts of parameters (n, 4), see `PARAMETERS`.

    Where there is no rebound the restitution is 0.
    """
    steps, lengths = np.empty((MOST_STEPS, _ROWS, order + 1)), np.empty(MOST_STEPS)
    for i in rows:
        _integrate(parameters[i], order, fixed, steps, lengths, out[i])


@jit
def _within_step(step: Array, order: int, wanted: float, guess: float, high: float) -> float:
    """Return s in [0, high] at which the time of this step reaches wanted; time grows at the rate w."""
    low, s = 0.0, min(max(guess, 0.0), high)
    for _ in range(60):
        error = _value(step, _TAU, order, s) - wanted
        if error < 0.0:
            low = s
        else:
            high = s
        rate = _value(step, _W, order, s)
        following = s - error / rate if rate > 0.0 else 0.5 * (low + high)
        if abs(following - s) <= 1e-15 * high or high - low <= 1e-15 * high:
            return min(max(following, low), high)
        s = following if low < following < high else 0.5 * (low + high)
    return s


@jit
def _march(steps: Array, lengths: Array, count: int, order: int, n: int, s: float, tau: float) -> tuple[int, float]:
    """Return the step and the place in it at time tau, seeking from (n, s)."""
    if tau < steps[n, _TAU, 0]:
        n, s = 0, 0.0
    while n < count - 1 and steps[n + 1, _TAU, 0] <= tau:
        n, s = n + 1, 0.0
    step = steps[n]
    past = tau - _value(step, _TAU, order, s)
    w = _value(step, _W, order, s)
    # From touch time goes like sigma^2 / 4; later a sample is a small move at the rate w.
    guess = s + past / w if past < 10.0 * w * w else s + 2.0 * math.sqrt(past)
    return n, _within_step(step, order, tau, guess, lengths[n])


@jit
def _quantity(step: Array, order: int, s: float, row: int) -> float:
    value = _value(step, row, order, s)
    return value * value if row == _W else max(value, 0.0)


@jit
def at_times(
    times: Array, parameters: Array, time_scale: Array, amplitude: Array, row: int, order: int, out: Array, rows: Array
) -> None:
    """Fill some rows of out (n, k) at times (n, k) [s], zero outside contact.

    row: `DISPLACEMENT` or `FORCE`.
    """
    steps, lengths = np.empty((MOST_STEPS, _ROWS, order + 1)), np.empty(MOST_STEPS)
    result = np.empty(len(RESULTS))
    for i in rows:
        count = _integrate(parameters[i], order, 0.0, steps, lengths, result)
        n, s = 0, 0.0
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            if 0.0 < tau < result[2]:
                n, s = _march(steps, lengths, count, order, n, s, tau)
                out[i, k] = amplitude[i] * _quantity(steps[n], order, s, row)
            else:
                out[i, k] = 0.0


@jit
def add_to_frames(
    frames: Array, onset: Array, step: Array, parameters: Array, amplitude: Array, order: int, rows: Array
) -> None:
    """Add one force pulse to some rows of frames (n, n_samples); only contact is touched.

    onset [samples] is where touch falls on the sample grid, step is the sampling interval over T0.
    """
    steps, lengths = np.empty((MOST_STEPS, _ROWS, order + 1)), np.empty(MOST_STEPS)
    result = np.empty(len(RESULTS))
    for i in rows:
        count = _integrate(parameters[i], order, 0.0, steps, lengths, result)
        n_samples = float(frames.shape[1])
        here = int(min(max(math.floor(onset[i]) + 1.0, 0.0), n_samples))
        end = int(min(max(math.ceil(onset[i] + result[2] / step[i]) + 1.0, 0.0), n_samples))
        n, s = 0, 0.0
        for k in range(here, end):
            tau = (k - onset[i]) * step[i]
            if 0.0 < tau < result[2]:
                n, s = _march(steps, lengths, count, order, n, s, tau)
                frames[i, k] += amplitude[i] * _quantity(steps[n], order, s, FORCE)


@jit
def _contact_force(x: float, y: float, damping: float, zeta: float, inelasticity: float) -> float:
    if x <= 0.0:
        return 0.0
    root = math.sqrt(x)
    loss = damping * x * root + zeta * root
    return (x * root + loss * y) / (1.0 + inelasticity * loss)


@jit
def _runge_kutta(x: float, y: float, h: float, parameters: Array) -> tuple[float, float]:
    """Return displacement and velocity of the sphere a step h later."""
    damping, zeta, inelasticity, weight = parameters[0], parameters[1], parameters[2], parameters[3]
    f1 = _contact_force(x, y, damping, zeta, inelasticity)
    u1, a1 = y - inelasticity * f1, weight - f1
    x2, y2 = x + 0.5 * h * u1, y + 0.5 * h * a1
    f2 = _contact_force(x2, y2, damping, zeta, inelasticity)
    u2, a2 = y2 - inelasticity * f2, weight - f2
    x3, y3 = x + 0.5 * h * u2, y + 0.5 * h * a2
    f3 = _contact_force(x3, y3, damping, zeta, inelasticity)
    u3, a3 = y3 - inelasticity * f3, weight - f3
    x4, y4 = x + h * u3, y + h * a3
    f4 = _contact_force(x4, y4, damping, zeta, inelasticity)
    u4, a4 = y4 - inelasticity * f4, weight - f4
    return x + h * (u1 + 2.0 * (u2 + u3) + u4) / 6.0, y + h * (a1 + 2.0 * (a2 + a3) + a4) / 6.0


@jit
def add_stepped(
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
                x, y = _runge_kutta(x, y, h, numbers)
                left -= h
            tau = (k - onset[i]) * step[i]
            if tau >= contact_time[i]:
                break
            samples[k] += amplitude[i] * max(_contact_force(x, y, numbers[0], numbers[1], numbers[2]), 0.0)

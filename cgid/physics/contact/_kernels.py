"""Numba kernels of the tabulated pulses (`cgid.measure.fit.family`) and of those made of branches.

No `fastmath`: compiled and interpreted they give the same bits,
whether or not it fuses multiplication and addition.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import jit
from cgid.measure.fit.family import CONTACT, CUT, INTERVALS, ORDERS, POWERS, SEGMENTS

Array = NDArray[Any]

_MIDDLE = SEGMENTS * POWERS  # where the columns of the second half begin
#: Columns of a pulse of three branches. Up to `loading_end` it is the elastic curve; up to `peak_time`
#: `level + height cos(rate (peak_time - tau))`; up to `contact_time` `rest + unloading_height` times half an elastic
#: curve, or a quarter of a sine, run backwards from separation in the unit of time `unloading_unit`.
BRANCHES = (
    "loading_end",
    "rate",
    "peak_time",
    "contact_time",
    "unloading_unit",
    "level",
    "height",
    "rest",
    "unloading_height",
)


@jit
def _blend(columns: Array, position: float, out: Array) -> None:
    """Evaluate the polynomials over ln e of one interval: columns (interval, order, column) -> out (column)."""
    interval = min(int(position), INTERVALS - 1)
    u = 2.0 * (position - interval) - 1.0
    rows = columns[interval]
    for j in range(out.size):
        value = rows[ORDERS - 1, j]
        for order in range(ORDERS - 2, -1, -1):
            value = value * u + rows[order, j]
        out[j] = value


@jit
def _add_segment(
    samples: Array, coefficients: Array, segment: int, square: float, step: float, amplitude: float
) -> None:
    """Add the force to the samples in one segment; square is sigma^2 of the first, step its increment."""
    # A slice from its start and a fixed number of powers let the compiler vectorise over samples.
    offset = 2.0 * segment + 1.0
    for k in range(samples.size):
        sigma_square = abs(square + k * step)
        sigma = math.sqrt(sigma_square)
        u = 2.0 * SEGMENTS * sigma - offset
        square_of_u = u * u
        even, odd = coefficients[POWERS - 2], coefficients[POWERS - 1]
        for power in range(POWERS - 4, -1, -2):
            even = even * square_of_u + coefficients[power]
            odd = odd * square_of_u + coefficients[power + 1]
        samples[k] += amplitude * ((even + u * odd) * sigma_square * sigma)


@jit
def _sample_after(position: float, n_samples: int) -> int:
    """Return the first sample strictly after a position on the sample grid, within 0 and n_samples."""
    return int(min(max(math.floor(position) + 1.0, 0.0), float(n_samples)))


@jit
def add_to_frames(
    frames: Array, onset: Array, step: Array, position: Array, amplitude: Array, columns: Array, rows: Array
) -> None:
    """Add one force pulse to some rows of frames (n, n_samples); only contact is touched."""
    # onset [samples] is on the sample grid, step is the sampling interval over T0, place `family.coordinate` of e.
    pulse = np.empty(columns.shape[2])
    for i in rows:
        _blend(columns, position[i], pulse)
        contact, cut, start, samples = pulse[CONTACT], pulse[CUT], onset[i], frames[i]
        rest, rate = contact - cut, 1.0 / step[i]
        first_half, second_half = step[i] / cut, step[i] / rest  # sigma^2 from one sample to the next
        at = _sample_after(start, samples.size)
        for segment in range(SEGMENTS):
            edge = cut * ((segment + 1.0) / SEGMENTS) ** 2
            end = max(_sample_after(start + edge * rate, samples.size), at)
            coefficients = pulse[segment * POWERS : (segment + 1) * POWERS]
            _add_segment(samples[at:end], coefficients, segment, (at - start) * first_half, first_half, amplitude[i])
            at = end
        for segment in range(SEGMENTS - 1, -1, -1):
            edge = contact - rest * (segment / SEGMENTS) ** 2
            end = max(_sample_after(start + edge * rate, samples.size), at)
            if segment == 0 and end > at and (end - 1 - start) * step[i] >= contact:
                end -= 1  # a sample that falls on separation itself holds no force
            first = _MIDDLE + segment * POWERS
            square = (contact - (at - start) * step[i]) / rest
            _add_segment(samples[at:end], pulse[first : first + POWERS], segment, square, -second_half, amplitude[i])
            at = end


@jit
def _in_half(pulse: Array, first: int, square: float, cubic: bool) -> float:
    """Return force or displacement where sigma^2 is square, in the half of a pulse whose columns begin at first."""
    sigma = math.sqrt(square)
    segment = min(int(sigma * SEGMENTS), SEGMENTS - 1)
    u = 2.0 * (sigma * SEGMENTS - segment) - 1.0
    column = first + segment * POWERS
    value: float = pulse[column + POWERS - 1]
    for power in range(POWERS - 2, -1, -1):
        value = value * u + pulse[column + power]
    value *= square
    return value * sigma if cubic else value


@jit
def at_times(
    times: Array,
    position: Array,
    time_scale: Array,
    amplitude: Array,
    columns: Array,
    cubic: bool,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, k) with force (cubic) or displacement at times (n, k) [s]; zero outside contact."""
    pulse = np.empty(columns.shape[2])
    for i in rows:
        _blend(columns, position[i], pulse)
        contact, cut = pulse[CONTACT], pulse[CUT]
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            if not 0.0 < tau < contact:
                out[i, k] = 0.0
                continue
            if tau <= cut:
                out[i, k] = amplitude[i] * _in_half(pulse, 0, tau / cut, cubic)
            else:
                out[i, k] = amplitude[i] * _in_half(pulse, _MIDDLE, (contact - tau) / (contact - cut), cubic)


@jit
def add_branches_to_frames(
    frames: Array,
    onset: Array,
    step: Array,
    branches: Array,
    linear: bool,
    amplitude: Array,
    columns: Array,
    rows: Array,
) -> None:
    """Add one force pulse of three branches to some rows of frames; linear: how the last branch unloads."""
    pulse = np.empty(columns.shape[2])
    _blend(columns, 0.0, pulse)
    cut = pulse[CUT]
    for i in rows:
        first, rate, peak, contact, unit = (
            branches[i, 0],
            branches[i, 1],
            branches[i, 2],
            branches[i, 3],
            branches[i, 4],
        )
        start, samples, grid = onset[i], frames[i], 1.0 / step[i]
        growth, decline = step[i] / cut, step[i] / (unit * cut)  # sigma^2 from one sample to the next
        at = _sample_after(start, samples.size)
        for segment in range(SEGMENTS):
            edge = min(cut * ((segment + 1.0) / SEGMENTS) ** 2, first)
            end = max(_sample_after(start + edge * grid, samples.size), at)
            coefficients = pulse[segment * POWERS : (segment + 1) * POWERS]
            _add_segment(samples[at:end], coefficients, segment, (at - start) * growth, growth, amplitude[i])
            at = end
        end = max(_sample_after(start + peak * grid, samples.size), at)
        for k in range(at, end):
            share = math.cos(rate * (peak - (k - start) * step[i]))
            samples[k] += amplitude[i] * max(branches[i, 5] + branches[i, 6] * share, 0.0)
        at, height = end, amplitude[i] * branches[i, 8]
        for segment in range(SEGMENTS - 1, -1, -1):
            edge = contact - unit * cut * (segment / SEGMENTS) ** 2
            end = max(_sample_after(start + edge * grid, samples.size), at)
            if segment == 0 and end > at and (end - 1 - start) * step[i] >= contact:
                end -= 1  # a sample that falls on separation itself holds no force
            if linear:
                for k in range(at, end):
                    samples[k] += height * max(math.sin((contact - (k - start) * step[i]) / unit), 0.0)
            else:
                square = (contact - (at - start) * step[i]) / (unit * cut)
                coefficients = pulse[segment * POWERS : (segment + 1) * POWERS]
                _add_segment(samples[at:end], coefficients, segment, square, -decline, height)
            at = end


@jit
def branches_at_times(
    times: Array,
    time_scale: Array,
    branches: Array,
    linear: bool,
    amplitude: Array,
    columns: Array,
    cubic: bool,
    out: Array,
    rows: Array,
) -> None:
    """Fill some rows of out (n, k) with pulses of three branches at times (n, k) [s], as `at_times`."""
    pulse = np.empty(columns.shape[2])
    _blend(columns, 0.0, pulse)
    cut = pulse[CUT]
    for i in rows:
        contact, unit = branches[i, 3], branches[i, 4]
        for k in range(times.shape[1]):
            tau = times[i, k] / time_scale[i]
            if not 0.0 < tau < contact:
                value = 0.0
            elif tau <= branches[i, 0]:
                value = _in_half(pulse, 0, tau / cut, cubic)
            elif tau <= branches[i, 2]:
                value = branches[i, 5] + branches[i, 6] * math.cos(branches[i, 1] * (branches[i, 2] - tau))
            elif linear:
                value = branches[i, 7] + branches[i, 8] * math.sin((contact - tau) / unit)
            else:
                value = branches[i, 7] + branches[i, 8] * _in_half(pulse, 0, (contact - tau) / (unit * cut), cubic)
            out[i, k] = amplitude[i] * max(value, 0.0)

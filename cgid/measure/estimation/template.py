"""The damped-Hertz pulse as a curve to be fitted: its value and slopes on many samples at once, numpy only.

A pulse of peak 1 is `g(u; s)` at the share u of its contact, with s = ln e. Turned round in time the pulse of e is
that of 1/e (with `tau -> -tau` damping changes its sign in `x'' = -x^(3/2) (1 + D x')`), so the family goes on smoothly
beyond e = 1. There it is a shape and no material, but an estimate near 1 may err to either side, and needs not be
pressed against a wall.

In `w = (1 + sqrt(u) - sqrt(1 - u)) / 2` the curve is smooth up to touch and separation, where it rises as the power
3/2 of time. It is held on a grid of s and w, with its derivatives, and carried on from the nearest node by its Taylor
polynomial of order two: within 1e-5 of the peak for e from .2, 5e-5 from .1, 1.2e-4 at .05.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cgid import family
from cgid.validation import Floats

#: Bounds of the shape s = ln e.
LOWEST_SHAPE, HIGHEST_SHAPE = float(np.log(family.LOWEST_RESTITUTION)), -float(np.log(family.LOWEST_RESTITUTION))
#: Steps of the grid between the lowest shape and 0, and between touch and separation.
_SHAPES, _PLACES = 128, 256
#: Nodes beyond s = 0: enough for central differences there.
_BEYOND = 3
#: Nearest to touch and separation that slopes are taken.
_EDGE = 1e-12


@dataclass(frozen=True)
class _Table:
    """Nodes and derivatives.

    Attributes
    ----------
    curve : tuple of ndarray, (n_nodes,)
        g, g_w, g_ww, g_s, g_sw, g_ss at the nodes of s and w, flat.
    times : ndarray, (n_shapes, 2, 3)
        Contact duration, and the time from touch to the peak, over the width (impulse over peak); with two
        derivatives in s.
    """

    curve: tuple[Floats, ...]
    times: Floats


@cache
def _table() -> _Table:
    step = -LOWEST_SHAPE / _SHAPES
    shapes = LOWEST_SHAPE + step * np.arange(_SHAPES + 1)
    w = np.arange(_PLACES + 1) / _PLACES
    u = np.sin(np.pi / 4 + np.arcsin((2 * w - 1) / np.sqrt(2))) ** 2  # w is (1 + sin - cos) / 2 of that angle
    restitution = np.minimum(np.exp(shapes), family.HIGHEST_RESTITUTION)
    contact, peak_time, _ = family.times(restitution)
    peak = family.force(peak_time[:, None], restitution)
    curve = family.force(u * contact[:, None], restitution) / peak
    # The impulse of m x'' from 1 to -e is 1 + e.
    times = np.stack([contact, peak_time], axis=1) * (peak / (1 + restitution[:, None]))
    # Beyond s = 0 the same, turned round.
    turned = slice(-2, -2 - _BEYOND, -1)
    curve = np.concatenate([curve, curve[turned, ::-1]])
    beyond = times[turned]
    times = np.concatenate([times, np.stack([beyond[:, 0], beyond[:, 0] - beyond[:, 1]], axis=1)])
    spacing_w = 1 / _PLACES
    in_w, in_s = _slope(curve, 1) / spacing_w, _slope(curve, 0) / step
    derivatives = (
        curve,
        in_w,
        _bend(curve, 1) / spacing_w**2,
        in_s,
        _slope(in_s, 1) / spacing_w,
        _bend(curve, 0) / step**2,
    )
    held = tuple(np.ascontiguousarray(part[: _SHAPES + 1].ravel()) for part in derivatives)
    time_derivatives = np.stack([times, _slope(times, 0) / step, _bend(times, 0) / step**2], axis=-1)[: _SHAPES + 1]
    return _Table(held, time_derivatives)


def _slope(values: Floats, axis: int) -> Floats:
    """Return the first differences of a row of nodes, of order four inside and two at the ends."""
    v = np.moveaxis(values, axis, 0)
    out = np.gradient(v, axis=0, edge_order=2)
    out[2:-2] = (8 * (v[3:-1] - v[1:-3]) - (v[4:] - v[:-4])) / 12
    return np.moveaxis(out, 0, axis)


def _bend(values: Floats, axis: int) -> Floats:
    """Return the second differences of a row of nodes, of order four inside and one at the ends."""
    v = np.moveaxis(values, axis, 0)
    out = np.empty_like(v)
    out[1:-1] = v[2:] - 2 * v[1:-1] + v[:-2]
    out[0], out[-1] = out[1], out[-2]
    out[2:-2] = (16 * (v[3:-1] + v[1:-3]) - (v[4:] + v[:-4]) - 30 * v[2:-2]) / 12
    return np.moveaxis(out, 0, axis)


def relative_times(shape: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return contact duration and time from touch to peak over the width (impulse over peak), and their slopes in s.

    Parameters
    ----------
    shape : ndarray, (n,)
        s = ln e.

    Returns
    -------
    duration, peak_time, duration_slope, peak_time_slope : ndarray, (n,)
    """
    node, offset = _nearest(shape)
    value, slope, bend = np.moveaxis(_table().times[node], -1, 0)
    at = value + offset[:, None] * (slope + 0.5 * offset[:, None] * bend)
    slopes = slope + offset[:, None] * bend
    turned = shape > 0
    duration, peak_time = at[:, 0], np.where(turned, at[:, 0] - at[:, 1], at[:, 1])
    sign = np.where(turned, -1.0, 1.0)
    duration_slope = sign * slopes[:, 0]
    peak_slope = np.where(turned, duration_slope + slopes[:, 1], slopes[:, 1])
    return duration, peak_time, duration_slope, peak_slope


def curve(share: Floats, shape: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the pulse and its slopes in the share of the contact and in the shape; zero outside contact.

    Parameters
    ----------
    share : ndarray, (n, n_samples)
        u: 0 at touch, 1 at separation.
    shape : ndarray, (n,)
        s = ln e.

    Returns
    -------
    value, in_share, in_shape : ndarray, (n, n_samples)
        With the peak as unit.
    """
    node, offset = _nearest(shape)
    turned = shape > 0
    u = share
    if turned.any():
        u = np.where(turned[:, None], 1 - share, share)
    inside = (u > 0) & (u < 1)
    u = np.clip(u, _EDGE, 1 - _EDGE)
    root, other = np.sqrt(u), np.sqrt(1 - u)
    place = (root - other + 1) * (0.5 * _PLACES)
    column = np.rint(place)
    dw = (place - column) * (1 / _PLACES)
    index = column.astype(np.intp) + (node * (_PLACES + 1))[:, None]
    g, g_w, g_ww, g_s, g_sw, g_ss = (np.take(held, index) for held in _table().curve)
    ds = offset[:, None]
    in_shape = (g_s + ds * g_ss + dw * g_sw) * inside
    g_w += ds * g_sw
    value = (g + ds * (g_s + (0.5 * ds) * g_ss) + dw * (g_w + 0.5 * dw * g_ww)) * inside
    in_share = (g_w + dw * g_ww) * (0.25 / root + 0.25 / other) * inside
    if turned.any():
        in_share[turned] *= -1.0
        in_shape[turned] *= -1.0
    return value, in_share, in_shape


def _nearest(shape: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Return the nearest node of s (of -s beyond 0) and the way from it."""
    place = (-np.abs(shape) - LOWEST_SHAPE) * (_SHAPES / -LOWEST_SHAPE)
    node = np.clip(np.rint(place), 0, _SHAPES).astype(np.intp)
    return node, (place - node) * (-LOWEST_SHAPE / _SHAPES)

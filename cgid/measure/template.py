"""The damped-Hertz pulse as a curve to fit: its values, its slopes, and the covariance of its parameters.

A pulse of peak 1 is `g(u; s)` at the share u of its contact, with s = ln e. Reversed in time, the pulse of e is that of
1/e (`tau -> -tau` changes the sign of the damping in `x'' = -x^(3/2) (1 + D x')`), so the family continues smoothly
beyond e = 1. No material has such a shape, but estimates near 1 may err to either side.

In `w = (1 + sqrt(u) - sqrt(1 - u)) / 2` the curve is smooth up to touch and separation, where it rises as the power
3/2 of time. It is tabulated with its derivatives on a grid of s and w, and extrapolated from the nearest node by a
Taylor polynomial of order two: within 1e-5 of the peak for e from .2, 5e-5 from .1, 1.2e-4 at .05.

The parameters of a fit are (peak, ln width, place = time of the peak, s, baseline), where width is impulse over peak.
They are nearly independent, while contact duration and onset of a damped pulse, which ends in the noise, are strongly
correlated with s. The reported parameters are `PARAMETERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import family
from cgid.validation import Floats

#: Bounds of the shape s = ln e.
LOWEST_SHAPE, HIGHEST_SHAPE = float(np.log(family.LOWEST_RESTITUTION)), -float(np.log(family.LOWEST_RESTITUTION))
#: Steps of the grid from the lowest shape to 0, and from touch to separation.
_SHAPES, _PLACES = 128, 256
_SPACING = -LOWEST_SHAPE / _SHAPES
_NODES: Floats = LOWEST_SHAPE + _SPACING * np.arange(_SHAPES + 1, dtype=np.float64)
#: Nodes to either side that central differences need, also beyond s = 0.
_BEYOND = 2
#: Least distance from touch and separation at which slopes are evaluated.
_EDGE = 1e-12
#: Cells of the contact in the table of `slopes_and_pulse`.
_CELLS = 1024


class RowsOnDemand:
    """Arrays of one row for each shape, made when first asked for: a pulse or two need few of them.

    `make` returns the arrays from the numbers of some rows; their shapes have no axis for the rows.
    """

    def __init__(
        self, make: Callable[[NDArray[np.intp]], Iterable[Floats]], n_rows: int, *shapes: tuple[int, ...], kind: Any
    ) -> None:
        self._make, self._made = make, np.zeros(n_rows, bool)
        self._held = tuple(np.empty((n_rows, *shape), kind) for shape in shapes)

    def __call__(self, rows: NDArray[np.intp]) -> tuple[NDArray[Any], ...]:
        """Return the arrays, of which at least these rows are made."""
        if not self._made[rows].all():
            missing = np.flatnonzero(np.bincount(rows, minlength=len(self._made)).astype(bool) & ~self._made)
            for held, part in zip(self._held, self._make(missing), strict=True):
                held[missing] = part
            self._made[missing] = True
        return self._held


def dimensionless(shapes: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return restitution, contact time, time of the peak and peak of the dimensionless pulse, each (n,)."""
    restitution = np.minimum(np.exp(shapes), family.HIGHEST_RESTITUTION)
    contact, peak_time, _ = family.times(restitution)
    return restitution, contact, peak_time, family.force(peak_time[:, None], restitution)[:, 0]


def dimensionless_logarithms(shape: Floats, *names: str) -> tuple[Floats, ...]:
    """Return ln of "contact" time, "peak" or "width" of the dimensionless pulse by a table, each as `shape`.

    The width is impulse over peak. A pulse that rises more slowly than one of s = 0 gets the values there.
    """
    table = _logarithms()
    return tuple(np.interp(shape, table["shape"], table[name]) for name in names)


@cache
def _logarithms() -> dict[str, Floats]:
    grid = np.linspace(LOWEST_SHAPE, 0.0, 1201)
    restitution, contact, _, peak = dimensionless(grid)
    # The impulse of m x'' from 1 to -e is 1 + e.
    return {"shape": grid, "contact": np.log(contact), "peak": np.log(peak), "width": np.log((1 + restitution) / peak)}


@cache
def _times() -> Floats:
    """Return contact duration and time from touch to peak at the nodes of s, (n_shapes, 2, 3).

    Over the width (impulse over peak), with two derivatives in s.
    """
    restitution, contact, peak_time, peak = dimensionless(_NODES)
    # The impulse of m x'' from 1 to -e is 1 + e.
    times = np.stack([contact, peak_time], axis=1) * (peak / (1 + restitution))[:, None]
    # Beyond s = 0: the same, reversed.
    beyond = times[-2 : -2 - _BEYOND : -1]
    times = np.concatenate([times, np.stack([beyond[:, 0], beyond[:, 0] - beyond[:, 1]], axis=1)])
    return np.stack([times, _slope(times, 0) / _SPACING, _bend(times, 0) / _SPACING**2], axis=-1)[: _NODES.size]


@cache
def pulse_table() -> RowsOnDemand:
    """Return g, g_w, g_ww, g_s, g_sw and g_ss at the nodes of s and w."""
    return RowsOnDemand(_derivatives, _NODES.size, *((_PLACES + 1,),) * 6, kind=np.float64)


def _derivatives(rows: NDArray[np.intp]) -> tuple[Floats, ...]:
    first = np.maximum(rows - _BEYOND, 0)
    around = first[:, None] + np.arange(2 * _BEYOND + 1)
    # Beyond s = 0: the same, reversed.
    beyond = around >= _NODES.size
    around[beyond] = 2 * (_NODES.size - 1) - around[beyond]
    wanted = np.flatnonzero(np.bincount(around.ravel()))
    curves = _curves(wanted)[np.searchsorted(wanted, around)]
    curves[beyond] = curves[beyond][:, ::-1]
    own = np.arange(rows.size), rows - first
    in_s = _slope(curves, 1)[own] / _SPACING
    return (
        curves[own],
        _slope(curves[own], 1) * _PLACES,
        _bend(curves[own], 1) * _PLACES**2,
        in_s,
        _slope(in_s, 1) * _PLACES,
        _bend(curves, 1)[own] / _SPACING**2,
    )


def _curves(rows: NDArray[np.intp]) -> Floats:
    """Return pulses over their peaks at some nodes of s and all of w."""
    w = np.arange(_PLACES + 1) / _PLACES
    u = np.sin(np.pi / 4 + np.arcsin((2 * w - 1) / np.sqrt(2))) ** 2  # w is (1 + sin - cos) / 2 of that angle
    restitution, contact, _, peak = dimensionless(_NODES[rows])
    return family.force(u * contact[:, None], restitution) / peak[:, None]


def _slope(values: Floats, axis: int) -> Floats:
    """Return first differences between nodes, of order four inside and two at the ends."""
    v = np.moveaxis(values, axis, 0)
    out = np.gradient(v, axis=0, edge_order=2)
    out[2:-2] = (8 * (v[3:-1] - v[1:-3]) - (v[4:] - v[:-4])) / 12
    return np.moveaxis(out, 0, axis)


def _bend(values: Floats, axis: int) -> Floats:
    """Return second differences between nodes, of order four inside and one at the ends."""
    v = np.moveaxis(values, axis, 0)
    out = np.empty_like(v)
    out[1:-1] = v[2:] - 2 * v[1:-1] + v[:-2]
    out[0], out[-1] = out[1], out[-2]
    out[2:-2] = (16 * (v[3:-1] + v[1:-3]) - (v[4:] + v[:-4]) - 30 * v[2:-2]) / 12
    return np.moveaxis(out, 0, axis)


def relative_times(shape: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return contact duration and time from touch to peak over the width (impulse over peak), and their slopes in s."""
    node, offset = _nearest(shape)
    held = _times()[node]
    at = held[:, :, 0] + offset[:, None] * (held[:, :, 1] + 0.5 * offset[:, None] * held[:, :, 2])
    slopes = held[:, :, 1] + offset[:, None] * held[:, :, 2]
    duration, peak_time, duration_slope, peak_slope = at[:, 0], at[:, 1], slopes[:, 0], slopes[:, 1]
    turned = shape > 0
    if turned.any():
        peak_time = np.where(turned, duration - peak_time, peak_time)
        duration_slope = np.where(turned, -duration_slope, duration_slope)
        peak_slope = np.where(turned, duration_slope + peak_slope, peak_slope)
    return duration, peak_time, duration_slope, peak_slope


def curve(share: Floats, shape: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the pulse over its peak and its slopes in share and shape, each (n, n_samples); zero outside contact.

    `share` (n, n_samples) is u, 0 at touch and 1 at separation; `shape` (n,) is s = ln e.
    """
    node, offset = _nearest(shape)
    turned = shape > 0
    u = share
    if turned.any():
        u = np.where(turned[:, None], 1 - share, share)
    inside = (u > 0) & (u < 1)
    u = np.minimum(np.maximum(u, _EDGE), 1 - _EDGE)
    root, other = np.sqrt(u), np.sqrt(1 - u)
    place = (root - other + 1) * (0.5 * _PLACES)
    column = np.rint(place)
    dw = (place - column) * (1 / _PLACES)
    index = column.astype(np.intp) + (node * (_PLACES + 1))[:, None]
    g, g_w, g_ww, g_s, g_sw, g_ss = (held.take(index) for held in pulse_table()(node))
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
    """Return the nearest node of s (of -s above 0) and the distance from it."""
    place = (-np.abs(shape) - LOWEST_SHAPE) * (_SHAPES / -LOWEST_SHAPE)
    # Of nan, which a fit of no pulse may try, fmax and fmin make a node.
    node = np.fmin(np.fmax(np.rint(place), 0), _SHAPES).astype(np.intp)
    return node, (place - node) * (-LOWEST_SHAPE / _SHAPES)


#: Order of the parameters in a reported covariance.
PARAMETERS = ("ln_peak", "ln_duration", "onset", "shape", "baseline")
#: Shapes and points in time for the information of a densely sampled pulse.
_GRID, _POINTS = 241, 300


def free_parameters(onset_known: bool, fit_baseline: bool) -> list[int]:
    """Return the columns of (peak, ln width, place, shape, baseline) that are fitted."""
    return [0, 1, *([] if onset_known else [2]), 3, *([4] if fit_baseline else [])]


@cache
def quick_pulse_table() -> RowsOnDemand:
    """Return g, g_u, g_uu, g_s, g_su, g_ss at the nodes of s and at even shares u; u counts cells.

    Touch and separation are zero with all slopes, and so is what lies beyond.
    """
    return RowsOnDemand(_quick_derivatives, _NODES.size, *((_CELLS + 1,),) * 6, kind=np.float32)


def _quick_derivatives(rows: NDArray[np.intp]) -> tuple[Floats, ...]:
    # Of a shape and its neighbours, or at the ends the next two.
    first = np.minimum(np.maximum(rows - 1, 0), _NODES.size - 3)
    around = first[:, None] + np.arange(3)
    wanted = np.flatnonzero(np.bincount(around.ravel()))
    shapes = LOWEST_SHAPE * (1 - wanted / _SHAPES)
    value, in_share, in_shape = curve(
        np.broadcast_to(np.arange(_CELLS + 1) / _CELLS, (wanted.size, _CELLS + 1)), shapes
    )
    places, own = np.searchsorted(wanted, around), np.searchsorted(wanted, rows)
    bend = np.gradient(in_shape[places], _SPACING, axis=1, edge_order=2)[np.arange(rows.size), rows - first]
    value, in_share, in_shape = value[own], in_share[own] / _CELLS, in_shape[own]
    curvature, twist = np.gradient(in_share, axis=1), np.gradient(in_shape, axis=1)
    # Near the ends the curve is as u^(3/2).
    curvature[:, 1], curvature[:, -2] = 0.5 * in_share[:, 1], -0.5 * in_share[:, -2]
    half, _, _ = curve(np.broadcast_to(np.array([0.5, _CELLS - 0.5]) / _CELLS, (rows.size, 2)), shapes[own])
    for part in (value, in_share, in_shape, twist, bend):
        part[:, [0, -1]] = 0.0
    curvature[:, [0, -1]] = 8 * half
    return value, in_share, curvature, in_shape, twist, bend


def slopes_and_pulse(
    parameters: Floats, times: Floats, onset_known: bool = False, fit_baseline: bool = False
) -> Floats:
    """Return the slopes of pulses in the free parameters and, last, the pulses without baseline.

    From parameters (n, 5) and times (n, n_samples); the result is (n, n_free + 1, n_samples). With a known onset, the
    place follows from width and shape. It is `curve` in single precision and a fifth of its time, and errs more only
    within a thousandth of the contact from its ends: by up to 4e-5 of the peak for e from .3, 4e-4 at .05.
    """
    peak, log_width, place, shape, _ = parameters.T
    width = np.exp(log_width)
    duration, lead, duration_slope, lead_slope = relative_times(shape)
    node, offset = _nearest(shape)
    turned = shape > 0
    sign = np.where(turned, -1.0, 1.0)
    # Time in cells x is linear in time, and what the slopes need of time is linear in x.
    scale = sign * _CELLS / (width * duration)
    shift = (lead / duration) * sign * _CELLS + np.where(turned, _CELLS, 0.0) - place * scale
    steep = peak * scale * width
    # z, the time from the place over the width, and the share at x = 0; with a known onset, the time from there.
    first_z, first_share = turned * duration - (0.0 if onset_known else lead), turned * 1.0
    moved = 0.0 if onset_known else lead_slope
    of_rows = [
        offset,
        0.5 * offset,
        -steep * first_z,
        -steep * (sign * duration / _CELLS),
        -steep / width,
        peak * sign,
        steep * (moved - first_share * duration_slope),
        -steep * (sign / _CELLS) * duration_slope,
    ]
    ds, half, z0, z1, to_place, in_s, s0, s1 = np.array(of_rows, np.float32)[:, :, None]
    n, n_points = times.shape
    out = np.empty((n, len(free_parameters(onset_known, fit_baseline)) + 1, n_points))
    x = times * scale[:, None]
    x += shift[:, None]
    np.minimum(np.maximum(x, 0.0, out=x), _CELLS, out=x)
    column = np.rint(x)
    dx = (x - column).astype(np.float32)
    index = column.astype(np.intp)
    index += (node * (_CELLS + 1))[:, None]
    g, g_u, g_uu, g_s, g_su, g_ss = (held.take(index) for held in quick_pulse_table()(node))
    x = x.astype(np.float32)
    g_uu *= dx
    slope = g_su * ds
    slope += g_u
    # g + ds (g_s + ds g_ss / 2) + dx (g_u + ds g_su + dx g_uu / 2)
    g_ss *= half
    g_s += g_ss
    g += g_s * ds
    g_s += g_ss
    g_su *= dx
    g_s += g_su
    g_uu *= np.float32(0.5)
    slope += g_uu
    g += dx * slope
    slope += g_uu
    out[:, 0] = g
    np.multiply(g, peak[:, None], out=out[:, -1])
    z1 = z1 * x
    z1 += z0
    z1 *= slope
    out[:, 1] = z1
    if not onset_known:
        np.multiply(slope, to_place, out=out[:, 2])
    x *= s1
    x += s0
    x *= slope
    g_s *= in_s
    np.add(x, g_s, out=out[:, 2 if onset_known else 3])
    if fit_baseline:
        out[:, -2] = 1.0
    return out


def pulse_and_slopes(
    parameters: Floats, times: Floats, onset_known: bool = False, fit_baseline: bool = False
) -> tuple[Floats, Floats]:
    """Return what `slopes_and_pulse` does apart: pulses (n, n_samples), and their slopes (n, n_free, n_samples)."""
    both = slopes_and_pulse(parameters, times, onset_known, fit_baseline)
    return both[:, -1], both[:, :-1]


def covariance_of(
    information: Floats, parameters: Floats, onset_known: bool = False, fit_baseline: bool = False
) -> Floats:
    """Return the covariance of `PARAMETERS`, (n, 5, 5), for noise of variance 1; zero where a parameter is known.

    `information` (n, n_free, n_free) holds the sums of products of the slopes at the parameters (n, 5).
    """
    peak, log_width, _, shape, _ = parameters.T
    width = np.exp(log_width)
    duration, lead, duration_slope, lead_slope = relative_times(shape)
    turn = np.zeros((len(peak), 5, 5))
    turn[:, 0, 0] = 1 / peak
    turn[:, 1, 1], turn[:, 1, 3] = 1.0, duration_slope / duration
    if not onset_known:
        turn[:, 2, 1], turn[:, 2, 2], turn[:, 2, 3] = -lead * width, 1.0, -lead_slope * width
    turn[:, 3, 3] = turn[:, 4, 4] = 1.0
    turn = turn[:, :, free_parameters(onset_known, fit_baseline)]
    scale, unit = _scaled(information, 1e-12)
    inverse = np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(turn @ inverse @ np.swapaxes(turn, 1, 2))


def solve_scaled(information: Floats, right: Floats, ridge: Floats | float) -> Floats:
    """Return the solutions (n, n_free) of `information @ x = right`, with a ridge in scaled parameters."""
    scale, unit = _scaled(information, ridge)
    return np.asarray(np.linalg.solve(unit, (right / scale)[..., None])[..., 0] / scale)


def _scaled(information: Floats, ridge: Floats | float) -> tuple[Floats, Floats]:
    """Return scales and the information with ones on the diagonal, since peaks are newtons and shapes are ratios."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-300))
    unit = information / (scale[:, :, None] * scale[:, None, :])
    return scale, unit + ridge * np.eye(information.shape[1])


@cache
def _shape_deviation() -> tuple[Floats, Floats]:
    """Return shapes s, and ln(standard deviation of s) there with two derivatives, for densely sampled pulses."""
    shapes = np.linspace(LOWEST_SHAPE, HIGHEST_SHAPE, _GRID)
    duration, lead, _, _ = relative_times(shapes)
    ones, zeros = np.ones(_GRID), np.zeros(_GRID)
    parameters = np.stack([ones, zeros, lead, shapes, zeros], axis=1)
    times = duration[:, None] * (np.arange(_POINTS) + 0.5) / _POINTS
    _, slopes = pulse_and_slopes(parameters, times)
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2)) * (duration / _POINTS)[:, None, None]
    deviation = np.log(covariance_of(information, parameters)[:, 3, 3]) / 2
    step = shapes[1] - shapes[0]
    slope = np.gradient(deviation, step)
    return shapes, np.stack([deviation, slope, np.gradient(slope, step)])


def shape_deviation(shape: Floats) -> Floats:
    """Return ln(standard deviation of s) of densely sampled pulses plus a constant, and two derivatives, (3, n)."""
    grid, held = _shape_deviation()
    place = (shape - LOWEST_SHAPE) / (grid[1] - grid[0])
    node = np.clip(place.astype(np.intp), 0, _GRID - 2)
    return np.asarray(held[:, node] + (place - node) * (held[:, node + 1] - held[:, node]))


def parameters_of(peak: Floats, width: Floats, onset: Floats, shape: Floats) -> Floats:
    """Return (peak, ln width, place, shape, baseline 0), (n, 5), of pulses given by their onset."""
    _, lead, _, _ = relative_times(shape)
    return np.stack([peak, np.log(width), onset + lead * width, shape, np.zeros_like(peak)], axis=1)

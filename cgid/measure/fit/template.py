"""The damped-Hertz pulse as a curve to fit: its values, its slopes, and the covariance of its parameters.

A pulse of peak 1 is `g(u; s)` at the fraction u of its contact, with s = ln e. Reversed in time, the pulse of e is that
of 1/e (`tau -> -tau` changes the sign of the damping in `x'' = -x^(3/2) (1 + D x')`), so the family continues smoothly
beyond e = 1, where estimates near 1 may fall.

It is tabulated with its derivatives at `N_SHAPES` shapes and `N_CELLS` equal parts of the contact, and extrapolated
from the nearest node to second order. `tests/references/make_shapes.py` makes the tables from
`cgid.measure.fit.family`.

The parameters of a fit, (peak, ln width, peak time, s) with width = impulse over peak, are
nearly independent; contact duration and onset would be strongly correlated with s. `PARAMETERS` are reported.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit import family
from cgid.measure.fit.least_squares import scaled

#: Bounds of the shape s = ln e.
MIN_SHAPE, MAX_SHAPE = float(np.log(family.MIN_RESTITUTION)), -float(np.log(family.MIN_RESTITUTION))
#: Tables of pulses; and of their times, of the bank of `search`, and of the components of `residual`.
TEMPLATE_PATH, SHAPES_PATH = (Path(__file__).with_name(name) for name in ("template.npy", "shapes.npz"))
#: Shapes of the tables, from the lowest to 0, and cells of the contact.
N_SHAPES, N_CELLS = 129, 1024
#: Largest steps of ln(width), of the peak time over the width, and of s.
MAX_STEPS = (0.4, 0.5, 0.7)
_SPACING = -MIN_SHAPE / (N_SHAPES - 1)


def dimensionless(shapes: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return restitution, contact time, time of the peak and peak of the dimensionless pulse, each (n,)."""
    restitution = np.minimum(np.exp(shapes), family.MAX_RESTITUTION)
    contact, rise_time, _ = family.times(restitution)
    return restitution, contact, rise_time, family.force(rise_time[:, None], restitution)[:, 0]


@cache
def tables() -> tuple[NDArray[np.float32], Floats]:
    """Return the tables of the family from their files."""
    # The first (6, n_shapes, n_cells + 1) holds g, g_u, g_uu, g_s, g_su and g_ss at nodes of s and even fractions u; u
    # counts cells. The second (n_shapes, 2, 3) holds contact duration and time from onset to peak, over the width, with
    # two derivatives in s.
    with np.load(SHAPES_PATH, allow_pickle=False) as stored:
        return np.load(TEMPLATE_PATH, allow_pickle=False), stored["times"]


def relative_times(shape: Floats) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.intp], Floats]:
    """Return contact duration and time from onset to peak over the width (impulse over peak), and their slopes in s.

    Last, the nearest node of s (of -s above 0) and the distance from it.
    """
    position = (-np.abs(shape) - MIN_SHAPE) / _SPACING
    # Of nan, which a fit of no pulse may try, fmax and fmin make a node.
    node = np.fmin(np.fmax(np.rint(position), 0), N_SHAPES - 1).astype(np.intp)
    offset = (position - node) * _SPACING
    tabulated = tables()[1][node]
    slopes = tabulated[:, :, 1] + offset[:, None] * tabulated[:, :, 2]
    at = tabulated[:, :, 0] + 0.5 * offset[:, None] * (tabulated[:, :, 1] + slopes)
    duration, rise_time, duration_slope, peak_slope = at[:, 0], at[:, 1], slopes[:, 0], slopes[:, 1]
    turned = shape > 0
    if turned.any():
        rise_time = np.where(turned, duration - rise_time, rise_time)
        duration_slope = np.where(turned, -duration_slope, duration_slope)
        peak_slope = np.where(turned, duration_slope + peak_slope, peak_slope)
    return duration, rise_time, duration_slope, peak_slope, node, offset


def curve(fraction: Floats, shape: Floats) -> Floats:
    """Return the exact pulse over its peak at fractions u (n, n_samples) of the contact; zero outside contact."""
    restitution, contact, _, peak = dimensionless(-np.abs(shape))
    fraction = np.where(shape[:, None] > 0, 1 - fraction, fraction)
    return family.force(fraction * contact[:, None], restitution) / peak[:, None]


#: Order of the parameters in a reported covariance.
PARAMETERS = ("ln_peak", "ln_duration", "onset", "shape")


#: Columns of (peak, ln width, peak time, shape) that are fitted, by whether the onset is known.
FREE = {False: [0, 1, 2, 3], True: [0, 1, 3]}


def slopes_and_pulse(parameters: Floats, times: Floats, onset_known: bool = False) -> Floats:
    """Return slopes in the free parameters and, last, pulses, (n, n_free + 1, n_samples)."""
    # With a known onset, the peak time follows from width and shape. The error against `curve` is 1e-5 of the peak for
    # e from .2 and 1.2e-4 at .05; within a thousandth of the contact from its ends up to 4e-5 for e from .3, 4e-4 at
    # .05.
    peak, log_width, peak_time, shape = parameters.T
    width = np.exp(log_width)
    duration, lead, duration_slope, lead_slope, node, offset = relative_times(shape)
    turned = shape > 0
    sign = np.where(turned, -1.0, 1.0)
    # Time in cells x is linear in time, and the slopes are linear in x.
    scale = sign * N_CELLS / (width * duration)
    shift = (lead / duration) * sign * N_CELLS + np.where(turned, N_CELLS, 0.0) - peak_time * scale
    steep = peak * scale * width
    # z: time from the peak (with a known onset, from there) over the width, at x = 0.
    first_z, first_share = turned * duration - (0.0 if onset_known else lead), turned * 1.0
    moved = 0.0 if onset_known else lead_slope
    of_rows = [
        offset,
        0.5 * offset,
        -steep * first_z,
        -steep * (sign * duration / N_CELLS),
        -steep / width,
        peak * sign,
        steep * (moved - first_share * duration_slope),
        -steep * (sign / N_CELLS) * duration_slope,
    ]
    ds, half, z0, z1, to_peak_time, in_s, s0, s1 = np.array(of_rows, np.float32)[:, :, None]
    n, n_points = times.shape
    out = np.empty((n, len(FREE[onset_known]) + 1, n_points))
    x = times * scale[:, None]
    x += shift[:, None]
    np.minimum(np.maximum(x, 0.0, out=x), N_CELLS, out=x)
    column = np.rint(x)
    dx = (x - column).astype(np.float32)
    index = column.astype(np.intp)
    index += (node * (N_CELLS + 1))[:, None]
    g, g_u, g_uu, g_s, g_su, g_ss = (tabulated.take(index) for tabulated in tables()[0])
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
        np.multiply(slope, to_peak_time, out=out[:, 2])
    x *= s1
    x += s0
    x *= slope
    g_s *= in_s
    np.add(x, g_s, out=out[:, 2 if onset_known else 3])
    return out


def covariance_of(information: Floats, parameters: Floats, variance: Floats) -> Floats:
    """Return the covariance of `PARAMETERS` in a parabolic likelihood, (n, 4, 4), for noise of a variance, (n,)."""
    peak, log_width, _, shape = parameters.T
    width = np.exp(log_width)
    duration, lead, duration_slope, lead_slope, *_ = relative_times(shape)
    jacobian = np.zeros((len(peak), 4, 4))
    jacobian[:, 0, 0] = 1 / peak
    jacobian[:, 1, 1], jacobian[:, 1, 3] = 1.0, duration_slope / duration
    jacobian[:, 2, 1], jacobian[:, 2, 2], jacobian[:, 2, 3] = -lead * width, 1.0, -lead_slope * width
    jacobian[:, 3, 3] = 1.0
    scale, unit = scaled(information, 1e-12)
    inverse = np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(jacobian @ inverse @ np.swapaxes(jacobian, 1, 2) * variance[:, None, None])


def bounded(step: Floats, free: list[int], width: Floats) -> Floats:
    """Return steps (n, n_free) in free parameters, none larger than `MAX_STEPS`; width (n,) [samples]."""
    step = step.copy()
    for column, parameter in enumerate(free):
        if 1 <= parameter <= 3:
            largest = MAX_STEPS[parameter - 1] * (width if parameter == 2 else 1.0)
            step[:, column] = np.minimum(np.maximum(step[:, column], -largest), largest)
    return step

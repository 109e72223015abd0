"""Constant weights of a collocation step for a contact force that acts on modes.

A step covers the time h. In its own variable s from 0 to 1 the time passed is `h m(s)`, and m makes the force
analytic: m = s within contact, `s^2` after onset and `s (2 - s)` before separation, where the force goes like the
distance in time to the power 3/2. The force is the polynomial through its values at n Gauss nodes of s; the
free motion of the modes, and their response to a unit impulse, are polynomials of time through k Chebyshev nodes,
ends included.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Kinds of a step, the first index of many arrays.
WITHIN, FROM_TOUCH, TO_SEPARATION = 0, 1, 2
_TIME: tuple[Callable[[Floats], Floats], ...] = (lambda s: s, lambda s: s * s, lambda s: s * (2 - s))
_RATE: tuple[Callable[[Floats], Floats], ...] = (lambda s: np.ones_like(s), lambda s: 2 * s, lambda s: 2 - 2 * s)


class Collocation(NamedTuple):
    """Weights of a step; the first axis of most is its kind."""

    place: Floats  # time at the Gauss nodes over h, (3, n)
    measure: Floats  # weights of an integral over the step, of values at the Gauss nodes, (3, n)
    integral: Floats  # weights of the integrals from 0 to each Gauss node, (3, n, n)
    # `memory[kind, k, i, j]`: response at Gauss node i to a force of 1 at Gauss node j, 0 at the others, for a unit
    # impulse response of 1 at Chebyshev time k, 0 at the others, (3, k, n, n)
    memory: Floats
    moment: Floats  # the same at the end of the step, (3, k, n)
    cardinal: Floats  # from values at the Chebyshev times to those at the Gauss nodes, (3, n, k)
    legendre: Floats  # from values at the Gauss nodes to the coefficients of Legendre polynomials of `2 s - 1`, (n, n)
    times: Floats  # the Chebyshev times over h, 0 and 1 included, (k,)
    barycentric: Floats  # their barycentric weights, (k,)
    flight: Floats  # weights of the integrals from 0 to each Chebyshev time, (k, k)


@cache
def collocation(n_nodes: int, n_times: int) -> Collocation:
    """Return the weights for n Gauss nodes and k Chebyshev times."""
    nodes, weights = _on_unit(n_nodes)
    sine = np.sin(np.pi / 2 * np.arange(n_times) / (n_times - 1))
    times = sine * sine
    barycentric: Floats = np.where(np.arange(n_times) % 2, -1.0, 1.0)
    barycentric[[0, -1]] /= 2
    # Exact for the product of all polynomials, whose variable m is of degree 2.
    fine, fine_weights = _on_unit(n_times + n_nodes // 2 + 2)
    degrees = np.arange(n_nodes)
    legendre = (2 * degrees[:, None] + 1) * np.polynomial.legendre.legvander(2 * nodes - 1, n_nodes - 1).T * weights
    # For each Gauss node i the fine nodes between 0 and it, (n, fine).
    before = nodes[:, None] * fine
    fraction = nodes[:, None] * fine_weights
    vander = np.polynomial.legendre.legvander
    at_nodes, at_fine = (
        np.einsum("pj,jn->pn", vander(2 * place.ravel() - 1, n_nodes - 1), legendre) for place in (before, fine)
    )
    at_nodes = at_nodes.reshape(*before.shape, n_nodes)
    integral, memory, moment, cardinal = [], [], [], []
    for time, rate in zip(_TIME, _RATE, strict=True):
        weighed = (fraction * rate(before))[..., None] * at_nodes
        integral.append(weighed.sum(axis=1))
        past = _cardinal(times, barycentric, time(nodes)[:, None] - time(before))
        memory.append((past[..., None] * weighed[:, :, None]).sum(axis=1).swapaxes(0, 1))
        past = _cardinal(times, barycentric, 1 - time(fine))
        moment.append(np.einsum("ft,fn->tn", past, (fine_weights * rate(fine))[:, None] * at_fine))
        cardinal.append(_cardinal(times, barycentric, time(nodes)))
    flight = (times[:, None] * fine_weights)[..., None] * _cardinal(times, barycentric, times[:, None] * fine)
    return Collocation(
        place=np.array([time(nodes) for time in _TIME]),
        measure=np.array([weights * rate(nodes) for rate in _RATE]),
        integral=np.array(integral),
        memory=np.array(memory),
        moment=np.array(moment),
        cardinal=np.array(cardinal),
        legendre=legendre,
        times=times,
        barycentric=barycentric,
        flight=flight.sum(axis=1),
    )


def gauss(n_nodes: int) -> tuple[Floats, Floats]:
    """Return the nodes and weights of Gauss's rule on [-1, 1], by Newton's method on the Legendre polynomial.

    Examples
    --------
    >>> nodes, weights = gauss(2)
    >>> nodes.round(6).tolist(), weights.round(6).tolist()
    ([-0.57735, 0.57735], [1.0, 1.0])
    """
    # Tricomi's estimate; Abramowitz & Stegun (1964), 22.16.6.
    x = -np.cos(np.pi * (np.arange(n_nodes) + 0.75) / (n_nodes + 0.5))
    for _ in range(6):
        before, value = np.ones_like(x), x
        for degree in range(1, n_nodes):
            before, value = value, ((2 * degree + 1) * x * value - degree * before) / (degree + 1)
        slope = n_nodes * (before - x * value) / ((1 - x) * (1 + x))
        x = x - value / slope
    x = (x - x[::-1]) / 2
    return x, 2 / ((1 - x) * (1 + x) * slope * slope)


def _on_unit(n_nodes: int) -> tuple[Floats, Floats]:
    """Return nodes and weights on [0, 1]."""
    nodes, weights = gauss(n_nodes)
    return (nodes + 1) / 2, weights / 2


def _cardinal(times: Floats, barycentric: Floats, at: Floats) -> Floats:
    """Return the polynomials that are 1 at one of the times and 0 at the others, (*shape of at, k)."""
    distance = at[..., None] - times
    hit = distance == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = barycentric / distance
        values = terms / terms.sum(axis=-1, keepdims=True)
    return np.asarray(np.where(hit.any(axis=-1, keepdims=True), hit.astype(float), values))

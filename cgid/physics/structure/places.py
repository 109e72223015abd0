"""Shapes of modes between the places where they were measured.

A mode of a plate is locally a sum of waves of one length from all sides, so that its values at two places r apart
correlate like the Bessel function J0(k r) (Berry 1977). Where stiffness differs from place to place, or with the
direction, so does the length, and the correlation fades with the distance. Each mode is interpolated by the Gaussian
process of that correlation which predicts its value at every place best from all others; wave numbers grow with the
root of the frequency, which tells a wave from another one that passes through the same places.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads scipy.spatial on first use
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.special import j0

from cgid._lib.validation import Floats
from cgid.measure.modal.modes import NodeShapes, are_lines, nodes

__all__ = ["PlacedShapes", "placed"]

#: Wave numbers tried for each wave length that the places resolve, how far beyond they go, and lengths over which the
#: correlation fades, over the size of the region.
_STEP, _BEYOND, _FADES = 1.15, 1.3, (0.1, 0.3, 1.0, 3.0)
#: Variances of the error of a value over that of the mode.
_NUGGETS = np.array([1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0])
#: A mode's wave number is within this factor of what the frequencies of all say.
_NEAR = 1.3
#: Places, nearest to their middle, from which correlations are chosen.
_CHOOSING = 120
#: Chebyshev nodes to a wave, and beyond.
_NODES_A_WAVE, _NODES = 4.0, 9


@dataclass(frozen=True, eq=False)
class PlacedShapes:
    """Shapes of modes between places.

    Attributes
    ----------
    shapes : NodeShapes
        In the smallest rectangle that contains the places.
    left_out : ndarray, (n_places, n_modes)
        Value at each place minus what the other places predict, over the root mean square of the mode.
    deviation : ndarray, (n_modes,)
        Standard deviation between the places, over the root mean square of the mode.
    surprise : ndarray, (n_places,)
        `left_out` over its standard deviation, root mean square of the modes in the band.
    """

    shapes: NodeShapes
    left_out: Floats
    deviation: Floats
    surprise: Floats

    @property
    def unpredicted(self) -> Floats:
        """Root mean square of `left_out`, (n_modes,)."""
        return np.asarray(np.sqrt(np.square(self.left_out).mean(axis=0)))

    def taken(self, modes: NDArray[np.intp]) -> PlacedShapes:
        """Return some of the modes."""
        shapes = NodeShapes(self.shapes.values[modes], self.shapes.region)
        return replace(self, shapes=shapes, left_out=self.left_out[:, modes], deviation=self.deviation[modes])


def placed(places: Floats, values: Floats, frequency: Floats, damping_ratio: Floats) -> PlacedShapes:
    """Return the shapes of modes from values (n_places, n_modes) at places (n_places, 2) [m]."""
    level = np.maximum(np.sqrt(np.mean(np.square(values), axis=0)), 1e-300)
    of_mode = values / level
    is_mode = ~are_lines(damping_ratio)  # the others have no wave number
    wave, fade, nugget = _correlations(places, of_mode, frequency, is_mode)
    low, high = places.min(axis=0), places.max(axis=0)
    shortest = 2 * np.pi / float((wave + 2 / fade).max())
    counts = np.ceil(_NODES_A_WAVE * (high - low) / shortest).astype(int) + _NODES
    sides = [nodes(int(n) if b > a else 1, a, b) for n, a, b in zip(counts, low, high, strict=True)]
    at = np.stack([side.ravel() for side in np.meshgrid(*sides, indexing="ij")], axis=1)
    apart, towards = scipy.spatial.distance.cdist(places, places), scipy.spatial.distance.cdist(at, places)
    out = np.empty((len(frequency), len(at)))
    left, deviation = np.empty(values.shape), np.empty(len(frequency))
    # Between places: not in the corners of the rectangle that have none.
    between, surprise = towards.min(axis=1) <= _spacing(apart), np.zeros(len(places))
    for kind in np.unique(np.stack([wave, fade, nugget], axis=1), axis=0):
        modes = np.flatnonzero((np.stack([wave, fade, nugget], axis=1) == kind).all(axis=1))
        inverse = np.linalg.inv(_correlation(apart, *kind[:2]) + kind[2] * np.eye(len(places)))
        across = _correlation(towards, *kind[:2])
        weights = inverse @ of_mode[:, modes]
        out[modes] = (across @ weights).T
        left[:, modes] = weights / np.diag(inverse)[:, None]
        # The variance of the process is that of the values left out, each over what is expected of it.
        squares = np.square(left[:, modes]) * np.diag(inverse)[:, None]
        scale = np.maximum(squares.mean(axis=0), 1e-300)
        surprise += (squares / scale)[:, is_mode[modes]].sum(axis=1)
        spread = 1 - np.einsum("np,pq,nq->n", across[between], inverse, across[between], optimize=True)
        deviation[modes] = np.sqrt(scale * np.maximum(spread, 0).mean())
    out *= level[:, None]
    region = np.array([low[0], high[0], low[1], high[1]])
    shapes = NodeShapes(out.reshape(-1, *(side.size for side in sides)), region)
    return PlacedShapes(shapes, left, deviation, np.sqrt(surprise / max(is_mode.sum(), 1)))


def _spacing(apart: Floats) -> float:
    """Return the usual distance of a place from the nearest other one."""
    return float(np.median(np.sort(apart, axis=1)[:, 1]))


def _correlation(distance: Floats, wave: float, fade: float) -> Floats:
    return np.asarray(j0(wave * distance) * np.exp(-0.5 * np.square(distance / fade)))


def _correlations(
    places: Floats, values: Floats, frequency: Floats, is_mode: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:
    """Return wave number [1/m], fading length [m] and relative variance of the error of each mode, (n_modes,)."""
    middle = np.square(places - places.mean(axis=0)).sum(axis=1)
    few = np.argsort(middle, kind="stable")[:_CHOOSING]
    apart, part = scipy.spatial.distance.cdist(places[few], places[few]), values[few]
    size = float(np.linalg.norm(np.ptp(places, axis=0)))
    most = _BEYOND * np.pi / _spacing(apart)
    waves = np.append(0.0, np.geomspace(1 / size, most, max(int(np.log(most * size) / np.log(_STEP)), 2)))
    fades = np.array(_FADES) * size
    left = np.empty((waves.size, fades.size, _NUGGETS.size, values.shape[1]))
    for i, wave in enumerate(waves.tolist()):
        for k, fade in enumerate(fades.tolist()):
            power, mixed = eigh(_correlation(apart, wave, fade))
            turned = mixed.T @ part
            for j, nugget in enumerate(_NUGGETS.tolist()):
                inverse = 1 / (np.maximum(power, 0.0) + nugget)
                missed = (mixed @ (turned * inverse[:, None])) / (np.square(mixed) @ inverse)[:, None]
                left[i, k, j] = np.mean(np.square(missed), axis=0)
    flat = np.log(np.maximum(left, 1e-12)).reshape(waves.size, -1, values.shape[1])
    by_wave = flat.min(axis=1)
    allowed = np.zeros((waves.size, values.shape[1]), bool)
    allowed[0, ~is_mode] = True
    if is_mode.any():
        root = np.sqrt(frequency[is_mode])
        factors = np.geomspace(waves[1] / root.max(), most / root.min(), 200)
        known = by_wave[:, is_mode]
        columns = np.arange(root.size)
        costs = [known[np.abs(waves[:, None] - factor * root).argmin(axis=0), columns].sum() for factor in factors]
        usual = factors[int(np.argmin(costs))] * root
        allowed[:, is_mode] = (waves[:, None] <= _NEAR * usual) & (waves[:, None] >= usual / _NEAR)
        allowed[0, is_mode] |= ~allowed[:, is_mode].any(axis=0)
    chosen = np.where(allowed, by_wave, np.inf).argmin(axis=0)
    fade_of, nugget_of = np.unravel_index(
        flat[chosen, :, np.arange(values.shape[1])].argmin(axis=1), (fades.size, _NUGGETS.size)
    )
    return waves[chosen], fades[fade_of], _NUGGETS[nugget_of]

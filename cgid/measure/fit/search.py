"""The global search for a pulse: all shapes at once, each with its peak, width and peak time.

A bank contains the damped-Hertz pulse of each shape of `NODES`, with its slopes in time and width, in coordinates in
which the pulses overlap most. The samples around a pulse become bins in the same coordinates, so one product of
matrices solves least squares for all shapes. A few repetitions with the bins moved to the best solution find the global
optimum. The likelihood of every shape (`Found.cost`) then gives standard deviations where a parabola would not: a dull
pulse of restitution .15 in 3 % noise may also be one of .45.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.template import MAX_SHAPE, MIN_SHAPE, SHAPES_PATH

#: Shapes of the bank: most of them where materials are, some mirrored.
NODES = np.concatenate([np.linspace(MIN_SHAPE, 0.8, 20), [1.2, 1.8, MAX_SHAPE]])
#: Inner nodes with evenly spaced neighbours.
_EVEN = np.abs(np.diff(NODES, n=2)) < 1e-9
#: Bins of the common coordinates, in widths of the elastic pulse.
_FIRST, LAST, N_BINS = -1.5, 4.1, 56
BIN = (LAST - _FIRST) / N_BINS
EDGES = _FIRST + BIN * np.arange(N_BINS + 1)
MIDDLES = EDGES[:-1] + 0.5 * BIN
#: Repetitions of the search, and its largest steps in peak time (over the width) and ln(width).
_PASSES, _MAX_STEP = 4, 0.4
#: Base-2 logarithm of the minimum number of samples around a pulse.
_SHORTEST = 5
#: A row is settled when its steps are below this.
_SETTLED = 0.02
#: Shapes farther apart than this are different; a shape is ruled out if its cost is this many noise variances higher.
_FAR, _MIN_COST_RISE = 0.5, 16.0


@dataclass(frozen=True, eq=False, repr=False)
class PulseBank:
    """Pulses of peak 1 in common coordinates."""

    # `peak_time`, `width`: of each node's peak and of its width (impulse over peak) in common coordinates, (n_nodes,)
    peak_time: Floats
    width: Floats
    # pulse, slopes in peak time and ln(width), averaged over bins, (n_nodes, n_bins, n_free)
    basis: Floats
    products: Floats  # of the columns of the basis, (n_bins, n_nodes n_free n_free)
    inverse: Floats  # of the information of all bins, (n_nodes, n_free, n_free)
    tangents: Floats  # slopes in peak, peak time, width and shape, (n_nodes, n_bins, 4)

    @cached_property
    def flat(self) -> Floats:
        """The basis as (n_bins, n_nodes n_free)."""
        return np.moveaxis(self.basis, 0, 1).reshape(N_BINS, -1)

    def conditions(self, shape: Floats) -> tuple[Floats, Floats]:
        """Return peak time and width in common coordinates at any shapes."""
        return np.interp(shape, NODES, self.peak_time), np.interp(shape, NODES, self.width)


@cache
def bank() -> PulseBank:
    """Return the bank from its file: making it takes longer than the fit of a few pulses."""
    with np.load(SHAPES_PATH, allow_pickle=False) as stored:
        peak_time, width, tangents = stored["place"], stored["width"], stored["tangents"]
    basis = tangents[:, :, :3]
    products = np.einsum("kbi,kbj->bkij", basis, basis).reshape(N_BINS, -1)
    inverse = np.linalg.inv(products.sum(axis=0).reshape(NODES.size, *basis.shape[2:] * 2))
    return PulseBank(peak_time, width, basis, products, inverse, tangents)


@dataclass(frozen=True, eq=False, repr=False)
class Bins:
    """Samples around pulses, averaged over the bins: values and which of them count, (n, n_bins); None for all."""

    values: Floats
    inside: NDArray[np.bool_] | None

    @property
    def partial(self) -> NDArray[np.intp]:
        """Rows with bins that do not count."""
        return np.flatnonzero(~self.inside.all(axis=1)) if self.inside is not None else np.empty(0, np.intp)


class Samples:
    """Running sums of the samples around some pulses, from which bins anywhere follow."""

    # `first` and `last` (n,) are frame columns of the first and last sample; `reach` (n,) the last column that bins
    # used.

    def __init__(
        self,
        samples: NDArray[np.floating],
        offset: Floats,
        clip_level: Floats,
        first: NDArray[np.intp],
        last: NDArray[np.intp] | None = None,
    ) -> None:
        n, self.n_samples = samples.shape
        self.total = np.zeros((n, self.n_samples + 1))
        self.total[:, 1:] = samples
        np.cumsum(self.total, axis=1, out=self.total)
        self.offset, self.clip_level, self.first = offset, clip_level, first
        self.last = np.full(n, self.n_samples - 1.0) if last is None else (last - first).astype(np.float64)
        self.clips = bool(np.isfinite(clip_level).any())
        self.reach = np.zeros(n)

    def bins(self, peak_time: Floats, width: Floats, rows: NDArray[np.intp]) -> Bins:
        """Return the bins around origins `peak_time` [samples of the frame] of unit `width` [samples]."""
        last = self.last[rows]
        at = width[:, None] * EDGES
        at += (peak_time - self.first[rows])[:, None]
        self.reach[rows] = np.maximum(self.reach[rows], at[:, -1] + self.first[rows])
        inside = None
        if not (at[:, 0].min() >= 0 and (at[:, -1] < last).all()):
            within = (at >= 0) & (at <= last[:, None])
            inside = within[:, :-1] & within[:, 1:]
            at = np.clip(np.nan_to_num(at), 0.0, last[:, None])
        column = np.minimum(at.astype(np.intp), self.n_samples - 2)
        share = at - column
        # The integral of the line through the samples, from their running sums.
        column += (rows * (self.n_samples + 1))[:, None]
        flat = self.total.ravel()
        sums, middle, behind = flat.take(column), flat.take(column + 1), flat.take(column + 2)
        behind -= middle
        middle -= sums  # the two samples on either side
        behind -= middle
        sums += 0.5 * middle
        behind *= 0.5 * share
        behind += middle
        behind *= share
        sums += behind
        values = np.diff(sums, axis=1)
        values /= (width * BIN)[:, None]
        values -= self.offset[rows, None]
        if self.clips:
            # A bin near the limit contains clipped samples.
            free = values < 0.97 * self.clip_level[rows, None]
            inside = free if inside is None else inside & free
        return Bins(values if inside is None else np.where(inside, values, 0.0), inside)


def around(
    samples: NDArray[np.floating], peak_time: Floats, width: Floats, offset: Floats, clip_level: Floats, reach: float
) -> Iterator[tuple[NDArray[np.intp], Samples]]:
    """Yield rows of pulses of similar width, and their samples within `reach` times the extent of the bins."""
    n_samples = samples.shape[1]
    # Lengths come in steps, and the last sample repeats beyond the frame, so that a row depends neither on the other
    # rows nor on samples further away.
    required = np.maximum(reach * (LAST - _FIRST) * width, 2.0**_SHORTEST)
    length = 1 << np.minimum(np.ceil(np.log2(required)), 40).astype(np.intp)
    middle = peak_time + 0.5 * (_FIRST + LAST) * width
    first = np.minimum(np.maximum(np.floor(middle - 0.5 * length), 0), n_samples - 2).astype(np.intp)
    complete = length >= 2 * n_samples
    length[complete], first[complete] = n_samples, 0
    for n_columns in sorted(set(length.tolist())):
        rows = np.flatnonzero(length == n_columns)
        columns = first[rows, None] + np.arange(n_columns)
        if columns[:, -1].max() >= n_samples:
            np.minimum(columns, n_samples - 1, out=columns)
        columns += (rows * n_samples)[:, None]
        last = np.minimum(first[rows] + n_columns, n_samples) - 1
        yield rows, Samples(samples.ravel().take(columns), offset[rows], clip_level[rows], first[rows], last)


@dataclass(frozen=True, eq=False, repr=False)
class SearchResult:
    """The result of the search, each (n, n_nodes); `unit` [samples] is (n,)."""

    cost: Floats  # sum over the bins of the squared residual
    peak: Floats  # `peak`, `peak_time`, `width`: the best at each shape, times in samples
    peak_time: Floats
    width: Floats
    unit: Floats

    @classmethod
    def joined(cls, parts: list[tuple[NDArray[np.intp], SearchResult]]) -> SearchResult:
        """Return the result of all rows from those of some."""
        order = np.argsort(np.concatenate([rows for rows, _ in parts]), kind="stable")
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for _, part in parts])[order] for f in fields(cls)})

    def rows(self, n_columns: NDArray[np.intp]) -> SearchResult:
        """Return some of the rows."""
        return SearchResult(**{one.name: getattr(self, one.name)[n_columns] for one in fields(self)})

    def in_doubt(self, variance: Floats, shape: Floats | None = None) -> NDArray[np.bool_]:
        """Return which pulses may be those of the second minimum, or far from a `shape`, for this noise, (n,)."""
        (lowest, cost), scale = self.valleys[1], self.unit * BIN / variance
        if shape is not None:
            cost = np.where(np.abs(NODES - shape[:, None]) > _FAR, self.cost, np.inf).min(axis=1)
        # The bins of a pulse of few samples are coarse.
        return np.asarray((cost - lowest) * scale < _MIN_COST_RISE * np.maximum(lowest * scale / N_BINS, 1.0))

    def depth_near(self, shape: Floats) -> Floats:
        """Return the cost of the minimum nearer to a shape, (n,)."""
        _, (lowest, second), shapes = self.valleys
        away = np.abs(shapes - shape)
        return np.asarray(np.where((away[1] < away[0]) & np.isfinite(second), second, lowest))

    def start(self, second: bool = False) -> Floats:
        """Return parameters (peak, ln width, peak time, shape) near the best, or the second best, (n, 4)."""
        rows, valley = np.arange(len(self.cost)), int(second)
        node, shape = self.valleys[0][valley], self.valleys[2][valley]
        middle = np.clip(node, 1, NODES.size - 2)
        share = (shape - NODES[node]) / (NODES[1] - NODES[0])  # 0 where the neighbours differ
        before, at, after = (
            np.array([part[rows, k] for part in (self.peak, self.width, self.peak_time)])
            for k in (middle - 1, node, middle + 1)
        )
        for part in (before, at, after):
            np.log(part[1], out=part[1])
        peak, log_width, peak_time = at + np.where(
            share == 0, 0.0, 0.5 * share * (after - before) + 0.5 * share**2 * (after - 2 * at + before)
        )
        return np.array([peak, log_width, peak_time, shape]).T

    @cached_property
    def valleys(self) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Nodes, costs and shapes of the two lowest minima, each (2, n); an infinite cost without a second one."""
        # The minimum of each node's parabola between its neighbours [s from the node], and the cost there.
        move, lowest = np.zeros(self.cost.shape), self.cost.copy()
        before, at, after = self.cost[:, :-2], self.cost[:, 1:-1], self.cost[:, 2:]
        bend, tilt = before - 2 * at + after, 0.5 * (before - after)
        inner = np.isfinite(bend) & (bend > 0) & (at <= before) & (at <= after) & _EVEN
        share = np.where(inner, tilt / np.where(inner, bend, 1.0), 0.0)
        move[:, 1:-1] = share * (NODES[1] - NODES[0])
        lowest[:, 1:-1] -= 0.5 * np.where(inner, tilt, 0.0) * share
        valley = np.ones(self.cost.shape, bool)
        falls = self.cost[:, 1:] <= self.cost[:, :-1]
        valley[:, 1:] = falls
        valley[:, :-1] &= ~falls | (self.cost[:, 1:] == self.cost[:, :-1])
        depths = np.where(valley, lowest, np.inf)
        rows, first = np.arange(len(depths)), np.argmin(depths, axis=1)
        deepest = depths[rows, first]
        depths[rows, first] = np.inf
        second = np.argmin(depths, axis=1)
        nodes = np.stack([first, second])
        return nodes, np.stack([deepest, depths[rows, second]]), NODES[nodes] + move[rows, nodes]


def search(samples: Samples, peak_time: Floats, width: Floats) -> SearchResult:
    """Return the best pulses of all shapes in frames, from approximate peak times and widths [samples], each (n,)."""
    shapes = bank()
    n, n_nodes = len(peak_time), NODES.size
    origin, unit = peak_time.copy(), width.copy()
    solution = np.zeros((n, n_nodes, shapes.basis.shape[2]))
    cost, best = np.full((n, n_nodes), np.inf), np.zeros(n, np.intp)
    active = np.arange(n)
    for repetition in range(_PASSES):
        solved_bins = solve(shapes, samples.bins(origin[active], unit[active], active))
        solution[active], cost[active] = solved_bins
        best[active] = np.argmin(solved_bins[1], axis=1)
        if repetition == _PASSES - 1:
            break
        solved = solution[active, best[active]].T
        steps = solved[1:3] / np.where(solved[0] > 0, solved[0], np.inf)
        steps = np.minimum(np.maximum(steps, -_MAX_STEP), _MAX_STEP)
        moving = np.abs(steps).max(axis=0) > _SETTLED
        active, steps = active[moving], steps[:, moving]
        if not active.size:
            break
        origin[active] += steps[0] * unit[active]
        unit[active] *= np.exp(steps[1])
    peak = np.maximum(solution[:, :, 0], 1e-300)
    # First-order moves from the common origin and unit, for each shape.
    move, stretch = (np.clip(solution[:, :, k] / peak, -_MAX_STEP, _MAX_STEP) for k in (1, 2))
    stretched_unit = unit[:, None] * np.exp(stretch)
    return SearchResult(
        cost,
        peak,
        origin[:, None] + unit[:, None] * move + stretched_unit * shapes.peak_time,
        stretched_unit * shapes.width,
        unit,
    )


def solve(shapes: PulseBank, bins: Bins) -> tuple[Floats, Floats]:
    """Return the least-squares solutions for all shapes, (n, n_nodes, n_free), and their squared residuals."""
    n, (n_nodes, _, n_free) = len(bins.values), shapes.basis.shape
    # Row by row: a result must not depend on the number of rows.
    right = np.matmul(bins.values[:, None], shapes.flat).reshape(n, n_nodes, n_free)
    solution = np.einsum("kij,nkj->nki", shapes.inverse, right)
    if bins.inside is not None and (partial := bins.partial).size:
        inside = bins.inside[partial][:, None].astype(np.float64)
        information = np.matmul(inside, shapes.products).reshape(-1, n_nodes, n_free, n_free)
        ridge = 1e-6 * np.einsum("nkii->nki", information) + 1e-9
        information[..., np.arange(n_free), np.arange(n_free)] += ridge
        solution[partial] = np.linalg.solve(information, right[partial][..., None])[..., 0]
    explained = np.einsum("nki,nki->nk", solution, right)
    cost = np.sum(bins.values**2, axis=1)[:, None] - explained
    return solution, np.where(solution[:, :, 0] > 0, cost, np.inf)

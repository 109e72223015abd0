"""Mass, radius and speed of the impactor, from fitted pulses: the posterior within a population.

A pulse of the damped-Hertz family has the scales `P0 = K L^(3/2)` and `T0 = L / v`. With `K ~ E* R^(1/2)` and
`L = (m v^2 / K)^(2/5)`, P0 / T0^2 does not depend on the size and varies as `v^(8/5)`; T0 is proportional to the size
(Hertz 1882; Johnson 1985, Contact Mechanics, section 11.4). So a pulse leaves radius, speed and modulus undetermined
along one direction, which the population fills.

Each sample of the population that could have given the pulse is moved onto it along these powers: its speed until
P0 / T0^2 agrees, then its radius until T0 does. (Without the powers this is the regression adjustment of Beaumont,
Zhang and Balding 2002, Genetics 162, 2025.) Samples are sorted by shape and P0 / T0^2, so an impact uses some hundred.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from studies.impactor.measured import MeasuredPulses
from studies.impactor.pulses import dimensionless_logarithms

#: Estimated quantities of an impactor and their units.
QUANTITIES = {"mass": "kg", "radius": "m", "speed": "m/s"}
#: Probabilities of the stored quantiles.
LEVELS = np.array([0.005, 0.01, 0.025, *np.arange(0.05, 0.951, 0.05), 0.975, 0.99, 0.995])
#: Powers of the speed in P0 / T0^2 and in T0.
SPEED_POWER, TIME_POWER = 1.6, -0.2
#: Power of the modulus in T0 over that in P0 / T0^2: -2/5 over 6/5.
_MODULUS_RATIO = -1 / 3
#: Nodes along the shape, and draws used from each.
_NODES, _DRAWS = 12, 48
#: Extent of ln(radius) below which more draws are used, as fewer have weight, and the most.
_FEW_RADII, _MOST_DRAWS = 0.25, 384
#: Extent of the nodes and cut-off distance of draws [standard deviations].
_REACH, _BEYOND = 3.5, 4.0
#: Half the extent of draws of equal shape; minimum width of cells of a posterior: the draws have single precision.
_THIN, _PRECISION = 1e-6, 1e-5
#: Minimum number of draws per shape, and minimum and maximum number of shapes.
_PER_SHAPE, _MIN_SHAPES, _MAX_SHAPES = 1024, 8, 96
#: Widest kernel of draws along ln(P0 / T0^2).
_WIDEST = 0.25
#: Cells of ln(P0 / T0^2), of ln(radius), and of a posterior.
_CELLS, _RADII, _POSTERIOR = 512, 256, 160
#: Minimum relative width of a population's radii and speeds: equal ones are spread by this fraction. Range of ln(speed)
#: that counts as one speed, and number of speeds that count as few.
_NARROWEST, _EQUAL_SPEEDS, _FEW_SPEEDS = 0.01, 0.05, 64
#: Impacts processed at once: more exceed the cache.
_ROWS = 128


@dataclass(frozen=True, eq=False)
class ImpactorEstimates:
    """The impactor, one row per impact.

    Attributes
    ----------
    quantiles : dict of ndarray, (n, n_levels)
        Of mass [kg], radius [m] and speed [m/s], at `LEVELS`; nan without an estimate.
    reason : ndarray of str, (n,)
        Why there is no interval, or a wide one; else empty.
    """

    quantiles: dict[str, Floats]
    reason: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.reason)

    def __repr__(self) -> str:
        known = int(np.isfinite(self.quantiles["mass"][:, 0]).sum())
        return f"ImpactorEstimates({counted(len(self), 'impact')}, {known} with intervals of {', '.join(QUANTITIES)})"

    def quantile(self, quantity: str, probability: float) -> Floats:
        """Return a quantile (.005 to .995) of the mass [kg], radius [m] or speed [m/s] of each impact, (n,).

        It is nan without an estimate.
        """
        validation.choice("quantity", quantity, QUANTITIES)
        at = float(validation.between("probability", probability, LEVELS[0], LEVELS[-1]))
        after = int(np.clip(np.searchsorted(LEVELS, at), 1, LEVELS.size - 1))
        fraction = (at - LEVELS[after - 1]) / (LEVELS[after] - LEVELS[after - 1])
        low, high = self.quantiles[quantity][:, after - 1], self.quantiles[quantity][:, after]
        return np.asarray(low ** (1 - fraction) * high**fraction)

    def median(self, quantity: str) -> Floats:
        """Return the median of each impact, (n,), as `quantile`."""
        return self.quantile(quantity, 0.5)

    def interval(self, quantity: str, coverage: float = 0.9) -> tuple[Floats, Floats]:
        """Return the equal-tailed interval that contains a quantity with this probability, two arrays (n,).

        `coverage` is above 0, up to .99.
        """
        if not 0 < validation.number("coverage", coverage) <= 0.99:
            raise InvalidValue(f"coverage must be above 0 and at most 0.99, got {coverage:g}")
        return self.quantile(quantity, 0.5 - 0.5 * coverage), self.quantile(quantity, 0.5 + 0.5 * coverage)

    @classmethod
    def joined(cls, parts: list[ImpactorEstimates]) -> ImpactorEstimates:
        """Return the impacts of all parts."""
        quantiles = {name: np.concatenate([part.quantiles[name] for part in parts]) for name in QUANTITIES}
        return cls(quantiles, np.concatenate([part.reason for part in parts]))

    @classmethod
    def unknown(cls, reason: NDArray[np.str_]) -> ImpactorEstimates:
        """Return impactors without estimates."""
        return cls({name: np.full((reason.size, LEVELS.size), np.nan) for name in QUANTITIES}, reason)


@dataclass(frozen=True, eq=False)
class ImpactorPopulation:
    """Draws of a population, each (n,).

    Attributes
    ----------
    log_peak, log_width, shape : of the pulse: ln of the peak [N] and of impulse over peak [s], and s = ln e
    log_radius, log_speed, log_mass : of the impactor [m], [m/s], [kg]
    group : number of its part of the population; within a part the radius is independent of other quantities
    name : of the population
    """

    log_peak: Floats
    log_width: Floats
    shape: Floats
    log_radius: Floats
    log_speed: Floats
    log_mass: Floats
    group: NDArray[np.intp]
    name: str = "population"

    def __post_init__(self) -> None:
        if self.shape.size < _PER_SHAPE:
            raise InvalidValue(f"{self.name}: must have at least {_PER_SHAPE} draws, got {self.shape.size}")

    def posterior(self, pulses: MeasuredPulses) -> ImpactorEstimates:
        """Return the posterior of the impactor."""
        parts = [self._posterior(part) for part in pulses.blocks(_ROWS)]
        return ImpactorEstimates.joined(parts) if parts else ImpactorEstimates.unknown(np.empty(0, np.str_))

    def _posterior(self, pulses: MeasuredPulses) -> ImpactorEstimates:
        values, weight, excluded = self._moved(pulses)
        quantiles = {name: np.exp(logarithms) for name, logarithms in _quantiles(values, weight).items()}
        return ImpactorEstimates(quantiles, pulses.without(excluded).problem)

    def _moved(self, pulses: MeasuredPulses) -> tuple[dict[str, Floats], Floats, dict[int, str]]:
        """Return logarithms of draws moved onto pulses, their weights, (n, n_draws), and reasons for missing ones."""
        table = self._table
        shape, index, density, given = table.nodes(pulses)
        given_shape = _given_shape(pulses, shape)
        rows, fraction = table.around(index, given_shape[0], given_shape[2])
        size_free, time, spread, lag, residual_std = (one.astype(np.float32)[:, :, None] for one in given_shape)
        distance = table.size_free[rows] - size_free
        kernel = np.minimum(0.2 * np.ptp(distance, axis=2, keepdims=True), _WIDEST) ** 2
        kernel += (0.3 * np.gradient(size_free, axis=1)) ** 2  # pulses of shapes between the nodes
        wide = spread**2 + kernel
        # Draws more distant than the error of the pulse are moved towards it.
        moved = distance * (spread / np.sqrt(wide))
        faster = table.speed_share * (moved - distance) / SPEED_POWER
        log_speed = table.log_speed[rows] + faster
        later = time + lag * moved + residual_std * table.jitter
        growth = later - table.time[rows]
        log_radius = table.log_radius[rows] + growth - table.time_power * (moved - distance)
        log_weight = -0.5 * distance**2 / wide
        reached = log_weight > -0.5 * _BEYOND**2
        fits = table.radii(table.group[rows], log_radius)
        fits *= (log_speed >= table.speeds[0]) & (log_speed <= table.speeds[1])
        weight = np.exp(log_weight) * reached * fits
        weight *= (fraction * density / np.sqrt(wide[:, :, 0])).astype(np.float32)[:, :, None]
        n = len(shape)
        weight = weight.reshape(n, -1)
        total = weight.sum(axis=1, keepdims=True)
        usable = np.isfinite(total[:, 0]) & (total[:, 0] > 0) & pulses.usable
        weight = np.where(usable[:, None], weight / np.where(usable[:, None], total, 1.0), 0.0)
        if table.one_radius:
            log_radius = table.log_radius[rows]
        log_mass = table.log_density[rows] + 3 * log_radius
        values = {"mass": log_mass, "radius": log_radius, "speed": log_speed}
        excluded = np.flatnonzero(~usable & pulses.usable)
        why = {row: self._excluded(pulses, row, given, reached, given_shape[0]) for row in excluded.tolist()}
        return {name: one.reshape(n, -1) for name, one in values.items()}, weight, why

    def _excluded(
        self, pulses: MeasuredPulses, row: int, given: NDArray[np.bool_], reached: NDArray[np.bool_], size_free: Floats
    ) -> str:
        """Return why the population excludes a pulse."""
        peak, width = np.exp(pulses.log_peak[row]), np.exp(pulses.log_width[row])
        if not given[row]:
            rule = f"restitution {np.exp(pulses.shape[row]):.2g} is outside of it"
        elif not reached[row].any():
            high = size_free[row].mean() > np.median(self._table.size_free)
            rule = f"its peak is too {'high' if high else 'low'} for its width"
        else:
            rule = "its size or speed would be different"
        return (
            f"{self.name} contains no impactor with a pulse of {peak:.3g} N and {width * 1e6:.3g} us (impulse over "
            f"peak): {rule}; use a population that does"
        )

    @cached_property
    def _table(self) -> _Table:
        return _Table(self)

    def prior(self, quantity: str) -> Floats:
        """Return the draws of a quantity without a measurement, (n,), in its unit of `QUANTITIES`."""
        validation.choice("quantity", quantity, QUANTITIES)
        return np.asarray(np.exp(getattr(self, f"log_{quantity}")))


class _Table:
    """Draws sorted by shape and, within these, by size-free scale."""

    def __init__(self, population: ImpactorPopulation) -> None:
        shape = population.shape
        n = shape.size
        self.n_shapes = int(np.clip(n // _PER_SHAPE, _MIN_SHAPES, _MAX_SHAPES))
        low, high = np.quantile(shape, [0.0005, 0.9995])
        low, high = low - 1e-3, max(high, low + _NARROWEST) + 1e-3
        step = (high - low) / self.n_shapes
        shape_index = np.clip((shape - low) / step, 0, self.n_shapes - 1).astype(np.intp)
        log_peak, log_width = dimensionless_logarithms(shape, "peak", "width")
        time = population.log_width - log_width
        size_free = population.log_peak - log_peak - 2 * time
        order = np.lexsort((size_free, shape_index))
        counts = np.bincount(shape_index, minlength=self.n_shapes)
        self.first, self.count = np.cumsum(counts) - counts, counts
        # Each shape extends as far as its draws: not at all if the restitution is a constant.
        self.lowest, self.highest = np.full(self.n_shapes, high), np.full(self.n_shapes, low)
        np.minimum.at(self.lowest, shape_index, np.clip(shape, low, high) - _THIN)
        np.maximum.at(self.highest, shape_index, np.clip(shape, low, high) + _THIN)
        # Single precision errs by 1e-6 of a logarithm, and is twice as fast.
        log_density = population.log_mass - 3 * population.log_radius
        columns = (size_free, time, population.log_radius, population.log_speed, log_density)
        self.size_free, self.time, self.log_radius, self.log_speed, self.log_density = (
            column[order].astype(np.float32) for column in columns
        )
        self.group = population.group[order]
        # The rank of a size-free scale within its shape, on a grid.
        self.origin, self.cell = size_free.min() - 1e-6, max(np.ptp(size_free), 1e-3) * (1 + 1e-6) / (_CELLS - 1)
        cells = ((self.size_free - self.origin) / self.cell).astype(np.intp) + 1
        grid = np.zeros((self.n_shapes, _CELLS + 1))
        np.add.at(grid, (shape_index[order], cells), 1.0)
        self.ranks = np.cumsum(grid, axis=1)
        self.speeds = self.log_speed.min() - 2 * _NARROWEST, self.log_speed.max() + 2 * _NARROWEST
        # Draws of one, or one of a few, speeds keep it, and of one radius: then the modulus moves them onto a pulse.
        few = np.ptp(self.log_speed) < _EQUAL_SPEEDS or np.unique(self.log_speed).size <= _FEW_SPEEDS
        self.speed_share = float(not few)
        self.time_power = _MODULUS_RATIO if few else TIME_POWER / SPEED_POWER
        self.one_radius = np.ptp(self.log_radius) < _NARROWEST
        self.n_draws = int(np.clip(_DRAWS * _FEW_RADII / self._radii(), _DRAWS, _MOST_DRAWS))
        # Nodes at one shape use different draws.
        self.phase = (np.arange(_NODES)[:, None] + 0.5) / _NODES
        even = np.broadcast_to(_normal(self.n_draws), (_NODES, self.n_draws))
        self.jitter = np.random.default_rng(0x57).permuted(even, axis=1).astype(np.float32)

    def _radii(self) -> float:
        """Tabulate the weight of a moved draw by its radius: the prior density there over that of the moved draws.

        Return the extent of ln(radius), that of a uniform density as concentrated.
        """
        low, high = self.log_radius.min(), self.log_radius.max()
        margin = max(0.02 * (high - low), 5 * _NARROWEST)
        self.smallest, self.ring = low - margin, (high - low + 2 * margin) / _RADII
        bins = ((self.log_radius - self.smallest) / self.ring).astype(np.intp)
        n_groups = int(self.group.max()) + 1
        counts = np.bincount(self.group * _RADII + bins, minlength=n_groups * _RADII).reshape(n_groups, _RADII)
        # Smooth enough to suppress the noise of draws.
        blur = max(1.5, 0.6 * _NARROWEST / self.ring)
        kernel = np.exp(-0.5 * (np.arange(-int(4 * blur), int(4 * blur) + 1) / blur) ** 2)
        smooth = np.stack([np.convolve(row, kernel / kernel.sum(), mode="same") for row in counts.astype(np.float64)])
        density = smooth / np.maximum(smooth.sum(axis=1, keepdims=True), 1e-300)
        extent = self.ring / np.max(np.sum(density**2, axis=1))
        self._weight = np.pad(density, ((0, 0), (1, 1))).astype(np.float32)
        return float(extent)

    def radii(self, group: NDArray[np.intp], log_radius: Floats) -> Floats:
        """Return the weight of moved draws by their radius."""
        position = np.clip((log_radius - self.smallest) / self.ring + 1, 0, _RADII + 1).astype(np.intp)
        return np.asarray(self._weight.reshape(-1)[group * (_RADII + 2) + position])

    def nodes(self, pulses: MeasuredPulses) -> tuple[Floats, NDArray[np.intp], Floats, NDArray[np.bool_]]:
        """Return nodes of the shape, (n, n_nodes), the number of its shape, its weight, and whether any exist."""
        # Quantiles (Chebyshev nodes, closer at the ends) of the draws times a logistic density, which is wider than
        # the likelihood and has a closed integral.
        middle, deviation = pulses.shape[:, None], np.sqrt(pulses.covariance[:, 2, 2])[:, None]
        low, high = (
            1 / (1 + np.exp(-np.clip((ends - middle) / deviation, -_REACH, _REACH)))
            for ends in (self.lowest, self.highest)
        )
        share = self.count * np.maximum(high - low, 0.0) / np.maximum(self.highest - self.lowest, _THIN)
        below = np.cumsum(share, axis=1)
        given = below[:, -1] > 0
        below[~given] = np.arange(1, self.n_shapes + 1)
        angle = np.pi * (np.arange(_NODES) + 0.5) / _NODES
        target = below[:, -1:] * (0.5 - 0.5 * np.cos(angle))
        index = np.sum(below[:, None, :] <= target[:, :, None], axis=2)
        low, high, share, below = (np.take_along_axis(one, index, axis=1) for one in (low, high, share, below))
        at = high - (high - low) * np.clip((below - target) / np.maximum(share, 1e-300), 0.0, 1.0)
        offset = np.log(at / (1 - at))
        weight = given[:, None] * np.sin(angle) * np.exp(-0.5 * offset**2) / (at * (1 - at))
        return middle + deviation * offset, index, weight, given

    def around(
        self, shape_index: NDArray[np.intp], size_free: Floats, spread: Floats
    ) -> tuple[NDArray[np.intp], Floats]:
        """Return the draws around points, (n, n_nodes, n_draws), and the fraction of a shape that each represents."""
        n_draws = self.n_draws
        counted = self.count[shape_index]
        low, high = (self._rank(shape_index, size_free + side * 2.5 * spread) for side in (-1, 1))
        lacking = np.maximum(n_draws - (high - low), 0) / 2
        low = np.clip(low - lacking, 0, np.maximum(counted - n_draws, 0))
        high = np.clip(np.maximum(high + lacking, low + n_draws), 0, counted)
        low = np.minimum(low, np.maximum(high - n_draws, 0))
        each = np.maximum(high - low, 0) / n_draws
        picks = (low[:, :, None] + each[:, :, None] * (np.arange(n_draws) + self.phase)).astype(np.intp)
        rows = self.first[shape_index][:, :, None] + np.minimum(picks, np.maximum(counted - 1, 0)[:, :, None])
        return np.minimum(rows, self.size_free.size - 1), each / np.maximum(counted, 1)

    def _rank(self, shape_index: NDArray[np.intp], size_free: Floats) -> Floats:
        position = np.clip((size_free - self.origin) / self.cell, 0, _CELLS - 1e-6)
        cell = position.astype(np.intp)
        flat, start = self.ranks.reshape(-1), shape_index * (_CELLS + 1) + cell
        below = flat[start]
        return np.asarray(below + (position - cell) * (flat[start + 1] - below))


def _given_shape(pulses: MeasuredPulses, shape: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return size-free scale, ln T0, and the std, slope and remainder of the former, at the nodes' shapes."""
    c, offset = pulses.covariance, shape - pulses.shape[:, None]
    slope = c[:, :2, 2] / c[:, 2:, 2]
    left = c[:, :2, :2] - slope[:, :, None] * c[:, None, :2, 2]
    log_peak, log_width = dimensionless_logarithms(shape, "peak", "width")
    time = pulses.log_width[:, None] + slope[:, 1:] * offset - log_width
    size_free = pulses.log_peak[:, None] + slope[:, :1] * offset - log_peak - 2 * time
    width = np.maximum(left[:, 1, 1], 1e-10)
    variance = np.maximum(left[:, 0, 0] - 4 * left[:, 0, 1] + 4 * width, 1e-10)
    lag = (left[:, 0, 1] - 2 * width) / variance
    residual_std = np.sqrt(np.maximum(width - lag**2 * variance, 0.0))
    spread, lag, residual_std = (
        np.broadcast_to(one[:, None], shape.shape) for one in (np.sqrt(variance), lag, residual_std)
    )
    return size_free, time, spread, lag, residual_std


def _normal(n: int) -> Floats:
    """Return n equally likely numbers of a standard normal distribution."""
    return np.array([NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)])


def _quantiles(values: dict[str, Floats], weight: Floats) -> dict[str, Floats]:
    """Return quantiles of weighted rows, each (n, n_levels), by histograms; nan for rows without weight."""
    n, max_weight = len(weight), weight.max(axis=1, initial=0.0)
    counted = weight > np.where(max_weight > 0, 1e-4 * max_weight, np.inf)[:, None]
    n_counted = counted.sum(axis=1)
    with_weight = np.flatnonzero(n_counted)
    row = np.repeat(np.arange(with_weight.size), n_counted[with_weight])
    first = np.searchsorted(row, np.arange(with_weight.size))
    heavy, start = weight[counted], row * _POSTERIOR
    quantiles = {}
    for name, column in values.items():
        quantiles[name] = np.full((n, LEVELS.size), np.nan)
        if with_weight.size:
            selected = column[counted]
            low, high = np.minimum.reduceat(selected, first), np.maximum.reduceat(selected, first)
            cell = np.maximum((high - low) / (_POSTERIOR - 1), _PRECISION)
            position = ((selected - low[row]) / cell[row] + 0.5).astype(np.intp)
            mass = np.bincount(start + np.minimum(position, _POSTERIOR - 1), heavy, with_weight.size * _POSTERIOR)
            at = _crossed(np.asarray(mass.reshape(-1, _POSTERIOR), np.float64))
            quantiles[name][with_weight] = low[:, None] + cell[:, None] * (at - 0.5)
    return quantiles


def _crossed(mass: Floats) -> Floats:
    """Return where the sum of each row (n, n_cells) reaches each of `LEVELS` of the whole [cells], (n, n_levels)."""
    below = np.cumsum(mass, axis=1)
    below /= below[:, -1:]
    # One search for all rows: each is shifted by one above the previous row.
    floor = np.arange(len(mass))[:, None]
    at = np.searchsorted((below + floor).ravel(), (LEVELS + floor).ravel()).reshape(len(mass), -1)
    at = np.clip(at - floor * mass.shape[1], 0, mass.shape[1] - 1)
    upper = np.take_along_axis(below, at, axis=1)
    lower = np.where(at > 0, np.take_along_axis(below, np.maximum(at - 1, 0), axis=1), 0.0)
    return np.asarray(at + np.clip((LEVELS - lower) / np.maximum(upper - lower, 1e-300), 0, 1))

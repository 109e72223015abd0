"""The density of the pulses of a population, and the probability of signals under it.

Peak and duration over those of the shape are the scales of an impact, `P0 = K L^(3/2)` and `T0 = L / v`, which do not
depend on the loss. So their density and that of the shape are separate smoothed histograms of samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from studies.impactor.likelihood import Profile
from studies.impactor.pulses import dimensionless_logarithms

#: Nodes along each of peak and duration at a node of a profile.
_HERMITE = 3
#: Cells of a prior's histograms, and the standard deviation of the smoothing in cells.
_CELLS, _SMOOTHING = 240, 1.2
#: Minimum density over the maximum: draws cannot exclude anything completely.
_FLOOR = 1e-9


@dataclass(frozen=True, eq=False)
class Prior:
    """Density of the pulses of one population."""

    # ln of the density of (ln P0 - 2 ln T0, ln T0), (n_cells, n_cells); the first is independent of size
    log_scales: Floats
    scale_edges: tuple[Floats, Floats]  # first edge and width of its cells, each (2,)
    log_shape: Floats  # ln of the density of s = ln e, (n_cells,)
    shape_edges: tuple[float, float]  # first edge and width of its cells

    @classmethod
    def from_draws(cls, log_peak: Floats, log_duration: Floats, restitution: Floats) -> Prior:
        """Return the density of samples, each (n,), whose restitution is independent of the other two."""
        log_peak, log_duration, restitution = validation.broadcast(
            log_peak=validation.real("log_peak", log_peak),
            log_duration=validation.real("log_duration", log_duration),
            restitution=validation.positive("restitution", restitution),
        )
        shape = np.log(restitution)
        size_free, time = _scales(log_peak, log_duration, shape)
        points = np.stack([size_free, time], axis=1)
        low, high = points.min(axis=0), points.max(axis=0)
        margin = np.maximum(0.03 * (high - low), 1e-3)
        low, high = low - margin, high + margin
        counts, _, _ = np.histogram2d(size_free, time, bins=_CELLS, range=list(zip(low, high, strict=True)))
        width = (high - low) / _CELLS
        shape_low, shape_high = float(shape.min()), float(shape.max())
        shape_margin = max(0.02 * (shape_high - shape_low), 1e-3)
        shape_low, shape_high = shape_low - shape_margin, min(shape_high + shape_margin, 0.0 + shape_margin)
        shape_counts, _ = np.histogram(shape, bins=_CELLS, range=(shape_low, shape_high))
        shape_width = (shape_high - shape_low) / _CELLS
        return cls(
            _log_density(counts, width.prod()),
            (low, width),
            _log_density(shape_counts, shape_width),
            (shape_low, shape_width),
        )

    @property
    def shape_bounds(self) -> tuple[float, float]:
        """Lowest and highest shape with a density above the floor."""
        inside = np.flatnonzero(self.log_shape > self.log_shape.max() + np.log(_FLOOR) + 1)
        first, width = self.shape_edges
        return first + width * float(inside[0]), first + width * float(inside[-1] + 1)

    def log_density(self, log_peak: Floats, log_duration: Floats, shape: Floats) -> Floats:
        """Return ln of the density of (ln peak, ln duration, s) at points of any common shape."""
        size_free, time = _scales(log_peak, log_duration, shape)
        low, width = self.scale_edges
        first, step = self.shape_edges
        scales = _at(self.log_scales, (size_free - low[0]) / width[0], (time - low[1]) / width[1])
        return scales + _at(self.log_shape, (shape - first) / step)

    def evidence(
        self, along: Profile, log_peak_offset: Floats | float = 0.0, log_time_offset: Floats | float = 0.0
    ) -> Floats:
        """Return ln of the probability of each signal, plus a constant; offsets shift ln peak and ln duration."""
        from scipy.special import logsumexp

        return np.asarray(logsumexp(self._joint(along, log_peak_offset, log_time_offset), axis=1))

    def _joint(self, along: Profile, log_peak_offset: Floats | float, log_time_offset: Floats | float) -> Floats:
        """Return ln of likelihood times prior, whose mean over peak and duration is by Gauss-Hermite quadrature."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(_HERMITE)
        log_peak, log_duration = along.log_peak + log_peak_offset, along.log_duration + log_time_offset
        density = np.zeros(along.shape.shape)
        for x, outer in zip(nodes, weights / weights.sum(), strict=True):
            for y, inner in zip(nodes, weights / weights.sum(), strict=True):
                at = self.log_density(
                    log_peak + along.peak_deviation * x,
                    log_duration + along.cross * x + along.duration_deviation * y,
                    along.shape,
                )
                density += outer * inner * np.exp(at)
        with np.errstate(divide="ignore"):
            return np.asarray(along.log_weight + np.log(density))


def _scales(log_peak: Floats, log_duration: Floats, shape: Floats) -> tuple[Floats, Floats]:
    """Return ln P0 - 2 ln T0 and ln T0."""
    contact, peak = dimensionless_logarithms(shape, "contact", "peak")
    time = log_duration - contact
    return log_peak - peak - 2 * time, time


def _log_density(counts: NDArray[Any], cell: float) -> Floats:
    """Return ln of the density of a smoothed histogram."""
    from scipy.ndimage import gaussian_filter

    smoothed = gaussian_filter(counts, _SMOOTHING, mode="constant", radius=4, output=np.float64)
    density = smoothed / smoothed.sum() / cell
    return np.asarray(np.log(np.maximum(density, _FLOOR * density.max())))


def _at(values: Floats, *positions: Floats) -> Floats:
    """Return values of cells at positions [cells], linear between their middles; the floor beyond the cells."""
    from scipy.ndimage import map_coordinates

    beyond = np.any([(position < 0) | (position > _CELLS) for position in positions], axis=0)
    interpolated: Floats = map_coordinates(values, [position - 0.5 for position in positions], order=1, mode="nearest")
    return np.where(beyond, values.max() + np.log(_FLOOR), interpolated)

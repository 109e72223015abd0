"""Fitted pulses as input of the posterior of an impactor, from forces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.template import MAX_SHAPE, MIN_SHAPE, relative_times
from studies.impactor.estimation import FAMILY_LIMIT, Estimates

#: A pulse whose peak, over the clipping level, minus 1, exceeds this is a guess.
OVERLOAD_LIMIT = 1.0
#: Smallest accepted standard deviation of the logarithms.
_FINEST = 1e-4
#: Largest accepted one.
_COARSEST = 3.0


@dataclass(frozen=True, eq=False)
class MeasuredPulses:
    """Fitted pulses, one row per impact.

    Attributes
    ----------
    log_peak : ndarray, (n,)
        ln of the peak [N].
    log_width : ndarray, (n,)
        ln of impulse over peak [s].
    shape : ndarray, (n,)
        s = ln e; above 0 for a pulse that rises more slowly than it falls.
    covariance : ndarray, (n, 3, 3)
        Of these; widened by the misfit where that is above 1.
    problem : ndarray of str, (n,)
        Why a pulse is not informative; else empty.
    usable : ndarray of bool, (n,)
        Whether a pulse is informative.
    """

    log_peak: Floats
    log_width: Floats
    shape: Floats
    covariance: Floats
    problem: NDArray[np.str_]
    usable: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.shape)

    def blocks(self, n_rows: int) -> Iterator[MeasuredPulses]:
        """Yield the pulses in blocks."""
        for first in range(0, len(self), n_rows):
            yield self.rows(slice(first, first + n_rows))

    def rows(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> MeasuredPulses:
        """Return some of the pulses."""
        return MeasuredPulses(**{one.name: getattr(self, one.name)[rows] for one in fields(self)})

    def without(self, failed: dict[int, str]) -> MeasuredPulses:
        """Return the pulses with some rows marked as unusable, for these reasons."""
        problem, usable = self.problem.astype(object), self.usable.copy()
        for row, why in failed.items():
            problem[row], usable[row] = why, False
        return replace(self, problem=problem.astype(np.str_), usable=usable)

    @classmethod
    def of_estimates(cls, estimates: Estimates) -> MeasuredPulses:
        """Return pulses fitted by `studies.impactor.estimation.estimate` to forces [N].

        The covariance is multiplied by the misfit (Birge 1932, Phys. Rev. 40, 207).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            shape = np.clip(np.log(estimates.restitution), MIN_SHAPE, MAX_SHAPE)
            relative, _, slope, *_ = relative_times(shape)
            log_width, log_peak = np.log(estimates.contact_duration / relative), np.log(estimates.peak)
        keep = [0, 1, 3]
        covariance = estimates.covariance[:, keep][:, :, keep].copy()
        misfit = np.nan_to_num(estimates.misfit, nan=np.inf)
        # From ln(duration) to ln(width).
        slope_ratio = slope / relative
        with np.errstate(invalid="ignore"):  # non-finite values are refused below
            covariance[:, 1] -= slope_ratio[:, None] * covariance[:, 2]
            covariance[:, :, 1] -= slope_ratio[:, None] * covariance[:, :, 2]
            covariance *= np.maximum(misfit, 1.0)[:, None, None]
        sound = np.isfinite(log_peak) & np.isfinite(log_width) & np.isfinite(shape)
        sound &= np.isfinite(covariance).all(axis=(1, 2)) & (covariance[:, range(3), range(3)] >= 0).all(axis=1)
        vague = sound & (covariance[:, range(2), range(2)] > _COARSEST**2).any(axis=1)
        problem = estimates.problem.astype(object)
        # The steps of the fit may end before it has converged: it is then near the optimum, within its error.
        for rows, why in (
            (~sound, "the fit of the pulse failed"),
            (vague, "the pulse determines neither peak nor width"),
            (misfit > FAMILY_LIMIT, "the pulse is not of the family (misfit {0:.3g}, {1:g} is the limit)"),
            (
                estimates.overload > OVERLOAD_LIMIT,
                "saturated: the fitted peak exceeds the clipping level {2:.3g} times; increase the range",
            ),
        ):
            for row in np.flatnonzero(rows & (estimates.problem == "")):
                problem[row] = why.format(misfit[row], FAMILY_LIMIT, estimates.overload[row] + 1)
        bad = ~sound | vague
        covariance[bad] = np.eye(3)
        covariance[:, range(3), range(3)] += _FINEST**2
        log_peak, log_width, shape = (np.where(bad, 0.0, one) for one in (log_peak, log_width, shape))
        return cls(log_peak, log_width, shape, covariance, problem.astype(np.str_), problem == "")

"""Fitted pulses as the posterior of a striker takes them, from forces or from the acceleration of a beam."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.identification.contact import Contact
from cgid.identification.estimation import FAMILY_LIMIT, Estimates
from cgid.measure.template import HIGHEST_SHAPE, LOWEST_SHAPE, relative_times
from cgid.validation import Floats

#: A pulse of more than this peak, over the level where it is cut off, minus 1, is a guess.
OVERLOAD_LIMIT = 1.0
#: Above this misfit nothing of the family is left, and no widening makes it an estimate.
HOPELESS = 400.0
#: Smallest and largest standard deviation of the logarithms that are believed.
_FINEST, _COARSEST = 1e-4, 3.0


@dataclass(frozen=True, eq=False)
class MeasuredPulses:
    """Fitted pulses, one row an impact.

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
        Why a pulse says nothing or less than it could; else empty.
    usable : ndarray of bool, (n,)
        Whether a pulse says anything.
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
        """Yield the pulses so many at a time."""
        for first in range(0, len(self), n_rows):
            yield self.rows(slice(first, first + n_rows))

    def rows(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> MeasuredPulses:
        """Return some of the pulses."""
        held = (self.log_peak, self.log_width, self.shape, self.covariance, self.problem, self.usable)
        return MeasuredPulses(*(one[rows] for one in held))

    @classmethod
    def of_estimates(cls, estimates: Estimates) -> MeasuredPulses:
        """Return pulses fitted by `cgid.identification.estimation.estimate` to forces [N].

        The covariance times the misfit: what the family leaves of other laws of loss is an error like noise (Birge
        1932, Phys. Rev. 40, 207).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            shape = np.clip(np.log(estimates.restitution), LOWEST_SHAPE, HIGHEST_SHAPE)
            duration, _, slope, _ = relative_times(shape)
            log_width = np.log(estimates.contact_duration) - np.log(duration)
            log_peak = np.log(estimates.peak)
        keep = [0, 1, 3]
        covariance = estimates.covariance[:, keep][:, :, keep].copy()
        # From ln(duration) to ln(width).
        turn = slope / duration
        covariance[:, 1] -= turn[:, None] * covariance[:, 2]
        covariance[:, :, 1] -= turn[:, None] * covariance[:, :, 2]
        problem = np.full(len(shape), "", object)
        loose = estimates.misfit > FAMILY_LIMIT
        problem[loose] = [f"wide: the pulse is not of the family (misfit {one:.3g})" for one in estimates.misfit[loose]]
        for rows, why in (
            (estimates.misfit > HOPELESS, "the pulse is not of the family (misfit {0.misfit:.3g})"),
            (
                estimates.overload > OVERLOAD_LIMIT,
                "saturated: the fitted peak is {0.overload:.3g} times above the level where samples are cut off; "
                "raise the range of the recorder",
            ),
            (~estimates.converged, "the fit did not converge"),
        ):
            for row in np.flatnonzero(rows):
                problem[row] = why.format(_Row(float(estimates.misfit[row]), float(estimates.overload[row])))
        usable = estimates.converged & (estimates.overload <= OVERLOAD_LIMIT) & (estimates.misfit <= HOPELESS)
        covariance *= np.maximum(estimates.misfit, 1.0)[:, None, None]
        return cls._checked(log_peak, log_width, shape, covariance, problem, usable)

    @classmethod
    def of_contact(cls, contact: Contact) -> MeasuredPulses:
        """Return pulses fitted to forces behind a beam; their covariance is widened already."""
        n = len(contact.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_peak, log_width = np.log(contact.peak), np.log(contact.width)
        problem = np.full(n, "", object)
        return cls._checked(log_peak, log_width, contact.shape, contact.covariance.copy(), problem, np.ones(n, bool))

    @classmethod
    def _checked(
        cls,
        log_peak: Floats,
        log_width: Floats,
        shape: Floats,
        covariance: Floats,
        problem: NDArray[np.object_],
        usable: NDArray[np.bool_],
    ) -> MeasuredPulses:
        """Return pulses; what is not finite, or tells nothing, is replaced and not usable."""
        diagonal = covariance[:, range(3), range(3)]
        sound = np.isfinite(log_peak) & np.isfinite(log_width) & np.isfinite(shape)
        sound &= np.isfinite(covariance).all(axis=(1, 2)) & (diagonal >= 0).all(axis=1)
        vague = sound & (diagonal[:, :2] > _COARSEST**2).any(axis=1)
        problem[~sound & (problem == "")] = "the fit of the pulse failed"
        problem[vague & (problem == "")] = "the pulse tells neither peak nor width"
        usable = usable & sound & ~vague
        bad = ~(sound & ~vague)
        covariance[bad] = np.eye(3)
        covariance[:, range(3), range(3)] += _FINEST**2
        log_peak, log_width, shape = (np.where(bad, 0.0, one) for one in (log_peak, log_width, shape))
        return cls(log_peak, log_width, shape, covariance, problem.astype(np.str_), usable)


@dataclass(frozen=True)
class _Row:
    """The numbers of a message."""

    misfit: float
    overload: float

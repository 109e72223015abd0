"""Fitted pulses as the posterior of an impactor takes them, from forces or from the acceleration of a beam."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cgid.identification.contact import Contact
from cgid.identification.estimation import FAMILY_LIMIT, Estimates
from cgid.identification.inversion import ForceEstimate
from cgid.measure.fit import PulseFit
from cgid.measure.pulses import PulseBatch
from cgid.measure.template import MAX_SHAPE, MIN_SHAPE, relative_times
from cgid.validation import Floats

#: A pulse of more than this peak, over the level where it is cut off, minus 1, is a guess.
OVERLOAD_LIMIT = 1.0
#: Above this misfit nothing of the family is left, and no widening makes it an estimate.
HOPELESS = 400.0
#: What ln peak, ln width and shape of pulses of the laws of Thornton, Walton and Kuwabara are, less those of the damped
#: Hertz pulse of the same sphere and speed: mean and deviation in scene `rock` (`benchmarks/impactor.py`). Peak and
#: width vary together, because their product is the impulse, `(1 + e) m v`: with this correlation.
OTHER_LAWS, OTHER_DEVIATIONS, OTHER_CORRELATION = (-0.51, 0.49, 0.99), (0.44, 0.39, 0.40), -0.98
#: Smallest and largest standard deviation of the logarithms that are believed.
_FINEST, _COARSEST = 1e-4, 3.0
#: Standard deviations of ln peak, ln width and shape by which pulses fitted through a beam differ from the closest
#: ones of the family where the beam's own waves come back during contact (`benchmarks/impactor.py`).
_BEHIND_BEAM = (0.005, 0.01, 0.08)
#: Error of ln peak for what the beam leaves unexplained, over the root of its share of the energy, the largest, those
#: of ln peak, ln width and shape over it, and from which on it is told: so that the intervals of scene `caving` cover.
_UNEXPLAINED, _MAX_ERROR, _SHARES, _MIN_INFORMATION = 4.0, 1.2, (1.0, 0.6, 0.8), 0.2


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
    strange : ndarray of bool, (n,)
        Whether the samples show that the pulse is not of the family.
    """

    log_peak: Floats
    log_width: Floats
    shape: Floats
    covariance: Floats
    problem: NDArray[np.str_]
    usable: NDArray[np.bool_]
    strange: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.shape)

    def blocks(self, n_rows: int) -> Iterator[MeasuredPulses]:
        """Yield the pulses so many at a time."""
        for first in range(0, len(self), n_rows):
            yield self.rows(slice(first, first + n_rows))

    def rows(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> MeasuredPulses:
        """Return some of the pulses."""
        return MeasuredPulses(**{one.name: getattr(self, one.name)[rows] for one in fields(self)})

    @classmethod
    def joined(cls, parts: list[MeasuredPulses]) -> MeasuredPulses:
        """Return the pulses of all parts."""
        return cls(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)))

    @classmethod
    def failed(cls, reasons: list[str]) -> MeasuredPulses:
        """Return pulses that could not be measured, for these reasons."""
        n = len(reasons)
        nothing, never = np.zeros(n), np.zeros(n, bool)
        covariance = np.broadcast_to(np.eye(3), (n, 3, 3))
        return cls(nothing, nothing, nothing, covariance, np.array(reasons, np.str_), never, never)

    def without(self, failed: dict[int, str]) -> MeasuredPulses:
        """Return the pulses, of which some rows are not usable, for these reasons."""
        problem, usable = self.problem.astype(object), self.usable.copy()
        for row, why in failed.items():
            problem[row], usable[row] = why, False
        return replace(self, problem=problem.astype(np.str_), usable=usable)

    def widened(self) -> MeasuredPulses:
        """Return the pulses as a population of the family alone must see them.

        Those that are not of the family become the damped Hertz pulses that other laws may stand for, and wide.
        """
        wide = np.diag(np.square(OTHER_DEVIATIONS))
        wide[0, 1] = wide[1, 0] = OTHER_CORRELATION * OTHER_DEVIATIONS[0] * OTHER_DEVIATIONS[1]
        log_peak, log_width, shape = (
            values - self.strange * shift
            for values, shift in zip((self.log_peak, self.log_width, self.shape), OTHER_LAWS, strict=True)
        )
        covariance = self.covariance + self.strange[:, None, None] * wide
        return replace(self, log_peak=log_peak, log_width=log_width, shape=shape, covariance=covariance)

    @classmethod
    def of_estimates(cls, estimates: Estimates) -> MeasuredPulses:
        """Return pulses fitted by `cgid.identification.estimation.estimate` to forces [N].

        The covariance times the misfit: what the family leaves of other laws of loss is an error like noise (Birge
        1932, Phys. Rev. 40, 207).
        """
        return cls._of_fit(estimates.contact_duration, np.log(estimates.restitution), estimates, estimates.overload, {})

    @classmethod
    def of_frames(cls, pulses: PulseBatch) -> MeasuredPulses:
        """Return the pulses fitted to frames of force [N]; a frame that cannot be fitted is not usable."""
        fit = pulses.fit
        return cls._of_fit(fit.duration / pulses.sampling_rate, fit.shape, fit, pulses.overload, pulses.fit_problems())

    @classmethod
    def _of_fit(
        cls, duration: Floats, shape: Floats, fit: Estimates | PulseFit, overload: Floats, failed: dict[int, str]
    ) -> MeasuredPulses:
        """Return pulses of contact durations [s], shapes, a fit, overloads, and why some rows have none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            shape = np.clip(shape, MIN_SHAPE, MAX_SHAPE)
            relative, _, slope, _ = relative_times(shape)
            log_width, log_peak = np.log(duration) - np.log(relative), np.log(fit.peak)
        keep = [0, 1, 3]
        covariance = fit.covariance[:, keep][:, :, keep].copy()
        # From ln(duration) to ln(width).
        slope_ratio = slope / relative
        with np.errstate(invalid="ignore"):  # what is not finite is refused below
            covariance[:, 1] -= slope_ratio[:, None] * covariance[:, 2]
            covariance[:, :, 1] -= slope_ratio[:, None] * covariance[:, :, 2]
        problem = np.full(len(shape), "", object)
        misfit = np.nan_to_num(fit.misfit, nan=np.inf)
        strange, hopeless, saturated = misfit > FAMILY_LIMIT, misfit > HOPELESS, overload > OVERLOAD_LIMIT
        for rows, why in (
            (strange, "wide: the pulse is not of the family (misfit {0:.3g}, {2:g} is the limit)"),
            (hopeless, "the pulse is not of the family (misfit {0:.3g}, {3:g} is the limit)"),
            (
                saturated,
                "saturated: the fitted peak is {1:.3g} times above the level where samples are cut off; raise the "
                "range of the recorder",
            ),
            (~fit.converged, "the fit of the pulse failed"),
        ):
            for row in np.flatnonzero(rows):
                problem[row] = why.format(misfit[row], overload[row], FAMILY_LIMIT, HOPELESS)
        usable = fit.converged & ~saturated & ~hopeless
        usable[list(failed)] = False
        problem[list(failed)] = list(failed.values())
        covariance *= np.maximum(misfit, 1.0)[:, None, None]
        return cls._checked(log_peak, log_width, shape, covariance, problem, usable, strange)

    @classmethod
    def of_contact(cls, contact: Contact, inverted: ForceEstimate) -> MeasuredPulses:
        """Return pulses fitted to forces behind a beam, which are widened by their misfit already.

        What the beam leaves unexplained beyond the noise, such as another impact, is an error of the pulse, too.
        """
        n = len(contact.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_peak, log_width = np.log(contact.peak), np.log(contact.width)
            strange = inverted.unexplained * np.clip(1 - 1 / inverted.misfit, 0.0, 1.0)
        error = np.minimum(_UNEXPLAINED * np.sqrt(np.nan_to_num(strange)), _MAX_ERROR)
        covariance = contact.covariance + np.diag(np.square(_BEHIND_BEAM))
        covariance += np.square(error)[:, None, None] * np.diag(np.square(_SHARES))
        problem = np.full(n, "", object)
        for row in np.flatnonzero(error > _MIN_INFORMATION):
            problem[row] = f"wide: the beam leaves {100 * strange[row]:.2g} % of the vibration unexplained"
        # Place and force of what is no likelier than noise alone are arbitrary.
        seen = inverted.evidence > 0
        problem[~seen] = "no blow anywhere on the beam explains the vibration better than noise does"
        return cls._checked(log_peak, log_width, contact.shape, covariance, problem, seen, np.zeros(n, bool))

    @classmethod
    def _checked(
        cls,
        log_peak: Floats,
        log_width: Floats,
        shape: Floats,
        covariance: Floats,
        problem: NDArray[np.object_],
        usable: NDArray[np.bool_],
        strange: NDArray[np.bool_],
    ) -> MeasuredPulses:
        """Return pulses; what is not finite, or uninformative, is replaced and not usable."""
        diagonal = covariance[:, range(3), range(3)]
        sound = np.isfinite(log_peak) & np.isfinite(log_width) & np.isfinite(shape)
        sound &= np.isfinite(covariance).all(axis=(1, 2)) & (diagonal >= 0).all(axis=1)
        vague = sound & (diagonal[:, :2] > _COARSEST**2).any(axis=1)
        problem[~sound & usable] = "the fit of the pulse failed"
        problem[vague & (problem == "")] = "the pulse tells neither peak nor width"
        usable = usable & sound & ~vague
        bad = ~(sound & ~vague)
        covariance[bad] = np.eye(3)
        covariance[:, range(3), range(3)] += _FINEST**2
        log_peak, log_width, shape = (np.where(bad, 0.0, one) for one in (log_peak, log_width, shape))
        return cls(log_peak, log_width, shape, covariance, problem.astype(np.str_), usable, strange)

"""Fitted pulses as input of the posterior of an impactor, from forces or from the acceleration of a beam."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.contact import Contact
from cgid.identification.inversion.inversion import ForceEstimate
from cgid.measure.features.pulses import PulseBatch
from cgid.measure.fit.fit import PulseFit
from cgid.measure.fit.template import MAX_SHAPE, MIN_SHAPE, relative_times
from studies.impactor.estimation import FAMILY_LIMIT, Estimates, with_baseline_error

#: A pulse whose peak, over the clipping level, minus 1, exceeds this is a guess.
OVERLOAD_LIMIT = 1.0
#: Above this misfit a pulse is not of the family, and widening cannot make it an estimate.
HOPELESS = 400.0
#: ln peak, ln width and shape of pulses of the laws of Thornton, Walton and Kuwabara, minus those of the damped Hertz
#: pulse of the same sphere and speed: mean and standard deviation in scene `rock` (`benchmarks/beam/impactor.py`). Peak
#: and width vary together, because their product is the impulse, `(1 + e) m v`: with this correlation.
OTHER_LAWS, OTHER_DEVIATIONS, OTHER_CORRELATION = (-0.51, 0.49, 0.99), (0.44, 0.39, 0.40), -0.98
#: Smallest and largest accepted standard deviation of the logarithms.
_FINEST, _COARSEST = 1e-4, 3.0
#: Standard deviations of ln peak, ln width and shape by which pulses fitted through a beam differ from the closest ones
#: of the family when waves of the beam return during contact (`benchmarks/beam/impactor.py`).
_THROUGH_BEAM = (0.005, 0.01, 0.08)
#: Error of ln peak due to the unexplained energy, over the root of its fraction; its maximum; errors of ln peak, ln
#: width and shape over it; and the fraction from which on it is reported. With these the intervals of scene `caving`
#: have their coverage.
_UNEXPLAINED, _MAX_ERROR, _ERROR_RATIOS, _MIN_INFORMATION = 4.0, 1.2, (1.0, 0.6, 0.8), 0.2


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
        Why a pulse is uninformative or less informative; else empty.
    usable : ndarray of bool, (n,)
        Whether a pulse is informative.
    strange : ndarray of bool, (n,)
        Whether the pulse is not of the family.
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
        """Yield the pulses in blocks."""
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
        """Return the pulses with some rows marked as unusable, for these reasons."""
        problem, usable = self.problem.astype(object), self.usable.copy()
        for row, why in failed.items():
            problem[row], usable[row] = why, False
        return replace(self, problem=problem.astype(np.str_), usable=usable)

    def widened(self) -> MeasuredPulses:
        """Return the pulses for a population of the family; other laws become damped Hertz pulses with wide errors."""
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
        """Return pulses fitted by `studies.impactor.estimation.estimate` to forces [N].

        The covariance is multiplied by the misfit: the deviation of other laws of loss is treated like noise (Birge
        1932, Phys. Rev. 40, 207).
        """
        failed = {row: str(estimates.problem[row]) for row in np.flatnonzero(estimates.problem != "").tolist()}
        shape = np.log(estimates.restitution)
        return cls._of_fit(estimates.contact_duration, shape, estimates, estimates.overload, failed)

    @classmethod
    def of_frames(cls, pulses: PulseBatch) -> MeasuredPulses:
        """Return the pulses fitted to frames of force [N]; a frame that cannot be fitted is not usable."""
        failed = {row: problem.text for row, problem in pulses.fit_problems().items()}
        fit = with_baseline_error(pulses.fit, pulses.noise, pulses.n_quiet)
        return cls._of_fit(fit.duration / pulses.sampling_rate, fit.shape, fit, pulses.overload, failed)

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
        with np.errstate(invalid="ignore"):  # non-finite values are refused below
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
                f"saturated: the fitted peak exceeds the clipping level {1:.3g} times; increase the range of the "
                "recorder",
            ),
        ):
            for row in np.flatnonzero(rows):
                problem[row] = why.format(misfit[row], overload[row], FAMILY_LIMIT, HOPELESS)
        # The steps of the fit may end before it has converged: it is then near the optimum, within its error.
        usable = ~saturated & ~hopeless
        usable[list(failed)] = False
        problem[list(failed)] = list(failed.values())
        covariance *= np.maximum(misfit, 1.0)[:, None, None]
        return cls._checked(log_peak, log_width, shape, covariance, problem, usable, strange)

    @classmethod
    def of_contact(cls, contact: Contact, inverted: ForceEstimate) -> MeasuredPulses:
        """Return pulses fitted to forces through a beam, whose covariance already includes the misfit.

        Energy beyond the noise that the beam does not explain, such as another impact, is an error of the pulse, too.
        """
        n = len(contact.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_peak, log_width = np.log(contact.peak), np.log(contact.width)
            strange = inverted.unexplained * np.clip(1 - 1 / inverted.misfit, 0.0, 1.0)
        error = np.minimum(_UNEXPLAINED * np.sqrt(np.nan_to_num(strange)), _MAX_ERROR)
        covariance = contact.covariance + np.diag(np.square(_THROUGH_BEAM))
        covariance += np.square(error)[:, None, None] * np.diag(np.square(_ERROR_RATIOS))
        problem = np.full(n, "", object)
        for row in np.flatnonzero(error > _MIN_INFORMATION):
            problem[row] = f"wide: the beam leaves {100 * strange[row]:.2g} % of the vibration unexplained"
        # Location and force of an event no likelier than noise are arbitrary.
        seen = inverted.evidence > 0
        problem[~seen] = "no impact anywhere on the beam explains the vibration better than noise"
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
        """Return pulses; non-finite or uninformative ones are replaced and marked as unusable."""
        diagonal = covariance[:, range(3), range(3)]
        sound = np.isfinite(log_peak) & np.isfinite(log_width) & np.isfinite(shape)
        sound &= np.isfinite(covariance).all(axis=(1, 2)) & (diagonal >= 0).all(axis=1)
        vague = sound & (diagonal[:, :2] > _COARSEST**2).any(axis=1)
        problem[~sound & usable] = "the fit of the pulse failed"
        problem[vague & usable] = "the pulse determines neither peak nor width"
        usable = usable & sound & ~vague
        bad = ~(sound & ~vague)
        covariance[bad] = np.eye(3)
        covariance[:, range(3), range(3)] += _FINEST**2
        log_peak, log_width, shape = (np.where(bad, 0.0, one) for one in (log_peak, log_width, shape))
        return cls(log_peak, log_width, shape, covariance, problem.astype(np.str_), usable, strange)

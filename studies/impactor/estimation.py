"""Parameters of pulses by maximum likelihood.

The fitted restitution is the shape of the pulse, how much faster it rises than it falls. For a sphere on a half space
it is the restitution of the impact; on recordings of real shocks it varies with the mounting and describes the pulse.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, require_rate
from cgid.errors import BadData, InvalidValue
from cgid.measure.features.pulses import PulseBatch
from cgid.measure.fit.fit import MODEL_ERROR, PulseFit, fit_pulses, without_impact
from cgid.measure.fit.template import relative_times
from cgid.measure.frames import LARGEST, frames_of

#: Rows processed at once.
_ROWS = 512
#: If the squared residual is more than this many times that of the noise, the pulse is not of the family.
FAMILY_LIMIT = 2.5


@dataclass(frozen=True, eq=False)
class Estimates:
    """Fitted damped-Hertz pulses, one per row, in the unit of the signal and seconds.

    Attributes
    ----------
    peak, contact_duration : ndarray, (n,)
    onset : ndarray, (n,) [s]
        Time of onset after the first sample.
    restitution : ndarray, (n,)
        Above 1 for a pulse that rises more slowly than it falls.
    covariance : ndarray, (n, 4, 4)
        Covariance of ln(peak), ln(contact duration), onset [s] and ln(restitution), with the error of a baseline that
        was removed.
    restitution_deviation : ndarray, (n,)
        Standard deviation of the restitution; from the likelihood of all shapes if it is not a parabola, so that it
        includes a second likely shape.
    misfit : ndarray, (n,)
        Squared residual over that of the noise, about 1 for a pulse of the family.
    overload : ndarray, (n,)
        Peak over the clipping level, minus 1; 0 without clipping.
    converged : ndarray of bool, (n,)
    problem : ndarray of str, (n,)
        Why a signal has no impact; else empty.
    """

    peak: Floats
    contact_duration: Floats
    onset: Floats
    restitution: Floats
    covariance: Floats
    restitution_deviation: Floats
    misfit: Floats
    overload: Floats
    converged: NDArray[np.bool_]
    problem: NDArray[np.str_]

    @property
    def of_family(self) -> NDArray[np.bool_]:
        """Whether the pulse may be a damped-Hertz pulse: `misfit` at most `FAMILY_LIMIT`."""
        return np.asarray(self.misfit <= FAMILY_LIMIT)


def estimate(
    samples: ArrayLike,
    sampling_rate: float,
    *,
    pre_trigger: int | None = None,
    noise: ArrayLike | None = None,
    remove_baseline: bool = True,
    clip_level: ArrayLike | None = None,
    invalid: Literal["raise", "nan"] = "raise",
) -> Estimates:
    """Fit the most likely damped-Hertz pulse to each signal.

    Least squares under white noise, the global optimum. Clipped samples count as "at least this value".

    Parameters
    ----------
    samples : array_like, (n_samples,) or (n_signals, n_samples)
        One positive pulse per row.
    sampling_rate : float
        [Hz].
    pre_trigger : int, optional
        Samples before onset, whose mean is the baseline and whose standard deviation is the noise; by default all up to
        the foot of the pulse.
    noise : float or array_like, (n_signals,), optional
        Standard deviation of the noise, if known and white; by default its level and colour are those of the samples
        before onset.
    remove_baseline : bool
        Whether to subtract the mean before onset first.
    clip_level : float or array_like, (n_signals,), optional
        Limit of the sensor; by default the top level that at least three samples share.
    invalid : {"raise", "nan"}
        Treatment of a signal without impact; `Estimates.problem` has the reason of a row of nan.

    Returns
    -------
    Estimates

    Raises
    ------
    BadData
        Samples are not finite rows of numbers, or a signal has no impact.
    InvalidValue
        A number breaks its rule, or numbers are masked.

    Examples
    --------
    >>> t = np.arange(400) / 2e5
    >>> pulse = 800 * np.sin(np.pi * np.clip((t - 6e-4) / 5e-4, 0, 1)) ** 1.5
    >>> found = estimate(pulse, 2e5)
    >>> [round(float(x[0]), 3) for x in (found.peak, found.contact_duration * 1e3, found.restitution)]
    [805.24, 0.509, 1.0]
    """
    frames, rate = frames_of(samples, pre_trigger).astype(np.float64, copy=False), require_rate(sampling_rate)
    n = frames.shape[0]
    given_noise = None if noise is None else _each("noise", validation.between("noise", noise, 0, LARGEST), n)
    limit = None if clip_level is None else _each("clip_level", validation.positive("clip_level", clip_level), n)
    validation.choice("invalid", invalid, ("raise", "nan"))
    parts, overloads, problem = [PulseFit.nothing()], [np.empty(0)], np.full(n, "", object)
    for first in range(0, n, _ROWS):
        block = slice(first, first + _ROWS)
        pulses = PulseBatch(frames[block], rate, pre_trigger, remove_baseline).uncoupled()
        level = pulses.clip_level if limit is None else limit[block] - pulses.offset
        parts.append(
            fit_pulses(
                pulses.samples,
                pulses.fit_start,
                pulses.noise if given_noise is None else given_noise[block],
                offset=pulses.offset,
                clip_level=level,
                n_quiet=pulses.n_quiet if given_noise is None else None,
            )
        )
        if remove_baseline:
            level_noise = pulses.noise if given_noise is None else given_noise[block]
            parts[-1] = with_baseline_error(parts[-1], level_noise, pulses.n_quiet)
        failures = without_impact(pulses.samples, parts[-1])
        if failures and invalid == "raise":
            row = min(failures)
            raise BadData(f"signal {first + row}: {failures[row].text}" if n > 1 else failures[row].text)
        for row, failure in failures.items():
            problem[first + row] = failure.text
        cut = parts[-1].clipped > 0
        overloads.append(np.where(cut, parts[-1].peak / (level if level is not None else 1.0) - 1, 0.0).clip(0.0))
    fit = PulseFit.joined(parts)
    covariance = fit.covariance.copy()
    covariance[:, 2] /= rate
    covariance[:, :, 2] /= rate
    found = Estimates(
        peak=fit.peak,
        contact_duration=fit.duration / rate,
        onset=fit.onset / rate,
        restitution=fit.restitution,
        covariance=covariance,
        restitution_deviation=fit.restitution_deviation,
        misfit=fit.misfit,
        overload=np.concatenate(overloads),
        converged=fit.converged,
        problem=problem.astype(np.str_),
    )
    for one in fields(Estimates):
        if (column := getattr(found, one.name)).dtype.kind == "f":
            column[problem != ""] = np.nan
    return found


def with_baseline_error(fit: PulseFit, noise: Floats, n_quiet: Floats) -> PulseFit:
    """Return the pulses with the error of their baseline, the mean of `n_quiet` samples (n,), in the covariance."""
    # A constant moves the parameters along the covariance times its products with the slopes of the pulse, the slopes
    # of the impulse: that of duration [samples] times peak over `relative_times`.
    with np.errstate(all="ignore"):  # a failed fit stays one
        relative, _, slope, *_ = relative_times(np.nan_to_num(fit.shape))
        impulse = fit.peak * fit.width * noise / np.sqrt(n_quiet) / (noise**2 + (MODEL_ERROR * fit.peak) ** 2)
        shift = (
            fit.covariance[:, :, 0] + fit.covariance[:, :, 1] - (slope / relative)[:, None] * fit.covariance[:, :, 3]
        )
        most = np.sqrt(np.nan_to_num(np.diagonal(fit.covariance, axis1=1, axis2=2)))
        shift = np.clip(np.nan_to_num(shift * impulse[:, None]), -most, most)  # beyond, it is not linear
        return replace(fit, covariance=fit.covariance + shift[:, :, None] * shift[:, None])


def _each(name: str, numbers: Floats, n: int) -> Floats:
    """Return one number for each of n signals."""
    if numbers.shape not in ((), (1,), (n,)):
        raise InvalidValue(f"{name} must be one number or one for each signal ({n}), got shape {numbers.shape}")
    return np.broadcast_to(numbers, (n,))

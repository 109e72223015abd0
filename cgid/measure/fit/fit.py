"""The damped-Hertz pulse fitted to samples by maximum likelihood, batched over signals.

Coloured noise is whitened first. A search of all shapes (`cgid.measure.fit.search`) precedes the fit to all samples
(`cgid.measure.fit.optimum`); `cgid.measure.fit.profile` gives standard deviations where the likelihood is no parabola.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.ar_noise import ORDER, ar_noise_of
from cgid.measure.fit.fit_samples import Selected, windows
from cgid.measure.fit.optimum import Optimum, Problems, search_nearby
from cgid.measure.fit.profile import PARABOLIC, Profiled, binned, exact, gaussian_restitution
from cgid.measure.fit.search import LAST, SearchResult, around, bank, search
from cgid.measure.fit.template import covariance_of, relative_times
from cgid.measure.frames import Problem, constant_signal, no_impact

#: Extent of the samples that the search uses, over that of the initial pulse.
_REACH = 2.0
#: Unit of the search [samples] above which its bins contain as much information as the samples.
_WELL_BINNED = 12.0
#: Highest fitted shape for which the likelihood is profiled.
_MAX_PROFILED = 0.3
#: Smallest noise over the peak: the accuracy of the template.
_NOISE_FLOOR = 1e-5
#: Deviations below this fraction of the peak count as noise in the misfit.
MODEL_ERROR = 1e-3
#: Samples outside the pulse may reach this fraction of the peak: hum, or the ringing of a filter.
STRAY = 0.03
#: Column of the frame that represents any beyond it.
_FAR = 1e9
#: A deviation of this many standard deviations outside the window counts as a misfit of 1.
_OUTLIER = 5.5
#: Smallest sum of squares that a pulse must explain, over the variance of the noise: chance explains less.
EVIDENCE = 40.0


# -- start and result of a fit ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class PulseStart:
    """Start of the search: peak, width (impulse over peak) and time of the peak [samples], each (n,)."""

    peak: Floats
    width: Floats
    peak_time: Floats

    def rows(self, selected: Selected) -> PulseStart:
        """Return some of the rows."""
        return PulseStart(self.peak[selected], self.width[selected], self.peak_time[selected])


@dataclass(frozen=True, eq=False, repr=False)
class PulseFit:
    """Fitted pulses; each attribute is (n,) unless noted, times are in samples of the frame."""

    peak: Floats  # above the baseline, in the unit of the signal
    duration: Floats
    onset: Floats
    width: Floats  # impulse over peak
    shape: Floats  # s = ln e, above 0 for a pulse that rises more slowly than it falls
    covariance: Floats  # (n, 4, 4), of `cgid.measure.fit.template.PARAMETERS`
    restitution_deviation: Floats  # of exp(s)
    expected_restitution: Floats  # mean after the fit, if it was `WIDE_RESTITUTION` before
    expected_deviation: Floats
    misfit: Floats  # reduced chi-square; more if a sample outside the pulse stands out
    stray: Floats  # largest sample outside the pulse, squared, over what noise and `STRAY` of the peak allow
    clipped: NDArray[np.intp]  # number of samples at the sensor's limit
    evidence: Floats  # sum of squares that the pulse explains, over the variance of the noise
    converged: NDArray[np.bool_]
    reach: NDArray[np.intp]  # last sample that the fit and its residual use; only the misfit uses the complete frame

    @classmethod
    def joined(cls, parts: list[PulseFit]) -> PulseFit:
        """Return the rows of all parts."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    @classmethod
    def nothing(cls) -> PulseFit:
        """Return a fit without rows."""
        none = np.empty(0)
        return cls(
            *(none,) * 5, np.empty((0, 4, 4)), *(none,) * 5, *(np.empty(0, kind) for kind in (int, float, bool, int))
        )

    def spread(self, rows: NDArray[np.intp], n: int) -> PulseFit:
        """Return n rows with these fits at `rows`; the others are nan, not clipped and not converged."""
        spread = {}
        for f in fields(self):
            values = getattr(self, f.name)
            spread[f.name] = np.full((n, *values.shape[1:]), np.nan if values.dtype.kind == "f" else 0, values.dtype)
            spread[f.name][rows] = values
        return PulseFit(**spread)

    @property
    def restitution(self) -> Floats:
        """Restitution exp(s), above 1 for a pulse that rises more slowly than it falls."""
        return np.exp(self.shape)


def without_impact(samples: NDArray[np.floating], fit: PulseFit) -> dict[int, Problem]:
    """Map each row whose fitted pulse may be chance to its problem."""
    problems: dict[int, Problem] = {}
    for row in np.flatnonzero(~(fit.evidence > EVIDENCE) | ~(fit.peak > 0)):
        explained = np.nan_to_num(fit.evidence[row])
        problems[int(row)] = no_impact(
            f"a pulse must explain {EVIDENCE:g} times the variance of the noise, the best one explains "
            f"{explained:.3g} times; if the pulse points downwards, invert the signal"
        )
        if fit.peak[row] < 0:
            problems[int(row)] = no_impact(
                f"a pulse must point upwards, the best one reaches {fit.peak[row]:.3g}; invert the signal"
            )
        if np.ptp(samples[row]) == 0:
            problems[int(row)] = constant_signal(samples[row, 0])
    return problems


# -- the fit ------------------------------------------------------------------------------------------


@np.errstate(all="ignore")  # the fit of a frame without a pulse fails; `evidence` shows it
def fit_pulses(
    samples: NDArray[np.floating],
    start: PulseStart,
    noise: Floats,
    *,
    offset: Floats | None = None,
    clip_level: Floats | None = None,
    n_quiet: Floats | None = None,
) -> PulseFit:
    """Return the most likely pulse of the damped-Hertz family in each row of samples, (n, n_samples)."""
    # `noise` (n,) is a standard deviation, white unless the first `n_quiet` (n,) samples show otherwise. `offset` (n,)
    # is subtracted first. Samples at or above `clip_level` (n,) are lower bounds.
    if not len(samples):
        return PulseFit.nothing()
    n = len(samples)
    offset = np.zeros(n) if offset is None else offset
    clip_level = np.full(n, np.inf) if clip_level is None else clip_level
    # In units of its first peak, every pulse is of order 1.
    unit = start.peak
    noise_over_peak = np.maximum(noise / unit, _NOISE_FLOOR)
    guess, reach, results = np.empty((n, 4)), np.zeros(n), []
    for rows, window_block in around(samples, start.peak_time, start.width, offset, clip_level, _REACH):
        nearby = search(window_block, start.peak_time[rows], start.width[rows])
        results.append((rows, nearby))
        guess[rows], reach[rows] = nearby.start(), window_block.reach
    parts, sigma = [], noise_over_peak.copy()
    floor = MODEL_ERROR * unit
    colour = None if n_quiet is None else ar_noise_of(samples, n_quiet, floor)
    coloured = np.empty(0, np.intp) if colour is None else colour.rows
    for rows, before in ((np.delete(np.arange(n), coloured), 0), (coloured, ORDER)):
        levels = (offset[rows], clip_level[rows], unit[rows])
        for window in windows(samples, guess[rows], *levels, before=before, among=rows):
            if before and colour is not None and n_quiet is not None:
                some = window.rows
                window.colour = colour.of(some)
                if window.run > 1:
                    window.colour = ar_noise_of(samples[some], n_quiet[some], floor[some], window.run)
                sigma[some] = window.colour.innovation / unit[some] * np.sqrt(window.run)
            parts.append(window)
    guess[:, 0] /= unit
    problems = Problems(parts)
    result = results[0][1] if len(results) == 1 else SearchResult.joined(results)
    best = search_nearby(problems, guess, sigma / np.sqrt(problems.averaged), np.arange(n))
    return _report(problems, best, sigma, noise_over_peak, unit, result, reach)


def _report(
    problems: Problems, best: Optimum, sigma: Floats, noise: Floats, unit: Floats, result: SearchResult, reach: Floats
) -> PulseFit:
    """Return the fitted pulses; `sigma`, `noise` and the parameters are in units of the start's peak."""
    variance = sigma**2 / problems.averaged
    # The accuracy of the pulse model limits the fit, however good the recorder.
    believed = variance + (MODEL_ERROR * best.parameters[:, 0]) ** 2 / problems.averaged
    covariance = covariance_of(best.information, best.parameters, believed)
    shape = best.parameters[:, 3]
    restitution = gaussian_restitution(shape, covariance[:, 3, 3])
    doubt = (covariance[:, 3, 3] > PARABOLIC**2) | result.in_doubt(believed * problems.averaged * unit**2, shape)
    doubt &= shape < _MAX_PROFILED
    well = (result.unit >= _WELL_BINNED) & ~problems.coloured
    for profiled, some in ((binned, well), (exact, ~well)):
        rows = np.flatnonzero(doubt & some)
        if rows.size:
            profile = profiled(problems, result.rows(rows), unit[rows], rows)
            tops = _improve(problems, best, profile, believed, rows)
            covariance[rows], restitution[:, rows] = profile.moments(tops, believed[rows])
    peak, log_width, peak_time, shape = best.parameters.T
    width = np.exp(log_width)
    duration, lead, *_ = relative_times(shape)
    each = [(one.largest_outside, one.reach, one.n_clipped, one.n_inside) for one in problems.windows]
    outside, end, clipped, counted = (problems.gathered(part) for part in zip(*each, strict=True))
    bin_peak_time, bin_width = bank().conditions(shape)
    reach = np.maximum(np.maximum(end, reach), peak_time + (LAST - bin_peak_time) * width / bin_width)
    freedom = np.maximum(counted - clipped - len(problems.free), 1)
    outlying = (outside / _OUTLIER) ** 2
    return PulseFit(
        peak=peak * unit,
        duration=width * duration,
        onset=peak_time - lead * width,
        width=width,
        shape=shape,
        covariance=covariance,
        restitution_deviation=restitution[0],
        expected_restitution=restitution[1],
        expected_deviation=restitution[2],
        misfit=np.maximum(best.cost / freedom / believed, outlying / (noise**2 + (MODEL_ERROR * peak) ** 2)),
        stray=outlying / (noise**2 + (STRAY * peak) ** 2),
        clipped=clipped,
        evidence=peak**2 * np.maximum(best.information[:, 0, 0], 0.0) / variance,
        converged=best.converged,
        reach=np.minimum(np.nan_to_num(np.ceil(reach), nan=_FAR), _FAR).astype(np.intp),
    )


def _improve(
    problems: Problems, best: Optimum, profile: Profiled, variance: Floats, rows: NDArray[np.intp]
) -> list[Optimum]:
    """Search again from the second-best shape of some rows; replace the worse results in place, return both."""
    tops = [best.rows(rows), best.rows(rows)]
    guess, likely = profile.second(tops[0], variance[rows])
    again = np.flatnonzero(likely)
    if again.size:
        nearby = search_nearby(problems, guess[again], np.sqrt(variance[rows[again]]), rows[again])
        better = nearby.cost < tops[0].cost[again]
        tops[1].put(again[~better], nearby.rows(~better))
        tops[0].put(again[better], nearby.rows(better))
        best.put(rows[again[better]], nearby.rows(better))
    if profile.binned:
        tops = [replace(top, cost=profile.result.depth_near(top.parameters[:, 3]) * profile.scale) for top in tops]
    tops[1].cost[~likely] = np.inf
    return tops

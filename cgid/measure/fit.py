"""The samples that a fit looks at: those around each pulse, pulses of like width together.

Where to look for a pulse that stands hardly above the noise: the strongest mean over runs of samples.

Maximum likelihood of the damped-Hertz family under white noise: least squares, batched over signals.

Levenberg and Marquardt's damping keeps each signal's steps in bounds; signals that have converged leave the batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cgid.measure.filters import mixing_matrix
from cgid.measure.template import (
    HIGHEST_SHAPE,
    LOWEST_SHAPE,
    covariance_of,
    free_parameters,
    pulse_and_slopes,
    relative_times,
    shape_penalty,
)
from cgid.validation import Floats

#: The first, coarse window reaches this far before and behind the peak, in widths (impulse over peak).
BEFORE, BEHIND = 1.5, 3.0
#: The final one goes this far beyond the contact that the coarse fit found, but not further behind the peak than the
#: second number: there less than 0.2 % of the peak is left at any restitution.
_MARGIN, _FURTHEST = 0.35, 4.5
#: Lengths are powers of this number.
_STEP = 1.5
#: Longer windows are averaged over equal runs of samples: hundreds of points say all about a smooth curve.
_LONGEST = 320
#: Points of a coarse window.
_COARSE = 48


@dataclass(frozen=True)
class Window:
    """Samples of some rows.

    Attributes
    ----------
    rows : ndarray of int, (n,)
        Of the frames they are from.
    values : ndarray, (n, n_points)
    times : ndarray, (n, n_points)
        [samples of the frame].
    averaged : ndarray, (n,)
        Samples in one point.
    outside : ndarray of bool, (n, n_points), or None
        Points beyond the frame; None where there are none.
    clipped : ndarray of bool, (n, n_points), or None
    beside : ndarray, (n,)
        The largest magnitude of the samples that are not looked at.
    run : int
        Samples in one point where all rows have as many by design; else 1.
    reach : ndarray of int, (n,)
        The last column that was asked for, in the frame or beyond it.
    """

    rows: NDArray[np.intp]
    values: Floats
    times: Floats
    averaged: Floats
    outside: NDArray[np.bool_] | None
    clipped: NDArray[np.bool_] | None
    beside: Floats
    run: int
    reach: NDArray[np.intp]

    def part(self, rows: NDArray[np.intp] | slice) -> Window:
        """Return some of its rows."""
        return Window(
            self.rows[rows],
            self.values[rows],
            self.times[rows],
            self.averaged[rows],
            None if self.outside is None else self.outside[rows],
            None if self.clipped is None else self.clipped[rows],
            self.beside[rows],
            self.run,
            self.reach[rows],
        )


def windows(
    samples: NDArray[np.floating],
    guess: Floats,
    offset: Floats | None,
    clip_level: Floats | None,
    averaged: bool = True,
    unit: Floats | None = None,
) -> Iterator[Window]:
    """Yield windows around pulses (peak, ln width, place, shape, baseline), those of like length together.

    Values are over `unit`, (n,), where it is given; offset and limit are in that of the samples.
    """
    width = np.exp(guess[:, 1])
    duration, lead, _, _ = relative_times(guess[:, 3])
    first = guess[:, 2] - (lead + _MARGIN) * width
    lengths = np.minimum(duration + 2 * _MARGIN, lead + _MARGIN + _FURTHEST) * width
    # Lengths come in steps: what a row is compared with must not depend on the other rows.
    step = np.ceil(np.log(np.maximum(lengths, 1.0)) / np.log(_STEP)).astype(np.intp)
    for chosen in np.unique(step):
        rows = np.flatnonzero(step == chosen)
        length = int(np.ceil(_STEP**chosen)) + 4
        yield _window(
            samples, rows, np.floor(first[rows]).astype(np.intp) - 2, length, offset, clip_level, averaged, unit
        )


def coarse_window(
    samples: NDArray[np.floating], start: Start, offset: Floats | None, clip_level: Floats | None
) -> Window:
    """Return few points of every pulse over its first peak, each the mean of as many samples as its width allows."""
    n, n_samples = samples.shape
    run = np.maximum(np.ceil((BEFORE + BEHIND) * start.width / _COARSE), 1).astype(np.intp)
    first = np.floor(start.place - BEFORE * start.width).astype(np.intp) - 1
    edges = first[:, None] + run[:, None] * np.arange(_COARSE + 1)
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples, axis=1, dtype=np.float64, out=total[:, 1:])
    at_edges = np.take_along_axis(total, np.clip(edges, 0, n_samples), axis=1)
    values = np.diff(at_edges, axis=1) / run[:, None]
    if offset is not None:
        values -= offset[:, None]
    outside = (edges[:, :-1] < 0) | (edges[:, 1:] > n_samples)
    clipped = None
    if clip_level is not None:  # a point near the limit holds clipped samples
        near = ~outside & (values >= 0.97 * clip_level[:, None])
        clipped = near if near.any() else None
    values /= start.peak[:, None]
    times = 0.5 * (edges[:, :-1] + edges[:, 1:] - 1.0)
    rows = np.arange(n)
    return Window(rows, values, times, run.astype(np.float64), outside, clipped, np.zeros(n), 1, edges[:, -1] - 1)


def _window(
    samples: NDArray[np.floating],
    rows: NDArray[np.intp],
    first: NDArray[np.intp],
    length: int,
    offset: Floats | None,
    clip_level: Floats | None,
    averaged: bool,
    unit: Floats | None,
) -> Window:
    n_samples = samples.shape[1]
    run = max(-(-length // _LONGEST), 1) if averaged else 1
    length = -(-length // run) * run
    columns = first[:, None] + np.arange(length)
    beyond = (columns < 0) | (columns >= n_samples)
    values = samples[rows[:, None], np.clip(columns, 0, n_samples - 1)].astype(np.float64)
    if offset is not None:
        values -= offset[rows][:, None]
    beside = _largest_beside(samples, rows, first, length, offset)
    outside = beyond if beyond.any() else None
    clipped = None
    if clip_level is not None:
        at_limit = ~beyond & (values >= clip_level[rows][:, None])
        clipped = at_limit if at_limit.any() else None
    if unit is not None:
        values /= unit[rows][:, None]
        beside /= unit[rows]
    times, reach = columns.astype(np.float64), first + length - 1
    if run > 1:
        shape = (len(rows), length // run, run)
        values, times = values.reshape(shape).mean(axis=2), times.reshape(shape).mean(axis=2)
        outside = None if outside is None else outside.reshape(shape).any(axis=2)
        clipped = None if clipped is None else clipped.reshape(shape).any(axis=2)
    return Window(rows, values, times, np.full(len(rows), float(run)), outside, clipped, beside, run, reach)


def _largest_beside(
    samples: NDArray[np.floating], rows: NDArray[np.intp], first: NDArray[np.intp], length: int, offset: Floats | None
) -> Floats:
    out = np.zeros(len(rows))
    for place, (row, column) in enumerate(zip(rows.tolist(), first.tolist(), strict=True)):
        frame = samples[row]
        for part in (frame[: max(column, 0)], frame[max(column + length, 0) :]):
            if part.size:
                base = 0.0 if offset is None else offset[row]
                out[place] = max(out[place], float(part.max()) - base, base - float(part.min()))
    return out


#: Runs grow by this factor from the shortest to this share of the frame.
_GROWTH, _SHORTEST, _LONGEST_SHARE = 1.4, 3, 0.5
#: A pulse's best run, over its width (impulse over peak), and its mean over the peak.
_RUN_OVER_WIDTH, _MEAN_OVER_PEAK = 1.1, 0.74


def strongest_run(samples: NDArray[np.floating], offset: Floats) -> tuple[Floats, Floats, Floats]:
    """Return peak, width [samples] and place [samples] of the pulse that stands out most, each (n,).

    Parameters
    ----------
    samples : ndarray, (n, n_samples)
    offset : ndarray, (n,)
        Taken off the samples.

    A box is within 6 % of the matched filter for these pulses, and sums make boxes of all lengths cheap.
    """
    n, n_samples = samples.shape
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples - offset[:, None], axis=1, dtype=np.float64, out=total[:, 1:])
    best = np.full(n, -np.inf)
    run, place = np.ones(n), np.zeros(n)
    rows = np.arange(n)
    length = _SHORTEST
    while length <= max(_LONGEST_SHARE * n_samples, _SHORTEST):
        strength = (total[:, length:] - total[:, :-length]) / np.sqrt(length)
        top = np.argmax(strength, axis=1)
        better = strength[rows, top] > best
        best = np.where(better, strength[rows, top], best)
        run, place = np.where(better, length, run), np.where(better, top + 0.5 * (length - 1), place)
        length = max(int(length * _GROWTH), length + 1)
    return best / np.sqrt(run) / _MEAN_OVER_PEAK, run / _RUN_OVER_WIDTH, place


#: Largest steps: of ln(width), of the place over the width, of s.
_LARGEST_STEPS = (0.4, 0.5, 0.7)
_COARSE_ITERATIONS, _ITERATIONS = 7, 12
#: A fit ends when the next step would gain less than this much of a half squared standard deviation.
_TOLERANCE = 3e-3
#: Share of Jeffreys' prior in the likelihood. Where the shape is just told (bound .03), none leaves estimates a tenth
#: to a fifth of a standard deviation too low and stray ones far too low; all of it makes them as much too high.
_FIRTH = 0.6
#: Where the search begins, below what restitution a second one begins, and how much better it must be.
_FIRST_RESTITUTIONS, _DOUBTFUL, _SURE = (0.5, 0.2), 0.62, 12.0
#: Rows fitted at once: what they need must stay in the processor's cache.
_ROWS = 1024
#: Less damping changes no step.
_FELT = 0.3
#: No step is damped more.
_STUCK = 1e4
#: Less noise than this share of the peak is not believed: the template is no more exact.
_NOISE_FLOOR = 1e-5
#: In the judgement of the fit a deviation of this share of the peak counts as noise.
MODEL_ERROR = 1e-3
#: A sample beside the pulse that is this many standard deviations high counts as much as a misfit of 1.
_OUTLIER = 5.5


@dataclass(frozen=True)
class Start:
    """Where the search begins.

    Attributes
    ----------
    peak : ndarray, (n,)
    width : ndarray, (n,)
        Impulse over peak [samples].
    place : ndarray, (n,)
        Column of the peak.
    """

    peak: Floats
    width: Floats
    place: Floats

    def rows(self, chosen: NDArray[np.intp] | slice) -> Start:
        """Return some of them."""
        return Start(self.peak[chosen], self.width[chosen], self.place[chosen])


@dataclass(frozen=True)
class PulseFit:
    """Fitted pulses; times in samples of the frame.

    Attributes
    ----------
    peak : ndarray, (n,)
        Above the baseline, in the unit of the signal.
    duration, onset, width : ndarray, (n,)
        Contact duration, time of touch, impulse over peak [samples].
    shape : ndarray, (n,)
        s = ln e, beyond 0 for a pulse that rises more slowly than it falls.
    baseline : ndarray, (n,)
        0 unless it was fitted, too.
    covariance : ndarray, (n, 5, 5)
        Of `cgid.measure.template.PARAMETERS`, onset in samples; zero where a parameter was given.
    misfit : ndarray, (n,)
        Squared residual over what the noise explains, 1 on average for a pulse of the family (reduced chi-square); more
        where a sample beside the pulse stands out.
    clipped : ndarray of int, (n,)
        Samples at the sensor's limit.
    evidence : ndarray, (n,)
        What the pulse explains of the samples, over the variance of the noise.
    converged : ndarray of bool, (n,)
    reach : ndarray of int, (n,)
        The last sample that the fit asked for; the misfit alone looks at the whole frame.
    """

    peak: Floats
    duration: Floats
    onset: Floats
    width: Floats
    shape: Floats
    baseline: Floats
    covariance: Floats
    misfit: Floats
    clipped: NDArray[np.intp]
    evidence: Floats
    converged: NDArray[np.bool_]
    reach: NDArray[np.intp]

    @classmethod
    def joined(cls, parts: list[PulseFit]) -> PulseFit:
        """Return the rows of all parts."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    @classmethod
    def nothing(cls) -> PulseFit:
        """Return no rows at all."""
        none = np.empty(0)
        return cls(
            *(none,) * 6, np.empty((0, 5, 5)), none, np.empty(0, np.intp), none, np.empty(0, bool), np.empty(0, np.intp)
        )

    def spread(self, places: NDArray[np.intp], n: int) -> PulseFit:
        """Return n rows with these at their places, the others nan, nothing clipped and not converged."""
        spread = {}
        for f in fields(self):
            held = getattr(self, f.name)
            spread[f.name] = np.full((n, *held.shape[1:]), np.nan if held.dtype.kind == "f" else 0, held.dtype)
            spread[f.name][places] = held
        return PulseFit(**spread)

    def rows(self, chosen: NDArray[np.intp] | slice) -> PulseFit:
        """Return some of them."""
        return PulseFit(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    @property
    def restitution(self) -> Floats:
        """Restitution exp(s), above 1 where the pulse leans the other way."""
        return np.exp(self.shape)

    @property
    def restitution_deviation(self) -> Floats:
        """Standard deviation of the restitution."""
        return np.asarray(self.restitution * np.sqrt(self.covariance[:, 3, 3]))


def fit_pulses(
    samples: NDArray[np.floating],
    start: Start,
    noise: Floats,
    *,
    offset: Floats | None = None,
    fit_baseline: bool = False,
    onset: Floats | None = None,
    clip_level: Floats | None = None,
    response: Floats | None = None,
) -> PulseFit:
    """Return the pulse of the damped-Hertz family that is most likely in each frame.

    Parameters
    ----------
    samples : ndarray, (n, n_samples)
        One positive pulse a row.
    start : Start
    noise : ndarray, (n,)
        Standard deviation of the white noise.
    offset : ndarray, (n,), optional
        Taken off the samples.
    fit_baseline : bool
        Whether a constant is fitted beside the pulse.
    onset : ndarray, (n,), optional
        Time of touch [samples], where it is known.
    clip_level : ndarray, (n,), optional
        Samples at or above only say that the force was at least that (infinite where nothing is clipped).
    response : ndarray, (n_lags,), optional
        The sensor's symmetric impulse response, from lag 0: the pulse is seen through it, the noise is not.
    """
    if not len(samples):
        return PulseFit.nothing()
    blocks = [
        _fit_block(
            samples[block],
            start.rows(block),
            noise[block],
            None if offset is None else offset[block],
            fit_baseline,
            None if onset is None else onset[block],
            None if clip_level is None else clip_level[block],
            response,
        )
        for block in (slice(first, first + _ROWS) for first in range(0, len(samples), _ROWS))
    ]
    return PulseFit.joined(blocks)


def _fit_block(
    samples: NDArray[np.floating],
    start: Start,
    noise: Floats,
    offset: Floats | None,
    fit_baseline: bool,
    onset: Floats | None,
    clip_level: Floats | None,
    response: Floats | None,
) -> PulseFit:
    # In units of its first peak every pulse is of the order of 1, whatever the unit of the signal.
    unit = start.peak
    sigma = np.maximum(noise / unit, _NOISE_FLOOR)
    with np.errstate(all="ignore"):  # a frame without any pulse leads nowhere, and `evidence` says so
        coarse = coarse_window(samples, start, offset, clip_level)
        guess = _coarse(coarse, first_guess(start), sigma, fit_baseline, onset)
        parts = []
        for window in windows(samples, guess, offset, clip_level, averaged=response is None, unit=unit):
            rows = window.rows
            problem = Problem(window, fit_baseline, None if onset is None else onset[rows], response)
            found = _search(problem, guess[rows], sigma[rows] / np.sqrt(window.averaged), _ITERATIONS, 1e-6)
            parts.append((rows, _report(problem, *found, sigma[rows], unit[rows])))
    rows = np.concatenate([rows for rows, _ in parts])
    joined = PulseFit.joined([part for _, part in parts]).rows(np.argsort(rows, kind="stable"))
    return replace(joined, reach=np.maximum(joined.reach, coarse.reach))


def _coarse(window: Window, guess: Floats, sigma: Floats, fit_baseline: bool, onset: Floats | None) -> Floats:
    """Return parameters near the best ones, from few points.

    Between e of .2 and .45 two shapes may both be locally best. The search begins from the higher side; the other
    minimum is believed only if it is better by more than noise makes it look where it is wrong.
    """

    def search(rows: NDArray[np.intp] | slice, shape: float) -> tuple[Floats, Floats]:
        part = window.part(rows)
        problem = Problem(part, fit_baseline, None if onset is None else onset[rows], None)
        first = guess[rows]
        first[:, 3] = np.log(shape)
        noise = sigma[rows] / np.sqrt(part.averaged)
        found, cost, _, _ = _search(problem, first, noise, _COARSE_ITERATIONS, 1e-3)
        return found, cost / noise**2 - 2 * _FIRTH * shape_penalty(found[:, 3])[0]

    found, cost = search(slice(None), _FIRST_RESTITUTIONS[0])
    doubtful = np.flatnonzero(found[:, 3] < np.log(_DOUBTFUL))
    if doubtful.size:
        other, other_cost = search(doubtful, _FIRST_RESTITUTIONS[1])
        better = other_cost < cost[doubtful] - _SURE
        found[doubtful[better]] = other[better]
    return found


def first_guess(start: Start) -> Floats:
    """Return parameters (peak over the first one, ln width, place, shape, baseline) to start from, (n, 5)."""
    one, none = np.ones(len(start.peak)), np.zeros(len(start.peak))
    return np.stack([one, np.log(start.width), start.place, none, none], axis=1)


class Problem:
    """Samples and the curve through them.

    Parameters
    ----------
    window : Window
    fit_baseline : bool
    onset : ndarray, (n,), optional
        [samples].
    response : ndarray, (n_lags,), optional
    """

    def __init__(self, window: Window, fit_baseline: bool, onset: Floats | None, response: Floats | None) -> None:
        self.window, self.onset, self.fit_baseline = window, onset, fit_baseline
        self.free = free_parameters(onset is not None, fit_baseline)
        #: A mean over a run of samples is the curve in its middle and this share of its second difference.
        self.blur = (1 - window.run**-2) / 24 if window.run > 1 else 0.0
        self.mixing = None
        if response is not None:
            self.mixing = mixing_matrix(response, window.values.shape[1])

    def tied(self, parameters: Floats, rows: NDArray[np.intp] | slice = slice(None)) -> Floats:
        """Return the parameters with the place that follows from a known onset."""
        if self.onset is not None:
            _, lead, _, _ = relative_times(parameters[:, 3])
            parameters[:, 2] = self.onset[rows] + lead * np.exp(parameters[:, 1])
        return parameters

    def residual(self, parameters: Floats, rows: NDArray[np.intp] | slice) -> tuple[Floats, Floats]:
        """Return samples minus curve, (n, n_samples), and the slopes of the curve, (n, n_free, n_samples)."""
        times = self.window.times[rows]
        model, slopes = pulse_and_slopes(parameters, times, self.onset is not None, self.fit_baseline)
        if self.mixing is not None:
            model, slopes = model @ self.mixing, slopes @ self.mixing
        if self.blur:
            model, slopes = _blurred(model, self.blur), _blurred(slopes, self.blur)
        residual = self.window.values[rows] - model - parameters[:, 4:]
        return self._weighted(residual, slopes, rows)

    def _weighted(self, residual: Floats, slopes: Floats, rows: NDArray[np.intp] | slice) -> tuple[Floats, Floats]:
        """Leave out what lies outside the frame, and clipped samples that the curve is above."""
        silent = None if self.window.outside is None else self.window.outside[rows]
        if self.window.clipped is not None:
            above = self.window.clipped[rows] & (residual < 0)
            silent = above if silent is None else silent | above
        if silent is not None:
            residual = np.where(silent, 0.0, residual)
            slopes = np.where(silent[:, None], 0.0, slopes)
        return residual, slopes


def _blurred(curves: Floats, share: float) -> Floats:
    out = curves.copy()
    out[..., 1:-1] += share * (curves[..., 2:] - 2 * curves[..., 1:-1] + curves[..., :-2])
    return out


def _search(
    problem: Problem, guess: Floats, sigma: Floats, iterations: int, first_damping: float
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Return parameters, squared residual, information (times the variance of the noise) and who converged."""
    parameters = problem.tied(guess)
    n, free, variance = len(parameters), problem.free, sigma**2
    column = free.index(3)
    cost, information, gradient = _normal(*problem.residual(parameters, slice(None)))
    penalty = np.stack(shape_penalty(parameters[:, 3])) * variance * _FIRTH
    damping, active, converged = np.full(n, first_damping), np.arange(n), np.zeros(n, bool)
    for _ in range(iterations):
        bent, pulled = information[active], gradient[active]
        bent[:, column, column] -= penalty[2, active]
        pulled[:, column] += penalty[1, active]
        step, promise = _step(bent, pulled, damping[active])
        done = promise < _TOLERANCE * variance[active]
        converged[active[done]] = True
        active, step = active[~done], step[~done]
        if not active.size:
            break
        tried = parameters[active]
        tried[:, free] += _bounded(step, free, np.exp(tried[:, 1]))
        tried[:, 3] = np.clip(tried[:, 3], LOWEST_SHAPE, HIGHEST_SHAPE)
        tried = problem.tied(tried, active)
        new = _normal(*problem.residual(tried, active))
        new_penalty = np.stack(shape_penalty(tried[:, 3])) * variance[active] * _FIRTH
        better = new[0] - 2 * new_penalty[0] <= cost[active] - 2 * penalty[0, active]
        taken = active[better]
        parameters[taken], penalty[:, taken] = tried[better], new_penalty[:, better]
        cost[taken], information[taken], gradient[taken] = (a[better] for a in new)
        eased, raised = 0.1 * damping[active], np.maximum(10.0 * damping[active], _FELT)
        damping[active] = np.where(better, eased, raised)
        # Where even a tiny step goes uphill, it is a kink (a sample at touch) that is the lowest place.
        stuck = damping[active] > _STUCK
        converged[active[stuck]] = True
        active = active[~stuck]
    return parameters, cost, information, converged


def _normal(residual: Floats, slopes: Floats) -> tuple[Floats, Floats, Floats]:
    information = np.matmul(slopes, np.swapaxes(slopes, 1, 2))
    gradient = np.matmul(slopes, residual[..., None])[..., 0]
    return np.sum(residual**2, axis=1), information, gradient


def _step(information: Floats, gradient: Floats, damping: Floats) -> tuple[Floats, Floats]:
    """Return the damped step and what it would gain of the squared residual if nothing were bent or bounded."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", information), 1e-300))
    unit = information / (scale[:, :, None] * scale[:, None, :])
    unit += (damping[:, None] + 1e-10)[:, :, None] * np.eye(unit.shape[1])
    step = np.linalg.solve(unit, (gradient / scale)[..., None])[..., 0] / scale
    return step, np.sum(step * gradient, axis=1)


def _bounded(step: Floats, free: list[int], width: Floats) -> Floats:
    for column, parameter in enumerate(free):
        if 1 <= parameter <= 3:
            largest = _LARGEST_STEPS[parameter - 1] * (width if parameter == 2 else 1.0)
            step[:, column] = np.clip(step[:, column], -largest, largest)
    return step


def _report(
    problem: Problem,
    parameters: Floats,
    cost: Floats,
    information: Floats,
    converged: NDArray[np.bool_],
    sigma: Floats,
    unit: Floats,
) -> PulseFit:
    """Return what was found; noise and parameters are in units of the first peak."""
    window = problem.window
    peak, log_width, place, shape, baseline = parameters.T
    width = np.exp(log_width)
    duration, lead, _, _ = relative_times(shape)
    variance = sigma**2 / window.averaged
    covariance = covariance_of(information, parameters, problem.onset is not None, problem.fit_baseline)
    covariance *= variance[:, None, None]
    covariance[:, 4] *= unit[:, None]
    covariance[:, :, 4] *= unit[:, None]
    clipped = np.zeros(len(peak), np.intp) if window.clipped is None else window.clipped.sum(axis=1)
    counted = window.values.shape[1] - (0 if window.outside is None else window.outside.sum(axis=1))
    freedom = np.maximum(counted - clipped - len(problem.free), 1)
    believed = variance + (MODEL_ERROR * peak) ** 2 / window.averaged
    beside = (window.beside / _OUTLIER) ** 2 / (believed * window.averaged)
    return PulseFit(
        peak=peak * unit,
        duration=width * duration,
        onset=place - lead * width,
        width=width,
        shape=shape,
        baseline=baseline * unit,
        covariance=covariance,
        misfit=np.maximum(cost / freedom / believed, beside),
        clipped=clipped,
        evidence=peak**2 * np.maximum(information[:, 0, 0], 0.0) / variance,
        converged=converged,
        reach=window.reach,
    )

"""Measurements on a batch of single pulses, such as contact forces, and their features (`PULSE_FEATURES`, at the end).

Each quantity is computed on first use, relative to a baseline from the samples before onset. After the peak is found,
only a window around contact is used.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.ac_coupling import LEAST_FALL, QUIET_BLOCKS, coupling_rates
from cgid.measure.features.table import Bank, Feature, bank, described
from cgid.measure.fit.fit import MODEL_ERROR, PulseFit, PulseStart, fit_pulses, without_impact
from cgid.measure.fit.fit_samples import strongest_run
from cgid.measure.fit.residual import N_SHAPES, Residual, fit_residual
from cgid.measure.fit.search import around
from cgid.measure.frames import Frames, Problem, ProblemKind, constant_signal, no_impact
from cgid.measure.spectra import PulseSpectrum

#: Minimum number of samples between the 10 % crossings of a measurable width.
MINIMUM_SAMPLES = 4
#: Smallest width (impulse over peak) of a pulse that can be fitted [samples].
MINIMUM_WIDTH = 1.5
#: Recommended number of samples in contact, for messages.
RECOMMENDED_SAMPLES = 20
#: Lower of the two levels from which contact is extrapolated to zero: over the noise, and its bounds over the peak.
#: Without noise, the duration is .2 % too short at restitution .5, 1.2 % at .4 and 9 % at .3: the tail of a strongly
#: damped pulse is below any level.
FOOT_OVER_NOISE, FOOT_LEVELS = 4.0, (0.01, 0.1)
#: Smallest peak that locates the pulse [standard deviations of the noise].
FAINT = 12.0
#: Width (impulse over peak) of a typical pulse over its width at half the peak.
_WIDTH_OVER_HALF_WIDTH = 1.08
#: Equal samples in a row at the top that indicate a sensor at its limit.
_FLAT_TOP = 3
#: Residual above which a pulse is no single impact; fitted peak over clipping level, minus 1, above which it is a
#: guess.
MAX_UNEXPLAINED, MAX_OVERLOAD = 4.5, 1.2
#: A force ends with the contact. Ring-down shows in differences over the first of these times, between the second and
#: third time after onset (in contact durations); hum and drift hardly change over it. The last is the fraction of the
#: peak that counts as ring-down.
_RING_LAG, _RING_FROM, _RING_TO, MAX_RINGING = 1.5, 1.2, 11.2, 0.03
#: Samples per contact duration that are compared, and the minimum number of differences that show ring-down.
_RING_STEPS, _MIN_RINGING = 8, 8
#: The level after a contact is seen from so far behind it and over so long, in its own time at 10 % of the peak.
_AFTER, _AFTER_TIME = 0.5, 2.0
#: Samples that look for a fall of that level, fewest of them, and standard deviations of their mean that count.
_LOOKS, _FEWEST_LOOKS, _LOOKED = 32, 16, 1.5


class PulseBatch(Frames):
    """Single positive pulses in frames; each quantity is computed on first use."""

    # Without `pre_trigger`, each row is quiet up to shortly before its last sample below 1 % of its rise.

    # -- the recorder ---------------------------------------------------------------------------------

    @cached_property
    def after(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns between which the level after contact is seen, in the frame or beyond it."""
        first, last = self._edges
        contact = last - first + 1
        start = last + 3 + np.ceil(_AFTER * contact).astype(np.intp)
        return start, start + np.ceil(_AFTER_TIME * contact).astype(np.intp)

    def uncoupled(self) -> PulseBatch:
        """Return the pulses as they were before an AC coupling of the recorder, if there are any behind one."""
        # Without samples before onset nothing says what 0 is.
        if self.pre_trigger is None or self.pre_trigger < QUIET_BLOCKS or not self.remove_baseline:
            return self
        if not len(self.samples):
            return self
        (start, stop), n_samples = self.after, self.samples.shape[1]
        looks = start[:, None] + ((stop - start)[:, None] * np.arange(_LOOKS)) // _LOOKS
        seen = np.take_along_axis(self.samples, np.minimum(looks, n_samples - 1), axis=1)
        count = np.maximum(np.sum(looks < n_samples, axis=1), 1)
        level = np.sum(seen, axis=1, where=looks < n_samples, dtype=np.float64) / count - self.offset
        low = level < -np.maximum(0.5 * LEAST_FALL * self.peak, _LOOKED * self.noise / np.sqrt(count))
        if self.clip_level is not None:
            low &= self.clip_level == np.inf  # what the sensor's limit took of the impulse is unknown
        rows = np.flatnonzero(low & (np.minimum(stop, n_samples) - start >= _FEWEST_LOOKS))
        if not rows.size:
            return self
        force = self.samples[rows] - self.offset[rows, None]
        after = start[rows], np.minimum(stop, n_samples)[rows]
        rate = coupling_rates(force, self.peak[rows], self.noise[rows], self.pre_trigger, after)
        if not rate.any():
            return self
        samples = self.samples.copy()
        samples[rows] += (rate[:, None] * np.cumsum(force, axis=1)).astype(samples.dtype)
        return replace(self, samples=samples)

    # -- before onset ---------------------------------------------------------------------------------

    @cached_property
    def _surely_quiet(self) -> NDArray[np.intp]:
        """A sample certainly before onset: a fifth of the rise before the last one below 1 % of the peak."""
        # Relative to the mean of the first quarter of the samples before it, so a sensor's offset cancels.
        peak_index, highest = self._highest
        columns = np.arange(self.samples.shape[1])
        count = np.maximum(peak_index // 4, 1)
        early = columns[: count.max()] < count[:, None]
        start = np.sum(self.samples[:, : count.max()], axis=1, where=early, dtype=np.float64) / count
        level = start + 0.01 * (highest - start)
        low = (self.samples < level[:, None]) & (columns < peak_index[:, None])
        foot = np.where(low, columns, 0).max(axis=1)
        return np.asarray(np.maximum(foot - (peak_index - foot) // 5 - 1, 0))

    @cached_property
    def n_quiet(self) -> Floats:
        """Number of samples before onset that define baseline and noise."""
        if self.pre_trigger is not None:
            return np.full(len(self.samples), float(max(self.pre_trigger, 1)))
        return np.asarray(np.maximum(self._surely_quiet, 1), np.float64)

    # -- the peak -------------------------------------------------------------------------------------

    @cached_property
    def _highest(self) -> tuple[NDArray[np.intp], Floats]:
        peak_index = np.argmax(self.samples, axis=1)
        return peak_index, self.samples[np.arange(len(peak_index)), peak_index].astype(np.float64)

    @cached_property
    def peak(self) -> Floats:
        """Largest sample above the baseline."""
        return self._highest[1] - self.offset

    # -- the window around contact --------------------------------------------------------------------

    @cached_property
    def _edges(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First and last sample of the run around the peak above 10 % of the peak."""
        return self._run_above(0.1)

    def _run_above(self, share: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the first and last sample of the run around the peak above a share of it."""
        n_rows, n_samples = self.samples.shape
        # If nothing rises above the baseline, the run is the largest sample.
        level = np.minimum(share * self.peak + self.offset, self._highest[1]).astype(self.samples.dtype)
        # Only a few samples are high: their flat indices form runs, separated by gaps and the ends of rows.
        high = np.flatnonzero(self.samples >= level[:, None])
        breaks = np.flatnonzero((high[1:] - high[:-1] > 1) | (high[1:] % n_samples == 0)) + 1
        starts, stops = high[np.append(0, breaks)], high[np.append(breaks - 1, high.size - 1)]
        first_of_row = np.arange(n_rows) * n_samples
        run = np.searchsorted(starts, first_of_row + self._highest[0], side="right") - 1
        return starts[run] - first_of_row, stops[run] - first_of_row

    @cached_property
    def window_reach(self) -> NDArray[np.intp]:
        """Last sample of the window around contact, in the frame or beyond it."""
        first, last = self._edges
        return np.asarray(last + (last - first + 1) + 2)

    @cached_property
    def _window(self) -> tuple[Floats, NDArray[np.intp]]:
        """Samples around contact (n_signals, width), less the baseline, and the column of the first."""
        # A quarter of the run's length more before it and its complete length after: a damped pulse has a long tail.
        # Zeros follow, so a row does not depend on the other rows of the batch.
        first, last = self._edges
        start, stop = first - (last - first + 1) // 4 - 2, self.window_reach
        offset = np.arange(int((stop - start).max()) + 1)
        columns = start[:, None] + offset
        inside = (offset <= (stop - start)[:, None]) & (columns >= 0) & (columns < self.samples.shape[1])
        taken = np.take_along_axis(self.samples, np.clip(columns, 0, self.samples.shape[1] - 1), axis=1)
        return np.where(inside, taken - self.offset[:, None], 0.0), start

    @cached_property
    def _peak_column(self) -> NDArray[np.intp]:
        return self._highest[0] - self._window[1]

    @cached_property
    def _crossings(self) -> dict[float, tuple[Floats, Floats]]:
        return {}

    def crossings(self, level: float) -> tuple[Floats, Floats]:
        """Return where the pulse crosses a fraction of its peak, rising and falling [samples of the window]."""
        if level not in self._crossings:
            self._crossings[level] = self._crossings_at(np.full(len(self.samples), level))
        return self._crossings[level]

    def _crossings_at(self, level: Floats, power: float = 1.0) -> tuple[Floats, Floats]:
        """Return both crossings of a level of each row, linear in a power of the pulse between samples."""
        window, columns = self._window[0], np.arange(self._window[0].shape[1])
        height, peak_index = (level * self.peak)[:, None], self._peak_column[:, None]
        low = window < height
        before = np.where(low & (columns < peak_index), columns, 0).max(axis=1)
        after = np.where(low & (columns > peak_index), columns, columns.size - 1).min(axis=1)
        rising = self._between(before, before + 1, height[:, 0], power)
        return rising, self._between(after, after - 1, height[:, 0], power)

    def _between(self, outer: NDArray[np.intp], inner: NDArray[np.intp], height: Floats, power: float) -> Floats:
        rows = np.arange(len(outer))
        low, high = (np.maximum(self._window[0][rows, column], 0.0) ** power for column in (outer, inner))
        rise = np.where(high > low, high - low, 1.0)
        return np.asarray(outer + (inner - outer) * np.clip((height**power - low) / rise, 0.0, 1.0))

    def width(self, level: float) -> Floats:
        """Return the width at a fraction of the peak [s]."""
        rising, falling = self.crossings(level)
        return (falling - rising) / self.sampling_rate

    @cached_property
    def contact(self) -> tuple[Floats, Floats]:
        """Onset and separation [samples of the window], extrapolated from two crossings near the foot."""
        # An elastic pulse is close to sin^(3/2), so `arcsin(F^(2/3))` is nearly linear in time near both. The lower
        # crossing is at `FOOT_OVER_NOISE` standard deviations of the noise, within `FOOT_LEVELS`.
        low = np.clip(FOOT_OVER_NOISE * self.noise / self.peak, *FOOT_LEVELS)
        angle, angle_up = np.arcsin(low ** (2 / 3)), np.arcsin((3 * low) ** (2 / 3))
        reach = angle / (angle_up - angle)
        (rise, fall), (rise_up, fall_up) = self._crossings_at(low, 2 / 3), self._crossings_at(3 * low, 2 / 3)
        return rise - reach * (rise_up - rise), fall + reach * (fall - fall_up)

    @cached_property
    def duration(self) -> Floats:
        """Contact duration [s]."""
        onset, separation = self.contact
        return (separation - onset) / self.sampling_rate

    @cached_property
    def time_of_peak(self) -> Floats:
        """Top of a parabola fitted around the peak to the samples above 80 % of it [samples of the window]."""
        window, peak_index = self._window[0], self._peak_column
        rising, falling = self.crossings(0.8)
        offset = np.arange(window.shape[1]) - peak_index[:, None]
        in_reach = (offset >= np.minimum(rising - peak_index, -1)[:, None]) & (
            offset <= np.maximum(falling - peak_index, 1)[:, None]
        )
        scale = np.maximum(falling - rising, 2.0)[:, None]
        u = np.where(in_reach, offset / scale, 0.0)
        moments = [in_reach.sum(axis=1).astype(np.float64)] + [np.sum(u**k, axis=1) for k in (1, 2, 3, 4)]
        weighted = np.where(in_reach, window, 0.0)
        right = np.stack([np.sum(weighted * u**k, axis=1) for k in (0, 1, 2)], axis=1)
        matrix = np.stack([np.stack(moments[k : k + 3], axis=1) for k in (0, 1, 2)], axis=1)
        fit = np.linalg.solve(matrix, right[..., None])[..., 0]
        bent = fit[:, 2] < 0
        top = np.where(bent, -fit[:, 1] / (2 * np.where(bent, fit[:, 2], -1.0)), 0.0)
        return np.asarray(peak_index + scale[:, 0] * np.clip(top, -0.5, 0.5))

    @cached_property
    def _during_contact(self) -> Floats:
        """The window, zero outside contact."""
        onset, separation = self.contact
        columns = np.arange(self._window[0].shape[1])
        inside = (columns > onset[:, None]) & (columns < separation[:, None])
        return np.where(inside, self._window[0], 0.0)

    @cached_property
    def moments(self) -> tuple[Floats, Floats, Floats]:
        """Sum [unit s], standard deviation over time [s] and skewness of the pulse during contact."""
        force, columns = self._during_contact, np.arange(self._window[0].shape[1], dtype=np.float64)
        total = force.sum(axis=1)
        centred = columns - (force @ columns / total)[:, None]
        variance = np.maximum(np.sum(force * centred**2, axis=1) / total, 1e-12)
        third = np.sum(force * centred**3, axis=1) / total
        return total / self.sampling_rate, np.sqrt(variance) / self.sampling_rate, third / variance**1.5

    @cached_property
    def energy(self) -> Floats:
        """Integral of the squared pulse during contact [unit^2 s]."""
        return np.asarray(np.sum(self._during_contact**2, axis=1) / self.sampling_rate)

    # -- the fitted pulse -----------------------------------------------------------------------------

    @cached_property
    def fit(self) -> PulseFit:
        """The most likely damped-Hertz pulse, times in samples of the frame; nan where there is no rise."""
        alive = np.flatnonzero((self.peak > 0) & (np.ptp(self.samples, axis=1) > 0))
        fitted = fit_pulses(
            self.samples[alive],
            self.fit_start if alive.size == len(self.samples) else self.fit_start.rows(alive),
            self.noise[alive],
            offset=self.offset[alive],
            clip_level=None if self.clip_level is None else self.clip_level[alive],
            n_quiet=self.n_quiet[alive],
        )
        return fitted if alive.size == len(self.samples) else fitted.spread(alive, len(self.samples))

    @cached_property
    def fit_start(self) -> PulseStart:
        """Start of the fit: the largest sample, or the strongest run of samples for a faint peak."""
        faint = np.flatnonzero(~(self.peak >= FAINT * self.noise))
        peak, peak_index = self.peak.copy(), self._highest[0].astype(np.float64)
        # The width at half the peak, linear between samples.
        rows, last, level = np.arange(len(peak)), self.samples.shape[1] - 1, 0.5 * peak + self.offset
        width = np.zeros(len(peak))
        for sign, inner in zip((-1, 1), self._run_above(0.5), strict=True):
            outer = np.minimum(np.maximum(inner + sign, 0), last)
            high, low = (self.samples[rows, column].astype(np.float64) for column in (inner, outer))
            share = np.maximum(high - level, 0.0) / np.where(high > low, high - low, 1.0)
            width += sign * inner + np.minimum(share, 1.0)
        width *= _WIDTH_OVER_HALF_WIDTH
        if faint.size:
            peak[faint], width[faint], peak_index[faint] = strongest_run(self.samples[faint], self.offset[faint])
        tiny = 1e-12 + 1e-9 * np.abs(self._highest[1])
        return PulseStart(np.maximum(peak, tiny), np.maximum(width, 1.0), peak_index)

    @cached_property
    def clip_level(self) -> Floats | None:
        """Level of the sensor's limit above the baseline, infinite for rows below it; None if no row reaches it."""
        peak_index, highest = self._highest
        rows, flat = np.arange(len(peak_index)), np.ones(len(peak_index), bool)
        for step in range(1, _FLAT_TOP):
            flat &= self.samples[rows, np.minimum(peak_index + step, self.samples.shape[1] - 1)] == highest
        flat &= highest > self.offset
        return np.where(flat, highest - self.offset, np.inf) if flat.any() else None

    @cached_property
    def overload(self) -> Floats:
        """Fitted peak over the clipping level, minus 1; 0 where samples are not clipped."""
        if self.clip_level is None:
            return np.zeros(len(self.samples))
        return np.maximum(self.fit.peak / self.clip_level - 1, 0.0)

    @cached_property
    def residual(self) -> Residual:
        """The residual of the fitted pulse; nan where there is no fit."""
        fit, n = self.fit, len(self.samples)
        rows = np.flatnonzero(np.isfinite(fit.shape) & (fit.peak > 0) & (fit.width > 0))
        level = np.full(n, np.inf) if self.clip_level is None else self.clip_level
        components, unexplained = np.full((n, N_SHAPES), np.nan), np.full(n, np.nan)
        noise = np.hypot(self.noise, MODEL_ERROR * np.maximum(fit.peak, 0.0))
        taken = (fit.onset[rows] + 0.5 * fit.width[rows], fit.width[rows], self.offset[rows], level[rows])
        for part, samples in around(self.samples[rows], *taken, 1.3):
            selected = rows[part]
            pulse = (fit.peak[selected], fit.width[selected], fit.onset[selected], fit.shape[selected])
            residuals = fit_residual(samples, *pulse, noise[selected])
            components[selected], unexplained[selected] = residuals.components, residuals.unexplained
        # Steep, so that pulses with little clipping or ring-down keep their value.
        doubt = MAX_UNEXPLAINED * np.minimum((self.ringing / MAX_RINGING) ** 4, 100.0)
        if self.clip_level is not None:
            doubt = np.maximum(doubt, MAX_UNEXPLAINED * np.minimum((self.overload / MAX_OVERLOAD) ** 8, 100.0))
        return Residual(components, np.maximum(np.maximum(unexplained, fit.stray), doubt))

    @cached_property
    def ringing(self) -> Floats:
        """Root mean square of the ring-down after the pulse, above twice the power of the noise, over the peak."""
        fit, last = self.fit, self.samples.shape[1] - 1
        times = np.arange(_RING_FROM, _RING_TO, 1 / _RING_STEPS)
        at = np.nan_to_num(fit.onset[:, None] + fit.duration[:, None] * times, nan=2.0 * last)
        column = np.clip(np.rint(at), 0, last).astype(np.intp)
        after = np.take_along_axis(self.samples, column, axis=1).astype(np.float64)
        lag = round(_RING_LAG * _RING_STEPS)
        inside = at[:, lag:] <= last
        count, step = inside.sum(axis=1), after[:, lag:] - after[:, :-lag]
        power = np.sum(step**2, axis=1, where=inside) / (2 * np.maximum(count, 1)) - 2 * self.noise**2
        seen = (count >= _MIN_RINGING) & (fit.peak > 0)
        return np.where(seen, np.sqrt(np.maximum(power, 0.0)) / np.where(seen, fit.peak, 1.0), 0.0)

    def fit_problems(self) -> dict[int, Problem]:
        """Map each row that cannot be fitted to its problem."""
        problems = without_impact(self.samples, self.fit)
        middle = self.fit.onset + 0.5 * self.fit.duration
        for row in np.flatnonzero((self.fit.onset < -0.5) | (middle > self.samples.shape[1] - 1)):
            problems.setdefault(int(row), self._cut_off(self.fit.onset[row] < -0.5))
        for row in np.flatnonzero(self.fit.width < MINIMUM_WIDTH):
            width = self.fit.width[row]
            width_text = f"{width:.3g} samples of width"
            problems.setdefault(int(row), self._too_short(width, width_text, MINIMUM_WIDTH, RECOMMENDED_SAMPLES / 2))
        return problems

    # -- the spectrum ---------------------------------------------------------------------------------

    @cached_property
    def spectrum(self) -> PulseSpectrum:
        """Spectrum of the contact alone."""
        onset, separation = self.contact
        return PulseSpectrum(self._during_contact, onset, separation, self.sampling_rate)

    # -- rows that cannot be measured -----------------------------------------------------------------

    def problems(self) -> dict[int, Problem]:
        """Map each row that cannot be measured to its problem."""
        problems: dict[int, Problem] = {}
        first, last = self._edges
        count = last - first + 1
        for row in np.flatnonzero(~(self.peak > self.detection_limit * self.noise) | ~(self.peak > 0)):
            problems[int(row)] = no_impact(
                f"the peak must pass {self.detection_limit:g} times the noise, it is {self.peak[row]:.3g} "
                f"over a noise of {self.noise[row]:.3g}; if the pulse points downwards, invert the signal"
            )
        cut_off = (first == 0) | (last == self.samples.shape[1] - 1)
        for row in np.flatnonzero(cut_off):
            if np.ptp(self.samples[row]) == 0:
                problems.setdefault(int(row), constant_signal(self.samples[row, 0]))
            problems.setdefault(int(row), self._cut_off(first[row] == 0))
        for row in np.flatnonzero(count < MINIMUM_SAMPLES):
            width_text = f"{count[row]} samples above 10 % of its peak"
            problems.setdefault(
                int(row), self._too_short(max(count[row], 1), width_text, MINIMUM_SAMPLES, RECOMMENDED_SAMPLES)
            )
        return problems

    def _cut_off(self, by_start: bool) -> Problem:
        end, sample = ("start", 0) if by_start else ("end", self.samples.shape[1] - 1)
        return Problem(
            ProblemKind.CUT_OFF,
            f"the pulse must be inside the frame, it is cut off by its {end} (sample {sample}): record a longer frame",
        )

    def _too_short(self, samples: float, width_text: str, needed: float, recommended: float) -> Problem:
        span = samples / self.sampling_rate
        return Problem(
            ProblemKind.TOO_SHORT,
            f"sampling_rate {self.sampling_rate:g} Hz gives this {span * 1e3:.3g} ms pulse {width_text}; {needed:g} "
            f"are needed and {recommended:g} wanted: use {recommended / span:.3g} Hz or more",
        )


# -- features -----------------------------------------------------------------------------------------


def _transition(pulses: PulseBatch, side: int) -> Floats:
    """Return the time between 10 % and 90 % of the peak [s], rising (side 0) or falling (1)."""
    return np.abs(pulses.crossings(0.9)[side] - pulses.crossings(0.1)[side]) / pulses.sampling_rate


def _asymmetry(pulses: PulseBatch) -> Floats:
    rising, falling = pulses.crossings(0.1)
    return (rising + falling - 2 * pulses.time_of_peak) / (falling - rising)


def _tilt(pulses: PulseBatch) -> Floats:
    (rise_10, fall_10), (rise_50, fall_50) = pulses.crossings(0.1), pulses.crossings(0.5)
    return ((rise_10 + fall_10) - (rise_50 + fall_50)) / (fall_50 - rise_50)


#: Edges of the bands of `band_energy_*_hz` [Hz].
_BANDS = ((0, 500), (500, 1000), (1000, 2000), (2000, 4000), (4000, 8000), (8000, 16000))

PULSE_FEATURES: tuple[Feature | Bank, ...] = (
    *described(
        {
            "peak_force": lambda p: p.peak,
            "contact_duration": lambda p: p.duration,
            "width_10": lambda p: p.width(0.1),
            "width_50": lambda p: p.width(0.5),
            "rise_time": lambda p: _transition(p, 0),
            "fall_time": lambda p: _transition(p, 1),
            "asymmetry": _asymmetry,
            "tilt": _tilt,
            "skewness": lambda p: p.moments[2],
            "deviation": lambda p: p.moments[1],
            "impulse": lambda p: p.moments[0],
            "energy": lambda p: p.energy,
            "size_free_index": lambda p: p.peak / p.duration**2,
            "spectral_centroid": lambda p: p.spectrum.moments[0],
            "spectral_bandwidth": lambda p: p.spectrum.moments[1],
            "spectral_rolloff": lambda p: p.spectrum.rolloff,
            "cutoff_10db": lambda p: p.spectrum.cutoff,
        }
    ),
    bank(
        "band_energy_*_hz",
        lambda p, n: p.spectrum.between(*_BANDS[n]),
        [f"{low}_{high}" for low, high in _BANDS],
    ),
    *described(
        {
            "fitted_peak": lambda p: p.fit.peak,
            "fitted_width": lambda p: p.fit.width / p.sampling_rate,
            "fitted_duration": lambda p: p.fit.duration / p.sampling_rate,
            "fitted_restitution": lambda p: p.fit.restitution,
            "fitted_restitution_deviation": lambda p: p.fit.restitution_deviation,
            "shrunken_restitution": lambda p: p.fit.expected_restitution,
            "shrunken_restitution_deviation": lambda p: p.fit.expected_deviation,
            "fitted_peak_deviation": lambda p: np.sqrt(p.fit.covariance[:, 0, 0]),
        }
    ),
    bank("pulse_shape_*", lambda p, n: p.residual.components[:, n], [str(n + 1) for n in range(N_SHAPES)]),
    *described(
        {
            "unexplained": lambda p: p.residual.unexplained,
            "misfit": lambda p: p.fit.misfit,
            "overload": lambda p: p.overload,
        }
    ),
)

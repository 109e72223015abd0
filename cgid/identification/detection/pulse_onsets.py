"""Onsets of force pulses: samples clear of the noise and of the ring-down of earlier impacts.

A pulse points upwards from a baseline that may drift. It begins where the signal rises above

    max(6 sigma, a(t), b(t))
    a(t) = max over s < t of 0.05 h(s) exp(-(t - s) / 10 ms)
    b(t) = max over s < t of 2 d(s) exp(-(t - s) / 20 ms)

with the noise sigma, the height h above the baseline, and the depth d below it where it exceeds 6 sigma. a excludes the
echoes of an impact, b excludes ring-down of 200 Hz or more, which swings below the baseline as far as above. Both end
after 5 ms without a sample beyond 6 sigma and with a power near that of the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.detection.events import Onset, Read

#: An impact rises above this many standard deviations of the noise.
THRESHOLD_OVER_NOISE = 6.0
#: An impact begins and ends at this fraction of its peak.
THRESHOLD_OVER_PEAK = 0.05
#: A new impact must rise above `THRESHOLD_OVER_PEAK` of the previous one, and above this many times the depth to which
#: the signal swings below its baseline.
RISE_OVER_SWING = 2.0
#: Ring-down does not swing deeper than this many times the height of the impact before it.
_DEEPEST = 2.0
#: Time constants of the decay of these two thresholds [s].
ECHO_TIME, SWING_TIME = 10e-3, 20e-3
#: Update interval of these thresholds [s].
_HOP_TIME = 0.5e-3
#: Ring-down has ended if the mean square over this time [s], a period of 200 Hz, is at most this many times the
#: noise's: an oscillation of 1.2 sigma, with crests far below the threshold.
_QUIET_TIME, _QUIET_POWER = 5e-3, 1.7
#: Differences below this fraction of the largest sample of this many latest windows (0.8 s) are rounding: six steps of
#: single precision. With a longer memory one loud sample would hide later impacts.
_ROUNDING, _ROUNDING_WINDOWS = 1e-6, 40
#: Length of the windows for the estimates of baseline and noise [s], and its minimum [samples].
_WINDOW_TIME, _MIN_WINDOW = 20e-3, 64
#: Approximate number of samples used of each window.
_N_SAMPLED = 128
_CHUNK_WINDOWS = 10
#: The baseline is the median over this many windows to either side (0.18 s in total), because it may drift.
_BASELINE_WINDOWS = 4
#: The noise is the median over this many windows before the end of the chunk (2 s).
_NOISE_WINDOWS = 100
#: The noise is at least the lowest of this many windows (0.2 s), so that rising noise raises the threshold sooner.
_RISING_WINDOWS = 10
#: Number of chunks needed for the first estimates.
START_CHUNKS = 2
#: Two peaks are separate if both reach this fraction of the highest, and the signal falls to that fraction in between.
_PEAK, _VALLEY = 0.5, 0.25


@dataclass(frozen=True, eq=False, repr=False)
class _Levels:
    """Baseline, noise limit, highest and lowest sample of each window, all (n_channels, n_windows)."""

    length: int
    baseline: Floats
    limit: Floats
    highest: Floats
    lowest: Floats


@dataclass(eq=False, repr=False)
class _AfterImpact:
    """State of a channel after its impacts: thresholds, heights, and quiet samples."""

    echo: float = 0.0
    swing: float = 0.0
    peak: float = 0.0
    quiet: int = 0  # samples since the last one beyond the noise
    energy: float = 0.0  # sum of their squares


@dataclass(eq=False, repr=False)
class _OpenPulse:
    """An impact in progress: indices, heights and limits of its high samples in each channel."""

    onset: Onset
    places: list[NDArray[np.intp]] = field(default_factory=list)
    heights: list[Floats] = field(default_factory=list)
    limits: list[Floats] = field(default_factory=list)


class PulseOnsets:
    """Find pulses in chunks of samples, in each channel or, if `joint`, in all together; nan is a missing sample."""

    # The noise is 1.4826 times the median absolute deviation; where most samples are equal, the smallest step below the
    # median. High samples at most `dead_time` [s] apart belong to one impact, which ends after `longest` samples at the
    # latest; a signal that stays high starts no new one until it falls. Onsets within `lag` samples of the end are
    # open.

    lag = 0

    def __init__(self, sampling_rate: float, n_channels: int, dead_time: float, longest: int, joint: bool) -> None:
        self._window = max(round(_WINDOW_TIME * sampling_rate), _MIN_WINDOW)
        self.chunk = _CHUNK_WINDOWS * self._window
        self._hop = max(round(_HOP_TIME * sampling_rate), 1)
        self._quiet = max(round(_QUIET_TIME * sampling_rate), 1)
        self._echo_rate, self._swing_rate = 1 / (ECHO_TIME * sampling_rate), 1 / (SWING_TIME * sampling_rate)
        self._gap = max(int(min(dead_time * sampling_rate, 2.0**60)), 1)
        self._longest = longest
        everything = list(range(n_channels))
        self._rows = [everything] if joint else [[channel] for channel in everything]
        self._taken = 0
        self._medians = np.zeros((n_channels, 0))
        self._noises = np.zeros((n_channels, 0))
        self._largest = np.zeros((n_channels, _ROUNDING_WINDOWS - 1))
        self._after = [_AfterImpact() for _ in range(n_channels)]
        self._open: list[_OpenPulse | None] = [None] * len(self._rows)
        # Including the last high sample of closed pulses.
        self._last: list[int | None] = [None] * len(self._rows)
        self.rise, self.fall, self.noise = np.zeros((3, n_channels))

    def take(self, samples: Floats, read: Read, n_known: int | None = None) -> list[Onset]:
        """Add chunks (n_channels, k chunk) with `n_known` real samples; return the pulses that begin."""
        ended = n_known is not None
        samples = samples[:, :n_known]
        onsets = []
        if samples.shape[1]:
            levels = self._levels_in(samples)
            high = [self._high_in(channel, channel_samples, levels) for channel, channel_samples in enumerate(samples)]
            for row, channels in enumerate(self._rows):
                places = high[channels[0]] if len(channels) == 1 else np.unique(np.concatenate(high))
                onsets += self._grouped(row, places, samples, levels, read)
        self._taken += samples.shape[1]
        for row, pulse in enumerate(self._open):
            if pulse is not None and (ended or self._is_over(row, pulse.onset)):
                self._close(row, read)
        return onsets

    # -- levels ---------------------------------------------------------------------------------------

    def _levels_in(self, samples: Floats) -> _Levels:
        n_channels, n_samples = samples.shape
        short = not self._taken and n_samples < START_CHUNKS * self.chunk
        length, step = (n_samples, 1) if short else (self._window, max(self._window // _N_SAMPLED, 1))
        n_windows = n_samples // length
        windows = samples[:, : n_windows * length].reshape(n_channels, n_windows, length)
        medians, noises = _median_and_noise(windows, step)
        medians = np.concatenate([self._medians, medians], axis=1)
        noises = np.concatenate([self._noises, noises], axis=1)
        before = self._medians.shape[1]
        self._medians, self._noises = medians[:, -_NOISE_WINDOWS:], noises[:, -_NOISE_WINDOWS:]
        shape, around = (n_channels, -(-n_samples // length)), np.arange(-_BASELINE_WINDOWS, _BASELINE_WINDOWS + 1)
        baseline, noise = np.empty(shape), np.empty(shape)
        for first in range(0, shape[1], _CHUNK_WINDOWS):
            stop = before + first + _CHUNK_WINDOWS
            if not self._taken:
                stop = max(stop, START_CHUNKS * _CHUNK_WINDOWS)
            # Windows after the chunk are not used: whether they are known yet depends on the blocks.
            stop = min(stop, medians.shape[1])
            chunk = slice(first, first + _CHUNK_WINDOWS)
            numbers = before + np.arange(first, min(chunk.stop, shape[1]))[:, None]
            window_index = np.clip(numbers + around, 0, stop - 1)
            baseline[:, chunk] = _median(medians[:, window_index])
            latest = np.clip(np.maximum(numbers, _RISING_WINDOWS - 1) - np.arange(_RISING_WINDOWS), 0, stop - 1)
            typical = _typical(noises[:, max(stop - _NOISE_WINDOWS, 0) : stop])[:, None]
            noise[:, chunk] = np.maximum(typical, np.fmin.reduce(noises[:, latest], axis=2))
        highest, lowest = np.empty(shape), np.empty(shape)
        highest[:, :n_windows], lowest[:, :n_windows] = _extremes(windows)
        if shape[1] > n_windows:
            highest[:, n_windows], lowest[:, n_windows] = _extremes(samples[:, n_windows * length :])
        # A window without samples has no largest one.
        largest = np.concatenate([self._largest, np.fmax(np.maximum(highest, -lowest), 0.0)], axis=1)
        self._largest = largest[:, largest.shape[1] - _ROUNDING_WINDOWS + 1 :]
        largest = np.lib.stride_tricks.sliding_window_view(largest, _ROUNDING_WINDOWS, axis=1).max(axis=-1)
        self.noise = np.where(np.isnan(noise[:, -1]), self.noise, noise[:, -1])
        self.rise = np.fmax(self.rise, np.fmax.reduce(highest - baseline, axis=1))
        self.fall = np.fmax(self.fall, np.fmax.reduce(baseline - lowest, axis=1))
        # Without a baseline or noise there is no impact: no comparison with nan is true.
        limit = np.maximum(THRESHOLD_OVER_NOISE * noise, _ROUNDING * largest)
        return _Levels(length, baseline, limit, highest, lowest)

    def _high_in(self, channel: int, samples: Floats, levels: _Levels) -> NDArray[np.intp]:
        """Return the indices of the samples (n,) of a channel that exceed noise and ring-down."""
        parts = [np.empty(0, np.intp)]
        after, length = self._after[channel], levels.length
        baselines, limits = levels.baseline[channel], levels.limit[channel]
        above = levels.highest[channel] - baselines > limits
        behind = 0
        for window in np.flatnonzero(above | (baselines - levels.lowest[channel] > limits)).tolist():
            first = window * length
            self._pass(first - behind, after)
            heights = samples[first : first + length] - baselines[window]
            heights[np.isnan(heights)] = 0.0
            needed = self._needed(heights, float(limits[window]), after)
            if above[window]:
                parts.append(np.flatnonzero(heights > needed) + first)
            behind = first + length
        self._pass(max(samples.size - behind, 0), after)
        return np.concatenate(parts) + self._taken

    def _pass(self, n_samples: int, after: _AfterImpact) -> None:
        """Decay the thresholds over samples within the noise."""
        swing_factor = math.exp(-n_samples * self._swing_rate)
        after.echo *= math.exp(-n_samples * self._echo_rate)
        after.swing, after.peak = after.swing * swing_factor, after.peak * swing_factor
        if n_samples:
            after.quiet, after.energy = 0, 0.0

    def _needed(self, heights: Floats, limit: float, after: _AfterImpact) -> Floats:
        """Return the threshold of each sample (n,), and update the state."""
        hops = np.arange(0, heights.size, self._hop)
        peaks, depths = np.maximum.reduceat(heights, hops), -np.minimum.reduceat(heights, hops)
        energies, sizes = np.add.reduceat(heights * heights, hops), np.diff(hops, append=heights.size)
        echo_factor, swing_factor = math.exp(-self._hop * self._echo_rate), math.exp(-self._hop * self._swing_rate)
        quiet_power = _QUIET_POWER * (limit / THRESHOLD_OVER_NOISE) ** 2
        needed = []
        hop_values = (values.tolist() for values in (peaks, depths, energies, sizes))
        for peak, depth, energy, size in zip(*hop_values, strict=True):
            needed.append(max(limit, after.echo, after.swing))
            after.peak = max(after.peak * swing_factor, peak)
            after.echo = max(after.echo * echo_factor, THRESHOLD_OVER_PEAK * peak)
            after.swing *= swing_factor
            # A swing deeper than any ring-down is the beginning of a downward pulse.
            if limit < depth < _DEEPEST * after.peak:
                after.swing = max(after.swing, RISE_OVER_SWING * depth)
            is_quiet = max(peak, depth) <= limit
            after.quiet, after.energy = (after.quiet + size, after.energy + energy) if is_quiet else (0, 0.0)
            if after.quiet >= self._quiet:  # both thresholds end after the ring-down
                if after.energy <= quiet_power * after.quiet:
                    after.echo = after.swing = 0.0
                after.quiet, after.energy = 0, 0.0
        return np.repeat(needed, self._hop)[: heights.size]

    # -- impacts ----------------------------------------------------------------------------------------

    def _grouped(self, row: int, places: NDArray[np.intp], samples: Floats, levels: _Levels, read: Read) -> list[Onset]:
        """Return the impacts that begin with these high samples."""
        if not places.size:
            return []
        groups, channels, inside = [], np.array(self._rows[row])[:, None], places - self._taken
        heights = samples[channels, inside] - levels.baseline[channels, inside // levels.length]
        limits = levels.limit[channels, inside // levels.length]
        bounds = [0, *(np.flatnonzero(np.diff(places) > self._gap) + 1).tolist(), places.size]
        for begin, stop in pairwise(bounds):
            first, latest = int(places[begin]), self._last[row]
            if latest is None or first - latest > self._gap:
                self._close(row, read)
                baseline = levels.baseline[:, int(inside[begin]) // levels.length].copy()
                onset = Onset(row, self._rows[row][0], first, noise=baseline, closed=False)
                self._open[row] = _OpenPulse(onset)
                groups.append(onset)
            self._last[row] = int(places[stop - 1])
            pulse = self._open[row]
            if pulse is not None:
                of_impact = slice(begin, int(np.searchsorted(places[:stop], pulse.onset.sample + self._longest)))
                pulse.places.append(places[of_impact])
                pulse.heights.append(heights[:, of_impact])
                pulse.limits.append(limits[:, of_impact])
                if of_impact.stop < stop:
                    self._close(row, read)
        return groups

    def _is_over(self, row: int, onset: Onset) -> bool:
        latest = self._last[row]
        assert latest is not None
        return self._taken - latest > self._gap or self._taken >= onset.sample + self._longest

    def end_of(self, onset: Onset, samples: Floats) -> int:
        """Return the number of samples from its onset to the end of an impact."""
        assert onset.last is not None
        return onset.last + 1 - onset.sample

    def _close(self, row: int, read: Read) -> None:
        """End the open impact of a row, and trim it to the crossings of a fraction of its peak."""
        pulse = self._open[row]
        self._open[row] = None
        if pulse is None:
            return
        onset, places = pulse.onset, np.concatenate(pulse.places)
        heights, limits = np.concatenate(pulse.heights, axis=1), np.concatenate(pulse.limits, axis=1)
        highest = np.fmax.reduce(heights, axis=1, keepdims=True)
        excess = np.nan_to_num(heights - np.maximum(limits, THRESHOLD_OVER_PEAK * highest), nan=-np.inf, posinf=np.inf)
        above = np.flatnonzero((excess > 0).any(axis=0))
        if above.size == 0:
            above = np.arange(places.size)
        onset.channel = self._rows[row][int(np.argmax(excess[:, above[0]]))]
        onset.sample, onset.last, onset.closed = int(places[above[0]]), int(places[above[-1]]), True
        excess_samples = read(onset.sample, onset.last + 1)[onset.channel] - onset.noise[onset.channel]
        onset.again = onset.last if _has_two_peaks(excess_samples) else None


def _median_and_noise(windows: Floats, step: int) -> tuple[Floats, Floats]:
    """Return both for windows (..., n_samples), from every `step`-th sample; nan where most of these are missing."""
    sampled = windows[..., ::step]
    median = _median(sampled)
    if np.isnan(sampled).any():
        median[np.isnan(sampled).mean(axis=-1) > 0.5] = np.nan
    noise = 1.4826 * _median(np.abs(sampled - median[..., None]))
    for index in np.argwhere(noise == 0):
        where = tuple(index)
        below = median[where] - windows[where]
        below = below[below > 0]
        noise[where] = below.min() if below.size else 0.0
    return median, noise


def _median(values: Floats) -> Floats:
    """Return the median along the last axis, of what is not nan; `np.median` would import `numpy.ma` for a few."""
    below, above = (values.shape[-1] - 1) // 2, values.shape[-1] // 2
    ordered = np.partition(values, (below, above), axis=-1)
    medians = np.asarray(0.5 * (ordered[..., below] + ordered[..., above]))
    lacking = np.isnan(values)
    if lacking.any():
        for index in map(tuple, np.argwhere(lacking.any(axis=-1))):
            present = values[index][~lacking[index]]
            medians[index] = _median(present) if present.size else np.nan
    return medians


def _extremes(windows: Floats) -> tuple[Floats, Floats]:
    """Return the highest and the lowest sample along the last axis, nan where all are missing."""
    highest, lowest = windows.max(axis=-1), windows.min(axis=-1)
    if np.isnan(highest).any():
        highest, lowest = np.fmax.reduce(windows, axis=-1), np.fmin.reduce(windows, axis=-1)
    return highest, lowest


def _typical(noises: Floats) -> Floats:
    """Return the median noise (n_channels,) over windows (n_channels, n), of those with noise if most have none."""
    typical = _median(noises)
    for channel in np.flatnonzero(typical == 0):
        some = noises[channel][noises[channel] > 0]
        typical[channel] = _median(some) if some.size else 0.0
    return np.asarray(typical)


def _has_two_peaks(heights: Floats) -> bool:
    """Return whether two high parts are separated by a valley."""
    top = heights.max()
    high = np.flatnonzero(heights > _PEAK * top)
    low = np.flatnonzero(heights < _VALLEY * top)
    return bool(np.any(np.searchsorted(low, high[1:]) > np.searchsorted(low, high[:-1])))

"""Where pulses begin: what rises above the baseline, each blow once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.identification.events import Onset, Read
from cgid.validation import Floats

#: An impact rises above this many standard deviations of the noise,
THRESHOLD_OVER_NOISE = 6.0
#: and above this share of the largest sample of its window and the two before: a struck body rings.
THRESHOLD_OVER_PEAK = 0.05
#: Baseline and noise are told by windows of this length [s], or of so many samples,
_WINDOW_TIME, _SHORTEST_WINDOW = 20e-3, 64
#: of which about so many samples are looked at.
_LOOKED_AT = 128
_CHUNK_WINDOWS = 10
#: The baseline is the median of so many windows to either side (0.18 s in all), for it may drift,
_BASELINE_WINDOWS = 4
#: the noise that of so many before the end of the chunk (2 s).
_NOISE_WINDOWS = 100
#: The first chunks wait until so many are there to tell them.
START_CHUNKS = 2
#: What follows a first peak is a second one if both have this share of the highest, and that share lies between.
_PEAK, _VALLEY = 0.5, 0.25


@dataclass(frozen=True)
class _Levels:
    """Baseline of each window (n_channels, n_windows), and how far a sample of it must rise above that."""

    length: int
    baseline: Floats
    threshold: Floats


class PulseOnsets:
    """Pulses, channel by channel or in all together, from chunks of samples.

    The noise is the median absolute deviation from the median, times 1.4826; where most samples are equal, the smallest
    step below the median. A recording shorter than `START_CHUNKS` is one window.

    Parameters
    ----------
    sampling_rate : float
        [Hz].
    n_channels : int
    dead_time : float
        High samples no further apart belong to the same blow [s].
    longest : int
        A blow ends after so many samples at the latest; what stays high is not a new one until it falls.
    joint : bool
        Whether a pulse in one channel is one in all.

    Attributes
    ----------
    chunk : int
        Samples that are taken at once, or multiples of it; the first time `START_CHUNKS` at least.
    lag : int
        What begins so many samples before the end of what was taken may not be known yet.
    """

    lag = 0

    def __init__(self, sampling_rate: float, n_channels: int, dead_time: float, longest: int, joint: bool) -> None:
        self._window = max(round(_WINDOW_TIME * sampling_rate), _SHORTEST_WINDOW)
        self.chunk = _CHUNK_WINDOWS * self._window
        self._gap = max(int(min(dead_time * sampling_rate, 2.0**60)), 1)
        self._longest = longest
        self._joint = joint
        self._taken = 0
        self._medians = np.zeros((n_channels, 0))
        self._noises = np.zeros((n_channels, 0))
        self._highest = np.full((n_channels, 2), -np.inf)
        self._open: list[Onset | None] = [None] * (1 if joint else n_channels)
        # The last high sample of each row, whether its blow is closed or not.
        self._last: list[int | None] = [None] * len(self._open)

    def take(self, samples: Floats, read: Read, n_known: int | None = None) -> list[Onset]:
        """Take the next chunks and return the pulses that begin in them.

        Parameters
        ----------
        samples : ndarray, (n_channels, k chunk)
        read : callable
            Returns the samples (n_channels, n) between two numbers, as far as they are there.
        n_known : int, optional
            With the last chunk: samples that are really there.
        """
        ended = n_known is not None
        samples = samples[:, :n_known]
        found = []
        if samples.shape[1]:
            levels = self._levels_in(samples)
            for row, places in enumerate(self._high_in(samples, levels)):
                found += self._grouped(row, places, samples, levels, read)
        self._taken += samples.shape[1]
        for row, onset in enumerate(self._open):
            if onset is not None and (ended or self._is_over(row, onset)):
                self._close(row, read)
        return found

    # -- levels ---------------------------------------------------------------------------------------

    def _levels_in(self, samples: Floats) -> _Levels:
        n_channels, n_samples = samples.shape
        short = not self._taken and n_samples < START_CHUNKS * self.chunk
        length, step = (n_samples, 1) if short else (self._window, max(self._window // _LOOKED_AT, 1))
        whole = n_samples // length
        windows = samples[:, : whole * length].reshape(n_channels, whole, length)
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
            stop = min(stop, medians.shape[1])
            chunk = slice(first, first + _CHUNK_WINDOWS)
            # Of what comes after the chunk nothing is known yet.
            near = np.clip(before + np.arange(first, min(chunk.stop, shape[1]))[:, None] + around, 0, stop - 1)
            baseline[:, chunk] = np.median(medians[:, near], axis=2)
            noise[:, chunk] = _typical(noises[:, max(stop - _NOISE_WINDOWS, 0) : stop])[:, None]
        highest = np.empty(shape)
        highest[:, :whole] = windows.max(axis=2)
        if shape[1] > whole:
            highest[:, whole] = samples[:, whole * length :].max(axis=1)
        peaks = np.concatenate([self._highest, highest - baseline], axis=1)
        self._highest = peaks[:, -2:]
        peak = np.maximum(np.maximum(peaks[:, :-2], peaks[:, 1:-1]), peaks[:, 2:])
        return _Levels(length, baseline, np.maximum(THRESHOLD_OVER_NOISE * noise, THRESHOLD_OVER_PEAK * peak))

    def _high_in(self, samples: Floats, levels: _Levels) -> list[NDArray[np.intp]]:
        """Return the numbers of the high samples of each row."""
        rows = []
        for channel, own in enumerate(samples):
            parts = [np.empty(0, np.intp)]
            for window, (base, threshold) in enumerate(
                zip(levels.baseline[channel].tolist(), levels.threshold[channel].tolist(), strict=True)
            ):
                part = own[window * levels.length : (window + 1) * levels.length]
                if part.max() - base > threshold:
                    parts.append(np.flatnonzero(part - base > threshold) + window * levels.length)
            rows.append(np.concatenate(parts))
        if self._joint:
            rows = [np.unique(np.concatenate(rows))]
        return [places + self._taken for places in rows]

    # -- blows ----------------------------------------------------------------------------------------

    def _grouped(self, row: int, places: NDArray[np.intp], samples: Floats, levels: _Levels, read: Read) -> list[Onset]:
        """Return the blows that begin with some of these high samples."""
        found = []
        breaks = np.flatnonzero(np.diff(places) > self._gap) + 1
        for part in np.split(places, breaks) if places.size else ():
            first, latest = int(part[0]), self._last[row]
            if latest is None or first - latest > self._gap:
                self._close(row, read)
                self._open[row] = onset = self._begun(row, first, samples, levels)
                found.append(onset)
            self._last[row] = int(part[-1])
            begun = self._open[row]
            if begun is not None:
                inside = part[part < begun.sample + self._longest]
                begun.last = int(inside[-1]) if inside.size else begun.last
                if self._last[row] != begun.last:
                    self._close(row, read)
        return found

    def _begun(self, row: int, first: int, samples: Floats, levels: _Levels) -> Onset:
        place = first - self._taken
        window = place // levels.length
        channel = row
        if self._joint:
            excess = samples[:, place] - levels.baseline[:, window] - levels.threshold[:, window]
            channel = int(np.argmax(excess))
        return Onset(row, channel, first, noise=levels.baseline[:, window].copy(), closed=False)

    def _is_over(self, row: int, onset: Onset) -> bool:
        latest = self._last[row]
        assert latest is not None
        return self._taken - latest > self._gap or self._taken >= onset.sample + self._longest

    def end_of(self, onset: Onset, samples: Floats) -> int:
        """Return after how many samples from its onset on a blow is over."""
        assert onset.last is not None
        return onset.last + 1 - onset.sample

    def _close(self, row: int, read: Read) -> None:
        onset = self._open[row]
        self._open[row] = None
        if onset is None:
            return
        assert onset.last is not None
        onset.closed = True
        heights = read(onset.sample, onset.last + 1)[onset.channel] - onset.noise[onset.channel]
        onset.again = onset.last if _has_two_peaks(heights) else None


def _median_and_noise(windows: Floats, step: int) -> tuple[Floats, Floats]:
    """Return both for windows (..., n_samples), from every so many of their samples."""
    looked = windows[..., ::step]
    median = np.median(looked, axis=-1)
    noise = 1.4826 * np.median(np.abs(looked - median[..., None]), axis=-1)
    for place in np.argwhere(noise == 0):
        where = tuple(place)
        below = median[where] - windows[where]
        below = below[below > 0]
        noise[where] = below.min() if below.size else 0.0
    return median, noise


def _typical(noises: Floats) -> Floats:
    """Return the median noise (n_channels,) of windows (n_channels, n), of those that have any where most have none."""
    found = np.median(noises, axis=1)
    for channel in np.flatnonzero(found == 0):
        some = noises[channel][noises[channel] > 0]
        found[channel] = np.median(some) if some.size else 0.0
    return np.asarray(found)


def _has_two_peaks(heights: Floats) -> bool:
    """Return whether two high stretches have a valley between them."""
    top = heights.max()
    high = np.flatnonzero(heights > _PEAK * top)
    low = np.flatnonzero(heights < _VALLEY * top)
    return bool(np.any(np.searchsorted(low, high[1:]) > np.searchsorted(low, high[:-1])))

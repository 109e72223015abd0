"""Onsets of impacts in vibrations: a sudden rise of the energy in most bands.

The ring-down of a beam lasts longer than the time to the next rock, and motors hum, so no level indicates an impact.
But an impact brings energy to several bands within a millisecond, while ring-down only decays and noise is stationary.
In each of `BANDS`, the energy of the next 2 ms is divided by that of the 4 ms before, or by the noise of the band if
that is more. The rise is the squared mean of the square roots of these ratios, so that two beating modes in one band do
not decide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.detection.events import Onset, Read

#: Single precision suffices for sums of a few energies; halving the memory nearly halves the time.
Singles = NDArray[np.float32]

#: Energies are of windows of two hops, one hop apart. Length of a hop [s], and its minimum [samples].
HOP_TIME, _MIN_HOP = 0.5e-3, 8
#: Centre frequencies of the bands, as multiples of one over the window's length: 0.8 to 8 kHz with windows of 1 ms.
#: Bands above `HIGHEST` times the sampling rate are left out.
BANDS = (0.8, 1.6, 2.4, 3.2, 4.0, 5.0, 6.0, 8.0)
HIGHEST = 0.45
#: An impact is where the rise exceeds this.
RISE = 3.0
#: The energy of an impact is also this many times that of the noise. White noise alone does not reach it in ten
#: minutes; at 10 kHz, where windows have few samples, it does two or three times.
RISE_OVER_NOISE = 3.2
#: Hops compared: after and before a point, with one hop in between.
_NOW, _BEFORE = 3, 8
#: An impact affects the rise for this many hops. After that, another impact within the dead time is detectable.
_REACH = 8
#: Length of the windows for the noise, a mean energy in each band [hops]: 20 ms, a period of the mains.
_WINDOW_HOPS = 40
#: Windows of a chunk.
_CHUNK_WINDOWS = 10
#: The noise is this quantile of this many latest windows (0.4 s), because most of the others contain ring-down.
_QUIET_SHARE, _N_WINDOWS = 0.2, 20
#: Ratio of the mean to this quantile, for white noise in windows of that many hops.
_QUIET_FACTOR = 1.2
#: Number of chunks needed for the first estimate of the noise.
START_CHUNKS = 2
#: Energy below this fraction of the maximum of this many latest chunks (0.8 s) is rounding, not vibration. With a
#: longer memory one loud sample would hide later impacts.
_ROUNDING, _N_CHUNKS = 1e-10, 4
#: Upper limit of scaled samples, lower limit of energies.
_LARGEST, _TINY = np.float32(1e15), np.float32(1e-30)
#: An event ends when its energy over that of the noise has fallen to this fraction of its maximum, or to this value.
END_SHARE, END_OVER_NOISE = 0.01, 2.0
#: The onset is determined from differences of the signal at no more than this rate [Hz].
_ONSET_RATE = 25_600.0


class VibrationOnsets:
    """Find impacts in chunks of vibrations, by channel or, if `joint`, in all together; nan is missing."""

    # A rise within `dead_time` [s], at least 4 ms, is not a new impact. Onsets within `lag` samples of the end are
    # open; `steepest` is the highest rise so far (n_channels,), an impact is above `RISE`.

    def __init__(self, sampling_rate: float, n_channels: int, dead_time: float, joint: bool) -> None:
        self.hop = max(round(HOP_TIME * sampling_rate), _MIN_HOP)
        self.chunk = _CHUNK_WINDOWS * _WINDOW_HOPS * self.hop
        self.lag = 8 * self.hop
        self._sampling_rate = sampling_rate
        self._atoms = _atoms(self.hop).astype(np.float32)
        self.n_bands = self._atoms.shape[1] // 4
        self._dead = max(int(min(dead_time * sampling_rate / self.hop, 2.0**60)), _REACH)
        self._joint = joint
        self._n_hops = 0
        self._offset: Floats = np.full((n_channels, 1), np.nan)
        self._scale = np.zeros((n_channels, 1))
        self._halves = np.zeros((n_channels, 2 * self.n_bands), np.float32)
        self._energies = np.zeros((n_channels, _NOW + _BEFORE, self.n_bands), np.float32)
        self._windows = np.zeros((n_channels, 0, self.n_bands), np.float32)
        self._max_energy = np.zeros((n_channels, _N_CHUNKS - 1, self.n_bands), np.float32)
        self._rises = np.zeros((n_channels, 0), np.float32)
        self._latest: list[tuple[int, Onset] | None] = [None] * (1 if joint else n_channels)
        self.steepest = np.zeros(n_channels)

    # -- energies -------------------------------------------------------------------------------------

    def _scaled(self, samples: Floats) -> Singles:
        """Return samples (n_channels, n) in single precision, of order 1, about the median of the first chunk."""
        # The unit is a power of two, from the first chunk that is not silent.
        for channel in np.flatnonzero(np.isnan(self._offset[:, 0])):
            for chunk in samples[channel].reshape(-1, self.chunk):
                there = chunk[~np.isnan(chunk)]
                if there.size:
                    self._offset[channel] = np.partition(there, there.size // 2)[there.size // 2]
                    break
        moved = samples - self._offset
        for channel in np.flatnonzero(self._scale == 0):
            highest = np.fmax.reduce(np.abs(moved[channel]).reshape(-1, self.chunk), axis=1)
            for size in highest[highest > 0][:1]:
                self._scale[channel] = 2.0 ** -np.clip(np.frexp(size)[1], -500, 500)
        return _single(moved * self._scale)

    def _energies_of(self, samples: Singles) -> Singles:
        """Return the energies (n_channels, n_hops, n_bands) of the windows that end with each hop."""
        n_channels, n_samples = samples.shape
        # A window is two hops, so each hop yields the halves of two windows at once. All matrices in the products have
        # one size, whatever the number of chunks, because the order of sums depends on it.
        hops = samples.reshape(n_channels, -1, _CHUNK_WINDOWS * _WINDOW_HOPS, self.hop)
        halves = np.matmul(hops, self._atoms).reshape(n_channels, n_samples // self.hop, 4 * self.n_bands)
        early, late = halves[..., : 2 * self.n_bands], halves[..., 2 * self.n_bands :]
        late[:, 1:] += early[:, :-1]
        late[:, 0] += self._halves
        self._halves = early[:, -1].copy()
        late *= late
        energies: Singles = late[..., : self.n_bands] + late[..., self.n_bands :]
        if self._n_hops == 0:
            energies[:, 0] = energies[:, 1]  # nothing precedes the first hop
        return energies

    def _floors_of(self, energies: Singles, n_known: int) -> tuple[Singles, Singles]:
        """Return noise and rounding in each chunk, both (n_channels, n_chunks, n_bands), of `n_known` real hops."""
        n_channels, _, n_bands = energies.shape
        means = _window_means(energies)
        highest = np.fmax.reduce(means.reshape(n_channels, -1, _CHUNK_WINDOWS, n_bands), axis=2)
        # A chunk without a complete window has no largest one.
        max_energy = np.concatenate([self._max_energy, np.fmax(highest, np.float32(0))], axis=1)
        self._max_energy = max_energy[:, max_energy.shape[1] - _N_CHUNKS + 1 :]
        max_energy = np.lib.stride_tricks.sliding_window_view(max_energy, _N_CHUNKS, axis=1).max(axis=-1)
        n_kept = self._windows.shape[1]
        means = means[:, : n_known // _WINDOW_HOPS]
        if not n_kept and means.shape[1] < _CHUNK_WINDOWS:
            # The recording ends too early for full windows: take shorter ones.
            length = max(n_known // (2 * _CHUNK_WINDOWS), 1)
            shorter = energies[:, : n_known // length * length]
            means = shorter.reshape(n_channels, -1, length, n_bands).mean(axis=2)
        windows = np.concatenate([self._windows, means], axis=1)
        self._windows = windows[:, -_N_WINDOWS:]
        noise = np.empty_like(highest)
        for number in range(noise.shape[1]):
            stop = n_kept + _CHUNK_WINDOWS * (number + 1)
            if not self._n_hops:
                stop = max(stop, START_CHUNKS * _CHUNK_WINDOWS)
            latest = windows[:, max(min(stop, windows.shape[1]) - _N_WINDOWS, 0) : stop]
            index = int(_QUIET_SHARE * latest.shape[1])
            noise[:, number] = np.partition(latest, index, axis=1)[:, index]
            lacking = np.isnan(latest).any(axis=(1, 2))
            for channel in np.flatnonzero(lacking).tolist():
                quiet = latest[channel][~np.isnan(latest[channel]).any(axis=1)]
                index = int(_QUIET_SHARE * len(quiet))
                noise[channel, number] = np.partition(quiet, index, axis=0)[index] if len(quiet) else np.nan
        return np.float32(_QUIET_FACTOR) * noise, np.float32(_ROUNDING) * max_energy

    def _rises_of(self, energies: Singles, noise: Singles, rounding: Singles) -> Singles:
        """Return the rise at each hop (n_channels, n_hops), three hops late, because it looks ahead by that much."""
        n_channels, n_hops, n_bands = energies.shape
        joined = np.concatenate([self._energies, energies], axis=1)
        self._energies = joined[:, n_hops:]
        before = joined[:, :-1] + joined[:, 1:]
        before = before[:, :-2] + before[:, 2:]
        before = before[:, :n_hops] + before[:, 4 : n_hops + 4]
        now = joined[:, 9 : n_hops + 9] + joined[:, 10 : n_hops + 10]
        now += joined[:, 11:]
        lowest = np.maximum(np.maximum(np.float32(RISE_OVER_NOISE / RISE) * noise, rounding), _TINY)
        shape = (n_channels, noise.shape[1], -1, n_bands)
        before = np.maximum(before.reshape(shape), np.float32(_BEFORE) * lowest[:, :, None])
        ratio = now.reshape(shape)
        ratio /= before
        np.sqrt(ratio, out=ratio)
        # Sum band by band: how numpy splits a sum depends on its shape.
        rise = ratio[..., 0].copy()
        for band in range(1, n_bands):
            rise += ratio[..., band]
        rise *= np.float32(np.sqrt(_BEFORE / _NOW) / n_bands)
        rise *= rise
        # Where a sample or the noise is missing, nothing rises.
        rise[np.isnan(rise)] = 0.0
        return np.asarray(rise.reshape(n_channels, n_hops))

    # -- impacts ----------------------------------------------------------------------------------------

    def take(self, samples: Floats, read: Read, n_known: int | None = None) -> list[Onset]:
        """Take chunks (n_channels, k chunk) with `n_known` real samples; return the impacts that begin."""
        n_hops = samples.shape[1] // self.hop
        known = n_hops if n_known is None else n_known // self.hop
        if known == 0:
            return []
        energies = self._energies_of(self._scaled(samples))
        noise, rounding = self._floors_of(energies, known)
        rises = np.concatenate([self._rises, self._rises_of(energies, noise, rounding)], axis=1)
        first = self._n_hops - self._rises.shape[1]
        self._n_hops += n_hops
        # An impact is at the maximum of the rise within three hops.
        n_decided = rises.shape[1] - 2 if n_known is None else rises.shape[1] - n_hops + known
        self._rises = rises[:, n_decided:]
        rows = rises.max(axis=0, keepdims=True) if self._joint else rises
        onsets = []
        decided = rises[:, : max(n_decided, 0)]
        self.steepest = np.maximum(self.steepest, decided.max(axis=1, initial=0.0))
        there = min(rises.shape[1], n_decided + (2 if n_known is None else 0))
        for row in range(len(rows)):
            for index in np.flatnonzero(rows[row, :n_decided] > RISE).tolist():
                if not self._is_new(row, first + index):
                    continue
                top = index + int(np.argmax(rows[row, index : min(index + 3, there)]))
                channel = int(np.argmax(rises[:, top])) if self._joint else row
                # The chunk that determined the location.
                chunk = (first + index + 2 - (self._n_hops - n_hops)) // (self.chunk // self.hop)
                level = noise[channel, min(chunk, noise.shape[1] - 1)]
                onsets.append(self._impact(row, channel, first + top, level, read))
        return onsets

    def _is_new(self, row: int, index: int) -> bool:
        latest = self._latest[row]
        if latest is None or index > latest[0] + self._dead:
            return True
        if index >= latest[0] + _REACH:
            latest[1].again = latest[1].again or index * self.hop
        return False

    def _impact(self, row: int, channel: int, index: int, noise: Floats, read: Read) -> Onset:
        start = max((index - 5) * self.hop, 0)
        samples = read(start, index * self.hop)[channel]
        sample = start + onset_in(samples, max(round(self._sampling_rate / _ONSET_RATE), 1))
        latest = self._latest[row]
        if latest is not None:
            sample = max(sample, latest[1].sample + 1)
        impact = Onset(row, channel, sample, noise=noise)
        self._latest[row] = (index, impact)
        return impact

    def end_of(self, onset: Onset, samples: Floats) -> int:
        """Return the duration of an event in samples from its onset, -1 if it is longer than these samples (n,)."""
        n_hops = samples.size // self.hop
        if n_hops < 2:
            return -1
        moved = (samples[: n_hops * self.hop] - self._offset[onset.channel]) * self._scale[onset.channel]
        halves = np.clip(moved, -_LARGEST, _LARGEST).reshape(n_hops, self.hop) @ self._atoms
        windows = halves[:-1, : 2 * self.n_bands] + halves[1:, 2 * self.n_bands :]
        windows *= windows
        energies = windows[:, : self.n_bands] + windows[:, self.n_bands :]
        floor = np.maximum(onset.noise, np.maximum(_ROUNDING * energies.max(axis=0), _TINY))
        level = energies @ (1 / floor)
        smooth = np.convolve(level, np.full(4, 0.25 / self.n_bands))[: level.size]
        top = int(np.argmax(smooth))
        over = smooth[top:] < max(END_SHARE * smooth[top], END_OVER_NOISE)
        index = int(np.argmax(over))
        return max(top + index, 1) * self.hop if over[index] else -1


def _single(samples: Floats) -> Singles:
    """Return samples in single precision, limited so that their squares are finite."""
    with np.errstate(over="ignore"):
        return np.clip(samples.astype(np.float32), -_LARGEST, _LARGEST)


def _window_means(energies: Singles) -> Singles:
    """Return the mean energies of windows (n_channels, n_windows, n_bands) from (n_channels, n_hops, n_bands)."""
    n_channels, n_hops, n_bands = energies.shape
    # Adding halves, which are long rows, down to five hops is several times faster than numpy's mean.
    sums = energies.reshape(n_channels, n_hops // _WINDOW_HOPS, _WINDOW_HOPS * n_bands)
    while sums.shape[2] > 5 * n_bands:
        half = sums.shape[2] // 2
        sums = sums[..., :half] + sums[..., half:]
    return np.asarray(sums.reshape(n_channels, -1, 5, n_bands).sum(axis=2) / np.float32(_WINDOW_HOPS))


def _atoms(hop: int) -> Floats:
    """Return the matrix (hop, 4 n_bands) from a hop to the cosines and sines of all bands in its two windows."""
    # Constants and slow curves, up to the second degree, have no energy.
    length = 2 * hop
    time = np.arange(length)
    bands = np.array([band for band in BANDS if band <= HIGHEST * length])
    turns = 2 * np.pi * np.outer(time, bands / length)
    bell = np.hanning(length + 2)[1:-1, None]
    waves = np.concatenate([bell * np.cos(turns), bell * np.sin(turns)], axis=1) / np.sqrt(np.sum(bell**2))
    curves = np.linalg.qr(np.vander(np.linspace(-1, 1, length), 3))[0]
    waves -= curves @ (curves.T @ waves)
    return np.ascontiguousarray(np.concatenate([waves[:hop], waves[hop:]], axis=1))


def onset_in(samples: Floats, width: int) -> int:
    """Return the onset in the samples (n,): where one variance changes to another (Akaike's criterion; Maeda 1985)."""
    if width > 1:
        sums = np.append(0.0, np.cumsum(samples - samples[:1]))
        averages = (sums[width:] - sums[:-width]) / width
        differences, behind = averages[width:] - averages[:-width], width
    else:
        differences, behind = np.diff(samples), 1
    n = differences.size
    if n < 8:
        return 0
    energy = np.cumsum(differences**2)
    count = np.arange(2, n - 2)
    lowest = max(energy[-1] * _ROUNDING, np.finfo(np.float64).tiny)
    early = np.maximum(energy[count - 1], lowest) / count
    late = np.maximum(energy[-1] - energy[count - 1], lowest) / (n - count)
    return int(count[np.argmin(count * np.log(early) + (n - count) * np.log(late))]) + behind

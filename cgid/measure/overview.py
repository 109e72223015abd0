"""The overview of a recording for a picture: a few thousand numbers for any length, computed block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, require_rate
from cgid.errors import BadData, InvalidValue

#: Maximum number of columns of a waveform; at least half of them are used if the recording has enough samples.
WAVEFORM_COLUMNS = 4096
#: Maximum number of columns of a spectrogram, and approximate number of its bands, evenly spaced in log frequency.
SPECTROGRAM_COLUMNS, SPECTROGRAM_BANDS = 1024, 200
#: Longest segment of the spectra [s].
MAX_SEGMENT_TIME = 0.2
#: Shortest and longest segment [samples], powers of two; shorter only for a recording that is shorter itself.
SEGMENTS = (64, 8192)
#: Least length of the recording over that of a segment, within these bounds.
_SEGMENTS_IN_RECORDING = 64
#: Shortest segment with a useful spectrum [samples].
_MIN_SEGMENT = 16
#: Samples per channel and segments processed at once: bounds the memory for blocks of any size.
_SAMPLES_AT_ONCE, _SEGMENTS_AT_ONCE = 65536, 64
#: Largest sample: larger ones are no measurements, and their power overflows.
_LARGEST = 1e140


@dataclass(frozen=True, kw_only=True, eq=False)
class Overview:
    """The content of a recording's picture; its size hardly depends on the length of the recording."""

    sampling_rate: float
    n_samples: int  # per channel
    waveform_step: int  # samples per column of the waveform; the last column may have fewer
    lowest: Floats  # `lowest`, `highest`: smallest and largest sample of each column, (n_channels, n_columns)
    highest: Floats
    mean: Floats  # `mean`, `deviation`: mean and standard deviation of all samples, (n_channels,)
    deviation: Floats
    frequency: Floats  # (n_bins,) [Hz]; empty if the recording is too short for a spectrum
    # one-sided power density, (n_channels, n_bins) [unit^2/Hz]; mean over half-overlapping Hann windows, each less its
    # mean (Welch)
    spectrum: Floats
    band_edges: Floats  # of the spectrogram, (n_bands + 1,) [Hz]; a band is one bin or several, without 0 Hz
    # of the spectrogram, (n_times + 1,) [s]; all columns but the last have the same number of segments
    time_edges: Floats
    spectrogram: Floats  # mean power density, (n_channels, n_bands, n_times) [unit^2/Hz]

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return self.n_samples / self.sampling_rate

    @property
    def waveform_edges(self) -> Floats:
        """Edges of the columns of the waveform [s], (n_columns + 1,)."""
        samples = np.arange(self.lowest.shape[1] + 1, dtype=np.float64) * self.waveform_step
        return np.asarray(np.minimum(samples, self.n_samples) / self.sampling_rate)


class OverviewStream:
    """Compute the overview of a recording that comes in blocks, in constant memory (about 10 MB per channel)."""

    def __init__(self, sampling_rate: float, n_channels: int = 1, source: str = "recording") -> None:
        self._rate = require_rate(sampling_rate)
        self._source = source
        self._n_channels = validation.count("n_channels", n_channels)
        self._lowest = _Columns(np.minimum, (n_channels,), WAVEFORM_COLUMNS)
        self._highest = _Columns(np.maximum, (n_channels,), WAVEFORM_COLUMNS)
        self._mean, self._squares = np.zeros(n_channels), np.zeros(n_channels)
        # The first samples wait: a short recording needs shorter segments.
        self._waiting: list[Floats] = []
        self._spectra: _Spectra | None = None

    def feed(self, block: NDArray[Any]) -> None:
        """Add samples (n_channels, n_samples); nan is missing, and counts as the mean."""
        block = validation.plain("block", block)
        if block.ndim != 2 or len(block) != self._n_channels:
            raise InvalidValue(f"block must be of shape ({self._n_channels}, n_samples), got shape {block.shape}")
        for start in range(0, block.shape[1], _SAMPLES_AT_ONCE):
            self._take(block[:, start : start + _SAMPLES_AT_ONCE].astype(np.float64))

    def watching(self, blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield blocks unchanged, and take their first channels, as many as the overview has."""
        for block in blocks:
            self.feed(block[: self._n_channels])
            yield block

    def overview(self) -> Overview:
        """Return the overview of the samples so far; more may follow. Raise `BadData` without samples."""
        n_samples = self._lowest.taken
        if not n_samples:
            raise BadData(f"{self._source}: the recording must have at least one sample, got none; record it again")
        spectra = self._spectra
        if spectra is None:
            spectra = _Spectra(self._rate, self._n_channels, segment_length(self._rate, n_samples))
            for samples in self._waiting:
                spectra.feed(samples)
        return Overview(
            sampling_rate=self._rate,
            n_samples=n_samples,
            waveform_step=self._lowest.step,
            lowest=self._lowest.values(),
            highest=self._highest.values(),
            mean=self._mean.copy(),
            deviation=np.sqrt(self._squares / n_samples),
            frequency=spectra.frequency,
            spectrum=spectra.mean(),
            band_edges=spectra.band_edges,
            time_edges=spectra.time_edges(),
            spectrogram=spectra.spectrogram(),
        )

    def _take(self, samples: Floats) -> None:
        missing = np.isnan(samples)
        if missing.any():
            samples = np.where(missing, self._mean[:, np.newaxis], samples)
        largest = max(samples.max(), -samples.min())
        if not largest <= _LARGEST:
            raise BadData(
                f"{self._source}: samples must be within +-{_LARGEST:g} to be plotted, got {largest:.3g}; was the file "
                "read in the right format?"
            )
        self._add_moments(samples)
        self._lowest.add(samples)
        self._highest.add(samples)
        if self._spectra is None:
            self._waiting.append(samples)
            longest = segment_length(self._rate, None)
            if self._lowest.taken < _SEGMENTS_IN_RECORDING * longest:
                return
            self._spectra = _Spectra(self._rate, self._n_channels, longest)
            for waiting in self._waiting:
                self._spectra.feed(waiting)
            self._waiting = []
        else:
            self._spectra.feed(samples)

    def _add_moments(self, samples: Floats) -> None:
        """Update the mean and the sum of squared distances from it, without the difference of two large sums."""
        before, n = self._lowest.taken, samples.shape[1]
        mean = samples.mean(axis=1)
        shift = mean - self._mean
        self._squares += ((samples - mean[:, np.newaxis]) ** 2).sum(axis=1) + shift**2 * (before * n / (before + n))
        self._mean += shift * (n / (before + n))


def segment_length(sampling_rate: float, n_samples: int | None) -> int:
    """Return the samples in a segment of the spectra, 0 for a recording that is too short; `n_samples` None is long."""
    shortest, longest = SEGMENTS
    longest = max(min(_power_of_two(sampling_rate * MAX_SEGMENT_TIME), longest), shortest)
    if n_samples is None:
        return longest
    length = min(max(_power_of_two(n_samples / _SEGMENTS_IN_RECORDING), shortest), longest, _power_of_two(n_samples))
    return length if length >= _MIN_SEGMENT else 0


def _power_of_two(number: float) -> int:
    """Return the largest power of two not above a number, at least 1."""
    return 1 << max(int(number).bit_length() - 1, 0)


class _Columns:
    """A growing row of values in at most `most` (even) columns of `step` values each."""

    # When all columns are full, `join` (np.minimum, np.maximum or np.add) merges pairs. Columns are the last axis.

    def __init__(self, join: np.ufunc, shape: tuple[int, ...], max_columns: int) -> None:
        self._join, self._max_columns = join, max_columns
        self._columns = np.zeros((*shape, max_columns))
        self.step, self.taken = 1, 0

    def add(self, values: Floats) -> None:
        """Add the next values, (*shape, n)."""
        while values.shape[-1]:
            n_free = self._max_columns * self.step - self.taken
            self._put(values[..., :n_free])
            values = values[..., n_free:]
            if self.taken == self._max_columns * self.step:
                pairs = self._columns.reshape(*self._columns.shape[:-1], self._max_columns // 2, 2)
                self._columns[..., : self._max_columns // 2] = self._join(pairs[..., 0], pairs[..., 1])
                self.step *= 2

    def values(self) -> Floats:
        """Return the columns so far, (*shape, n_columns)."""
        return self._columns[..., : -(-self.taken // self.step)].copy()

    def counts(self) -> NDArray[np.int64]:
        """Return the number of values in each column, (n_columns,)."""
        return np.diff(np.append(np.arange(0, self.taken, self.step), self.taken))

    def _put(self, values: Floats) -> None:
        begun, n = self.taken % self.step, values.shape[-1]
        first = self.taken // self.step
        starts = np.append(0, np.arange(self.step - begun, n, self.step)) if begun else np.arange(0, n, self.step)
        joined = self._join.reduceat(values, starts, axis=-1)
        if begun:
            joined[..., 0] = self._join(self._columns[..., first], joined[..., 0])
        self._columns[..., first : first + len(starts)] = joined
        self.taken += n


class _Spectra:
    """Sums of the spectra of half-overlapping segments: over all, and in bands and columns of time."""

    def __init__(self, sampling_rate: float, n_channels: int, segment: int) -> None:
        self._rate, self._segment, self._hop = sampling_rate, segment, segment // 2
        n_bins = segment // 2 + 1 if segment else 0
        # A periodic Hann window, without the 0 at its end.
        self._window = np.sin(np.pi * np.arange(segment) / max(segment, 1)) ** 2
        self.frequency = np.arange(n_bins, dtype=np.float64) * (sampling_rate / max(segment, 1))
        self._sum = np.zeros((n_channels, n_bins))
        # Bands end between bins; low bands are at least one bin wide.
        self._edges = np.unique(np.rint(np.geomspace(1, max(n_bins, 1), SPECTROGRAM_BANDS + 1)).astype(int))
        n_bands = len(self._edges) - 1
        highest = sampling_rate / 2
        self.band_edges = np.minimum((self._edges - 0.5) * (sampling_rate / max(segment, 1)), highest)
        self._columns = _Columns(np.add, (n_channels, n_bands), SPECTROGRAM_COLUMNS)
        self._remaining = np.empty((n_channels, 0))

    def feed(self, samples: Floats) -> None:
        """Add the next samples, (n_channels, n_samples)."""
        if not self._segment:
            return
        samples = np.concatenate([self._remaining, samples], axis=1)
        n_segments = max((samples.shape[1] - self._segment) // self._hop + 1, 0)
        if n_segments:
            segments = sliding_window_view(samples, self._segment, axis=1)[:, :: self._hop]
            for start in range(0, n_segments, _SEGMENTS_AT_ONCE):
                self._add(segments[:, start : start + _SEGMENTS_AT_ONCE])
        self._remaining = samples[:, n_segments * self._hop :].copy()

    def mean(self) -> Floats:
        """Return the mean power density, (n_channels, n_bins)."""
        return self._sum / max(self._columns.taken, 1)

    def spectrogram(self) -> Floats:
        """Return the mean power density of bands and columns, (n_channels, n_bands, n_times)."""
        return self._columns.values() / self._columns.counts()

    def time_edges(self) -> Floats:
        """Return the edges of the columns [s]; each segment covers the hop in its middle."""
        segments = np.append(0, np.cumsum(self._columns.counts()))
        return np.asarray((segments + 0.5) * (self._hop / self._rate))

    def _add(self, segments: Floats) -> None:
        """Add the spectra of segments, (n_channels, n_segments, segment)."""
        bands = np.empty((len(segments), len(self._edges) - 1, segments.shape[1]))
        for channel, rows in enumerate(segments):
            transform = np.fft.rfft((rows - rows.mean(axis=1, keepdims=True)) * self._window)
            density = transform.real**2 + transform.imag**2
            density *= 2 / (self._rate * np.sum(self._window**2))
            # 0 Hz and half the sampling rate have no mirror image.
            density[:, [0, -1]] *= 0.5
            self._sum[channel] += density.sum(axis=0)
            sums = np.add.reduceat(density, self._edges[:-1], axis=1)
            bands[channel] = (sums / np.diff(self._edges)).T
        self._columns.add(bands)

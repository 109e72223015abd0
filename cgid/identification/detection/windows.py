"""A recording in windows of one length, block by block, and votes of several windows.

Window k starts at sample k * hop, whatever the blocks of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.model.families import softmax
from cgid.measure.features.extraction import extract_array
from cgid.measure.filters import Equalisation
from cgid.measure.frames import MINIMUM_FRAME

#: Default length of a window [s].
WINDOW_TIME = 0.1
#: Default time over which probabilities are averaged [s].
VOTE_TIME = 0.5
#: Longest window [s], because it is in memory.
MAX_WINDOW = 10.0
#: Shortest hop, as a share of the window; the longest is `MAX_WINDOW`.
FINEST_HOP = 0.01
#: Maximum number of windows in a vote, because each vote sums all of them.
_MAX_VOTING = 10_000
#: Maximum number of windows yielded at once, because measuring them takes memory.
_MAX_WINDOWS = 512
#: Power of a window over the noise added to it [dB] from which a noisy copy still teaches its label: of the windows of
#: the ramp more than eight of ten are answered right at 20 dB, and fewer than three of four at 10 dB.
CLEAR = 15.0
#: Lower probabilities count as this one, so that no single window rules a label out.
MIN_PROBABILITY = 1e-6


def require_times(window_time: float, hop_time: float) -> None:
    """Raise `InvalidValue` unless the length of windows [s] and the hop between their starts [s] are valid."""
    validation.positive("window_time", window_time, "s")
    validation.positive("hop_time", hop_time, "s")
    if window_time > MAX_WINDOW:
        raise InvalidValue(f"window_time must be at most {MAX_WINDOW:g} s, got {window_time:g} s")
    if not FINEST_HOP * window_time <= hop_time <= MAX_WINDOW:
        raise InvalidValue(
            f"hop_time must be between {FINEST_HOP:g} of a window and {MAX_WINDOW:g} s, got {hop_time:g} s for "
            f"windows of {window_time:g} s"
        )


@dataclass(frozen=True)
class Grid:
    """Length of a window and hop between the starts of windows, in samples."""

    length: int
    hop: int

    @classmethod
    def at(cls, sampling_rate: float, window_time: float, hop_time: float) -> Grid:
        """Return the grid at a sampling rate [Hz] for a window length and a hop [s]."""
        length = round(validation.number("window_time", window_time, "s", validation.positive) * sampling_rate)
        hop = round(validation.number("hop_time", hop_time, "s", validation.positive) * sampling_rate)
        if length < MINIMUM_FRAME:
            raise InvalidValue(
                f"window_time must be at least {MINIMUM_FRAME} samples, {MINIMUM_FRAME / sampling_rate:g} s at "
                f"{sampling_rate:g} Hz, got {window_time:g} s"
            )
        return cls(length, max(hop, 1))


def windows_of(
    blocks: Iterable[NDArray[np.floating]], sampling_rate: float, window_time: float, hop_time: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.floating]]]:
    """Yield first samples and read-only windows (n_windows, n_channels, n_samples), at most 512 at once."""
    grid = Grid.at(sampling_rate, window_time, hop_time)
    waiting: list[NDArray[np.floating]] = []
    start = n_waiting = number = 0  # first sample in `waiting`, number of samples there, next window
    for block in blocks:
        waiting.append(block)
        n_waiting += block.shape[1]
        complete = (start + n_waiting - grid.length) // grid.hop + 1
        if complete <= number:
            continue
        samples = np.concatenate(waiting, axis=1)
        views = np.lib.stride_tricks.sliding_window_view(samples, grid.length, axis=1)
        for first_window in range(number, complete, _MAX_WINDOWS):
            last_window = min(first_window + _MAX_WINDOWS, complete)
            first = grid.hop * np.arange(first_window, last_window, dtype=np.int64)
            yield first, np.swapaxes(views[:, first[0] - start : first[-1] - start + 1 : grid.hop], 0, 1)
        number = complete
        # Also drop samples between windows that are further apart than they are long.
        gone = min(number * grid.hop - start, n_waiting)
        waiting, start, n_waiting = [samples[:, gone:].copy()], start + gone, n_waiting - gone


def measure_windows(
    windows: NDArray[np.floating],
    sampling_rate: float,
    names: tuple[str, ...],
    equalisation: Sequence[Equalisation] | None = None,
) -> Floats:
    """Return features (n_windows, n_channels * n_features), channel by channel; nan where not measurable."""
    is_complete = complete_windows(windows)
    if not is_complete.all():
        table = np.full((len(windows), windows.shape[1] * len(names)), np.nan)
        if is_complete.any():
            table[is_complete] = measure_windows(windows[is_complete], sampling_rate, names, equalisation)
        return table
    equalisations = [None] * windows.shape[1] if equalisation is None else equalisation
    channels = zip(np.moveaxis(windows, 1, 0), equalisations, strict=True)
    parts = [extract_array(rows, sampling_rate, names, invalid="nan", equalisation=one) for rows, one in channels]
    return np.concatenate(parts, axis=1)


def complete_windows(windows: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which windows (n_windows, n_channels, n_samples) lack no sample."""
    return np.asarray(~np.isnan(windows.max(axis=(1, 2), initial=-np.inf)))


def columns_of(names: Sequence[str], selected: Sequence[str], n_columns: int) -> list[int]:
    """Return the columns of the selected features in a table with all `names` of one channel after the other."""
    columns = [names.index(name) for name in selected]
    return [start + column for start in range(0, n_columns, len(names)) for column in columns]


#: Numbers of copies of each window with some noise, and with strong noise; the power of the window
#: over that of their noise [dB]; the largest change of their gain [dB]; the steepest noise, power over 1/frequency^n.
CLEAR_COPIES, NOISY_COPIES = 2, 1
_CLEAR_SNR, _NOISE_SNR, _GAIN, _STEEPEST = (CLEAR, 45.0), (-10.0, CLEAR), 3.0, 1.0


class NoisyCopies:
    """Copies of windows with noise and another gain, the same however the windows are divided into calls."""

    def __init__(self, seed: int | Sequence[int]) -> None:
        self._random = np.random.default_rng(seed)

    def of(self, windows: NDArray[np.floating]) -> Iterator[tuple[Floats, Floats]]:
        """Yield for each window its copies and their power over that of the noise [dB], (n_copies,)."""
        ranges = [_CLEAR_SNR] * CLEAR_COPIES + [_NOISE_SNR] * NOISY_COPIES
        for window in windows:
            levels, slopes, gains = self._random.random((3, len(ranges)))
            snr = np.array([low + level * (high - low) for (low, high), level in zip(ranges, levels, strict=True)])
            white = np.fft.rfft(self._random.normal(size=(len(ranges), *window.shape)))
            bins = np.maximum(np.arange(white.shape[-1]), 1)
            noise = np.fft.irfft(white * bins ** (-0.5 * _STEEPEST * slopes[:, None, None]), window.shape[-1])
            ratio = window.var(axis=1) / noise.var(axis=2) * 10 ** (-snr[:, None] / 10)
            gain = 10 ** ((2 * gains - 1) * _GAIN / 20)
            yield snr, gain[:, None, None] * (window + noise * np.sqrt(ratio)[:, :, None])


def independent_windows(n_windows: Floats, correlation: float) -> Floats:
    """Return how many independent windows successive ones are worth (design effect; Kish 1965, 8.2).

    >>> independent_windows(np.array([1, 9]), 0.5).tolist()
    [1.0, 1.8]
    """
    return np.asarray(n_windows / (1 + np.maximum(n_windows - 1, 0) * correlation))


class RunningVote:
    """Running vote of the last `n_windows` windows; a correlation of 1 averages log-probabilities, 0 adds them."""

    def __init__(self, n_windows: int, correlation: float = 1.0) -> None:
        self.n_windows = validation.count("n_windows", n_windows)
        self._correlation = correlation
        self._last: Floats | None = None

    @classmethod
    def over(cls, vote_time: float, window_time: float, hop_time: float, correlation: float = 1.0) -> RunningVote:
        """Return the vote over the windows entirely within a time, at least one; all times in seconds."""
        validation.positive("vote_time, window_time and hop_time", [vote_time, window_time, hop_time], "s")
        if vote_time > _MAX_VOTING * hop_time:
            raise InvalidValue(
                f"vote_time must be at most {_MAX_VOTING} hops of {hop_time:g} s, got {vote_time:g} s; decide on less"
            )
        return cls(max(int((vote_time - window_time) / hop_time + 1e-9) + 1, 1), correlation)

    def feed(self, probabilities: Floats, known: NDArray[np.bool_] | None = None) -> Floats:
        """Return voted probabilities of more windows, (n, n_labels), the same however they are divided into calls."""
        counted = np.ones(len(probabilities)) if known is None else known.astype(np.float64)
        logs = np.log(np.maximum(probabilities, MIN_PROBABILITY))
        votes = np.column_stack([counted[:, None] * logs, counted])
        before = np.zeros((self.n_windows - 1, votes.shape[1])) if self._last is None else self._last
        both = np.concatenate([before, votes])
        total = np.zeros_like(votes)
        for k in range(self.n_windows):  # the same order for every row
            total += both[k : k + len(votes)]
        self._last = both[len(votes) :]
        counts = total[:, -1:]
        voted = total[:, :-1] / np.maximum(counts, 1) * independent_windows(counts, self._correlation)
        return softmax(np.where(counts > 0, voted, logs))

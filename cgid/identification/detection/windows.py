"""A recording in windows of one length, block by block.

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
from cgid.measure.features.extraction import extract_array
from cgid.measure.frames import MINIMUM_FRAME

#: Default length of a window [s].
WINDOW_TIME = 0.1
#: Maximum number of windows yielded at once, because measuring them takes memory.
_MAX_WINDOWS = 512
#: Power of a window over the noise added to it [dB] from which a noisy copy still teaches its label: of the windows of
#: the ramp more than eight of ten are answered right at 20 dB, and fewer than three of four at 10 dB.
CLEAR = 15.0


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


def measure_windows(windows: NDArray[np.floating], sampling_rate: float, names: tuple[str, ...]) -> Floats:
    """Return features (n_windows, n_channels * n_features), channel by channel; nan where not measurable."""
    is_complete = complete_windows(windows)
    if not is_complete.all():
        table = np.full((len(windows), windows.shape[1] * len(names)), np.nan)
        if is_complete.any():
            table[is_complete] = measure_windows(windows[is_complete], sampling_rate, names)
        return table
    parts = [extract_array(rows, sampling_rate, names, invalid="nan") for rows in np.moveaxis(windows, 1, 0)]
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
N_COPIES = CLEAR_COPIES + NOISY_COPIES
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

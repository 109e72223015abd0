"""A recording in windows of one length, block by block, and votes of several windows.

Where impacts are too dense to be separated, windows are identified instead. They do not depend on the blocks of the
recording: window k starts at sample k hops.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.identification.families import softmax
from cgid.measure.features import extract_array
from cgid.measure.filters import Equalisation
from cgid.measure.frames import MINIMUM_FRAME
from cgid.validation import Floats

#: The default length of a window [s].
WINDOW_TIME = 0.1
#: Probabilities are averaged over this time by default [s].
VOTE_TIME = 0.5
#: No window is longer [s]: it is held in memory.
LONGEST_WINDOW = 10.0
#: The next window begins after this share of one at least, and within `LONGEST_WINDOW`.
FINEST_HOP = 0.01
#: At most this many windows vote together: each of them is added up for each vote.
_MOST_VOTING = 10_000
#: At most this many windows are yielded at once: measuring them takes memory.
_MOST_WINDOWS = 512
#: Lower probabilities count as this one: no window alone rules a label out.
LEAST_PROBABILITY = 1e-6


def require_times(window_time: float, hop_time: float) -> None:
    """Raise `InvalidValue` unless windows of this length [s] can start this far from each other [s]."""
    validation.positive("window_time", window_time, "s")
    validation.positive("hop_time", hop_time, "s")
    if window_time > LONGEST_WINDOW:
        raise InvalidValue(f"window_time must be at most {LONGEST_WINDOW:g} s, got {window_time:g} s")
    if not FINEST_HOP * window_time <= hop_time <= LONGEST_WINDOW:
        raise InvalidValue(
            f"hop_time must lie between {FINEST_HOP:g} of a window and {LONGEST_WINDOW:g} s, got {hop_time:g} s for "
            f"windows of {window_time:g} s"
        )


@dataclass(frozen=True)
class Grid:
    """Where windows lie, in samples.

    Attributes
    ----------
    length : int
        Of a window.
    hop : int
        From the start of one to that of the next.
    """

    length: int
    hop: int

    @classmethod
    def at(cls, sampling_rate: float, window_time: float, hop_time: float) -> Grid:
        """Return the grid at a sampling rate [Hz] of windows of a length [s] that start a hop [s] from each other.

        Raises
        ------
        InvalidValue
            A time is not above 0, or a window holds too few samples.

        Examples
        --------
        >>> Grid.at(44_100.0, 0.1, 0.05)
        Grid(length=4410, hop=2205)
        """
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
    """Return an iterator over the windows of a recording that lie in it as a whole, as soon as they are complete.

    Parameters
    ----------
    blocks : iterable of ndarray, (n_channels, n_samples)
        The recording, one block after the other, of any lengths. Only what the next window needs is kept.
    sampling_rate : float
        [Hz].
    window_time, hop_time : float
        Length of a window, and from the start of one to that of the next [s].

    Yields
    ------
    first_samples : ndarray of int, (n_windows,)
        Where they start in the recording.
    windows : ndarray, (n_windows, n_channels, n_samples)
        A view that must not be written to; at most 512 windows.

    Raises
    ------
    InvalidValue
        A time is not above 0, or a window holds too few samples.

    Examples
    --------
    >>> blocks = np.arange(10.0)[None, :7], np.arange(10.0)[None, 7:]
    >>> for first, windows in windows_of(blocks, 1.0, 6.0, 2.0):
    ...     print(first, windows[:, 0, 0], windows.shape)
    [0] [0.] (1, 1, 6)
    [2 4] [2. 4.] (2, 1, 6)
    """
    grid = Grid.at(sampling_rate, window_time, hop_time)
    waiting: list[NDArray[np.floating]] = []
    start = held = number = 0  # first sample that waits, how many wait, and the next window
    for block in blocks:
        waiting.append(block)
        held += block.shape[1]
        complete = (start + held - grid.length) // grid.hop + 1
        if complete <= number:
            continue
        samples = np.concatenate(waiting, axis=1)
        views = np.lib.stride_tricks.sliding_window_view(samples, grid.length, axis=1)
        for first_window in range(number, complete, _MOST_WINDOWS):
            last_window = min(first_window + _MOST_WINDOWS, complete)
            first = grid.hop * np.arange(first_window, last_window, dtype=np.int64)
            yield first, np.swapaxes(views[:, first[0] - start : first[-1] - start + 1 : grid.hop], 0, 1)
        number = complete
        # Samples between windows that are further apart than they are long do not wait.
        gone = min(number * grid.hop - start, held)
        waiting, start, held = [samples[:, gone:].copy()], start + gone, held - gone


def measure_windows(
    windows: NDArray[np.floating],
    sampling_rate: float,
    names: tuple[str, ...],
    equalisation: Sequence[Equalisation] | None = None,
) -> Floats:
    """Return the features of windows, those of the first channel before those of the second.

    Parameters
    ----------
    windows : ndarray, (n_windows, n_channels, n_samples)
    sampling_rate : float
        [Hz].
    names : tuple of str
        Out of `cgid.measure.features.FEATURES`.
    equalisation : sequence of Equalisation, optional
        Corrections of the sensor's response, one for each channel.

    Returns
    -------
    ndarray, (n_windows, n_channels * n_features)
        nan where a window cannot be measured.
    """
    own = [None] * windows.shape[1] if equalisation is None else equalisation
    channels = zip(np.moveaxis(windows, 1, 0), own, strict=True)
    parts = [extract_array(rows, sampling_rate, names, invalid="nan", equalisation=one) for rows, one in channels]
    return np.concatenate(parts, axis=1)


def columns_of(names: Sequence[str], chosen: Sequence[str], n_columns: int) -> list[int]:
    """Return the columns of some features in a table that holds all `names` for one channel after the other.

    Examples
    --------
    >>> columns_of(("a", "b", "c"), ("c", "a"), 6)
    [2, 0, 5, 3]
    """
    own = [names.index(name) for name in chosen]
    return [start + column for start in range(0, n_columns, len(names)) for column in own]


class RunningVote:
    """Probabilities averaged over the last windows: the mean of their logarithms, as they come.

    Parameters
    ----------
    n_windows : int
        Over this many; at the beginning, over all so far.
    """

    def __init__(self, n_windows: int) -> None:
        self.n_windows = validation.count("n_windows", n_windows)
        self._last: Floats | None = None
        self._seen = 0

    @classmethod
    def over(cls, vote_time: float, window_time: float, hop_time: float) -> RunningVote:
        """Return the vote of the windows that lie in a time as a whole, at least one; all times in seconds.

        Examples
        --------
        >>> RunningVote.over(0.5, 0.1, 0.05).n_windows
        9
        """
        validation.positive("vote_time, window_time and hop_time", [vote_time, window_time, hop_time], "s")
        if vote_time > _MOST_VOTING * hop_time:
            raise InvalidValue(
                f"vote_time must be at most {_MOST_VOTING} hops of {hop_time:g} s, got {vote_time:g} s; decide on less"
            )
        return cls(max(int((vote_time - window_time) / hop_time + 1e-9) + 1, 1))

    def feed(self, probabilities: Floats) -> Floats:
        """Return the averaged probabilities for more windows, (n, n_labels); each row adds up to 1.

        The rows are the same to the last digit whatever the portions that they come in.

        Examples
        --------
        >>> RunningVote(2).feed(np.array([[0.5, 0.5], [0.9, 0.1], [0.9, 0.1]])).round(2).tolist()
        [[0.5, 0.5], [0.75, 0.25], [0.9, 0.1]]
        """
        logs = np.log(np.maximum(probabilities, LEAST_PROBABILITY))
        before = np.zeros((self.n_windows - 1, logs.shape[1])) if self._last is None else self._last
        both = np.concatenate([before, logs])
        total = np.zeros_like(logs)
        for k in range(self.n_windows):  # in this order for every row
            total += both[k : k + len(logs)]
        counts = np.minimum(self._seen + 1 + np.arange(len(logs)), self.n_windows)
        self._last, self._seen = both[len(logs) :], self._seen + len(logs)
        return softmax(total / counts[:, None])

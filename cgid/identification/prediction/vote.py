"""The running vote of successive windows, whose predictions are not independent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.model.families import softmax

#: Default time over which probabilities are averaged [s].
VOTE_TIME = 0.5
#: Maximum number of windows in a vote, because each vote sums all of them.
_MAX_VOTING = 10_000
#: Lower probabilities count as this one, so that no single window rules a label out.
MIN_PROBABILITY = 1e-6


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

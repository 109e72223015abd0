"""How sure a share of right answers is when many of them come from few recordings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from cgid.identification.share import wilson_interval

#: Misses (or hits) in fewer groups than this do not show how much groups differ.
FEWEST_GROUPS = 3


def clustered_interval(hits: NDArray[np.bool_], group: NDArray[np.intp]) -> tuple[float, float]:
    """Return the 95 % interval of a share of hits, of which those of a group are no independent trials.

    It is the score interval (Wilson 1927) of as many independent trials as would spread as much as the groups do (Korn
    & Graubard 1998): never fewer than there are groups, never more than there are hits and misses. Where fewer than
    `FEWEST_GROUPS` have all the misses (or all the hits), a trial is a group.

    Parameters
    ----------
    hits : ndarray of bool, (n,)
    group : ndarray of int, (n,)

    Examples
    --------
    >>> hits = np.array([1, 1, 1, 1, 0, 0, 1, 1], bool)
    >>> [round(end, 3) for end in clustered_interval(hits, np.array([0, 0, 1, 1, 2, 2, 3, 3]))]
    [0.301, 0.954]
    """
    share, (_, own) = float(hits.mean()), np.unique(group, return_inverse=True)
    n_groups = int(own.max()) + 1
    if n_groups < 2:
        return 0.0, 1.0
    # A ratio of sums over groups, linearised (Cochran 1977, 6.3).
    deviations = np.bincount(own, hits - share)
    variance = np.sum(deviations**2) * n_groups / (n_groups - 1) / len(hits) ** 2
    trials = share * (1 - share) / variance if variance > 0 else 0.0
    trials *= (stats.norm.ppf(0.975) / stats.t.ppf(0.975, n_groups - 1)) ** 2
    if min(np.unique(own[hits]).size, np.unique(own[~hits]).size) < FEWEST_GROUPS:
        trials = 0.0
    low, high = wilson_interval(share, min(max(trials, n_groups), len(hits)))
    return max(float(low), 0.0), min(float(high), 1.0)

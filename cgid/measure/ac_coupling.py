"""An AC coupling seen in frames of a force, which is 0 after its contact, never below.

A high-pass of first order takes from each sample its rate times the impulse so far, so that a pulse ends below 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats

#: Blocks before onset and after contact whose means show the level.
QUIET_BLOCKS, AFTER_BLOCKS = 6, 8
#: The smallest fall of the level that is an AC coupling: over the peak, and in standard deviations. The level drifts as
#: well if its slope is so many standard deviations from 0.
LEAST_FALL, _SURE_FALL, _SURE_SLOPE = 0.003, 4.0, 2.5


def coupling_rates(
    force: Floats, peak: Floats, noise: Floats, quiet: int, after: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> Floats:
    """Return the rate of the high-pass that each row of force passed [1/sample], 0 where there is none to be seen.

    The rows (n, n_samples) are quiet before column `quiet`, and without contact between the columns `after`, in the
    frame; `peak` (n,) and `noise` (n,), a standard deviation, have the unit of the force.
    """
    start, stop = after
    begin = np.maximum(quiet - 3 * (stop - start) // 2, 0)
    columns = np.hstack(
        [
            first[:, None] + ((last - first)[:, None] * np.arange(n + 1)) // n
            for first, last, n in ((begin, np.full_like(begin, quiet), QUIET_BLOCKS), (start, stop, AFTER_BLOCKS))
        ]
    )
    impulse = np.cumsum(force, axis=1)
    inner = np.arange(QUIET_BLOCKS + AFTER_BLOCKS + 1) != QUIET_BLOCKS  # between the two there is the contact
    count = np.diff(columns, axis=1)[:, inner]
    level, share = (
        np.diff(np.take_along_axis(np.pad(np.cumsum(one, axis=1), ((0, 0), (1, 0))), columns, axis=1), axis=1)[:, inner]
        / np.maximum(count, 1)
        for one in (force, impulse)
    )
    middle = (0.5 * (columns[:, 1:] + columns[:, :-1]))[:, inner]
    time = (middle - quiet) / (stop - start)[:, None]
    design = np.stack([-share / peak[:, None], np.ones_like(time), time], axis=2)
    drifting = np.zeros(len(force), bool)
    found = sure = np.zeros((len(force), 3))
    # The slope is an unknown only where it is there: it takes most of what is known of the fall.
    for n_unknown in (3, 2):
        own = design[:, :, :n_unknown]
        inverse = np.linalg.pinv(np.einsum("nbi,nb,nbj->nij", own, count, own))
        slopes = np.einsum("nij,nbj,nb,nb->ni", inverse, own, count, level)
        left = np.sum(count * (level - np.einsum("nbi,ni->nb", own, slopes)) ** 2, axis=1)
        variance = np.maximum(left / (inner.sum() - 1 - n_unknown), noise**2)[:, None]
        deviations = slopes / np.sqrt(np.maximum(np.einsum("nii->ni", inverse) * variance, 1e-300))
        if n_unknown == 3:
            drifting, found, sure = np.abs(deviations[:, 2]) > _SURE_SLOPE, slopes, deviations
        else:
            found, sure = (np.where(drifting[:, None], a[:, :2], b) for a, b in ((found, slopes), (sure, deviations)))
    fallen = found[:, 0] / peak * np.take_along_axis(impulse, start[:, None], axis=1)[:, 0]
    return np.where((sure[:, 0] > _SURE_FALL) & (fallen > LEAST_FALL * peak), found[:, 0] / peak, 0.0)

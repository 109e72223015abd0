"""Where to look for a pulse that stands hardly above the noise: the strongest mean over runs of samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats

#: Runs grow by this factor from the shortest to this share of the frame.
_GROWTH, _SHORTEST, _LONGEST_SHARE = 1.4, 3, 0.5
#: A pulse's best run, over its width (impulse over peak), and its mean over the peak.
_RUN_OVER_WIDTH, _MEAN_OVER_PEAK = 1.1, 0.74


def strongest_run(samples: NDArray[np.floating], offset: Floats) -> tuple[Floats, Floats, Floats]:
    """Return peak, width [samples] and place [samples] of the pulse that stands out most, each (n,).

    Parameters
    ----------
    samples : ndarray, (n, n_samples)
    offset : ndarray, (n,)
        Taken off the samples.

    A box is within 6 % of the matched filter for these pulses, and sums make boxes of all lengths cheap.
    """
    n, n_samples = samples.shape
    total = np.zeros((n, n_samples + 1))
    np.cumsum(samples - offset[:, None], axis=1, dtype=np.float64, out=total[:, 1:])
    best = np.full(n, -np.inf)
    run, place = np.ones(n), np.zeros(n)
    rows = np.arange(n)
    length = _SHORTEST
    while length <= max(_LONGEST_SHARE * n_samples, _SHORTEST):
        strength = (total[:, length:] - total[:, :-length]) / np.sqrt(length)
        top = np.argmax(strength, axis=1)
        better = strength[rows, top] > best
        best = np.where(better, strength[rows, top], best)
        run, place = np.where(better, length, run), np.where(better, top + 0.5 * (length - 1), place)
        length = max(int(length * _GROWTH), length + 1)
    return best / np.sqrt(run) / _MEAN_OVER_PEAK, run / _RUN_OVER_WIDTH, place

"""Signals in frames, one impact each, and what is quiet before it: what pulses and vibrations have in common."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats

#: An impact must pass this many standard deviations of the noise.
DETECTION_LIMIT = 5.0


class Frames:
    """Frames with an impact each; baseline and noise are those of the samples before touch.

    Parameters
    ----------
    samples : ndarray, (n_signals, n_samples)
    sampling_rate : float
        [Hz].
    pre_trigger : int or None
        Samples before touch. None: each row's own, as many as the kind of signal tells.
    remove_baseline : bool
        Whether the mean before touch is subtracted.
    detection_limit : float
        An impact must pass this many standard deviations of what is before touch.
    """

    def __init__(
        self,
        samples: NDArray[np.floating],
        sampling_rate: float,
        pre_trigger: int | None = None,
        remove_baseline: bool = True,
        detection_limit: float = DETECTION_LIMIT,
    ) -> None:
        self.samples = samples
        self.sampling_rate = sampling_rate
        self.pre_trigger = pre_trigger
        self.remove_baseline = remove_baseline
        self.detection_limit = detection_limit

    @cached_property
    def _surely_quiet(self) -> NDArray[np.intp]:
        """Number of samples of each row that are surely before touch, where nobody says it."""
        raise NotImplementedError

    def _moments(self, count: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return mean and standard deviation of the first samples of each row, 0 where there are fewer than two."""
        before = np.arange(self.samples.shape[1]) < count[:, None]
        mean = np.sum(self.samples, axis=1, where=before, dtype=np.float64) / np.maximum(count, 1)
        square = np.where(before, (self.samples - mean[:, None]) ** 2, 0.0).sum(axis=1, dtype=np.float64)
        told = count > 1
        return np.where(told, mean, 0.0), np.where(told, np.sqrt(square / np.maximum(count - 1, 1)), 0.0)

    @cached_property
    def _quiet(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation before touch."""
        if self.pre_trigger is None:
            return self._moments(self._surely_quiet)
        quiet = self.samples[:, : max(self.pre_trigger, 0)]
        if quiet.shape[1] < 2:
            return np.zeros(len(self.samples)), np.zeros(len(self.samples))
        return quiet.mean(axis=1, dtype=np.float64), quiet.std(axis=1, ddof=1, dtype=np.float64)

    @property
    def baseline(self) -> Floats:
        """Mean before touch, 0 where fewer than two samples are before touch."""
        return self._quiet[0]

    @property
    def noise(self) -> Floats:
        """Standard deviation before touch, 0 where fewer than two samples are before touch."""
        return self._quiet[1]

"""The time axis of a recording: how long it is, and the part of it that is still being added to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid.scene.scene import Scene
from cgid.validation import Floats


def samples_of(scene: Scene) -> int:
    """Return the number of samples of a recording of a stream, or of a frame."""
    if scene.stream is None:
        return scene.sampling.samples
    return max(round(scene.stream.duration * scene.sampling.sampling_rate), 1)


class TimeAxis:
    """Samples from one on, as far as anything was added to them.

    Attributes
    ----------
    first : int
        Number of the first sample that has not been taken.
    samples : ndarray, (n,)
        That one and those behind it; behind the last all are 0.
    """

    def __init__(self) -> None:
        self.first = 0
        self.samples: Floats = np.zeros(0)

    def until(self, stop: int) -> Floats:
        """Return the samples from the first one to number `stop`, to be added to in place."""
        missing = stop - self.first - self.samples.size
        if missing > 0:
            self.samples = np.concatenate([self.samples, np.zeros(missing)])
        return self.samples[: stop - self.first]

    def add(self, first: NDArray[np.int64], windows: NDArray[np.floating]) -> None:
        """Add windows (n, width), each from its own sample on; what lies before the axis is lost."""
        width = windows.shape[1]
        samples = self.until(int(first.max()) + width)
        for start, window in zip((first - self.first).tolist(), windows, strict=True):
            lost = max(-start, 0)
            samples[start + lost : start + width] += window[lost:]

    def taken(self, stop: int) -> Floats:
        """Take the samples before number `stop` off the axis and return them."""
        part = self.until(stop).copy()
        self.samples, self.first = self.samples[part.size :], stop
        return part

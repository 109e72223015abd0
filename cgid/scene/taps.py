"""Pulses of a prescribed shape: a hammer, a calibration, a fault, whatever no law of impact has made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.counting import count
from cgid.elementary import sin
from cgid.validation import Floats

#: Force over its peak against time over the duration, strictly between 0 and 1. Their order numbers them.
SHAPES: Mapping[str, Callable[[Floats], Floats]] = {
    "half-sine": lambda u: sin(np.pi * u),
    "square": np.ones_like,
    "triangle": lambda u: np.asarray(1 - np.abs(2 * u - 1)),
    "haversine": lambda u: sin(np.pi * u) ** 2,
}


@dataclass(frozen=True)
class TapPulses:
    """Pulses of prescribed shapes, one for each row.

    Attributes
    ----------
    shape : ndarray of int, (n,)
        Number of the shape in `SHAPES`.
    peak_force : ndarray, (n,)
        [N].
    contact_duration : ndarray, (n,)
        [s].
    """

    shape: NDArray[np.intp]
    peak_force: Floats
    contact_duration: Floats

    @property
    def end_of_contact(self) -> Floats:
        """When the force is over [s], (n,)."""
        return self.contact_duration

    def add_to_frames(
        self, frames: NDArray[Any], sampling_rate: float | Floats, onset: Floats, *, tolerance: float = 0.0
    ) -> None:
        """Add the pulses to frames (n, n_samples) in place, each from its time of touch [s] on; without any error."""
        shapes = tuple(SHAPES.values())
        count("tap_pulses", len(frames))
        place, length = onset * sampling_rate, self.contact_duration * sampling_rate
        # As for an impact, a sample on touch or on the end itself holds no force, not even a square one's.
        first = np.clip(np.floor(place) + 1, 0, frames.shape[1]).astype(np.intp)
        behind = np.clip(np.ceil(place + length), first, frames.shape[1]).astype(np.intp)
        for row, frame in enumerate(frames):
            samples = np.arange(first[row], behind[row])
            share = (samples - place[row]) / length[row]
            # Where a sample falls on the end, rounding may put it a hair behind.
            force = np.where(share < 1, shapes[self.shape[row]](share), 0.0)
            frame[first[row] : behind[row]] += self.peak_force[row] * force

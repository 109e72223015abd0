"""Pulses on their way into the frames of a block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.impact import Impact
from cgid.impact.coupled import ModalImpact
from cgid.scene.response import Hearing
from cgid.scene.taps import TapPulses
from cgid.validation import Floats


@dataclass(frozen=True)
class Strike:
    """Pulses of one kind, each with its place in a block.

    Attributes
    ----------
    rows : ndarray of int, (n,)
        Signals of the block that they belong to.
    pulses : Impact, ModalImpact or TapPulses
        n of them.
    onset : ndarray, (n,)
        Time of touch in the frame [s].
    ratio : ndarray, (n,), optional
        What each is multiplied by.
    """

    rows: NDArray[np.intp]
    pulses: Impact | ModalImpact | TapPulses
    onset: Floats
    ratio: Floats | None = None

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: float) -> None:
        """Add the pulses to the frames of the block, in place."""
        if self.ratio is None and self.rows.size == len(frames):
            self.pulses.add_to_frames(frames, sampling_rate, self.onset)
            return
        own = np.zeros((self.rows.size, frames.shape[1]), frames.dtype)
        self.pulses.add_to_frames(own, sampling_rate, self.onset)
        if self.ratio is not None:
            own *= self.ratio.astype(frames.dtype)[:, None]
        frames[self.rows] += own

    def add_response(self, frames: NDArray[Any], hearing: Hearing, parameters: Mapping[str, Floats]) -> None:
        """Add what a recorder hears of the pulses to the frames of the block, in place."""
        own = {name: values[self.rows] for name, values in parameters.items()}
        hearing.response.add_to_frames(
            frames, self.pulses, self.onset, hearing.participation(own), rows=self.rows, ratio=self.ratio
        )

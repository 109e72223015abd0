"""Pulses on their way into the frames of a block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.physics import Impact
from cgid.physics.coupled import ModalImpact
from cgid.physics.sampled import SampledPulses
from cgid.scene.response import Hearing
from cgid.scene.scene import Scene
from cgid.scene.taps import TapPulses
from cgid.validation import Floats


@dataclass(frozen=True)
class Strike:
    """Pulses of one kind, each with its place in a block.

    Attributes
    ----------
    rows : ndarray of int, (n,)
        Signals of the block that they belong to.
    pulses : Impact, ModalImpact, TapPulses or SampledPulses
        n of them.
    onset : ndarray, (n,)
        Time of touch in the frame [s].
    ratio : ndarray, (n,), optional
        What each is multiplied by.
    """

    rows: NDArray[np.intp]
    pulses: Impact | ModalImpact | TapPulses | SampledPulses
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


@dataclass(frozen=True)
class Blows:
    """All that is heard in one block of signals.

    Attributes
    ----------
    labels : ndarray of str, (n_signals,)
    parameters : dict of ndarray, each (n_signals,)
        Drawn and derived, nan where one does not apply; onset is the time of touch in the frame, peak and duration are
        those of the first hit.
    specimen : ndarray of uint64, (n_signals,)
        Equal for pulses of an equal particle, or of an equal tap.
    strikes : tuple of Strike
        What the frames are made of: impacts, taps, second hits.
    scene : Scene
        The scene as it holds in this block.
    """

    labels: NDArray[np.str_]
    parameters: Mapping[str, Floats]
    specimen: NDArray[np.uint64]
    strikes: tuple[Strike, ...]
    scene: Scene

"""One ear: the only way from the samples of a recording to its impacts, whatever command or training asks.

Gaps are nan already. Then: unit and sign, the rate of the beam that is looked through, the tones of machines taken out,
the detector.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid.identification.detection.detector import FASTEST, ImpactDetector
from cgid.identification.detection.events import Event
from cgid.measure.features.table import ImpactKind

if TYPE_CHECKING:
    from cgid.identification.inversion.one_rate import OneRate
    from cgid.identification.inversion.through_beam import ThroughBeam
    from cgid.recordings.lines import Lines


class Heard(NamedTuple):
    """What further samples tell."""

    events: list[Event]  # in order of time
    until: float  # index before which all impacts are known, infinite at the end of the recording
    samples: NDArray[Any]  # (n_channels, n), as the detector got them, at `Ear.rate`


class Ear:
    """Hear the impacts of a recording, fed in blocks of any size.

    Parameters
    ----------
    sampling_rate : float [Hz]
    n_channels : int
    kind : {"pulse", "vibration"}
    dead_time, joint : float, bool
        As of `ImpactDetector`.
    factor : float
        Samples are multiplied by it: unit and sign.
    lines : bool, optional
        Whether tones of machines are taken out of vibrations: from the first sample on, or never; by default once a
        machine is heard.
    beam : ThroughBeam, optional
        The beam that is looked through: faster recordings are heard at its rate, as its recorder gives them.

    Attributes
    ----------
    rate : float
        Sampling rate of what is heard [Hz].
    is_brought : bool
        Whether that is another than the recording's.
    """

    def __init__(
        self,
        sampling_rate: float,
        n_channels: int = 1,
        *,
        kind: ImpactKind,
        dead_time: float | None = None,
        joint: bool = False,
        factor: float = 1.0,
        lines: bool | None = None,
        beam: ThroughBeam | None = None,
    ) -> None:
        self.rate, self.is_brought, self.lines = sampling_rate, False, None
        self._stages: list[OneRate | Lines] = []
        if beam is not None and sampling_rate <= FASTEST and (brought := beam.brings(sampling_rate, n_channels)):
            self.rate, self.is_brought, self._stages = brought.rate, True, [brought]
        self._detector = detector = ImpactDetector(
            self.rate, n_channels, kind=kind, dead_time=dead_time, joint=joint, gaps=True
        )
        self.n_samples, self.why_silent = detector.n_samples, detector.why_silent
        self.is_upside_down, self._factor = detector.is_upside_down, factor
        if kind == "vibration" and lines is not False:
            from cgid.recordings.lines import Lines

            self.lines = Lines(n_channels, self.rate, from_begin=bool(lines))
            self._stages.append(self.lines)

    def feed(self, block: NDArray[Any] | None) -> Heard:
        """Take the next samples (n_channels, n), nan where missing, or None at the end of the recording."""
        detector = self._detector
        if block is None:
            block = np.empty((detector.n_channels, 0), np.float32)
            for stage in self._stages:
                block = np.concatenate([stage.feed(block), stage.finish()], axis=1)
            events = detector.feed(block) if block.shape[1] else []
            return Heard(events + detector.finish(), np.inf, block)
        if block.ndim == 2 and len(block) == detector.n_channels and block.dtype.kind in "fiu":
            block = block if block.dtype in (np.float32, np.float64) else block.astype(np.float64)
            block = block if self._factor == 1 else block * self._factor
            for stage in self._stages:
                block = stage.feed(block)
        events = detector.feed(block)  # or it says what is wrong with the block
        return Heard(events, detector.known_until, block)

    def heard(self, blocks: Iterable[NDArray[Any]]) -> Iterator[Heard]:
        """Yield what each of the blocks of a recording tells, and at last what its end does."""
        return map(self.feed, chain(blocks, [None]))

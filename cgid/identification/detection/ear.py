"""One ear: the only way from the samples of a recording to its impacts, whatever command or training asks.

Gaps are nan already. Then: unit and sign, the tones of machines taken out, the detector.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid.identification.detection.detector import ImpactDetector
from cgid.identification.detection.events import Event
from cgid.measure.features.table import ImpactKind

if TYPE_CHECKING:
    from cgid.recordings.lines import Lines


class Heard(NamedTuple):
    """What further samples tell."""

    events: list[Event]  # in order of time
    until: float  # index before which all impacts are known, infinite at the end of the recording
    samples: NDArray[Any]  # (n_channels, n), as the detector got them


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
    ) -> None:
        self._detector = detector = ImpactDetector(
            sampling_rate, n_channels, kind=kind, dead_time=dead_time, joint=joint, gaps=True
        )
        self.n_samples, self.why_silent = detector.n_samples, detector.why_silent
        self.is_upside_down, self._factor = detector.is_upside_down, factor
        self.lines: Lines | None = None
        if kind == "vibration" and lines is not False:
            from cgid.recordings.lines import Lines

            self.lines = Lines(n_channels, sampling_rate, from_begin=bool(lines))

    def feed(self, block: NDArray[Any]) -> Heard:
        """Take the next samples (n_channels, n), nan where missing."""
        block = block if self._factor == 1 else block * self._factor
        return self._heard(block if self.lines is None else self.lines.feed(block))

    def finish(self) -> Heard:
        """Return what the end of the recording tells."""
        rest = np.empty((self._detector.n_channels, 0), np.float32) if self.lines is None else self.lines.finish()
        heard = self._heard(rest)
        return Heard(heard.events + self._detector.finish(), np.inf, rest)

    def heard(self, blocks: Iterable[NDArray[Any]]) -> Iterator[Heard]:
        """Yield what each of the blocks of a recording tells, and at last what its end does."""
        yield from map(self.feed, blocks)
        yield self.finish()

    def _heard(self, samples: NDArray[Any]) -> Heard:
        return Heard(self._detector.feed(samples), self._detector.known_until, samples)

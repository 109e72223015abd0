"""Whether recordings contain isolated impacts or dense flow, from the impact detector and the level between impacts.

A window without an impact is uninformative unless the recording is loud throughout. So a model decides on impacts where
most windows are silent, and on windows where impacts are dense or noise never ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.detection.ear import Ear, Heard
from cgid.identification.detection.events import Event
from cgid.identification.detection.windows import WINDOW_TIME, windows_of
from cgid.measure.features.table import ImpactKind
from cgid.recordings import RecordingFile

#: A window is silent if it contains no impact, and its power is below this fraction of that of windows with one (6 dB).
SILENT_POWER = 0.25
#: Impacts are used if more than this fraction of the windows is silent.
SILENT_SHARE = 0.5
#: An interval up to this length [s] with an impact, or two with a rebound, was cut out around it.
CUT_TIME = 0.5
#: Maximum part of a recording that is searched [s].
MAX_SEARCH_TIME = 120.0


@dataclass(frozen=True, kw_only=True)
class Silence:
    """Counts of impacts and silent windows within the annotated intervals of recordings."""

    n_impacts: int = 0  # impacts
    n_windows: int = 0  # `n_windows`, `n_silent`: windows of `WINDOW_TIME`, and how many of them are silent
    n_silent: int = 0
    n_intervals: int = 0  # `n_intervals`, `n_cut`: intervals, and how many of them were cut out around an impact
    n_cut: int = 0

    def __add__(self, other: Silence) -> Silence:
        """Return the sum of two counts."""
        return Silence(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def share(self) -> float:
        """Fraction of silent windows."""
        return self.n_silent / max(self.n_windows, 1)

    @property
    def is_cut(self) -> bool:
        """Whether the intervals were cut out around impacts, or are all too short for a window."""
        return self.n_cut > self.n_intervals / 2 or self.n_windows == 0

    @property
    def has_single_impacts(self) -> bool:
        """Whether impacts are isolated, so that a model should decide on them."""
        return self.is_cut or self.share > SILENT_SHARE

    def __str__(self) -> str:
        """Describe the counts."""
        if self.is_cut:
            return f"{self.n_cut} of {self.n_intervals} recordings or intervals contain a single impact"
        return f"{self.share:.0%} of the time is silence between impacts ({self.n_impacts} found)"


def silence_of(
    recording: RecordingFile,
    kind: ImpactKind,
    intervals: Sequence[tuple[float, float]],
    dead_time: float | None = None,
    hear: Callable[[Heard, float, int], object] | None = None,
) -> Silence:
    """Return the counts of a recording within intervals [s]; raises as its `blocks` and the detector.

    `hear` gets all that is heard, its sampling rate [Hz] and the length of a frame.
    """
    rate = recording.sampling_rate
    # With tones, as in a training on labelled recordings.
    ear = Ear(rate, len(recording.channels), kind=kind, dead_time=dead_time, joint=True, lines=False)
    events: list[Event] = []
    max_samples = left = round(MAX_SEARCH_TIME * rate)

    def begun() -> Iterator[NDArray[np.floating]]:
        nonlocal left
        for block in recording.blocks_with_gaps(joint=True):
            yield block[:, :left]
            left -= block.shape[1]
            if left <= 0:
                break

    def seen() -> Iterator[NDArray[np.floating]]:
        for heard in ear.heard(begun()):
            if hear is not None:
                hear(heard, ear.rate, ear.n_samples)
            events.extend(heard.events)
            yield heard.samples

    parts = [(first, windows.var(axis=2)) for first, windows in windows_of(seen(), rate, WINDOW_TIME, WINDOW_TIME)]
    intervals = [(start, min(end, (max_samples - left) / rate)) for start, end in intervals]
    inside = [sum(start <= event.time < end for event in events) for start, end in intervals]
    # At low rates, the frame of an impact lasts longer.
    cut_time = max(CUT_TIME, ear.n_samples / rate)
    cut = [n in (1, 2) and end - start <= cut_time for n, (start, end) in zip(inside, intervals, strict=True)]
    found = Silence(n_impacts=sum(inside), n_intervals=len(intervals), n_cut=sum(cut))
    if not parts:
        return found
    first, power = (np.concatenate(column) for column in zip(*parts, strict=True))
    complete = ~np.isnan(power).any(axis=1)
    first, power = first[complete], power[complete]
    inside_interval = np.zeros(len(first), bool)
    for start, end in intervals:
        inside_interval |= (first >= start * rate) & (first + WINDOW_TIME * rate <= end * rate + 0.5)
    silent = _silent(power, first, events, WINDOW_TIME * rate)
    return found + Silence(n_windows=int(inside_interval.sum()), n_silent=int((silent & inside_interval).sum()))


def _silent(power: Floats, first: NDArray[np.int64], events: Sequence[Event], length: float) -> NDArray[np.bool_]:
    """Return which windows contain no impact and are much quieter, on every channel, than those that do."""
    has_impact = np.zeros(len(first), bool)
    for event in events:
        has_impact |= (first < event.end) & (first + length > event.onset)
    if not has_impact.any():
        return has_impact
    return ~has_impact & (power < SILENT_POWER * np.median(power[has_impact], axis=0)).all(axis=1)

"""Detected impacts in frames of few lengths, so that hundreds are identified in one batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.features.table import LEAST_SAMPLES, ImpactKind
from cgid.measure.features.vibration import MIN_EVENT
from cgid.signals import Signal

__all__ = ["Event"]

#: Returns the samples (n_channels, n) of a recording between two indices, as far as they exist.
Read = Callable[[int, int], Floats]

#: Frames of vibrations begin this long before the impact and end this long after its onset: enough for every
#: third-octave band [s].
QUIET_TIME, EVENT_TIME = 10e-3, 150e-3
#: The same for pulses [s].
PULSE_QUIET_TIME, PULSE_TIME = 5e-3, 15e-3
#: Minimum of each of the two parts of a pulse frame [samples].
_MIN_PART = 200
#: A longer pulse has a frame 4 or 16 times as long after its onset. Even longer pulses are cut there.
_LONGER, _EXTENSIONS = 4, 16
#: The last part before the detected onset may belong to the impact [s].
LEAD_TIME = 1e-3
#: The detected onset of the next impact may be this late [s].
_LATE = 0.5e-3
#: Impacts on two channels within this time are one impact [s].
SAME_IMPACT = 10e-3
#: A detected impact must rise this many standard deviations above the quiet part of its frame. The limit is lower than
#: that of measurements, because of the ring-down of the previous impact.
DETECTION_LIMIT = 2.0
#: With at least this many samples before an impact, missing ones are mirrored.
_ENOUGH = 8
#: If the recording contains less than this fraction of the quiet part before an impact, the quietest stretch of the
#: frame replaces it. It is searched at this many positions per length.
_FEW, _PARTS = 0.25, 4
#: A vibration is cut off by the start of the recording if its first samples exceed this fraction of its peak and this
#: many standard deviations of the noise. The first samples are those in this time [s], because a vibration crosses
#: zero.
_BEGUN, _BEGUN_OVER_NOISE, _FIRST_TIME = 0.2, 6.0, 0.08e-3
#: A clipped value is at least this fraction of the largest deviation.
_CLIPPED_SHARE = 0.5


@dataclass(eq=False, repr=False)
class Onset:
    """The beginning of an impact, before its frame is cut."""

    row: int  # unit of dead time and neighbours: the channel, or 0 for joint channels
    channel: int  # of joint channels, the one with the strongest signal
    sample: int  # index in the recording
    noise: Floats  # of a vibration, the energy of the noise in each band; of a pulse, the baseline of each channel
    last: int | None = None  # of a pulse, its last high sample so far
    closed: bool = True  # whether no later sample can belong to it
    again: int | None = None  # sample of another impact that follows too closely to be separated


@dataclass(frozen=True, kw_only=True, eq=False)
class Event:
    """One impact in a recording.

    A vibration ends when its energy has fallen to 1 % or to twice the noise, at the latest at the end of its frame or
    at the next impact.

    Attributes
    ----------
    channel : int
        Channel of the impact; of joint channels, the one with the strongest signal.
    onset, end : int
        Index in the recording of its first sample, and of the first sample after it.
    samples : ndarray, (n_samples,) or (n_channels, n_samples)
        The frame; the baseline replaces the next impact, and fills the frame after the end
        of the recording; a quiet part that is too short is extended by mirroring or, where the
        recording begins there, by the quietest stretch of the frame.
    sampling_rate : float [Hz]
    pre_trigger : int or None
        Samples of the frame that are certainly before onset; None if it follows from the pulse itself.
    overlapping : bool
        Whether another impact begins before this one is over, or this one before the previous is over.
    clipped : bool
        Whether three samples in a row have the highest or lowest value.
    cut : bool
        Whether the recording begins or ends within the impact.
    since : int
        Index from which on no sample of its channel is missing before it.
    problem : str
        Why the impact cannot be measured, if the frame does not show it; else empty.
    detection_limit : float
        Least height of a pulse over the standard deviation of the noise, for measuring it.
    unit : str or None
        Unit of the samples.
    source : str
        Name of the recording.
    """

    channel: int
    onset: int
    end: int
    samples: NDArray[Any]
    sampling_rate: float
    pre_trigger: int | None
    overlapping: bool = False
    clipped: bool = False
    cut: bool = False
    since: int = 0
    problem: str = ""
    detection_limit: float = DETECTION_LIMIT
    unit: str | None = None
    source: str = "signal"

    def __repr__(self) -> str:
        marks = [name for name in ("overlapping", "clipped", "cut", "problem") if getattr(self, name)]
        listed_marks = f", {', '.join(marks)}" if marks else ""
        return (
            f"Event({self.source!r}, samples {self.onset} to {self.end - 1} at {self.sampling_rate:g} Hz, "
            f"frame {self.samples.shape}{listed_marks})"
        )

    @property
    def time(self) -> float:
        """Time of the onset in the recording [s]."""
        return self.onset / self.sampling_rate

    @property
    def signal(self) -> Signal:
        """The frame as a signal; raises `InvalidValue` if it has several channels."""
        if self.samples.ndim > 1:
            raise InvalidValue(f"a signal must be of one channel, this event has {len(self.samples)}; take its samples")
        return Signal(
            samples=self.samples,
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            source=self.source,
            pre_trigger=self.pre_trigger,
        )


def frames_alike(events: Sequence[Event]) -> Iterator[tuple[list[int], NDArray[Any]]]:
    """Yield indices and stacked frames of the events that can be measured in one batch."""
    batch: dict[tuple[Any, ...], list[int]] = {}
    for number, event in enumerate(events):
        key = event.samples.shape, event.sampling_rate, event.pre_trigger, event.detection_limit
        batch.setdefault(key, []).append(number)
    for numbers in batch.values():
        yield numbers, np.stack([events[number].samples for number in numbers])


@dataclass(frozen=True, eq=False, repr=False)
class Framing:
    """Lengths of frames in samples."""

    sampling_rate: float
    quiet: int  # before the onset
    lead: int  # last part of `quiet`, which may already belong to the impact
    length: int  # `length`, `longest`: from the onset on, by default and for the longest impact
    longest: int
    pre_trigger: int | None  # see `Event`
    shortest: int  # an impact that the recording cuts off sooner after its onset cannot be measured
    late: int  # how far before its onset the next impact may begin

    @classmethod
    @lru_cache
    def of(cls, kind: str, sampling_rate: float) -> Framing:
        """Return the framing for a kind of impact at a sampling rate [Hz]."""
        validation.choice("kind", kind, get_args(ImpactKind))
        lead, late = max(round(LEAD_TIME * sampling_rate), 1), round(_LATE * sampling_rate)
        if kind == "pulse":
            quiet = max(round(PULSE_QUIET_TIME * sampling_rate), _MIN_PART)
            length = max(round(PULSE_TIME * sampling_rate), _MIN_PART)
            return cls(sampling_rate, quiet, min(lead, quiet // 2), length, _EXTENSIONS * length, None, 0, late)
        quiet = max(round(QUIET_TIME * sampling_rate), 2)
        length = max(round(EVENT_TIME * sampling_rate), LEAST_SAMPLES)
        shortest = int(np.ceil(MIN_EVENT * sampling_rate))
        lead = min(lead, quiet // 2)
        return cls(sampling_rate, quiet, lead, length, length, quiet - lead, shortest, late)

    def length_of(self, onset: Onset) -> int:
        """Return the length, from the onset on, of the frame for a completed impact."""
        length = self.length
        while onset.last is not None and length < self.longest and length <= onset.last + 1 - onset.sample:
            length *= _LONGER
        return length

    @cached_property
    def beyond(self) -> int:
        """The distance behind its end from which a later onset does not affect a frame."""
        return self.late + 1


class FrameCutter:
    """Cut the frames of impacts, which arrive in order of time; with `joint`, frames contain all channels."""

    def __init__(self, framing: Framing, end_of: Callable[[Onset, Floats], int], joint: bool) -> None:
        self._framing, self._end_of, self._joint = framing, end_of, joint
        # The previous impact of each row, and whether it had ended when the next began.
        self._before: dict[int, tuple[Onset, bool]] = {}

    def cut(
        self,
        onset: Onset,
        following: Onset | None,
        samples: NDArray[Any],
        first: int,
        begin: int,
        stop: int | None,
        by: str,
    ) -> Event:
        """Return the event of an onset, between gaps and up to the `following` onset; `by` names the cause of a cut."""
        framing, length = self._framing, self._framing.length_of(onset)
        before, running = self._before.get(onset.row, (None, False))
        if before is not None and before.sample < begin:
            before, running = None, False
        limit = onset.sample + length
        behind = min(limit, limit if stop is None else stop)
        if following is not None:
            behind = min(behind, following.sample)
        one_channel = samples[onset.channel, onset.sample - first : behind - first].astype(np.float64, copy=False)
        lasted = self._end_of(onset, one_channel)
        interrupted = lasted < 0 and following is not None and behind == following.sample
        end = behind if lasted < 0 else min(onset.sample + lasted, max(behind, onset.sample + 1))
        self._before[onset.row] = onset, interrupted
        ended_cut = end == stop
        start = max(onset.sample - framing.quiet, begin, 0 if before is None else (before.last or before.sample) + 1)
        if following is not None:
            behind = min(behind, max(following.sample - framing.late, onset.sample + 1))
        rows = samples if self._joint else samples[onset.channel : onset.channel + 1]
        part = rows[:, start - first : behind - first]
        channel = onset.channel if self._joint else 0
        is_first, n_quiet = before is None and start == begin, onset.sample - framing.lead - start
        stretch = quietest(part[channel], framing.quiet) if is_first and n_quiet < _FEW * framing.quiet else slice(0, 0)
        frame, baseline = self._frame(part, onset, start, length, stretch)
        of_unit = float(baseline[channel])
        began_cut = onset.sample <= begin
        if framing.pre_trigger is not None and onset.sample - begin < framing.lead:
            began_cut = start > begin or has_begun(part[channel], onset.sample - begin, of_unit, stretch, framing.lead)
        recorded = length if stop is None else stop - onset.sample
        is_partial = began_cut or ended_cut or recorded < framing.shortest
        return Event(
            channel=onset.channel,
            onset=onset.sample,
            end=end,
            samples=frame if self._joint else frame[0],
            sampling_rate=framing.sampling_rate,
            pre_trigger=framing.pre_trigger,
            # Impacts after the frame do not count: whether they are known yet depends on the blocks.
            overlapping=running or interrupted or (onset.again is not None and onset.again < limit),
            clipped=_is_clipped(one_channel[: end - onset.sample], of_unit),
            cut=began_cut or ended_cut,
            problem=self._problem(began_cut, ended_cut, recorded, begin, by) if is_partial else "",
        )

    def _frame(
        self, part: NDArray[Any], onset: Onset, start: int, length: int, stretch: slice
    ) -> tuple[NDArray[Any], Floats]:
        """Return the frames (n_channels, n_samples) around a part that begins at `start`, and their baselines."""
        framing = self._framing
        quiet = part[:, : max(onset.sample - framing.lead - start, 0)]
        if stretch.stop:
            quiet = part[:, stretch]
        missing = framing.quiet - (onset.sample - start)
        enough = quiet.shape[1] >= _ENOUGH
        if enough:
            baseline = quiet.mean(axis=1, dtype=np.float64)
        else:
            baseline = np.median(part.astype(np.float64, copy=False), axis=1)
        frame = np.empty((len(part), framing.quiet + length), part.dtype)
        frame[:] = baseline[:, None]
        frame[:, missing : missing + part.shape[1]] = part
        if missing and enough:
            frame[:, :missing] = np.pad(quiet, ((0, 0), (missing, 0)), mode="symmetric")[:, :missing]
        return frame, baseline

    def _problem(self, began_cut: bool, ended_cut: bool, recorded: int, begin: int, by: str) -> str:
        framing = self._framing
        if began_cut:
            cut_by = f"a gap before sample {begin}" if begin else "its start (sample 0)"
            return f"the impact must begin inside the recording, it is cut off by {cut_by}: record samples before it"
        if ended_cut and framing.pre_trigger is None:
            return f"the pulse must end inside the recording, it is cut off by {by}: record a longer frame"
        if recorded < framing.shortest:  # Even if it has ended: later samples distinguish structures.
            return (
                f"the vibration must last {MIN_EVENT * 1e3:g} ms inside the recording, it is cut off by {by} "
                f"after {recorded / framing.sampling_rate * 1e3:.3g} ms: record longer"
            )
        return ""


def quietest(samples: Floats, longest: int) -> slice:
    """Return the slice of the samples (n,) with the least variance; empty for fewer than 4 `_ENOUGH` samples."""
    length = min(longest, samples.size // 4)
    if length < _ENOUGH:
        return slice(0, 0)
    starts = np.arange(0, samples.size - length + 1, max(length // _PARTS, 1))
    powers = [float(np.var(samples[start : start + length], dtype=np.float64)) for start in starts.tolist()]
    start = int(starts[int(np.argmin(powers))])
    return slice(start, start + length)


def has_begun(samples: Floats, onset: int, baseline: float, stretch: slice, lead: int) -> bool:
    """Return whether a vibration (n,) had begun before the first sample; `stretch` of it is noise."""
    count = max(round(lead * _FIRST_TIME / LEAD_TIME), 3)
    first = float(np.abs(samples[:count] - baseline).max())
    peak = float(np.abs(samples[: onset + lead] - baseline).max())
    noise = float(np.std(samples[stretch], dtype=np.float64)) if stretch.stop else 0.0
    return first > max(_BEGUN * peak, _BEGUN_OVER_NOISE * noise)


def _is_clipped(samples: Floats, baseline: float) -> bool:
    """Return whether an impact (n,) stays at an extreme for three samples."""
    extremes = float(samples.max()), float(samples.min())
    min_deviation = _CLIPPED_SHARE * max(abs(extreme - baseline) for extreme in extremes)
    at = [samples == extreme for extreme in extremes if abs(extreme - baseline) >= min_deviation]
    return any(np.count_nonzero(one) > 2 and bool(np.any(one[2:] & one[1:-1] & one[:-2])) for one in at)

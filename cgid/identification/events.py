"""Impacts that were found, each in a frame of one length, so that hundreds are identified in one batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cgid.errors import InvalidValue
from cgid.measure.vibration import SHORTEST_EVENT
from cgid.signals import Signal
from cgid.validation import Floats

#: Returns the samples (n_channels, n) of a recording between two numbers, as far as they are there.
Read = Callable[[int, int], Floats]

#: Frames of vibrations begin this long before the impact and last this long after its onset, enough for every
#: third-octave band [s].
QUIET_TIME, EVENT_TIME = 10e-3, 150e-3
#: The same for pulses,
PULSE_QUIET_TIME, PULSE_TIME = 5e-3, 15e-3
#: with this many samples at least.
_FEWEST = 200
#: A longer pulse has a frame 4 or 16 times as long after its onset; what lasts longer is cut there.
_LONGER, _LONGEST = 4, 16
#: The last part of what is before an impact may belong to it already [s].
LEAD_TIME = 1e-3
#: The onset of the next impact may be placed this late [s].
_LATE = 0.5e-3
#: What was found has to rise this many standard deviations above what is before it in its own frame: less than
#: elsewhere, because the ringing of the blow before may still go on there.
FOUND_LIMIT = 2.0
#: This many samples before an impact can stand for others that are missing.
_ENOUGH = 8
#: What is held in clipping is at least this share of the largest deviation.
_CLIPPED_SHARE = 0.5


@dataclass(eq=False)
class Onset:
    """The beginning of an impact, before its frame is cut.

    Attributes
    ----------
    row : int
        What dead time and neighbours are counted in: its channel, or 0 where all are one.
    channel : int
        Where it was found; where all are one, the channel that heard it most.
    sample : int
        From the first of the recording.
    noise : ndarray, (n,)
        Of a vibration: the energy of the noise in each band. Of a pulse: the baseline of each channel.
    last : int or None
        Of a pulse: its last high sample so far.
    closed : bool
        Whether no later sample can belong to it.
    again : int or None
        Sample at which another one is seen that followed so closely that they are one.
    """

    row: int
    channel: int
    sample: int
    noise: Floats
    last: int | None = None
    closed: bool = True
    again: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Event:
    """One impact in a recording.

    Attributes
    ----------
    channel : int
        Where it was heard; where all channels are one, the one that heard it most.
    onset, end : int
        The first sample of it and the first behind it, from the first of the recording. A vibration is over when its
        energy has fallen to 1 % or to twice the noise, at the latest at the end of its frame or at the next impact.
    samples : ndarray, (n_samples,) or (n_channels, n_samples)
        The frame. From shortly before the next impact (or from the end of the recording) on it holds the baseline.
        Where the impact before it or the start of the recording is too near, the quiet part is mirrored to fill it.
    sampling_rate : float
        [Hz].
    pre_trigger : int or None
        Samples of the frame that are surely before touch; None where the pulse itself must tell.
    overlapping : bool
        Whether another impact begins before this one is over, or this one before the last is.
    clipped : bool
        Whether the largest value is held for three samples.
    cut : bool
        Whether the recording begins or ends within it.
    problem : str
        Why it cannot be measured, where the frame does not show it; else empty.
    detection_limit : float
        What `cgid.measure.features.extract_array` should ask of it.
    unit : str or None
        Of the samples, where known.
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
    problem: str = ""
    detection_limit: float = FOUND_LIMIT
    unit: str | None = None
    source: str = "signal"

    @property
    def time(self) -> float:
        """Of the onset, from the first sample of the recording [s]."""
        return self.onset / self.sampling_rate

    @property
    def signal(self) -> Signal:
        """The frame as a signal; raises `InvalidValue` where it has several channels."""
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
    """Yield the events that can be measured in one batch: their numbers, and their frames one upon the other.

    Their frames are of one length and rate, and `pre_trigger` and `detection_limit` are the same.
    """
    alike: dict[tuple[Any, ...], list[int]] = {}
    for number, event in enumerate(events):
        key = event.samples.shape, event.sampling_rate, event.pre_trigger, event.detection_limit
        alike.setdefault(key, []).append(number)
    for numbers in alike.values():
        yield numbers, np.stack([events[number].samples for number in numbers])


@dataclass(frozen=True)
class Framing:
    """How long frames are, in samples.

    Attributes
    ----------
    sampling_rate : float
        [Hz].
    quiet : int
        Before the onset,
    lead : int
        of which this many may belong to the impact.
    length, longest : int
        From the onset on, and for the longest impact.
    pre_trigger : int or None
        See `Event`.
    shortest : int
        An impact that the recording ends sooner after its onset cannot be measured.
    """

    sampling_rate: float
    quiet: int
    lead: int
    length: int
    longest: int
    pre_trigger: int | None
    shortest: int

    @classmethod
    def of(cls, kind: str, sampling_rate: float) -> Framing:
        """Return the framing of a kind at a sampling rate [Hz]."""
        lead = max(round(LEAD_TIME * sampling_rate), 1)
        if kind == "pulse":
            quiet = max(round(PULSE_QUIET_TIME * sampling_rate), _FEWEST)
            length = max(round(PULSE_TIME * sampling_rate), _FEWEST)
            return cls(sampling_rate, quiet, min(lead, quiet // 2), length, _LONGEST * length, None, 0)
        quiet = max(round(QUIET_TIME * sampling_rate), 2)
        length = max(round(EVENT_TIME * sampling_rate), 16)
        shortest = int(np.ceil(SHORTEST_EVENT * sampling_rate))
        lead = min(lead, quiet // 2)
        return cls(sampling_rate, quiet, lead, length, length, quiet - lead, shortest)

    def length_of(self, onset: Onset) -> int:
        """Return the samples that the frame of an impact, which is over, has from its onset on."""
        length = self.length
        while onset.last is not None and length < self.longest and length <= onset.last + 1 - onset.sample:
            length *= _LONGER
        return length

    @property
    def n_samples(self) -> int:
        """Of a whole frame."""
        return self.quiet + self.length

    @property
    def late(self) -> int:
        """Samples by which the next impact may begin before its onset."""
        return round(_LATE * self.sampling_rate)

    def reach(self, length: int) -> int:
        """Return how far behind its onset an impact begins that has no part in a frame of a length from its onset."""
        return length + self.late + 1


class _Ends(Protocol):
    def end_of(self, onset: Onset, samples: Floats) -> int: ...


class FrameCutter:
    """Cuts the frames of impacts, which come in order of time.

    Parameters
    ----------
    framing : Framing
    ends : PulseOnsets or VibrationOnsets
        Knows when an impact is over.
    joint : bool
        Whether frames are of all channels.
    """

    def __init__(self, framing: Framing, ends: _Ends, joint: bool) -> None:
        self._framing, self._ends, self._joint = framing, ends, joint
        # The impact before in each row, and whether it was still going on when the next began.
        self._before: dict[int, tuple[Onset, bool]] = {}

    def cut(self, onset: Onset, following: Onset | None, samples: NDArray[Any], first: int, stop: int | None) -> Event:
        """Return the event of an onset.

        Parameters
        ----------
        onset : Onset
        following : Onset or None
            The next of its row, where there is one.
        samples : ndarray, (n_channels, n)
            Of the recording from number `first` on, as far as the frame reaches.
        first : int
        stop : int or None
            Number of samples of the recording, once it is over.
        """
        framing, length = self._framing, self._framing.length_of(onset)
        before, running = self._before.get(onset.row, (None, False))
        limit = onset.sample + length
        behind = min(limit, limit if stop is None else stop)
        if following is not None:
            behind = min(behind, following.sample)
        own = samples[onset.channel, onset.sample - first : behind - first].astype(np.float64, copy=False)
        lasted = self._ends.end_of(onset, own)
        interrupted = lasted < 0 and following is not None and behind == following.sample
        end = behind if lasted < 0 else min(onset.sample + lasted, max(behind, onset.sample + 1))
        self._before[onset.row] = onset, interrupted
        began_cut = onset.sample < (framing.lead if framing.pre_trigger is not None else 1)
        ended_cut = end == stop
        start = max(onset.sample - framing.quiet, 0, 0 if before is None else (before.last or before.sample) + 1)
        if following is not None:
            behind = min(behind, max(following.sample - framing.late, onset.sample + 1))
        rows = samples if self._joint else samples[onset.channel : onset.channel + 1]
        frame, baseline = self._frame(rows[:, start - first : behind - first], onset, start, length)
        mine = float(baseline[onset.channel if self._joint else 0])
        return Event(
            channel=onset.channel,
            onset=onset.sample,
            end=end,
            samples=frame if self._joint else frame[0],
            sampling_rate=framing.sampling_rate,
            pre_trigger=framing.pre_trigger,
            # What is seen behind the frame may not be known yet: it depends on the blocks.
            overlapping=running or interrupted or (onset.again is not None and onset.again < limit),
            clipped=_is_clipped(own[: end - onset.sample] - mine),
            cut=began_cut or ended_cut,
            problem=self._problem(began_cut, ended_cut, end - onset.sample),
        )

    def _frame(self, part: NDArray[Any], onset: Onset, start: int, length: int) -> tuple[NDArray[Any], Floats]:
        """Return the frames (n_channels, n_samples) around a part from `start` on, and their baselines."""
        framing = self._framing
        quiet = part[:, : max(onset.sample - framing.lead - start, 0)]
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

    def _problem(self, began_cut: bool, ended_cut: bool, lasted: int) -> str:
        framing = self._framing
        if began_cut:
            return (
                "the impact must begin inside the recording, it is cut off by its start (sample 0): record some "
                "samples before touch"
            )
        if ended_cut and framing.pre_trigger is None:
            return "the pulse must end inside the recording, it is cut off by its end: record a longer frame"
        if ended_cut and lasted < framing.shortest:
            return (
                f"the vibration must last {SHORTEST_EVENT * 1e3:g} ms inside the recording, it is cut off by its end "
                f"after {lasted / framing.sampling_rate * 1e3:.3g} ms: record longer"
            )
        return ""


def _is_clipped(deviation: Floats) -> bool:
    """Return whether an impact (n,), its baseline removed, holds its highest or lowest value for some samples."""
    least = _CLIPPED_SHARE * np.abs(deviation).max()
    for extreme in (deviation.max(), deviation.min()):
        at = deviation == extreme
        if abs(extreme) >= least and bool(np.any(at[2:] & at[1:-1] & at[:-2])):
            return True
    return False

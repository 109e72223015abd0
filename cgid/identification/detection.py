"""Impacts in a recording that comes block by block: each with its onset, its end and a frame of one length.

Finding the impacts in a recording that is in memory; `ImpactDetector` finds them in one that comes in blocks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.identification.events import FOUND_LIMIT, Event, FrameCutter, Framing, Onset
from cgid.identification.pulse_onsets import START_CHUNKS as PULSE_START
from cgid.identification.pulse_onsets import THRESHOLD_OVER_NOISE, THRESHOLD_OVER_PEAK, PulseOnsets
from cgid.identification.vibration_onsets import RISE_OVER_NOISE, RingingOnsets
from cgid.identification.vibration_onsets import START_CHUNKS as RINGING_START
from cgid.measure.frames import DETECTION_LIMIT, LARGEST
from cgid.measure.table import ImpactKind
from cgid.measure.vibration import SHORTEST_EVENT
from cgid.signals import Signal
from cgid.validation import Floats, require_rate

#: What follows within this time belongs to the same blow: a struck body rings [s].
DEAD_TIME = 2e-3
#: The same for a vibration: of what another follows sooner, too little is left to be measured.
VIBRATION_DEAD_TIME = SHORTEST_EVENT
#: No recorder of impacts is faster: frames would fill the memory [Hz].
FASTEST = 2e7
#: About so many samples are looked at together: they and what is made of them stay in the processor's cache.
_TOGETHER = 1 << 16


class ImpactDetector:
    """Finds impacts in a recording of one or more channels, fed in blocks of any size.

    What it has to say does not depend on the blocks: everything moves in chunks counted from the first sample. Memory
    holds some tenths of a second, however long the recording is.

    A vibration's blow is a sudden rise of energy over ringing and noise (`ringing`), a pulse what rises above
    the baseline (`pulses`).

    Parameters
    ----------
    sampling_rate : float
        [Hz].
    n_channels : int
    kind : {"pulse", "vibration"}
    dead_time : float, optional
        What comes so soon after an impact belongs to it [s]. Of a pulse `DEAD_TIME`, counted from its last high sample;
        of a vibration `VIBRATION_DEAD_TIME`, counted from its onset, and 4 ms at least.
    joint : bool
        Whether all channels hear the same impacts: an event has the frames of all, and begins with what any hears.
        Else each channel has its own.
    event_time : float, optional
        Of the impact in its frame [s].

    Attributes
    ----------
    pre_trigger : int or None
        Samples of each frame that are surely before touch; None where each pulse tells its own.
    n_samples : int
        Of each frame,
    n_quiet : int
        of which so many lie before the onset.

    Examples
    --------
    >>> detector = ImpactDetector(10_000.0, kind="pulse")
    >>> samples = np.zeros((1, 5000))
    >>> samples[0, 2000:2010] = 50.0
    >>> events = detector.feed(samples[:, :3000]) + detector.feed(samples[:, 3000:]) + detector.finish()
    >>> [(event.onset, event.end, event.samples.shape) for event in events]
    [(2000, 2010, (400,))]
    """

    def __init__(
        self,
        sampling_rate: float,
        n_channels: int = 1,
        *,
        kind: ImpactKind,
        dead_time: float | None = None,
        joint: bool = False,
        event_time: float | None = None,
    ) -> None:
        validation.choice("kind", kind, get_args(ImpactKind))
        rate = require_rate(sampling_rate)
        if rate > FASTEST:
            raise InvalidValue(
                f"sampling_rate must be at most {FASTEST:g} Hz where impacts are looked for, got {rate:g} Hz; check it"
            )
        n_channels = validation.count("n_channels", n_channels)
        if dead_time is None:
            dead_time = DEAD_TIME if kind == "pulse" else VIBRATION_DEAD_TIME
        dead_time = validation.number("dead_time", dead_time, "s", validation.not_negative)
        if event_time is not None:
            event_time = validation.number("event_time", event_time, "s", validation.positive)
        self.n_channels, self.joint = n_channels, joint
        self._framing = Framing.of(kind, rate, event_time)
        self.n_samples, self.n_quiet = self._framing.n_samples, self._framing.quiet
        self.pre_trigger = self._framing.pre_trigger
        self._onsets: PulseOnsets | RingingOnsets
        if kind == "pulse":
            self._onsets, start = PulseOnsets(rate, n_channels, dead_time, self._framing.length, joint), PULSE_START
        else:
            self._onsets, start = RingingOnsets(rate, n_channels, dead_time, joint), RINGING_START
        # Samples from number `first` on, and blocks that are not among them yet.
        self._samples: NDArray[Any] = np.empty((n_channels, 0), np.float32)
        self._first = 0
        self._blocks: list[NDArray[Any]] = []
        self._taken, self._fed = 0, 0
        self._needed = start * self._onsets.chunk
        self._pending: list[Onset] = []
        self._cutter = FrameCutter(self._framing, self._onsets, joint)
        self._ended = False

    @property
    def told(self) -> int:
        """All impacts that begin before this sample have been returned."""
        if self._ended:
            return self._fed
        reach = max(self._taken - self._onsets.lag - self._framing.reach, 0)
        return min([reach, *(onset.sample for onset in self._pending)])

    def feed(self, block: ArrayLike) -> list[Event]:
        """Take the next samples and return the impacts whose frames are whole by now, in order of time.

        Parameters
        ----------
        block : array_like, (n_channels, n)
            Finite numbers; pulses point upwards. One channel may be (n,).

        Raises
        ------
        InvalidValue
            The block has another shape, or the recording is over.
        BadData
            A sample is not finite or absurdly large.
        """
        samples = self._checked(block)
        # A copy: who feeds may use his block again.
        self._blocks.append(samples.copy())
        self._fed += samples.shape[1]
        if self._fed < self._needed:
            return []
        self._join()
        chunk = self._onsets.chunk
        together = max(_TOGETHER // (self.n_channels * chunk), 1) * chunk
        events = []
        while self._fed >= self._needed:
            whole = (self._fed - self._taken) // chunk * chunk
            events += self._take(min(whole, max(together, self._needed - self._taken)))
            self._needed = self._taken + chunk
        # Else what is left would hold all of a long block.
        self._samples = self._samples.copy()
        return events

    def finish(self) -> list[Event]:
        """Return the impacts that are left when there are no more samples."""
        if self._ended:
            return []
        self._join()
        self._ended = True
        rest = self._read(self._taken, self._fed)
        missing = -rest.shape[1] % self._onsets.chunk
        padded = np.pad(rest, ((0, 0), (0, missing)), mode="edge") if rest.shape[1] else rest
        found = self._onsets.take(padded, self._read, rest.shape[1])
        self._taken = self._fed
        return self._whole(found)

    def _checked(self, block: ArrayLike) -> NDArray[Any]:
        if self._ended:
            raise InvalidValue("the recording is over: after finish() no block can be taken; make another detector")
        samples = validation.plain("block", block)
        if samples.ndim == 1 and self.n_channels == 1:
            samples = samples[None]
        if samples.ndim != 2 or len(samples) != self.n_channels or samples.dtype.kind not in "fiu":
            raise InvalidValue(
                f"a block must be real numbers of shape ({self.n_channels}, n), got shape {samples.shape} of "
                f"{samples.dtype}"
            )
        if samples.dtype not in (np.float32, np.float64):
            samples = samples.astype(np.float64)
        lowest, highest = (float(samples.min()), float(samples.max())) if samples.size else (0.0, 0.0)
        # Nan lies nowhere.
        if not -LARGEST <= lowest <= highest <= LARGEST:
            raise BadData(
                f"samples must be finite and lie within +-{LARGEST:g}, they reach from {lowest:.3g} to {highest:.3g}; "
                "was the file read in the right format?"
            )
        return samples

    def _join(self) -> None:
        """Append the blocks that have come to the samples."""
        if self._blocks:
            kept = [self._samples] if self._samples.shape[1] else []
            self._samples = np.concatenate([*kept, *self._blocks], axis=1)
            self._blocks = []

    def _read(self, start: int, stop: int) -> Floats:
        part = self._samples[:, max(start - self._first, 0) : max(stop - self._first, 0)]
        return part.astype(np.float64, copy=False)

    def _take(self, count: int) -> list[Event]:
        found = self._onsets.take(self._read(self._taken, self._taken + count), self._read)
        self._taken += count
        events = self._whole(found)
        oldest = min([self._taken - self._onsets.lag, *(onset.sample for onset in self._pending)])
        drop = oldest - self._framing.quiet - self._first
        if drop > 0:
            self._samples, self._first = self._samples[:, drop:], self._first + drop
        return events

    def _whole(self, found: list[Onset]) -> list[Event]:
        """Return the events whose frames are whole with what has been taken."""
        self._pending = sorted([*self._pending, *found], key=lambda onset: (onset.sample, onset.row))
        reach = self._taken - self._onsets.lag - self._framing.reach
        stop = self._fed if self._ended else None
        events = []
        while self._pending:
            onset = self._pending[0]
            if not self._ended and not (onset.closed and onset.sample <= reach):
                break
            del self._pending[0]
            following = next((other for other in self._pending if other.row == onset.row), None)
            events.append(self._cutter.cut(onset, following, self._samples, self._first, stop))
        return events


__all__ = [
    "DEAD_TIME",
    "FOUND_LIMIT",
    "THRESHOLD_OVER_NOISE",
    "THRESHOLD_OVER_PEAK",
    "TURN_OVER",
    "VIBRATION_DEAD_TIME",
    "Event",
    "Extent",
    "ImpactDetector",
    "cure_of_silence",
    "find_impacts",
]

#: A recording of which more samples than this lie at its limits is clipped from its beginning to its end.
_CLIPPED_SHARE = 0.5
#: What falls this many times as far as it rises is upside down.
_UPSIDE_DOWN = 3.0
#: What cures that.
TURN_OVER = "turn it over with --invert, for pulses must point upwards"


def find_impacts(signal: Signal, *, kind: ImpactKind = "pulse", dead_time: float | None = None) -> list[Event]:
    """Return the impacts in a recording, in order.

    What `ImpactDetector` finds, but for pulses whose highest sample does not rise to `THRESHOLD_OVER_PEAK` of that of
    the highest pulse, and for vibrations that the recording ends before they can be measured. Frames are
    longer where a pulse is. A frame of a dataset (its `pre_trigger` is known) is one impact.

    Parameters
    ----------
    signal : Signal
        Pulses point upwards.
    kind : {"pulse", "vibration"}
    dead_time : float, optional
        [s], 0 or more; `DEAD_TIME` or `VIBRATION_DEAD_TIME` if not given.

    Returns
    -------
    list of Event
        At least one; their frames are of one length.

    Raises
    ------
    BadData
        The signal is constant or absurdly large, or nothing rises above the noise.
    """
    validation.choice("kind", kind, get_args(ImpactKind))
    if dead_time is not None:
        dead_time = validation.number("dead_time", dead_time, "s", validation.not_negative)
    lowest, highest = float(signal.samples.min()), float(signal.samples.max())
    if max(highest, -lowest) > LARGEST:
        raise BadData(
            f"{signal.name}: samples must lie within +-{LARGEST:g}, they reach from {lowest:.3g} to {highest:.3g}; was "
            "the file read in the right format?"
        )
    if lowest == highest:
        count = signal.samples.size
        told = f"all {count} samples are" if count > 1 else "its only sample is"
        raise BadData(f"{signal.name}: no impact: {told} {lowest:g}; check the sensor and its cable")
    if signal.pre_trigger is not None:
        return [_whole_frame(signal, signal.pre_trigger)]
    found = _found(signal, kind, dead_time)
    if not found:
        raise BadData(_nothing_in(signal, kind))
    if kind == "pulse":
        found = _high_ones(signal, found)
    else:
        long_enough = [event for event in found if not event.problem or event.end < signal.samples.size]
        if not long_enough:
            raise BadData(f"{signal.name}: {found[0].problem}")
        found = long_enough
    return [replace(event, unit=signal.unit, source=signal.name) for event in found]


def _found(signal: Signal, kind: ImpactKind, dead_time: float | None) -> list[Event]:
    event_time: float | None = None
    while True:
        detector = ImpactDetector(signal.sampling_rate, kind=kind, dead_time=dead_time, event_time=event_time)
        found = detector.feed(signal.samples) + detector.finish()
        longest = max((event.end - event.onset for event in found), default=0)
        room = detector.n_samples - detector.n_quiet
        if kind == "vibration" or longest < room or room >= signal.samples.size:
            return found
        event_time = 4 * room / signal.sampling_rate


def _high_ones(signal: Signal, found: list[Event]) -> list[Event]:
    """Leave out the pulses that are low beside the highest: what a struck body does after one may look like them."""
    middle = float(np.median(signal.samples.astype(np.float64)))  # the sum of two float32 may be beyond all of them
    heights = [float(signal.samples[event.onset : event.end].max()) - middle for event in found]
    least = THRESHOLD_OVER_PEAK * max(heights)
    return [event for event, height in zip(found, heights, strict=True) if height > least]


def _whole_frame(signal: Signal, pre_trigger: int) -> Event:
    return Event(
        channel=0,
        onset=pre_trigger,
        end=signal.samples.size,
        samples=signal.samples,
        sampling_rate=signal.sampling_rate,
        pre_trigger=pre_trigger,
        detection_limit=DETECTION_LIMIT,
        unit=signal.unit,
        source=signal.name,
    )


def _nothing_in(signal: Signal, kind: ImpactKind) -> str:
    """Return what is to say of a recording without impacts."""
    samples = signal.samples.astype(np.float64, copy=False)
    middle = float(np.median(samples))
    noise = 1.4826 * float(np.median(np.abs(samples - middle)))
    limits = float(samples.max()), float(samples.min())
    unit = f" {signal.unit}" if signal.unit else ""
    if np.mean((samples == limits[0]) | (samples == limits[1])) > _CLIPPED_SHARE:
        return (
            f"{signal.name}: no impact: it is clipped throughout, at {limits[1]:.3g} and {limits[0]:.3g}{unit}; record "
            "with a larger range"
        )
    highest, lowest = limits[0] - middle, middle - limits[1]
    if kind == "vibration":
        return (
            f"{signal.name}: no impact: the energy must rise at once to {RISE_OVER_NOISE:g} times that of the noise "
            f"({noise:.3g}{unit}), it nowhere does; the farthest sample lies {max(highest, lowest):.3g}{unit} from the "
            "median; record nearer or with less noise"
        )
    return (
        f"{signal.name}: no impact: a sample must rise {THRESHOLD_OVER_NOISE:g} times the noise ({noise:.3g}{unit}) "
        f"above the median, the highest rises {highest:.3g}{unit}, the deepest falls {lowest:.3g}{unit}; "
        f"{cure_of_silence(kind, highest, lowest)}"
    )


def cure_of_silence(kind: ImpactKind, rise: float, fall: float) -> str:
    """Return what to do where no impact is found, by how far samples rise above their middle and fall below it.

    Examples
    --------
    >>> cure_of_silence("pulse", 2.0, 90.0) == TURN_OVER
    True
    """
    return TURN_OVER if kind == "pulse" and fall > _UPSIDE_DOWN * rise else "record nearer or with less noise"


class Extent:
    """How far the samples of channels reach, of blocks that pass by.

    Attributes
    ----------
    lowest, highest, mean : ndarray, (n_channels,)
    n_samples : int
    """

    def __init__(self, n_channels: int) -> None:
        self.lowest, self.highest = np.full(n_channels, np.inf), np.full(n_channels, -np.inf)
        self._total, self.n_samples = np.zeros(n_channels), 0

    @property
    def mean(self) -> Floats:
        """Of all samples."""
        return self._total / self.n_samples

    def see(self, block: NDArray[Any]) -> None:
        """Look at the next samples, (n_channels, n)."""
        self.lowest = np.minimum(self.lowest, block.min(axis=1))
        self.highest = np.maximum(self.highest, block.max(axis=1))
        self._total += block.sum(axis=1, dtype=np.float64)
        self.n_samples += block.shape[1]

    def cure(self, row: int, kind: ImpactKind) -> str:
        """Return what to do where no impact of a kind is found in a channel."""
        return cure_of_silence(kind, self.highest[row] - self.mean[row], self.mean[row] - self.lowest[row])

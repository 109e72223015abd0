"""Impacts in a recording that comes block by block: each with its onset, its end and a frame of one length."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.frames import Event, FrameCutter, Framing
from cgid.identification.detection.onsets import Onset
from cgid.identification.detection.pulses import START_CHUNKS as PULSE_START
from cgid.identification.detection.pulses import PulseOnsets
from cgid.identification.detection.ringing import START_CHUNKS as RINGING_START
from cgid.identification.detection.ringing import RingingOnsets
from cgid.measure.frames import LARGEST
from cgid.measure.table import ImpactKind
from cgid.measure.vibration import SHORTEST_EVENT
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

"""Streaming impact detection: each impact with its onset, its end and a frame.

The result is the same for a complete recording, for blocks and for a live stream. Pulses rise above a baseline
(`pulse_onsets`); vibrations are a sudden rise of energy above ring-down and noise (`vibration_onsets`).
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats, require_rate
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.events import Event, FrameCutter, Framing, Onset
from cgid.identification.detection.pulse_onsets import START_CHUNKS as PULSE_START
from cgid.identification.detection.pulse_onsets import THRESHOLD_OVER_NOISE, PulseOnsets
from cgid.identification.detection.vibration_onsets import RISE, RISE_OVER_NOISE, VibrationOnsets
from cgid.identification.detection.vibration_onsets import START_CHUNKS as VIBRATION_START
from cgid.measure.features.table import ImpactKind
from cgid.measure.features.vibration import MIN_EVENT
from cgid.measure.frames import DETECTION_LIMIT, LARGEST
from cgid.signals import Signal

#: Later samples within this time belong to the same impact, because of its ring-down [s].
DEAD_TIME = 2e-3
#: The same for vibrations. If the next impact follows sooner, too few samples remain to measure.
VIBRATION_DEAD_TIME = MIN_EVENT
#: Highest sampling rate [Hz]; no recorder of impacts is faster, and frames would fill the memory.
FASTEST = 2e7
#: Approximate number of samples processed together, so that they and their derived arrays fit into the cache.
_TOGETHER = 1 << 16
#: A recording is clipped throughout if more than this fraction of its samples is at its limits.
_CLIPPED_SHARE = 0.5
#: Every 64th sample is checked for clipping.
_EVERY = 64
#: A signal is upside down if it falls this many times as far as it rises.
_UPSIDE_DOWN = 3.0


def invert_hint() -> str:
    """Return what helps where pulses point downwards."""
    return f"invert it with {spelled('invert', 'true')}, since pulses must point upwards"


class ImpactDetector:
    """Find impacts in a recording of one or more channels, fed in blocks of any size.

    The result does not depend on the blocks, because all processing happens in chunks counted from the first sample.
    Memory use is some tenths of a second of samples, for recordings of any length.

    Parameters
    ----------
    sampling_rate : float
        [Hz].
    n_channels : int
    kind : {"pulse", "vibration"}
    dead_time : float, optional
        Samples within this time belong to the same impact [s]. For pulses, it counts from the last high sample and is
        `DEAD_TIME` by default; for vibrations, from the onset, `VIBRATION_DEAD_TIME` by default, at least 4 ms.
    joint : bool
        Whether an impact in any channel is one in all, and an event has the frames of all channels.
    gaps : bool
        Whether nan is a missing sample, which is in no noise level and no frame; otherwise it is an error.

    Attributes
    ----------
    pre_trigger : int or None
        Samples of each frame that are certainly before onset; None if it follows from each pulse.
    n_samples, n_quiet : int
        Length of a frame, and of its part before the onset. The frame of a longer pulse is longer.

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
        gaps: bool = False,
    ) -> None:
        rate = require_rate(sampling_rate)
        if rate > FASTEST:
            raise InvalidValue(
                f"sampling_rate must be at most {FASTEST:g} Hz to detect impacts, got {rate:g} Hz; check it"
            )
        n_channels = validation.count("n_channels", n_channels)
        if dead_time is None:
            dead_time = DEAD_TIME if kind == "pulse" else VIBRATION_DEAD_TIME
        dead_time = validation.number("dead_time", dead_time, "s", validation.not_negative)
        self.n_channels, self.joint, self._gaps = n_channels, joint, gaps
        self._framing = Framing.of(kind, rate)
        self.n_samples, self.n_quiet = self._framing.quiet + self._framing.length, self._framing.quiet
        self.pre_trigger = self._framing.pre_trigger
        self._onsets: PulseOnsets | VibrationOnsets
        if kind == "pulse":
            self._onsets, start = PulseOnsets(rate, n_channels, dead_time, self._framing.longest, joint), PULSE_START
        else:
            self._onsets, start = VibrationOnsets(rate, n_channels, dead_time, joint), VIBRATION_START
        # `_samples` begins at index `_first` of the recording; `_blocks` are not joined to it yet.
        self._samples: NDArray[Any] = np.empty((n_channels, 0), np.float32)
        self._first = 0
        self._blocks: list[NDArray[Any]] = []
        self._taken, self._fed = 0, 0
        # Samples before this one may be missing.
        self._gap_until = 0
        # Index at which each channel continues after a gap.
        self._resumed: list[list[int]] = [[0] for _ in range(n_channels)]
        self._needed = start * self._onsets.chunk
        self._pending: list[Onset] = []
        self._cutter = FrameCutter(self._framing, self._onsets.end_of, joint)
        # Extremes of each channel, and how many of the samples that were looked at are there.
        self._lowest, self._highest = np.full(n_channels, np.inf), np.full(n_channels, -np.inf)
        self._counted, self._counts = np.stack([self._lowest, self._highest]), np.zeros((2, n_channels))
        self._seen, self._passed = 0, 0
        self._ended = False

    @property
    def known_until(self) -> int:
        """Index of the sample before which all impacts have been returned."""
        if self._ended:
            return self._fed
        reach = max(self._taken - self._onsets.lag - self._framing.length - self._framing.beyond, 0)
        return min([reach, *(onset.sample for onset in self._pending)])

    def feed(self, block: ArrayLike) -> list[Event]:
        """Add the next samples and return the impacts with complete frames, in order of time.

        Parameters
        ----------
        block : array_like, (n_channels, n) or, of one channel, (n,)
            Finite numbers, or nan where `gaps` allows it; pulses point upwards.

        Returns
        -------
        list of Event

        Raises
        ------
        InvalidValue
            The block has another shape, or the recording is over.
        BadData
            A sample is not finite or absurdly large.
        """
        samples = self._checked(block)
        # The caller may reuse the block.
        self._blocks.append(samples.copy())
        self._fed += samples.shape[1]
        if self._fed < self._needed:
            return []
        self._join()
        chunk = self._onsets.chunk
        together = max(_TOGETHER // (self.n_channels * chunk), 1) * chunk
        events = []
        while self._fed >= self._needed:
            n_complete = (self._fed - self._taken) // chunk * chunk
            events += self._take(min(n_complete, max(together, self._needed - self._taken)))
            self._needed = self._taken + chunk
        # A view would keep all of a long block in memory.
        self._samples = self._samples.copy()
        return events

    def finish(self) -> list[Event]:
        """Return the remaining impacts at the end of the recording.

        Returns
        -------
        list of Event
        """
        if self._ended:
            return []
        self._join()
        self._ended = True
        rest = self._read(self._taken, self._fed)
        missing = -rest.shape[1] % self._onsets.chunk
        padded = np.pad(rest, ((0, 0), (0, missing)), mode="edge") if rest.shape[1] else rest
        pulses = self._onsets.take(padded, self._read, rest.shape[1])
        self._taken = self._fed
        return self._complete(pulses)

    def is_upside_down(self, channel: int = 0) -> bool:
        """Return whether a channel falls more than three times as far below its baseline as it rises above it."""
        onsets = self._onsets
        return isinstance(onsets, PulseOnsets) and bool(onsets.fall[channel] > _UPSIDE_DOWN * onsets.rise[channel])

    def why_silent(self, channel: int = 0, unit: str | None = None) -> str:
        """Explain why a channel of a finished recording has no impact, and suggest a remedy."""
        in_unit = f" {unit}" if unit else ""
        lowest, highest = float(self._lowest[channel]), float(self._highest[channel])
        if lowest > highest:
            return "no impact: no sample could be read; check the sensor and its cable"
        if not lowest < highest:
            constant = f"all {self._fed} samples are" if self._fed > 1 else "the only sample is"
            return f"no impact: {constant} {lowest:g}; check the sensor and its cable"
        if float(self._counts[:, channel].sum()) > _CLIPPED_SHARE * max(self._seen, 1):
            return (
                f"no impact: it is clipped throughout, at {lowest:.3g} and {highest:.3g}{in_unit}; record with a "
                "larger range"
            )
        hint, onsets = "record closer to the impact or with less noise", self._onsets
        if isinstance(onsets, VibrationOnsets):
            steepest = onsets.steepest[channel] / RISE
            return (
                f"no impact: the energy must rise at once to {RISE_OVER_NOISE:g} times that of the noise, it rises to "
                f"{RISE_OVER_NOISE * steepest:.2g} times at most; {hint}"
            )
        rise, fall, noise = onsets.rise[channel], onsets.fall[channel], onsets.noise[channel]
        if self.is_upside_down(channel):
            hint = invert_hint()
        return (
            f"no impact: a sample must rise {THRESHOLD_OVER_NOISE:g} times the noise ({noise:.3g}{in_unit}) above the "
            f"baseline, the highest rises {rise:.3g}{in_unit}, the deepest falls {fall:.3g}{in_unit}; {hint}"
        )

    def _checked(self, block: ArrayLike) -> NDArray[Any]:
        if self._ended:
            raise InvalidValue("the recording has ended: after finish() no block can be added; use a new detector")
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
        if samples.size:
            lowest, highest = samples.min(axis=1), samples.max(axis=1)
            least, most = float(lowest.min()), float(highest.max())
            if self._gaps and np.isnan(least):
                self._gap_until = self._fed + samples.shape[1]
                for resumed, missing in zip(self._resumed, np.isnan(samples), strict=True):
                    resumed += (self._fed + 1 + np.flatnonzero(missing & ~np.append(missing[1:], False))).tolist()
                lowest, highest = (
                    extreme.reduce(samples, axis=1, initial=start)
                    for extreme, start in ((np.fmin, np.inf), (np.fmax, -np.inf))
                )
                least, most = float(lowest.min()), float(highest.max())
                if least > most:  # nothing is there
                    return samples
            # The comparison is also false for nan.
            if not -LARGEST <= least <= most <= LARGEST:
                raise BadData(
                    f"samples must be finite and within +-{LARGEST:g}, they reach from {least:.3g} to {most:.3g}; "
                    "was the file read in the right format?"
                )
            self._lowest, self._highest = np.minimum(self._lowest, lowest), np.maximum(self._highest, highest)
        return samples

    def _join(self) -> None:
        """Append the pending blocks to the samples, and count those at the limits."""
        if not self._blocks:
            return
        n_kept = self._samples.shape[1]
        self._samples = np.concatenate([*([self._samples] if n_kept else []), *self._blocks], axis=1)
        self._blocks = []
        limits = np.stack([self._lowest, self._highest])
        self._counts[limits != self._counted] = 0
        self._counted = limits
        # Of the recording, not of each block: the fraction must not depend on the blocks.
        looked = self._samples[:, n_kept + -self._passed % _EVERY :: _EVERY]
        self._passed += self._samples.shape[1] - n_kept
        self._counts += (looked == limits[:, :, None]).sum(axis=2)
        self._seen += looked.shape[1]

    def _read(self, start: int, stop: int) -> Floats:
        part = self._samples[:, max(start - self._first, 0) : max(stop - self._first, 0)]
        return part.astype(np.float64, copy=False)

    def _take(self, count: int) -> list[Event]:
        pulses = self._onsets.take(self._read(self._taken, self._taken + count), self._read)
        self._taken += count
        events = self._complete(pulses)
        oldest = min([self._taken - self._onsets.lag, *(onset.sample for onset in self._pending)])
        drop = oldest - self._framing.quiet - self._first
        if drop > 0:
            self._samples, self._first = self._samples[:, drop:], self._first + drop
            for resumed in self._resumed:
                del resumed[: bisect_right(resumed, self._first) - 1]
        return events

    def _complete(self, pulses: list[Onset]) -> list[Event]:
        """Return the events whose frames are complete with the samples so far."""
        self._pending = sorted([*self._pending, *pulses], key=lambda onset: (onset.sample, onset.row))
        known = self._taken - self._onsets.lag
        stop = self._fed if self._ended else None
        events = []
        while self._pending:
            onset = self._pending[0]
            reach = self._framing.length_of(onset) + self._framing.beyond
            if not self._ended and not (onset.closed and onset.sample + reach <= known):
                break
            del self._pending[0]
            begin, end = 0, None
            if self._gap_until > max(onset.sample - self._framing.quiet, 0):
                bounds = self._between_gaps(onset, onset.sample + reach)
                if bounds is None:
                    continue
                begin, end = bounds
            by = "its end" if end is None else f"a gap at sample {end}"
            end = stop if end is None else end
            following = next((other for other in self._pending if other.row == onset.row), None)
            if following is not None and end is not None and following.sample >= end:
                following = None
            event = self._cutter.cut(onset, following, self._samples, self._first, begin, end, by)
            events.append(replace(event, since=self._since(onset)) if self._gap_until else event)
        return events

    def _since(self, onset: Onset) -> int:
        """Return the sample after the last gap before an onset."""
        latest = 0
        for channel in range(self.n_channels) if self.joint else [onset.channel]:
            before = [sample for sample in self._resumed[channel] if sample <= onset.sample]
            self._resumed[channel] = [before[-1], *(s for s in self._resumed[channel] if s > onset.sample)]
            latest = max(latest, before[-1])
        return latest

    def _between_gaps(self, onset: Onset, reach: int) -> tuple[int, int | None] | None:
        """Return the samples around an onset up to the next gaps; None if one of joint channels misses the onset."""
        start = max(onset.sample - self._framing.quiet, self._first)
        rows = slice(None) if self.joint else slice(onset.channel, onset.channel + 1)
        missing = np.isnan(self._samples[rows, start - self._first : reach - self._first]).any(axis=0)
        position = onset.sample - start
        if missing[position]:
            return None
        before, after = np.flatnonzero(missing[:position]), np.flatnonzero(missing[position:])
        begin = start + int(before[-1]) + 1 if before.size else 0
        return begin, onset.sample + int(after[0]) if after.size else None


def find_impacts(
    signal: Signal | str | Path, *, kind: ImpactKind = "pulse", dead_time: float | None = None
) -> list[Event]:
    """Return the impacts in a recording, in order of time, as `ImpactDetector` finds them.

    A frame of a dataset (its `pre_trigger` is known) is one impact.

    Parameters
    ----------
    signal : Signal, str or Path
        Pulses point upwards. A recording of one channel may be given by its path, if the file states rate and unit.
    kind : {"pulse", "vibration"}
    dead_time : float, optional
        [s], at least 0; by default `DEAD_TIME` or `VIBRATION_DEAD_TIME`.

    Returns
    -------
    list of Event
        At least one.

    Raises
    ------
    BadData
        The signal is constant or absurdly large, or nothing rises above the noise.
    InvalidValue
        It is no signal, or a recording of several channels.
    """
    if isinstance(signal, str | Path):
        from cgid.recordings import read_recording

        first, *others = read_recording(signal)
        if others:
            raise InvalidValue(f"{signal}: must be of one channel; take one of those of cgid.read_recording")
        signal = first
    if not isinstance(signal, Signal):
        raise InvalidValue(
            f"signal must be a Signal or a path, got {validation.shown(signal)}; samples are one as "
            "cgid.Signal(samples, sampling_rate, unit)"
        )
    detector = ImpactDetector(signal.sampling_rate, kind=kind, dead_time=dead_time)
    try:
        pulses = detector.feed(signal.samples) + detector.finish()
    except BadData as error:
        raise BadData(f"{signal.name}: {error}") from None
    if signal.pre_trigger is not None and np.ptp(signal.samples) > 0:
        return [
            Event(
                channel=0,
                onset=signal.pre_trigger,
                end=signal.samples.size,
                samples=signal.samples,
                sampling_rate=signal.sampling_rate,
                pre_trigger=signal.pre_trigger,
                detection_limit=DETECTION_LIMIT,
                unit=signal.unit,
                source=signal.name,
            )
        ]
    if not pulses:
        raise BadData(f"{signal.name}: {detector.why_silent(unit=signal.unit)}")
    return [replace(event, unit=signal.unit, source=signal.name) for event in pulses]

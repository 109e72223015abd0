"""Finding the impacts in a recording that is in memory; `ImpactDetector` finds them in one that comes in blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.identification.detection.detector import (
    DEAD_TIME,
    VIBRATION_DEAD_TIME,
    ImpactDetector,
)
from cgid.identification.detection.frames import FOUND_LIMIT, Event
from cgid.identification.detection.pulses import THRESHOLD_OVER_NOISE, THRESHOLD_OVER_PEAK
from cgid.identification.detection.ringing import RISE_OVER_NOISE
from cgid.measure.frames import DETECTION_LIMIT, LARGEST
from cgid.measure.table import ImpactKind
from cgid.signals import Signal
from cgid.validation import Floats

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

"""Finding the impacts in a recording: what rises above the noise, each blow once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.pulses import DETECTION_LIMIT
from cgid.signals import Signal

#: An impact rises above this many standard deviations of the noise,
THRESHOLD_OVER_NOISE = 6.0
#: and above this share of the largest sample.
THRESHOLD_OVER_PEAK = 0.05
#: What follows within this time belongs to the same blow: a struck body rings [s].
DEAD_TIME = 2e-3
#: What was found has to rise this many standard deviations above what is before it in its own frame: less than
#: elsewhere, for there the ringing of the blow before may still go on.
FOUND_LIMIT = 2.0
#: At most so many samples before an impact tell its baseline and noise.
_QUIET_SAMPLES = 1000
#: What is larger is no measurement, and its square no number.
_LARGEST = 1e150


@dataclass(frozen=True)
class Event:
    """One impact in a recording.

    Attributes
    ----------
    signal : Signal
        The samples around it.
    time : float
        When the recording first passes the threshold [s], counted from its first sample.
    detection_limit : float
        What `cgid.features.extract_array` should ask of it.
    """

    signal: Signal
    time: float
    detection_limit: float = FOUND_LIMIT


def find_impacts(signal: Signal, *, dead_time: float = DEAD_TIME) -> list[Event]:
    """Return the impacts in a recording, in order.

    The noise is the median absolute deviation from the median, times 1.4826. Samples above the median by
    `THRESHOLD_OVER_NOISE` times that and by `THRESHOLD_OVER_PEAK` of the largest sample belong to an impact;
    stretches closer than the dead time are one. A frame of a dataset (its `pre_trigger` is known) is one impact.

    Parameters
    ----------
    signal : Signal
        Impacts point upwards.
    dead_time : float
        [s], 0 or more.

    Returns
    -------
    list of Event
        At least one.

    Raises
    ------
    BadData
        The signal is constant or absurdly large, or nothing rises above the noise.
    """
    gap = float(validation.not_negative("dead_time", dead_time, "s"))
    # In double precision: a threshold found in another one may lie above every sample.
    samples = signal.samples.astype(np.float64, copy=False)
    if max(samples.max(), -samples.min()) > _LARGEST:
        raise BadData(
            f"{signal.name}: samples must lie within +-{_LARGEST:g}, they reach from {samples.min():.3g} to "
            f"{samples.max():.3g}; was the file read in the right format?"
        )
    middle = float(np.median(samples))
    highest = float(samples.max()) - middle
    if samples.min() == samples.max():
        raise BadData(
            f"{signal.name}: no impact: all {samples.size} samples are {samples[0]:g}; check the sensor and its cable"
        )
    if signal.pre_trigger is not None:
        return [Event(signal, signal.pre_trigger / signal.sampling_rate, DETECTION_LIMIT)]
    noise = 1.4826 * float(np.median(np.abs(samples - middle)))
    if highest <= THRESHOLD_OVER_NOISE * noise:
        lowest = middle - float(samples.min())
        cure = "invert it" if lowest > THRESHOLD_OVER_NOISE * noise else "record nearer or with less noise"
        raise BadData(
            f"{signal.name}: no impact: a sample must rise {THRESHOLD_OVER_NOISE:g} times the noise ({noise:.3g}) "
            f"above the median, the highest rises {highest:.3g}, the deepest falls {lowest:.3g} "
            f"{signal.unit or ''}; {cure}"
        )
    threshold = max(THRESHOLD_OVER_NOISE * noise, THRESHOLD_OVER_PEAK * highest)
    high = np.flatnonzero(samples - middle > threshold)
    return _cut(signal, high, max(int(gap * signal.sampling_rate), 1))


def _cut(signal: Signal, high: NDArray[np.intp], gap: int) -> list[Event]:
    """Cut the recording around stretches of high samples; a frame ends where the next one's impact begins."""
    breaks = np.flatnonzero(np.diff(high) > gap) + 1
    firsts, lasts = high[np.append(0, breaks)], high[np.append(breaks - 1, high.size - 1)]
    events = []
    for k, (first, last) in enumerate(zip(firsts.tolist(), lasts.tolist(), strict=True)):
        start = max(first - _QUIET_SAMPLES, 0 if k == 0 else int(lasts[k - 1]) + 1)
        stop = min(last + gap, signal.samples.size if k == len(firsts) - 1 else int(firsts[k + 1]))
        part = replace(signal, samples=signal.samples[start:stop])
        events.append(Event(part, first / signal.sampling_rate))
    return events

"""Finding the impacts in a recording: what rises above the noise, each blow once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.features.feature import Kind
from cgid.frames import DETECTION_LIMIT
from cgid.signals import Signal
from cgid.validation import Floats
from cgid.vibration import SHORTEST_EVENT

#: An impact rises above this many standard deviations of the noise,
THRESHOLD_OVER_NOISE = 6.0
#: and above this share of the largest sample.
THRESHOLD_OVER_PEAK = 0.05
#: What follows within this time belongs to the same blow: a struck body rings [s].
DEAD_TIME = 2e-3
#: The same for a vibration, which is nothing but ringing: two periods at 100 Hz.
VIBRATION_DEAD_TIME = 20e-3
#: A blow into a vibration that goes on must within so long [s]
RISE_TIME = 2e-3
#: rise to this many times the largest amplitude of the dead time before.
RISE = 2.0
#: Frames of vibrations begin so long before the impact [s],
QUIET_TIME = 10e-3
#: of which the last part may belong to the impact already [s],
LEAD_TIME = 1e-3
#: and go on for so long after it, enough for every third-octave band [s].
EVENT_TIME = 150e-3
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


def find_impacts(signal: Signal, *, kind: Kind = "pulse", dead_time: float | None = None) -> list[Event]:
    """Return the impacts in a recording, in order.

    The noise is the median absolute deviation from the median, times 1.4826. Samples above the median by
    `THRESHOLD_OVER_NOISE` times that and by `THRESHOLD_OVER_PEAK` of the largest sample belong to an impact;
    stretches closer than the dead time are one. A frame of a dataset (its `pre_trigger` is known) is one impact.

    In a vibration, the distance from the median counts, to either side. While it goes on, a new impact is one that
    rises to `RISE` times what the dead time before has seen. Every frame is as long: `QUIET_TIME` before the impact and
    `EVENT_TIME` from it on; from the next impact (or the end of the recording) on it holds the median. What starts
    within `SHORTEST_EVENT` of the end is left out.

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
        At least one.

    Raises
    ------
    BadData
        The signal is constant or absurdly large, or nothing rises above the noise.
    """
    validation.choice("kind", kind, get_args(Kind))
    if dead_time is None:
        dead_time = DEAD_TIME if kind == "pulse" else VIBRATION_DEAD_TIME
    dead_time = float(validation.not_negative("dead_time", dead_time, "s"))
    # In double precision: a threshold found in another one may lie above every sample.
    samples = signal.samples.astype(np.float64, copy=False)
    if max(samples.max(), -samples.min()) > _LARGEST:
        raise BadData(
            f"{signal.name}: samples must lie within +-{_LARGEST:g}, they reach from {samples.min():.3g} to "
            f"{samples.max():.3g}; was the file read in the right format?"
        )
    middle = float(np.median(samples))
    if samples.min() == samples.max():
        raise BadData(
            f"{signal.name}: no impact: all {samples.size} samples are {samples[0]:g}; check the sensor and its cable"
        )
    if signal.pre_trigger is not None:
        return [Event(signal, signal.pre_trigger / signal.sampling_rate, DETECTION_LIMIT)]
    size = np.abs(samples - middle)
    noise = 1.4826 * float(np.median(size))
    gap = min(max(int(dead_time * signal.sampling_rate), 1), samples.size)
    if kind == "vibration":
        shortest = int(np.ceil(SHORTEST_EVENT * signal.sampling_rate))
        return _cut_vibration(signal, middle, _blows(signal, size, noise, max(gap, shortest)), shortest)
    highest = float(samples.max()) - middle
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
    return _cut(signal, high, gap)


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


def _blows(signal: Signal, size: Floats, noise: float, gap: int) -> list[int]:
    """Return the first samples of the impacts of a vibration, given its distance from the median."""
    highest = float(size.max())
    if highest <= THRESHOLD_OVER_NOISE * noise:
        raise BadData(
            f"{signal.name}: no impact: a sample must lie {THRESHOLD_OVER_NOISE:g} times the noise ({noise:.3g}) from "
            f"the median, the farthest lies {highest:.3g} {signal.unit or ''} from it; record nearer or with less noise"
        )
    threshold = max(THRESHOLD_OVER_NOISE * noise, THRESHOLD_OVER_PEAK * highest)
    rise = max(int(RISE_TIME * signal.sampling_rate), 1)
    before = np.append(0.0, _largest_of(size, gap)[: size.size - 1])
    coming = _largest_of(size[::-1], rise)[::-1]
    new = np.flatnonzero((size > threshold) & ((before <= threshold) | (coming > RISE * before)))
    firsts, free = [], 0
    while (k := int(np.searchsorted(new, free))) < new.size:
        # A new blow is seen coming; it begins with the first sample that is larger than all before.
        first = int(new[k])
        first += int(np.argmax(size[first : first + rise] > before[first]))
        firsts.append(first)
        free = first + gap + 1
    return firsts


def _largest_of(size: Floats, count: int) -> Floats:
    """Return the largest of the last so many samples up to each, in steps that double."""
    out, covered = size.copy(), 1
    while covered < min(count, size.size):
        step = min(covered, count - covered)
        out[step:] = np.maximum(out[step:], out[:-step])
        covered += step
    return out


def _cut_vibration(signal: Signal, middle: float, firsts: list[int], shortest: int) -> list[Event]:
    """Cut frames around the impacts that go on for one time after them; what is not of an impact's own is silence."""
    rate, n_samples = signal.sampling_rate, signal.samples.size
    quiet, lead, length = (max(round(time * rate), 1) for time in (QUIET_TIME, LEAD_TIME, EVENT_TIME))
    events = []
    for k, first in enumerate(firsts):
        if n_samples - first < shortest:
            continue
        start = max(first - quiet, firsts[k - 1] + 1 if k else 0)
        stop = min(first + length, *firsts[k + 1 : k + 2], n_samples)
        samples = np.full(first - start + length, middle, signal.samples.dtype)
        samples[: stop - start] = signal.samples[start:stop]
        part = replace(signal, samples=samples, pre_trigger=max(first - start - lead, 0) or None)
        events.append(Event(part, first / rate))
    if not events:
        raise BadData(
            f"{signal.name}: a vibration must go on for {SHORTEST_EVENT * 1e3:g} ms in the recording, the only impact "
            f"is cut off by the end after {(n_samples - firsts[0]) / rate * 1e3:.3g} ms: record longer"
        )
    return events

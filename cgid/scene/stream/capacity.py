"""How much a stream needs, told before any work is done."""

from __future__ import annotations

import numpy as np

from cgid.errors import InvalidValue
from cgid.scene.scene import Scene
from cgid.scene.stream.arrivals import arrivals_of
from cgid.scene.stream.axis import samples_of
from cgid.scene.units import SHORTEST_RECORDING
from cgid.store.description import LARGEST_RECORDING

#: The truth of an impact with what is needed to sort and write it [bytes],
_IMPACT_BYTES = 500
#: and the most that may be held in memory.
LARGEST_TRUTH = 1 << 30
#: A folder with more files helps nobody.
MOST_RECORDINGS = 100_000
#: How far the number of Poisson arrivals may lie above what is expected [standard deviations].
_DEVIATIONS = 6.0


def most_impacts(scene: Scene) -> float:
    """Return a number of impacts that a recording will not pass: six deviations above the expected rocks."""
    assert scene.stream is not None
    stream = scene.stream
    rocks = float(arrivals_of(stream).expected(stream.duration))
    if stream.arrivals.rate is not None:
        rocks += _DEVIATIONS * np.sqrt(rocks)
    return rocks * (1 if stream.rebounds is None else 1 + stream.rebounds.most)


def require_capacity(scene: Scene, dtype: str) -> None:
    """Raise `InvalidValue` if a recording would not fit into a file, or its truth not into memory."""
    assert scene.stream is not None
    duration, impacts = scene.stream.duration, most_impacts(scene)
    samples = samples_of(scene)
    size = samples * np.dtype(dtype).itemsize
    if size > LARGEST_RECORDING:
        raise InvalidValue(
            f"scene {scene.name}: stream.duration must make at most {LARGEST_RECORDING / 2**30:g} GiB of samples, "
            f"{duration:g} s at {scene.sampling.sampling_rate:g} Hz make {samples:.4g} of {dtype}, "
            f"{size / 2**30:.3g} GiB; {_cure(duration, size / LARGEST_RECORDING, 'lower the sampling rate')}"
        )
    needed = impacts * _IMPACT_BYTES
    if needed > LARGEST_TRUTH:
        raise InvalidValue(
            f"scene {scene.name}: stream.arrivals must make at most {LARGEST_TRUTH / _IMPACT_BYTES:.3g} impacts, whose "
            f"truth fits into {LARGEST_TRUTH / 2**30:g} GiB of memory; {duration:g} s can make {impacts:.3g}, which "
            f"need {needed / 2**30:.3g} GiB; {_cure(duration, needed / LARGEST_TRUTH, 'lower the rate')}"
        )


def _cure(duration: float, excess: float, otherwise: str) -> str:
    # A little more than there is room for, so that what is proposed passes.
    count = int(np.ceil(excess * 1.02))
    if count > MOST_RECORDINGS or duration / count < SHORTEST_RECORDING:
        return otherwise
    return f"make {count} recordings (-n {count}) with a duration of {duration / count:.3g} s each, or {otherwise}"

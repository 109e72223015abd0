"""What frames of single forces give the simulated seams and recordings of a model of force."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from threadpoolctl import threadpool_limits

from cgid.learning.seams import Pool, pulses_of
from cgid.measure.features.extraction import extract_array
from cgid.signals import Batch


def pool_of_pulses(batches: Iterable[Batch], names: tuple[str, ...]) -> Pool:
    """Return the impacts of frames of a force, each of a rock of its own, with these features and guards."""
    pulses, measured = [], []
    for batch in batches:
        pulses.append(pulses_of(batch.parameters, batch.parameters["restitution"]))
        with threadpool_limits(1):
            measured.append(
                extract_array(batch.signals, batch.sampling_rate, names, pre_trigger=batch.pre_trigger, invalid="nan")
            )
    pulse = np.concatenate(pulses)
    every, nothing = np.ones(len(pulse), bool), np.full(len(pulse), np.nan)
    return Pool(
        pulse=pulse,
        measured=np.concatenate(measured),
        told=every,
        bounce=~every,
        loudness=np.zeros(len(pulse), np.intp),  # the noise of a frame is relative to its peak
        back=nothing,
    )

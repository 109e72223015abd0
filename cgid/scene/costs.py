"""What the work on a signal costs, by unit costs and by how much a usual signal needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cgid.measure.features import samples_needed
from cgid.scene.impacts import share_through_modes
from cgid.scene.population import given, given_at
from cgid.scene.range_warnings import unwarned
from cgid.scene.response import TOLERANCE, expected_modes
from cgid.scene.scene import Scene
from cgid.scene.stream.axis import samples_of
from cgid.scene.stream.expected import expected_rocks, impacts_of_rock
from cgid.validation import Floats

#: Microseconds of one thread, measured by `python benchmarks/skipping.py --unit-costs` on one machine: look at the
#: ratios. A feature costs what it adds to a batch of a thousand.
UNIT_COSTS = {
    "parameters": 2.3,
    "impact": 3.7,
    "closed form": 1.6,
    "damping solve": 4.9,
    "integrated impact": 69.0,
    "coupled mode": 5.5,
    "pulse": 1.6,
    "pulse sample": 0.0053,
    "integrated pulse": 66.0,
    "tap": 15.0,
    "struck mode": 0.6,
    "mode sample": 0.0005,
    "arrival": 5.1,
    "flight": 0.66,
    "frame sample": 0.00037,
    "noise sample": 0.002,
    "hum sample": 0.02,
    "coloured sample": 0.066,
    "recorded sample": 0.0062,
    "filtered sample": 0.0095,
    "clipped sample": 0.0029,
    "digitised sample": 0.00072,
    "features in time": 31.0,
    "spectrum": 8.0,
    "fit": 130.0,
    "vibrations": 81.0,
    "stored byte": 0.0053,
    "column": 0.6,
}
#: Where in the distributions the longest contact of a block of 256 is taken to lie.
_LARGE = 0.99


@dataclass(frozen=True)
class Workload:
    """How much a usual signal or recording of a scene needs: that of the medians of its populations and taps."""

    scene: Scene
    features: tuple[str, ...]
    whole_frames: bool

    @cached_property
    def sampling_rate(self) -> float:
        """[Hz]; the median where it is drawn."""
        randomise = self.scene.randomise
        if randomise is None or randomise.sampling_rate is None:
            return self.scene.sampling.sampling_rate
        return float(randomise.sampling_rate.quantile(np.array([0.5]))[0])

    @property
    def n_samples(self) -> int:
        """Length of a frame or recording."""
        return samples_of(self.scene)

    @cached_property
    def weights(self) -> Floats:
        """How many of each population and tap a signal holds: shares that add up to one, or rocks of a recording."""
        if self.scene.stream is not None:
            return expected_rocks(self.scene)
        weights = np.array([source.weight for source in self.scene.sources])
        return np.asarray(weights / weights.sum())

    @property
    def impacts(self) -> float:
        """Impacts in a signal, second hits apart."""
        if self.scene.stream is not None:
            return self.sources * self._impacts_of_rock
        return float(self.weights[: len(self.scene.populations)].sum())

    @property
    def sources(self) -> float:
        """Rocks and taps that are drawn for a signal."""
        return float(self.weights.sum())

    @cached_property
    def _impacts_of_rock(self) -> float:
        with unwarned():
            return impacts_of_rock(self.scene)

    @property
    def pulses(self) -> float:
        """Impact pulses in a signal: first and second hits."""
        if self.scene.stream is not None:
            return self.impacts
        again = np.array([source.second_hit is not None for source in self.scene.populations], float)
        return float(self.weights[: len(again)] @ (1 + again))

    @property
    def taps(self) -> float:
        """Tap pulses in a signal."""
        again = np.array([source.second_hit is not None for source in self.scene.taps], float)
        return float(self.weights[len(self.scene.populations) :] @ (1 + again))

    def _durations(self, size: float) -> Floats:
        """Contact durations of each population and tap [s], where sizes and durations lie at this quantile."""
        drawn = given_at(self.scene, size)
        durations = np.array(drawn.values["contact_duration"])
        with unwarned():
            if drawn.fallen.size:
                durations[drawn.fallen] = drawn.impact.contact_duration
        return durations

    @cached_property
    def contact_samples(self) -> float:
        """Samples on the contacts of a signal."""
        mean = float(self.weights @ self._durations(0.5)) / self.sources if self.sources else 0.0
        return mean * self.sampling_rate * (self.pulses + self.taps)

    @cached_property
    def coupled(self) -> float:
        """Impacts in a signal that are solved together with the modes of the beam."""
        if self.scene.tail_beam is None or not self.scene.populations:
            return 0.0
        drawn = given(self.scene, 0, 0)
        with unwarned():
            return self.impacts * share_through_modes(self.scene, drawn.impact, drawn.values, drawn.fallen)

    @property
    def n_modes(self) -> int:
        """About how many modes the beam has."""
        return len(expected_modes(self.scene)[0])

    @property
    def mode_samples(self) -> float:
        """Samples over which modes ring, together."""
        frequency, damping_ratio = expected_modes(self.scene)
        return self._rung(2 * np.pi * frequency * damping_ratio)

    @property
    def filter_samples(self) -> float:
        """Samples over which the poles of mounting and anti-alias filter ring, together."""
        return sum(self._rung(-part.poles.real) for part in self.scene.sensor.filters)

    def _rung(self, decay: Floats) -> float:
        """Return how many samples poles of these decays [1/s] ring for, until what is left is within the tolerance."""
        each = np.log(1 / TOLERANCE) / decay * self.sampling_rate * (self.pulses + self.taps)
        return float(np.minimum(each, self.n_samples - (self.scene.sampling.pre_trigger or 0)).sum())

    @property
    def samples(self) -> int:
        """Samples made of a frame."""
        return self.n_samples if self.whole_frames else self._beginning

    @cached_property
    def _beginning(self) -> int:
        """Samples of a frame that the features need, the same for all signals of a block."""
        delays = [s.second_hit.delay.quantile(np.array([_LARGE]))[0] for s in self.scene.sources if s.second_hit]
        touch = self.scene.sampling.pre_trigger + 1 + max(delays, default=0.0) * self.sampling_rate
        longest = self._durations(_LARGE) * self.sampling_rate
        needed = samples_needed(self.features, np.full(longest.shape, touch), longest)
        return int(min(needed.max(), self.n_samples))

"""What the work on a signal costs, by unit costs and by how much a usual signal needs."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cgid.beginnings import samples_needed
from cgid.impact import HertzRangeWarning, ThinPlateWarning
from cgid.scene.population import given_at
from cgid.scene.scene import Scene
from cgid.validation import Floats

#: Microseconds of one thread, measured by `python benchmarks/skipping.py --unit-costs` on one machine: look at the
#: ratios. A feature costs what it adds to a batch of a thousand.
UNIT_COSTS = {
    "parameters": 2.3,
    "impact": 3.7,
    "closed form": 1.6,
    "damping solve": 4.9,
    "integrated impact": 69.0,
    "pulse": 1.6,
    "pulse sample": 0.0053,
    "integrated pulse": 66.0,
    "tap": 15.0,
    "frame sample": 0.00037,
    "noise sample": 0.002,
    "filtered sample": 0.0095,
    "clipped sample": 0.0029,
    "digitised sample": 0.00072,
    "features in time": 31.0,
    "spectrum": 8.0,
    "fit": 130.0,
    "stored byte": 0.0053,
    "column": 0.6,
}
#: Where in the distributions the longest contact of a block of 256 is taken to lie.
_LARGE = 0.99


@dataclass(frozen=True)
class Workload:
    """How much a usual signal of a scene needs: that of the medians of its populations and taps."""

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
        """Length of a frame."""
        return self.scene.sampling.samples

    @cached_property
    def weights(self) -> Floats:
        """Share of each population and tap among the signals."""
        weights = np.array([source.weight for source in self.scene.sources])
        return np.asarray(weights / weights.sum())

    @property
    def impacts(self) -> float:
        """Share of the impacts among the signals."""
        return float(self.weights[: len(self.scene.populations)].sum())

    @property
    def pulses(self) -> float:
        """Impact pulses in a signal: first and second hits."""
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
        with warnings.catch_warnings():
            for beyond in (HertzRangeWarning, ThinPlateWarning):
                warnings.simplefilter("ignore", beyond)
            if drawn.fallen.size:
                durations[drawn.fallen] = drawn.impact.contact_duration
        return durations

    @cached_property
    def contact_samples(self) -> float:
        """Samples on the contacts of a signal."""
        return float(self.weights @ self._durations(0.5)) * self.sampling_rate * (self.pulses + self.taps)

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

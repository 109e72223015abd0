"""Output of `cgid predict --impactor`: columns next to the predictions, and the sizes in a recording."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.detection.detector import find_impacts
from cgid.identification.model.model import StoredModel
from cgid.impactor.masses import Detection, SizeDistribution, size_distribution
from cgid.impactor.measured import MeasuredPulses
from cgid.impactor.population import population_of
from cgid.impactor.posterior import QUANTITIES
from cgid.impactor.recognition import forces, through_beam
from cgid.measure.features.table import ImpactKind
from cgid.scene.file.schema import Scene
from cgid.scene.synthesis.stream import record
from cgid.units import UNITS

#: Probability of the intervals.
COVERAGE = 0.9
#: Seed of the simulated recordings, and the maximum distance of a detected impact from the true one [s].
_SEED, _MATCH_TIME = 0x5EED_0004, 2e-3


class ImpactorColumns:
    """Estimate the impactor of each prediction of a model: the `impactors` of the settings.

    Parameters
    ----------
    scene : Scene
        Possible impactors.
    keep : bool
        Whether to store the pulses of all impacts, for their sizes.

    Raises
    ------
    InvalidValue
        The scene has no population of impactors.
    """

    def __init__(self, scene: Scene, *, keep: bool = False) -> None:
        self.scene, self.population = scene, population_of(scene)
        self._keep = keep
        self._pulses: list[MeasuredPulses] = []

    def check(self, model: StoredModel) -> None:
        """Raise `InvalidValue` if a model does not give the force of each impact."""
        if model.kind == "window":
            raise InvalidValue("impactor must be left out for a model of windows, which contain any number of impacts")
        if model.kind == "vibration" and model.beam is None:
            raise InvalidValue(
                "impactor needs the contact force, which this model does not estimate; use one that does, such as "
                "default-acceleration, or train one on a scene with a beam"
            )
        if model.beam is not None and model.together > 1:
            raise InvalidValue("impactor needs a model of one sensor, this one uses several together")
        if model.kind == "pulse" and model.quantity != "force":
            raise InvalidValue(
                f"impactor needs the force [N], the input of this model is {model.quantity} [{model.unit}]"
            )

    def __call__(
        self,
        frames: NDArray[np.floating],
        sampling_rate: float,
        model: StoredModel,
        pre_trigger: int | None,
        detection_limit: float,
    ) -> list[dict[str, Any]]:
        """Return the impactor in each frame (n_signals, n_samples) in the unit of the model; None where unknown."""
        samples = frames * UNITS[model.quantity][model.unit]
        if model.beam is None:
            pulses = forces(samples, sampling_rate, pre_trigger, detection_limit)
        else:
            pulses = through_beam(samples, sampling_rate, pre_trigger, model.beam, detection_limit)
        if self._keep:
            self._pulses.append(pulses)
        estimates = self.population.posterior(pulses)
        columns: dict[str, Floats] = {}
        for name in QUANTITIES:
            low, high = estimates.interval(name, COVERAGE)
            columns |= {name: estimates.median(name), f"{name}_low": low, f"{name}_high": high}
        rows = zip(*(column.tolist() for column in columns.values()), estimates.reason.tolist(), strict=True)
        return [
            dict(zip((*columns, "impactor_problem"), (None if one != one else one or None for one in row), strict=True))
            for row in rows
        ]

    def sizes(self, quantity: str = "mass") -> SizeDistribution:
        """Return the distribution of all impacts so far, corrected for those not detected in simulations of the scene.

        Raises
        ------
        BadData
            There are too few impacts.
        """
        pulses = MeasuredPulses.joined(self._pulses or [MeasuredPulses.failed([])])
        detection = None if self.scene.stream is None else detection_of(self.scene)
        return size_distribution(pulses, self.population, quantity=quantity, detection=detection)


def detection_of(scene: Scene, seed: int = _SEED) -> Detection:
    """Return the probability of detection of an impact in a recording of a scene, by its peak force.

    Parameters
    ----------
    scene : Scene
        With a stream; one of its recordings is simulated and searched.
    seed : int

    Returns
    -------
    Detection
        Impacts hidden by others count as undetected.
    """
    signal, truth = record(scene, seed)
    kind: ImpactKind = "pulse" if signal.quantity == "force" else "vibration"
    times = np.array([event.time for event in find_impacts(signal, kind=kind)])
    return Detection.learned(truth["peak_force"], match_times(truth["time"], times) >= 0)


def match_times(true: NDArray[np.floating], detected: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the number of the nearest detected impact of each true one, (n_true,), -1 where there is none."""
    out = np.full(len(true), -1)
    for number, time in enumerate(detected):
        nearest = int(np.argmin(np.abs(true - time))) if len(true) else -1
        if nearest >= 0 and abs(true[nearest] - time) < _MATCH_TIME and out[nearest] < 0:
            out[nearest] = number
    return out

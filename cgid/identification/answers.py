"""The answer to "what was that?": label, probability, and whether the model may speak of it at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, MissingOption
from cgid.features import MINIMUM_FRAME, extract_array
from cgid.identification.events import DEAD_TIME, find_impacts
from cgid.identification.model import UNKNOWN, Model
from cgid.pulses import DETECTION_LIMIT, PulseBatch
from cgid.signals import UNITS, Signal


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the model says of one impact.

    Attributes
    ----------
    time : float
        Of the impact in its recording [s].
    label : str
        The decision; "unknown" when the impact is outside of what was trained, or could not be measured.
    probabilities : dict
        Of each label of the model; empty when the impact could not be measured.
    novelty : float
        Distance from the training, 1 at its edge; nan when the impact could not be measured.
    in_training_range : bool
        Whether the novelty is at most 1 and the sampling rate one that the model was trained at.
    problem : str
        Why there is no known label, or why to doubt it; else empty.
    """

    time: float
    label: str
    probabilities: Mapping[str, float]
    novelty: float
    in_training_range: bool = False
    problem: str = ""

    @property
    def probability(self) -> float:
        """Of the most probable label, or of the one decided for; nan when nothing was measured."""
        if not self.probabilities:
            return float("nan")
        return self.probabilities.get(self.label, max(self.probabilities.values()))


def suited(signal: Signal, model: Model, mass: float | None = None) -> Signal:
    """Return the signal in the quantity and unit of the model.

    Parameters
    ----------
    signal : Signal
    model : Model
    mass : float, optional
        Of the accelerated striker [kg]; turns an acceleration into a force.

    Raises
    ------
    MissingOption
        Nobody said what unit the signal is in.
    BadData
        It is another quantity than the model's.
    """
    if signal.unit is None:
        raise MissingOption(
            f"{signal.name}: the unit must be known, neither header nor option says it; give --unit, such as "
            f"--unit {model.unit}"
        )
    if mass is not None:
        signal = signal.as_force(mass)
    if signal.quantity != model.quantity:
        cure = f"give a recording of {model.quantity}"
        if (signal.quantity, model.quantity) == ("acceleration", "force"):
            cure = "give --mass KG if the accelerated body is the striker (force = mass x acceleration)"
        raise BadData(
            f"{signal.name}: the quantity must be the model's, {model.quantity} [{model.unit}], got {signal.quantity} "
            f"[{signal.unit}]; {cure}"
        )
    if signal.unit == model.unit:
        return signal
    factor = UNITS[model.quantity][model.unit]
    return replace(signal, samples=signal.in_si().samples / factor, unit=model.unit)


def identify(
    signal: Signal, model: Model, *, costs: Mapping[str, float] | None = None, dead_time: float = DEAD_TIME
) -> list[Answer]:
    """Return one answer for each impact in a recording.

    Parameters
    ----------
    signal : Signal
        In the quantity and unit of the model (`suited`).
    model : Model
    costs : dict, optional
        See `Model.decide`.
    dead_time : float
        See `find_impacts` [s].

    Raises
    ------
    BadData
        There is no impact at all.
    """
    answers = []
    for event in find_impacts(signal, dead_time=dead_time):
        part = event.signal
        answers += identify_frames(
            part.samples[None],
            part.sampling_rate,
            model,
            pre_trigger=part.pre_trigger,
            costs=costs,
            detection_limit=event.detection_limit,
        )
        answers[-1] = replace(answers[-1], time=event.time)
    return answers


def identify_frames(
    frames: NDArray[np.floating],
    sampling_rate: float,
    model: Model,
    *,
    pre_trigger: int | None,
    costs: Mapping[str, float] | None = None,
    detection_limit: float = DETECTION_LIMIT,
) -> list[Answer]:
    """Return one answer for each frame (n_signals, n_samples) of a single impact."""
    if frames.shape[1] < MINIMUM_FRAME:
        short = f"a frame must hold at least {MINIMUM_FRAME} samples, got {frames.shape[1]}"
        return [_unmeasured(short)] * len(frames)
    features = extract_array(
        frames,
        sampling_rate,
        model.features,
        pre_trigger=pre_trigger,
        invalid="nan",
        detection_limit=detection_limit,
    )
    sound = np.asarray(np.isfinite(features).all(axis=1))
    time = 0.0 if pre_trigger is None else pre_trigger / sampling_rate
    known = _known_answers(features[sound], model, costs, time, sampling_rate)
    problems = {} if sound.all() else PulseBatch(frames, sampling_rate, pre_trigger, True, detection_limit).problems()
    return [
        next(known) if sound[row] else _unmeasured(problems.get(row, "a feature has no finite value"), time)
        for row in range(len(frames))
    ]


def _known_answers(
    features: NDArray[np.float64],
    model: Model,
    costs: Mapping[str, float] | None,
    time: float,
    sampling_rate: float,
) -> Iterator[Answer]:
    if not len(features):
        return
    probabilities, novelties = model.probabilities(features), model.novelty(features)
    for row, label in enumerate(model.decide(probabilities, costs).tolist()):
        novelty = float(novelties[row])
        problem = "" if model.covers(sampling_rate) else f"not trained at {sampling_rate:g} Hz"
        if novelty > 1:
            problem = f"outside of the training (novelty {novelty:.3g}, 1 is the edge)"
        yield Answer(
            time=time,
            label=label if novelty <= 1 else UNKNOWN,
            probabilities=dict(zip(model.labels, probabilities[row].tolist(), strict=True)),
            novelty=novelty,
            in_training_range=not problem,
            problem=problem,
        )


def _unmeasured(problem: str, time: float = 0.0) -> Answer:
    return Answer(time=time, label=UNKNOWN, probabilities={}, novelty=float("nan"), problem=problem)

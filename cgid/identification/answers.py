"""The answer for an impact: its label, the probabilities, and whether it lies in the training range of the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.detection import find_impacts
from cgid.identification.events import Event, frames_alike
from cgid.identification.model import Model
from cgid.identification.question import Question, known_columns
from cgid.measure.features import extract_array, problems_of
from cgid.measure.filters import Equalisation
from cgid.measure.frames import DETECTION_LIMIT, MINIMUM_FRAME
from cgid.signals import Signal
from cgid.units import UNITS
from cgid.validation import UNKNOWN, Floats


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The model's answer for one impact or one window.

    Attributes
    ----------
    time, end : of the impact or window in the recording [s]; the end is nan where it is not known
    label : the decision; "unknown" if outside of the training range, unmeasurable, or rejected by the prediction set
    probabilities : of each label; empty when the impact could not be measured
    novelty : distance from the training data, 1 at its edge; nan when the impact could not be measured
    in_training_range : whether the novelty is at most 1 and the model was trained at this sampling rate
    problem : why the label is unknown or doubtful; else empty
    prediction_set : labels that cannot be ruled out at the coverage; None without a coverage or a measurement
    channel : channel name; a window of several channels joins their names by "+"
    overlapping : whether another impact began before this one had died away
    clipped : whether samples stand at the limit of the recorder
    cut : whether the recording begins or ends within the impact
    """

    time: float
    label: str
    probabilities: Mapping[str, float]
    novelty: float
    in_training_range: bool = False
    problem: str = ""
    prediction_set: tuple[str, ...] | None = None
    channel: str = "1"
    end: float = float("nan")
    overlapping: bool = False
    clipped: bool = False
    cut: bool = False

    def __repr__(self) -> str:
        told = ", ".join(f"p({label}) {value:.3f}" for label, value in self.probabilities.items()) or "not measured"
        where = f"{self.time:.6g} s" if self.channel == "1" else f"{self.time:.6g} s of channel {self.channel}"
        reason = f"; {self.problem}" if self.problem else ""
        return f"Answer({self.label} at {where}: {told}, novelty {self.novelty:.3g}{reason})"

    @property
    def probability(self) -> float:
        """Probability of the label, or of the most probable label if it is "unknown"; nan when nothing was measured."""
        if not self.probabilities:
            return float("nan")
        return self.probabilities.get(self.label, max(self.probabilities.values()))


def suited(signal: Signal, model: Model, mass: float | None = None) -> Signal:
    """Convert the signal to the quantity and unit of the model.

    `mass` [kg] of the accelerated striker turns an acceleration into a force. Raises `MissingOption` if the unit is
    unknown, `BadData` for another quantity than the model's.
    """
    if signal.unit is None:
        raise MissingOption(
            f"{signal.name}: the unit must be known, neither header nor option says it; give --unit, such as "
            f"{_unit_options(model)}"
        )
    if mass is not None:
        signal = signal.as_force(mass)
    if signal.quantity != model.quantity:
        cure = f"give a recording of {model.quantity}"
        if (signal.quantity, model.quantity) == ("acceleration", "force"):
            cure = "give --mass KG if the accelerated body is the striker (force = mass x acceleration)"
        elif signal.quantity == "level":
            cure = f"say with --unit what 1 stands for, such as {_unit_options(model)}"
        raise BadData(
            f"{signal.name}: the quantity must be the model's, {model.quantity} [{model.unit}], got {signal.quantity} "
            f"[{signal.unit}]; {cure}"
        )
    if signal.unit == model.unit:
        return signal
    factor = UNITS[model.quantity][model.unit]
    return replace(signal, samples=signal.in_si().samples / factor, unit=model.unit)


def _unit_options(model: Model) -> str:
    """Return the options that state the unit; a signal of unknown quantity counts as a force."""
    own = f"--unit {model.unit}"
    return own if model.quantity != "force" else f"{own}, or --unit m/s^2 of an accelerometer"


def identify(signal: Signal, model: Model, question: Question | None = None, **fields: Any) -> list[Answer]:
    """Return one answer for each impact in a recording, given in the quantity and unit of the model (`suited`).

    `fields` override those of the question, such as `costs={"gangue": 3.0}` or `drop_height=1.5` [m]. Raises `BadData`
    without any impact, `MissingOption` without a needed drop height, `InvalidValue` for choices the model cannot serve.
    """
    question = replace(question or Question(), **fields)
    if model.kind == "window":
        raise InvalidValue(
            f"{signal.name}: model must be one of impacts, this one answers for windows; give a whole recording"
        )
    events = find_impacts(signal, kind=model.kind, dead_time=question.dead_time)
    return identify_events(events, model, question, channels=(signal.channel,))


def identify_events(
    events: Sequence[Event], model: Model, question: Question, *, channels: Sequence[str] = ("1",)
) -> list[Answer]:
    """Return one answer for each detected impact, in order; frames of one shape form one batch.

    `channels` holds the names of the channels of the recording. Raises as `identify`.
    """
    sensors = question.heard_by(model, channels)
    answers: dict[int, Answer] = {}
    for sensor in dict.fromkeys(sensors):
        own = [number for number, event in enumerate(events) if sensors[event.channel] == sensor]
        for numbers, frames in frames_alike([events[number] for number in own]):
            event = events[own[numbers[0]]]
            found = identify_frames(
                frames,
                event.sampling_rate,
                model,
                question,
                pre_trigger=event.pre_trigger,
                drop_height=question.drop_height,
                detection_limit=event.detection_limit,
                equalisation=None if sensor is None else model.equalisation(sensor)[0],
            )
            answers |= zip((own[number] for number in numbers), found, strict=True)
    return [_placed(answers[number], event, channels) for number, event in enumerate(events)]


def _placed(answer: Answer, event: Event, channels: Sequence[str]) -> Answer:
    return replace(
        unmeasured(event.problem) if event.problem else answer,
        time=event.time,
        end=event.end / event.sampling_rate,
        channel=channels[event.channel],
        overlapping=event.overlapping,
        clipped=event.clipped,
        cut=event.cut,
    )


def identify_frames(
    frames: NDArray[np.floating],
    sampling_rate: float,
    model: Model,
    question: Question | None = None,
    *,
    pre_trigger: int | None,
    drop_height: ArrayLike | None = None,
    detection_limit: float = DETECTION_LIMIT,
    equalisation: Equalisation | None = None,
) -> list[Answer]:
    """Return one answer for each frame (n_signals, n_samples) of a single impact; raises as `identify`.

    The drop height is one number, or one for each frame [m]. Only the decision settings of the question count. The
    equalisation corrects the sensor's response.
    """
    known = known_columns(model.known, len(frames), drop_height)
    if frames.shape[1] < MINIMUM_FRAME:
        short = f"a frame must hold at least {MINIMUM_FRAME} samples, got {frames.shape[1]}"
        return [unmeasured(short)] * len(frames)
    measured = extract_array(
        frames,
        sampling_rate,
        model.measured,
        pre_trigger=pre_trigger,
        invalid="nan",
        detection_limit=detection_limit,
        equalisation=equalisation,
    )
    sound = np.asarray(np.isfinite(measured).all(axis=1))
    time = 0.0 if pre_trigger is None else pre_trigger / sampling_rate
    features, guards = np.split(measured[sound], [len(model.features)], axis=1)
    answers = answers_from(np.hstack([features, known[sound]]), guards, model, question or Question(), sampling_rate)
    problems = {}
    if not sound.all():
        problems = problems_of(
            frames, sampling_rate, model.measured, pre_trigger=pre_trigger, detection_limit=detection_limit
        )
    return [
        replace(next(answers), time=time)
        if sound[row]
        else unmeasured(problems.get(row, "a feature has no finite value"), time)
        for row in range(len(frames))
    ]


def answers_from(
    inputs: Floats,
    guards: Floats,
    model: Model,
    question: Question,
    sampling_rate: float,
    vote: Callable[[Floats], Floats] = lambda probabilities: probabilities,
) -> Iterator[Answer]:
    """Yield answers at time 0 from measured inputs (n, n_inputs) and guards (n, n_guards).

    `vote` averages the probabilities (n, n_labels) of successive rows.
    """
    if not len(inputs):
        return
    probabilities, novelties = vote(model.probabilities(inputs)), model.novelty(inputs, guards)
    untrained = "" if model.covers(sampling_rate) else f"not trained at {sampling_rate:g} Hz"
    for row, (label, labels) in enumerate(zip(*question.labels(model, probabilities), strict=True)):
        novelty = float(novelties[row])
        outside = f"outside of the training (novelty {novelty:.3g}, 1 is the edge)" if novelty > 1 else ""
        yield Answer(
            time=0.0,
            label=UNKNOWN if outside else label,
            probabilities=dict(zip(model.labels, probabilities[row].tolist(), strict=True)),
            novelty=novelty,
            in_training_range=not (outside or untrained),
            problem=outside or question.doubt(labels) or untrained,
            prediction_set=labels,
        )


def unmeasured(problem: str, time: float = 0.0) -> Answer:
    """Return the answer for an impact or window that cannot be measured."""
    return Answer(time=time, label=UNKNOWN, probabilities={}, novelty=float("nan"), problem=problem)

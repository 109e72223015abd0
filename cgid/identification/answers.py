"""The answer for an impact: its label, the probabilities, and whether it lies within the training of the model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.detection import find_impacts
from cgid.identification.drop_height import known_columns
from cgid.identification.events import Event, frames_alike
from cgid.identification.model import Model
from cgid.identification.question import Question
from cgid.measure.features import extract_array, problems_of
from cgid.measure.filters import Equalisation
from cgid.measure.frames import DETECTION_LIMIT, MINIMUM_FRAME
from cgid.signals import Signal
from cgid.units import UNITS
from cgid.validation import UNKNOWN, Floats


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the model says of one impact, or of one window.

    Attributes
    ----------
    time : float
        Of the impact in its recording, or of the start of the window [s].
    label : str
        The decision; "unknown" when the impact is outside of what was trained, could not be measured, or is rejected
        because its prediction set is not a single label.
    probabilities : dict
        Of each label of the model; empty when the impact could not be measured.
    novelty : float
        Distance from the training, 1 at its edge; nan when the impact could not be measured.
    in_training_range : bool
        Whether the novelty is at most 1 and the sampling rate one that the model was trained at.
    problem : str
        Why there is no known label, or why to doubt it; else empty.
    prediction_set : tuple of str or None
        The labels that cannot be ruled out at the coverage asked for; None without a coverage or a measurement.
    channel : str
        Name of the channel; those of a window of several are joined by "+".
    end : float
        When the impact has died away, or the window ends [s]; nan where it is not known.
    overlapping, clipped, cut : bool
        Whether another impact began before this one had died away, samples stand at the limit of the recorder, and
        the recording begins or ends within it.
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
        The unit of the signal is not known.
    BadData
        It is another quantity than the model's.
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
    """Return one answer for each impact in a recording.

    Parameters
    ----------
    signal : Signal
        In the quantity and unit of the model (`suited`).
    model : Model
    question : Question, optional
    **fields
        Of the question, in place of its own: `costs={"gangue": 3.0}`, `coverage=0.9`, `drop_height=1.5` [m] ...

    Raises
    ------
    BadData
        There is no impact at all.
    MissingOption
        The model needs the drop height.
    InvalidValue
        The model has no use for the drop height, or a choice is one that it cannot serve.
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
    """Return one answer for each impact that was found, in their order; those with frames alike in one batch.

    `channels` are the names of the channels that the events number; else as `identify`.
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

    The drop height is one number or one for each frame [m]; of the question, only how a label is decided counts. The
    equalisation makes up for the sensor's response.
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
    answers: Iterator[Answer] = iter(())
    if sound.any():
        features, guards = np.split(measured[sound], [len(model.features)], axis=1)
        inputs = np.hstack([features, known[sound]])
        found = model.probabilities(inputs), model.novelty(inputs, guards)
        answers = answers_from(*found, model, question or Question(), sampling_rate)
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
    probabilities: Floats, novelties: Floats, model: Model, question: Question, sampling_rate: float
) -> Iterator[Answer]:
    """Return an iterator over answers at time 0, from probabilities (n, n_labels) and novelties (n,)."""
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
    """Return the answer for what cannot be measured."""
    return Answer(time=time, label=UNKNOWN, probabilities={}, novelty=float("nan"), problem=problem)

"""The answer to "what was that?": label, probability, and whether the model may speak of it at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.detection import Event, find_impacts
from cgid.identification.drop_height import known_columns
from cgid.identification.model import Model
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
        Of the impact in its recording, or of the begin of the window [s].
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
        The labels that cannot be ruled out at the coverage asked for; None when none was, or nothing was measured.
    channel : str
        Name of the channel; those of a window of several are joined by "+".
    end : float
        When the impact has died away, or the window ends [s]; nan where nobody looked.
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
        Nobody said what unit the signal is in.
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
    """Return what to give where nobody said the unit: a force is what is believed where nothing is known."""
    own = f"--unit {model.unit}"
    return own if model.quantity != "force" else f"{own}, or --unit m/s^2 of an accelerometer"


@dataclass(frozen=True, kw_only=True)
class Decision:
    """How probabilities become a label.

    Attributes
    ----------
    costs : dict
        See `Model.decide`.
    coverage : float or None
        Share of the prediction sets that hold the truth; an impact whose set is not a single label is rejected.
        None rejects nothing.
    class_conditional : bool
        Whether each label by itself is covered so often: `Model.prediction_set`.

    Raises
    ------
    InvalidValue
        Both costs and a coverage are given: a set of a single label leaves nothing to decide.
    """

    costs: Mapping[str, float] = field(default_factory=dict)
    coverage: float | None = None
    class_conditional: bool = False

    def __post_init__(self) -> None:
        if self.costs and self.coverage is not None:
            raise InvalidValue("costs and coverage must not be given together, each decides by itself; leave one out")
        if self.class_conditional and self.coverage is None:
            raise InvalidValue("class_conditional must come with a coverage; give --coverage, such as --coverage 0.9")

    def check(self, model: Model) -> None:
        """Raise `InvalidValue` if the model knows no such label or can promise no such coverage."""
        self.labels(model, np.empty((0, len(model.labels))))

    def labels(self, model: Model, probabilities: Floats) -> tuple[list[str], list[tuple[str, ...] | None]]:
        """Return the label and the prediction set of each row of probabilities."""
        if self.coverage is None:
            return model.decide(probabilities, self.costs).tolist(), [None] * len(probabilities)
        held = model.prediction_set(probabilities, self.coverage, class_conditional=self.class_conditional)
        sets = [tuple(compress(model.labels, row)) for row in held.tolist()]
        return [one[0] if len(one) == 1 else UNKNOWN for one in sets], [*sets]

    def doubt(self, labels: tuple[str, ...] | None) -> str:
        """Return what is wrong with a prediction set; empty when nothing is."""
        if labels is None or len(labels) == 1:
            return ""
        if not labels:
            return f"no label is probable enough: the prediction set at coverage {self.coverage:g} is empty"
        held = "both" if len(labels) == 2 else f"these {len(labels)}"
        return f"{' or '.join(labels)}: the prediction set at coverage {self.coverage:g} holds {held}"


def identify(
    signal: Signal,
    model: Model,
    *,
    costs: Mapping[str, float] | None = None,
    coverage: float | None = None,
    class_conditional: bool = False,
    drop_height: float | None = None,
    dead_time: float | None = None,
) -> list[Answer]:
    """Return one answer for each impact in a recording.

    Parameters
    ----------
    signal : Signal
        In the quantity and unit of the model (`suited`).
    model : Model
    costs, coverage, class_conditional : optional
        See `Decision`.
    drop_height : float, optional
        How far the rocks fell [m], for a model that needs to know.
    dead_time : float, optional
        See `find_impacts` [s].

    Raises
    ------
    BadData
        There is no impact at all.
    MissingOption
        The model needs the drop height.
    InvalidValue
        The model has no use for the drop height, or a choice is one that it cannot serve.
    """
    decision = Decision(costs=costs or {}, coverage=coverage, class_conditional=class_conditional)
    if model.kind == "window":
        raise InvalidValue(
            f"{signal.name}: model must be one of impacts, this one answers for windows; give a whole recording"
        )
    events = find_impacts(signal, kind=model.kind, dead_time=dead_time)
    return identify_events(events, model, decision, drop_height=drop_height, channels=(signal.channel,))


def identify_events(
    events: Sequence[Event],
    model: Model,
    decision: Decision,
    *,
    drop_height: float | None = None,
    channels: Sequence[str] = ("1",),
    sensors: Sequence[str | None] = (None,),
) -> list[Answer]:
    """Return one answer for each impact that was found, in their order; those whose frames begin alike at once.

    `channels` are the names of the channels that the events number, `sensors` the sensors of the model that they were
    heard by, where known; else as `identify`.
    """
    alike: dict[tuple[int | None, float, float, str | None], list[int]] = {}
    for number, event in enumerate(events):
        key = (event.pre_trigger, event.detection_limit, event.sampling_rate, sensors[event.channel])
        alike.setdefault(key, []).append(number)
    answers: dict[int, Answer] = {}
    for (pre_trigger, limit, sampling_rate, sensor), numbers in alike.items():
        found = identify_frames(
            np.stack([events[number].samples for number in numbers]),
            sampling_rate,
            model,
            pre_trigger=pre_trigger,
            costs=decision.costs,
            coverage=decision.coverage,
            class_conditional=decision.class_conditional,
            drop_height=drop_height,
            detection_limit=limit,
            equalisation=None if sensor is None else model.equalisation(sensor)[0],
        )
        answers |= dict(zip(numbers, found, strict=True))
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
    *,
    pre_trigger: int | None,
    costs: Mapping[str, float] | None = None,
    coverage: float | None = None,
    class_conditional: bool = False,
    drop_height: ArrayLike | None = None,
    detection_limit: float = DETECTION_LIMIT,
    equalisation: Equalisation | None = None,
) -> list[Answer]:
    """Return one answer for each frame (n_signals, n_samples) of a single impact; as `identify`.

    The drop height is one number or one for each frame. The equalisation makes up for the sensor's response.
    """
    decision = Decision(costs=costs or {}, coverage=coverage, class_conditional=class_conditional)
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
        answers = answers_from(*found, model, decision, sampling_rate)
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
    probabilities: Floats, novelties: Floats, model: Model, decision: Decision, sampling_rate: float
) -> Iterator[Answer]:
    """Return an iterator over answers at time 0, from probabilities (n, n_labels) and novelties (n,)."""
    untrained = "" if model.covers(sampling_rate) else f"not trained at {sampling_rate:g} Hz"
    for row, (label, labels) in enumerate(zip(*decision.labels(model, probabilities), strict=True)):
        novelty = float(novelties[row])
        outside = f"outside of the training (novelty {novelty:.3g}, 1 is the edge)" if novelty > 1 else ""
        yield Answer(
            time=0.0,
            label=UNKNOWN if outside else label,
            probabilities=dict(zip(model.labels, probabilities[row].tolist(), strict=True)),
            novelty=novelty,
            in_training_range=not (outside or untrained),
            problem=outside or decision.doubt(labels) or untrained,
            prediction_set=labels,
        )


def unmeasured(problem: str, time: float = 0.0) -> Answer:
    """Return the answer for what cannot be measured."""
    return Answer(time=time, label=UNKNOWN, probabilities={}, novelty=float("nan"), problem=problem)

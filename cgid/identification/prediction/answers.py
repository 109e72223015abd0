"""The prediction for an impact: its label, the probabilities, and whether it is in the training range of the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.validation import UNKNOWN, Floats
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.detection.detector import find_impacts
from cgid.identification.detection.events import Event, Framing, frames_alike
from cgid.identification.model.explanations import sampled
from cgid.identification.model.model import Model, StoredModel, stored
from cgid.identification.prediction.settings import PredictionSettings
from cgid.measure.features.extraction import as_rows, measured, require_measurable
from cgid.measure.frames import DETECTION_LIMIT, MINIMUM_FRAME, Problem, ProblemKind, frames_of
from cgid.recordings.chain import require_measured
from cgid.signals import Signal, force_factor
from cgid.units import ELECTRICAL, UNITS, Column, flags, numbers, quantity_of, times

if TYPE_CHECKING:
    from cgid.identification.inversion.through_beam import BeamStream

_DOUBLE = "another impact begins within 3 ms of it, or still rings"

__all__ = ["Answer", "identify", "identify_frames", "suited"]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The prediction of a model for one impact or window.

    Attributes
    ----------
    time, end : float [s]
        Begin and end of the impact or window in the recording; the end is nan if unknown.
    label : str
        The decision; "unknown" for an impact outside the training range, unmeasurable, or rejected by the prediction
        set.
    probabilities : mapping of str to float
        Probability of each label; empty when the impact could not be measured.
    novelty : float
        Distance from the training data, 1 at its edge; nan when the impact could not be measured.
    in_training_range : bool
        Whether the novelty is at most 1 and the model was trained at this sampling rate.
    problem : str
        Why the label is unknown or doubtful, as text; else empty.
    problem_kind : ProblemKind or None
        The rule that its frame breaks, where that is why it could not be measured.
    prediction_set : tuple of str or None
        Labels that cannot be ruled out at the coverage; None without a coverage or a measurement.
    channel : str
        Channel name; a window of several channels joins their names by "+".
    overlapping : bool
        Whether another impact began before this one had decayed.
    clipped : bool
        Whether samples stand at the limit of the recorder.
    cut : bool
        Whether the recording begins or ends within the impact.
    unexplained : float
        Fraction of its energy not explained by the model's beam [%]; nan without a beam or a measurement.
    misshapen : float
        Fraction of its force that no contact has [%]; nan without a beam or a measurement, and for a long pulse.
    level : float
        Logarithm of its peak force over the expectation of the training for such a pulse; nan without one.
    pulse : tuple of float or None
        Peak force, width [s] and restitution of the contact, if these are features of the model; None without a
        measurement.
    values : tuple of float or None
        Inputs and guards of the model as measured; None without a measurement.
    sampled : ndarray or None
        What its samples show beside them, `cgid.identification.model.explanations.sampled`; None unless it was
        found in a recording of one sensor.
    """

    channel: str = field(default="1", metadata={"column": Column("channel")})
    time: float = field(metadata={"column": times("time")})
    end: float = field(default=math.nan, metadata={"column": times("end")})
    label: str = field(metadata={"column": Column("label")})
    probabilities: Mapping[str, float] = field(metadata={"column": numbers("p_*", form=".4f")})
    novelty: float = field(metadata={"column": numbers("novelty", form=".3f")})
    overlapping: bool = field(default=False, metadata={"column": flags("overlapping")})
    clipped: bool = field(default=False, metadata={"column": flags("clipped")})
    cut: bool = field(default=False, metadata={"column": flags("cut_off")})
    problem: str = field(default="", metadata={"column": Column("problem")})
    prediction_set: tuple[str, ...] | None = field(default=None, metadata={"column": Column("prediction_set")})
    in_training_range: bool = False
    problem_kind: ProblemKind | None = None
    unexplained: float = math.nan
    misshapen: float = math.nan
    level: float = math.nan
    pulse: tuple[float, ...] | None = None
    values: tuple[float, ...] | None = None
    sampled: NDArray[np.float32] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        numbers = [f"p({label}) {value:.3f}" for label, value in self.probabilities.items()]
        measured = ", ".join([*numbers, f"novelty {self.novelty:.3g}"]) if numbers else "not measured"
        where = f"{self.time:.6g} s" if self.channel == "1" else f"{self.time:.6g} s of channel {self.channel}"
        reason = f"; {self.problem}" if self.problem else ""
        return f"Answer({self.label} at {where}: {measured}{reason})"

    @property
    def probability(self) -> float:
        """Probability of the label, or of the most probable label if it is "unknown"; nan when nothing was measured."""
        if not self.probabilities:
            return float("nan")
        return self.probabilities.get(self.label, max(self.probabilities.values()))

    @property
    def row(self) -> dict[str, Any]:
        """The row of a table, by the titles of its columns."""
        row = {column.title: getattr(self, name) for name, column in COLUMNS.items() if name != "probabilities"}
        row |= {f"p_{label}": probability for label, probability in self.probabilities.items()}
        return row | {"prediction_set": "+".join(self.prediction_set or ())}


#: Columns of a table of answers by the field that they show, in order; `p_*` is one column for each label.
COLUMNS: Mapping[str, Column] = {one.name: one.metadata["column"] for one in fields(Answer) if one.metadata}


def answer_columns(model: StoredModel, settings: PredictionSettings) -> tuple[Column, ...]:
    """Return the columns of a table of the answers of a model."""
    return _columns(model.labels, model.subject == "window", settings.coverage is not None)


@cache
def _columns(labels: tuple[str, ...], has_ends: bool, has_sets: bool) -> tuple[Column, ...]:
    shown = {"end": has_ends, "prediction_set": has_sets}
    return tuple(
        replace(column, name=column.name.replace("*", label))
        for name, column in COLUMNS.items()
        if shown.get(name, True)
        for label in (labels if name == "probabilities" else ("",))
    )


class Measurand(Protocol):
    """What samples must be: the quantity and unit of a model, or of the sensor of a scene."""

    @property
    def quantity(self) -> str: ...

    @property
    def unit(self) -> str: ...


def suited(signal: Signal, model: Model, mass: float | None = None) -> Signal:
    """Convert the signal to the quantity and unit of the model.

    Parameters
    ----------
    signal : Signal
    model : Model
    mass : float, optional [kg]
        Mass of the accelerated impactor, which turns an acceleration into a force.

    Returns
    -------
    Signal

    Raises
    ------
    MissingOption
        The unit of the signal is unknown, or the samples are in volts without a sensitivity.
    BadData
        The signal has another quantity than the model.
    """
    model = stored(model)
    factor = factor_to(model, signal.unit, signal.name, mass)
    if signal.unit == model.unit:
        return signal
    return replace(signal, samples=signal.samples * factor, unit=model.unit)


def factor_to(model: Measurand, unit: str | None, name: str, mass: float | None = None) -> float:
    """Return the factor from samples in a unit to those that a model takes; raises as `suited`, with a name."""
    if unit is None:
        raise MissingOption(
            f"{name}: the unit must be known, neither header nor option states it; give it, such as "
            f"{_unit_options(model)}, and for integers full scale, too, such as {spelled('full_scale', '500 g')}"
        )
    if unit == model.unit and mass is None:
        return 1.0
    quantity, factor = quantity_of(unit), 1.0
    if model.quantity not in ELECTRICAL:
        require_measured(unit, name)
    if mass is not None:
        factor, unit, quantity = force_factor(unit, mass, name), "N", "force"
    if quantity != model.quantity:
        hint = f"give a recording of {model.quantity}"
        if (quantity, model.quantity) == ("acceleration", "force"):
            hint = f"if the accelerated body is the impactor, force = mass x acceleration: give {spelled('mass', 'KG')}"
        elif quantity == "level":
            example = "500 g" if model.quantity == "acceleration" else "2 kN"
            of_motion = "" if model.quantity == "acceleration" else ", or '500 g' of an accelerometer"
            hint = (
                f"state full scale, as in {spelled('full_scale', example)}{of_motion}, or with "
                f"{spelled('full_scale', '10 V')} and the sensitivity of the sensor; floats may be in a unit as they "
                f"are: {_unit_options(model)}"
            )
        # Of sound without a full scale, as of volts without a sensitivity, only an option is missing.
        raise (MissingOption if quantity == "level" else BadData)(
            f"{name}: the quantity must be {model.quantity} [{model.unit}], got {quantity} [{unit}]; {hint}"
        )
    units = UNITS[quantity]
    return factor if unit == model.unit else factor * units[unit] / units[model.unit]


def _unit_options(model: Measurand) -> str:
    """Return the options that state the unit; a signal of unknown quantity counts as a force."""
    option = spelled("unit", model.unit)
    return option if model.quantity != "force" else f"{option}, or {spelled('unit', 'm/s^2')} of an accelerometer"


def identify(signal: Signal, model: Model, settings: PredictionSettings | None = None) -> list[Answer]:
    """Return one prediction for each impact in a recording.

    Parameters
    ----------
    signal : Signal
        In the quantity and unit of the model; see `suited`.
    model : Model
    settings : PredictionSettings, optional
        Costs, coverage and more; by default the most probable label is predicted.

    Returns
    -------
    list of Answer
        In order of time.

    Raises
    ------
    BadData
        The signal has no impact.
    InvalidValue
        The model does not support one of the settings.

    Examples
    --------
    >>> from cgid import load_model, read_recording, shipped
    >>> model = load_model()
    >>> (signal,) = read_recording(shipped.path_of("datasets", shipped.SAMPLE))
    >>> [answer.label for answer in identify(suited(signal, model), model)]
    ['coal', 'gangue', 'coal', 'gangue', 'coal', 'gangue']
    """
    model, settings = stored(model), settings or PredictionSettings()
    if model.kind == "window":
        raise InvalidValue(
            f"{signal.name}: model must be one of impacts, this one is for windows; give a complete recording"
        )
    events = find_impacts(signal, kind=model.kind, dead_time=settings.dead_time)
    if (shortest := min(len(event.samples) for event in events)) >= MINIMUM_FRAME:
        require_measurable(model.measured, signal.sampling_rate, shortest, model.beam)
    return measured_events(events, model, settings, (signal.channel,))[0]


def measured_events(
    events: Sequence[Event],
    model: StoredModel,
    settings: PredictionSettings,
    channels: Sequence[str],
    beam: BeamStream | None = None,
) -> tuple[list[Answer], Floats]:
    """Return one prediction for each detected impact, in order, and what was measured, (n_events, n_measured).

    What was not measured is nan; `beam` is the state of a stream.
    """
    if any(np.atleast_2d(event.samples).shape[0] != model.together for event in events):
        raise BadData(
            f"channels must be {model.together}, one for each sensor of this model, in the order of its training; give "
            "a complete recording of them, or use a model of one sensor"
        )
    answers: dict[int, Answer] = {}
    shown: dict[int, NDArray[np.float32]] = {}
    values = np.full((len(events), len(model.measured)), np.nan)
    for rows, frames in frames_alike(events):
        event = events[rows[0]]
        part, values[rows] = _identified(
            frames,
            event.sampling_rate,
            model,
            settings,
            pre_trigger=event.pre_trigger,
            detection_limit=event.detection_limit,
            beam=beam,
            # After a gap, a channel counts as a new one.
            channel=np.array([events[k].since * len(channels) + events[k].channel for k in rows]),
        )
        answers |= zip(rows, part, strict=True)
        if frames.ndim == 2:
            framing = Framing.of(model.kind, event.sampling_rate)
            spectrum = model.beam is not None
            seen = sampled(frames, event.sampling_rate, framing.quiet - framing.lead, spectrum=spectrum)
            shown |= zip(rows, seen, strict=True)
    values[[bool(event.problem) for event in events]] = np.nan
    placed = [
        replace(
            unmeasured(event.problem) if event.problem else answers[k],
            time=event.onset / event.sampling_rate,
            end=event.end / event.sampling_rate,
            channel=channels[event.channel],
            overlapping=event.overlapping or answers[k].overlapping,
            clipped=event.clipped,
            cut=event.cut,
            sampled=shown.get(k),
        )
        for k, event in enumerate(events)
    ]
    return placed, values


def identify_frames(
    frames: NDArray[np.floating],
    sampling_rate: float,
    model: Model,
    settings: PredictionSettings | None = None,
    *,
    pre_trigger: int | None,
    detection_limit: float = DETECTION_LIMIT,
) -> list[Answer]:
    """Return one prediction for each frame of a single impact.

    Parameters
    ----------
    frames : ndarray, (n_signals, n_samples)
        In the unit of the model; (n_signals, n_sensors, n_samples) if it is for a beam with several sensors.
    sampling_rate : float [Hz]
    model : Model
    settings : PredictionSettings, optional
        Only the settings of the decision are used, such as costs and coverage.
    pre_trigger : int or None
        Samples before onset, for baseline and noise; None to determine them from the pulse.
    detection_limit : float
        Minimum height of a pulse over the standard deviation of the noise.

    Returns
    -------
    list of Answer
        One for each frame; times count from the start of the frame.

    Raises
    ------
    BadData, InvalidValue
        As in `identify`, except that a frame without an impact gets an answer with a problem.
    """
    model = stored(model)
    shape = np.shape(frames)
    if shape[-1] >= MINIMUM_FRAME:
        require_measurable(model.measured, sampling_rate, shape[-1], model.beam)
        rows = as_rows(frames, 1 if model.beam is None else model.beam.n_sensors, model.measured)
        frames = frames_of(rows, pre_trigger).reshape(shape)
    return _identified(
        frames,
        sampling_rate,
        model,
        settings or PredictionSettings(),
        pre_trigger=pre_trigger,
        detection_limit=detection_limit,
    )[0]


def _identified(
    frames: NDArray[np.floating],
    sampling_rate: float,
    model: StoredModel,
    settings: PredictionSettings,
    *,
    pre_trigger: int | None,
    detection_limit: float,
    beam: BeamStream | None = None,
    channel: NDArray[np.intp] | None = None,
) -> tuple[list[Answer], Floats]:
    """Return one prediction for each frame, and what was measured."""
    if frames.shape[-1] < MINIMUM_FRAME:
        text = f"a frame must contain at least {MINIMUM_FRAME} samples, got {frames.shape[-1]}"
        short = Problem(ProblemKind.TOO_SHORT, text)
        return [unmeasured(short)] * len(frames), np.full((len(frames), len(model.measured)), np.nan)
    table, problems = measured(
        frames.reshape(-1, frames.shape[-1]),
        sampling_rate,
        model.measured + model.extras,
        pre_trigger=pre_trigger,
        detection_limit=detection_limit,
        beam=beam or model.beam,
        channel=channel,
    )
    values, extras = np.split(table, [len(model.measured)], axis=1)
    sound = np.asarray(np.isfinite(values).all(axis=1))
    time = 0.0 if pre_trigger is None else pre_trigger / sampling_rate
    features, guards = np.split(values[sound], [len(model.features)], axis=1)
    answers = answers_from(features, guards, model, settings, sampling_rate, time=time)
    identified = [
        next(answers) if sound[row] else unmeasured(problems.get(row, "a feature has no finite value"), time)
        for row in range(len(frames))
    ]
    if beam is not None and model.extras:
        rows = zip(identified, extras.tolist(), sound, strict=True)
        identified = [_with_extras(answer, *more) if is_sound else answer for answer, more, is_sound in rows]
    return identified, values


def _with_extras(answer: Answer, misshapen: float, overlap: float) -> Answer:
    """Return an answer with the extras of its model; two impacts at once are doubtful."""
    answer = replace(answer, misshapen=misshapen)
    return replace(answer, overlapping=True, problem=answer.problem or _DOUBLE) if overlap > 0 else answer


def answers_from(
    inputs: Floats,
    guards: Floats,
    model: StoredModel,
    settings: PredictionSettings,
    sampling_rate: float,
    vote: Callable[[Floats, NDArray[np.bool_]], Floats] = lambda probabilities, _: probabilities,
    time: float = 0.0,
) -> Iterator[Answer]:
    """Yield answers at one time from inputs (n, n_inputs) and guards (n, n_guards); `vote` combines successive rows."""
    if not len(inputs):
        return
    novelties = model.novelty(inputs, guards)
    probabilities = vote(model.probabilities(inputs), novelties <= 1)
    column = guards.T[model.guards.index("beam_unexplained")] if "beam_unexplained" in model.guards else None
    levels = model.levels(inputs)
    pulses = inputs[:, model.pulse_columns].tolist()
    values = np.hstack([inputs, guards]).tolist()
    untrained = "" if model.covers(sampling_rate) else f"not trained at {sampling_rate:g} Hz"
    for row, (label, labels) in enumerate(zip(*settings.labels(model, probabilities), strict=True)):
        novelty = float(novelties[row])
        outside = f"outside of the training (novelty {novelty:.3g}, 1 is the edge)" if novelty > 1 else ""
        yield Answer(
            time=time,
            label=UNKNOWN if outside else label,
            probabilities=dict(zip(model.labels, probabilities[row].tolist(), strict=True)),
            novelty=novelty,
            in_training_range=not (outside or untrained),
            problem=outside or (settings.doubt(labels) if labels is not None else "") or untrained,
            prediction_set=labels,
            unexplained=float("nan") if column is None else float(column[row]),
            level=float(levels[row]),
            pulse=tuple(pulses[row]) or None,
            values=tuple(values[row]),
        )


def unmeasured(problem: Problem | str, time: float = 0.0) -> Answer:
    """Return the prediction for an impact or window that cannot be measured."""
    kind, text = (None, problem) if isinstance(problem, str) else problem
    return Answer(time=time, label=UNKNOWN, probabilities={}, novelty=float("nan"), problem=text, problem_kind=kind)

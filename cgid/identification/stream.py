"""Answers for a recording that comes in blocks: impacts or windows, many at once, in the order of time.

Memory holds what the detector holds and one batch of impacts, however long the recording is.

What is asked of a recording, and the answers as they come.

Answers for the impacts of a recording that comes in blocks.

Answers for the windows of a recording that comes in blocks.

How far the sensors of a session have drifted from their reference runs, while its samples pass by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.identification.answers import Answer, Decision, answers_from, identify_events, suited, unmeasured
from cgid.identification.detection import Event, Extent, ImpactDetector, find_impacts
from cgid.identification.model import Model
from cgid.identification.reference import MeanSpectrum, drift
from cgid.identification.windows import VOTE_TIME, RunningVote, measure_windows, windows_of
from cgid.measure.features import FEATURES
from cgid.measure.filters import Equalisation
from cgid.measure.table import ImpactKind
from cgid.signals import Signal

if TYPE_CHECKING:
    from cgid.recordings import RecordingFile

#: No recorder of impacts is slower: a rate below is one in another unit, or that of something else [Hz].
SLOWEST = 10.0


def identify_recording(
    recording: RecordingFile,
    model: Model,
    question: Question | None = None,
    *,
    mass: float | None = None,
    invert: bool = False,
) -> Iterator[Answer]:
    """Return an iterator over the answers for a recording, in order of time; it is read block by block.

    Parameters
    ----------
    recording : RecordingFile
        As `cgid.recordings.open_recording` gives it; all of its channels in the model's quantity.
    model : Model
    question : Question, optional
    mass : float, optional
        Of the accelerated striker [kg]; turns an acceleration into a force.
    invert : bool
        Whether pulses point downwards.

    Raises
    ------
    BadData
        The recording is damaged, or of another quantity than the model.
    MissingOption
        The unit of a channel or the drop height is needed and nobody said it.
    """
    blocks = model_blocks(recording, model, range(len(recording.channels)), mass=mass, invert=invert)
    names = [channel.name for channel in recording.channels]
    question = question or Question()
    for step in identify_blocks(blocks, recording.sampling_rate, model, names, question, recording.source):
        yield from step.answers


def model_blocks(
    recording: RecordingFile,
    model: Model,
    rows: Sequence[int],
    *,
    mass: float | None = None,
    invert: bool = False,
    seen: Callable[[NDArray[Any]], object] | None = None,
) -> Iterator[NDArray[Any]]:
    """Return an iterator over the blocks of some channels, in the model's quantity and unit; as `identify_recording`.

    What is wrong with quantity or unit is said at once, not when the first block is asked for. `seen` is called with
    each block of these channels in their own units.
    """
    chosen, sign = list(rows), -1.0 if invert else 1.0
    channels = [recording.channels[row] for row in chosen]
    factors = [sign * factor_of(model, c.unit, recording.source, c.name, mass=mass) for c in channels]
    return scaled(_chosen_blocks(recording, chosen, seen), factors)


def _chosen_blocks(
    recording: RecordingFile, rows: list[int], seen: Callable[[NDArray[Any]], object] | None
) -> Iterator[NDArray[Any]]:
    all_of_them = rows == list(range(len(recording.channels)))
    for block in recording.blocks():
        chosen = block if all_of_them else block[rows]
        if seen is not None:
            seen(chosen)
        yield chosen


def factor_of(model: Model, unit: str | None, source: str, channel: str = "1", *, mass: float | None = None) -> float:
    """Return what samples in a unit are multiplied by to be in the model's quantity and unit; raises as `suited`."""
    one = Signal(samples=np.ones(1), sampling_rate=1.0, unit=unit, source=source, channel=channel)
    return float(suited(one, model, mass).samples[0])


def scaled(blocks: Iterable[NDArray[Any]], factors: Sequence[float]) -> Iterator[NDArray[Any]]:
    """Return an iterator over blocks (n_channels, n_samples) whose channels are multiplied by factors."""
    if all(factor == 1.0 for factor in factors):
        yield from blocks
        return
    column = np.array(factors)[:, np.newaxis]
    for block in blocks:
        with np.errstate(over="ignore"):  # what is no number then is told where impacts are looked for
            scaled_block = block * column.astype(block.dtype)
        yield scaled_block


def identify_blocks(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str = "signal",
) -> Iterator[Step]:
    """Return an iterator over answers as they come.

    Parameters
    ----------
    blocks : iterable of ndarray, (n_channels, n_samples)
        In the unit of the model.
    sampling_rate : float
        [Hz].
    model : Model
    channels : sequence of str
        Names of the channels.
    question : Question
    source : str
        Name of the recording.

    Raises
    ------
    BadData
        A model of windows looks at several channels together, and there are others; or the samples are absurd.
    InvalidValue
        The recording is sampled too slowly for what the model measures, or absurdly fast.
    """
    needed = max([SLOWEST, *(2 * FEATURES[name].highest_frequency for name in model.measured)])
    if sampling_rate < needed:
        raise InvalidValue(
            f"{source}: the sampling_rate must be at least {math.ceil(needed)} Hz for this model, got "
            f"{sampling_rate:g} Hz; check it, record faster, or train a model on recordings like this one"
        )
    how = windows_answered if model.kind == "window" else impacts_answered
    return _named(how(blocks, sampling_rate, model, channels, question, source), source)


def _named(steps: Iterator[Step], source: str) -> Iterator[Step]:
    """Yield steps; say which recording it is that cannot be answered for."""
    try:
        yield from steps
    except (BadData, InvalidValue) as error:
        text = str(error)
        if text.startswith(source):
            raise
        raise type(error)(f"{source}: {text}") from None


#: So many impacts are identified at once: a batch costs little more than a single one.
BATCH = 256
#: Samples that are held at once without a second thought.
WHOLE = 1 << 22


@dataclass(frozen=True, kw_only=True)
class Question:
    """What is asked of every impact or window of a recording.

    Attributes
    ----------
    decision : Decision
    drop_height : float or None
        How far the rocks fell [m], for a model that needs to know.
    dead_time : float or None
        See `find_impacts` [s].
    vote_time : float
        Windows are decided on the mean of the logarithms of their probabilities over so long [s]; 0: each by itself.
    sensors : tuple of str
        By which of the sensors that the model knows it was recorded: one for all channels, or one for each.
    batch : int
        Impacts wait until they are so many; with 1 none waits.
    whole : int
        A recording of up to so many samples, of all channels, is looked at as a whole by `find_impacts`, which knows
        its highest pulse; a longer one by `ImpactDetector` as it comes. With 0 every one is.
    """

    decision: Decision = field(default_factory=Decision)
    drop_height: float | None = None
    dead_time: float | None = None
    vote_time: float = VOTE_TIME
    sensors: tuple[str, ...] = ()
    batch: int = BATCH
    whole: int = WHOLE

    def heard_by(self, model: Model, channels: Sequence[str]) -> list[str | None]:
        """Return the sensor of each channel, or of each group of channels that the model looks at together.

        Raises
        ------
        InvalidValue
            There is another number of sensors, or the model knows none of this name.
        """
        if not self.sensors:
            return [None] * len(channels)
        if len(self.sensors) not in (1, len(channels)):
            raise InvalidValue(
                f"sensor must be one for all {len(channels)} channels or one for each, got {len(self.sensors)}"
            )
        for sensor in self.sensors:
            model.equalisation(sensor)
        return [*self.sensors] * (len(channels) // len(self.sensors))


@dataclass(frozen=True)
class Step:
    """Answers that have come.

    Attributes
    ----------
    answers : list of Answer
        In order of time.
    until : float
        No answer is still to come for what happened before this [s].
    silent : tuple of str
        Of which channels there was nothing to answer, and why; at the end.
    warnings : tuple of str
        What else is to be said; at the end.
    """

    answers: list[Answer]
    until: float
    silent: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def impacts_answered(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str,
) -> Iterator[Step]:
    """Yield the answers for impacts: of a short recording all at once, of a longer one as they come.

    As `cgid.identification.stream.identify_blocks`.
    """
    coming = iter(blocks)
    held: list[NDArray[Any]] = []
    size = 0
    while size <= question.whole and (block := next(coming, None)) is not None:
        held.append(block)
        size += block.size
    if held and size <= question.whole:
        samples = held[0] if len(held) == 1 else np.concatenate(held, axis=1)
        yield _whole_answered(samples, sampling_rate, model, channels, question, source)
        return
    kind = kind_found(model)
    detector = ImpactDetector(sampling_rate, len(channels), kind=kind, dead_time=question.dead_time)
    extent = Extent(len(channels))
    waiting: list[Event] = []
    heard: set[int] = set()

    def step(silent: tuple[str, ...] = ()) -> Step:
        heard.update(event.channel for event in waiting)
        answers = _events_answered(waiting, model, channels, question)
        waiting.clear()
        return Step(answers, detector.told / sampling_rate, silent)

    for block in chain(_emptied(held), coming):
        extent.see(block)
        waiting += detector.feed(block)
        if not waiting or len(waiting) >= question.batch:
            yield step()
    waiting += detector.finish()
    quiet = [channel for number, channel in enumerate(channels) if number not in heard | {e.channel for e in waiting}]
    yield step(
        tuple(
            f"{_name(source, channel, channels)}: no impact in {detector.told / sampling_rate:g} s: nothing rises "
            f"above the noise; look at it with cgid plot, or {extent.cure(list(channels).index(channel), kind)}"
            for channel in quiet
        )
    )


def _whole_answered(
    samples: NDArray[Any], sampling_rate: float, model: Model, channels: Sequence[str], question: Question, source: str
) -> Step:
    """Return the answers for a recording (n_channels, n_samples) that is in memory."""
    events: list[Event] = []
    silent = []
    for number, channel in enumerate(channels):
        signal = Signal(
            samples=samples[number],
            sampling_rate=sampling_rate,
            unit=model.unit,
            source=_name(source, channel, channels),
        )
        try:
            found = find_impacts(signal, kind=kind_found(model), dead_time=question.dead_time)
        except BadData as error:
            silent.append(str(error))
            continue
        events += [replace(event, channel=number) for event in found]
    events.sort(key=lambda event: (event.onset, event.channel))
    answers = []
    for first in range(0, len(events), BATCH):
        answers += _events_answered(events[first : first + BATCH], model, channels, question)
    return Step(answers, samples.shape[1] / sampling_rate, tuple(silent))


def kind_found(model: Model) -> ImpactKind:
    """Return what the impacts look like that a model answers for."""
    return "pulse" if model.kind == "pulse" else "vibration"


def _name(source: str, channel: str, channels: Sequence[str]) -> str:
    return source if list(channels) == ["1"] else f"{source} channel {channel}"


def _emptied(held: list[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Yield what is held, and hold it no longer."""
    while held:
        yield held.pop(0)


def _events_answered(
    events: Sequence[Event], model: Model, channels: Sequence[str], question: Question
) -> list[Answer]:
    return identify_events(
        events,
        model,
        question.decision,
        drop_height=question.drop_height,
        channels=channels,
        sensors=question.heard_by(model, channels),
    )


def answering_channels(model: Model, channels: Sequence[str]) -> tuple[str, ...]:
    """Return the names under which a model answers: that of each channel, or one for all that it looks at together.

    Raises
    ------
    BadData
        The model looks at another number of channels.
    """
    if model.n_channels == 1:
        return tuple(channels)
    if model.n_channels != len(channels):
        raise BadData(
            f"channels must be {model.n_channels}, which this model looks at together, got {len(channels)}; pick them "
            "with --channel"
        )
    return ("+".join(channels),)


def independence(model: Model, vote_time: float = VOTE_TIME) -> float:
    """Return what one answer counts beside others, in (0, 1]: windows that overlap, and votes, tell things again."""
    if model.kind != "window":
        return 1.0
    return min(model.hop_time / max(model.window_time, vote_time), 1.0)


def windows_answered(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str,
) -> Iterator[Step]:
    """Yield the answers for windows as they are complete; as `cgid.identification.stream.identify_blocks`."""
    names = answering_channels(model, channels)
    votes = [_vote(model, question) for _ in names]
    sensors = question.heard_by(model, names)
    equalisations = [None if sensor is None else model.equalisation(sensor) for sensor in sensors]
    drifts, seen = Drifts(model, sensors, sampling_rate), False
    for first, windows in windows_of(blocks, sampling_rate, model.window_time, model.hop_time):
        parts = [windows] if model.n_channels > 1 else [windows[:, [row]] for row in range(len(names))]
        told = [
            _judged(part, sampling_rate, model, question.decision, vote, equalisation)
            for part, vote, equalisation in zip(parts, votes, equalisations, strict=True)
        ]
        for number, part in enumerate(parts):
            drifts.see(number, part)
        length, seen = windows.shape[2], True
        answers = [
            replace(answered[row], time=start / sampling_rate, end=(start + length) / sampling_rate, channel=name)
            for row, start in enumerate(first.tolist())
            for name, answered in zip(names, told, strict=True)
        ]
        yield Step(answers, answers[-1].time)
    if not seen:
        yield Step([], 0.0, (f"{source}: a recording must last a window of {model.window_time:g} s, it is shorter",))
    yield Step([], 0.0, warnings=tuple(f"{source}: {warning}" for warning in drifts.warnings()))


def _vote(model: Model, question: Question) -> RunningVote:
    return RunningVote.over(max(question.vote_time, model.window_time), model.window_time, model.hop_time)


def _judged(
    windows: NDArray[np.floating],
    sampling_rate: float,
    model: Model,
    decision: Decision,
    vote: RunningVote,
    equalisation: Sequence[Equalisation] | None,
) -> list[Answer]:
    """Return one answer for each window (n_windows, n_channels, n_samples); what cannot be measured has no vote."""
    n_windows, n_channels, _ = windows.shape
    table = measure_windows(windows, sampling_rate, model.measured, equalisation).reshape(n_windows, n_channels, -1)
    inputs = table[:, :, : len(model.features)].reshape(n_windows, -1)
    guards = table[:, :, len(model.features) :].max(axis=1)
    sound = np.asarray(np.isfinite(table).all(axis=(1, 2)))
    answers: Iterator[Answer] = iter(())
    if sound.any():
        probabilities = vote.feed(model.probabilities(inputs[sound]))
        novelties = model.novelty(inputs[sound], guards[sound])
        answers = answers_from(probabilities, novelties, model, decision, sampling_rate)
    silent = unmeasured("the window cannot be measured: it is silent, constant or not a number")
    return [next(answers) if known else silent for known in sound.tolist()]


class Drifts:
    """The mean spectra of channels whose sensors are known.

    Parameters
    ----------
    model : Model
    sensors : sequence of str or None
        Of each channel, or of each group of channels that the model looks at together.
    sampling_rate : float
        [Hz].
    """

    def __init__(self, model: Model, sensors: Sequence[str | None], sampling_rate: float) -> None:
        self._model, self._sensors = model, sensors
        # Windows that overlap tell the same again, and a spectrum would seem surer than it is.
        self._every = max(math.ceil(model.window_time / model.hop_time - 1e-9), 1) if model.hop_time else 1
        self._seen = [0] * len(sensors)
        self._spectra = [[MeanSpectrum(sampling_rate) for _ in range(model.n_channels)] if s else [] for s in sensors]

    def see(self, number: int, windows: NDArray[np.floating]) -> None:
        """Look at the next windows (n_windows, n_channels, n_samples) of one of the sensors."""
        apart = windows[-self._seen[number] % self._every :: self._every]
        self._seen[number] += len(windows)
        for channel, spectrum in enumerate(self._spectra[number]):
            spectrum.feed(apart[:, channel])

    def warnings(self) -> tuple[str, ...]:
        """Return what is to be said of those that have drifted too far, one line each."""
        said: list[str] = []
        for sensor, spectra in zip(self._sensors, self._spectra, strict=True):
            if sensor is None:
                continue
            own = self._model.arrays["reference.spectra"][self._model.sensors.index(sensor)]
            for spectrum, reference in zip(spectra, own, strict=True):
                if spectrum.n_windows and (warning := drift(spectrum, reference).warning(sensor)):
                    said.append(warning)
        return tuple(dict.fromkeys(said))

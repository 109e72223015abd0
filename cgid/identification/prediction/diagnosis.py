"""Why most impacts of a recording are unknown, whether its beam has changed, and whether its scale is wrong.

A `Diagnosis` counts the predictions of a recording by channel and cause; its findings are the cause of most unknown
predictions. `cgid.cli.hints` adds commands. A model with a beam also detects changes of the beam that are
too small for single impacts: with the right modes, half of the impacts have almost no unexplained energy.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib.terminal import counted
from cgid._lib.validation import UNKNOWN, Floats
from cgid.errors import CgidError
from cgid.identification.detection.events import EVENT_TIME
from cgid.identification.model.world import CHECKS, Misfit, MisfitPart, WorldTest
from cgid.identification.prediction.findings import Finding
from cgid.measure.features.extraction import extract_array, powers_of
from cgid.measure.frames import ProblemKind
from cgid.units import UNITS

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer

#: The start of a vibration, whose power is compared with that before it [s]; below this ratio of amplitudes a vibration
#: is too weak.
_START_TIME, _CLEAR = 10e-3, 2.0
#: Factors of amplitude and duration that are tried; only one beyond `_FAR` times is a cause.
_SCALES, _MAX_DISTANCE = 10.0 ** np.arange(-4.0, 4.25, 0.25), 3.0
#: A signal that falls below its baseline by this fraction of its peak swings both ways, which no contact force does.
_BOTH_WAYS = 0.4
#: Standard deviations of the training to either side that make the range of a quantity in messages.
_N_DEVIATIONS = 3.0
#: A live stream is judged by the latest predictions of each channel, at most so many and so old [s]. Most are unknown
#: from this fraction of at least so many on, until it falls below the second fraction.
_RECENT, _OLDEST = 60, 300.0
_MIN_ANSWERS, _MOSTLY, _NO_LONGER = 20, 0.8, 0.5
#: Above this fraction, assume a different beam.
_ANOTHER_BEAM = 0.95
#: The beam has changed where the median of the latest impacts, so many, leaves more than this fraction of the energy
#: unexplained [%], beyond so many standard deviations of a median, and so many times that of the training.
_LATEST, CHANGED, _N_SIGMA, _OVER_TRAINING = (30, 100, 300), 0.5, 4.0, 3.0
#: So many latest impacts have forces that no contact has if the median share of these is above this [%].
_SHAPES, MISSHAPEN = 100, 3.0
#: Impacts from which on their levels are compared with those of the training, and the latest levels kept of a channel.
MIN_LEVELS, _MAX_LEVELS = 10, 10_000
#: A live stream is tested at these numbers of levels, and then whenever so many more have come, by so many latest ones.
_TESTS, _EVERY, _LATEST_LEVELS = (10, 30, 90, 270, 810), 5, (20, 30, 200)
#: Tests in a row without a finding by which a wrong scale is over: with one, a scale of 10 was lost and found three
#: times in two minutes of caving with 5 % of gangue, and SHUT came in between.
_QUIET_TESTS = 3
#: Tests go on for days, so chance may have this many times the variance; and from so many levels on, where chance is
#: small, recordings may differ by this many times theirs (benchmarks/plant/watch.py).
_ENDLESS, _MANY, _WIDE = 3.5, 90, 2.0
#: Levels count up to so many standard deviations from their median; the upper end of n levels, their mean and standard
#: deviation together, is about this one in the training. In standard deviations of the training.
_CLIPPED, _UPPER = 2.0, 0.85
#: The upper end of n levels lies above and below that by more than sqrt(a / n + b) in less than one of 200 recordings
#: each, by simulation (benchmarks/plant/wrong_scale.py): (a, b) above and below, for a force and for what a beam gives.
#: Slow rebounds on a beam only lower the level.
_SPREAD = {False: ((7.0, 0.10), (10.0, 0.12)), True: ((3.5, 0.05), (15.0, 0.34))}
#: So many latest levels, n, may be a mixture with the coal of an anchor if their upper end is no further below the
#: coal's than sqrt(a / n + a / n of the coal), and no further above that of the training than hard simulated seams
#: reach: but for one of 100 cycles of such seams. In standard deviations of the training.
OF_ANCHOR, _BELOW_COAL, _HARDEST = 60, 6.3, 1.3
#: Up to this factor a seam and a wrong scale look alike: where any seam may fall, it is told and withdraws nothing.
_AS_A_SEAM = 5.0
#: Between these factors g and m/s^2 may have been confused.
_LIKE_G = (5.0, 20.0)
#: Fraction of answers without any mark from which these, and not the marks, decide on the cause.
_UNMARKED = 0.25
#: Examples kept of each cause.
_MAX_EXAMPLES = 50


class CauseKind(StrEnum):
    """Why predictions are unknown, or how a beam has changed; the values are words for programs."""

    NOISE = "noise"
    DROWNED = "drowned"
    CLIPPED = "clipped"
    CUT_OFF = "cut_off"
    OVERLAPPING = "overlapping"
    UPSIDE_DOWN = "upside_down"
    COVERAGE = "coverage"
    UNMEASURED = "unmeasured"
    SAMPLING_RATE = "rate"
    AMPLITUDE = "scale"
    DURATION = "duration"
    VIBRATION = "vibration"
    SHAPE = "shape"
    FEATURES = "features"
    BEAM = "beam"
    CHAIN = "chain"


@dataclass(frozen=True)
class Cause:
    """The cause of an out-of-distribution prediction."""

    # `value` by `kind`: noise: amplitude of the impact over that before it; drowned: fraction of the novelty due to
    # noise; amplitude and duration: ratio to the training; sampling_rate: the one at which the impact is inside [Hz];
    # vibration: depth below the baseline over the peak; else that of `name`, an input or guard of the model, as
    # measured, with its training range.

    kind: CauseKind
    value: float
    name: str = ""
    low: float = float("nan")
    high: float = float("nan")

    @classmethod
    def of_column(cls, name: str, value: float, low: float, high: float) -> Cause:
        """Return the cause that an input or guard of the model is outside of its training range."""
        kind = CauseKind.FEATURES
        if name == "overload":
            kind = CauseKind.CLIPPED
        elif name.endswith(("misfit", "unexplained")):
            kind = CauseKind.SHAPE
        return cls(kind, value, name, low, high)


def causes_of(model: StoredModel, inputs: Floats, guards: Floats) -> list[Cause]:
    """Return the cause for each row outside of the training, from inputs (n, n_inputs) and guards (n, n_guards)."""
    limits = np.array(model.guard_limits)
    amplitudes, durations = (_scale_of(model, inputs, guards, symbol) for symbol in ("U", "s"))
    most_distant, (low, high), noise_novelty = (
        model.most_distant(inputs),
        model.usual(_N_DEVIATIONS),
        model.noise_novelty(inputs),
    )
    causes = []
    for row, values in enumerate(guards):
        of_size = ((amplitudes[row], CauseKind.AMPLITUDE), (durations[row], CauseKind.DURATION))
        scale, kind, factor = min((abs(np.log(factor)), kind, factor) for factor, kind in of_size)
        if noise_novelty[row] > 1 and scale == np.inf:  # a louder window of the training is no noise
            causes.append(Cause(CauseKind.DROWNED, float(noise_novelty[row])))
        elif values.size and (values / limits).max() > 1:
            guard = int(np.argmax(values / limits))
            causes.append(Cause.of_column(model.guards[guard], float(values[guard]), 0.0, model.guard_limits[guard]))
        elif scale < np.inf:
            causes.append(Cause(kind, float(factor)))
        else:
            k = int(most_distant[row])
            causes.append(Cause.of_column(model.inputs[k], float(inputs[row, k]), float(low[k]), float(high[k])))
    return causes


def _scale_of(model: StoredModel, inputs: Floats, guards: Floats, symbol: str) -> Floats:
    """Return how many times as large as in training the unit of each row is; infinite where no factor fits."""
    out = np.full(len(inputs), np.inf)
    powers, logarithmic = powers_of(model.inputs, symbol)
    if symbol == "s":  # durations of vibrations are ignored: their level lasts as long as the window
        powers[logarithmic] = 0.0
    # No factor can undo the result of a guard.
    rows = np.flatnonzero((guards <= np.array(model.guard_limits)).all(axis=1))
    if not rows.size or not powers.any():
        return out
    factors = _SCALES[:, None, None]
    scaled = np.where(logarithmic, inputs[rows] + powers * np.log10(factors), inputs[rows] * factors**powers)
    repeated = np.tile(guards[rows], (len(_SCALES), 1))
    distances = model.novelty(scaled.reshape(len(repeated), -1), repeated).reshape(len(_SCALES), -1)
    size = 1 / _SCALES[np.argmin(distances, axis=0)]
    is_cause = (np.min(distances, axis=0) <= 1) & ((size >= _MAX_DISTANCE) | (size <= 1 / _MAX_DISTANCE))
    out[rows] = np.where(is_cause, size, np.inf)
    return out


def with_frames(
    answers: Sequence[Answer],
    frames: NDArray[np.floating],
    sampling_rate: float,
    model: StoredModel,
    pre_trigger: int | None,
) -> list[Answer]:
    """Return the predictions for frames (n, n_samples), with causes visible only in the samples."""
    rows = [row for row, answer in enumerate(answers) if answer.cause is not None]
    explained = list(answers)
    if not rows:
        return explained
    outside, causes = frames[rows], {}
    if not model.covers(sampling_rate):
        rate = min(max(sampling_rate, min(model.sampling_rates)), max(model.sampling_rates))
        causes = dict.fromkeys(
            np.flatnonzero(_inside(outside, rate, model, pre_trigger)).tolist(), Cause(CauseKind.SAMPLING_RATE, rate)
        )
    if pre_trigger is not None and pre_trigger > 1:
        clear = _clearness(outside, sampling_rate, pre_trigger)
        causes |= {k: Cause(CauseKind.NOISE, float(clear[k])) for k in np.flatnonzero(clear < _CLEAR).tolist()}
    elif model.kind == "pulse":
        middle = np.median(outside, axis=1)
        depth = (middle - outside.min(axis=1)) / np.maximum(outside.max(axis=1) - middle, np.finfo(np.float64).tiny)
        causes |= {k: Cause(CauseKind.VIBRATION, float(depth[k])) for k in np.flatnonzero(depth > _BOTH_WAYS).tolist()}
    for k, cause in causes.items():
        explained[rows[k]] = replace(answers[rows[k]], cause=cause)
    return explained


def _inside(
    frames: NDArray[np.floating], rate: float, model: StoredModel, pre_trigger: int | None
) -> NDArray[np.bool_]:
    """Return whether each frame would lie inside of the training at another sampling rate."""
    try:
        table = extract_array(
            frames, rate, model.measured, pre_trigger=pre_trigger, invalid="nan", detection_limit=0.0, beam=model.beam
        )
    except CgidError:  # at that rate the frames are too short for a feature
        return np.zeros(len(frames), bool)
    sound = np.asarray(np.isfinite(table).all(axis=1))
    features, guards = np.split(table[sound], [len(model.features)], axis=1)
    sound[sound] = model.novelty(features, guards) <= 1
    return sound


def _clearness(frames: NDArray[np.floating], sampling_rate: float, pre_trigger: int) -> Floats:
    """Return the amplitude at the start of each vibration over that before it, at the sensor with the highest ratio."""
    before = frames[..., :pre_trigger].astype(np.float64)
    middle = before.mean(axis=-1, keepdims=True)
    start = frames[..., pre_trigger : pre_trigger + max(round(_START_TIME * sampling_rate), 2)] - middle
    noise = np.sqrt(np.mean((before - middle) ** 2, axis=-1))
    signal = np.sqrt(np.mean(start**2, axis=-1))
    ratio = np.asarray(np.divide(signal, noise, out=np.full(noise.shape, np.inf), where=noise > 0))
    return np.asarray(ratio.reshape(len(frames), -1).max(axis=1))


class _Counted(NamedTuple):
    """A prediction, the cause if it is unknown, whether a mark is that cause, and whether it could be trained on."""

    answer: Answer
    cause: CauseKind
    marked: bool
    usable: bool


@dataclass(eq=False, repr=False)
class ChannelAnswers:
    """The unknown predictions of a channel: their number by cause, and examples of the causes of unmarked ones.

    In a `live` stream only the latest predictions count.
    """

    live: bool = False
    n_answers: int = 0
    n_unmarked: int = 0
    n_unknown: int = 0
    n_usable: int = 0
    marks: Counter[CauseKind] = field(default_factory=Counter)
    unmarked: Counter[CauseKind] = field(default_factory=Counter)
    examples: dict[CauseKind, deque[Answer]] = field(default_factory=dict)
    latest: float = -np.inf
    problems: Counter[str] = field(default_factory=Counter)
    unexplained: deque[float] = field(default_factory=lambda: deque(maxlen=_LATEST[-1]))
    misshapen: deque[float] = field(default_factory=lambda: deque(maxlen=_SHAPES))
    levels: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_LEVELS))
    n_levels: int = 0
    traits: list[tuple[float, ...]] = field(default_factory=list)
    recent: deque[_Counted] = field(default_factory=deque)

    def add(self, answer: Answer, *, is_vibration: bool) -> None:
        """Count one more answer."""
        after, self.latest = answer.time - self.latest, answer.time
        is_soon = 0 < after < EVENT_TIME
        crowded = is_vibration and is_soon
        disturbed = answer.overlapping or answer.clipped or answer.cut
        cause, marked = _cause_of(answer, crowded)
        # Training excludes impacts that begin within the previous event.
        counted = _Counted(answer, cause, marked, bool(answer.probabilities) and not is_soon and not disturbed)
        if np.isfinite(answer.unexplained) and not disturbed:
            if not crowded:
                self.unexplained.append(answer.unexplained)
            # In the ring-down of an earlier impact, too: in a stream most impacts are.
            if np.isfinite(answer.misshapen):
                self.misshapen.append(answer.misshapen)
        if np.isfinite(answer.level):
            self.levels.append(answer.level)
            self.n_levels += 1
        self._count(counted, 1)
        if self.live:
            self.recent.append(counted)
            if len(self.recent) > _RECENT:
                self._count(self.recent.popleft(), -1)

    def forget(self, time: float) -> None:
        """Forget the predictions of a live stream that are too old at a time [s]."""
        while self.recent and self.recent[0].answer.time < time - _OLDEST:
            self._count(self.recent.popleft(), -1)

    def _count(self, counted: _Counted, by: int) -> None:
        """Count a prediction (by 1), or no longer (by -1)."""
        answer, cause = counted.answer, counted.cause
        self.n_answers += by
        self.n_unmarked += by * (not counted.marked)
        self.n_usable += by * counted.usable
        if answer.label != UNKNOWN:
            return
        self.n_unknown += by
        (self.marks if counted.marked else self.unmarked)[cause] += by
        if answer.problem in self.problems or len(self.problems) < _MAX_EXAMPLES:
            self.problems[answer.problem] += by
        examples = self.examples.setdefault(cause, deque())
        if by < 0 and examples and examples[0] is answer:
            examples.popleft()
        elif by > 0 and len(examples) < _MAX_EXAMPLES:
            examples.append(answer)

    @property
    def decisive(self) -> Counter[CauseKind]:
        """The relevant causes: only those of unmarked predictions if these are many."""
        few_marks = self.unmarked.total() and self.n_unmarked >= _UNMARKED * self.n_answers
        return self.unmarked if few_marks else self.marks + self.unmarked

    @property
    def median_misshapen(self) -> float:
        """Median share of the latest forces that no contact has [%]; nan for too few."""
        return float(np.median(self.misshapen)) if len(self.misshapen) == _SHAPES else float("nan")

    def median_unexplained(self) -> tuple[float, list[float]]:
        """Return a lower confidence bound of the median unexplained part of recent impacts, and its values [%]."""
        bounds: list[tuple[float, list[float]]] = [(float("nan"), [])]
        for n_latest in _LATEST if len(self.unexplained) >= _LATEST[0] else ():
            latest = list(self.unexplained)[-n_latest:]
            # The rank of a sample that is below the median with probability 1 - 2e-5 (binomial).
            bounds.append((sorted(latest)[int(len(latest) / 2 - _N_SIGMA / 2 * np.sqrt(len(latest))) - 1], latest))
        return max(bounds[1:] or bounds, key=lambda one: one[0])


class Condition(StrEnum):
    """What is wrong with a channel of a live stream, from its latest predictions."""

    WRONG_SCALE = "wrong_scale"
    UPSIDE_DOWN = "upside_down"
    MOSTLY_UNKNOWN = "mostly_unknown"
    BEAM = "beam"
    CHAIN = "chain"
    FOREIGN = "foreign"  # the recording as a whole is not like those of the training; this does not end


class Diagnosis:
    """Count the predictions of a recording, and determine the causes if most of a channel are unknown.

    In a `live` stream each channel is judged by its latest predictions alone, however long the stream runs, and
    `changes` says what begins and what ends. `channels` are all of the recording; a model that was trained with `beams`
    of several, which nobody has named here, knows them as such.
    """

    def __init__(
        self,
        model: StoredModel,
        sampling_rate: float = float("nan"),
        *,
        beams: str = "",
        labelled: bool = False,
        live: bool = False,
    ) -> None:
        self.model, self._live, self._rate, self._labelled, self._beams = model, live, sampling_rate, labelled, beams
        self.channels: dict[str, ChannelAnswers] = {}
        self.upside_down: set[str] = set()
        self._scales: dict[str, _Scale] = {}
        self._conditions: dict[str, dict[Condition, Finding]] = {}
        self._worlds: dict[str, WorldTest] = {}
        #: What does not fit of each channel that is not like recordings of the training.
        self.misfits: dict[str, Misfit] = {}

    @property
    def subject(self) -> str:
        """What one prediction is of, in words."""
        return "signal" if self._labelled else self.model.subject

    def add(self, answers: Iterable[Answer], upside_down: Iterable[str] | None = None) -> None:
        """Count more predictions, and set the channels that are upside down, where this is known."""
        if upside_down is not None:
            self.upside_down = set(upside_down)
        for answer in answers:
            if answer.channel not in self.channels:
                self.channels[answer.channel] = ChannelAnswers(self._live)
                self._scales[answer.channel] = _Scale(self.model)
            channel = self.channels[answer.channel]
            channel.add(answer, is_vibration=self.model.kind == "vibration")
            if np.isfinite(answer.level):
                self._scales[answer.channel].test(channel)
            if answer.traits is not None and len(channel.traits) < CHECKS[-1]:
                channel.traits.append(answer.traits)
                if len(channel.traits) in CHECKS and self.model.world is not None:
                    test = self._worlds.setdefault(answer.channel, WorldTest(self.model.world))
                    test.look(channel.traits)
                    if test.misfit is not None:
                        self.misfits[answer.channel] = test.misfit

    def conditions(self, channel: str) -> set[Condition]:
        """Return what is wrong with a channel, as of the last `changes`."""
        return set(self._conditions.get(channel, ()))

    def standing(self, channel: str) -> tuple[Finding, ...]:
        """Return what stands of a channel and can move its answers, as of the last `changes`."""
        return tuple(one for one in self._conditions.get(channel, {}).values() if one.moves)

    def changes(self, time: float) -> list[Finding]:
        """Return what has begun or ended in a live stream up to a time [s]."""
        found = []
        changed, foreign = self._changed(), self.misfits
        for name in sorted(self.channels.keys() | self.upside_down):
            channel, before = self.channels.get(name, ChannelAnswers()), self._conditions.get(name, {})
            channel.forget(time)
            now = set[Condition]()
            least = _NO_LONGER if Condition.MOSTLY_UNKNOWN in before else _MOSTLY
            enough = channel.n_answers >= _MIN_ANSWERS or (Condition.MOSTLY_UNKNOWN in before and channel.n_answers)
            if enough and channel.n_unknown >= least * channel.n_answers:
                now.add(Condition.MOSTLY_UNKNOWN)
            if name in self.upside_down:
                now.add(Condition.UPSIDE_DOWN)
            if name in changed or (Condition.BEAM in before and self._is_changed(channel)):
                now.add(Condition.BEAM)
            elif channel.median_misshapen > MISSHAPEN * (_NO_LONGER if Condition.CHAIN in before else 1.0):
                now.add(Condition.CHAIN)
            if name in foreign:
                now.add(Condition.FOREIGN)
            scale = self._scales.get(name)
            # Levels of impacts that the model does not know mean nothing.
            if (
                scale is not None
                and scale.factor != 1
                and (Condition.WRONG_SCALE in before or now <= {Condition.FOREIGN})
            ):
                now.add(Condition.WRONG_SCALE)
            began = {one: replace(self._begun(name, one), begin=time) for one in Condition if one in now - set(before)}
            found += [replace(before[one], end=time) for one in Condition if one in before.keys() - now]
            found += began.values()
            self._conditions[name] = {**{one: told for one, told in before.items() if one in now}, **began}
        return found

    def _begun(self, name: str, condition: Condition) -> Finding:
        """Return the finding of a condition of a channel that has just begun."""
        if condition == Condition.WRONG_SCALE:
            return self._scale((name,), self._scales[name].factor)
        if condition == Condition.FOREIGN:
            return self._foreign(name)
        if condition == Condition.UPSIDE_DOWN:
            return Finding(kind=str(CauseKind.UPSIDE_DOWN), channels=(name,))
        if condition == Condition.BEAM:
            return self._change({name: self.channels[name].median_unexplained()[1]})
        if condition == Condition.CHAIN:
            return self._misshapen((name,))
        return self._finding(self.channels[name].decisive.most_common(1)[0][0], (name,))

    def is_as_a_seam(self, channel: str) -> bool:
        """Return whether the factor of the levels of a channel may be that of a seam."""
        factor = self._scales[channel].factor
        return max(factor, 1 / factor) < _AS_A_SEAM

    def far_scale(self, channel: str) -> float:
        """Return the likely factor of the levels of a channel, if it is so large that it is a cause; else 1."""
        factor = self._scales[channel].factor  # another beam may have a smaller one
        return factor if max(factor, 1 / factor) >= _MAX_DISTANCE else 1.0

    @property
    def _limit(self) -> float:
        return max(CHANGED, _OVER_TRAINING * self.model.unexplained)

    def _changed(self) -> dict[str, list[float]]:
        """Return the channels whose beam has changed, with what their latest impacts leave unexplained [%]."""
        if self.model.beam is None:
            return {}
        unexplained = {name: channel.median_unexplained() for name, channel in self.channels.items()}
        return {name: latest for name, (median, latest) in unexplained.items() if median > self._limit}

    def _is_changed(self, channel: ChannelAnswers) -> bool:
        """Return whether a beam that had changed still leaves more of the latest impacts unexplained."""
        return float(np.median(list(channel.unexplained)[-_LATEST[0] :])) > self._limit

    def findings(self) -> list[Finding]:
        """Return what is wrong with the whole of a recording: one finding a channel."""
        found, told = list[Finding](), set[str]()
        causes = dict[CauseKind, list[str]]()
        changed = {} if self.model.beam is None else self._changed()
        for name in sorted(self.channels.keys() | self.upside_down):
            channel = self.channels[name] if name in self.channels else ChannelAnswers()
            # The rebounds of inverted pulses may be identified, but on the wrong side.
            if name in self.upside_down:
                causes.setdefault(CauseKind.UPSIDE_DOWN, []).append(name)
            elif 2 * channel.n_unknown > channel.n_answers:
                cause = channel.decisive.most_common(1)[0][0]
                another = channel.n_unknown >= _ANOTHER_BEAM * channel.n_answers
                if cause is CauseKind.SHAPE and not another and name in changed:
                    cause = CauseKind.BEAM
                causes.setdefault(cause, []).append(name)
            elif name in changed:
                causes.setdefault(CauseKind.BEAM, []).append(name)
            elif channel.misshapen and channel.median_misshapen > MISSHAPEN:
                causes.setdefault(CauseKind.CHAIN, []).append(name)
            elif (factor := _factor_of(channel.levels, self.model)) != 1:
                found.append(self._scale((name,), factor))
                told.add(name)
        for cause, names in causes.items():
            told |= set(names)
            if cause is CauseKind.UPSIDE_DOWN:
                found.append(Finding(kind=str(cause), channels=tuple(names)))
            elif cause is CauseKind.BEAM:
                found.append(self._change({name: changed[name] for name in names}))
            else:
                found.append(self._misshapen(names) if cause is CauseKind.CHAIN else self._finding(cause, names))
        return found + [self._foreign(name) for name in sorted(self.misfits.keys() - told)]

    def _finding(self, cause: CauseKind, names: Sequence[str]) -> Finding:
        """Return why most answers of some channels are unknown."""
        model, affected = self.model, [self.channels[name] for name in names]
        examples = [one.cause for channel in affected for one in channel.examples.get(cause, ()) if one.cause]
        problem = sum((channel.problems for channel in affected), Counter[str]()).most_common(1)
        name = Counter(one.name for one in examples).most_common(1)[0][0] if examples else ""
        if cause is CauseKind.FEATURES:  # of several inputs, the one that is most often the cause
            examples = [one for one in examples if one.name == name]
        value = float(np.median([one.value for one in examples])) if examples else float("nan")
        factors = [self.far_scale(name) for name in names]
        if cause is CauseKind.FEATURES and 1 not in factors:
            return self._scale(names, float(np.median(factors)), self._unknown(names))
        if cause is CauseKind.AMPLITUDE:
            return self._scale(names, value, self._unknown(names))
        low, high = (examples[0].low, examples[0].high) if examples else (float("nan"), float("nan"))
        is_outside = np.isfinite(low) and not low <= value <= high
        kind = str(cause)
        if cause is CauseKind.SHAPE and model.beam is not None and not self._labelled:
            kind = "other_beam"
        elif cause is CauseKind.FEATURES and self._beams:
            kind = "untold_beam"
        training = f"(mainly {name}: {value:.3g}, in the training {low:.3g} to {high:.3g})"
        return self._of(
            kind,
            names,
            unknown=self._unknown(names),
            value=value,
            true_rate=value,
            times=times(value),
            problem=problem[0][0] if problem else "",
            clear="" if np.isnan(value) else f", only {value:.2g} times as strong as what is before them",
            range=f" {training}" if is_outside else "",
            beam=self._beams,
            what="parts of recordings" if model.subject == "window" else "impacts",
            or_order=", or the channels are in another order" if model.together > 1 else "",
            other_rate=f"; and sampled at {self._rate:g} Hz, not {model.rates_text}"
            if not np.isnan(self._rate) and not model.covers(self._rate)
            else "",
        )

    def _unknown(self, names: Iterable[str]) -> str:
        """Return in words how many predictions of some channels are unknown."""
        affected = [self.channels[name] for name in names]
        n_unknown, n_answers = sum(one.n_unknown for one in affected), sum(one.n_answers for one in affected)
        return f"{n_unknown} of {counted(n_answers, self.subject)} unknown: "

    def _of(self, kind: str, names: Iterable[str], factor: float = float("nan"), **fields: Any) -> Finding:
        """Return a finding with the fields that many words share."""
        common = {
            "kind": self.subject,
            "rate": self._rate,
            "units": ", ".join(spellings(self.model.quantity)),
            "correct_rate": "correct sampling_rate",
            "correct_unit": "correct unit",
        }
        return Finding(kind=kind, channels=tuple(names), factor=factor, fields=common | fields)

    def _scale(self, names: Sequence[str], factor: float, unknown: str = "") -> Finding:
        """Return the finding of channels with samples that are about this factor too large."""
        model = self.model
        is_like_g = model.quantity == "acceleration" and _LIKE_G[0] < max(factor, 1 / factor) < _LIKE_G[1]
        return self._of(
            "scale",
            names,
            factor,
            unknown=unknown,
            times=times(factor),
            as_g=" (g taken for m/s^2 or the other way round is a factor of 9.81)" if is_like_g else "",
            forces="forces" if model.kind == "pulse" or model.beam is not None else "signals",
        )

    def _foreign(self, name: str) -> Finding:
        """Return the finding of a channel that as a whole is not like recordings of the training."""
        misfit = self.misfits[name]
        is_seam = misfit.part in (MisfitPart.SIZES, MisfitPart.SEAM) and self.model.seams is not None
        others = tuple(str(one.part) for one in misfit.others)
        finding = self._of(
            "other_seam" if is_seam else "foreign", (name,), misfit.factor, text=misfit_text(misfit, self.model)
        )
        return replace(finding, others=others)

    def _change(self, changed: Mapping[str, list[float]]) -> Finding:
        """Return the finding of channels whose beam is no longer that of the model."""
        latest = np.concatenate(list(changed.values()))
        usual = f", {self.model.unexplained:.2g} % in the training" if self.model.unexplained else ""
        return self._of("beam", changed, value=float(np.median(latest)), n_latest=len(latest), usual=usual)

    def _misshapen(self, names: Sequence[str]) -> Finding:
        """Return the finding of channels whose forces no contact has."""
        shares = [self.channels[name].median_misshapen for name in names]
        return self._of("chain", names, value=max(shares), n_latest=_SHAPES)


class _Scale:
    """The likely factor of one channel of a live stream, from its latest levels; 1 if they are as in the training."""

    def __init__(self, model: StoredModel) -> None:
        self._model, self.factor = model, 1.0
        self._n, self._next = 0, 0  # levels by which a wrong scale was found, and after which it is tested again
        self._n_quiet = 0  # tests in a row that found nothing, while a scale is told

    def test(self, channel: ChannelAnswers) -> None:
        """Test after one more level; the result does not depend on when others look."""
        n = channel.n_levels
        if self.factor != 1:
            if n >= self._next:
                found = self._of_latest(channel, self._n)
                self._n_quiet = self._n_quiet + 1 if found == 1 else 0
                self._set(self.factor if 0 < self._n_quiet < _QUIET_TESTS else found, self._n, n)
                if self.factor == 1:  # the levels before were of another scale
                    self._n_quiet = 0
                    channel.levels.clear()
                    channel.n_levels = 0
            return
        if n in _TESTS:
            self._set(self._of_latest(channel, n), n, n)
        if n % _EVERY == 0:
            for latest in _LATEST_LEVELS:
                if self.factor == 1 and n > latest:
                    self._set(self._of_latest(channel, latest, _ENDLESS), latest, n)

    def _of_latest(self, channel: ChannelAnswers, n: int, looks: float = 1.0) -> float:
        latest = list(islice(reversed(channel.levels), n))
        return _factor_of(latest, self._model, looks, _WIDE if n >= _MANY else 1.0)

    def _set(self, factor: float, n: int, n_levels: int) -> None:
        self.factor, self._n = factor, max(n, _LATEST_LEVELS[0])
        self._next = n_levels + self._n


def _factor_of(levels: Sequence[float], model: StoredModel, looks: float = 1.0, wide: float = 1.0) -> float:
    """Return the likely factor of a signal with these levels; 1 if they are as in recordings like the training's.

    Where many tests are made, `looks` multiplies the variance by chance, and `wide` that between recordings.
    """
    n, known, deviation = len(levels), model.level_range, model.level_deviation
    if n < MIN_LEVELS:
        return 1.0
    if known:  # of a model of labelled recordings
        end = upper_end(np.array(levels), known["deviation"])
        excess = max(end - known["high"], 0.0) + min(end - known["low"], 0.0)
        likely = float(np.exp(end - (known["low"] + known["high"]) / 2))
        return likely if abs(excess) > np.sqrt(wide * known["between"] + looks * known["within"] / n) else 1.0
    # Of labelled vibrations and windows without levels, it is not known by how much recordings differ.
    if not deviation or ("recorded" in model.training and model.kind != "pulse"):
        return 1.0
    excess = upper_end(np.array(levels), deviation) / deviation - _UPPER
    chance, spread = _SPREAD[model.beam is not None][0 if excess > 0 else 1]
    # Includes the uncertainty of the training for few impacts.
    limit = np.sqrt(looks * chance / n + chance / model.training.get("n_train", np.inf) + wide * spread)
    return float(np.exp(excess * deviation)) if abs(excess) > limit else 1.0


def fits_coal(levels: Sequence[float], coal: Sequence[float], model: StoredModel) -> bool:
    """Return whether the latest levels may be of a mixture with this coal; gangue only raises them."""
    deviation = model.level_deviation
    if len(levels) < OF_ANCHOR or len(coal) < MIN_LEVELS or not deviation:
        return True
    end, lowest = (upper_end(np.array(some), deviation) / deviation for some in (levels[-OF_ANCHOR:], coal))
    limit = np.sqrt(_BELOW_COAL / OF_ANCHOR + _BELOW_COAL / len(coal))
    return bool(lowest - limit <= end <= _UPPER + _HARDEST)


def upper_end(levels: Floats, deviation: float) -> float:
    """Return the upper end of levels, mean and standard deviation together, without stray ones."""
    ordered = np.sort(levels)  # np.median takes three times as long
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    clipped = np.clip(levels, middle - _CLIPPED * deviation, middle + _CLIPPED * deviation)
    return float(clipped.mean() + clipped.std())


def times(factor: float) -> str:
    """Return a factor above or below 1 in words.

    >>> times(1.04), times(0.31), times(162.3)
    ('1.04 times', '0.31 times', '160 times')
    """
    return f"{float(f'{factor:.{2 + (0.95 < factor < 1.95)}g}'):g} times"


def spellings(quantity: str) -> list[str]:
    """Return the units of a quantity, one spelling of each."""
    first: dict[float, str] = {}
    for unit, factor in UNITS[quantity].items():
        first.setdefault(factor, unit)
    return list(first.values())


def misfit_text(misfit: Misfit, model: StoredModel) -> str:
    """Return in words what of a recording does not fit, and how sure that is."""
    what = ", or ".join(map(_part_text, (misfit, *misfit.others)))
    sure = "" if model.world is None else f" (told of at most {100 * model.world.rate:.2g} % of recordings that are)"
    return f"its first {misfit.n_impacts} impacts are not like those of a recording of the training: {what}{sure}"


def _part_text(misfit: Misfit) -> str:
    size, touch = times(misfit.factor), "faces" if misfit.factor > 1 else "corners"
    return {
        MisfitPart.SCALE: f"all forces are about {size} as large",
        MisfitPart.SIZES: f"impulses are about {size} as large, of other sizes or falls",
        MisfitPart.SEAM: f"the rocks are about {size} as hard, or touch with {touch}",
        MisfitPart.BEAM: "more is unexplained, as on another beam, with a sensor at another place, or of large rocks",
        MisfitPart.NOISE: "the noise is another",
    }[misfit.part]


def _cause_of(answer: Answer, crowded: bool) -> tuple[CauseKind, bool]:
    """Return the cause of an unknown answer, and whether a mark of its frame is that cause."""
    if answer.cut and not answer.probabilities:
        return CauseKind.CUT_OFF, True
    cause = None if answer.cause is None else answer.cause.kind
    if answer.clipped or cause is CauseKind.CLIPPED:
        return CauseKind.CLIPPED, True
    weak = not answer.probabilities or cause is CauseKind.NOISE
    if answer.overlapping or (crowded and weak):
        return CauseKind.OVERLAPPING, True
    if answer.cut:
        return CauseKind.CUT_OFF, True
    if not answer.probabilities:
        no_impact = answer.problem_kind is ProblemKind.NO_IMPACT
        return (CauseKind.NOISE if no_impact else CauseKind.UNMEASURED), False
    return (CauseKind.COVERAGE if cause is None else cause), False

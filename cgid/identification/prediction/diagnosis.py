"""What is wrong with the channels of a recording: what explains their latest impacts, or that they are unknown.

`cgid.identification.prediction.explanation` explains those of models that know sound and spoilt recordings. Of others,
levels outside of what labelled recordings had are a wrong scale, windows are drowned in noise, and the rest is unknown.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from enum import StrEnum
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid._lib.terminal import counted
from cgid._lib.validation import UNKNOWN, Floats
from cgid.identification.detection.events import EVENT_TIME
from cgid.identification.prediction.explanation import LEAST_IMPACTS, ChannelWatch, Evidence, Explained, Fault, explain
from cgid.identification.prediction.findings import Finding
from cgid.units import UNITS

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer

#: Of so many latest predictions of a channel in a live stream, most are unknown from this fraction of at least so many
#: on, until it falls below the second fraction.
_RECENT = 60
_MIN_ANSWERS, _MOSTLY, _NO_LONGER = 20, 0.8, 0.5
#: Impacts from which on their levels are compared with those of the training, and the latest levels kept of a channel.
MIN_LEVELS, _MAX_LEVELS = 10, 10_000
#: A live stream is tested at these numbers of levels, and then whenever so many more have come, by so many latest ones.
_TESTS, _EVERY, _LATEST_LEVELS = (10, 30, 90, 270, 810), 5, (20, 30, 200)
#: Problems that are counted apart.
_MAX_EXAMPLES = 50
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


class Condition(StrEnum):
    """What of a channel is a ground of its own."""

    WRONG_SCALE = "wrong_scale"
    MOSTLY_UNKNOWN = "mostly_unknown"


class _Channel:
    """The latest predictions of a channel, and what is known of them."""

    def __init__(self, model: StoredModel, *, watched: bool) -> None:
        self.evidence = Evidence()
        self.watch = ChannelWatch(model) if watched else None
        self.scale = _Scale(model) if watched else None
        self.n_answers = self.n_unknown = self.n_usable = 0
        self.problems: Counter[str] = Counter()
        self.levels: deque[float] = deque(maxlen=_MAX_LEVELS)
        self.n_levels = 0
        self.latest = -np.inf

    def add(self, answer: Answer) -> None:
        """Count one more prediction."""
        is_unknown, is_soon = answer.label == UNKNOWN, 0 < answer.time - self.latest < EVENT_TIME
        self.latest = answer.time
        self.n_answers += 1
        self.n_unknown += is_unknown
        # Training excludes impacts that begin within the previous event.
        self.n_usable += bool(answer.probabilities) and not (
            is_soon or answer.overlapping or answer.clipped or answer.cut
        )
        if answer.problem in self.problems or len(self.problems) < _MAX_EXAMPLES:
            self.problems[answer.problem] += is_unknown
        self.evidence.add(answer)
        if self.watch is not None:
            self.watch.add(answer)
        if np.isfinite(answer.level):
            self.levels.append(answer.level)
            self.n_levels += 1
            if self.scale is not None:
                self.scale.test(self)

    def is_mostly_unknown(self, *, before: bool) -> bool:
        """Return whether most of the latest predictions are unknown; if they were `before`, until half are not."""
        recent = self.evidence.latest(_RECENT).answers
        n_unknown = sum(answer.label == UNKNOWN for answer in recent)
        enough = len(recent) >= (1 if before else _MIN_ANSWERS)
        return enough and n_unknown >= (_NO_LONGER if before else _MOSTLY) * len(recent)


class Diagnosis:
    """Follow the predictions of a recording by channel, and say what is wrong with it.

    `findings` says what is wrong with the whole of a recording, by its latest impacts; where it is `watched`, `changes`
    says what begins and what ends.
    """

    def __init__(
        self, model: StoredModel, sampling_rate: float = float("nan"), *, labelled: bool = False, watched: bool = True
    ) -> None:
        self.model, self._rate, self._labelled, self._watched = model, sampling_rate, labelled, watched
        self.channels: dict[str, _Channel] = {}
        self._standing: dict[str, dict[str, Finding]] = {}
        self._unknown: set[str] = set()  # channels whose latest predictions are mostly unknown

    def add(self, answers: Iterable[Answer]) -> None:
        """Count more predictions."""
        for answer in answers:
            if answer.channel not in self.channels:
                self.channels[answer.channel] = _Channel(self.model, watched=self._watched)
            self.channels[answer.channel].add(answer)

    def conditions(self, channel: str) -> set[Condition]:
        """Return what of a channel is a ground of its own, as of the last `changes`."""
        found = {Condition.MOSTLY_UNKNOWN} if channel in self._unknown else set()
        return found | {Condition.WRONG_SCALE for one in self.standing(channel) if one.kind == Fault.SCALE}

    def standing(self, channel: str) -> tuple[Finding, ...]:
        """Return what surely stands of a channel and can move its answers, as of the last `changes`."""
        if channel not in self.channels or self.is_doubtful(channel):
            return ()
        return tuple(one for one in self._standing.get(channel, {}).values() if one.moves)

    def is_doubtful(self, channel: str) -> bool:
        """Return whether something is wrong by impacts that no later ones have confirmed yet."""
        watch = self.channels[channel].watch if channel in self.channels else None
        return watch is not None and bool(watch.explained.faults) and not watch.is_sure

    def stands(self, channel: str) -> bool:
        """Return whether anything stands of a channel, surely or not, as of the last `changes`."""
        return bool(self._standing.get(channel))

    def changes(self, time: float) -> list[Finding]:
        """Return what has begun or ended up to a time [s]."""
        found = []
        for name, channel in sorted(self.channels.items()):
            assert channel.watch is not None
            channel.evidence.forget(time)
            channel.watch.forget(time)
            before = self._standing.get(name, {})
            is_unknown = channel.is_mostly_unknown(before=name in self._unknown)
            (self._unknown.add if is_unknown else self._unknown.discard)(name)
            now = {one.kind: one for one in self._of(name, channel, channel.watch.explained)}
            if not now and is_unknown:
                now = {one.kind: one for one in self._of_unknown(name, channel)}
            began = {kind: replace(one, begin=time) for kind, one in now.items() if kind not in before}
            found += [replace(one, end=time) for kind, one in before.items() if kind not in now]
            found += began.values()
            # Its factor is better known later.
            self._standing[name] = {
                kind: began[kind] if kind in began else replace(one, begin=before[kind].begin)
                for kind, one in now.items()
            }
        return found

    def findings(self) -> list[Finding]:
        """Return what is wrong with the whole of a recording."""
        found = []
        for name, channel in sorted(self.channels.items()):
            own = list[Finding]()
            if channel.n_answers >= LEAST_IMPACTS:
                own = self._of(name, channel, explain(channel.evidence, self.model), whole=True)
            if not own and 2 * channel.n_unknown > channel.n_answers:
                own = self._of_unknown(name, channel)
            found += own
        return found

    def is_as_a_seam(self, channel: str) -> bool:
        """Return whether the factor of the levels of a channel may be that of a seam; no seam changes by itself."""
        factors = [one.factor for one in self.standing(channel) if one.kind == Fault.SCALE]
        watch = self.channels[channel].watch if channel in self.channels else None
        is_change = watch is not None and watch.explained.of_past
        return not is_change and all(max(factor, 1 / factor) < _AS_A_SEAM for factor in factors)

    def _of(self, name: str, channel: _Channel, explained: Explained, *, whole: bool = False) -> list[Finding]:
        """Return what explains the impacts of a channel: one finding a fault."""
        if explained.faults:
            odds, others = explained.odds, tuple(map(str, explained.others))
            return [self._finding(str(one), name, explained.factor, odds, others) for one in explained.faults]
        if self.model.explanations is not None and self.model.beam is not None:
            return []  # on a beam, levels are those of a seam
        # Levels of impacts that the model does not know mean nothing.
        is_known = 2 * channel.n_unknown <= channel.n_answers
        factor = _factor_of(channel.levels, self.model) if whole or channel.scale is None else channel.scale.factor
        return [self._finding(str(Fault.SCALE), name, factor)] if factor != 1 and is_known else []

    def _of_unknown(self, name: str, channel: _Channel) -> list[Finding]:
        """Return that most predictions of a channel are unknown, with what is known of why."""
        unknown = [one for one in channel.evidence.answers if one.label == UNKNOWN]
        measured = np.array([one.values for one in unknown if one.values is not None])
        if len(measured) and self.model.kind == "window":
            drowned = self.model.noise_novelty(measured[:, : len(self.model.inputs)]) > 1
            if drowned.mean() > 0.5:
                return [self._finding(str(Fault.NOISE), name)]
        problem = +channel.problems
        return [self._finding(str(Fault.UNKNOWN), name, problem=problem.most_common(1)[0][0] if problem else "")]

    def _finding(
        self,
        kind: str,
        name: str,
        factor: float = float("nan"),
        odds: float = float("nan"),
        others: tuple[str, ...] = (),
        **fields: Any,
    ) -> Finding:
        """Return a finding with the fields that words share."""
        model, channel = self.model, self.channels[name]
        subject = "signal" if self._labelled else model.subject
        is_like_g = model.quantity == "acceleration" and _LIKE_G[0] < max(factor, 1 / factor) < _LIKE_G[1]
        unknown = f"{channel.n_unknown} of {counted(channel.n_answers, subject)} unknown: "
        common = {
            "unknown": unknown if 2 * channel.n_unknown > channel.n_answers else "",
            "times": times(factor) if np.isfinite(factor) else "",
            "true_rate": self._rate / factor,
            "rate": self._rate,
            "as_g": " (g taken for m/s^2 or the other way round is a factor of 9.81)" if is_like_g else "",
            "forces": "forces" if model.kind == "pulse" or model.beam is not None else "signals",
            "units": ", ".join(spellings(model.quantity)),
            "correct_rate": "correct sampling_rate",
            "what": "parts of recordings" if model.subject == "window" else "impacts",
            "or_rocks": ", or the rocks are of other sizes, drop heights or mixture" if model.beam is None else "",
        }
        return Finding(kind=kind, channels=(name,), factor=factor, odds=odds, others=others, fields=common | fields)


class _Scale:
    """The likely factor of one channel of a live stream, from its latest levels; 1 if they are as in the training."""

    def __init__(self, model: StoredModel) -> None:
        self._model, self.factor = model, 1.0
        self._n, self._next = 0, 0  # levels by which a wrong scale was found, and after which it is tested again
        self._n_quiet = 0  # tests in a row that found nothing, while a scale is told

    def test(self, channel: _Channel) -> None:
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

    def _of_latest(self, channel: _Channel, n: int, looks: float = 1.0) -> float:
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

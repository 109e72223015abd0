"""Channels of one beam: an impact that several of them measure is one rock, one row and one decision.

Impacts of the channels of a group belong to one rock if they begin within the time that sound takes to cross a beam.
Where each channel is inverted through the beam, the pulses are fused as independent Gaussians of ln peak, ln width and
ln restitution, and the same model answers for the result. Elsewhere the answer is the mean of the log-odds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.events import Event
from cgid.identification.model.families import softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer, answers_from, measured_events
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.settings import PredictionSettings
from cgid.measure.features.extraction import FEATURES
from cgid.measure.features.vibration import BEAM_PULSE

#: Sound crosses a beam within this time [s].
CROSSING = 4e-3
#: Pairs of quantities with a correlation, as in `BEAM_PULSE`.
_PAIRS = ((0, 0, 1), (1, 2, 2))
#: Channels disagree where a quantity differs by more than this many standard deviations, to which the error of the
#: beam adds this much [1].
_DISAGREE, _OF_BEAM = 4.0, 0.03
#: A channel is left out where at most `_FEW` of the last `_RECENT` rocks of its group count, until `_MANY` do.
_RECENT, _FEW, _MANY = 20, 2, 12
#: Impacts of a channel from which it is known which of two that disagree is less like the training.
_REMEMBERED = 200
#: Channels hear the same rocks if they share more than `SAME` of the impacts of the one with fewer, of at least
#: `_ENOUGH`, by so many standard deviations more than chance gives; other ones if they share less than `_OTHER`. Counts
#: begin anew when a channel has `_COUNTED`.
SAME, _OTHER, _ENOUGH, _SURELY, _COUNTED = 0.6, 0.2, 20, 4.0, 500
#: Reasons why a channel is left out.
_REASONS = {
    "missing": "it measures no impact that the others measure; check sensor and cable",
    "unlike": "it does not fit the model as the others do; check its place and the order of the group",
    "disagrees": "it disagrees with the others by more than four deviations; check its place, gain and unit",
}


class Timed(Protocol):
    """An impact of a channel."""

    @property
    def channel(self) -> int: ...  # noqa: D102
    @property
    def onset(self) -> int: ...  # noqa: D102


T = TypeVar("T", bound=Timed)


# -- groups -----------------------------------------------------------------------------------------------


def rows_of(model: StoredModel, channels: Sequence[str], same_beam: Sequence[Sequence[str]]) -> list[tuple[int, ...]]:
    """Return the rows of a block that give one prediction together, by their first row."""
    if not same_beam:
        if model.together == 1:
            return [(row,) for row in range(len(channels))]
        if model.together != len(channels):
            raise BadData(
                f"channels must be {model.together}, which this model uses together, got {len(channels)}; pick them "
                f"with {spelled('channel')}"
            )
        return [tuple(range(len(channels)))]
    groups = grouped(channels, same_beam)
    if model.n_channels > 1:
        raise InvalidValue(f"same_beam must be left out, this model uses {model.n_channels} channels together")
    if model.together > 1 and (wrong := [rows for rows in groups if len(rows) != model.together]):
        raise InvalidValue(
            f"same_beam must name groups of {model.together} channels, one for each sensor of this model in the order "
            f"of its training, got {'+'.join(channels[row] for row in wrong[0])}; name the others, or take a model of "
            "one sensor"
        )
    return groups


def answering_channels(groups: Sequence[tuple[int, ...]], channels: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the channels of predictions: each channel, or those of one beam or used together in one."""
    return tuple("+".join(channels[row] for row in rows) for rows in groups)


def grouped(channels: Sequence[str], same_beam: Sequence[Sequence[str]]) -> list[tuple[int, ...]]:
    """Return the rows of each group of channels, named or numbered from 1, and of each other channel."""
    numbers = {str(number): row for row, number in enumerate(range(1, len(channels) + 1))}
    found = numbers | {name: row for row, name in enumerate(channels)}
    for one in (one for group in same_beam for one in group):
        if one not in found:
            raise InvalidValue(
                f"same_beam must name channels of the recording ({', '.join(channels)}), got {one}; correct it"
            )
        if "+" in channels[found[one]]:  # which joins the names of a group
            raise InvalidValue(f"same_beam must name channels without a plus sign, got {one}; rename it in the file")
    groups = [tuple(found[one] for one in group) for group in same_beam]
    rows = [row for group in groups for row in group]
    if len(set(rows)) < len(rows):
        twice = next(row for row in rows if rows.count(row) > 1)
        raise InvalidValue(f"same_beam must name each channel once, got {channels[twice]} twice, by name and number")
    return sorted([*groups, *((row,) for row in range(len(channels)) if row not in rows)], key=min)


class Detected(NamedTuple):
    """The onset of an impact of a channel."""

    channel: int
    onset: int


class RockAssigner(Generic[T]):
    """Assign impacts, in order of time, to rocks: at most one of each channel of a group, within `CROSSING`."""

    def __init__(self, groups: Iterable[Sequence[int]], sampling_rate: float) -> None:
        self._group = {row: tuple(rows) for rows in groups for row in rows}
        self._reach = CROSSING * sampling_rate
        self._open: list[list[T]] = []

    @property
    def begin(self) -> float:
        """Onset of the first rock that is not returned yet; infinite without one."""
        return self._open[0][0].onset if self._open else np.inf

    def feed(self, impacts: Iterable[T], known_until: float) -> list[list[T]]:
        """Add impacts, and return the rocks of which no further one can begin before `known_until` [samples]."""
        for impact in impacts:
            near = None
            for rock in reversed(self._open):
                if impact.onset - rock[0].onset > self._reach:
                    break
                if rock[0].channel in self._group[impact.channel] and all(p.channel != impact.channel for p in rock):
                    near = rock
            if near is None:
                self._open.append([impact])
            else:
                near.append(impact)
        count = 0
        for rock in self._open:
            if len(rock) < len(self._group[rock[0].channel]) and rock[0].onset + self._reach >= known_until:
                break
            count += 1
        done, self._open = self._open[:count], self._open[count:]
        return done


# -- one answer of several --------------------------------------------------------------------------------


def joined(values: Floats, names: Sequence[str]) -> Floats:
    """Return the features of an impact, (n_names,), from those that channels of one beam measure, (n, n_names).

    These are the fused pulse if they include it, and the mean of everything else, of logarithms where a model takes
    them.
    """
    linear = np.array([FEATURES[name].linear for name in names]) | (values <= 0).any(axis=0)
    out = values.mean(axis=0)
    out[~linear] = np.exp(np.log(values[:, ~linear]).mean(axis=0))
    if columns := pulse_columns(names):
        out[columns] = fused(values[:, columns])
    return np.asarray(out)


def pulse_columns(names: Sequence[str]) -> list[int]:
    """Return the columns of `BEAM_PULSE` among features; none if one is lacking."""
    return [names.index(name) for name in BEAM_PULSE] if set(BEAM_PULSE) <= set(names) else []


def fused(pulses: Floats) -> Floats:
    """Return `BEAM_PULSE` of a pulse, (9,), from those that independent channels measure, (n, 9)."""
    # The covariances of one pulse in several channels have one shape, and a size that goes with the noise of each.
    # Their inverses would also weigh by what each channel takes for the pulse, which favours high restitutions.
    values, deviation = np.log(pulses[:, :3]), pulses[:, 3:6]
    correlation = np.broadcast_to(np.eye(3), (len(pulses), 3, 3)).copy()
    for first, second, column in zip(*_PAIRS, pulses[:, 6:].T, strict=True):
        correlation[:, first, second] = correlation[:, second, first] = column
    size = np.log(deviation[:, :2]).mean(axis=1)
    weight = np.exp(2 * (size.min() - size))
    weight /= weight.sum()
    covariance = np.einsum("n,nij->ij", weight**2, correlation * deviation[:, :, None] * deviation[:, None])
    own = np.sqrt(np.diag(covariance))
    return np.concatenate([np.exp(weight @ values), own, (covariance / np.outer(own, own))[_PAIRS]])


def agreeing(pulses: Floats, misfit: Sequence[float]) -> list[int]:
    """Return which pulses, (n, 9), remain without those that disagree with most others; of two, that of less misfit."""
    values, variance = np.log(pulses[:, :3]), np.square(pulses[:, 3:6])
    spread = np.sqrt(variance[:, None] + variance + _OF_BEAM**2)
    apart = (np.abs(values[:, None] - values) > _DISAGREE * spread).any(axis=2)
    left = list(range(len(pulses)))
    while len(left) > 1 and (counts := apart[np.ix_(left, left)].sum(axis=1)).any():
        left.pop(max(range(len(left)), key=lambda k: (counts[k], misfit[left[k]])))
    return left


def mean_of_log_odds(probabilities: Floats) -> Floats:
    """Return the mean of log-odds of some rows, (n, n_labels), as probabilities; no label is surer than in any row."""
    logs = np.log(np.maximum(probabilities, 1e-300)).mean(axis=0)
    pooled, highest = softmax(logs[None])[0], probabilities.max()
    sharper = pooled > highest
    if not sharper.any():  # always with two labels
        return np.asarray(pooled)
    plain = probabilities.mean(axis=0)
    share = np.max((pooled - highest)[sharper] / (pooled - plain)[sharper])
    return np.asarray((1 - share) * pooled + share * plain)


def _table(answers: Sequence[Answer], labels: Sequence[str]) -> Floats:
    """Return the probabilities of some answers, (n, n_labels)."""
    return np.array([[one.probabilities[label] for label in labels] for one in answers])


def _distance(answer: Answer) -> float:
    return answer.novelty if answer.probabilities else np.inf


def pooled(answers: Sequence[Answer], model: StoredModel, settings: PredictionSettings) -> Answer:
    """Return one answer of several for the same rock or window: the mean of the log-odds of those that are known."""
    best, known = min(answers, key=_distance), [one for one in answers if one.novelty <= 1]
    if len(known) < 2:
        return best
    probabilities = mean_of_log_odds(_table(known, model.labels))
    (label,), (labels,) = settings.labels(model, probabilities[None])
    return replace(
        best,
        label=label,
        probabilities=dict(zip(model.labels, probabilities.tolist(), strict=True)),
        novelty=max(one.novelty for one in known),
        problem=(settings.doubt(labels) if labels is not None else "")
        or ("" if best.in_training_range else best.problem),
        prediction_set=labels,
        level=float(np.mean([one.level for one in known])),
    )


@dataclass(frozen=True, eq=False, repr=False)
class ChannelMeasurement:
    """What one channel measures of a rock."""

    channel: int
    onset: int
    answer: Answer
    values: Floats  # (n_measured,), features and guards; nan where it cannot be measured


class SameBeam:
    """Answer for the rocks of a stream whose channels share beams, and tell which channels are left out."""

    def __init__(
        self,
        model: StoredModel,
        channels: Sequence[str],
        settings: PredictionSettings,
        sampling_rate: float,
        recorded: float,
    ) -> None:
        self._model, self._channels, self._settings, self._rate = model, tuple(channels), settings, sampling_rate
        groups = rows_of(model, channels, settings.same_beam)
        self._rows = {row: rows for rows in groups for row in rows}
        self._rocks: RockAssigner[ChannelMeasurement] = RockAssigner(groups, sampling_rate)
        self._together = Together(sampling_rate, groups)
        self._standing = {rows: _Standing(has_order=model.together > 1) for rows in groups if len(rows) > 1}
        # Of recent impacts of each channel: the largest guard over its limit, and the level.
        self._recent = {row: deque[tuple[float, float]](maxlen=_REMEMBERED) for row in self._rows}
        looks = behind_each_sensor(model)
        self._looks = [(look, None if look.beam is None else look.beam.of(recorded).stream()) for look in looks]
        self._sensor = {row: rows.index(row) % len(looks) for row, rows in self._rows.items()}
        self._columns = pulse_columns(model.measured)

    def identified(self, events: Sequence[Event], known_until: float) -> tuple[list[Answer], float, list[Finding]]:
        """Return the answers for rocks of which all impacts are known, the sample up to which that is so, and findings.

        `known_until` is the sample before which all impacts have been given, infinite at the end.
        """
        found = list(self._together.feed(events, self._channels, ended=known_until == np.inf))
        rocks = self._rocks.feed(self._parts(events), known_until)
        used = [self._used(self._rows[rock[0].channel], rock) for rock in rocks]
        several = self._answered([parts for parts in used if len(parts) > 1])
        answers = []
        for rock, parts in zip(rocks, used, strict=True):
            rows, time = self._rows[rock[0].channel], rock[0].answer.time
            name = "+".join(self._channels[row] for row in rows)
            if len(parts) > 1:
                answer, parts = next(several)
            else:
                answer = min((part.answer for part in parts or rock), key=_distance)
            answers.append(replace(answer, time=time, channel=name))
            if len(rows) > 1:
                found += self._standing[rows].see(self._outcomes(rows, rock, parts), name, self._channels, time)
        return answers, min(known_until, self._rocks.begin), found

    def _outcomes(
        self, rows: tuple[int, ...], rock: list[ChannelMeasurement], used: list[ChannelMeasurement]
    ) -> dict[int, str]:
        """Return why each channel of a group does not count for a rock, "" if it does."""
        outcomes, is_strange = dict.fromkeys(rows, "missing"), all(self._misfit(part) > 1 for part in used)
        for part in rock:
            if part in used:
                outcomes[part.channel] = "unlike" if is_strange else ""
            elif part.answer.probabilities:
                outcomes[part.channel] = "disagrees" if self._columns and self._misfit(part) <= 1 else "unlike"
        return outcomes

    def _parts(self, events: Sequence[Event]) -> list[ChannelMeasurement]:
        """Return what each channel measures, in the order of the events."""
        parts: dict[int, ChannelMeasurement] = {}
        for k, (look, stream) in enumerate(self._looks):
            own = [number for number, event in enumerate(events) if self._sensor[event.channel] == k]
            some = [events[number] for number in own]
            answers, values = measured_events(some, look, self._settings, self._channels, stream)
            for number, event, answer, row in zip(own, some, answers, values, strict=True):
                parts[number] = ChannelMeasurement(event.channel, event.onset, answer, row)
        return [parts[number] for number in range(len(events))]

    def _used(self, rows: tuple[int, ...], rock: list[ChannelMeasurement]) -> list[ChannelMeasurement]:
        """Return the parts of a rock that count, in the order of the group."""
        measured = [part for row in rows for part in rock if part.channel == row and part.answer.probabilities]
        if not self._columns or len(rows) == 1:
            return measured
        for part in measured:
            self._recent[part.channel].append((self._misfit(part), part.answer.level))
        fits = [part for part in measured if self._misfit(part) <= 1] or measured
        pulses = np.array([part.values[self._columns] for part in fits]).reshape(len(fits), len(self._columns))
        return [fits[k] for k in agreeing(pulses, [self._doubt(part.channel) for part in fits])]

    def _misfit(self, part: ChannelMeasurement) -> float:
        """Return the largest guard over its limit: how badly a channel fits the beam; 0 without a beam."""
        guards = part.values[len(self._model.features) :] / np.array(self._model.guard_limits)
        return float(guards.max(initial=0.0)) if self._columns else 0.0

    def _doubt(self, row: int) -> float:
        """Return how unlike the training a channel has been: by its fit to the beam, and by its level."""
        misfit, level = np.median(list(self._recent[row]), axis=0).tolist()
        deviation = self._model.level_deviation
        return float(misfit + (abs(level) / deviation if deviation else 0.0))

    def _answered(self, used: list[list[ChannelMeasurement]]) -> Iterator[tuple[Answer, list[ChannelMeasurement]]]:
        """Yield one answer for each list of parts, by what they measure together, and the parts that count."""
        values = np.array([joined(np.stack([part.values for part in parts]), self._model.measured) for parts in used])
        values = values.reshape(len(used), len(self._model.measured))
        features, guards = np.split(values, [len(self._model.features)], axis=1)
        labels = self._model.labels

        def mean(*_: object) -> Floats:
            return np.stack([mean_of_log_odds(_table([part.answer for part in parts], labels)) for parts in used])

        vote: dict[str, Any] = {} if self._columns else {"vote": mean}
        answers = answers_from(features, guards, self._model, self._settings, self._rate, **vote)
        for parts, answer in zip(used, answers, strict=True):
            inside = [part for part in parts if part.answer.novelty <= 1]
            if answer.novelty > 1 and inside and not self._columns:
                parts, answer = inside, pooled([part.answer for part in inside], self._model, self._settings)
            own = [part.answer for part in parts]
            best = min(own, key=_distance)
            answer = replace(
                answer,
                # The cause that the samples show is that of the clearest channel.
                end=max(one.end for one in own),
                overlapping=any(one.overlapping for one in own),
                clipped=any(one.clipped for one in own),
                cut=any(one.cut for one in own),
                misshapen=best.misshapen,
            )
            yield answer, parts


def behind_each_sensor(model: StoredModel) -> list[StoredModel]:
    """Return a model for each sensor of its beam alone; the model itself if it has one sensor or no beam."""
    if model.beam is None or model.together == 1:
        return [model]
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith("beam.")}
    sensors = map(model.beam.beam.of_sensor, range(model.together))
    return [replace(model, arrays=arrays | sensor.arrays) for sensor in sensors]


# -- what is told of channels -----------------------------------------------------------------------------


class _Standing:
    """Which channels of a group count, from its last rocks."""

    def __init__(self, *, has_order: bool) -> None:
        self._has_order = has_order
        self._outcomes: deque[dict[int, str]] = deque(maxlen=_RECENT)
        self._strange: deque[bool] = deque(maxlen=_RECENT)
        self._left_out: set[int] = set()
        self._is_strange = False

    def see(self, outcomes: dict[int, str], name: str, channels: Sequence[str], time: float) -> Iterator[Finding]:
        """Add a rock, with the reason why each channel does not count or "", and yield what begins and ends."""
        # Where no channel fits, none is worse than the others.
        is_strange = set(outcomes.values()) == {"unlike"}
        self._strange.append(is_strange)
        self._outcomes.append(dict.fromkeys(outcomes, "") if is_strange else outcomes)
        if len(self._outcomes) < _RECENT:
            return
        for row in outcomes:
            reasons = [one[row] for one in self._outcomes]
            left_out = Finding(kind="left_out", channels=(channels[row],))
            if row not in self._left_out and reasons.count("") <= _FEW:
                self._left_out.add(row)
                fields = {"beam": name, "reason": _REASONS[max(_REASONS, key=reasons.count)]}
                yield replace(left_out, begin=time, fields=fields)
            elif row in self._left_out and reasons.count("") >= _MANY:
                self._left_out.discard(row)
                yield replace(left_out, end=time)
        swapped = Finding(kind="swapped", channels=tuple(channels[row] for row in outcomes))
        if self._has_order and not self._is_strange and sum(self._strange) >= _MANY:
            self._is_strange = True
            yield replace(swapped, begin=time)
        elif self._is_strange and sum(self._strange) <= _FEW:
            self._is_strange = False
            yield replace(swapped, end=time)


class Together:
    """Count impacts that two channels share, to tell channels of one beam that are not declared, and the reverse."""

    def __init__(self, sampling_rate: float, groups: Iterable[Sequence[int]]) -> None:
        self._reach = CROSSING * sampling_rate
        self._group = {row: tuple(rows) for rows in groups for row in rows}
        self._told: set[tuple[int, int]] = set()
        self._suspected: dict[int, frozenset[int]] = {}
        # Groups to be told once the rock is over that made them, so that many channels are told at once.
        self._pending: dict[frozenset[int], dict[str, Any]] = {}
        self._latest = 0
        self._begin()

    def _begin(self) -> None:
        self._first: int | None = None
        self._counts: dict[int, int] = {}
        self._shared: dict[tuple[int, int], int] = {}
        # Recent impacts: onset, channel, and the channels that share it.
        self._recent: deque[tuple[int, int, set[int]]] = deque()

    def feed(self, events: Iterable[Timed], channels: Sequence[str], *, ended: bool) -> Iterator[Finding]:
        """Add impacts in order of time, and yield which channels are declared wrongly, once each."""
        for event in events:
            if self._pending and event.onset - self._latest > self._reach:
                yield from self._told_of(channels)
            if self._counts.get(event.channel, 0) >= _COUNTED:
                self._begin()
            self._first = event.onset if self._first is None else self._first
            self._counts[event.channel] = self._counts.get(event.channel, 0) + 1
            while self._recent and event.onset - self._recent[0][0] > self._reach:
                self._recent.popleft()
            own: set[int] = set()
            for _, other, with_others in self._recent:
                if other != event.channel and other not in own and event.channel not in with_others:
                    own.add(other)
                    with_others.add(event.channel)
                    pair = min(other, event.channel), max(other, event.channel)
                    self._shared[pair] = self._shared.get(pair, 0) + 1
            self._recent.append((event.onset, event.channel, own))
            for other in own.union(self._group[event.channel]) - {event.channel}:
                pair = min(other, event.channel), max(other, event.channel)
                if pair not in self._told and min(self._counts.get(row, 0) for row in pair) >= _ENOUGH:
                    yield from self._tested(pair, event.onset, channels)

        if ended:
            yield from self._told_of(channels)

    def _told_of(self, channels: Sequence[str]) -> Iterator[Finding]:
        for rows, fields in self._pending.items():
            names = tuple(channels[row] for row in sorted(rows))
            yield Finding(kind="same_beam", channels=names, fields=fields | {"beam": "+".join(names)})
        self._pending.clear()

    def _tested(self, pair: tuple[int, int], now: int, channels: Sequence[str]) -> Iterator[Finding]:
        fewer, more = sorted(self._counts[row] for row in pair)
        shared, elapsed = self._shared.get(pair, 0), now - (self._first or 0)
        fields = {"shared": shared, "fewer": fewer, "within": 1e3 * CROSSING}
        if pair[1] in self._group[pair[0]]:
            if shared < _OTHER * fewer:
                self._told.add(pair)
                yield Finding(kind="other_rocks", channels=tuple(channels[row] for row in pair), fields=fields)
            return
        chance = -np.expm1(-2 * self._reach * more / max(elapsed, 1))
        surely = chance * fewer + _SURELY * np.sqrt(fewer * chance * (1 - chance))
        if shared > max(SAME * fewer, surely):
            self._told.add(pair)
            known = [self._suspected.get(row, frozenset(self._group[row])) for row in pair]
            if known[0] == known[1]:
                return
            both = known[0] | known[1]
            self._suspected |= dict.fromkeys(both, both)
            for part in known:
                self._pending.pop(part, None)
            self._pending[both], self._latest = fields, now

"""The state of a support: what is decided, on what ground, and how old it is.

Every output of `cgid monitor` and `cgid predict` is made from these records: rows, JSON, the live page, Modbus, MQTT,
Prometheus, commands, and the report.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import UNKNOWN
from cgid.errors import InvalidValue
from cgid.identification.model.anchor import MIN_LUMPS, Anchor, Basis
from cgid.identification.model.explanations import Fault
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.fraction import (
    NoConfusion,
    Share,
    ShareWindow,
    ShutDecision,
    Switch,
    answers_of,
    as_in,
    held_out,
    separates,
    tested_answers,
)
from cgid.identification.prediction.levels import OF_ANCHOR, fits_coal
from cgid.identification.prediction.settings import LabelledSpan, PredictionSettings
from cgid.recordings.soundness import SensorWatch

__all__ = ["CavingWatch", "Decision", "Ground", "SupportState"]


class Decision(StrEnum):
    """What is decided for the window of a support."""

    NONE = "none"  # no evidence: too few of its latest impacts are identified, or none came in a window
    UNSURE = "unsure"  # the costs speak for going on, and the interval still holds the limit
    DRAW = "draw"
    SHUT = "shut"


class Ground(StrEnum):
    """What a decision rests on: only a support that is seen has one."""

    SEEN = "seen"
    BLIND = "blind"  # its sensor is dead for most of the time, or loud, and no impact comes
    FAULT = "fault"  # a finding that can move answers stands
    WRONG_SCALE = "wrong_scale"  # the levels are not those of the training, or of a mixture with the stated coal
    MOSTLY_UNKNOWN = "mostly_unknown"  # most impacts of the last minutes are unknown
    UNPROVEN = "unproven"  # the model is not shown to be better than chance, or follows machines instead of rocks
    STOPPED = "stopped"  # no samples arrive


#: Grounds are looked at this often at least [s].
_LONGEST_STEP = 1.0
#: In a live stream a gangue fraction is told so many times per window.
STEPS = 10
#: What came so long before the tones of a machine went is no evidence [s]: impacts of its tones look like gangue.
_BEFORE_HEARD = 5.0


@dataclass(frozen=True, kw_only=True)
class SupportState:
    """The record of one support at one time, computed from the last minutes of its samples and predictions.

    Attributes
    ----------
    time : float [s]
        Time of the record in the stream.
    decision : Decision
    ground : Ground
    since : float [s]
        Begin of the ground in the stream.
    reason : str
        Why the ground is not `SEEN`, in words; else empty.
    share : Share
        The gangue fraction of the window that ends at `time`.
    last_sound : float [s]
        Time of the last sound sample in the stream; nan before the first.
    last_identified : float [s]
        Time of the last identified impact in the stream; nan before the first.
    """

    time: float
    share: Share
    decision: Decision = Decision.NONE
    ground: Ground = Ground.SEEN
    since: float = 0.0
    reason: str = ""
    last_sound: float = float("nan")
    last_identified: float = float("nan")

    def content(self) -> dict[str, Any]:
        """Return the record for JSON; the line adds the wall clock."""
        share = self.share
        return {
            "channel": share.channel,
            "decision": str(self.decision),
            "ground": str(self.ground),
            "ground_since_s": self.since,
            "reason": self.reason,
            "gangue_share": share.share,
            "low": share.low,
            "high": share.high,
            "basis": str(share.basis),
            "impacts": share.n_impacts,
            "unknown": share.n_unknown,
            "last_sound_s": self.last_sound,
            "last_identified_s": self.last_identified,
        }


class SupportReport(NamedTuple):
    """A record and why it is told: a regular `share`, a `state` that has changed, or a switch (`shut`, `open`)."""

    kind: Literal["share", "state", "shut", "open"]
    state: SupportState
    switch: Switch | None = None


class CavingWatch:
    """Follow the samples and predictions of a recording by support: its gangue fraction, ground and decision.

    Parameters
    ----------
    model : Model
    supports : sequence of str
        Names of the channels of the predictions; channels that are used together have one name.
    settings : PredictionSettings
        Contains the window of the fraction, its step, the labels and the cost of gangue.
    weight : float, in (0, 1]
        Weight of one prediction, since overlapping windows are not independent: 1 end to end, 0.5 for half overlap.
    sensors : SensorWatch, optional
        Watches the samples; without it no support is blind.
    channels : sequence of str, optional
        Names of the channels of `sensors`; by default the supports.
    rows : sequence of sequences of int, optional
        The channels of each support, as from `rows_of`; by default one each.
    diagnosis : Diagnosis, optional
        Gets the predictions in order of time; by default one of its own.
    """

    def __init__(
        self,
        model: StoredModel,
        supports: Sequence[str],
        settings: PredictionSettings,
        weight: float = 1.0,
        *,
        sensors: SensorWatch | None = None,
        channels: Sequence[str] | None = None,
        rows: Sequence[Sequence[int]] | None = None,
        diagnosis: Diagnosis | None = None,
    ) -> None:
        shares = settings.shares
        gangue = as_in(model, shares.gangue)
        self._gangue, self._blind_after = gangue, settings.blinded_after
        # Grounds and stated coal are looked at in between, as often as in a live stream.
        self._every = max(math.ceil(shares.step / min(shares.window / STEPS, _LONGEST_STEP) - 1e-9), 1)
        self._step = shares.step / self._every
        self.diagnosis = Diagnosis(model) if diagnosis is None else diagnosis
        #: Fraction above which continuing costs more than shutting; None for a model without gangue or another label.
        self.threshold: float | None = None
        rules: list[ShutDecision | None] = [None] * len(supports)
        if settings.needs_shares:
            for label in gangue:
                validation.choice("gangue label", label, model.labels)
        if separates(gangue, model):
            self.threshold = 1 / (1 + shares.dilution_cost)
            rules = [ShutDecision(**shares.costs, hold=shares.hold) for _ in supports]
        elif settings.needs_shares:
            raise InvalidValue(
                "at least one label must remain besides gangue, got all of the model's: "
                f"{', '.join(gangue)}; leave one out"
            )
        test = held_out(model, gangue)
        self._unproven = "" if self.threshold is None or test is None else test.unproven
        # The seams of the simulation have coal and gangue; other labels may be anything.
        seams = self._seams = None if shares.trained_seam or gangue != ("gangue",) else model.seams
        # These networks take the place of how often the model errs.
        answers = answers_of(model, gangue) if seams is None else None
        is_stated = shares.coal_until is not None or shares.coal
        if shares.lumps and seams is None:
            raise InvalidValue(
                "lumps must be left out, this model was not trained on simulated seams with labelled gangue; use a "
                "shipped model, or train one again on streams of a scene"
            )
        if is_stated and isinstance(answers, NoConfusion):
            answers = tested_answers(model, gangue)
        self._sensors, self._channels = sensors, list(supports if channels is None else channels)
        # Nobody knows yet whether a machine runs; of one that is known to run, the first frames show the lines badly.
        self._deaf_until = 0.0
        if settings.lines is not False and model.beam is not None:
            from cgid.recordings.lines import HEARD_AFTER

            self._deaf_until = HEARD_AFTER

        def within(labelled: Sequence[LabelledSpan], own: Sequence[int]) -> list[tuple[float, float]]:
            named = {self._channels[row] for row in own}
            return [(one.start, one.end) for one in labelled if not one.channel or one.channel in named]

        def anchor(own: Sequence[int]) -> Anchor | None:
            spans = within(shares.coal, own)
            return Anchor(shares.coal_until or 0.0, shares.cycle_pause, spans) if shares.coal_until or spans else None

        def lumps(own: Sequence[int]) -> Anchor | None:
            spans = within(shares.lumps, own)
            return Anchor(0.0, spans=spans, least=MIN_LUMPS) if spans else None

        def window(name: str, own: Sequence[int], time: float) -> ShareWindow:
            return ShareWindow(
                time,
                answers=answers,
                weight=weight,
                channel=name,
                threshold=0.5 if self.threshold is None else self.threshold,
                seams=seams,
                anchor=anchor(own) if is_stated else None,
                lumps=lumps(own) if shares.lumps else None,
                by_chance=test is not None and test.by_chance,
            )

        self._window = window
        self._supports = {
            # A tuple of rows would index several axes.
            name: _Support(window=window(name, own, shares.window), rule=rule, rows=list(own))
            for name, rule, own in zip(supports, rules, rows or [(row,) for row in range(len(supports))], strict=True)
        }
        self._waiting: deque[Answer] = deque()
        self._heard: list[tuple[float, str]] = []  # when machines were heard [s]
        self._steps = 0
        self._is_new = False  # whether predictions have come since the last gangue fraction
        self._changes: list[Finding] = []

    def feed(
        self, answers: Iterable[Answer], until: float, heard: Mapping[str, float] | None = None
    ) -> list[SupportReport]:
        """Add the next predictions, in order of time, and return the reports of completed windows.

        All predictions before `until` [s] have arrived. Only the first of several empty windows is reported. `heard`
        are supports with a machine whose tones were left in until a time [s].
        """
        self._waiting.extend(answers)
        # A stream of short blocks has reported what came before; so a recording must, too.
        self._heard += [(time, name) for name, time in (heard or {}).items()]
        reports: list[SupportReport] = []
        while (end := (self._steps + 1) * self._step) <= until:
            self._steps += 1
            reports += self._at(end, in_between=bool(self._steps % self._every))
        return reports

    def finish(self, duration: float) -> list[SupportReport]:
        """Return the remaining reports at the end of a recording of this duration [s]."""
        found = self.feed((), duration)
        return found + list(self._at(duration)) if self._waiting or self._is_new or not self._steps else found

    def stopped(self, reason: str) -> list[SupportReport]:
        """Return the reports of a stream whose samples have stopped; the next `feed` takes them up again."""
        time = self._steps * self._step
        return [
            report
            for one in self._supports.values()
            for report in one.at(one.window.at(time), Ground.STOPPED, time, reason, is_known=True)
            if report.kind == "state"
        ]

    def begin_cycle(self, time: float, name: str = "") -> None:
        """Begin another caving cycle at a time [s]: of a support, or of all without a name.

        Raises `InvalidValue` for a name that no support has.
        """
        if name:
            validation.choice("the support of a cycle", name, tuple(self._supports))
        for support in [self._supports[name]] if name else self._supports.values():
            if support.window.anchor is not None:
                support.window.anchor.begin_at(time)

    def cycles(self) -> dict[str, float]:
        """Return when the caving cycle of each support with stated coal has begun [s]."""
        anchors = {name: one.window.anchor for name, one in self._supports.items()}
        return {name: anchor.cycle for name, anchor in anchors.items() if anchor is not None}

    def short_cycles(self) -> dict[str, tuple[float, float]]:
        """Return begin and end [s] of the first caving cycle of each support that was shorter than its coal."""
        anchors = {name: one.window.anchor for name, one in self._supports.items()}
        return {name: one.short for name, one in anchors.items() if one is not None and one.short is not None}

    def take_changes(self) -> list[Finding]:
        """Return what has begun or ended with the predictions of the channels since the last call."""
        changes, self._changes = self._changes, []
        return changes

    def states(self) -> list[SupportState]:
        """Return the latest record of each support."""
        return [one.state for one in self._supports.values() if one.state is not None]

    def whole(self, answers: Sequence[Answer], duration: float) -> list[Share]:
        """Return the gangue fraction of each support with impacts over a whole recording of this duration [s]."""
        found = []
        for name, support in self._supports.items():
            window = self._window(name, support.rows, duration)
            for answer in answers:
                if answer.channel == name:
                    window.add(answer.time, self._probability(answer), answer.pulse)
            for span in support.forgotten:
                window.forget(*span)
            found.append(window.at(duration))
        return [share for share in found if share.n_impacts]

    def _at(self, end: float, *, in_between: bool = False) -> Iterator[SupportReport]:
        for time, name in [one for one in self._heard if one[0] <= end]:
            self._supports[name].forget(time - _BEFORE_HEARD, time)
            self._heard.remove((time, name))
        while self._waiting and self._waiting[0].time <= end:
            answer = self._waiting.popleft()
            self.diagnosis.add((answer,))
            self._is_new = True
            support = self._supports[answer.channel]
            if not any(start < answer.time <= end for start, end in support.forgotten):
                support.window.add(answer.time, self._probability(answer), answer.pulse)
                support.add_level(answer)
            support.last_impact = answer.time
            if answer.label != UNKNOWN:
                support.last_identified = answer.time
        if self._sensors is not None:
            self._sensors.advance(end)
        self._changes += self.diagnosis.changes(end)
        self._is_new = self._is_new and in_between
        for name, support in self._supports.items():
            ground, since, reason = self._ground(name, support, end)
            is_told = not in_between or ground != (Ground.SEEN if support.state is None else support.state.ground)
            anchor = support.window.anchor
            if not is_told and anchor is not None and not anchor.is_foreign:
                support.window.at(end)  # which finds out
                is_told = anchor.is_foreign
            if is_told:
                is_known = end >= self._deaf_until and not self.diagnosis.is_doubtful(name)
                yield from support.at(support.window.at(end), ground, since, reason, is_known=is_known)

    def _ground(self, name: str, support: _Support, end: float) -> tuple[Ground, float, str]:
        """Return the ground of a support, its start if it is new [s], and the reason."""
        if self._sensors is not None:
            support.hear(self._sensors, end)
            support.last_sound = float(np.fmax.reduce(self._sensors.last_sound[support.rows], initial=np.nan))
            usual = max(self._sensors.last_usual[support.rows].max(), support.last_impact)
            dead = support.n_dead * self._sensors.stretch
            support.n_dead = min(support.n_dead, math.ceil(self._blind_after / self._sensors.stretch))
            if dead >= self._blind_after - 1e-9 or (support.is_blind and dead > 0):
                support.is_blind = True
                return Ground.BLIND, end - dead, self._sensors.why_blind(support.rows, self._channels)
            support.is_blind = False
            if end - usual >= self._blind_after:
                return Ground.BLIND, float(usual), "its noise is far above its own, and no impact comes"
        standing, is_unknown = self.diagnosis.standing(name), self.diagnosis.is_mostly_unknown(name)
        is_scaled, anchor = any(one.kind == Fault.SCALE for one in standing), support.window.anchor
        if self._seams is not None and anchor is not None and anchor.basis(end) in (Basis.PENDING, Basis.ANCHOR):
            # A seam may be harder than the training, and its gangue harder still.
            if not is_unknown and not fits_coal(list(support.levels), anchor.levels, self.diagnosis.model):
                return Ground.WRONG_SCALE, end, "the levels of its impacts do not fit the coal of this cycle"
        elif is_scaled and not (self._seams and self.diagnosis.is_as_a_seam(name)):
            return Ground.WRONG_SCALE, end, "the levels of its impacts are not those of the training"
        if is_unknown:
            return Ground.MOSTLY_UNKNOWN, end, "most of its latest impacts are unknown"
        others = [one for one in standing if one.kind != Fault.SCALE]
        if others:
            return Ground.FAULT, end, f"the finding {others[0].kind} stands"
        if self._unproven:
            return Ground.UNPROVEN, end, self._unproven
        return Ground.SEEN, end, ""

    def _probability(self, answer: Answer) -> float:
        """Return the probability of gangue; nan outside of the training range."""
        if self.threshold is None or not answer.novelty <= 1:
            return float("nan")
        return sum(answer.probabilities[label] for label in self._gangue)


@dataclass(eq=False, repr=False)
class _Support:
    """The window, the rule and the latest record of one support; `rows` are its channels."""

    window: ShareWindow
    rule: ShutDecision | None
    rows: list[int]
    state: SupportState | None = None
    last_sound: float = float("nan")
    last_identified: float = float("nan")
    last_impact: float = float("inf")  # without one nobody knows what its noise is with impacts
    n_dead: int = 0  # dead stretches less sound ones, from the last time when there were as many, until it is blind
    is_blind: bool = False
    looked: tuple[NDArray[np.int64] | int, int] = (0, 0)  # dead stretches of each row, and all, at the last look
    is_silent: bool = False
    levels: deque[float] = field(default_factory=lambda: deque(maxlen=OF_ANCHOR))
    forgotten: list[tuple[float, float]] = field(default_factory=list)  # impacts after a time and up to another [s]

    def hear(self, sensors: SensorWatch, end: float) -> None:
        """Count the stretches since the last look, of which all sensors were dead; a dead sensor is no pause."""
        (dead, every), self.looked = self.looked, (sensors.n_dead[self.rows], sensors.n_all)
        n_dead, n_all = int((self.looked[0] - dead).min()), sensors.n_all - every
        if n_dead == n_all and end - n_all * sensors.stretch < self.last_identified <= end - sensors.stretch:
            n_dead = 0  # stretches that are not whole are none of a dead sensor if impacts are identified in them
        self.n_dead = max(self.n_dead + 2 * n_dead - n_all, 0)
        if n_dead and self.window.anchor is not None:
            self.window.anchor.lose(end)

    def add_level(self, answer: Answer) -> None:
        """Keep the level of an impact that was added to the window, if it has one."""
        if math.isfinite(answer.level):
            self.levels.append(answer.level)
            if self.window.anchor is not None and self.window.anchor.has(answer.time):
                self.window.anchor.levels.append(answer.level)

    @property
    def decision(self) -> Decision:
        """What its rule has decided."""
        if self.rule is None or self.rule.shut is None:
            return Decision.NONE
        return Decision.SHUT if self.rule.shut else Decision.DRAW if self.rule.is_sure else Decision.UNSURE

    def forget(self, start: float, end: float) -> None:
        """Forget what came after `start` and up to `end` [s]: it is no evidence."""
        self.forgotten.append((start, end))
        self.window.forget(start, end)

    def at(self, share: Share, ground: Ground, since: float, reason: str, *, is_known: bool) -> Iterator[SupportReport]:
        """Yield the reports of the window that ends now; unless `is_known` nothing is decided anew."""
        before, switch = self.state, None
        if before is not None and before.ground != Ground.SEEN and ground == Ground.SEEN:
            # What came on another ground is no evidence.
            share = self.window.restart(share.time)
        if self.rule is not None and ground == Ground.SEEN:
            if share.basis == Basis.PENDING:  # coal falls: what was decided is of the cycle before
                self.rule.withdraw()
                self.rule.note(share)
            elif is_known:
                switch = self.rule.watch(share)
        elif self.rule is not None:
            self.rule.withdraw()
        state = SupportState(
            time=share.time,
            share=share,
            decision=self.decision,
            ground=ground,
            since=before.since if before is not None and before.ground == ground else since,
            reason=reason,
            last_sound=self.last_sound,
            last_identified=self.last_identified,
        )
        if before is None and ground in (Ground.SEEN, Ground.UNPROVEN):
            state = replace(state, since=0.0)
        self.state = state
        was_silent, self.is_silent = self.is_silent, not share.n_impacts + share.n_unknown
        if self.rule is not None and not (was_silent and self.is_silent):
            yield SupportReport("share", state)
        if switch is not None:
            yield SupportReport("shut" if switch.shut else "open", state, switch)
        elif (_rough(state.decision), ground) != (
            (Decision.NONE, Ground.SEEN) if before is None else (_rough(before.decision), before.ground)
        ):
            yield SupportReport("state", state)


def _rough(decision: Decision) -> Decision:
    """Return a decision without how sure it is, which changes with every window and is told with its fraction."""
    return Decision.DRAW if decision == Decision.UNSURE else decision

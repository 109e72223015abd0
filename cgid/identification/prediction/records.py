"""What is told of a recording or live stream: answers, fractions, states and findings, in the order of telling."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import finite
from cgid.errors import BadData
from cgid.identification.prediction.findings import Finding

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer
    from cgid.identification.prediction.fraction import Share, Switch
    from cgid.identification.prediction.pipeline import Look, Pipeline
    from cgid.identification.prediction.settings import PredictionSettings
    from cgid.identification.prediction.stream import Step
    from cgid.identification.prediction.support import SupportReport, SupportState
    from cgid.plant import PlantOutputs
    from cgid.recordings.live import Inbox

#: Version of the records; it rises if a key goes or has another meaning.
RECORDS_VERSION = 7
#: Gets each record.
Listener = Callable[[dict[str, Any]], object]


class Records:
    """Make one record of each answer, fraction, state, finding and summary, and give it to the listeners.

    Lines of JSON, MQTT, Modbus, Prometheus, the page and commands are made of these records alone.
    """

    def __init__(self, *listeners: Listener) -> None:
        self.listeners = [*listeners]

    def begin(self, source: str, model: StoredModel, settings: PredictionSettings) -> None:
        """Set the columns of a table."""

    def holds(self, share: Share) -> bool:
        """Return whether the fraction of a file waits for its end, told only if no other one follows."""
        return False

    def answer(self, source: str, answer: Answer, kind: str = "impact", **more: Any) -> None:
        """Tell the prediction for an impact or window; `more`: its number in its channel, its index or its truth."""
        if not self.listeners:
            return
        from cgid.identification.prediction.answers import COLUMNS

        row = {**answer.row, "problem": answer.problem or None}
        probabilities = dict(answer.probabilities)
        content = {column.title: row[column.title] for name, column in COLUMNS.items() if name != "probabilities"}
        content |= more
        content["most_likely"] = max(probabilities, key=lambda label: probabilities[label], default=None)
        content |= {"probabilities": probabilities, "in_training_range": answer.in_training_range}
        content["prediction_set"] = None if answer.prediction_set is None else list(answer.prediction_set)
        self._record(kind, source, content)

    def share(self, source: str, name: str, state: SupportState) -> None:
        """Tell the gangue fraction of a window of a source, or of its channel as `name`."""
        if self.listeners:
            self._record("share", source, {"from_s": state.share.start, "to_s": state.share.time, **_content(state)})

    def state(self, source: str, state: SupportState) -> None:
        """Tell that the ground or the decision of a support has changed; findings say why."""
        self._record("state", source, _content(state))

    def turn(self, source: str, name: str, state: SupportState, turn: Switch, costs: Mapping[str, float]) -> None:
        """Tell that continuing costs more than shutting, or less again."""
        content = _content(state) | {"cost": turn.cost, "evidence": turn.evidence, **costs}
        self._record("shut" if turn.shut else "open", source, content)

    def finding(self, source: str, finding: Finding, n_channels: int = 1, *, withdrawn: bool = False) -> None:
        """Tell what begins or ends; `withdrawn`: the decision of a support with it."""
        self._record("finding", source, finding.content(spelled))

    def summary(self, source: str, tally: RecordingTally, duration: float, start_time: Any = None) -> None:
        """Tell the summary of a recording."""
        if self.listeners:
            self._record("summary", source, {"duration_s": duration, **tally.content(start_time)})

    def _record(self, kind: str, source: str, content: dict[str, Any]) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        record = {"version": RECORDS_VERSION, "kind": kind, "source": source, **finite(content), "wall_time": now}
        for take in self.listeners:
            take(record)


def _content(state: SupportState) -> dict[str, Any]:
    return {"time_s": state.time, **state.content()}


class RecordingTally:
    """Counts of the predictions of a recording, by label and by mark."""

    def __init__(self, kind: str) -> None:
        from cgid.identification.prediction.answers import COLUMNS

        self.kind = kind
        self.labels: Counter[str] = Counter()
        self.marks: Counter[str] = Counter()
        self._marks = {name: column.title for name, column in COLUMNS.items() if column.dtype == "bool"}
        self.n_outside = 0

    def add(self, answers: Iterable[Answer]) -> None:
        """Count more predictions."""
        for answer in answers:
            self.labels[answer.label] += 1
            self.marks.update(title for name, title in self._marks.items() if getattr(answer, name))
            self.n_outside += not answer.in_training_range

    @property
    def total(self) -> int:
        """Number of predictions."""
        return self.labels.total()

    def content(self, start_time: Any) -> dict[str, Any]:
        """Return the counts for JSON."""
        return {
            "start_time": None if start_time is None else start_time.isoformat(),
            f"{self.kind}s": self.total,
            "labels": dict(sorted(self.labels.items())),
            "out_of_training_range": self.n_outside,
            **{title: self.marks[title] for title in self._marks.values()},
        }

    def text(self) -> str:
        """Return the counts in words."""
        named = ", ".join(f"{label} {count}" for label, count in self.labels.most_common()) or "none"
        marks = ", ".join(f"{count} {title.replace('_', ' ')}" for title, count in sorted(self.marks.items()))
        outside = f", {self.n_outside} out of the training's range" if self.n_outside else ""
        return f"{counted(self.total, self.kind)}: {named}{outside}" + (f", {marks}" if marks else "")


#: Maximum number of pending rows before a measurable one.
_MAX_PENDING = 1000
#: Maximum delay of predictions that keep up with a live stream [s].
_BEHIND = 1.0


class RecordingRows:
    """Tell the predictions of one model for the channels of one recording."""

    # Unless `live`, rows wait for a measurable one, and gangue fractions for a second row.

    def __init__(
        self,
        pipeline: Pipeline,
        lines: Records,
        helped: Callable[[Finding], Finding] = lambda finding: finding,
        *,
        keep: bool = False,
    ) -> None:
        self._pipeline, self.lines, self._live = pipeline, lines, pipeline.live
        self.source, self.channels = pipeline.source, pipeline.supports
        self.kind = pipeline.model.subject
        self.tally = RecordingTally(self.kind)
        self.answers: list[Answer] = []
        self.shares: list[Share] = []
        self.turns: list[Switch] = []
        self.findings: list[Finding] = []
        self._keep, self.settings = keep, pipeline.settings
        self._numbers: Counter[str] = Counter()
        self._helped = helped
        self._measured = self._live
        self._pending_answers: list[Answer] = []
        self._pending_reports: list[SupportReport] = []
        self._held: dict[str, SupportState] = {}  # fractions of few impacts, told at the end unless one of more follows
        assert pipeline.watch is not None
        self._watch = pipeline.watch
        self._silent: list[Finding] = []
        self._look: Look | None = None
        self._decided: set[str] = set()  # supports of which something is decided
        self.threshold = self._watch.threshold

    def attach(self, outputs: PlantOutputs, inbox: Inbox) -> None:
        """Let outputs take part in a live stream, which knows its delay, and since when no samples have come."""
        pipeline = self._pipeline
        outputs.begin(
            source=self.source,
            channels=self.channels,
            rows=pipeline.names,
            unit=pipeline.model.unit,
            threshold=self.threshold,
            blind_after=self.settings.blinded_after,
            behind=lambda: inbox.behind,
            waited=lambda: inbox.waited,
        )
        self.lines.listeners.append(outputs)
        self._look = partial(outputs.monitored_blocks, sampling_rate=pipeline.sampling_rate)

    def steps(self, inbox: Inbox) -> Iterator[Step]:
        """Yield the steps of a live stream, each told before; and tell when they fall behind, and catch up."""
        late: Finding | None = None
        for step in self._pipeline.steps(inbox, measured=self._look):
            self.feed(step)
            behind = inbox.behind
            if late is None and behind >= _BEHIND:
                late = Finding(kind="behind", begin=self._pipeline.duration, fields={"behind": behind})
                self._tell_found([late], ())
            elif late is not None and behind < _BEHIND / 2:
                self._tell_found([replace(late, end=self._pipeline.duration)], ())
                late = None
            yield step

    def feed(self, step: Step) -> None:
        """Tell the next predictions, what begins and ends, and the reports of completed windows."""
        answers = step.answers
        self.tally.add(answers)
        if self._keep:
            self.answers += answers
        self._measured = self._measured or any(answer.probabilities for answer in answers)
        self._pending_answers += answers
        if self._measured or len(self._pending_answers) > _MAX_PENDING:
            self._tell_answers()
        self._tell_found(step.found, step.reports)
        self._tell_reports(step.reports)

    def stopped(self, seconds: float) -> Step:
        """Tell that a live stream gives no samples, and return that step; the next ones take it up again."""
        last = self._pipeline.stopped(f"no samples have arrived for {seconds:.0f} s")
        self.feed(last)
        return last

    def finish(self, start_time: Any = None) -> Step:
        """Tell what waits at the end of a recording, and what is wrong with all of it; return the last step."""
        last = self._pipeline.finish()
        self.lines.begin(self.source, self._pipeline.model, self.settings)  # the head of an empty table
        if self._silent:
            raise BadData(self._helped(self._silent[0]).line(self.source, len(self._pipeline.names), spelled))
        if not self._measured and self.tally.total:
            first = self._pending_answers[0] if self._pending_answers else None
            more = f" (and so for all {self.tally.total} {self.kind}s)" if self.tally.total > 1 else ""
            problem = first.problem if first else "nothing in it can be measured"
            raise BadData(f"{self.name(first.channel) if first else self.source}: {problem}{more}")
        self._tell_answers()
        if self._live:
            self._tell_found(last.found, last.reports)
        self._tell_reports(last.reports)
        for channel, state in self._held.items():
            self.lines.share(self.source, self.name(channel), state)
        if self.tally.total > 1 or self._live:
            self.lines.summary(self.source, self.tally, last.until, start_time)
        if not self._live:
            self._tell_found(last.found, last.reports)
        return last

    def _tell_found(self, found: Sequence[Finding], reports: Sequence[SupportReport]) -> None:
        """Tell what begins and ends, each with the decision that it withdraws."""
        if not (self._live or self.settings.needs_shares or self.tally.total > 1):
            found = [one for one in found if not one.is_of_fraction]  # a recording of one impact has no fraction
        if not self.tally.total and not self._live:  # where no channel gives anything, that is an error
            self._silent += [one for one in found if one.is_silent]
            found = [one for one in found if not one.is_silent]
        lost = {one.state.share.channel for one in reports if one.state.decision == "none"} & self._decided
        for one in map(self._helped, found):
            own = {name for name in lost if one.concerns(name)} if one.channels and not one.is_over else set()
            lost -= own
            self.lines.finding(self.source, one, len(self._pipeline.names), withdrawn=bool(own))
            if self._keep:
                self.findings.append(one)

    @property
    def states(self) -> list[SupportState]:
        """The latest record of each support."""
        return self._watch.states()

    def whole(self, duration: float) -> list[Share]:
        """Return the gangue fraction of each support over the whole recording of this duration [s]."""
        return self._watch.whole(self.answers, duration)

    def name(self, channel: str) -> str:
        """Return source and channel in one word."""
        return self.source if channel == "1" and len(self.channels) == 1 else f"{self.source} channel {channel}"

    def _tell_answers(self) -> None:
        if self._pending_answers:
            self.lines.begin(self.source, self._pipeline.model, self.settings)
        for answer in self._pending_answers:
            self._numbers[answer.channel] += 1
            self.lines.answer(self.source, answer, self.kind, **{self.kind: self._numbers[answer.channel]})
        self._pending_answers = []

    def _tell_reports(self, more: Iterable[SupportReport]) -> None:
        """Tell the records of supports; a recording of one impact has none unless an option requests them."""
        self._pending_reports += more
        if not (self._live or self.settings.needs_shares or self.tally.total > 1):
            return
        for one in self._pending_reports:
            state, share = one.state, one.state.share
            name = self.name(share.channel)
            if one.kind == "share":
                self.shares += [share] * self._keep
                if not self._live and (share.n_impacts or share.n_unknown) and self.lines.holds(share):
                    self._held[share.channel] = state
                elif share.n_impacts or self._live or share.n_unknown:
                    self._held.pop(share.channel, None)
                    self.lines.share(self.source, name, state)
            elif one.switch is not None:
                self.turns += [one.switch] * self._keep
                self.lines.turn(self.source, name, state, one.switch, self.settings.shares.costs)
            else:
                self.lines.state(self.source, state)
            self._decided.discard(share.channel)
            if state.decision != "none":
                self._decided.add(share.channel)
        self._pending_reports = []

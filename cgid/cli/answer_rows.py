"""Output of predict and monitor: predictions on stdout, messages on stderr; with --json all on stdout, line by line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from cgid._lib.spelling import as_option
from cgid._lib.terminal import counted
from cgid.cli.output import finite, print_json, say, warn
from cgid.cli.table import TableOutput
from cgid.errors import BadData
from cgid.units import Column

if TYPE_CHECKING:
    from cgid.cli.hints import NextSteps
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import Answer, PredictionSettings
    from cgid.identification.prediction.findings import Finding
    from cgid.identification.prediction.fraction import Share, Switch
    from cgid.identification.prediction.pipeline import Pipeline
    from cgid.identification.prediction.stream import Step
    from cgid.identification.prediction.support import SupportReport, SupportState

#: Version of the lines of --json; it rises if a key goes or has another meaning.
ANSWERS_VERSION = 6


class AnswerLines:
    """Print one row at a time, with its kind in JSON; `listener` receives each line, printed or not."""

    def __init__(
        self,
        as_json: bool,
        table: TableOutput | None = None,
        *,
        datasets: bool = False,
        live: bool = False,
        clock: bool = False,
        only_summary: bool = False,
        fractions: bool = False,
        listener: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self.as_json, self.only_summary = as_json, only_summary
        self._live, self._clock, self._listener = live, clock, listener
        #: Whether each fraction and decision has a line of text; else the summary tells the last ones.
        self.has_fractions = live or fractions
        self._last: dict[str, str] = {}  # fraction of each support
        self._turns: dict[str, list[str]] = {}
        self._noted: set[str] = set()  # kinds of notes that are told once, however many files there are
        self._table, self._datasets = table or TableOutput(), datasets
        self._has_rows = not only_summary or self._table.is_file

    def begin(self, source: str, model: StoredModel, settings: PredictionSettings) -> None:
        """Set the columns; raises `BadData` if earlier rows have different ones."""
        from cgid.identification.prediction.answers import answer_columns

        if self.as_json or not self._has_rows:
            return
        columns = [Column("source"), *answer_columns(model, settings)]
        columns += [Column("index", dtype="int64"), Column("truth")] * self._datasets
        if lacking := self._table.begin(columns):
            raise BadData(
                f"{source}: its columns must be those of earlier rows, its model adds {lacking[0].title}; run it alone"
            )

    def answer(self, source: str, answer: Answer, kind: str = "impact", **more: Any) -> None:
        """Print the prediction for an impact or window; `more`: its number in its channel, its index or its truth."""
        from cgid.identification.prediction.answers import COLUMNS

        if not self._has_rows:
            return
        row = {"source": source, **answer.row, "problem": answer.problem or None, **more}
        if not self.as_json:
            self._table.add(row)
        if self.as_json or self._listener is not None:
            probabilities = dict(answer.probabilities)
            content = {
                column.title: row[column.title] for name, column in COLUMNS.items() if name != "probabilities"
            } | more
            content["most_likely"] = max(probabilities, key=lambda label: probabilities[label], default=None)
            content |= {"probabilities": probabilities, "in_training_range": answer.in_training_range}
            content["prediction_set"] = None if answer.prediction_set is None else list(answer.prediction_set)
            self._line(kind, source, content)

    def share(self, source: str, name: str, state: SupportState) -> None:
        """Print the gangue fraction of a window of a source, or of its channel as `name`."""
        share = state.share
        unknown = f", {share.n_unknown} more unknown" if share.n_unknown else ""
        any_seam = ", any seam" if share.basis.is_any_seam else ""
        fraction = (
            f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f}{any_seam})" if share.is_known else "not known"
        )
        content = {"from_s": share.start, "to_s": share.time, **_record(state)}
        answers = counted(share.n_impacts, "answer") + unknown
        text = f"gangue fraction {fraction} from {share.start:.6g} to {share.time:.6g} s, {answers}"
        self._last[name] = text
        self._note("share", source, f"{name}: {text}", content, is_told=self.has_fractions)

    def state(self, source: str, state: SupportState) -> None:
        """Give the record of a support whose ground or decision has changed to programs; findings say why."""
        self._line("state", source, _record(state))

    def turn(self, source: str, name: str, state: SupportState, turn: Switch, costs: Mapping[str, float]) -> None:
        """Print that continuing costs more than shutting, or less again."""
        word, side = ("SHUT", "above") if turn.shut else ("OPEN", "below")
        share, limit, sure = turn.share, 1 / (1 + costs["dilution_cost"]), f"{min(turn.evidence, 0.999):.1%} sure"
        why = f"{'going on' if turn.shut else 'staying shut'} is expected to lose {abs(turn.cost):.2f} coal a rock"
        if not turn.shut:
            why += f", as shut too early costs {costs['cost_early']:g} times as much as too late"
        message = (
            f"{word} {turn.time:.6g} s: {why} (gangue fraction {share.share:.2f}, {sure} that it is {side} "
            f"{limit:.2f}, the limit where a drawn gangue costs {costs['dilution_cost']:g} coal)  {name}"
        )
        content = {"cost": turn.cost, "evidence": turn.evidence, **costs}
        self._turns.setdefault(name, []).append(f"{word} at {turn.time:.6g} s")
        self._note(word.lower(), source, message, _record(state) | content, is_told=self.has_fractions)

    def summary(self, source: str, tally: RecordingTally, duration: float, start_time: Any = None) -> None:
        """Print the summary of a recording."""
        content = {"duration_s": duration, **tally.content(start_time)}
        message = f"{source}: {tally.text()} in {duration:.6g} s"
        if not self.has_fractions:
            told = {name: "; ".join([text, *self._turns.pop(name, [])]) for name, text in self._last.items()}
            message += "".join(f"; {text}" if name == source else f"\n{name}: {text}" for name, text in told.items())
        self._last.clear()
        self._line("summary", source, content)
        for one in message.splitlines() if not self.as_json else ():
            say(one, err=not self.only_summary)

    def finding(self, source: str, finding: Finding, n_channels: int = 1, *, withdrawn: bool = False) -> None:
        """Print what begins or ends, on stderr and in JSON; `withdrawn`: the decision of a support with it."""
        self._line("finding", source, finding.content(as_option))
        line = finding.line(source, n_channels, as_option)
        if finding.is_note:
            if not self.as_json and finding.kind not in self._noted:
                say(line, err=True)
            self._noted.add(finding.kind)
        elif line:
            warn(line + ", so the decision is withdrawn" * withdrawn)

    def delay(self, source: str, behind: float, message: str) -> None:
        """Print the delay of the predictions after a live stream [s], on stderr and in JSON."""
        warn(f"{source}: {behind:.1f} s behind: {message}")
        self._line("delay", source, {"behind_s": behind, "message": message})

    def _note(self, kind: str, source: str, message: str, content: dict[str, Any], is_told: bool = True) -> None:
        """Print the content in JSON, else the message: on stderr, unless it is all that is printed."""
        self._line(kind, source, content)
        if is_told and not self.as_json:
            say(message, err=not self.only_summary)

    def _line(self, kind: str, source: str, content: dict[str, Any]) -> None:
        """Print the content as a line of JSON, if requested; then the listener receives it."""
        line = {"kind": kind, "source": source, **content}
        now = {"wall_time": datetime.now(UTC).isoformat(timespec="milliseconds")}
        if self.as_json:
            # Whoever reads the record of a live support must see how old it is.
            is_record = self._live and "ground" in line
            print_json(line | now if self._clock or is_record else line, version=ANSWERS_VERSION)
        if self._listener is not None:
            self._listener({"version": ANSWERS_VERSION, **finite(line | now)})


def _record(state: SupportState) -> dict[str, Any]:
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
#: Identified impacts from which a gangue fraction is told in words before the end of a recording.
_ENOUGH = 10


class RecordingRows:
    """Print the predictions of one model for the channels of one recording."""

    # Unless `live`, rows wait for a measurable one, and gangue fractions for a second row.

    def __init__(self, pipeline: Pipeline, lines: AnswerLines, steps: NextSteps, *, keep: bool = False) -> None:
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
        self._steps = steps
        self._measured = self._live
        self._pending_answers: list[Answer] = []
        self._pending_reports: list[SupportReport] = []
        self._held: dict[str, SupportState] = {}  # fractions of few impacts, told at the end unless one of more follows
        assert pipeline.watch is not None
        self._watch = pipeline.watch
        self._silent: list[Finding] = []
        self._decided: set[str] = set()  # supports of which something is decided
        self.threshold = self._watch.threshold

    def feed(self, step: Step) -> None:
        """Print the next predictions, the reports of completed windows, and warnings."""
        answers = step.answers
        self.tally.add(answers)
        if self._keep:
            self.answers += answers
        self._measured = self._measured or any(answer.probabilities for answer in answers)
        self._pending_answers += answers
        if self._measured or len(self._pending_answers) > _MAX_PENDING:
            self._print_answers()
        self._print_found(step.found, step.reports)
        self._print_reports(step.reports)

    def stopped(self, seconds: float) -> None:
        """Print that a live stream gives no samples; the next ones take it up again."""
        last = self._pipeline.stopped(f"no samples have arrived for {seconds:.0f} s")
        self._print_found(last.found, last.reports)
        self._print_reports(last.reports)

    def finish(self, start_time: Any = None) -> None:
        """Print pending lines at the end of a recording, and what is wrong with all of it."""
        last = self._pipeline.finish()
        self.lines.begin(self.source, self._pipeline.model, self.settings)  # the head of an empty table
        if self._silent:
            raise BadData(self._steps.of(self._silent[0]).line(self.source, len(self._pipeline.names), as_option))
        if not self._measured and self.tally.total:
            first = self._pending_answers[0] if self._pending_answers else None
            more = f" (and so for all {self.tally.total} {self.kind}s)" if self.tally.total > 1 else ""
            problem = first.problem if first else "nothing in it can be measured"
            raise BadData(f"{self.name(first.channel) if first else self.source}: {problem}{more}")
        self._print_answers()
        is_live = self._live
        if is_live:
            self._print_found(last.found, last.reports)
        self._print_reports(last.reports)
        for channel, state in self._held.items():
            self.lines.share(self.source, self.name(channel), state)
        if self.tally.total > 1 or is_live:
            self.lines.summary(self.source, self.tally, last.until, start_time)
        if not is_live:
            self._print_found(last.found, last.reports)

    def _print_found(self, found: Sequence[Finding], reports: Sequence[SupportReport]) -> None:
        """Print what begins and ends, each with the decision that it withdraws."""
        if not (self._live or self.settings.needs_shares or self.tally.total > 1):
            found = [one for one in found if not one.is_of_fraction]  # a recording of one impact has no fraction
        if not self.tally.total and not self._live:  # where no channel gives anything, that is an error
            self._silent += [one for one in found if one.is_silent]
            found = [one for one in found if not one.is_silent]
        lost = {one.state.share.channel for one in reports if one.state.decision == "none"} & self._decided
        for one in map(self._steps.of, found):
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

    def _print_answers(self) -> None:
        if self._pending_answers:
            self.lines.begin(self.source, self._pipeline.model, self.settings)
        for answer in self._pending_answers:
            self._numbers[answer.channel] += 1
            self.lines.answer(self.source, answer, self.kind, **{self.kind: self._numbers[answer.channel]})
        self._pending_answers = []

    def _print_reports(self, more: Iterable[SupportReport]) -> None:
        """Print the records of supports; a recording of one impact has none unless an option requests them."""
        self._pending_reports += more
        if not (self._live or self.settings.needs_shares or self.tally.total > 1):
            return
        for one in self._pending_reports:
            state, share = one.state, one.state.share
            name = self.name(share.channel)
            if one.kind == "share":
                self.shares += [share] * self._keep
                if self._is_held(share):
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

    def _is_held(self, share: Share) -> bool:
        """Return whether a fraction waits for the end of the recording."""
        if self._live or not (share.n_impacts or share.n_unknown):
            return False
        is_brief = not self.lines.as_json and (share.n_impacts < _ENOUGH or not self.lines.has_fractions)
        return self.lines.only_summary or is_brief

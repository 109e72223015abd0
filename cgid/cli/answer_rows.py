"""Output of predict and monitor: predictions on stdout, messages on stderr; with --json all on stdout, line by line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from cgid._lib.terminal import counted
from cgid.cli.output import finite, print_json, say, warn
from cgid.cli.table import TableOutput
from cgid.errors import BadData
from cgid.units import Column

if TYPE_CHECKING:
    from cgid.cli.hints import Hints
    from cgid.identification.model.anchor import Basis
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import Answer, PredictionSettings
    from cgid.identification.prediction.diagnosis import Change, Hint
    from cgid.identification.prediction.fraction import Share, Switch
    from cgid.identification.prediction.pipeline import Pipeline
    from cgid.identification.prediction.stream import Step
    from cgid.identification.prediction.support import SupportReport, SupportState

#: Version of the lines of --json; it rises if a key goes or has another meaning.
ANSWERS_VERSION = 5


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

    def state(self, source: str, name: str, state: SupportState, message: str | None) -> None:
        """Print that the ground or the decision of a support has changed; without a message only in JSON."""
        self._line("state", source, _record(state))
        if message is not None:
            warn(f"{name}: {message}")

    def turn(self, source: str, name: str, state: SupportState, turn: Switch, costs: Mapping[str, float]) -> None:
        """Print that continuing costs more than shutting, or less again."""
        word, side = ("SHUT", "above") if turn.shut else ("OPEN", "below")
        share, limit, sure = turn.share, 1 / (1 + costs["dilution_cost"]), f"{min(turn.evidence, 0.999):.1%} sure"
        why = f"{'going on' if turn.shut else 'staying shut'} is expected to lose {abs(turn.cost):.2f} coal a rock"
        if not turn.shut:
            why += f", as shut too early costs {costs['cost_early']:g} where too late costs {costs['cost_late']:g}"
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

    def warning(self, source: str, message: str, **more: Any) -> None:
        """Print a warning about a readable recording, on stderr and in JSON; `more`: what programs get besides."""
        warn(message)
        self._line("warning", source, {"message": message, **more})

    def hint(self, source: str, hint: Hint) -> None:
        """Print why most predictions are unknown and what to do, on stderr and in JSON."""
        where = f" channel {', '.join(hint.channels)}" if hint.channels else ""
        content = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(hint).items()}
        say(f"cgid: hint: {source}{where}: {hint.line}", err=True)
        self._line("hint", source, content)

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
#: Maximum number of silent channels that are named one by one.
_MAX_SILENT_LISTED = 3
#: A caving cycle without a pause is told after this time [s]: it is some minutes long.
_LONGEST_CYCLE = 1800.0
#: What goes on with a channel of a live stream is told again after this time [s].
_REPEATED_AFTER = 3600.0
#: Grounds of a support and ends of conditions in words.
_GROUNDS = {
    "blind": "blind",
    "fault": "faulty",
    "wrong_scale": "of a wrong scale",
    "mostly_unknown": "mostly unknown",
    "unproven": "of an unproven model",
    "stopped": "stopped",
}
_OVER = {
    "wrong_scale": "the levels are those of the training again",
    "upside_down": "the signal points upwards again",
    "mostly_unknown": "most impacts are identified again",
    "beam": "the modes of the model explain the impacts again",
    "chain": "the forces are those of contacts again",
}


class RecordingRows:
    """Print the predictions of one model for the channels of one recording."""

    # Unless `live`, rows wait for a measurable one, gangue fractions for a second row, and hints for the end. In a live
    # stream each channel is told what begins and what ends.

    def __init__(self, pipeline: Pipeline, lines: AnswerLines, *, hints: Hints, keep: bool = False) -> None:
        self._pipeline, self.lines, self._live = pipeline, lines, pipeline.live
        self.source, self.channels = pipeline.source, pipeline.supports
        self.kind = pipeline.model.subject
        self.tally = RecordingTally(self.kind)
        self.answers: list[Answer] = []
        self.shares: list[Share] = []
        self.turns: list[Switch] = []
        self.hints: list[Hint] = []
        self.warnings: list[str] = []
        self._keep, self.settings = keep, pipeline.settings
        self._numbers: Counter[str] = Counter()
        self._diagnosis = hints
        self._measured = self._live
        self._silent: tuple[str, ...] = ()
        self._pending_answers: list[Answer] = []
        self._pending_reports: list[SupportReport] = []
        self._held: dict[str, SupportState] = {}  # fractions of few impacts, told at the end unless one of more follows
        assert pipeline.watch is not None
        self._watch = pipeline.watch
        self._grounds: dict[str, tuple[str, bool]] = {}  # last ground and whether something was decided
        self._endless: set[str] = set()  # supports whose caving cycle goes on without a pause
        self._short: set[str] = set()  # supports that had a caving cycle shorter than its coal
        self._bases: dict[str, Basis] = {}  # last basis of the gangue fraction of each support
        self._conditions: dict[tuple[str, str], float] = {}  # what a channel has, and when it was told [s]
        self._later: list[Change] = []
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
        self._print_changes(step.changes, step.until)
        self._print_reports(step.reports)
        self._silent += step.silent
        for warning in (*step.warnings, *step.wrong_beams):
            self.lines.warning(self.source, warning)
        for note in step.notes if not self.lines.as_json else ():
            say(note, err=True)

    def stopped(self, seconds: float) -> None:
        """Print that a live stream gives no samples; the next ones take it up again."""
        self._print_reports(self._watch.stopped(f"no samples have arrived for {seconds:.0f} s"))

    def finish(self, start_time: Any = None) -> None:
        """Print pending lines at the end of a recording, and its silent channels."""
        last = self._pipeline.finish()
        self.lines.begin(self.source, self._pipeline.model, self.settings)  # the head of an empty table
        silent = self._silent
        if silent and not self.tally.total and not self._live:
            raise BadData(silent[0])
        for message in silent[:_MAX_SILENT_LISTED]:
            self.lines.warning(self.source, message)
        if len(silent) > _MAX_SILENT_LISTED:
            more = (
                f"{self.source}: and {counted(len(silent) - _MAX_SILENT_LISTED, 'more channel')} without {self.kind}s"
            )
            self.lines.warning(self.source, more)
        if not self._measured and self.tally.total:
            first = self._pending_answers[0] if self._pending_answers else None
            more = f" (and so for all {self.tally.total} {self.kind}s)" if self.tally.total > 1 else ""
            problem = first.problem if first else "nothing in it can be measured"
            raise BadData(f"{self.name(first.channel) if first else self.source}: {problem}{more}")
        self._print_answers()
        self._print_changes(last.changes, last.until)
        self._print_reports(last.reports)
        for channel, state in self._held.items():
            self.lines.share(self.source, self.name(channel), state)
        if (stated := self.settings.coal_until) is not None and stated > last.until:
            self._warn(
                f"{self.source}: --coal-until must be within the recording of {last.until:.6g} s, got {stated:.6g} s"
            )
        if (pause := self.settings.cycle_pause) is not None and last.until > (stated or 0.0) + pause:
            self._print_endless(last.until, {name: one for name, one in self._watch.cycles().items() if not one})
        for label, spans in (("coal", self.settings.coal), ("gangue", self.settings.lumps)):
            if late := sum(one.start > last.until for one in spans):
                self._warn(
                    f"{self.source}: labelled {label} must be within the recording of {last.until:.6g} s, "
                    f"got {counted(late, 'row')} after it"
                )
        if self.tally.total > 1 or self._live:
            self.lines.summary(self.source, self.tally, last.until, start_time)
        if not self._live:
            hints = self._diagnosis.hints()
            self._print_hints(hints)
            factors = self._diagnosis.wrong_scales()
            told = {name for hint in hints for name in hint.channels or self.channels} | factors.keys()
            self._print_scales(factors, "")
            self._print_foreign(self._diagnosis.misfits.keys() - told)
            for change in self._later:  # of a part of the recording alone
                if change.channel not in told:
                    self._print_scales({change.channel: change.factor}, f"from {change.time:.6g} s on ")

    def _print_changes(self, changes: Sequence[Change], time: float) -> None:
        """Print what has begun or ended with the channels of a live stream, and once an hour what goes on."""
        from cgid.identification.prediction.diagnosis import Condition

        if not self._live:
            self._later += [one for one in changes if one.condition == Condition.WRONG_SCALE and one.begins]
            return
        hinted = set[str]()
        for condition in Condition:
            found = [one for one in changes if one.condition == condition]
            began = {one.channel: one for one in found if one.begins}
            for name in self.channels:
                if time >= self._conditions.get((name, condition), time) + _REPEATED_AFTER:
                    began[name] = self._diagnosis.change(name, condition, time)
            self._conditions |= dict.fromkeys(((name, condition) for name in began), time)
            if condition == Condition.WRONG_SCALE:
                self._print_scales({name: one.factor for name, one in began.items()}, "")
            elif condition == Condition.FOREIGN:
                self._print_foreign(began)
            else:
                hinted |= began.keys()
            for name in (one.channel for one in found if not one.begins):
                self._conditions.pop((name, condition), None)
                message = f"{self.name(name)}: {_OVER[condition]}"
                self._warn(message, channel=name, condition=str(condition), active=False)
        if hinted:
            self._print_hints(self._diagnosis.hints(hinted))

    def _print_scales(self, factors: Mapping[str, float], when: str) -> None:
        """Print which channels have levels that are not those of the training."""
        for name, factor in factors.items():
            text = self._diagnosis.level_warning(factor)
            self._warn(
                f"{self.name(name)}: {when}{text}", channel=name, condition="wrong_scale", active=True, factor=factor
            )

    def _print_foreign(self, names: Iterable[str]) -> None:
        """Print what of channels is not like recordings of the training, and what would help."""
        misfits = self._diagnosis.misfits
        for name in sorted(names):
            text, misfit = self._diagnosis.misfit_warning(misfits[name]), misfits[name]
            parts = [str(one.part) for one in (misfit, *misfit.others)]
            more = {"part": parts[0], "parts": parts}
            self._warn(f"{self.name(name)}: {text}", channel=name, condition="foreign", active=True, **more)

    def _warn(self, message: str, **more: Any) -> None:
        self.warnings += [message] * self._keep
        self.lines.warning(self.source, message, **more)

    def _print_hints(self, hints: Iterable[Hint]) -> None:
        for hint in hints:
            self.hints += [hint] * self._keep
            self.lines.hint(self.source, hint)

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
            self._print_basis(name, share)
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
                message = self._state_message(state)
                self.warnings += [f"{name}: {message}"] * (self._keep and message is not None)
                self.lines.state(self.source, name, state, message)
            begun = self._watch.cycles().get(share.channel, share.time) if self.settings.cycle_pause else share.time
            if share.time - begun > _LONGEST_CYCLE:
                self._print_endless(share.time, {share.channel: begun})
            if one.kind != "share":
                self._grounds[share.channel] = state.ground, state.decision != "none"
        self._print_short()
        self._pending_reports = []

    def _is_held(self, share: Share) -> bool:
        """Return whether a fraction waits for the end of the recording."""
        if self._live or not (share.n_impacts or share.n_unknown):
            return False
        is_brief = not self.lines.as_json and (share.n_impacts < _ENOUGH or not self.lines.has_fractions)
        return self.lines.only_summary or is_brief

    def _print_endless(self, time: float, begun: Mapping[str, float]) -> None:
        """Print which supports had no pause since their caving cycles have begun [s], once for each."""
        for name in begun.keys() - self._endless:
            self._endless.add(name)
            self._warn(
                f"{self.name(name)}: no pause of {self.settings.cycle_pause:.6g} s came from {begun[name]:.6g} to "
                f"{time:.6g} s, so this is one caving cycle with one coal; give a shorter cycle_pause, or let "
                "cgid monitor begin cycles with --set cycle_by=stdin",
                channel=name,
            )

    def _print_short(self) -> None:
        """Print which supports had a caving cycle that was shorter than its coal, once for each."""
        for name, (begin, end) in self._watch.short_cycles().items():
            if name not in self._short:
                self._short.add(name)
                self._warn(
                    f"{self.name(name)}: the caving cycle from {begin:.6g} to {end:.6g} s was shorter than its coal of "
                    f"{self.settings.coal_until:.6g} s, so nothing was decided in it; give a shorter --coal-until, or "
                    f"a longer cycle_pause than {self.settings.cycle_pause or 0.0:.6g} s",
                    channel=name,
                )

    def _print_basis(self, name: str, share: Share) -> None:
        """Print why the gangue fraction of a support is not that of its own seam, when that begins."""
        from cgid.identification.model.anchor import MIN_ANCHOR, MIN_LUMPS, Basis

        if share.basis == self._bases.get(share.channel) or not (share.n_impacts or share.basis == Basis.TOO_FEW):
            return
        begins = share.basis in (Basis.ANY_SEAM, Basis.TRAINED)
        if begins and (share.n_impacts < _ENOUGH or share.time < self.settings.shares.window):
            return  # nobody can say what fell at the beginning of so short a recording
        self._bases[share.channel] = share.basis
        stated = self.settings.coal_until
        coal = "the labelled coal" if stated is None else f"the coal of {stated:.6g} s"
        so = "so the interval of the gangue fraction is for any seam"
        alone = "so the gangue fraction rests on the coal alone"
        message = {
            Basis.TOO_FEW: f"{coal} must give at least {MIN_ANCHOR} identified impacts, it gave fewer, {so}; state a "
            "longer time",
            Basis.FOREIGN: f"the impacts until {share.time:.6g} s are hardly a mixture with {coal}, {so}; check that "
            "it was coal alone, of this channel and cycle",
            Basis.FEW_LUMPS: f"the labelled gangue must give at least {MIN_LUMPS} identified impacts, it gave fewer, "
            f"{alone}; label more lumps",
            Basis.WRONG_LUMPS: f"the labelled gangue is hardly gangue beside {coal}, {alone}; check both labels",
            Basis.TRAINED: "the model learned from single blows; where rocks bounce, its gangue fraction and interval "
            "are wrong, and so are decisions: train it on a scene with a [stream]"
            if self._pipeline.model.is_of_blows
            else None,
        }.get(share.basis)
        if message is not None:
            self._warn(f"{name}: {message}", channel=share.channel, basis=str(share.basis))
        elif share.basis == Basis.ANY_SEAM and not self.lines.as_json and len(self._bases) == 1:
            say(
                f"{self.source}: the interval of the gangue fraction is for any seam; it is a third narrower if you "
                "can say how long coal alone fell at the beginning (--coal-until 30s), or that the seam is that of the "
                "training (--set trained_seam=true)",
                err=True,
            )

    def _state_message(self, state: SupportState) -> str | None:
        """Return in words that a ground is lost or won, or that a decision is withdrawn; None for a first decision."""
        ground, decided = self._grounds.get(state.share.channel, ("seen", False))
        if (ground, state.ground) == ("seen", "unproven"):  # said of the model, once for all supports
            return None
        withdrawn = ", so the decision is withdrawn" if decided else ""
        if state.ground != ground and state.ground != "seen":
            return f"{_GROUNDS[state.ground]} since {state.since:.6g} s ({state.reason}){withdrawn}"
        if state.ground != ground:
            return f"seen again at {state.time:.6g} s"
        if decided and state.decision == "none":
            return f"too few identified impacts until {state.time:.6g} s{withdrawn}"
        return None

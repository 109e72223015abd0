"""Rows of answers: impacts or windows, gangue shares, turns and a summary, as text or one JSON object per line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from cgid.cli.output import print_json, say

if TYPE_CHECKING:
    from cgid.identification.answers import Answer
    from cgid.identification.model import Model
    from cgid.identification.next_steps import Diagnosis, Hint
    from cgid.identification.question import Question
    from cgid.identification.share import Share, Turn
    from cgid.identification.stream import Step

#: Version of the lines that --json prints: since 2 each has a kind, and there are kinds besides impacts.
ANSWERS_VERSION = 2
_ROW = "{:>12}  {:<12} {:>11}  {:>8}  {}"
_TITLES = _ROW.format("time [s]", "label", "probability", "novelty", "source")


class AnswerLines:
    """Print one row at a time, with its kind in JSON."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._titled = False

    def answer(self, source: str, number: int, answer: Answer, kind: str = "impact", truth: str | None = None) -> None:
        """Print the answer for an impact or a window, with its number in its channel."""
        if not self._titled and not self.as_json:
            say(_TITLES)
            self._titled = True
        content = {
            kind: number,
            "channel": answer.channel,
            "time_s": answer.time,
            "end_s": answer.end,
            "label": answer.label,
            "probability": answer.probability,
            "probabilities": dict(answer.probabilities),
            "novelty": answer.novelty,
            "in_training_range": answer.in_training_range,
            "overlapping": answer.overlapping,
            "clipped": answer.clipped,
            "cut_off": answer.cut,
            "problem": answer.problem or None,
            "prediction_set": None if answer.prediction_set is None else list(answer.prediction_set),
            **({} if truth is None else {"truth": truth}),
        }
        notes = "; ".join([*([answer.problem] if answer.problem else []), *marks_of(answer)])
        about = source + (f"  ({notes})" if notes else "") + ("" if truth is None else f"  truth: {truth}")
        probability, novelty = _number(answer.probability), _number(answer.novelty)
        text = _ROW.format(f"{answer.time:.6f}", answer.label, probability, novelty, about)
        self._line(kind, source, content, text)

    def share(self, source: str, share: Share) -> None:
        """Print the gangue share of a window."""
        unknown = f", {share.n_unknown} more unknown" if share.n_unknown else ""
        told = f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f})" if share.n_impacts else "not known"
        span = f"{share.start:.6g} to {share.time:.6g} s"
        content = {
            "channel": share.channel,
            "from_s": share.start,
            "to_s": share.time,
            "gangue_share": share.share,
            "low": share.low,
            "high": share.high,
            "impacts": share.n_impacts,
            "unknown": share.n_unknown,
        }
        text = f"# gangue share {told}, {span}, {share.n_impacts} answers{unknown}  {source}"
        self._line("share", source, content, text)

    def turn(self, source: str, turn: Turn, gangue_cost: float) -> None:
        """Print that going on begins to cost more than shutting, or less again."""
        word = "SHUT" if turn.shut else "OPEN"
        says = f"going on costs {turn.cost:.2f} coal an impact" if turn.shut else "going on pays again"
        share = f"gangue share {turn.share.share:.2f}, {1 / (1 + gangue_cost):.2f} is the limit"
        content = {
            "channel": turn.share.channel,
            "time_s": turn.time,
            "cost": turn.cost,
            "gangue_cost": gangue_cost,
            "gangue_share": turn.share.share,
            "low": turn.share.low,
            "high": turn.share.high,
        }
        text = f"{word} {turn.time:.6g} s: {says} ({share} where a gangue costs {gangue_cost:g} coal)  {source}"
        self._line(word.lower(), source, content, text)

    def summary(self, source: str, tally: RecordingTally, duration: float, start_time: Any = None) -> None:
        """Print the summary of a recording."""
        content = {"duration_s": duration, **tally.content(start_time)}
        self._line("summary", source, content, f"# {source}: {tally.text()} in {duration:.6g} s")

    def warning(self, source: str, message: str) -> None:
        """Print a warning about a readable recording, on stderr and in JSON."""
        say(f"cgid: warning: {message}", err=True)
        self._line("warning", source, {"message": message})

    def hint(self, source: str, hint: Hint) -> None:
        """Print why most answers are unknown and what helps, on stderr and in JSON."""
        where = f" channel {', '.join(hint.channels)}" if hint.channels else ""
        say(f"cgid: hint: {source}{where}: {hint.text}", err=True)
        content = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(hint).items()}
        self._line("hint", source, content)

    def delay(self, source: str, behind: float, message: str) -> None:
        """Print how far the answers are behind a live stream [s], on stderr and in JSON."""
        say(f"cgid: warning: {source}: {behind:.1f} s behind: {message}", err=True)
        self._line("delay", source, {"behind_s": behind, "message": message})

    def _line(self, kind: str, source: str, content: dict[str, Any], text: str | None = None) -> None:
        """Print the content in JSON, else the text."""
        if self.as_json:
            print_json({"kind": kind, "source": source, **content}, version=ANSWERS_VERSION)
        elif text is not None:
            say(text)


class RecordingTally:
    """Counts of the answers of a recording, by label and by mark."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.labels: Counter[str] = Counter()
        self.marks: Counter[str] = Counter()
        self.n_outside = 0

    def add(self, answers: Iterable[Answer]) -> None:
        """Count more answers."""
        for answer in answers:
            self.labels[answer.label] += 1
            self.marks.update(marks_of(answer))
            self.n_outside += not answer.in_training_range

    @property
    def total(self) -> int:
        """Number of answers."""
        return self.labels.total()

    def content(self, start_time: Any) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {
            "start_time": None if start_time is None else start_time.isoformat(),
            f"{self.kind}s": self.total,
            "labels": dict(sorted(self.labels.items())),
            "out_of_training_range": self.n_outside,
            **{name.replace(" ", "_"): self.marks[name] for name in ("overlapping", "clipped", "cut off")},
        }

    def text(self) -> str:
        """Return the figures in words."""
        named = ", ".join(f"{label} {count}" for label, count in self.labels.most_common()) or "none"
        marks = ", ".join(f"{count} {name}" for name, count in sorted(self.marks.items()))
        outside = f", {self.n_outside} out of the training's range" if self.n_outside else ""
        plural = "" if self.total == 1 else "s"
        return f"{self.total} {self.kind}{plural}: {named}{outside}" + (f", {marks}" if marks else "")


def marks_of(answer: Answer) -> list[str]:
    """Return the marks of an answer's frame in words."""
    marked = {"overlapping": answer.overlapping, "clipped": answer.clipped, "cut off": answer.cut}
    return [name for name, holds in marked.items() if holds]


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.3f}"


#: Most rows that wait for a measurable one.
_MOST_HELD = 1000
#: Up to this many silent channels are named one by one.
_MOST_SILENT = 3


class RecordingRows:
    """Print the answers of one model for the channels of one recording.

    `keep` stores answers, shares and turns. Unless `always`, rows wait for a measurable one, and shares for a second
    row. `diagnosis` sees all answers; its hint follows the last line or, if `always`, the first clear answers.
    """

    def __init__(
        self,
        source: str,
        model: Model,
        channels: Sequence[str],
        question: Question,
        lines: AnswerLines,
        *,
        keep: bool = False,
        always: bool = False,
        diagnosis: Diagnosis | None = None,
    ) -> None:
        from cgid.identification.share import CavingWatch, Turn
        from cgid.identification.stream import answering_channels, independence

        self.source, self.lines = source, lines
        self.kind = "window" if model.kind == "window" else "impact"
        self.tally = RecordingTally(self.kind)
        self.channels = answering_channels(model, channels)
        self.answers: list[Answer] = []
        self.shares: list[Share] = []
        self.turns: list[Turn] = []
        self._keep, self._always, self._turn, self._question = keep, always, Turn, question
        self._numbers: Counter[str] = Counter()
        self._diagnosis = diagnosis
        self.hint: Hint | None = None
        self._measured = always
        self._silent: tuple[str, ...] = ()
        self._held_answers: list[Answer] = []
        self._held_shares: list[Share | Turn] = []
        self._watch: CavingWatch | None = None
        self.threshold: float | None = None
        if question.asks_for_shares or question.separates_gangue(model):
            self._watch = CavingWatch(model, self.channels, question, independence(model, question))
            self.threshold = self._watch.threshold

    def feed(self, step: Step) -> None:
        """Print the next answers, the shares of the windows that have ended, and warnings."""
        answers = step.answers
        self.tally.add(answers)
        if self._keep:
            self.answers += answers
        self._measured = self._measured or any(answer.probabilities for answer in answers)
        self._held_answers += answers
        if self._measured or len(self._held_answers) > _MOST_HELD:
            self._print_answers()
        if self._watch is not None:
            self._print_shares(self._watch.feed(answers, step.until))
        self._silent += step.silent
        for warning in step.warnings:
            self.lines.warning(self.source, warning)
        if self._diagnosis is not None:
            self._diagnosis.add(answers)
            self._diagnosis.upside_down.update(step.upside_down)
            if self._always and self._diagnosis.is_clear:
                self._print_hint()

    def finish(self, duration: float, start_time: Any = None) -> None:
        """Print the rest at the end of a recording of this duration [s], and its silent channels.

        Raises `BadData` if there was no answer or none could be measured; never for a live stream.
        """
        from cgid.errors import BadData

        silent = self._silent
        if silent and not self.tally.total and not self._always:
            raise BadData(silent[0])
        for message in silent[:_MOST_SILENT]:
            self.lines.warning(self.source, message)
        if len(silent) > _MOST_SILENT:
            more = f"{self.source}: and {len(silent) - _MOST_SILENT} more channels without {self.kind}s"
            self.lines.warning(self.source, more)
        if not self._measured and self.tally.total:
            first = self._held_answers[0] if self._held_answers else None
            more = f" (and so for all {self.tally.total} {self.kind}s)" if self.tally.total > 1 else ""
            problem = first.problem if first else "nothing in it can be measured"
            raise BadData(f"{self.name(first.channel) if first else self.source}: {problem}{more}")
        self._print_answers()
        if self._watch is not None:
            self._print_shares(self._watch.finish(duration))
        if self.tally.total > 1 or self._always:
            self.lines.summary(self.source, self.tally, duration, start_time)
        self._print_hint()

    def _print_hint(self) -> None:
        """Print the hint once, if there is one."""
        if self._diagnosis is not None and self.hint is None:
            self.hint = self._diagnosis.hint()
            if self.hint is not None:
                self.lines.hint(self.source, self.hint)

    def name(self, channel: str) -> str:
        """Return source and channel in one word; in JSON, the first channel has no name."""
        plain = channel == "1" and (self.lines.as_json or len(self.channels) == 1)
        return self.source if plain else f"{self.source} channel {channel}"

    def _print_answers(self) -> None:
        for answer in self._held_answers:
            self._numbers[answer.channel] += 1
            self.lines.answer(self.name(answer.channel), self._numbers[answer.channel], answer, self.kind)
        self._held_answers = []

    def _print_shares(self, more: Iterable[Share | Turn]) -> None:
        """Print shares and turns; a recording of one impact has none unless an option asks for them."""
        self._held_shares += more
        if not (self._always or self._question.asks_for_shares or self.tally.total > 1):
            return
        for one in self._held_shares:
            if isinstance(one, self._turn):
                self.turns += [one] * self._keep
                self.lines.turn(self.name(one.share.channel), one, self._question.cost_of_gangue)
                continue
            self.shares += [one] * self._keep
            if one.n_impacts or one.n_unknown or self._always:
                self.lines.share(self.name(one.channel), one)
        self._held_shares = []

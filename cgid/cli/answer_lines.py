"""How answers are printed: one row each, or one JSON object a line, each with its kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from cgid.cli.options import print_json
from cgid.cli.output import say

#: Version of the lines that --json prints of answers: since 2 each says its kind, and there are others than impacts.
ANSWERS_VERSION = 2
_ROW = "{:>12}  {:<12} {:>11}  {:>8}  {}"
_TITLES = _ROW.format("time [s]", "label", "probability", "novelty", "source")


class AnswerLines:
    """Prints what is known of recordings, as it comes.

    Parameters
    ----------
    as_json : bool
    """

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._titled = False

    def answer(self, source: str, number: int, answer: Any, kind: str = "impact", truth: str | None = None) -> None:
        """Print the answer for an impact or a window, the how many-th of its channel."""
        if self.as_json:
            content = {
                "kind": kind,
                "source": source,
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
            }
            self._json(content | ({} if truth is None else {"truth": truth}))
            return
        if not self._titled:  # once, above the first row
            say(_TITLES)
            self._titled = True
        notes = [*([answer.problem] if answer.problem else []), *marks_of(answer)]
        note = f"  ({'; '.join(notes)})" if notes else ""
        note += "" if truth is None else f"  truth: {truth}"
        probability, novelty = _number(answer.probability), _number(answer.novelty)
        say(_ROW.format(f"{answer.time:.6f}", answer.label, probability, novelty, source + note))

    def share(self, source: str, share: Any) -> None:
        """Print the gangue share of a window."""
        if self.as_json:
            content = {
                "kind": "share",
                "source": source,
                "channel": share.channel,
                "from_s": share.start,
                "to_s": share.time,
                "gangue_share": share.share,
                "low": share.low,
                "high": share.high,
                "impacts": share.n_impacts,
                "unknown": share.n_unknown,
            }
            self._json(content)
            return
        unknown = f", {share.n_unknown} more unknown" if share.n_unknown else ""
        told = f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f})" if share.n_impacts else "not known"
        span = f"{share.start:.6g} to {share.time:.6g} s"
        say(f"# gangue share {told}, {span}, {share.n_impacts} answers{unknown}  {source}")

    def turn(self, source: str, turn: Any, gangue_cost: float) -> None:
        """Print that going on has begun to cost more than it brings, or less again."""
        if self.as_json:
            content = {
                "kind": "shut" if turn.shut else "open",
                "source": source,
                "channel": turn.share.channel,
                "time_s": turn.time,
                "cost": turn.cost,
                "gangue_cost": gangue_cost,
                "gangue_share": turn.share.share,
                "low": turn.share.low,
                "high": turn.share.high,
            }
            self._json(content)
            return
        word = "SHUT" if turn.shut else "OPEN"
        says = f"going on costs {turn.cost:.2f} coal an impact" if turn.shut else "going on pays again"
        share = f"gangue share {turn.share.share:.2f}, {1 / (1 + gangue_cost):.2f} is the limit"
        say(f"{word} {turn.time:.6g} s: {says} ({share} where a gangue costs {gangue_cost:g} coal)  {source}")

    def summary(self, source: str, tally: RecordingTally, duration: float, start_time: Any = None) -> None:
        """Print what a recording held."""
        if self.as_json:
            self._json({"kind": "summary", "source": source, "duration_s": duration, **tally.content(start_time)})
            return
        say(f"# {source}: {tally.text()} in {duration:.6g} s")

    def warning(self, source: str, message: str) -> None:
        """Say on stderr what is wrong with a recording that is read all the same, and in JSON as well."""
        say(f"cgid: warning: {message}", err=True)
        if self.as_json:
            self._json({"kind": "warning", "source": source, "message": message})

    def delay(self, source: str, behind: float, message: str) -> None:
        """Say on stderr how far the answers are behind a live stream [s], and in JSON as well."""
        say(f"cgid: warning: {source}: {behind:.1f} s behind: {message}", err=True)
        if self.as_json:
            self._json({"kind": "delay", "source": source, "behind_s": behind, "message": message})

    def _json(self, content: dict[str, Any]) -> None:
        print_json(content, version=ANSWERS_VERSION)


class RecordingTally:
    """How many answers of a recording were what."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.labels: Counter[str] = Counter()
        self.marks: Counter[str] = Counter()
        self.n_outside = 0

    def add(self, answers: Iterable[Any]) -> None:
        """Count some more."""
        for answer in answers:
            self.labels[answer.label] += 1
            self.marks.update(marks_of(answer))
            self.n_outside += not answer.in_training_range

    @property
    def total(self) -> int:
        """All answers."""
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


def marks_of(answer: Any) -> list[str]:
    """Return what is special about the frame of an answer, in words."""
    marked = {"overlapping": answer.overlapping, "clipped": answer.clipped, "cut off": answer.cut}
    return [name for name, holds in marked.items() if holds]


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.3f}"

"""Output of predict and monitor: predictions on stdout, messages on stderr; with --json all on stdout, line by line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from cgid._lib.spelling import as_option
from cgid._lib.terminal import counted
from cgid._lib.validation import finite
from cgid.cli.output import print_json, say, warn
from cgid.cli.table import TableOutput
from cgid.errors import BadData
from cgid.units import Column

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import Answer, PredictionSettings
    from cgid.identification.prediction.findings import Finding
    from cgid.identification.prediction.fraction import Switch
    from cgid.identification.prediction.records import RecordingTally
    from cgid.identification.prediction.support import SupportState

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

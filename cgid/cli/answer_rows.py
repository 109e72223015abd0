"""Output of predict and monitor: predictions on stdout, messages on stderr; with --json all on stdout, line by line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from cgid._lib.spelling import as_option
from cgid._lib.terminal import counted
from cgid.cli.output import print_json, say, warn
from cgid.cli.table import TableOutput
from cgid.errors import BadData
from cgid.identification.prediction.records import RecordingTally, Records
from cgid.units import Column

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import Answer, PredictionSettings
    from cgid.identification.prediction.findings import Finding
    from cgid.identification.prediction.fraction import Share, Switch
    from cgid.identification.prediction.support import SupportState

#: Identified impacts from which a gangue fraction is told in words before the end of a recording.
_ENOUGH = 10
#: Columns before and behind those of the answers.
_SOURCE, _OF_DATASETS = Column("source"), (Column("index", dtype="int64"), Column("truth"))


class AnswerLines(Records):
    """Print one row at a time: in a table and in words, or its record as JSON."""

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
    ) -> None:
        super().__init__(*[self._print] * as_json)
        self.as_json, self._only_summary = as_json, only_summary
        self._live, self._clock = live, clock
        #: Whether each fraction and decision has a line of text; else the summary tells the last ones.
        self._has_fractions = live or fractions
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
        columns = [_SOURCE, *answer_columns(model, settings), *_OF_DATASETS * self._datasets]
        if lacking := self._table.begin(columns):
            raise BadData(
                f"{source}: its columns must be those of earlier rows, its model adds {lacking[0].title}; run it alone"
            )

    def holds(self, share: Share) -> bool:
        """Return whether the fraction of a file waits for its end: one of few impacts, or where one line tells all."""
        is_brief = not self.as_json and (share.n_impacts < _ENOUGH or not self._has_fractions)
        return self._only_summary or is_brief

    def answer(self, source: str, answer: Answer, kind: str = "impact", **more: Any) -> None:
        """Print the prediction for an impact or window; `more`: its number in its channel, its index or its truth."""
        if not self._has_rows:
            return
        if not self.as_json:
            self._table.add({"source": source, **answer.row, "problem": answer.problem or None, **more})
        super().answer(source, answer, kind, **more)

    def share(self, source: str, name: str, state: SupportState) -> None:
        """Print the gangue fraction of a window of a source, or of its channel as `name`."""
        super().share(source, name, state)
        share = state.share
        unknown = f", {share.n_unknown} more unknown" if share.n_unknown else ""
        any_seam = ", any seam" if share.basis.is_any_seam else ""
        fraction = (
            f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f}{any_seam})" if share.is_known else "not known"
        )
        answers = counted(share.n_impacts, "answer") + unknown
        text = f"gangue fraction {fraction} from {share.start:.6g} to {share.time:.6g} s, {answers}"
        self._last[name] = text
        self._note(f"{name}: {text}")

    def turn(self, source: str, name: str, state: SupportState, turn: Switch, costs: Mapping[str, float]) -> None:
        """Print that continuing costs more than shutting, or less again."""
        super().turn(source, name, state, turn, costs)
        share, limit = turn.share, 1 / (1 + costs["dilution_cost"])
        word, other = ("SHUT", "going on") if turn.shut else ("OPEN", "staying shut")
        self._turns.setdefault(name, []).append(f"{word} at {turn.time:.6g} s")
        self._note(
            f"{word} {turn.time:.6g} s: {other} is expected to lose more coal than it wins, at a gangue fraction of "
            f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f}) beside the limit of {limit:.2f}  {name}"
        )

    def summary(self, source: str, tally: RecordingTally, duration: float, start_time: Any = None) -> None:
        """Print the summary of a recording."""
        super().summary(source, tally, duration, start_time)
        message = f"{source}: {tally.text()} in {duration:.6g} s"
        if not self._has_fractions:
            told = {name: "; ".join([text, *self._turns.pop(name, [])]) for name, text in self._last.items()}
            message += "".join(f"; {text}" if name == source else f"\n{name}: {text}" for name, text in told.items())
        self._last.clear()
        for one in message.splitlines() if not self.as_json else ():
            say(one, err=not self._only_summary)

    def finding(self, source: str, finding: Finding, n_channels: int = 1, *, withdrawn: bool = False) -> None:
        """Print what begins or ends, on stderr and in JSON; `withdrawn`: the decision of a support with it."""
        super().finding(source, finding, n_channels)
        line = finding.line(source, n_channels, as_option)
        if finding.is_note:
            if not self.as_json and finding.kind not in self._noted:
                say(line, err=True)
            self._noted.add(finding.kind)
        elif line:
            warn(line + ", so the decision is withdrawn" * withdrawn)

    def _note(self, message: str) -> None:
        """Print a message in place of JSON: on stderr, unless it is all that is printed."""
        if self._has_fractions and not self.as_json:
            say(message, err=not self._only_summary)

    def _print(self, record: dict[str, Any]) -> None:
        """Print a record as a line of JSON; its time of day if that was asked for, or tells how old a live one is."""
        if not (self._clock or (self._live and "ground" in record)):
            record = {name: value for name, value in record.items() if name != "wall_time"}
        print_json(record, record["version"])

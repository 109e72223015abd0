"""The answers for a recording as they are printed: impacts or windows, shares, turns, a summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from cgid.cli.answer_lines import AnswerLines, RecordingTally
from cgid.cli.asked import Asked

#: So many rows wait at most for one that can be measured.
_MOST_HELD = 1000
#: So many channels without impacts are told one by one.
_MOST_SILENT = 3


class Telling:
    """Prints the answers for the channels of one recording that one model answers for.

    Parameters
    ----------
    source : str
        The recording's name.
    model : Model
    channels : sequence of str
    sampling_rate : float
        [Hz].
    asked : Asked
    lines : AnswerLines
    keep : bool
        Whether answers, shares and turns are kept.
    always : bool
        Whether all leaves at once: else rows wait for one that can be measured, and shares for a second row.
    """

    def __init__(
        self,
        source: str,
        model: Any,
        channels: Sequence[str],
        sampling_rate: float,
        asked: Asked,
        lines: AnswerLines,
        *,
        keep: bool = False,
        always: bool = False,
    ) -> None:
        from cgid.identification.answering.shutting import Turn
        from cgid.identification.answering.watch import CavingWatch
        from cgid.identification.answering.windows import answering_channels, independence

        self.source, self.lines = source, lines
        self.kind = "window" if model.kind == "window" else "impact"
        asked.require_use(self.kind)
        self.tally = RecordingTally(self.kind)
        self.channels = answering_channels(model, channels)
        self.answers: list[Any] = []
        self.shares: list[Any] = []
        self.turns: list[Any] = []
        self._keep, self._always, self._turn, self._asked = keep, always, Turn, asked
        self._numbers: Counter[str] = Counter()
        self._measured = always
        self._held_answers: list[Any] = []
        self._held_shares: list[Any] = []
        self._watch: CavingWatch | None = None
        self.threshold: float | None = None
        if asked.shares_asked or asked.settings.serve(model):
            weight = independence(model, asked.question().vote_time)
            self._watch = CavingWatch(model, self.channels, asked.settings, weight)
            self.threshold = self._watch.threshold

    def feed(self, answers: Sequence[Any], until: float) -> None:
        """Print the next answers, and the shares of windows that end by now [s]."""
        self.tally.add(answers)
        if self._keep:
            self.answers += answers
        self._measured = self._measured or any(answer.probabilities for answer in answers)
        self._held_answers += answers
        if self._measured or len(self._held_answers) > _MOST_HELD:
            self._print_answers()
        if self._watch is not None:
            self._tell(self._watch.feed(answers, until))

    def finish(self, duration: float, silent: Sequence[str] = (), start_time: Any = None) -> None:
        """Print what is left to tell at the end of a recording of so long [s], and which channels were silent.

        Raises
        ------
        BadData
            There was nothing, or nothing could be measured; never of a live stream.
        """
        from cgid.errors import BadData

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
            self._tell(self._watch.finish(duration))
        if self.tally.total > 1 or self._always:
            self.lines.summary(self.source, self.tally, duration, start_time)

    def name(self, channel: str) -> str:
        """Return source and channel in one word; the first channel has no name in JSON, as ever."""
        plain = channel == "1" and (self.lines.as_json or len(self.channels) == 1)
        return self.source if plain else f"{self.source} channel {channel}"

    def _print_answers(self) -> None:
        for answer in self._held_answers:
            self._numbers[answer.channel] += 1
            self.lines.answer(self.name(answer.channel), self._numbers[answer.channel], answer, self.kind)
        self._held_answers = []

    def _tell(self, told: Iterable[Any]) -> None:
        """Print shares and turns; a recording of one impact has none unless they were asked for."""
        self._held_shares += told
        if not (self._always or self._asked.shares_asked or self.tally.total > 1):
            return
        for one in self._held_shares:
            if self._keep:
                (self.turns if isinstance(one, self._turn) else self.shares).append(one)
            if isinstance(one, self._turn):
                self.lines.turn(self.name(one.share.channel), one, self._asked.settings.gangue_cost)
            elif one.n_impacts or one.n_unknown or self._always:
                self.lines.share(self.name(one.channel), one)
        self._held_shares = []

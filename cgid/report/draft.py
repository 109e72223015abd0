"""A report in the making: what passes by while a recording is answered block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from numpy.typing import NDArray

from cgid.identification.answers import Answer
from cgid.identification.model import Model
from cgid.identification.share import Share
from cgid.identification.shutting import Turn
from cgid.overview import OverviewStream
from cgid.plots import MOST_CHANNELS
from cgid.recordings import Channel, RecordingFile
from cgid.report.content import Report, model_facts, recording_facts


class ReportDraft:
    """Gathers what a report tells of those channels of a recording that one model answers for.

    Parameters
    ----------
    recording : RecordingFile
    model : Model
    model_name : str
        Of its file.
    rows : sequence of int
        Numbers of the channels of the recording that are in the blocks, from 0.
    threshold : float, optional
        The share above which going on costs more than it brings.
    """

    def __init__(
        self,
        recording: RecordingFile,
        model: Model,
        model_name: str,
        rows: Sequence[int],
        threshold: float | None = None,
    ) -> None:
        self._recording, self._model, self._model_name = recording, model, model_name
        self._threshold = threshold
        # The blocks are in the unit of the model by the time it answers for them.
        names = [recording.channels[row].name for row in rows]
        self._channels = [Channel(name=name, unit=model.unit) for name in names[:MOST_CHANNELS]]
        self._stream = OverviewStream(recording.sampling_rate, len(self._channels), recording.source)
        self._answers: list[Answer] = []
        self._shares: list[Share] = []
        self._turns: list[Turn] = []

    def passing(self, blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Return an iterator over the blocks (n_channels, n_samples), in the model's unit, that looks at each."""
        return self._stream.passing(blocks)

    def answered(self, answers: Iterable[Answer]) -> None:
        """Take the next answers, in order of time."""
        self._answers += answers

    def told(self, said: Iterable[Share | Turn]) -> None:
        """Take the next shares and turns."""
        for one in said:
            if isinstance(one, Turn):
                self._turns.append(one)
            else:
                self._shares.append(one)

    def report(self) -> Report:
        """Return the report, once all blocks have passed.

        Raises
        ------
        BadData
            None has.
        """
        overview = self._stream.overview()
        return Report(
            source=self._recording.source,
            recording=recording_facts(self._recording, overview, self._channels),
            model=model_facts(self._model, self._model_name),
            overview=overview,
            channels=self._channels,
            answers=self._answers,
            shares=self._shares,
            turns=self._turns,
            threshold=self._threshold,
            warnings=self._recording.warnings,
            unit_of_decision="window" if self._model.kind == "window" else "impact",
        )

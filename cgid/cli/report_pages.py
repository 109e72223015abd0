"""The page that --report asks for: what was printed of each recording, with its pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cgid.cli.asked import Asked
from cgid.cli.recording_answers import Passing
from cgid.cli.telling import Telling


class Pages:
    """What the page is to hold, gathered while recordings are read.

    Parameters
    ----------
    path : str
        Of the page.
    overwrite : bool
        Whether an old one may be replaced.

    Raises
    ------
    CannotCreate
        There may be no page of this name.
    MissingExtra
        matplotlib is not installed.
    """

    def __init__(self, path: str, overwrite: bool) -> None:
        from cgid.files import check_new
        from cgid.plots import require_matplotlib
        from cgid.report import ENDINGS

        self._path = check_new(Path(path), "a report", ENDINGS, overwrite=overwrite)
        self._overwrite = overwrite
        self._reports: list[Any] = []
        require_matplotlib()

    def drawing(self, recording: Any, rows: list[int]) -> Drawing:
        """Return what looks at the blocks of some channels of a recording."""
        return Drawing(recording, rows)

    def add(self, recording: Any, drawing: Any, model: Any, asked: Asked, telling: Telling) -> None:
        """Take what was told of a recording."""
        from cgid.report import Report, model_facts, recording_facts

        overview = drawing.stream.overview()
        report = Report(
            source=recording.source,
            recording=recording_facts(recording, overview, drawing.channels),
            model=model_facts(model, asked.models.name(model)),
            overview=overview,
            channels=drawing.channels,
            answers=telling.answers,
            shares=telling.shares,
            turns=telling.turns,
            threshold=telling.threshold,
            warnings=recording.warnings,
            unit_of_decision=telling.kind,
        )
        self._reports.append(report)

    def write(self) -> bool:
        """Write the page; return whether there was something to write."""
        from cgid.report import write_report

        if self._reports:
            write_report(self._path, self._reports, overwrite=self._overwrite)
        return bool(self._reports)


class Drawing(Passing):
    """Draws the first channels of a recording while its blocks pass by."""

    def __init__(self, recording: Any, rows: list[int]) -> None:
        from cgid.measure.overview import OverviewStream
        from cgid.plots import MOST_CHANNELS

        super().__init__()
        self.channels = [recording.channels[row] for row in rows[:MOST_CHANNELS]]
        self.stream = OverviewStream(recording.sampling_rate, len(self.channels))

    def see(self, block: Any) -> None:
        """Look at a block, (n_channels, n_samples)."""
        super().see(block)
        self.stream.feed(block[: len(self.channels)])

"""The page that --report asks for: what was printed of each recording, with its pictures.

A recording read block by block, answered by the models that its channels need.

The signals of a dataset, identified batch by batch, and how many of the answers are right.

`cgid predict`: one row for each impact found, the gangue share, a summary.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import click

from cgid.cli.answer_rows import AnswerLines, Telling
from cgid.cli.answering import Asked, Models, answering_options, asked_of, warn_of_rate
from cgid.cli.options import (
    PATH,
    asks_for_whole_dataset,
    dead_time_in_seconds,
    each_file,
    open_file,
    read_signals,
    recording_options,
)
from cgid.cli.output import say
from cgid.errors import CgidError


class Passing:
    """Counts the samples of blocks that pass by."""

    def __init__(self) -> None:
        self.n_samples = 0

    def see(self, block: Any) -> None:
        """Look at a block, (n_channels, n_samples)."""
        self.n_samples += block.shape[1]


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


def answer_recording(recording: Any, asked: Asked, lines: AnswerLines, pages: Pages | None = None) -> None:
    """Print the answers for a recording, which is read block by block: once for each model that its channels need.

    Raises
    ------
    CgidError
        It cannot be read, is of another quantity, or nothing in it can be measured.
    """
    groups = _models_of(recording, asked)
    errors: list[CgidError] = []
    try:
        for model, rows in groups:
            try:
                _answer_channels(recording, model, rows, asked, lines, pages)
            except CgidError as error:
                errors.append(error)
    finally:
        for warning in recording.warnings:
            lines.warning(recording.source, warning)
    if len(errors) == len(groups):
        raise errors[0]
    # Channels of another quantity do not hide those that can be answered for.
    for unanswered in errors:
        lines.warning(recording.source, str(unanswered))


def _answer_channels(
    recording: Any, model: Any, rows: list[int], asked: Asked, lines: AnswerLines, pages: Pages | None
) -> None:
    """Print the answers for those channels of a recording that one model answers for."""
    from cgid.identification.stream import identify_blocks, model_blocks

    names, rate, source = [recording.channels[row].name for row in rows], recording.sampling_rate, recording.source
    passing = Passing() if pages is None else pages.drawing(recording, rows)
    blocks = model_blocks(recording, model, rows, mass=asked.mass, invert=asked.invert, seen=passing.see)
    steps = identify_blocks(blocks, rate, model, names, asked.question(), source)
    asked.warn_of_sensor(source, model)
    telling = Telling(source, model, names, rate, asked, lines, keep=pages is not None)
    warn_of_rate(telling.name(telling.channels[0]), rate, model)
    silent: tuple[str, ...] = ()
    for step in steps:
        telling.feed(step.answers, step.until)
        silent += step.silent
        for warning in step.warnings:
            lines.warning(source, warning)
    telling.finish(passing.n_samples / rate, silent, recording.start_time)
    if pages is not None:
        pages.add(recording, passing, model, asked, telling)


def _models_of(recording: Any, asked: Asked) -> list[tuple[Any, list[int]]]:
    """Return the models that answer for the channels of a recording, each with the numbers of its channels."""
    found: dict[int, tuple[Any, list[int]]] = {}
    for row, channel in enumerate(recording.channels):
        model = asked.models.of(channel.quantity)
        found.setdefault(id(model), (model, []))[1].append(row)
    return list(found.values())


def identify_dataset(
    path: str, models: Models, drop_height: float | None, how: Mapping[str, Any], invert: bool, lines: AnswerLines
) -> None:
    """Answer for every signal of a dataset; `how` is what `identify_frames` takes besides."""
    from cgid.errors import BadData
    from cgid.identification.answers import identify_frames
    from cgid.store import Dataset
    from cgid.units import UNITS

    dataset = Dataset(path)
    model = models.of(dataset.quantity)
    if dataset.quantity != model.quantity:
        raise BadData(
            f"{path}: the quantity must be the model's, {model.quantity} [{model.unit}], got {dataset.quantity} "
            f"[{dataset.unit}]; train a model on such signals"
        )
    units = UNITS[dataset.quantity]
    factor = units[dataset.unit] / units[model.unit] * (-1 if invert else 1)
    warn_of_rate(path, dataset.sampling_rate, model)
    number, tally = count(), _Tally()
    for batch in dataset.batches():
        answers = identify_frames(
            batch.signals if factor == 1 else batch.signals * factor,
            batch.sampling_rate,
            model,
            pre_trigger=batch.pre_trigger,
            drop_height=heights(path, batch, model, drop_height),
            **how,
        )
        for answer, truth, specimen in zip(answers, batch.labels.tolist(), batch.specimen.tolist(), strict=True):
            lines.answer(f"{path} index {next(number)}", 1, answer, truth=truth)
            tally.add(answer, truth, specimen)
    if tally.measured:
        say(f"{path}: {tally.summary(len(dataset))}", err=True)


def heights(path: str, batch: Any, model: Any, given: float | None) -> Any:
    """Return the drop heights that a batch stores, for a model that needs them; else the one given."""
    from cgid.errors import InvalidValue
    from cgid.identification.drop_height import drop_heights

    stored = drop_heights(batch) if "drop_height" in model.known else None
    if stored is not None and given is not None:
        raise InvalidValue(f"{path}: --drop-height must be left out, this dataset stores that of each impact")
    return given if stored is None else stored


@dataclass
class _Tally:
    """How many of the labelled impacts of a dataset were answered how."""

    measured: int = 0
    right: int = 0
    unknown: int = 0
    answered_right: int = 0
    covered: int | None = None
    specimens: set[int] = field(default_factory=set)

    def add(self, answer: Any, truth: str, specimen: int) -> None:
        self.specimens.add(specimen)
        self.unknown += answer.label == "unknown"
        self.answered_right += answer.label == truth
        if not answer.probabilities:
            return
        self.measured += 1
        # Judged by the most probable label, so that the figure is that of the model card.
        self.right += max(answer.probabilities, key=lambda label: answer.probabilities[label]) == truth
        if answer.prediction_set is not None:
            self.covered = (self.covered or 0) + (truth in answer.prediction_set)

    def summary(self, n_impacts: int) -> str:
        """Return the figures in one line."""
        from cgid.identification.share import wilson_interval

        share = self.right / self.measured
        # Impacts of one specimen are no independent trials.
        low, high = wilson_interval(share, min(self.measured, len(self.specimens)))
        text = (
            f"accuracy of the most probable label {share:.4f} (95 % interval {low:.4f} to {high:.4f}) "
            f"on {self.measured} of {n_impacts} labelled impacts; {self.unknown} answered unknown"
        )
        if self.covered is None:
            return text
        answered = n_impacts - self.unknown
        right = f", {self.answered_right / answered:.4f} of the {answered} other answers are right" if answered else ""
        return f"{text}{right}; prediction sets hold the truth in {self.covered / self.measured:.4f}"


@click.command(short_help="Identify the material of the impacts in recordings.")
@click.argument("files", type=PATH, nargs=-1, metavar="FILE...")
@click.option("--sample", is_flag=True, help="Use the recording that comes with cgid.")
@answering_options
@click.option(
    "--report", type=PATH, metavar="PAGE", help="Write pictures and answers of the recordings as one page, .html."
)
@click.option("--overwrite", is_flag=True, help="Replace an old report.")
@recording_options
def predict(
    files: tuple[str, ...],
    sample: bool,
    report: str | None,
    overwrite: bool,
    as_json: bool,
    dead_time: float | None,
    strict: bool,
    **options: Any,
) -> int:
    """Identify the material of every impact in FILEs: recordings or datasets; - is stdin.

    Without --model a force is answered by the default model of pulses, an acceleration by that of vibrations; with
    --mass an acceleration is that of the striker, and becomes a force. A model of windows answers for each window.

    The label is "unknown" when the impact lies outside of what the model was trained on (novelty above 1), or with
    --coverage when several labels, or none, are left.

    Recordings of several impacts have a gangue share over a sliding window, with the interval that holds it with 95 %,
    a line SHUT where going on begins to cost more than it brings, and a summary. Lines of --json have a kind: impact,
    window, share, shut, open, warning, summary.
    """
    from cgid import shipped

    if sample:
        files = (*files, str(shipped.path_of("datasets", shipped.SAMPLE)))
    if not files:
        raise click.UsageError("give at least one FILE, or --sample for the one that comes with cgid")
    asked, reading = asked_of(options, dead_time_in_seconds(dead_time))
    lines, pages = AnswerLines(as_json), None if report is None else Pages(report, overwrite)

    def treat(path: str) -> None:
        if asks_for_whole_dataset(path, mass=asked.mass, **reading):
            identify_dataset(path, asked.models, asked.drop_height, asked.how, asked.invert, lines)
        elif reading["index"] is not None:
            _treat_signal(path, asked, lines, reading)
        else:
            answer_recording(open_file(path, **reading), asked, lines, pages)

    code = each_file(files, treat, strict=strict)
    if pages is not None and pages.write():
        say(f"wrote {report}", err=True)
    return code


def _treat_signal(path: str, asked: Asked, lines: AnswerLines, reading: dict[str, Any]) -> None:
    """Answer for the one signal of a dataset that was asked for."""
    from cgid.errors import BadData
    from cgid.identification.answers import identify, suited
    from cgid.store import Dataset

    (signal,) = read_signals(path, invert=asked.invert, **reading)
    model = asked.models.of(signal.quantity)
    fitting = suited(signal, model, asked.mass)
    warn_of_rate(fitting.name, fitting.sampling_rate, model)
    height = heights(path, Dataset(path).impact(reading["index"]), model, asked.drop_height)
    (answer,) = identify(fitting, model, drop_height=height, dead_time=asked.dead_time, **asked.how)
    if not answer.probabilities:
        raise BadData(f"{fitting.name}: {answer.problem}")
    lines.answer(fitting.name, 1, answer)

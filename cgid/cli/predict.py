"""`cgid predict`: a table of detected impacts, the gangue fraction, a summary; and the page of --report."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid import shipped
from cgid._lib.terminal import counted
from cgid.cli.answer_rows import AnswerLines
from cgid.cli.answering import Models, model_option, settings_of, settings_with_coal
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, json_option
from cgid.cli.output import FileErrors, progress_bar, say
from cgid.cli.reading import CHAIN, ReadingOptions, given_options, reading_options
from cgid.cli.table import TableOutput, output_options
from cgid.cli.watching import coal_option, labelled_option
from cgid.errors import BadData, CgidError, InvalidValue

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import Answer, PredictionSettings
    from cgid.identification.prediction.findings import Finding
    from cgid.identification.prediction.records import RecordingRows
    from cgid.identification.training.manifest import Manifest
    from cgid.measure.overview import Overview
    from cgid.plots.report import Report
    from cgid.recordings import RecordingFile
    from cgid.recordings.recording import Channel
    from cgid.signals import Signal


def _report(
    recording: RecordingFile,
    channels: list[Channel],
    overview: Overview,
    model: StoredModel,
    model_name: str,
    rows: RecordingRows,
) -> Report:
    """Return the page content of a recording: its pictures, and the printed predictions."""
    from cgid.plots.report import Report, model_facts, recording_facts

    stated = shlex.join([word for words in given_options() for word in words])
    return Report(
        source=recording.source,
        recording=recording_facts(recording, overview, channels) | ({"stated": stated} if stated else {}),
        model=model_facts(model, model_name, rows.settings.shares.gangue),
        overview=overview,
        channels=channels,
        answers=rows.answers,
        shares=rows.shares,
        turns=rows.turns,
        states=rows.states,
        whole=rows.whole(overview.duration),
        threshold=rows.threshold,
        findings=[*map(_of_reading, recording.messages), *rows.findings],
        unit_of_decision=rows.kind,
    )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class _Prediction:
    """The settings for all files; `reports` collects the page content of each recording, if requested."""

    models: Models
    settings: PredictionSettings
    reading: ReadingOptions
    lines: AnswerLines
    reports: list[Report] | None
    joint: tuple[str, ...] = ()  # channels joined by "+", as on the command line
    labelled: Manifest | None = None

    def recording(self, recording: RecordingFile) -> None:
        """Print the predictions for a recording, read block by block, once for each model that its channels need."""
        groups: dict[str | None, tuple[StoredModel, list[int]]] = {}
        for number, channel in enumerate(recording.channels):
            model = self.models.of(channel.quantity)
            groups.setdefault(self.models.key(channel.quantity), (model, []))[1].append(number)
        errors: list[CgidError] = []
        same_beam = self.reading.beams(recording)
        try:
            for model, numbers in groups.values():
                try:
                    self._channels(recording, model, numbers, same_beam)
                except CgidError as error:
                    errors.append(error)
        finally:
            for text in recording.messages:
                self.lines.finding(recording.source, _of_reading(text))
        if len(errors) == len(groups):
            raise errors[0]
        # Channels of another quantity must not hide those with predictions.
        for unanswered in errors:
            self.lines.finding(recording.source, _of_reading(str(unanswered).removeprefix(f"{recording.source}: ")))

    def _channels(
        self, recording: RecordingFile, model: StoredModel, numbers: list[int], same_beam: tuple[tuple[str, ...], ...]
    ) -> None:
        """Print the predictions for the channels of a recording that use this model."""
        from cgid.identification.prediction.pipeline import Pipeline
        from cgid.identification.prediction.records import RecordingRows

        source, rate = recording.source, recording.sampling_rate
        channels = [recording.channels[number] for number in numbers]
        names = [channel.name for channel in channels]
        own = tuple(group for group in same_beam if set(group) & set(names))
        if mixed := ["+".join(group) for group in own if not set(group) <= set(names)]:
            raise InvalidValue(f"{source}: --same-beam must name channels of one quantity, got {mixed[0]}; correct it")
        settings = replace(self.settings, same_beam=own)
        if self.labelled is not None:
            settings = settings_with_coal(settings, self.labelled, recording.source, recording.channels, model)
        together = [one for one in self.joint if one not in names]
        if together and model.together == 1 and not own:
            raise InvalidValue(
                f"{source}: --channel must name one channel each time, this model uses none together, got "
                f"{together[0]}; give --same-beam {together[0]} if they are on one beam, else --channel for each"
            )
        pipeline = Pipeline(model, channels, rate, settings, source)

        def helped(finding: Finding) -> Finding:
            from cgid.cli.hints import NextSteps  # most recordings have no finding

            # The next command cannot read a pipe again.
            file = "RECORDING" if source == "stdin" else source
            every = [channel.name for channel in recording.channels]
            return NextSteps(pipeline.diagnosis, rate, file, *given_options(), channels=every).of(finding)

        blocks: Iterable[Any] = recording.blocks(gaps=True)
        if len(channels) < len(recording.channels):
            blocks = (block[numbers] for block in blocks)
        pictures = None
        if self.reports is not None:
            from cgid.measure.overview import OverviewStream
            from cgid.plots.recording import MAX_CHANNELS

            channels = channels[:MAX_CHANNELS]
            pictures = OverviewStream(rate, len(channels))
        rows = RecordingRows(pipeline, self.lines, helped, keep=pictures is not None)
        with progress_bar(recording.n_samples, "samples", "predicting") as progress:
            seen = 0
            for step in pipeline.steps(blocks, marked=None if pictures is None else pictures.watching):
                rows.feed(step)
                progress(pipeline.n_seen - seen)
                seen = pipeline.n_seen
        rows.finish(recording.start_time)
        pipeline.require()
        if self.reports is not None and pictures is not None:
            name = self.models.name(model)
            self.reports.append(_report(recording, channels, pictures.overview(), model, name, rows))

    def dataset(self, path: str) -> None:
        """Print the prediction for every signal of a dataset, and the accuracy."""
        from cgid.cli.hints import NextSteps
        from cgid.identification.prediction.batches import identify_batches
        from cgid.identification.prediction.diagnosis import Diagnosis
        from cgid.identification.prediction.telling import of_model
        from cgid.store import Dataset

        dataset = Dataset(path)
        model = self.models.of(dataset.quantity)
        tally, number = _Tally(model.labels), count()
        diagnosis = Diagnosis(model, dataset.sampling_rate, labelled=True, watched=False)
        steps = NextSteps(diagnosis, dataset.sampling_rate, path, *given_options(), labelled=True)
        with progress_bar(len(dataset), "signals", "predicting") as progress:
            for batch, answers in identify_batches(dataset.batches(), model, self.settings, path):
                if not tally.specimens:
                    for one in of_model(model, dataset.sampling_rate, self.settings):
                        self.lines.finding(path, one)
                    self.lines.begin(path, model, self.settings)
                diagnosis.add(answers)
                truths = zip(answers, batch.labels.tolist(), batch.specimen.tolist(), strict=True)
                for answer, truth, specimen in truths:
                    self.lines.answer(path, answer, index=next(number), truth=truth)
                    tally.add(answer, truth, specimen)
                progress(len(batch))
        if tally.measured or tally.foreign:
            say(f"{path}: {tally.summary(len(dataset))}", err=True)
        for one in diagnosis.findings():
            self.lines.finding(path, steps.of(one))

    def dataset_signal(self, path: str, index: int, signal: Signal) -> None:
        """Print the prediction for one signal of a dataset."""
        from cgid.identification.prediction import identify, suited
        from cgid.identification.prediction.batches import require_one_signal
        from cgid.identification.prediction.telling import of_model

        require_one_signal(self.settings, path)
        model = self.models.of(signal.quantity)
        fitting = suited(signal, model, self.settings.mass)
        for one in of_model(model, fitting.sampling_rate, self.settings):
            self.lines.finding(fitting.name, one)
        (answer,) = identify(fitting, model, self.settings)
        if not answer.probabilities:
            raise BadData(f"{fitting.name}: {answer.problem}")
        self.lines.begin(path, model, self.settings)
        self.lines.answer(path, answer, index=index)


def _of_reading(text: str) -> Finding:
    from cgid.identification.prediction.findings import Finding

    return Finding(kind="reading", fields={"text": text})


@dataclass(eq=False, repr=False)
class _Tally:
    """Counts of the predictions for the labelled impacts of a dataset."""

    labels: tuple[str, ...]  # of the model
    foreign: Counter[str] = field(default_factory=Counter)  # impacts by label that the model lacks
    measured: int = 0
    right: int = 0
    unknown: int = 0
    answered_right: int = 0
    covered: int | None = None
    specimens: set[int] = field(default_factory=set)

    def add(self, answer: Answer, truth: str, specimen: int) -> None:
        self.specimens.add(specimen)
        self.unknown += answer.label == "unknown"
        self.answered_right += answer.label == truth
        if truth not in self.labels:
            self.foreign[truth] += 1
        if truth in self.foreign or not answer.probabilities:
            return
        self.measured += 1
        # The most probable label is used, so that the accuracy agrees with the model card.
        self.right += max(answer.probabilities, key=lambda label: answer.probabilities[label]) == truth
        if answer.prediction_set is not None:
            self.covered = (self.covered or 0) + (truth in answer.prediction_set)

    def summary(self, n_impacts: int) -> str:
        """Return the counts in one line."""
        from cgid.identification.model.confusion import wilson_interval

        counts = f"{self.unknown} unknown"
        if self.foreign:
            names = ", ".join(self.foreign)
            counts += f"; {counted(self.foreign.total(), 'impact')} of labels that the model lacks ({names}) not judged"
        if not self.measured:
            return f"no accuracy, {counts}"
        share = self.right / self.measured
        # Impacts of one specimen are not independent trials.
        low, high = wilson_interval(share, min(self.measured, len(self.specimens)))
        text = (
            f"accuracy of the most probable label {share:.4f} (95 % interval {low:.4f} to {high:.4f}) "
            f"on {self.measured} of {counted(n_impacts, 'labelled impact')}; {counts}"
        )
        if self.covered is None:
            return text
        answered = n_impacts - self.unknown
        others = counted(answered, "other answer")
        right = f", {self.answered_right / answered:.4f} of {others} right" if answered else ""
        return f"{text}{right}; prediction sets contain the truth in {self.covered / self.measured:.4f}"


@click.command(
    cls=Command, short_help="Identify the material of the impacts in recordings.", example="cgid predict --sample"
)
@click.argument("files", type=PATH, nargs=-1, metavar="FILE...")
@click.option("--sample", is_flag=True, help="Use the bundled sample recording.")
@model_option
@reading_options(*CHAIN, "same_beam")
@coal_option
@labelled_option
@click.option("--fractions", is_flag=True, help="Print the gangue fraction twice a window, and each SHUT and OPEN.")
@click.option("--summary", is_flag=True, help="Print no rows, but to --output.")
@click.option("--report", type=OUTPUT, metavar="PAGE", help="Write a page (.html) with pictures and predictions.")
@output_options
@json_option
def predict(
    files: tuple[str, ...],
    sample: bool,
    model_path: str | None,
    coal_until: float | None,
    fractions: bool,
    summary: bool,
    report: str | None,
    labelled: str | None,
    output: str | None,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> int:
    """Identify the material of every impact in FILEs: recordings, folders of them, or datasets; - is stdin.

    Stdout is one CSV table, with the probability of each label as p_LABEL. The label is "unknown" if the impact is out
    of distribution (novelty above 1). A summary on stderr has the counts, the gangue fraction at the end with its 95 %
    interval, and when to shut the window. With --json all of it goes to stdout in lines that have a kind.
    """
    from cgid.recordings import is_dataset

    if not files and not sample:
        raise click.UsageError("give at least one FILE, or --sample for the shipped one")
    models, settings = settings_of(reading, model_path, coal_until=coal_until)
    labelled = reading.site.get("labelled") if labelled is None else labelled
    if sample:
        name = shipped.ACCELERATION_SAMPLE if models.expects_acceleration else shipped.SAMPLE
        files = (*files, str(shipped.path_of("datasets", name)))
    if report is not None:
        from cgid.plots.figure import new_picture
        from cgid.plots.report import ENDINGS

        new_picture(report, "a report", ENDINGS, overwrite=overwrite)
    manifest: Manifest | None = None
    if labelled is not None or any(Path(file).is_dir() for file in files):  # manifests take 2 % of a start
        from cgid.identification.training.manifest import read_manifest, recordings_of

        files = tuple(recordings_of(files))
        manifest = None if labelled is None else read_manifest(labelled)
    reading.require_files(files)
    table = TableOutput(output, overwrite=overwrite, as_json=as_json)
    lines = AnswerLines(as_json, table, datasets=any(map(is_dataset, files)), only_summary=summary, fractions=fractions)
    prediction = _Prediction(
        models=models,
        settings=settings,
        reading=reading,
        lines=lines,
        labelled=manifest,
        reports=None if report is None else [],
        joint=tuple(channel for channel in reading.channel if "+" in channel),
    )

    errors = FileErrors(one_output=True)
    with table:
        for path in errors.each(files):
            with errors:
                if reading.wants_complete_dataset(path):
                    prediction.dataset(path)
                elif reading.index is not None:
                    (signal,) = reading.signals(path)
                    prediction.dataset_signal(path, reading.index, signal)
                else:
                    prediction.recording(reading.recording(path))
    if report is not None and prediction.reports:
        from cgid._lib.files import write_whole
        from cgid.plots.report import report_page

        write_whole(report, report_page(prediction.reports).encode(), overwrite=overwrite)
        say(f"wrote {report}", err=True)
    return errors.code

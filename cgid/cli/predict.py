"""`cgid predict`: one row for each impact found, the gangue share, a summary."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.answer_lines import AnswerLines
from cgid.cli.asked import Asked, answering_options, asked_of
from cgid.cli.dataset_answers import heights, identify_dataset
from cgid.cli.model_choice import warn_of_rate
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
from cgid.cli.recording_answers import answer_recording
from cgid.cli.report_pages import Pages


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

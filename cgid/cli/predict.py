"""`cgid predict`: one row for each impact found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import count
from typing import Any

import click

from cgid.cli.options import (
    asks_for_whole_dataset,
    check_dead_time,
    each_file,
    print_json,
    read_signals,
    recording_options,
)


@click.command(short_help="Identify the material of the impacts in recordings.")
@click.argument("files", nargs=-1, metavar="FILE...")
@click.option("--model", "model_path", help="Model file; the default model if not given.")
@click.option("--sample", is_flag=True, help="Use the recording that comes with cgid.")
@click.option("--mass", type=float, help="Mass of the accelerated striker [kg]: force = mass x acceleration.")
@click.option(
    "--cost", "costs", multiple=True, metavar="LABEL=COST", help="What missing this label costs, 1 by default."
)
@recording_options
def predict(
    files: tuple[str, ...],
    model_path: str | None,
    sample: bool,
    mass: float | None,
    costs: tuple[str, ...],
    as_json: bool,
    dead_time: float,
    **reading: Any,
) -> int:
    """Identify the material of every impact in FILEs: CSV or TXT, NPY, WAV, or a dataset; - is stdin.

    The label is "unknown" when the impact lies outside of what the model was trained on (novelty above 1).
    """
    from cgid import shipped
    from cgid.identification.model import Model

    if sample:
        files = (*files, str(shipped.path_of("datasets", shipped.SAMPLE)))
    if not files:
        raise click.UsageError("give at least one FILE, or --sample for the one that comes with cgid")
    model = Model.load(model_path or shipped.path_of("models", shipped.DEFAULT_MODEL))
    weights = dict(_parse_cost(text) for text in costs)
    model.decide(_no_rows(model), weights)
    check_dead_time(dead_time)
    titles = iter([] if as_json else [_ROW.format("time [s]", "label", "probability", "novelty", "source")])

    def treat(path: str) -> None:
        _treat(path, model, weights, mass, dead_time * 1e-3, titles, as_json, reading)

    return each_file(files, treat)


_ROW = "{:>12}  {:<12} {:>11}  {:>8}  {}"


def _treat(
    path: str,
    model: Any,
    costs: Mapping[str, float],
    mass: float | None,
    dead_time: float,
    titles: Iterator[str],
    as_json: bool,
    reading: dict[str, Any],
) -> None:
    from cgid.errors import BadData
    from cgid.identification.answers import identify, suited

    if asks_for_whole_dataset(path, mass=mass, **reading):
        _treat_dataset(path, model, costs, titles, as_json, reading["invert"])
        return
    for signal in read_signals(path, **reading):
        fitting = suited(signal, model, mass)
        _warn_of_rate(fitting.name, fitting.sampling_rate, model)
        answers = identify(fitting, model, costs=costs, dead_time=dead_time)
        if not any(answer.probabilities for answer in answers):
            more = f" (and so for all {len(answers)} impacts)" if len(answers) > 1 else ""
            raise BadData(f"{fitting.name}: {answers[0].problem}{more}")
        _print(fitting.name, answers, titles, as_json)


def _treat_dataset(
    path: str, model: Any, costs: Mapping[str, float], titles: Iterator[str], as_json: bool, invert: bool
) -> None:
    """Answer for every signal of a dataset, batch by batch, and count the right answers."""
    from cgid.errors import BadData
    from cgid.identification.answers import identify_frames
    from cgid.identification.interval import wilson_interval
    from cgid.store import Dataset

    dataset = Dataset(path)
    if dataset.unit != model.unit:
        raise BadData(
            f"{path}: the unit must be the model's, {model.unit}, got {dataset.unit}; train a model on such signals"
        )
    _warn_of_rate(path, dataset.sampling_rate, model)
    number, right, measured, unknown = count(), 0, 0, 0
    specimens: set[int] = set()
    for batch in dataset.batches():
        frames = -batch.signals if invert else batch.signals
        answers = identify_frames(frames, batch.sampling_rate, model, pre_trigger=batch.pre_trigger, costs=costs)
        specimens.update(batch.specimen.tolist())
        for answer, truth in zip(answers, batch.labels.tolist(), strict=True):
            _print(f"{path} index {next(number)}", [answer], titles, as_json, truth)
            unknown += answer.label == "unknown"
            # Judged by the most probable label, so that the figure is that of the model card.
            if answer.probabilities:
                measured += 1
                right += max(answer.probabilities, key=lambda label: answer.probabilities[label]) == truth
    if measured:
        # Impacts of one specimen are no independent trials.
        low, high = wilson_interval(right / measured, min(measured, len(specimens)))
        click.echo(
            f"{path}: accuracy of the most probable label {right / measured:.4f} "
            f"(95 % interval {low:.4f} to {high:.4f}) on {measured} of {len(dataset)} labelled impacts; "
            f"{unknown} answered unknown",
            err=True,
        )


def _print(source: str, answers: Iterable[Any], titles: Iterator[str], as_json: bool, truth: str | None = None) -> None:
    for title in titles:  # once, above the first row
        click.echo(title)
    for number, answer in enumerate(answers, start=1):
        if as_json:
            content = {
                "source": source,
                "impact": number,
                "time_s": answer.time,
                "label": answer.label,
                "probability": answer.probability,
                "probabilities": dict(answer.probabilities),
                "novelty": answer.novelty,
                "in_training_range": answer.in_training_range,
                "problem": answer.problem or None,
            }
            print_json(content | ({} if truth is None else {"truth": truth}))
            continue
        note = f"  ({answer.problem})" if answer.problem else ""
        note += "" if truth is None else f"  truth: {truth}"
        probability, novelty = _number(answer.probability), _number(answer.novelty)
        click.echo(_ROW.format(f"{answer.time:.6f}", answer.label, probability, novelty, source + note))


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.3f}"


def _parse_cost(text: str) -> tuple[str, float]:
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--cost must be LABEL=COST such as gangue=3, got {text!r}") from None


def _no_rows(model: Any) -> Any:
    import numpy as np

    return np.empty((0, len(model.labels)))


def _warn_of_rate(name: str, rate: float, model: Any) -> None:
    low, high = model.sampling_rates
    if not model.covers(rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        click.echo(f"cgid: warning: {name}: sampled at {rate:g} Hz, the model was trained at {trained} Hz", err=True)

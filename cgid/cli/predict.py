"""`cgid predict`: one row for each impact found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import click

from cgid.cli.options import (
    asks_for_whole_dataset,
    dead_time_in_seconds,
    each_file,
    print_json,
    read_signals,
    recording_options,
)


@dataclass(frozen=True)
class _Asked:
    """What is asked of every file."""

    models: _Models
    decision: Any
    drop_height: float | None
    mass: float | None
    dead_time: float | None
    as_json: bool
    model: Any = None

    def of(self, quantity: str | None) -> _Asked:
        """Return the same with the model for a quantity."""
        return replace(self, model=self.models.of(quantity))

    @property
    def how(self) -> dict[str, Any]:
        """Return the arguments that `identify` and `identify_frames` share."""
        return {name: getattr(self.decision, name) for name in ("costs", "coverage", "class_conditional")}


class _Models:
    """The model asked for; else the default model of each quantity, loaded and checked when a signal needs it.

    Whoever gives a mass or a drop height has a force in mind.
    """

    def __init__(self, path: str | None, mass: float | None, drop_height: float | None, decision: Any) -> None:
        self.drop_height, self.decision = drop_height, decision
        self._models: dict[str | None, Any] = {}
        self._given: Any = None
        if path is not None or mass is not None or drop_height is not None:
            self._given = self._checked(_load(path, drop_height))

    def of(self, quantity: str | None) -> Any:
        """Return the model for signals of a quantity."""
        if self._given is not None:
            return self._given
        if quantity not in self._models:
            self._models[quantity] = self._checked(_default_for(quantity))
        return self._models[quantity]

    def _checked(self, model: Any) -> Any:
        """Return the model if it can decide as asked."""
        from cgid.identification.known import known_columns

        self.decision.check(model)
        if self.drop_height is not None:
            known_columns(model.known, 1, self.drop_height)
        return model


@click.command(short_help="Identify the material of the impacts in recordings.")
@click.argument("files", nargs=-1, metavar="FILE...")
@click.option("--model", "model_path", help="Model file; the default model of the quantity if not given.")
@click.option("--sample", is_flag=True, help="Use the recording that comes with cgid.")
@click.option("--mass", type=float, help="Mass of the accelerated striker [kg]: force = mass x acceleration.")
@click.option("--drop-height", type=float, help="How far the rocks fell [m], for a model that needs to know.")
@click.option(
    "--cost", "costs", multiple=True, metavar="LABEL=COST", help="What missing this label costs, 1 by default."
)
@click.option(
    "--coverage", type=float, help="Reject impacts whose prediction set at this coverage (0.9) is not a single label."
)
@click.option("--class-conditional", is_flag=True, help="The coverage holds for each label, not only for their mix.")
@recording_options
def predict(
    files: tuple[str, ...],
    model_path: str | None,
    sample: bool,
    mass: float | None,
    drop_height: float | None,
    costs: tuple[str, ...],
    coverage: float | None,
    class_conditional: bool,
    as_json: bool,
    dead_time: float | None,
    **reading: Any,
) -> int:
    """Identify the material of every impact in FILEs: CSV or TXT, NPY, WAV, or a dataset; - is stdin.

    Without --model a force is answered by the default model of pulses, an acceleration by that of vibrations; with
    --mass an acceleration is that of the striker, and becomes a force.

    The label is "unknown" when the impact lies outside of what the model was trained on (novelty above 1), or with
    --coverage when several labels, or none, are left.
    """
    from cgid import shipped
    from cgid.identification.answers import Decision

    if sample:
        files = (*files, str(shipped.path_of("datasets", shipped.SAMPLE)))
    if not files:
        raise click.UsageError("give at least one FILE, or --sample for the one that comes with cgid")
    weights = dict(_parse_cost(text) for text in costs)
    decision = Decision(costs=weights, coverage=coverage, class_conditional=class_conditional)
    models = _Models(model_path, mass, drop_height, decision)
    asked = _Asked(models, decision, drop_height, mass, dead_time_in_seconds(dead_time), as_json)
    titles = iter([] if as_json else [_ROW.format("time [s]", "label", "probability", "novelty", "source")])

    def treat(path: str) -> None:
        _treat(path, asked, titles, reading)

    return each_file(files, treat)


_ROW = "{:>12}  {:<12} {:>11}  {:>8}  {}"


def _load(path: str | None, drop_height: float | None) -> Any:
    """Return the model asked for; else the default one, or its sister that knows the drop height."""
    from cgid import shipped
    from cgid.errors import NoInput
    from cgid.identification.model import Model

    if path is None and drop_height is not None:
        with suppress(NoInput):
            return Model.load(shipped.path_of("models", shipped.DROP_HEIGHT_MODEL))
    return Model.load(path or shipped.path_of("models", shipped.DEFAULT_MODEL))


def _default_for(quantity: str | None) -> Any:
    """Return the default model for a quantity; what is neither force nor acceleration is told to be a force's."""
    from cgid import shipped
    from cgid.errors import NoInput
    from cgid.identification.model import Model

    if quantity != "acceleration":
        return Model.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    try:
        return Model.load(shipped.path_of("models", shipped.ACCELERATION_MODEL))
    except NoInput as error:
        raise NoInput(
            f"{error}; or give --model, or --mass KG if the accelerated body is the striker (force = mass x "
            "acceleration)"
        ) from None


def _treat(path: str, asked: _Asked, titles: Iterator[str], reading: dict[str, Any]) -> None:
    from cgid.errors import BadData
    from cgid.identification.answers import identify, suited
    from cgid.recordings import is_dataset

    if asks_for_whole_dataset(path, mass=asked.mass, **reading):
        _treat_dataset(path, asked, titles, reading["invert"])
        return
    everything = asked
    for signal in read_signals(path, **reading):
        asked = everything.of(signal.quantity)
        fitting = suited(signal, asked.model, asked.mass)
        _warn_of_rate(fitting.name, fitting.sampling_rate, asked.model)
        height = asked.drop_height
        if is_dataset(path):
            from cgid.store import Dataset

            height = _heights(path, Dataset(path).impact(reading["index"]), asked)
        answers = identify(fitting, asked.model, drop_height=height, dead_time=asked.dead_time, **asked.how)
        if not any(answer.probabilities for answer in answers):
            more = f" (and so for all {len(answers)} impacts)" if len(answers) > 1 else ""
            raise BadData(f"{fitting.name}: {answers[0].problem}{more}")
        _print(fitting.name, answers, titles, asked.as_json)


def _treat_dataset(path: str, asked: _Asked, titles: Iterator[str], invert: bool) -> None:
    """Answer for every signal of a dataset, batch by batch, and count the right answers."""
    from cgid.errors import BadData
    from cgid.identification.answers import identify_frames
    from cgid.signals import UNITS
    from cgid.store import Dataset

    dataset = Dataset(path)
    asked = asked.of(dataset.quantity)
    if dataset.quantity != asked.model.quantity:
        raise BadData(
            f"{path}: the quantity must be the model's, {asked.model.quantity} [{asked.model.unit}], got "
            f"{dataset.quantity} [{dataset.unit}]; train a model on such signals"
        )
    units = UNITS[dataset.quantity]
    factor = units[dataset.unit] / units[asked.model.unit] * (-1 if invert else 1)
    _warn_of_rate(path, dataset.sampling_rate, asked.model)
    number, tally = count(), _Tally()
    for batch in dataset.batches():
        answers = identify_frames(
            batch.signals if factor == 1 else batch.signals * factor,
            batch.sampling_rate,
            asked.model,
            pre_trigger=batch.pre_trigger,
            drop_height=_heights(path, batch, asked),
            **asked.how,
        )
        for answer, truth, specimen in zip(answers, batch.labels.tolist(), batch.specimen.tolist(), strict=True):
            _print(f"{path} index {next(number)}", [answer], titles, asked.as_json, truth)
            tally.add(answer, truth, specimen)
    if tally.measured:
        click.echo(f"{path}: {tally.summary(len(dataset))}", err=True)


def _heights(path: str, batch: Any, asked: _Asked) -> Any:
    """Return the drop heights that a batch stores, for a model that needs them; else the one given."""
    from cgid.errors import InvalidValue
    from cgid.identification.known import drop_heights

    stored = drop_heights(batch) if "drop_height" in asked.model.known else None
    if stored is not None and asked.drop_height is not None:
        raise InvalidValue(f"{path}: --drop-height must be left out, this dataset stores that of each impact")
    return asked.drop_height if stored is None else stored


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
        from cgid.identification.interval import wilson_interval

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
                "prediction_set": None if answer.prediction_set is None else list(answer.prediction_set),
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


def _warn_of_rate(name: str, rate: float, model: Any) -> None:
    low, high = model.sampling_rates
    if not model.covers(rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        click.echo(f"cgid: warning: {name}: sampled at {rate:g} Hz, the model was trained at {trained} Hz", err=True)

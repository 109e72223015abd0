"""The signals of a dataset, identified batch by batch, and how many of the answers are right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from cgid.cli.answer_lines import AnswerLines
from cgid.cli.model_choice import Models, warn_of_rate
from cgid.cli.output import say


def identify_dataset(
    path: str, models: Models, drop_height: float | None, how: Mapping[str, Any], invert: bool, lines: AnswerLines
) -> None:
    """Answer for every signal of a dataset; `how` is what `identify_frames` takes besides."""
    from cgid.errors import BadData
    from cgid.identification.answers import identify_frames
    from cgid.signals import UNITS
    from cgid.store import Dataset

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
    from cgid.identification.known import drop_heights

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

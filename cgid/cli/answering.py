"""Common to `cgid predict` and `cgid monitor`: the options, the question that they state, and the model."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from cgid.cli.options import PATH
from cgid.cli.output import say

if TYPE_CHECKING:
    from cgid.identification.model import Model
    from cgid.identification.question import Question

F = TypeVar("F", bound=Callable[..., Any])


def answering_options(command: F) -> F:
    """Add the options that choose the model and state the question."""
    options: list[Callable[[Any], Any]] = [
        click.option(
            "--model", "model_path", type=PATH, help="Model file; the default model of the quantity if not given."
        ),
        click.option("--mass", type=float, help="Mass of the accelerated striker [kg]: force = mass x acceleration."),
        click.option("--drop-height", type=float, help="How far the rocks fell [m], for a model that needs to know."),
        click.option(
            "--cost", "costs", multiple=True, metavar="LABEL=COST", help="What missing this label costs, 1 by default."
        ),
        click.option(
            "--coverage",
            type=float,
            help="Reject impacts whose prediction set at this coverage (0.9) is not a single label.",
        ),
        click.option(
            "--class-conditional", is_flag=True, help="The coverage holds for each label, not only for their mix."
        ),
        click.option(
            "--vote", type=float, help="Windows are decided on together over this time [s], 0.5; 0: each alone."
        ),
        click.option(
            "--sensor", multiple=True, metavar="NAME", help="Sensor of the model's reference runs; or one a channel."
        ),
        click.option("--window", type=float, help="The gangue share looks back this long [s], 10."),
        click.option("--gangue", multiple=True, metavar="LABEL", help="Label that is gangue; may be given again."),
        click.option(
            "--gangue-cost", type=float, help="What a drawn gangue costs, in lost coal, 1: says when to shut."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def question_of(
    options: dict[str, Any], dead_time: float | None, **more: Any
) -> tuple[Models, Question, dict[str, Any]]:
    """Return the models, the question, and the remaining options, which say how to read.

    The dead time is in seconds; `more` are fields of the question without an option.
    """
    from cgid import validation
    from cgid.identification.question import Question

    left = dict(options)
    path, vote, window, cost = (left.pop(name) for name in ("model_path", "vote", "window", "gangue_cost"))
    question = Question(
        costs=dict(parse_cost(text) for text in left.pop("costs")),
        coverage=left.pop("coverage"),
        class_conditional=left.pop("class_conditional"),
        drop_height=left.pop("drop_height"),
        mass=left.pop("mass"),
        invert=bool(left.pop("invert")),
        sensors=left.pop("sensor"),
        dead_time=dead_time,
        vote_time=None if vote is None else float(validation.not_negative("--vote", vote, "s")),
        share_time=None if window is None else float(validation.positive("--window", window, "s")),
        gangue=left.pop("gangue"),
        gangue_cost=None if cost is None else float(validation.positive("--gangue-cost", cost)),
        **more,
    )
    return Models(path, question), question, left


def parse_cost(text: str) -> tuple[str, float]:
    """Return label and cost of LABEL=COST."""
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--cost must be LABEL=COST such as gangue=3, got {text!r}") from None


def warn_of_rate(name: str, rate: float, model: Any) -> None:
    """Warn if a model was not trained at a sampling rate [Hz]."""
    low, high = model.sampling_rates
    if not model.covers(rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        say(f"cgid: warning: {name}: sampled at {rate:g} Hz, the model was trained at {trained} Hz", err=True)


class Models:
    """The given model; else the default model of each quantity, loaded and checked when a signal needs it.

    A mass or a drop height implies a force.
    """

    def __init__(self, path: str | None, question: Question) -> None:
        self._path, self._question = path, question
        self._models: dict[str | None, Model] = {}
        self._given: Model | None = None
        if path is not None or question.mass is not None or question.drop_height is not None:
            self._given = self._checked(_load(path, question.drop_height))

    def of(self, quantity: str | None) -> Model:
        """Return the model for signals of a quantity."""
        if self._given is not None:
            return self._given
        if quantity not in self._models:
            self._models[quantity] = self._checked(_default_for(quantity))
        return self._models[quantity]

    def name(self, model: Model) -> str:
        """Return the file name of a model, or which default model it is."""
        if self._path is not None:
            return Path(self._path).name
        return "default model" + (" that knows the drop height" if model.known else f" of {model.quantity}")

    def _checked(self, model: Model) -> Model:
        self._question.check(model)
        return model


def warn_of_model(source: str, name: str, sampling_rate: float, model: Model, question: Question) -> None:
    """Warn if a model was not trained for the sampling rate [Hz] of a signal, or needs the name of its sensor."""
    if model.sensors and not question.sensors:
        known = ", ".join(model.sensors)
        say(
            f"cgid: warning: {source}: the model knows the response of some sensors, nothing makes up for that of "
            f"this one; give --sensor NAME if it is one of {known}",
            err=True,
        )
    low, high = model.sampling_rates
    if not model.covers(sampling_rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        say(f"cgid: warning: {name}: sampled at {sampling_rate:g} Hz, the model was trained at {trained} Hz", err=True)


def _load(path: str | None, drop_height: float | None) -> Model:
    """Return the given model; else the default one, or its variant with the drop height."""
    from cgid import shipped
    from cgid.errors import NoInput
    from cgid.identification.model import Model

    if path is None and drop_height is not None:
        with suppress(NoInput):
            return Model.load(shipped.path_of("models", shipped.DROP_HEIGHT_MODEL))
    return Model.load(path or shipped.path_of("models", shipped.DEFAULT_MODEL))


def _default_for(quantity: str | None) -> Model:
    """Return the default model for a quantity; anything but an acceleration counts as a force."""
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

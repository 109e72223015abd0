"""Which model answers: the one asked for, or the default model of the quantity.

What is asked of a recording: by which model, and how, its impacts are answered.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from cgid.cli.options import PATH
from cgid.cli.output import say


class Models:
    """The model asked for; else the default model of each quantity, loaded and checked when a signal needs it.

    Whoever gives a mass or a drop height has a force in mind.
    """

    def __init__(self, path: str | None, mass: float | None, drop_height: float | None, decision: Any) -> None:
        self.drop_height, self.decision = drop_height, decision
        self._models: dict[str | None, Any] = {}
        self._path = path
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

    def name(self, model: Any) -> str:
        """Return the name of a model's file, or which of the default models it is."""
        if self._path is not None:
            return Path(self._path).name
        return "default model" + (" that knows the drop height" if model.known else f" of {model.quantity}")

    def _checked(self, model: Any) -> Any:
        """Return the model if it can decide as asked."""
        from cgid.identification.drop_height import known_columns

        self.decision.check(model)
        if self.drop_height is not None:
            known_columns(model.known, 1, self.drop_height)
        return model


def parse_cost(text: str) -> tuple[str, float]:
    """Return label and cost of LABEL=COST."""
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--cost must be LABEL=COST such as gangue=3, got {text!r}") from None


def warn_of_rate(name: str, rate: float, model: Any) -> None:
    """Say so if a model was not trained at a sampling rate [Hz]."""
    low, high = model.sampling_rates
    if not model.covers(rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        say(f"cgid: warning: {name}: sampled at {rate:g} Hz, the model was trained at {trained} Hz", err=True)


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


F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What is asked of every recording.

    Attributes
    ----------
    models : Models
    decision : Decision
    drop_height, mass, dead_time, vote_time : float or None
    invert : bool
    sensors : tuple of str
    settings : ShareSettings
    shares_asked : bool
        Whether an option speaks of shares, so that they must be told.
    """

    models: Models
    decision: Any
    drop_height: float | None
    mass: float | None
    dead_time: float | None
    vote_time: float | None
    invert: bool
    sensors: tuple[str, ...]
    settings: Any
    shares_asked: bool

    @property
    def how(self) -> dict[str, Any]:
        """Return the arguments that `identify` and `identify_frames` share."""
        return {name: getattr(self.decision, name) for name in ("costs", "coverage", "class_conditional")}

    def warn_of_sensor(self, source: str, model: Any) -> None:
        """Say so if a model knows sensors and nobody says which one it is."""
        if model.sensors and not self.sensors:
            known = ", ".join(model.sensors)
            say(
                f"cgid: warning: {source}: the model knows the response of some sensors, nothing makes up for that of "
                f"this one; give --sensor NAME if it is one of {known}",
                err=True,
            )

    def require_use(self, kind: str) -> None:
        """Refuse what has no meaning for what a model decides on: it would be overlooked in silence."""
        from cgid.errors import InvalidValue

        stray = {"impact": ("--vote", self.vote_time), "window": ("--dead-time", self.dead_time)}
        flag, given = stray[kind]
        if given is not None:
            raise InvalidValue(f"{flag} must be left out, this model decides on {kind}s")

    def question(self, **changes: Any) -> Any:
        """Return what is asked of every impact or window."""
        from cgid.identification.stream import Question

        given: dict[str, Any] = {} if self.vote_time is None else {"vote_time": self.vote_time}
        return Question(
            decision=self.decision,
            drop_height=self.drop_height,
            dead_time=self.dead_time,
            sensors=self.sensors,
            **given,
            **changes,
        )


def answering_options(command: F) -> F:
    """Add the options that say by which model, and how, is answered."""
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
            "--vote", type=float, help="Windows are decided on together over so long [s], 0.5; 0: each alone."
        ),
        click.option(
            "--sensor", multiple=True, metavar="NAME", help="Sensor of the model's reference runs; or one a channel."
        ),
        click.option("--window", type=float, help="The gangue share looks back so long [s], 10."),
        click.option("--gangue", multiple=True, metavar="LABEL", help="Label that is gangue; may be given again."),
        click.option(
            "--gangue-cost", type=float, help="What a drawn gangue costs, in lost coal, 1: says when to shut."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def asked_of(options: dict[str, Any], dead_time: float | None, steps: int = 2) -> tuple[Asked, dict[str, Any]]:
    """Return what is asked, and the options that are left: those that say how to read.

    A share is told so many times within its window.
    """
    from cgid import validation
    from cgid.identification.answers import Decision
    from cgid.identification.share import GANGUE, SHARE_TIME, ShareSettings

    left = dict(options)
    names = ("model_path", "mass", "drop_height", "costs", "coverage", "class_conditional")
    path, mass, drop_height, costs, coverage, class_conditional = (left.pop(name) for name in names)
    vote, window, gangue, gangue_cost = (left.pop(name) for name in ("vote", "window", "gangue", "gangue_cost"))
    weights = dict(parse_cost(text) for text in costs)
    decision = Decision(costs=weights, coverage=coverage, class_conditional=class_conditional)
    length = SHARE_TIME if window is None else float(validation.positive("--window", window, "s"))
    settings = ShareSettings(
        length=length,
        step=length / steps,
        gangue=gangue or (GANGUE,),
        gangue_cost=1.0 if gangue_cost is None else float(validation.positive("--gangue-cost", gangue_cost)),
    )
    asked = Asked(
        models=Models(path, mass, drop_height, decision),
        decision=decision,
        drop_height=drop_height,
        mass=mass,
        dead_time=dead_time,
        vote_time=None if vote is None else float(validation.not_negative("--vote", vote, "s")),
        invert=bool(left.pop("invert")),
        sensors=left.pop("sensor"),
        settings=settings,
        shares_asked=bool(gangue) or window is not None or gangue_cost is not None,
    )
    return asked, left

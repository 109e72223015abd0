"""What is asked of a recording: by which model, and how, its impacts are answered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import click

from cgid.cli.model_choice import Models, parse_cost
from cgid.cli.options import PATH
from cgid.cli.output import say

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
        from cgid.identification.answering.question import Question

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
    from cgid.identification.answering.watch import GANGUE, SHARE_TIME, ShareSettings
    from cgid.identification.answers import Decision

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

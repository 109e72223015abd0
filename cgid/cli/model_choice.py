"""Which model answers: the one asked for, or the default model of the quantity."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import click

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
        from cgid.identification.known import known_columns

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

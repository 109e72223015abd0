"""The `[stream]` section of a scene file: one long recording of many rocks instead of a frame for each."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, model_validator

from cgid._lib.validation import Floats, Rule
from cgid.scene.file.distributions import LIMITS, Duration, Inclination, Moments, Quantity, Section, Speed, WholeNumber
from cgid.scene.file.sections import Population
from cgid.scene.file.sensor import Sensor
from cgid.units import parse

#: Lowest bandwidth over the sampling rate; it spreads every impact over some 65,000 samples.
_MIN_BAND = 1 / 512
#: Tolerance of the sum of shares.
_SHARE_TOLERANCE = 1e-9


def _require_ascending(times: tuple[float, ...]) -> None:
    for row, (before, after) in enumerate(pairwise(times), start=1):
        if not before < after:
            raise ValueError(f"times must ascend, got {after:g} s after {before:g} s in row {row}")


class RateTable(Section):
    """Rocks per second: linear between the times, constant before the first and after the last."""

    times: Moments
    """Ascending times."""
    values: Annotated[tuple[float, ...], Quantity("frequency", Rule(0, LIMITS["frequency"][1]))]
    """Rate at these times."""

    @model_validator(mode="after")
    def _sound(self) -> Self:
        _require_ascending(self.times)
        if len(self.values) != len(self.times):
            raise ValueError(f"values must be as many as times, {len(self.times)}, got {len(self.values)}")
        if max(self.values) < 1e-3:
            raise ValueError(f"must somewhere be 0.001 Hz or more, got at most {max(self.values):g} Hz")
        return self


def _read_rate(content: Any) -> Any:
    """Convert a bare rate to a constant one."""
    if isinstance(content, dict | BaseModel):
        return content
    return {"times": [0.0], "values": [parse(content, "frequency")]}


class ArrivalsSection(Section):
    """Arrivals of rocks: random (a Poisson process) with a rate, or at given times."""

    rate: Annotated[RateTable, BeforeValidator(_read_rate)] | None = None
    """Rocks per second: a number, or a table over time."""
    times: Moments | None = None
    """Times of arrival, instead of a rate."""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.rate is None) == (self.times is None):
            raise ValueError("must have either rate or times, and not both")
        if self.times is not None and any(before > after for before, after in pairwise(self.times)):
            raise ValueError("times must not descend; sort them")
        return self


class MixtureSection(Section):
    """The fractions of labels among the arriving rocks over time; every key but `times` is a label.

    Fractions are linear between the times, constant before the first and after the last. Labels without a row divide
    the rest by the weights of their populations.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, Annotated[tuple[float, ...], Quantity("ratio", Rule(0, 1))]]

    times: Moments
    """Ascending times at which the shares of labels are given."""

    @property
    def shares(self) -> dict[str, tuple[float, ...]]:
        """The given shares by label."""
        return dict(self.__pydantic_extra__)

    @model_validator(mode="after")
    def _sound(self) -> Self:
        _require_ascending(self.times)
        if not self.shares:
            raise ValueError("must give the shares of at least one label, such as gangue = [0.1, 0.9]")
        for label, shares in self.shares.items():
            if len(shares) != len(self.times):
                raise ValueError(f"{label} must have as many shares as times, {len(self.times)}, got {len(shares)}")
        total = np.sum([*self.shares.values()], axis=0)
        if total.max() > 1 + _SHARE_TOLERANCE:
            row = int(np.argmax(total))
            raise ValueError(f"shares must add up to 1 or less, got {total[row]:g} at {self.times[row]:g} s")
        return self

    def problems(self, labels: tuple[str, ...]) -> list[str]:
        """Return error messages for shares that do not fit a scene with these labels."""
        known = ", ".join(labels)
        problems = [
            f"stream.mixture.{label}: must be a label of a population, one of {known}"
            for label in self.shares
            if label not in labels
        ]
        total = np.sum([*self.shares.values()], axis=0)
        if not problems and set(labels) == set(self.shares) and total.min() < 1 - _SHARE_TOLERANCE:
            row = int(np.argmin(total))
            problems.append(
                f"stream.mixture: shares of all labels must add up to 1, got {total[row]:g} at {self.times[row]:g} s; "
                "leave out a label, which then takes the rest"
            )
        return problems

    def at(self, label: str, times: Floats) -> Floats:
        """Return the share of a label with a row at these times [s]."""
        return np.asarray(np.interp(times, self.times, self.shares[label]))


class ReboundsSection(Section):
    """Rocks are followed for at most this many rebounds, and while their normal speed is at least this."""

    most: Annotated[WholeNumber, Quantity(rule=Rule(1, 1000))] = 5
    """Rebounds of a rock after which it is no longer followed."""
    least_speed: Speed = 0.1
    """Normal speed below which a rock is no longer followed."""


class StreamSection(Section):
    """One long recording of a stream of rocks."""

    duration: Duration
    """Length of the recording."""
    arrivals: ArrivalsSection
    """When rocks arrive."""
    mixture: MixtureSection | None = None
    """How the shares of the labels change; without it the weights of the populations hold."""
    rebounds: ReboundsSection | None = None
    """How rocks bounce down the beam; without it each rock hits once."""
    inclination: Inclination = 0.0
    """Slope of the beam, down which rocks bounce."""

    @model_validator(mode="after")
    def _arrivals_inside(self) -> Self:
        times = self.arrivals.times
        if times is not None and times[-1] >= self.duration:
            raise ValueError(
                f"arrivals.times must be before the end of the recording at {self.duration:g} s, got {times[-1]:g} s"
            )
        return self

    def problems(self, populations: tuple[Population, ...], sensor: Sensor, sampling_rate: float) -> list[str]:
        """Return error messages for settings that conflict with a stream of one time axis and one sensor."""
        labels = tuple(sorted({population.label for population in populations}))
        problems = [] if self.mixture is None or not labels else self.mixture.problems(labels)
        if sensor.relative_noise > 0:
            problems.append(
                "sensor.relative_noise: must be left out of a stream, whose impacts share one noise; "
                "give absolute_noise or noise_density"
            )
        if sensor.relative_range is not None:
            problems.append(
                "sensor.relative_range: must be left out of a stream, whose impacts share one full scale; give range"
            )
        if sensor.bandwidth is not None and (sensor.quantity != "force" or sensor.filters):
            problems.append(
                "sensor.bandwidth: must be left out of a stream where something rings before it; give anti_alias"
            )
        elif sensor.bandwidth is not None and sensor.bandwidth < sampling_rate * _MIN_BAND:
            problems.append(
                f"sensor.bandwidth: must be at least 1/{1 / _MIN_BAND:g} of the sampling rate in a stream, "
                f"{sampling_rate * _MIN_BAND:.4g} Hz, got {sensor.bandwidth:g} Hz, which smears impacts too far to "
                "both sides; give anti_alias, or lower the sampling rate"
            )
        for index, population in enumerate(populations):
            for name, hint in (
                ("second_hit", "stream.rebounds makes further hits"),
                ("clipped_at", "sensor.range clips"),
            ):
                if getattr(population, name) is not None:
                    problems.append(f"populations.{index}.{name}: must be left out of a stream; {hint}")
        return problems

"""The numbers of a scene file: their units and limits, and the distributions that they are drawn from.

A number is `"3.1 GPa"` or, in the SI unit, `3.1e9`. All distributions are drawn by inversion of their distribution
function: one uniform number gives one value, so values do not depend on how many are drawn at once.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, Strict, model_validator
from scipy.special import ndtr, ndtri

from cgid.units import DIMENSIONS, parse
from cgid.validation import Floats

#: Dimension -> lowest and highest value in SI units: wider than any real impact, but no formula overflows within them.
LIMITS: dict[str, tuple[float, float]] = {
    "density": (1e-3, 1e5),
    "modulus": (1e3, 1e15),
    "length": (1e-6, 1e4),
    "speed": (1e-3, 1e4),
    "frequency": (1e-3, 1e9),
    "force": (1e-9, 1e15),
    "time": (1e-9, 1e4),
    "acceleration": (1e-3, 1e4),
    "mass": (1e-6, 1e9),
}


def _reader(dimension: str) -> BeforeValidator:
    return BeforeValidator(partial(parse, dimension=dimension))


def _limits(dimension: str) -> Any:
    lowest, highest = LIMITS[dimension]
    return Field(ge=lowest, le=highest)


Density = Annotated[float, _reader("density"), _limits("density")]
Modulus = Annotated[float, _reader("modulus"), _limits("modulus")]
Length = Annotated[float, _reader("length"), _limits("length")]
Frequency = Annotated[float, _reader("frequency"), _limits("frequency")]
Mass = Annotated[float, _reader("mass"), _limits("mass")]
#: A level in the unit of the sensor's quantity, parsed by `cgid.scene.sensor`.
Level = Annotated[float, Field(ge=0, le=LIMITS["force"][1])]
Acceleration = Annotated[float, _reader("acceleration"), _limits("acceleration")]
#: Shortest recording [s].
SHORTEST_RECORDING = 1e-3
#: A time in a recording, and its duration: at most a day.
Moment = Annotated[float, _reader("time"), Field(ge=0, le=86_400)]
Duration = Annotated[float, _reader("time"), Field(ge=SHORTEST_RECORDING, le=86_400)]
#: Angle to the horizontal [rad], less than vertical.
Inclination = Annotated[float, _reader("angle"), Field(ge=0, le=1.5)]
Speed = Annotated[float, _reader("speed"), _limits("speed")]
Decibel = Annotated[float, _reader("decibel"), Field(ge=-200, le=200)]
#: A frequency of events, which may be 0.
Rate = Annotated[float, _reader("frequency"), Field(ge=0, le=LIMITS["frequency"][1])]
#: A dimensionless number; strings and booleans are rejected.
Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Ratio = Annotated[float, _reader("ratio")]

# ---- distributions ---------------------------------------------------------------------------------------------------

#: The smallest and largest uniform numbers (`cgid.scene.draws`).
SMALLEST_UNIFORM, LARGEST_UNIFORM = 2.0**-54, 1 - 2.0**-53


class _Distribution(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @abstractmethod
    def quantile(self, uniform: Floats) -> Floats:
        """Return the quantiles at these probabilities."""

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and the largest value that can ever be drawn."""
        with np.errstate(all="ignore"):  # an overflow is infinite, beyond all bounds
            low, high = self.quantile(np.array([SMALLEST_UNIFORM, LARGEST_UNIFORM]))
        return float(low), float(high)


class Constant(_Distribution):
    """Always the same value.

    Parameters
    ----------
    value : float
        The value.
    """

    distribution: Literal["constant"] = "constant"
    value: float

    def quantile(self, uniform: Floats) -> Floats:
        """Return the value itself."""
        return np.full(uniform.shape, self.value)


class _Weighted(_Distribution):
    """One of several, with weights (equal by default)."""

    weights: tuple[Number, ...] | None = None

    @property
    @abstractmethod
    def _among(self) -> tuple[str, int]:
        """The key of what is chosen among, and how many there are."""

    @model_validator(mode="after")
    def _weights_fit(self) -> Self:
        if self.weights is not None:
            name, number = self._among
            if len(self.weights) != number:
                raise ValueError(f"weights must be as many as {name}, {number}, got {len(self.weights)}")
            if min(self.weights) < 0 or not 0 < sum(self.weights) < np.inf:
                raise ValueError(f"weights must be 0 or more with a finite sum above 0, got {list(self.weights)}")
        return self

    @property
    def _edges(self) -> Floats:
        """The upper ends of the intervals of the uniform number."""
        weights = np.ones(self._among[1]) if self.weights is None else np.array(self.weights)
        edges = np.cumsum(weights) / weights.sum()
        edges[np.flatnonzero(weights)[-1] :] = 1.0
        return np.asarray(edges)


class Choice(_Weighted):
    """One of several values, with weights (equal by default).

    Parameters
    ----------
    values : tuple of float
        The values.
    weights : tuple of float, optional
        How often each is drawn, relative to the others.
    """

    distribution: Literal["choice"]
    values: tuple[float, ...] = Field(min_length=1)

    @property
    def _among(self) -> tuple[str, int]:
        return "values", len(self.values)

    def quantile(self, uniform: Floats) -> Floats:
        """Return the value whose interval of the cumulative weights holds the uniform number."""
        return np.asarray(self.values, np.float64)[np.searchsorted(self._edges, uniform, side="right")]

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and largest value, regardless of weights."""
        return min(self.values), max(self.values)


class _Bounded(_Distribution):
    lowest: float
    highest: float

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.lowest < self.highest:
            raise ValueError(f"lowest must be below highest, got {self.lowest:g} and {self.highest:g}")
        return self


class Uniform(_Bounded):
    """Uniform between two bounds.

    Parameters
    ----------
    lowest : float
        Lower bound.
    highest : float
        Upper bound.
    """

    distribution: Literal["uniform"]

    def quantile(self, uniform: Floats) -> Floats:
        """Return `lowest + (highest - lowest) u`."""
        return self.lowest + (self.highest - self.lowest) * uniform


class LogUniform(_Bounded):
    """The logarithm is uniform between two bounds.

    Parameters
    ----------
    lowest : float
        Lower bound.
    highest : float
        Upper bound.
    """

    distribution: Literal["log-uniform"]

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        if self.lowest <= 0:
            raise ValueError(f"lowest must be above 0 for a logarithm, got {self.lowest:g}")
        if self.highest / self.lowest == np.inf:
            raise ValueError(f"highest / lowest must be a finite number, got {self.highest:g} and {self.lowest:g}")
        return self

    def quantile(self, uniform: Floats) -> Floats:
        """Return `lowest (highest / lowest)^u`."""
        return np.asarray(
            np.clip(self.lowest * np.power(self.highest / self.lowest, uniform), self.lowest, self.highest)
        )


class _Truncatable(_Distribution):
    """A distribution that may be truncated to its bounds."""

    lowest: float | None = None
    highest: float | None = None

    @abstractmethod
    def _cumulative(self, value: float) -> float: ...

    @abstractmethod
    def _inverse(self, probability: Floats) -> Floats: ...

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        low, high = self._probabilities
        if not high - low > 1e-12:
            raise ValueError(f"lowest {self.lowest} and highest {self.highest} must leave something between them")
        return self

    @property
    def _probabilities(self) -> tuple[float, float]:
        with np.errstate(all="ignore"):  # powers overflow in the far tails, where the function is 0 or 1
            return (
                0.0 if self.lowest is None else self._cumulative(self.lowest),
                1.0 if self.highest is None else self._cumulative(self.highest),
            )

    def quantile(self, uniform: Floats) -> Floats:
        """Return the inverse of the distribution function between the bounds."""
        if self.lowest is None and self.highest is None:
            return self._inverse(uniform)
        low, high = self._probabilities
        return np.asarray(np.clip(self._inverse(low + (high - low) * uniform), self.lowest, self.highest))


class Normal(_Truncatable):
    """Gaussian; as "truncated-normal" between a lowest and a highest value.

    Parameters
    ----------
    mean : float
        Mean before truncation.
    deviation : float
        Standard deviation before truncation.
    lowest : float, optional
        Values below are not drawn.
    highest : float, optional
        Values above are not drawn.
    """

    distribution: Literal["normal", "truncated-normal"]
    mean: float
    deviation: float = Field(gt=0)

    @model_validator(mode="after")
    def _bounds_fit_name(self) -> Self:
        if self.distribution == "truncated-normal" and (self.lowest is None or self.highest is None):
            raise ValueError("truncated-normal must have lowest and highest; without bounds it is normal")
        if self.distribution == "normal" and not (self.lowest is None and self.highest is None):
            raise ValueError("normal has no lowest or highest; with bounds it is truncated-normal")
        return self

    def _cumulative(self, value: float) -> float:
        return float(ndtr((value - self.mean) / self.deviation))

    def _inverse(self, probability: Floats) -> Floats:
        return np.asarray(self.mean + self.deviation * ndtri(probability))


class Lognormal(_Truncatable):
    """The logarithm is Gaussian, with standard deviation `sigma`; half of the draws lie below `median`.

    Parameters
    ----------
    median : float
        Median before truncation.
    sigma : float
        Standard deviation of the natural logarithm.
    lowest : float, optional
        Values below are not drawn.
    highest : float, optional
        Values above are not drawn.
    """

    distribution: Literal["lognormal"]
    median: float = Field(gt=0)
    sigma: Number = Field(gt=0)

    def _cumulative(self, value: float) -> float:
        return float(ndtr(np.log(value / self.median) / self.sigma)) if value > 0 else 0.0

    def _inverse(self, probability: Floats) -> Floats:
        return np.asarray(self.median * np.exp(self.sigma * ndtri(probability)))


class RosinRammler(_Truncatable):
    """Rosin & Rammler (1933): the share below x is `1 - exp(-(x / characteristic)^uniformity)`.

    The law was found for the *mass* that passes a sieve; here it applies to the number of impacts.

    Parameters
    ----------
    characteristic : float
        Value below which 63 % of the draws lie.
    uniformity : float
        The higher, the narrower the distribution.
    lowest : float, optional
        Values below are not drawn.
    highest : float, optional
        Values above are not drawn.
    """

    distribution: Literal["rosin-rammler"]
    characteristic: float = Field(gt=0)
    uniformity: Number = Field(gt=0)

    def _cumulative(self, value: float) -> float:
        return float(-np.expm1(-np.power(max(value, 0.0) / self.characteristic, self.uniformity)))

    def _inverse(self, probability: Floats) -> Floats:
        return self.characteristic * np.power(-np.log1p(-probability), 1 / self.uniformity)


Single = Annotated[
    Constant | Choice | Uniform | LogUniform | Normal | Lognormal | RosinRammler,
    Field(discriminator="distribution"),
]


class Mixed(_Weighted):
    """One of several distributions, with weights (equal by default), such as 0 for half and uniform for the others.

    Parameters
    ----------
    parts : tuple of distribution
        The distributions; a plain number is one that always gives that number.
    weights : tuple of float, optional
        How often each is drawn from, relative to the others.
    """

    distribution: Literal["mixed"]
    parts: tuple[Single, ...] = Field(min_length=1, max_length=64)

    @property
    def _among(self) -> tuple[str, int]:
        return "parts", len(self.parts)

    def quantile(self, uniform: Floats) -> Floats:
        """Return the quantiles of the parts whose intervals hold the uniform numbers, at the places within these."""
        edges = self._edges
        which = np.searchsorted(edges, uniform, side="right")
        below = np.concatenate([np.zeros(1), edges])[which]
        place = np.clip((uniform - below) / (edges[which] - below), SMALLEST_UNIFORM, LARGEST_UNIFORM)
        values = np.empty(uniform.shape)
        for number, part in enumerate(self.parts):
            values[which == number] = part.quantile(place[which == number])
        return values

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and largest value of any part, regardless of weights."""
        lowest, highest = zip(*(part.extremes for part in self.parts), strict=True)
        return min(lowest), max(highest)


#: The keys of a distribution that have the dimension of the quantity.
_MEASURED = ("value", "values", "lowest", "highest", "mean", "deviation", "median", "characteristic")


def measured(dimension: str) -> BeforeValidator:
    """Return a validator that converts the units of a distribution to SI; a bare number becomes a constant."""
    return BeforeValidator(partial(_in_si, dimension=dimension))


def _in_si(content: Any, dimension: str) -> Any:
    if isinstance(content, BaseModel):
        return content
    if not isinstance(content, dict):
        return {"distribution": "constant", "value": _si("", content, dimension)}
    problems: list[str] = []
    numbers = dict(content)
    for key in content.keys() & set(_MEASURED):
        try:
            numbers[key] = _si(f"{key} ", content[key], dimension)
        except ValueError as error:
            problems.append(str(error))
    if isinstance(content.get("parts"), list):
        numbers["parts"] = []
        for number, part in enumerate(content["parts"]):
            try:
                numbers["parts"].append(_in_si(part, dimension))
            except ValueError as error:
                problems.append(f"parts.{number}: {error}")
    if problems:
        raise ValueError("; ".join(sorted(problems)))
    return numbers


def _si(key: str, value: Any, dimension: str) -> Any:
    try:
        if isinstance(value, list):
            return tuple(parse(item, dimension) for item in value)
        return parse(value, dimension)
    except ValueError as error:
        raise ValueError(f"{key}{error}") from None


Distribution = Annotated[
    Constant | Choice | Uniform | LogUniform | Normal | Lognormal | RosinRammler | Mixed,
    Field(discriminator="distribution"),
]
#: The names in a scene file; the paths of errors omit them.
DISTRIBUTION_NAMES = (
    "constant",
    "choice",
    "uniform",
    "log-uniform",
    "normal",
    "truncated-normal",
    "lognormal",
    "mixed",
    "rosin-rammler",
)


def measured_within(dimension: str) -> AfterValidator:
    """Return a validator that keeps a distribution above 0 and within the `LIMITS` of its dimension."""
    lowest, highest = LIMITS[dimension]
    unit = next(iter(DIMENSIONS[dimension]))
    return within(lowest, highest, f"must be above 0, within {lowest:g} and {highest:g} {unit}", unit)


def within(lowest: float, highest: float, rule: str, unit: str = "") -> AfterValidator:
    """Return a validator that rejects a distribution with possible values outside `lowest..highest`."""

    def check(distribution: _Distribution) -> _Distribution:
        low, high = distribution.extremes
        if not (lowest <= low and high <= highest):
            value = high if lowest <= low else low
            drawn = "got" if isinstance(distribution, Constant) else "it can be drawn as"
            cure = "" if isinstance(distribution, Constant) else "; give it lowest and highest, or other parameters"
            raise ValueError(f"{rule}, {drawn} {value:.3g}{' ' + unit if unit else ''}{cure}")
        return distribution

    return AfterValidator(check)

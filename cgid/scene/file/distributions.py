"""The numbers of a scene file (`"3.1 GPa"`, or `3.1e9` in the SI unit) and their distributions."""

from __future__ import annotations

import inspect
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, cast, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, Strict, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema
from scipy.special import ndtr, ndtri

from cgid._lib.validation import Floats, Rule, positive, real, shown
from cgid.units import DIMENSIONS, parse

#: Dimension -> lowest and highest value in SI units: wider than any real impact, and without overflow in any formula.
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


@dataclass(frozen=True)
class Quantity:
    """Metadata of a key's type: its dimension, whether it may have a unit, and its rule for all values."""

    dimension: str = ""
    rule: Rule = real

    @classmethod
    def of(cls, dimension: str) -> Self:
        """Return a quantity within the `LIMITS` of its dimension."""
        return cls(dimension, Rule(*LIMITS[dimension]))

    @property
    def unit(self) -> str:
        """The SI unit; empty for none."""
        return next(iter(DIMENSIONS[self.dimension])) if self.dimension else ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Parse the unit before the validation by pydantic, and check the rule after it."""
        read = None
        if self.dimension:
            read = parse if source is float else _list_in_si if get_origin(source) is tuple else _in_si

        def validate(content: Any, handle: Callable[[Any], Any]) -> Any:
            if read is not None and not (source is float and type(content) is float):
                value = handle(read(content, self.dimension))
            else:
                value = handle(content)
            self.require(value, content)
            return value

        return core_schema.no_info_wrap_validator_function(validate, handler(source))

    def require(self, value: Any, content: Any) -> None:
        """Raise `ValueError` unless a number, all numbers of a list, or all values of a distribution meet the rule."""
        drawn = isinstance(value, _Distribution)
        try:
            numbers = np.atleast_1d(np.asarray(value.extremes if drawn else value, np.float64))
        except OverflowError:  # a whole number of hundreds of digits
            raise ValueError(f"must {self.rule.sentence(self.unit)}, got {shown(value)}") from None
        for index in np.flatnonzero(~self.rule.holds(numbers))[:1]:
            wrong, unit = float(numbers[index]), f" {self.unit}" if self.unit else ""
            text = f", got {value if isinstance(value, int) else format(wrong, '.6g')}{unit}"
            if isinstance(content, str):
                text = f", got {shown(content)}"
            elif isinstance(value, tuple):
                text += f" at index {index}"
            elif drawn and not isinstance(value, Constant):
                text = f", its distribution includes {wrong:.3g}{unit}; give lowest and highest, or other parameters"
            raise ValueError(f"must {self.rule.sentence(self.unit)}{text}")


def _list_in_si(content: Any, dimension: str) -> Any:
    if not isinstance(content, list | tuple) or all(type(item) in (int, float) for item in content):
        return content
    return [_si(f"index {number} ", item, dimension) for number, item in enumerate(content)]


def quantity_of(field: FieldInfo) -> Quantity | None:
    """Return the type of the numbers of a key; None for a section or a text."""
    return next((one for one in _metadata(field) if isinstance(one, Quantity)), None)


def _metadata(field: Any) -> Iterator[Any]:
    yield from getattr(field, "metadata", getattr(field, "__metadata__", ()))
    for part in get_args(getattr(field, "annotation", field)):
        yield from _metadata(part)


Density = Annotated[float, Quantity.of("density")]
Modulus = Annotated[float, Quantity.of("modulus")]
Length = Annotated[float, Quantity.of("length")]
Frequency = Annotated[float, Quantity.of("frequency")]
Mass = Annotated[float, Quantity.of("mass")]
Acceleration = Annotated[float, Quantity.of("acceleration")]
Speed = Annotated[float, Quantity.of("speed")]
#: A level in the unit of the sensor's quantity, parsed by `cgid.scene.file.sensor`.
Level = Annotated[float, Quantity(rule=Rule(0, LIMITS["force"][1]))]
#: Shortest recording [s].
MIN_RECORDING = 1e-3
_DAY = 86_400
#: Times in a recording, and its duration: at most a day.
Moments = Annotated[tuple[float, ...], Field(min_length=1, max_length=100_000), Quantity("time", Rule(0, _DAY))]
Duration = Annotated[float, Quantity("time", Rule(MIN_RECORDING, _DAY))]
#: Angle to the horizontal [rad], less than vertical.
Inclination = Annotated[float, Quantity("angle", Rule(0, 1.5))]
Decibel = Annotated[float, Quantity("decibel", Rule(-200, 200))]
#: A dimensionless number; strings and booleans are rejected.
Number = Annotated[float, Strict()]
WholeNumber = Annotated[int, Strict()]
#: A number without a unit, or in per cent.
Share = Annotated[float, Quantity("ratio", Rule(0, 1))]
DampingRatio = Annotated[float, Quantity("ratio", Rule(0, 1, without="ends"))]


class Section(BaseModel):
    """A section of the file: no unknown keys, no nan. Strings below keys are their documentation."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Add the keys to the docstring."""
        lines = []
        for name, field in cls.model_fields.items():
            quantity, optional = quantity_of(field), "" if field.is_required() else "optional "
            unit = f"[{quantity.unit}]" if quantity is not None and quantity.unit else ""
            if field.description:
                field.description = " ".join(field.description.split())
                lines += [f"{name} : {optional}{unit}".rstrip(" :"), f"    {field.description}"]
        summary = inspect.cleandoc(vars(cls).get("__doc__") or "")
        cls.__doc__ = "\n".join([summary, "", "Parameters", "----------", *lines])

    @property
    def distributions(self) -> dict[str, Distribution]:
        """The distributions among its keys."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: cast("Distribution", value) for name, value in values.items() if isinstance(value, _Distribution)}


# ---- distributions ---------------------------------------------------------------------------------------------------

#: The smallest and largest uniform numbers (`cgid.scene.synthesis.draws`).
MIN_UNIFORM, MAX_UNIFORM = 2.0**-54, 1 - 2.0**-53


class _Distribution(Section):
    @abstractmethod
    def quantile(self, uniform: Floats) -> Floats:
        """Return the quantiles at these probabilities."""

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and the largest possible value."""
        with np.errstate(all="ignore"):  # overflow gives infinity, beyond all bounds
            low, high = self.quantile(np.array([MIN_UNIFORM, MAX_UNIFORM]))
        return float(low), float(high)


class Constant(_Distribution):
    """Always the same value."""

    distribution: Literal["constant"] = "constant"
    value: float
    """The value."""

    def quantile(self, uniform: Floats) -> Floats:
        """Return the value itself."""
        return np.full(uniform.shape, self.value)


class _Weighted(_Distribution):
    """One of several, with weights (equal by default)."""

    weights: tuple[Number, ...] | None = None
    """Relative frequency of each; equal by default."""

    @property
    @abstractmethod
    def _among(self) -> tuple[str, int]:
        """The key of the alternatives, and their number."""

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
    """One of several values, with weights (equal by default)."""

    distribution: Literal["choice"]
    values: tuple[float, ...] = Field(min_length=1)
    """The values."""

    @property
    def _among(self) -> tuple[str, int]:
        return "values", len(self.values)

    def quantile(self, uniform: Floats) -> Floats:
        """Return the value whose interval of the cumulative weights contains the uniform number."""
        return np.asarray(self.values, np.float64)[np.searchsorted(self._edges, uniform, side="right")]

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and largest value, regardless of weights."""
        return min(self.values), max(self.values)


#: Above 0.
_Positive = Annotated[float, Quantity(rule=positive)]


class _Bounded(_Distribution):
    lowest: float
    """Lower bound."""
    highest: float
    """Upper bound."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.lowest < self.highest:
            raise ValueError(f"lowest must be below highest, got {self.lowest:g} and {self.highest:g}")
        return self


class Uniform(_Bounded):
    """Uniform between two bounds."""

    distribution: Literal["uniform"]

    def quantile(self, uniform: Floats) -> Floats:
        """Return `lowest + (highest - lowest) u`."""
        return self.lowest + (self.highest - self.lowest) * uniform


class LogUniform(_Bounded):
    """The logarithm is uniform between two bounds."""

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
    """Values below are excluded."""
    highest: float | None = None
    """Values above are excluded."""

    @abstractmethod
    def _cumulative(self, value: float) -> float: ...

    @abstractmethod
    def _inverse(self, probability: Floats) -> Floats: ...

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        low, high = self._probabilities
        if not high - low > 1e-12:
            raise ValueError(f"lowest {self.lowest} and highest {self.highest} must leave a range between them")
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
    """Gaussian; as "truncated-normal" between a lowest and a highest value."""

    distribution: Literal["normal", "truncated-normal"]
    mean: float
    """Mean before truncation."""
    deviation: _Positive
    """Standard deviation before truncation."""

    @model_validator(mode="after")
    def _bounds_fit_name(self) -> Self:
        if self.distribution == "truncated-normal" and (self.lowest is None or self.highest is None):
            raise ValueError("truncated-normal must have lowest and highest; without bounds use normal")
        if self.distribution == "normal" and not (self.lowest is None and self.highest is None):
            raise ValueError("normal has no lowest or highest; with bounds use truncated-normal")
        return self

    def _cumulative(self, value: float) -> float:
        return float(ndtr((value - self.mean) / self.deviation))

    def _inverse(self, probability: Floats) -> Floats:
        return np.asarray(self.mean + self.deviation * ndtri(probability))


class Lognormal(_Truncatable):
    """The logarithm is Gaussian, with standard deviation `sigma`; half of the draws are below `median`."""

    distribution: Literal["lognormal"]
    median: _Positive
    """Median before truncation."""
    sigma: Annotated[Number, Quantity(rule=positive)]
    """Standard deviation of the natural logarithm."""

    def _cumulative(self, value: float) -> float:
        return float(ndtr(np.log(value / self.median) / self.sigma)) if value > 0 else 0.0

    def _inverse(self, probability: Floats) -> Floats:
        return np.asarray(self.median * np.exp(self.sigma * ndtri(probability)))


class RosinRammler(_Truncatable):
    """Rosin & Rammler (1933): the fraction below x is `1 - exp(-(x / characteristic)^uniformity)`.

    The law was found for the *mass* that passes a sieve; here it applies to the number of impacts.
    """

    distribution: Literal["rosin-rammler"]
    characteristic: _Positive
    """Value below which 63 % of the draws are."""
    uniformity: Annotated[Number, Quantity(rule=positive)]
    """The higher, the narrower the distribution."""

    def _cumulative(self, value: float) -> float:
        return float(-np.expm1(-np.power(max(value, 0.0) / self.characteristic, self.uniformity)))

    def _inverse(self, probability: Floats) -> Floats:
        return self.characteristic * np.power(-np.log1p(-probability), 1 / self.uniformity)


Single = Annotated[
    Constant | Choice | Uniform | LogUniform | Normal | Lognormal | RosinRammler,
    Field(discriminator="distribution"),
]


class Mixed(_Weighted):
    """One of several distributions, with weights (equal by default), such as 0 for half and uniform for the others."""

    distribution: Literal["mixed"]
    parts: tuple[Single, ...] = Field(min_length=1, max_length=64)
    """The distributions; a plain number is one that always gives that number."""

    @property
    def _among(self) -> tuple[str, int]:
        return "parts", len(self.parts)

    def quantile(self, uniform: Floats) -> Floats:
        """Return the quantiles of the parts selected by the uniform numbers, at the positions within these."""
        edges = self._edges
        which = np.searchsorted(edges, uniform, side="right")
        below = np.concatenate([np.zeros(1), edges])[which]
        within = np.clip((uniform - below) / (edges[which] - below), MIN_UNIFORM, MAX_UNIFORM)
        values = np.empty(uniform.shape)
        for number, part in enumerate(self.parts):
            values[which == number] = part.quantile(within[which == number])
        return values

    @property
    def extremes(self) -> tuple[float, float]:
        """The smallest and largest value of any part, regardless of weights."""
        lowest, highest = zip(*(part.extremes for part in self.parts), strict=True)
        return min(lowest), max(highest)


#: The keys of a distribution that have the dimension of the quantity.
_MEASURED = ("value", "values", "lowest", "highest", "mean", "deviation", "median", "characteristic")


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
    if type(value) is float and math.isfinite(value):
        return value
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
    *("constant", "choice", "uniform", "log-uniform", "normal", "truncated-normal", "lognormal", "mixed"),
    "rosin-rammler",
)

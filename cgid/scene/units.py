"""Types of the numbers in a scene file, with their limits: `"3.1 GPa"` or, in the SI unit, `3.1e9`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, Strict

from cgid import units

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
    return BeforeValidator(partial(units.parse, dimension=dimension))


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

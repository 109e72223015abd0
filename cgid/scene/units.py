"""Types of the numbers in a scene file, with their limits: `"3.1 GPa"` or, in the SI unit, `3.1e9`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, Strict

from cgid import units

#: Dimension -> lowest and highest value in SI units: wider than anything that falls, and within them no formula
#: of an impact overflows.
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
#: A level in the unit of what the sensor feels, which it reads itself (`cgid.scene.sensor`).
Level = Annotated[float, Field(ge=0, le=LIMITS["force"][1])]
Acceleration = Annotated[float, _reader("acceleration"), _limits("acceleration")]
#: A recording is no shorter [s].
SHORTEST_RECORDING = 1e-3
#: A place on the time axis of a recording, and its length: at most a day.
Moment = Annotated[float, _reader("time"), Field(ge=0, le=86_400)]
Duration = Annotated[float, _reader("time"), Field(ge=SHORTEST_RECORDING, le=86_400)]
#: From the horizontal: on a wall nothing falls.
Inclination = Annotated[float, _reader("angle"), Field(ge=0, le=1.5)]
Speed = Annotated[float, _reader("speed"), _limits("speed")]
Decibel = Annotated[float, _reader("decibel"), Field(ge=-200, le=200)]
#: How often something happens, which may be never.
Rate = Annotated[float, _reader("frequency"), Field(ge=0, le=LIMITS["frequency"][1])]
#: Without a dimension: a number as it stands, neither a string nor true or false.
Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Ratio = Annotated[float, _reader("ratio")]

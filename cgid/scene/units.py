"""Numbers with units, as a scene file may write them: `"3.1 GPa"` or, in the SI unit, `3.1e9`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, Strict

from cgid.signals import STANDARD_GRAVITY
from cgid.validation import shown

#: Dimension -> unit -> factor to the SI unit, which comes first.
DIMENSIONS: dict[str, dict[str, float]] = {
    "density": {"kg/m^3": 1.0, "kg/m3": 1.0, "g/cm^3": 1e3, "g/cm3": 1e3, "t/m^3": 1e3},
    "modulus": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "ratio": {"": 1.0, "%": 1e-2},
    "mass": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "acceleration": {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "decibel": {"dB": 1.0},
}
#: Of every quantity that a sensor may feel: what noise has in a band of 1 Hz, and how it drifts in time.
for _quantity in ("force", "acceleration", "speed", "length"):
    _units = DIMENSIONS[_quantity]
    DIMENSIONS[f"{_quantity} noise density"] = {f"{unit}/sqrt(Hz)": factor for unit, factor in _units.items()}
    DIMENSIONS[f"{_quantity} per time"] = {f"{unit}/s": factor for unit, factor in _units.items()}
DIMENSIONS["acceleration noise density"] |= {"ug/sqrt(Hz)": 1e-6 * STANDARD_GRAVITY}

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

_NUMBER = re.compile(r"([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,9}))?\s*(.*)")


def parse(value: Any, dimension: str) -> float:
    """Return a number or a string with a unit in the SI unit of its dimension.

    Raises
    ------
    ValueError
        No finite number, or a unit of another dimension.

    Examples
    --------
    >>> parse("3.1 GPa", "modulus"), parse(20, "length"), parse("2 %", "ratio")
    (3100000000.0, 20.0, 0.02)
    """
    units = DIMENSIONS[dimension]
    if isinstance(value, str):
        match = _NUMBER.fullmatch(value.strip())
        if match is None:
            raise ValueError(f"must be a number with a unit such as '1 {next(iter(units))}', got {shown(value)}")
        unit = match[3]
        if unit not in units:
            known = ", ".join(name or "no unit" for name in units)
            article = "an" if dimension[0] in "aeiou" else "a"
            raise ValueError(f"must be {article} {dimension} in {known}, got {shown(value)}")
        # A power of ten goes into the exponent: "136.51 GPa" is the very number 136.51e9, without a second rounding.
        factor, exponent = units[unit], int(match[2] or 0)
        power = round(math.log10(factor))
        if factor == float(f"1e{power}"):
            exponent, factor = exponent + power, 1.0
        value = float(f"{match[1]}e{exponent}") * factor
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"must be a finite number [{next(iter(units)) or '1'}], got {shown(value)}")
    return number


def _reader(dimension: str) -> Callable[[Any], float]:
    def read(value: Any) -> float:
        return parse(value, dimension)

    return read


def _limits(dimension: str) -> Any:
    lowest, highest = LIMITS[dimension]
    return Field(ge=lowest, le=highest)


Density = Annotated[float, BeforeValidator(_reader("density")), _limits("density")]
Modulus = Annotated[float, BeforeValidator(_reader("modulus")), _limits("modulus")]
Length = Annotated[float, BeforeValidator(_reader("length")), _limits("length")]
Frequency = Annotated[float, BeforeValidator(_reader("frequency")), _limits("frequency")]
Mass = Annotated[float, BeforeValidator(_reader("mass")), _limits("mass")]
#: A level in the unit of what the sensor feels, which it reads itself (`cgid.scene.sensor`).
Level = Annotated[float, Field(ge=0, le=LIMITS["force"][1])]
Acceleration = Annotated[float, BeforeValidator(_reader("acceleration")), _limits("acceleration")]
#: A recording is no shorter [s].
SHORTEST_RECORDING = 1e-3
#: A place on the time axis of a recording, and its length: at most a day.
Moment = Annotated[float, BeforeValidator(_reader("time")), Field(ge=0, le=86_400)]
Duration = Annotated[float, BeforeValidator(_reader("time")), Field(ge=SHORTEST_RECORDING, le=86_400)]
#: From the horizontal: on a wall nothing falls.
Inclination = Annotated[float, BeforeValidator(_reader("angle")), Field(ge=0, le=1.5)]
Speed = Annotated[float, BeforeValidator(_reader("speed")), _limits("speed")]
Decibel = Annotated[float, BeforeValidator(_reader("decibel")), Field(ge=-200, le=200)]
#: How often something happens, which may be never.
Rate = Annotated[float, BeforeValidator(_reader("frequency")), Field(ge=0, le=LIMITS["frequency"][1])]
#: Without a dimension: a number as it stands, neither a string nor true or false.
Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Ratio = Annotated[float, BeforeValidator(_reader("ratio"))]

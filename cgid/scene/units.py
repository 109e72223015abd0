"""Numbers with units, as a scene file may write them: `"3.1 GPa"` or, in the SI unit, `3.1e9`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator

#: Dimension -> unit -> factor to the SI unit, which comes first.
DIMENSIONS: dict[str, dict[str, float]] = {
    "density": {"kg/m^3": 1.0, "kg/m3": 1.0, "g/cm^3": 1e3, "g/cm3": 1e3, "t/m^3": 1e3},
    "modulus": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6},
    "ratio": {"": 1.0, "%": 1e-2},
}

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


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
        match = _NUMBER.fullmatch(value)
        if match is None:
            raise ValueError(f"must be a number with a unit such as '1 {next(iter(units))}', got {value!r}")
        number, unit = float(match[1]), match[2]
        if unit not in units:
            known = ", ".join(name or "no unit" for name in units)
            raise ValueError(f"must be a {dimension} in {known}, got {value!r}")
        # Powers of ten are divided by where they are below one: 25 mm is 25 / 1000, which is .025 exactly rounded.
        factor = units[unit]
        value = number / round(1 / factor) if factor < 1 and dimension != "speed" else number * factor
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"must be a finite number [{next(iter(units)) or '1'}], got {value!r}")
    return float(value)


def _reader(dimension: str) -> Callable[[Any], float]:
    def read(value: Any) -> float:
        return parse(value, dimension)

    return read


Density = Annotated[float, BeforeValidator(_reader("density"))]
Modulus = Annotated[float, BeforeValidator(_reader("modulus"))]
Length = Annotated[float, BeforeValidator(_reader("length"))]
Speed = Annotated[float, BeforeValidator(_reader("speed"))]
Frequency = Annotated[float, BeforeValidator(_reader("frequency"))]
Force = Annotated[float, BeforeValidator(_reader("force"))]
Ratio = Annotated[float, BeforeValidator(_reader("ratio"))]

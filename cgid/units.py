"""Units that users write: of samples, in file headers, scene files and options.

Inside the package every number is in the SI unit of its quantity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cgid._lib.validation import shown, suggestion
from cgid.errors import InvalidValue

#: Standard gravity [m/s^2], the factor of the unit g.
STANDARD_GRAVITY = 9.80665

#: Units of samples: quantity -> unit -> factor to the SI unit, which comes first.
UNITS: Mapping[str, Mapping[str, float]] = {
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6, "mN": 1e-3, "lbf": 4.4482216152605, "kgf": STANDARD_GRAVITY},
    "acceleration": {
        "m/s^2": 1.0,
        "m/s2": 1.0,
        "m/s²": 1.0,
        "m/s**2": 1.0,
        "mm/s^2": 1e-3,
        "cm/s^2": 1e-2,
        "in/s^2": 0.0254,
        "ft/s^2": 0.3048,
        "g": STANDARD_GRAVITY,
        "mg": 1e-3 * STANDARD_GRAVITY,
    },
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "in/s": 0.0254, "km/h": 1 / 3.6},
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "voltage": {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "µV": 1e-6},
    # Not C: a column in C is a temperature.
    "charge": {"A*s": 1.0, "nC": 1e-9, "pC": 1e-12},
    "energy": {"J": 1.0, "kJ": 1e3, "mJ": 1e-3},
    "strain": {"m/m": 1.0, "um/m": 1e-6, "µm/m": 1e-6},
    "level": {"FS": 1.0},
}

#: Limits of samples in the SI unit of each quantity: several times the range of the largest commercial sensor, such as
#: 2e6 m/s^2 (200,000 g) or 5e7 N. For full scale, the counts of 32 bits, since a float may be a count.
LARGEST: Mapping[str, float] = {
    "force": 1e8,
    "acceleration": 3e6,
    "velocity": 1e4,
    "displacement": 1e3,
    "pressure": 1e10,
    "voltage": 1e6,
    "charge": 1.0,
    "energy": 1e9,
    "strain": 10.0,
    "level": 1e10,
}

#: Signs of a unit that a column spells in ASCII.
_SPELLED = str.maketrans({"^": "", "(": "", ")": "", "²": "2", "µ": "u", "%": "percent"})

#: Quantities of a sensor's signal, which its sensitivity converts to the measured quantity.
ELECTRICAL = ("voltage", "charge")

#: All units of samples.
KNOWN_UNITS = frozenset(unit for units in UNITS.values() for unit in units)

_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_FREQUENCY = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9}

#: Units in scene files: dimension -> unit -> factor to the SI unit, which comes first.
DIMENSIONS: dict[str, Mapping[str, float]] = {
    "density": {"kg/m^3": 1.0, "kg/m3": 1.0, "g/cm^3": 1e3, "g/cm3": 1e3, "t/m^3": 1e3},
    "modulus": UNITS["pressure"],
    "length": UNITS["displacement"],
    "speed": UNITS["velocity"],
    "frequency": _FREQUENCY,
    "force": UNITS["force"],
    "time": _TIME,
    "ratio": {"": 1.0, "%": 1e-2},
    "mass": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "acceleration": UNITS["acceleration"],
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "decibel": {"dB": 1.0},
}
# Noise density and drift of a sensor are in units of its measured quantity.
for _quantity in ("force", "acceleration", "speed", "length"):
    DIMENSIONS[f"{_quantity} noise density"] = {
        f"{unit}/sqrt(Hz)": factor for unit, factor in DIMENSIONS[_quantity].items()
    }
    DIMENSIONS[f"{_quantity} per time"] = {f"{unit}/s": factor for unit, factor in DIMENSIONS[_quantity].items()}
DIMENSIONS["acceleration noise density"] = {
    **DIMENSIONS["acceleration noise density"],
    "ug/sqrt(Hz)": 1e-6 * STANDARD_GRAVITY,
}

#: Other spellings of units, in lower case -> unit.
_WRITTEN_OUT = {
    **dict.fromkeys(("sec", "second", "seconds", "sekunden"), "s"),
    **dict.fromkeys(("msec", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "µsec", "microseconds"), "us"),
    "nsec": "ns",
    **dict.fromkeys(("s/s", "sps"), "Hz"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("mvolt", "mvolts", "millivolt", "millivolts"), "mV"),
    **dict.fromkeys(("ms-2", "ms^-2", "ms⁻²", "m/s/s", "mps2", "m.s-2", "m.s^-2", "m*s^-2", "m s-2"), "m/s^2"),
    **dict.fromkeys(("m s^-2", "m s⁻²", "m·s⁻²"), "m/s^2"),
    **dict.fromkeys(("gal", "gals", "cm/s2", "cm/s²"), "cm/s^2"),
    **dict.fromkeys(("in/s2", "in/s²"), "in/s^2"),
    **dict.fromkeys(("ft/s2", "ft/s²"), "ft/s^2"),
    **dict.fromkeys(("lbs", "lb"), "lbf"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("pascal", "pascals"), "Pa"),
    **dict.fromkeys(("meters", "metres"), "m"),
    "strain": "m/m",
    **dict.fromkeys(("gs", "gn", "g_n", "g0"), "g"),
}

_NUMBER = re.compile(r"([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,9}))?\s*(.*)")


def quantity_of(unit: str) -> str:
    """Return the quantity of a unit of samples; raise `InvalidValue` with the known units if it is unknown."""
    for quantity, units in UNITS.items():
        if isinstance(unit, str) and unit in units:
            return quantity
    listed = "; ".join(f"{quantity}: {', '.join(units)}" for quantity, units in UNITS.items())
    meant = known_unit(str(unit))
    hint = suggestion(str(unit), sorted(KNOWN_UNITS)) if meant is None else f"; did you mean {meant!r}?"
    raise InvalidValue(f"unit must be a known one, got {shown(unit)} ({listed}){hint}")


def meaning_of(unit: str) -> tuple[str, float]:
    """Return the quantity of a unit of samples and its factor to the SI unit; raises as `quantity_of`."""
    quantity = quantity_of(unit)
    return quantity, UNITS[quantity][unit]


def si_of(unit: str) -> tuple[float, str]:
    """Return the factor of a unit of samples to the SI unit of its quantity, and that unit."""
    quantity, factor = meaning_of(unit)
    return factor, next(iter(UNITS[quantity]))


def plain_unit(text: str) -> str:
    """Return a unit from a file without surrounding brackets and blanks, with the micro sign for a Greek mu.

    >>> plain_unit(" [m/s^2] ")
    'm/s^2'
    """
    return text.replace("\u03bc", "µ").strip(" \t\0[]()")


def known_unit(text: str) -> str | None:
    """Return the unit of samples named by a text, None if there is none.

    >>> known_unit("[kN]"), known_unit("Volts"), known_unit("counts")
    ('kN', 'V', None)
    """
    unit = plain_unit(text)
    unit = unit if unit in KNOWN_UNITS else "g" if unit == "G" else _WRITTEN_OUT.get(unit.lower(), "")
    return unit if unit in KNOWN_UNITS else None


def seconds_of(unit: str) -> float | None:
    """Return the factor from a unit of sample times, in any case, to seconds: 1 for "", None for any other unit.

    >>> seconds_of("msec"), seconds_of("MS"), seconds_of(""), seconds_of("h")
    (0.001, 0.001, 1.0, None)
    """
    name = unit.lower().replace("\u03bc", "µ")
    factor = _TIME.get(_WRITTEN_OUT.get(name, name)) if unit else 1.0
    return factor if factor is not None and factor <= 1 else None


def hertz_of(unit: str) -> float | None:
    """Return the factor from a unit of frequency, in any case, to Hz: 1 for "", None for any other unit.

    >>> hertz_of("khz"), hertz_of("S/s"), hertz_of("s")
    (1000.0, 1.0, None)
    """
    name = plain_unit(unit).lower()
    name = _WRITTEN_OUT.get(name, name or "Hz").lower()
    return next((factor for unit, factor in _FREQUENCY.items() if unit.lower() == name), None)


def number_and_unit(text: str) -> tuple[float, str] | None:
    """Return the number at the start of a text and what follows it; None if it does not start with one.

    >>> number_and_unit("10.2 mV/g"), number_and_unit("loud")
    ((10.2, 'mV/g'), None)
    """
    match = _NUMBER.fullmatch(text.strip())
    return None if match is None else (float(f"{match[1]}e{match[2] or 0}"), match[3].strip())


def ratio_of(text: str) -> tuple[str, str, float] | None:
    """Return the two quantities of a unit such as mV/g, and its factor to the ratio of their SI units; or None.

    >>> ratio_of("mV/N"), ratio_of("pC/(m/s^2)"), ratio_of("mVolts per g")[:2], ratio_of("mV")
    (('voltage', 'force', 0.001), ('charge', 'acceleration', 1e-12), ('voltage', 'acceleration'), None)
    """
    above, _, below = re.sub(r"\s+per\s+", "/", text.strip(), flags=re.IGNORECASE).partition("/")
    first, second = known_unit(above), known_unit(below)
    if first is None or second is None:
        return None
    upper, lower = quantity_of(first), quantity_of(second)
    return upper, lower, UNITS[upper][first] / UNITS[lower][second]


def parse(value: Any, dimension: str) -> float:
    """Return a number, or a string with a unit such as "3.1 GPa", in the SI unit of its dimension.

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
            listed = ", ".join(name or "no unit" for name in units)
            article = "an" if dimension[0] in "aeiou" else "a"
            hint = suggestion(unit, units)
            raise ValueError(f"must be {article} {dimension} in {listed}, got {shown(value)}{hint}")
        # Powers of ten go into the exponent, to avoid a second rounding: "136.51 GPa" equals 136.51e9.
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


def column_title(name: str, unit: str = "") -> str:
    """Return the title of a column: its name, then its unit in ASCII; the unit "1" adds nothing.

    >>> column_title("peak_acceleration", "m/s^2"), column_title("impulse", "N s"), column_title("novelty", "1")
    ('peak_acceleration_m_s2', 'impulse_N_s', 'novelty')
    """
    spelled = re.sub("[^A-Za-z0-9]+", "_", unit.translate(_SPELLED)).strip("_") if unit != "1" else ""
    return f"{name}_{spelled}" if spelled else name


@dataclass(frozen=True)
class Column:
    """A column of a table, of texts by default; `form` is the format of numbers in CSV."""

    name: str
    unit: str = ""
    dtype: str = "string"
    form: str = ""

    @cached_property
    def title(self) -> str:
        """The name and the unit, as in `time_s`."""
        return column_title(self.name, self.unit)


def numbers(name: str, unit: str = "", form: str = ".8g") -> Column:
    """Return a column of numbers."""
    return Column(name, unit, "float64", form)


def times(name: str) -> Column:
    """Return a column of times [s], distinct for samples up to 5 MHz."""
    return numbers(name, "s", ".7f")


def flags(name: str) -> Column:
    """Return a column of true and false."""
    return Column(name, dtype="bool")

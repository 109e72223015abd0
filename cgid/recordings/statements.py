"""Named values in files (HDF5 attributes, TDMS properties, MATLAB scalars) that state rate, unit, start or names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime

import numpy as np

from cgid.errors import BadData
from cgid.recordings.recording import require_one_rate
from cgid.recordings.text_header import column_of
from cgid.units import hertz_of, known_unit, plain_unit, seconds_of

#: Values with names in a file; a list has one value per channel.
Value = float | str | datetime | list[str]
Values = Mapping[str, Value]

_RATE_NAMES = frozenset(
    ("samplingrate", "samplerate", "samplingfrequency", "samplefrequency", "samplingfreq", "samplefreq", "fs", "fsamp")
)
_INTERVAL_NAMES = frozenset(
    ("dt", "samplinginterval", "sampleinterval", "samplingperiod", "sampleperiod", "timestep", "deltat", "wfincrement")
)
_UNIT_NAMES = frozenset(("unit", "units", "unitstring", "yunit", "yunits", "engineeringunit", "engineeringunits"))
_START_NAMES = frozenset(("starttime", "wfstarttime", "startdatetime", "acquisitionstart", "recordingstart"))
_CHANNEL_NAMES = frozenset(("channelnames", "channelname", "channels", "channellabels", "labels"))
_NAMES = _RATE_NAMES | _INTERVAL_NAMES | _UNIT_NAMES | _START_NAMES | _CHANNEL_NAMES

_NUMBER = re.compile(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*([^\d\s]\S*)?\s*")
_UNIT_BEHIND = re.compile(r"[\s_([]+(k?hz|mhz|s|sec|ms|us|µs)[\s)\]]*$")


def is_statement(name: str) -> bool:
    """Return whether a value of this name could state a rate, a unit, a start or channel names.

    Examples
    --------
    >>> [is_statement(name) for name in ("Sampling Rate [kHz]", "fs", "FS", "gain")]
    [True, True, False, False]
    """
    return _plain(name)[0] in _NAMES


def stated_rate(values: Values, source: str) -> tuple[float, str] | None:
    """Return the stated sampling rate [Hz] and the name that states it, None without one.

    Raises `BadData` if two statements disagree or one is not a positive number.

    Examples
    --------
    >>> stated_rate({"Sample rate [kHz]": 51.2, "gain": 3.0}, "example")
    (51200.0, 'Sample rate [kHz]')
    >>> stated_rate({"dt": "250 ms"}, "example")
    (4.0, 'dt')
    """
    found: list[tuple[float, str]] = []
    for name, value in values.items():
        plain, unit = _plain(name)
        if plain in _RATE_NAMES:
            number = _number(value, unit, hertz_of)
        elif plain in _INTERVAL_NAMES:
            interval = _number(value, unit, seconds_of)
            number = None if interval is None else _rate_of(interval)
        else:
            continue
        if number is None:
            continue
        if not (np.isfinite(number) and number > 0):
            raise BadData(f"{source}: the sampling rate must be above 0 and finite, {name} says {value!r}; correct it")
        found.append((number, name))
    if not found:
        return None
    first = found[0]
    for rate, name in found[1:]:
        require_one_rate(first, (rate, name), source)
    return first


def stated_units(values: Values, n_channels: int) -> list[str | None]:
    """Return the unit of each channel, None if none is stated or it is not in `cgid.units.UNITS`.

    Examples
    --------
    >>> stated_units({"Unit": "kN"}, 2), stated_units({"units": ["g", "furlong"]}, 2)
    (['kN', 'kN'], ['g', None])
    """
    for name, value in values.items():
        if _plain(name)[0] not in _UNIT_NAMES:
            continue
        if isinstance(value, str):
            return [known_unit(value)] * n_channels
        if isinstance(value, list) and len(value) == n_channels:
            return [known_unit(unit) for unit in value]
    return [None] * n_channels


def stated_names(values: Values, n_channels: int) -> list[str]:
    """Return the names of the channels, [] without any."""
    for name, value in values.items():
        if _plain(name)[0] in _CHANNEL_NAMES and isinstance(value, list) and len(value) == n_channels:
            return value
    return []


def stated_start(values: Values) -> datetime | None:
    """Return the time of the first sample; numbers are not accepted, as their epoch is unknown.

    Examples
    --------
    >>> stated_start({"start_time": "2026-03-01T12:00:00"})
    datetime.datetime(2026, 3, 1, 12, 0)
    """
    for name, value in values.items():
        if _plain(name)[0] not in _START_NAMES:
            continue
        if isinstance(value, datetime):
            return value
        if isinstance(value, str):
            try:
                return datetime.fromisoformat(value.strip())
            except ValueError:
                continue
    return None


def stated_time_unit(name: str, values: Values) -> str:
    """Return the unit of an array of times: its attribute, else the unit in its name, else ""."""
    for key, value in values.items():
        if _plain(key)[0] in _UNIT_NAMES and isinstance(value, str) and value.strip():
            return plain_unit(value)
    column = column_of(name.rpartition("/")[2])
    return column.unit if column.has_time_unit else ""


def _plain(name: str) -> tuple[str, str]:
    """Return the letters and digits of a name in lower case, "" if it states nothing, and the unit behind it."""
    # FS means full scale as often as sampling rate.
    if name.strip() == "FS":
        return "", ""
    plain = _letters(name)
    if plain in _NAMES:
        return plain, ""
    found = _UNIT_BEHIND.search(name.lower())
    if found and (plain := _letters(name[: found.start()])) in _NAMES:
        return plain, found[1]
    return "", ""


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "", name.lower())


def _rate_of(interval: float) -> float:
    """Return the rate of an interval, rounded if a whole rate has the same interval: 1 / 1e-5 is below 100000."""
    if not interval:
        return np.inf
    rate = 1 / interval
    whole = round(rate) if 0 < rate < 1e12 else 0
    return float(whole) if whole and 1 / whole == interval else rate


def _number(value: Value, unit: str, factor_of: Callable[[str], float | None]) -> float | None:
    """Return a value in SI units, None if it is not a number; its own unit takes precedence over that in its name."""
    if isinstance(value, str):
        found = _NUMBER.fullmatch(value.replace("\u03bc", "µ"))
        if not found:
            return None
        value, unit = float(found[1]), found[2] or unit
    factor = factor_of(unit)
    if isinstance(value, bool) or not isinstance(value, int | float) or factor is None:
        return None
    return value * factor

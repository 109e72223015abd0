"""Select the recording among the named arrays of a file, and collect its metadata from named values."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import rates_agree
from cgid.errors import BadData
from cgid.recordings.recording import SIMULTANEOUS, Asked, Blocks, ReadBlocks, Remark, require_one_rate
from cgid.recordings.text_layout import ColumnHeader, column_of
from cgid.recordings.times import clocks_of, is_time_name, part, rate_of_blocks, seconds
from cgid.units import hertz_of, known_unit, number_and_unit, plain_unit, ratio_of, seconds_of

#: Values with names in a file; a list has one value per channel.
Value = float | str | datetime | list[str]
Values = Mapping[str, Value]

_RATE_NAMES = frozenset(
    ("samplingrate", "samplerate", "samplingfrequency", "samplefrequency", "samplingfreq", "samplefreq", "fs", "fsamp")
)
_INTERVAL_NAMES = frozenset(
    ("dt", "samplinginterval", "sampleinterval", "samplingperiod", "sampleperiod", "timestep", "deltat", "wfincrement")
)
_X_UNIT_NAMES = frozenset(("wfxunitstring", "xunit", "xunits", "xunitstring"))
_UNIT_NAMES = frozenset(("unit", "units", "unitstring", "yunit", "yunits", "engineeringunit", "engineeringunits"))
_START_NAMES = frozenset(("starttime", "wfstarttime", "startdatetime", "acquisitionstart", "recordingstart"))
_CHANNEL_NAMES = frozenset(("channelnames", "channelname", "channels", "channellabels", "labels"))
_GAIN_NAMES = frozenset(("gain", "chargegain", "amplifiergain"))
_SCALE_NAMES = frozenset(("scale", "slope", "gain", "scalefactor"))
_OFFSET_NAMES = frozenset(("offset", "intercept", "addoffset"))
_NAMES = _RATE_NAMES | _INTERVAL_NAMES | _UNIT_NAMES | _X_UNIT_NAMES | _START_NAMES | _CHANNEL_NAMES | _GAIN_NAMES
_NAMES |= _SCALE_NAMES | _OFFSET_NAMES
#: Groups beside the arrays whose values are those of the file.
_HEADERS = frozenset(("header", "info", "meta", "metadata", "fileheader"))

#: What structs of axes state, see `_nested`.
_NESTED = ("increment", "label")

_NUMBER = re.compile(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*([^\d\s]\S*)?\s*")
#: A name of a sensitivity or of its unit, and the unit in brackets after it.
_SENSITIVITY = re.compile(
    r"(?i:(?:.*[\W_])?(?:sensor|transducer)?sensitivity(?:[\W_]*(?:value|(unit|units)))?)\s*(?:[(\[](.+)[)\]])?\s*"
)
#: Longest name of a statement.
_MAX_NAME_LENGTH = 200
_UNIT_BEHIND = re.compile(r"[\s_([]+(k?hz|mhz|s|sec|ms|us|µs)[\s)\]]*$")


def is_statement(name: str) -> bool:
    """Return whether a value of this name could state a rate, a unit, a start, channel names or a sensitivity."""
    return _plain(name)[0] in _NAMES or name in _NESTED or _sensitivity(name) is not None


def _sensitivity(name: str) -> re.Match[str] | None:
    return _SENSITIVITY.fullmatch(name) if len(name) <= _MAX_NAME_LENGTH else None


def stated_rate(values: Values, source: str) -> tuple[float, str] | None:
    """Return the stated sampling rate [Hz] and the name that states it, None without one; raises `BadData`."""
    rates: list[tuple[float, str]] = []
    x_unit = next((str(value) for _, value, _, _ in _named(values, _X_UNIT_NAMES)), "")
    for name, value, plain, unit in _named(values, _RATE_NAMES | _INTERVAL_NAMES):
        is_rate = plain in _RATE_NAMES
        if x_unit.strip() and plain == "wfincrement":
            seconds(x_unit.strip(), source)
            unit = unit or x_unit.strip()
        number = _number(value, unit, hertz_of if is_rate else seconds_of)
        if number is not None and not is_rate:
            number = _rate_of(number)
        if number is None:
            continue
        if not (np.isfinite(number) and number > 0):
            raise BadData(
                f"{source}: the sampling rate must be above 0 and finite, {name} states {value!r}; correct it"
            )
        rates.append((number, name))
    for other in rates[1:]:
        require_one_rate(rates[0], other, source)
    return rates[0] if rates else None


def stated_units(values: Values, n_channels: int) -> list[str | None] | None:
    """Return the unit of each channel, None if it is not in `cgid.units.UNITS`; None if none is stated."""
    for _, value, _, _ in _named(values, _UNIT_NAMES):
        written = [value] * n_channels if isinstance(value, str) else value
        if isinstance(written, list) and len(written) == n_channels:
            return [known_unit(unit) for unit in written] if any(map(str.strip, written)) else None
    return None


def stated_sensitivities(values: Values, n_channels: int) -> list[str | None] | None:
    """Return the sensitivity of each channel as a text, None if none is stated with a unit."""
    given, unit = None, ""
    for name, value in values.items():
        named = _sensitivity(name)
        if named is not None and named[1] and isinstance(value, str):
            unit = value
        elif named is not None and not named[1] and given is None:
            given, unit = value, named[2] or unit
    written = given if isinstance(given, list) and len(given) == n_channels else [given] * n_channels
    texts = [_with_unit(one, unit) for one in written]
    return texts if any(texts) else None


def _with_unit(value: Any, unit: str) -> str | None:
    text = f"{value:.10g}" if isinstance(value, int | float) else str(value)
    match = number_and_unit(text)
    if match is None:
        return None
    text = text if match[1] else f"{text} {unit}"
    return text if ratio_of(match[1] or unit) is not None else None


def stated_gains(values: Values, n_channels: int) -> list[str | None] | None:
    """Return the gain of each channel as a text, None without one."""
    for _, value, _, _ in _named(values, _GAIN_NAMES):
        if isinstance(value, str | float | int):
            return [f"{value:.10g}" if isinstance(value, float | int) else value] * n_channels
    return None


def full_scale_of(dtype: np.dtype[Any]) -> float | None:
    """Return the number of full scale of signed integers of 8 or 16 bit, None for other types."""
    # Unsigned ones have no known middle, and a converter may place its 24 bits at either end of 32.
    return 2.0 ** (8 * dtype.itemsize - 1) if dtype.kind == "i" and dtype.itemsize <= 2 else None


def stated_names(values: Values, n_channels: int) -> list[str] | None:
    """Return the names of the channels, None without any."""
    named = (value for _, value, _, _ in _named(values, _CHANNEL_NAMES))
    return next((one for one in named if isinstance(one, list) and len(one) == n_channels), None)


def stated_start(values: Values) -> datetime | None:
    """Return the time of the first sample; numbers are not accepted, as their epoch is unknown."""
    for _, value, _, _ in _named(values, _START_NAMES):
        if isinstance(value, datetime):
            return value
        if isinstance(value, str):
            with suppress(ValueError):
                return datetime.fromisoformat(value.strip())
    return None


def _column_of(variable: Variable) -> ColumnHeader:
    """Return name and unit of an array: its attribute, else the unit behind its name, as in a text."""
    stated = next((value for _, value, _, _ in _named(variable.about, _UNIT_NAMES) if isinstance(value, str)), "")
    column = column_of(variable.name)
    if stated.strip():
        return ColumnHeader(name=variable.name, unit=plain_unit(stated))
    return column if column.known_unit or column.has_time_unit else ColumnHeader(name=variable.name)


def _named(values: Values, names: frozenset[str]) -> Iterator[tuple[str, Value, str, str]]:
    """Yield the values of these names: name as written, value, plain name and the unit after it."""
    for name, value in values.items():
        plain, unit = _plain(name)
        if plain in names:
            yield name, value, plain, unit


def _plain(name: str) -> tuple[str, str]:
    """Return the letters and digits of a name in lower case, "" if it states nothing, and the unit after it."""
    # FS means full scale as often as sampling rate.
    if name.strip() == "FS":
        return "", ""
    plain = _letters(name)
    if plain in _NAMES:
        return plain, ""
    match = _UNIT_BEHIND.search(name.lower())
    if match and (plain := _letters(name[: match.start()])) in _NAMES:
        return plain, match[1]
    return "", ""


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "", name.lower())


def _rate_of(interval: float) -> float:
    """Return the rate of an interval, rounded if a whole rate has the same interval: 1 / 1e-5 is below 100000."""
    if not interval:
        return np.inf
    rate = 1 / interval
    rounded = round(rate) if 0 < rate < 1e12 else 0
    return float(rounded) if rounded and 1 / rounded == interval else rate


def _number(value: Value, unit: str, factor_of: Callable[[str], float | None]) -> float | None:
    """Return a value in SI units, None if it is not a number; its own unit takes precedence over that in its name."""
    if isinstance(value, str):
        match = _NUMBER.fullmatch(value.replace("\u03bc", "µ"))
        if not match:
            return None
        value, unit = float(match[1]), match[2] or unit
    factor = factor_of(unit)
    if isinstance(value, bool) or not isinstance(value, int | float) or factor is None:
        return None
    return value * factor


# ---- arrays ----------------------------------------------------------------------------------------------------------

#: What is said of an object of MATLAB: its name and class.
MATLAB_OBJECT = "{} is a MATLAB {} and is left out; to read it, save its columns as arrays, as in x = T.x"
#: Times read at once, and the first of them, which show what they are.
_BLOCK_LENGTH = 1 << 18
_SHOWN = 1 << 10
#: Maximum number of names in a message.
_LISTED = 12
Answer = TypeVar("Answer")


@dataclass(frozen=True, kw_only=True)
class Variable:
    """An array of numbers in a file; `about`: named values attached to it, `fault`: why it cannot be read."""

    name: str
    n_channels: int
    n_samples: int
    read: ReadBlocks
    seekable: bool = False
    group: str = ""
    about: Values = field(default_factory=dict)
    full_scale: float | None = None
    is_integer: bool = False
    fault: str = ""
    warning: str = ""

    @property
    def path(self) -> str:
        """Group and name."""
        return f"{self.group}/{self.name}" if self.group else self.name

    @property
    def is_time(self) -> bool:
        """Whether its name means the times of samples."""
        return self.n_channels == 1 and is_time_name(self.name)

    def __str__(self) -> str:
        shape = f"{self.n_channels} x {self.n_samples}" if self.n_channels > 1 else str(self.n_samples)
        return f"{self.path} ({shape})"


def orientation(shape: Sequence[int]) -> tuple[int | None, int] | None:
    """Return the axes of the channels (None for one) and of the samples, the longer; None for more than two axes."""
    axes = [axis for axis, length in enumerate(shape) if length != 1]
    if len(axes) > 2 or not shape:
        return None
    if len(axes) < 2:
        return None, axes[0] if axes else len(shape) - 1
    first, second = axes
    return (second, first) if shape[second] < shape[first] else (first, second)


def contents_of(
    variables: Sequence[Variable],
    statements: Mapping[str, Values],
    source: str,
    asked: Asked,
    warnings: list[str],
    *,
    group_is_one: bool = False,
    is_cut: bool = False,
) -> Blocks:
    """Return the recording among the arrays of a file, by name, pattern or group if there are several."""
    # statements : path of a group ("" is the top) -> named values; group_is_one : its arrays are the channels of one
    # recording; is_cut : the shortest channel counts
    selected = _select(variables, source, asked.variable, group_is_one, warnings)
    first = selected[0]
    n_samples = min(one.n_samples for one in selected)
    if len(selected) > 1 and any(one.n_channels > 1 or (one.n_samples != n_samples and not is_cut) for one in selected):
        raise BadData(
            f"{source}: channels must be of one length, got {_listed(selected)}; pick those of one by "
            f"{spelled('variable', 'NAME')}, which may be a pattern such as 'run1/*'"
        )
    for one in selected:
        _require_readable(one, source)
    levels = [list(_levels(one, statements)) for one in selected]
    selected = [_as_stated(one, level, source, warnings) for one, level in zip(selected, levels, strict=True)]
    first = selected[0]
    levels = [list(_levels(one, statements)) for one in selected]
    starts: list[datetime | None] = [_first(level, stated_start) for level in levels]
    times, measured = [one for one in variables if one.is_time], dict[str, tuple[float, list[tuple[int, int]]] | None]()
    rates = []
    for one, level in zip(selected, levels, strict=True):
        stated = _first(level, lambda values: stated_rate(values, source))
        rates.append(_rate(one, stated, times, measured, source, warnings, asked.sampling_rate))
    for (rate, _), one in zip(rates[1:], selected[1:], strict=True):
        if (rate is None) != (rates[0][0] is None) or (rate and rates[0][0] and not rates_agree(rate, rates[0][0])):
            raise BadData(
                f"{source}: channels must have one sampling rate, {first.path} has {_hertz(rates[0][0])} and "
                f"{one.path} {_hertz(rate)}; pick one by {spelled('variable', 'NAME')}"
            )
    start = starts[0]
    if len(set(starts)) > 1:
        selected, start, said = _begun_together(selected, starts, rates[0][0], source)
        n_samples, warnings = min(one.n_samples for one in selected), [*warnings, *said]
    if len(selected) == 1:
        names = _first(levels[0], lambda values: stated_names(values, first.n_channels)) or [first.name]
        names = names if len(names) == first.n_channels else []
    else:
        names = [one.name for one in selected]
    columns = list(map(column_of, names))
    # A unit behind a name counts as in a text.
    names = [one.name if one.name and one.known_unit else name for one, name in zip(columns, names, strict=True)]
    units, sensitivities, gains = list[str | None](), list[str | None](), list[str | None]()
    for one, level in zip(selected, levels, strict=True):
        for values, stated_of in ((units, stated_units), (sensitivities, stated_sensitivities), (gains, stated_gains)):
            values += _first(level, partial(stated_of, n_channels=one.n_channels)) or [None] * one.n_channels
    units = [unit or one.known_unit for unit, one in zip(units, columns, strict=True)] if columns else units
    gaps_of = [_gaps(one, times, measured) for one in selected]
    gaps = gaps_of[0]
    if any(one != gaps for one in gaps_of):
        raise BadData(
            f"{source}: channels must have the same gaps, their times differ; pick one by {spelled('variable', 'NAME')}"
        )
    if n_lost := sum(number for _, number in gaps):
        warnings = [*warnings, f"{counted(n_lost, 'sample')} in {counted(len(gaps), 'gap')} of the times missing"]
    return Blocks(
        n_channels=sum(one.n_channels for one in selected),
        read=first.read if len(selected) == 1 else _joined(selected, n_samples, source),
        seekable=all(one.seekable for one in selected),
        n_samples=n_samples + n_lost,
        gaps=gaps,
        names=names,
        units=units,
        sampling_rate=rates[0][0],
        rate_from=rates[0][1],
        full_scales=[one.full_scale for one in selected for _ in range(one.n_channels)],
        integers=[one.is_integer for one in selected for _ in range(one.n_channels)],
        sensitivities=sensitivities,
        gains=gains,
        start_time=start,
        warnings=warnings + [f"{one.path}: {one.warning}" for one in selected if one.warning],
    )


def _begun_together(
    selected: Sequence[Variable], starts: Sequence[datetime | None], rate: float | None, source: str
) -> tuple[list[Variable], datetime | None, list[str]]:
    """Return channels of different starts from the last start on, this start, and what was left out."""
    known = [one for one in starts if one is not None]
    hint = f"pick one by {spelled('variable', 'NAME')}"
    if len(known) < len(starts) or len({one.tzinfo is None for one in known}) > 1:
        return list(selected), starts[0], ["not all channels state when they begin; they were taken as simultaneous"]
    if rate is None:
        raise BadData(f"{source}: channels that begin at different times must state their rate, they do not; {hint}")
    together, said = [], []
    for one, start in zip(selected, known, strict=True):
        earlier = (max(known) - start).total_seconds()
        n_left_out = round(earlier * rate)
        if n_left_out >= one.n_samples:
            raise BadData(
                f"{source}: channels must have a time in common, {one.path} ends before another begins, {earlier:g} s "
                f"after it; {hint}"
            )
        if n_left_out or abs(earlier * rate - n_left_out) > SIMULTANEOUS:
            said.append(
                f"{one.path} begins {earlier:.9g} s before another channel: its first {counted(n_left_out, 'sample')} "
                f"{'is' if n_left_out == 1 else 'are'} left out"
            )
        together.append(replace(one, n_samples=one.n_samples - n_left_out, read=partial(_from, one, n_left_out)))
    return together, max(known), said


def _from(
    variable: Variable, first: int, length: int, channels: Sequence[int], start: int = 0
) -> Iterator[NDArray[Any]]:
    if variable.seekable:
        yield from variable.read(length, channels, first + start)
        return
    for block in variable.read(length, channels):
        if first < block.shape[1]:
            yield block[:, first:]
        first = max(first - block.shape[1], 0)


def _select(
    variables: Sequence[Variable], source: str, variable: str | None, group_is_one: bool, warnings: Sequence[str]
) -> list[Variable]:
    signals = [one for one in variables if not one.is_time]
    if not variables:
        raise BadData(
            f"{source}: a recording must be an array of real numbers with one or two axes, there is none; "
            f"{'; '.join(warnings) or 'save the samples as one'}"
        )
    if {"header", "neighbourhood.centres"} <= {one.path for one in signals}:
        raise BadData(f"{source}: must be a recording, it is a model; give it by {spelled('model')} beside a recording")
    if variable is None:
        is_one = group_is_one and len({one.group for one in signals}) == 1
        if len(signals) > 1 and not is_one:
            raise BadData(
                f"{source}: the file contains several arrays, {_listed(signals)}; choose one by "
                f"{spelled('variable', 'NAME')}, or several of one length by a pattern such as 'ch*'"
            )
        return signals or list(variables[:1])
    pattern = variable
    ways: list[Callable[[Variable], bool]] = [
        lambda one: pattern in (one.path, f"/{one.path}"),
        lambda one: one.name == pattern,
        lambda one: pattern.strip("/") == one.group and not one.is_time,
        lambda one: fnmatchcase(one.path, pattern) and not one.is_time,
    ]
    for index, way in enumerate(ways):
        matching = [one for one in variables if way(one)]
        if len(matching) == 1 or (matching and index > 1):
            return matching
        if matching:
            raise BadData(f"{source}: variable {variable!r} is the name of several: {_listed(matching)}; give the path")
    raise BadData(
        f"{source}: no variable {variable!r} in this file, only {_listed(variables)}; give one by "
        f"{spelled('variable', 'NAME')}"
    )


def _listed(variables: Sequence[Variable]) -> str:
    more = f" and {len(variables) - _LISTED} more" if len(variables) > _LISTED else ""
    return ", ".join(map(str, variables[:_LISTED])) + more


def _levels(variable: Variable, statements: Mapping[str, Values]) -> Iterator[Values]:
    """Yield the named values of the array, of its groups and of the top of the file."""
    yield variable.about
    group = variable.group
    while group:
        yield {**statements.get(group, {}), **_nested(statements, group)}
        group = group.rpartition("/")[0]
    yield statements.get("", {})
    yield from (values for name, values in statements.items() if name.lower() in _HEADERS)


def _nested(statements: Mapping[str, Values], group: str) -> Values:
    """Return what structs within a group state of its axes: the increment of the times, the unit of the samples."""
    about: dict[str, Value] = {}
    for axis in ("x_values", "x_axis", "xaxis", "x"):
        step = statements.get(f"{group}/{axis}", {}).get("increment")
        unit = statements.get(f"{group}/{axis}/quantity", {}).get("label", "s")
        if isinstance(step, int | float) and isinstance(unit, str) and (factor := seconds_of(unit)):
            about["dt"] = step * factor
    if isinstance(label := statements.get(f"{group}/quantity", {}).get("label"), str):
        about["unit"] = label
    return about


def _first(levels: Sequence[Values], ask: Callable[[Values], Answer | None]) -> Answer | None:
    return next((answer for values in levels if (answer := ask(values)) is not None), None)


def _rate(
    variable: Variable,
    stated: tuple[float, str] | None,
    times: Sequence[Variable],
    measured: dict[str, tuple[float, list[tuple[int, int]]] | None],
    source: str,
    warnings: list[str],
    given: float | None,
) -> tuple[float | None, str]:
    """Return the rate [Hz] of an array and its origin, or None and "header"; `measured` keeps those of times."""
    rates, its_times = [] if stated is None else [stated], _times_of(variable, times)
    if its_times and its_times[0].n_samples > 1 and its_times[0].path not in measured:
        measured.update(dict.fromkeys(one.path for one in its_times))
        try:
            measured.update(_measured(its_times, source, given))
        except BadData:
            if stated is None:
                raise
            listed = ", ".join(one.path for one in its_times)
            warnings.append(Remark(f"the times of {listed} are not even, the rate is that of {stated[1]}"))
    for one in its_times:
        found = measured.get(one.path)
        if found is not None:
            rates.append((found[0], f"array {one.path}"))
    for other in rates[1:]:
        require_one_rate(rates[0], other, source)
    return rates[0] if rates else (None, "header")


def _measured(
    times: Sequence[Variable], source: str, given: float | None
) -> Iterator[tuple[str, tuple[float, list[tuple[int, int]]]]]:
    """Yield the path of arrays of times with the rate [Hz] and the gaps that they give."""
    times = sorted(times, key=lambda one: part(one.name) or 0)
    for one in times:
        _require_readable(one, source)
    shown = [next(iter(one.read(_SHOWN, (0,))))[0] for one in times]
    precision = max(float(np.finfo(one.dtype).eps) for one in shown)
    rows = np.stack(shown, axis=1).astype(np.float64)
    where = f"{source}: {', '.join(one.path for one in times)}"
    for clock in clocks_of([_column_of(one) for one in times], rows, where):
        blocks = _joined(times, times[0].n_samples, source)(_BLOCK_LENGTH, range(len(times)))
        seconds_of_rows = (clock.times(block.T.astype(np.float64)) for block in blocks)
        yield times[clock.columns[0]].path, rate_of_blocks(seconds_of_rows, precision, where, given)


def _gaps(
    variable: Variable, times: Sequence[Variable], measured: Mapping[str, tuple[float, list[tuple[int, int]]] | None]
) -> list[tuple[int, int]]:
    found = [measured.get(one.path) for one in _times_of(variable, times)]
    return next((one[1] for one in found if one is not None), [])


def _times_of(variable: Variable, times: Sequence[Variable]) -> list[Variable]:
    """Return the arrays of times of an array: of its length, in its group, else in the nearest above."""
    group = variable.group
    while True:
        found = [
            one
            for one in times
            if one.path != variable.path and (one.group, one.n_samples) == (group, variable.n_samples)
        ]
        if found or not group:
            return found
        group = group.rpartition("/")[0]


def _as_stated(variable: Variable, levels: Sequence[Values], source: str, warnings: list[str]) -> Variable:
    """Return packed numbers, and integers, times the scale that they state, plus their offset."""
    # Packed numbers: CF conventions 1.11, section 8.1. A gain of a group is that of an amplifier.
    about = dict(variable.about)
    scale = _stated_number(about, _SCALE_NAMES if variable.is_integer else {"scalefactor"})
    offset = _stated_number(about, _OFFSET_NAMES if variable.is_integer else {"addoffset"})
    if variable.is_integer and scale is None:
        scale = _first(levels[1:], lambda values: _stated_number(dict(values), _SCALE_NAMES - {"gain"}))
    factor, offset = 1.0 if scale is None else scale, offset or 0.0
    if not (np.isfinite([factor, offset]).all() and factor):
        raise BadData(
            f"{source}: the scale of {variable.path} must be a number other than 0, and its offset one, they are "
            f"{factor:g} and {offset:g}; correct them"
        )
    if (factor, offset) == (1.0, 0.0):
        return variable

    def read(length: int, channels: Sequence[int], *start: int) -> Iterator[NDArray[Any]]:
        return (offset + factor * block for block in variable.read(length, channels, *start))

    if variable.is_integer:
        warnings.append(Remark(f"{variable.path}: integers times {factor:g}" + (f" plus {offset:g}" if offset else "")))
    return replace(variable, read=read, about=about, is_integer=False, full_scale=None)


def _stated_number(values: dict[str, Value], names: Collection[str]) -> float | None:
    """Take the number of one of some names from values, nan for a text; None without one."""
    for name, value, plain, _ in list(_named(values, frozenset(names))):
        if isinstance(value, int | float) or plain != "gain":
            del values[name]
            number = _number(value, "", {"": 1.0}.get)  # metadata of Parquet are texts
            return np.nan if number is None else number
    return None


def _require_readable(variable: Variable, source: str) -> None:
    if variable.fault:
        raise BadData(f"{source}: {variable.path} {variable.fault}; copy the file again, or save it as a plain array")


def _hertz(rate: float | None) -> str:
    return "none" if rate is None else f"{rate:.10g} Hz"


def _joined(selected: Sequence[Variable], n_samples: int, source: str) -> ReadBlocks:
    """Return the blocks of several one-channel arrays, `n_samples` long."""
    nothing: NDArray[Any] = np.empty((1, 0))

    def blocks(length: int, channels: Sequence[int], *start: int) -> Iterator[NDArray[Any]]:
        streams = [selected[channel].read(length, (0,), *start) for channel in channels]
        waiting = [next(stream, nothing) for stream in streams]
        left = n_samples - sum(start)
        while left:
            # The pieces of the arrays may differ in length.
            n = min(left, *(piece.shape[1] for piece in waiting))
            if not n:
                raise BadData(
                    f"{source}: {n_samples} samples are declared, the file contains {n_samples - left}; copy it again"
                )
            yield np.concatenate([piece[:, :n] for piece in waiting])
            left -= n
            waiting = [
                piece[:, n:] if piece.shape[1] > n or not left else next(stream, nothing)
                for piece, stream in zip(waiting, streams, strict=True)
            ]

    return blocks

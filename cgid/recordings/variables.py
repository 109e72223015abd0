"""Select the recording among the named arrays of a file, and collect the file's statements about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from fnmatch import fnmatchcase
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import Blocks, Contents, rates_agree, require_one_rate
from cgid.recordings.statements import (
    Values,
    stated_names,
    stated_rate,
    stated_start,
    stated_time_unit,
    stated_units,
)
from cgid.recordings.times import rate_of_vector

#: Names of an array of times; a capital T may as well be a temperature or a torque.
_TIME_NAME = re.compile(r"(?i:(?:.*[\s_.-])?(?:time|zeit)(?:[\s_.(\[-].*)?)|t(?:\s*[(\[].*|_(?:m|u|µ)?s)?")
#: Most names in a message.
_LISTED = 12
Answer = TypeVar("Answer")


@dataclass(frozen=True, kw_only=True)
class Variable:
    """An array of numbers in a file.

    group : path of its group, parts divided by slashes, "" at the top
    blocks : as in `Contents`
    about : named values attached to it
    fault : why its samples cannot be read, "" if they can
    warning : which samples are missing, "" if none
    """

    name: str
    n_channels: int
    n_samples: int
    blocks: Blocks
    group: str = ""
    about: Values = field(default_factory=dict)
    fault: str = ""
    warning: str = ""

    @property
    def path(self) -> str:
        """Group and name."""
        return f"{self.group}/{self.name}" if self.group else self.name

    @property
    def is_time(self) -> bool:
        """Whether its name means the times of samples."""
        return self.n_channels == 1 and _TIME_NAME.fullmatch(self.name) is not None

    def __str__(self) -> str:
        shape = f"{self.n_channels} x {self.n_samples}" if self.n_channels > 1 else str(self.n_samples)
        return f"{self.path} ({shape})"


def orientation(shape: Sequence[int]) -> tuple[int | None, int] | None:
    """Return the axes of the channels (None for one channel) and of the samples; None for more than two axes.

    Axes of length 1 do not count. The longer of two axes is that of the samples, the second if both are equal.

    Examples
    --------
    >>> orientation((1000,)), orientation((1, 1000)), orientation((4, 1000)), orientation((1000, 4))
    ((None, 0), (None, 1), (0, 1), (1, 0))
    >>> orientation((4, 5, 1000)) is None
    True
    """
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
    variable: str | None,
    warnings: list[str],
    *,
    group_is_one: bool = False,
    is_cut: bool = False,
) -> Contents:
    """Return the recording among the arrays of a file.

    variables : all arrays of two samples or more
    statements : path of a group ("" is the top) -> named values in it or attached to it
    variable : name of an array or of a group (its arrays of one channel), or a pattern with * or ?; a unique name
        needs no path; None if there is only one array besides times
    group_is_one : whether the arrays of a group are the channels of one recording
    is_cut : whether the file was cut off; then channels may differ in length, and the shortest counts

    Raises `BadData` if there is no array, several without a choice, or the chosen ones differ in length or rate.
    """
    chosen = _chosen(variables, source, variable, group_is_one)
    first = chosen[0]
    n_samples = min(one.n_samples for one in chosen)
    if len(chosen) > 1 and any(one.n_channels > 1 or (one.n_samples != n_samples and not is_cut) for one in chosen):
        raise BadData(
            f"{source}: channels must be of one length, got {_listed(chosen)}; pick those of one by --variable NAME, "
            "which may be a pattern such as 'run1/*'"
        )
    for one in chosen:
        _require_readable(one, source)
    rates_of = _Rates(variables, statements, source, warnings)
    rates = [rates_of.of(one) for one in chosen]
    for (rate, _), one in zip(rates[1:], chosen[1:], strict=True):
        if (rate is None) != (rates[0][0] is None) or (rate and rates[0][0] and not rates_agree(rate, rates[0][0])):
            raise BadData(
                f"{source}: channels must have one sampling rate, {first.path} has {_hertz(rates[0][0])} and "
                f"{one.path} {_hertz(rate)}; pick one by --variable NAME"
            )
    levels = [list(_levels(one, statements)) for one in chosen]
    if len(chosen) == 1:
        names = _first(levels[0], lambda values: stated_names(values, first.n_channels) or None) or []
        units = _first(levels[0], lambda values: _units(values, first.n_channels))
    else:
        names = [one.name for one in chosen]
        units = [unit for level in levels for unit in (_first(level, lambda v: _units(v, 1)) or [None])]
    start: datetime | None = _first(levels[0], stated_start)
    return Contents(
        n_channels=sum(one.n_channels for one in chosen),
        blocks=first.blocks if len(chosen) == 1 else _joined(chosen, n_samples, source),
        n_samples=n_samples,
        names=names,
        units=units or [],
        sampling_rate=rates[0][0],
        rate_from=rates[0][1],
        start_time=start,
        warnings=warnings + [f"{one.path}: {one.warning}" for one in chosen if one.warning],
    )


def _chosen(variables: Sequence[Variable], source: str, variable: str | None, group_is_one: bool) -> list[Variable]:
    signals = [one for one in variables if not one.is_time]
    if not variables:
        raise BadData(
            f"{source}: a recording must hold an array of real numbers, there is none; save the samples as one array"
        )
    if variable is None:
        is_one = group_is_one and len({one.group for one in signals}) == 1
        if len(signals) > 1 and not is_one:
            raise BadData(
                f"{source}: which array is meant must be statements, there are {_listed(signals)}; name one by "
                "--variable NAME, or several of one length by a pattern such as 'ch*'"
            )
        return signals or list(variables[:1])
    wanted = variable
    ways: list[Callable[[Variable], bool]] = [
        lambda one: wanted in (one.path, f"/{one.path}"),
        lambda one: one.name == wanted,
        lambda one: wanted.strip("/") == one.group and not one.is_time,
        lambda one: fnmatchcase(one.path, wanted) and not one.is_time,
    ]
    for index, way in enumerate(ways):
        found = [one for one in variables if way(one)]
        if len(found) == 1 or (found and index > 1):
            return found
        if found:
            raise BadData(f"{source}: variable {variable!r} is the name of several: {_listed(found)}; give the path")
    raise BadData(
        f"{source}: variable {variable!r} is none of those in the file, {_listed(variables)}; give one by --variable"
    )


def _listed(variables: Sequence[Variable]) -> str:
    more = f" and {len(variables) - _LISTED} more" if len(variables) > _LISTED else ""
    return ", ".join(map(str, variables[:_LISTED])) + more


def _levels(variable: Variable, statements: Mapping[str, Values]) -> Iterator[Values]:
    """Yield the named values of the array, of its groups and of the top of the file."""
    yield variable.about
    group = variable.group
    while group:
        yield statements.get(group, {})
        group = group.rpartition("/")[0]
    yield statements.get("", {})


def _first(levels: Sequence[Values], ask: Callable[[Values], Answer | None]) -> Answer | None:
    return next((answer for values in levels if (answer := ask(values)) is not None), None)


def _units(values: Values, n_channels: int) -> list[str | None] | None:
    units = stated_units(values, n_channels)
    return units if any(units) else None


class _Rates:
    """Sampling rates of arrays, from named values about them and from times next to them."""

    def __init__(
        self, variables: Sequence[Variable], statements: Mapping[str, Values], source: str, warnings: list[str]
    ) -> None:
        self._times = [one for one in variables if one.is_time]
        self._statements, self._source, self._warnings = statements, source, warnings
        # Times are read only once for all their channels.
        self._measured: dict[str, float | None] = {}

    def of(self, variable: Variable) -> tuple[float | None, str]:
        """Return the rate [Hz] and its origin, or None and "header"; raise `BadData` on contradictions."""
        stated = _first(list(_levels(variable, self._statements)), lambda values: stated_rate(values, self._source))
        found = [] if stated is None else [stated]
        for times in self._times:
            if times is variable or (times.group, times.n_samples) != (variable.group, variable.n_samples):
                continue
            if times.path not in self._measured and times.n_samples > 1:
                self._measured[times.path] = self._measure(times, None if stated is None else stated[1])
            rate = self._measured.get(times.path)
            if rate is not None:
                found.append((rate, f"array {times.path}"))
        for other in found[1:]:
            require_one_rate(found[0], other, self._source)
        return found[0] if found else (None, "header")

    def _measure(self, times: Variable, otherwise: str | None) -> float | None:
        try:
            _require_readable(times, self._source)
            unit = stated_time_unit(times.name, times.about)
            return rate_of_vector(times, unit, f"{self._source}: {times.path}")
        except BadData:
            if otherwise is None:
                raise
            self._warnings.append(f"the times of {times.path} are not even, the rate is that of {otherwise}")
            return None


def _require_readable(variable: Variable, source: str) -> None:
    if variable.fault:
        raise BadData(f"{source}: {variable.path} {variable.fault}; copy the file again, or save it as a plain array")


def _hertz(rate: float | None) -> str:
    return "none" if rate is None else f"{rate:.10g} Hz"


def _joined(chosen: Sequence[Variable], n_samples: int, source: str) -> Blocks:
    """Return the blocks of several one-channel arrays, `n_samples` long."""
    nothing: NDArray[Any] = np.empty((1, 0))

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        streams = [chosen[channel].blocks(length, (0,)) for channel in channels]
        waiting = [next(stream, nothing) for stream in streams]
        left = n_samples
        while left:
            # The pieces of the arrays may differ in length.
            n = min(left, *(piece.shape[1] for piece in waiting))
            if not n:
                raise BadData(
                    f"{source}: {n_samples} samples are declared, {n_samples - left} are there; copy it again"
                )
            yield np.concatenate([piece[:, :n] for piece in waiting])
            left -= n
            waiting = [
                piece[:, n:] if piece.shape[1] > n or not left else next(stream, nothing)
                for piece, stream in zip(waiting, streams, strict=True)
            ]

    return blocks

"""What is told of a recording: one record a finding, from which every output is made.

Lines, JSON, pages, MQTT, Prometheus, Modbus, the report, and the warnings of Python are made from these records, in
order of time; each is told once when it begins and once when it ends. All words are rows of findings.toml: a new kind
is a row there, and a `Finding` of its kind where it is found.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from cgid._lib.spelling import as_argument

__all__ = ["Finding", "FindingWarning", "Findings", "InWords", "SameBeamWarning"]

#: An option in the words: its name, and its value unless it is only named.
_OPTION = re.compile(r"<(\w+)(?:=([^>]*))?>")
#: Channels that are named in a line.
_MAX_NAMED = 3

#: Name and value (empty where it is only named) of a setting -> its words.
Speak = Callable[[str, str], str]


@cache
def words() -> Mapping[str, Mapping[str, Any]]:
    """Return the words of each kind."""
    return tomllib.loads(Path(__file__).with_name("findings.toml").read_text(encoding="utf-8"))


class InWords(str):
    """A step that is no command, such as filling in a table."""


class _Fields(dict[str, Any]):
    """The fields of the words; those that only a command fills are empty."""

    def __missing__(self, key: str) -> str:
        return ""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What was found of a recording, of one of its channels, or of what identifies it.

    Attributes
    ----------
    kind : str
        A row of findings.toml; a word for programs.
    channels : tuple of str
        Those concerned; empty for all.
    begin, end : float [s]
        Time in the recording; the begin is nan if it concerns all of it, the end as long as it stands.
    factor : float
        Of the samples over what they should be, or of the stated sampling rate over the true one; nan without one.
    odds : float
        Natural logarithm of the odds against "as in the training", beyond the limit from which on it is told.
    others : tuple of str
        Kinds that would explain it nearly as well.
    commands, instead : tuple of str
        The next steps as commands, in order, and the alternatives; in Python there are none.
    fields : mapping
        What else the words name.
    """

    kind: str
    channels: tuple[str, ...] = ()
    begin: float = math.nan
    end: float = math.nan
    factor: float = math.nan
    odds: float = math.nan
    others: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    instead: tuple[str, ...] = ()
    fields: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        return self.line("", 2).lstrip(" :")

    @property
    def number(self) -> int:
        """The number of its kind, for registers."""
        return int(words()[self.kind]["number"])

    @property
    def moves(self) -> bool:
        """Whether it can move answers, so that nothing may be decided while it stands."""
        return bool(words()[self.kind].get("moves"))

    @property
    def is_note(self) -> bool:
        """Whether it says what was done, and is no fault."""
        return bool(words()[self.kind].get("note"))

    @property
    def is_of_fraction(self) -> bool:
        """Whether it concerns the gangue fraction alone."""
        return bool(words()[self.kind].get("of_fraction"))

    @property
    def is_silent(self) -> bool:
        """Whether its channels give nothing that could be identified."""
        return bool(words()[self.kind].get("silent")) or "silent" in self.fields

    @property
    def is_explained(self) -> bool:
        """Whether it says nothing where another finding of its channel can move answers."""
        return bool(words()[self.kind].get("explained"))

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return math.isfinite(self.end)

    def concerns(self, support: str) -> bool:
        """Return whether it concerns a support: its channel, or one of its channels joined by "+"."""
        return not self.channels or not {support, *support.split("+")}.isdisjoint(self.channels)

    def what(self, speak: Speak = as_argument) -> str:
        """Return what is wrong, or at its end what is over; empty where nothing is said of the end."""
        if self.is_over:
            over = "" if "renamed" in self.fields else self._said("over", speak)
            return over and f"{over} at {self.end:.6g} s"
        since = f"since {self.begin:.6g} s: " if self.begin > 0 else ""
        return since + self._said("what", speak)

    def help(self, speak: Speak = as_argument) -> str:
        """Return what helps; empty if nothing is known to."""
        return "" if self.is_over else self._said("help", speak)

    def line(self, source: str, n_channels: int = 1, speak: Speak = as_argument) -> str:
        """Return all of it in one line, of a source with so many channels; empty where nothing is said of its end."""
        named, more = ", ".join(self.channels[:_MAX_NAMED]), len(self.channels) - _MAX_NAMED
        named += f" and {more} more" if more > 0 else ""
        plural = "s" if len(self.channels) > 1 else ""
        is_only = n_channels == 1 and self.channels == ("1",)
        where = f" channel{plural} {named}" if named and not is_only else ""
        what = self.what(speak)
        parts = "; ".join(part for part in (what, self.help(speak)) if part)
        return what and f"{source}{where}: {parts}{''.join(f': {step}' for step in self.commands[:1])}"

    def warning(self, line: str) -> FindingWarning:
        """Return its line as a warning of Python."""
        return (SameBeamWarning if words()[self.kind].get("of_beams") else FindingWarning)(line, self)

    def content(self, speak: Speak = as_argument) -> dict[str, Any]:
        """Return the record for JSON."""
        return {
            "finding": self.kind,
            "number": self.number,
            "channels": list(self.channels),
            "begin_s": _finite(self.begin),
            "end_s": _finite(self.end),
            "factor": _finite(self.factor),
            "odds": _finite(self.odds),
            "others": list(self.others),
            "moves_answers": self.moves,
            "note": self.is_note,
            "message": self.what(speak),
            "help": self.help(speak),
            "commands": list(self.commands),
            "instead": list(self.instead),
        }

    def _said(self, part: str, speak: Speak) -> str:
        template, fields = words()[self.kind][part], _Fields(self.fields)

        def option(match: re.Match[str]) -> str:
            name, value = match.groups()
            fields[f"<{name}>"] = speak(name, (value or "").format_map(fields))
            return f"{{<{name}>}}"

        return str(_OPTION.sub(option, template).format_map(fields))


class FindingWarning(UserWarning):
    """A finding as a warning of Python; `finding` is its record."""

    def __init__(self, text: str, finding: Finding) -> None:
        super().__init__(text, finding)
        self.finding = finding

    def __str__(self) -> str:
        return str(self.args[0])


class SameBeamWarning(FindingWarning):
    """A finding of channels that hear the same rocks and are not declared as of one beam, or the reverse."""


class Findings:
    """All findings of a recording, `all`, in the order in which they were told."""

    all: list[Finding]

    def tell(self, found: Iterable[Finding]) -> list[Finding]:
        """Take what begins and what ends, and return it as it is told: alike findings of several channels as one."""
        told: dict[tuple[Any, ...], Finding] = {}
        for one in found:
            if one.is_over:
                place = next((k for k, known in enumerate(self.all) if _is_of(known, one)), None)
                if place is None:
                    continue
                known = self.all[place]
                one = self.all[place] = replace(known, end=one.end, fields={**known.fields, **one.fields})
            else:
                self.all.append(one)
            key = (one.kind, *map(str, (one.begin, one.end, one.factor, one.commands)))
            alike = told.get(key, one)
            told[key] = replace(
                alike,
                channels=tuple(dict.fromkeys(alike.channels + one.channels)),
                others=tuple(dict.fromkeys(alike.others + one.others)),
            )
        return list(told.values())

    def standing(self, kind: str, channels: Sequence[str]) -> Finding | None:
        """Return what stands of a kind and of these channels."""
        return next((one for one in self.all if _is_of(one, Finding(kind=kind, channels=tuple(channels)))), None)

    @property
    def in_order(self) -> list[Finding]:
        """All findings in order of time, first those of the recording as a whole."""
        return sorted(self.all, key=lambda one: one.begin if math.isfinite(one.begin) else -math.inf)


def _is_of(known: Finding, one: Finding) -> bool:
    """Return whether a finding is the one, still standing, that another one ends."""
    return not known.is_over and (known.kind, known.channels) == (one.kind, one.channels)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

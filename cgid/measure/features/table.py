"""The table of features: entries of one feature, banks of many, and the lookup by name.

An entry has the name, unit, definition and source of a feature and how to measure it. `features.csv` describes them;
how they are measured is at the end of the module that does it: `PULSE_FEATURES` in `pulses.py`, `VIBRATION_FEATURES` in
`vibration.py`, `WINDOW_FEATURES` in `windows.py`. To add a feature, add a row::

    form_factor,1,positive,peak_force times contact_duration over impulse,cgid

and a line there::

    "form_factor": lambda p: p.peak * p.duration / p.moments[0],

and, for a new measurement, a property of the batch. Extraction, models, tables of scenes and `cgid features` find it
by its name. Features that differ in a band, a packet or a lag are one `Bank`, whose columns are built on first use.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue

#: Kind of an impact: one positive pulse, or a decaying vibration of both signs.
ImpactKind = Literal["pulse", "vibration"]
#: Kind of a signal: an impact, or a window of a recording with any number of impacts.
Kind = Literal[ImpactKind, "window"]
#: Least bandwidth [Hz], half of the sampling rate, of vibrations and windows, and of features of their bands on a mel
#: or an even scale, which are too wide below it.
LEAST_BANDWIDTH, MIN_BANDWIDTH = 125.0, 1000.0
#: Least number of samples of a vibration or window, which rates below 1.2 kHz make longer than usual, and the length of
#: windows by default at rates up to 2 kHz [s].
LEAST_SAMPLES, LOW_WINDOW_TIME = 175, 0.35


@dataclass(frozen=True, eq=False, repr=False)
class Feature:
    """One feature."""

    name: str
    unit: str  # `U` stands for the unit of the signal
    definition: str
    source: str
    measure: Callable[[Any], Floats]  # from a `PulseBatch`, `VibrationBatch` or `WindowBatch` to one number per row
    fitted: bool = False  # read from the fitted pulse, which exists even where the samples alone do not show the pulse
    positive: bool = False  # without a unit but always above 0, so that ratios are meaningful
    spectral: bool = False  # read from the spectrum
    whole_frame: bool = False  # depends on samples far from the pulse
    kind: Kind = "pulse"
    highest_frequency: float = 0.0  # lower limit of half the sampling rate [Hz]
    shortest_frame: float = 0.0  # least duration of a frame [s]
    extra: str = ""  # the extra of cgid that it needs; such a feature is measured only if named
    beam: bool = False  # inverted through a beam whose modes are given; the same is true

    @property
    def columns(self) -> tuple[str, ...]:
        """The name of the feature, its only column."""
        return (self.name,)

    def unit_for(self, signal_unit: str) -> str:
        """Return the unit for a signal in `signal_unit`."""
        compound = self.unit != "U" and not signal_unit.isalpha()
        return self.unit.replace("U", f"({signal_unit})" if compound else signal_unit)

    @property
    def linear(self) -> bool:
        """Whether its logarithm is meaningless: it is a logarithm already, or may have either sign."""
        return self.unit.startswith("log10") or (self.unit == "1" and not self.positive)


def described(measures: Mapping[str, Callable[[Any], Floats]], **about: Any) -> tuple[Feature, ...]:
    """Return the features of these names in `features.csv`; `about` has their common attributes."""
    return tuple(Feature(**_described(name), measure=measure, **about) for name, measure in measures.items())


def _described(name: str) -> dict[str, Any]:
    """Return the row of `features.csv` of a feature or a bank."""
    row = _descriptions()[name]
    return {key: row[key] for key in ("name", "unit", "definition", "source")} | dict.fromkeys(
        row["traits"].split(), True
    )


@cache
def _descriptions() -> dict[str, dict[str, str]]:
    with Path(__file__).with_name("features.csv").open(encoding="utf-8", newline="") as lines:
        return {row["name"]: row for row in csv.DictReader(lines)}


@dataclass(frozen=True, eq=False, repr=False)
class Bank:
    """Features that differ only in a band, a packet or a lag: one entry with a column for each label."""

    name: str  # with `*` instead of the label: `mel_*_hz` has the column `mel_1000_hz`
    unit: str
    definition: str  # with `*` for the label
    source: str
    measure: Callable[[Any, int], Floats]  # from a batch and the number of a column to one number per row
    labels: Sequence[str]
    fitted: bool = False
    spectral: bool = False
    kind: Kind = "pulse"
    # `highest_frequency`, `shortest_frame`: as in `Feature`, for all columns or for each
    highest_frequency: float | Sequence[float] = 0.0
    shortest_frame: float | Sequence[float] = 0.0
    extra: str = ""

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.name.replace("*", label) for label in self.labels)

    def column(self, name: str) -> Feature | None:
        """Return the feature of a column; None if the bank has no such column."""
        before, after = self.name.split("*")
        if not (name.startswith(before) and name.endswith(after)) or name not in self.columns:
            return None
        number, n = self.columns.index(name), len(self.columns)
        return Feature(
            name,
            self.unit,
            self.definition.replace("*", self.labels[number]),
            self.source,
            lambda batch: self.measure(batch, number),
            fitted=self.fitted,
            spectral=self.spectral,
            kind=self.kind,
            highest_frequency=float(np.broadcast_to(self.highest_frequency, n)[number]),
            shortest_frame=float(np.broadcast_to(self.shortest_frame, n)[number]),
            extra=self.extra,
        )

    def less(self, name: str, total: Feature) -> Bank:
        """Return the bank of levels minus a total level, which cancels the gain of the sensor."""
        return replace(
            self,
            name=name,
            unit="1",
            definition=f"{self.name} minus {total.name}: the gain of the sensor cancels",
            measure=lambda batch, number: self.measure(batch, number) - total.measure(batch),
        )


def bank(name: str, measure: Callable[[Any, int], Floats], labels: Sequence[str], **about: Any) -> Bank:
    """Return the bank of this name in `features.csv`."""
    return Bank(**_described(name), measure=measure, labels=labels, **about)


class FeatureTable(Mapping[str, Feature]):
    """Features by name, in column order; those of a bank are built on first use, one's own come last."""

    def __init__(self, entries: Sequence[Feature | Bank], outside: Callable[[], Mapping[str, Feature]] = dict) -> None:
        self.entries, self._outside = tuple(entries), outside
        self._built = {entry.name: entry for entry in entries if isinstance(entry, Feature)}
        self._banks = [entry for entry in entries if isinstance(entry, Bank)]
        self._own: dict[str, Feature] = {}

    def __getitem__(self, name: str) -> Feature:
        if name not in self._built:
            for bank in self._banks:
                feature = bank.column(name)
                if feature is not None:
                    self._built[name] = feature
                    return feature
            return self._own[name] if name in self._own else self._outside()[name]
        return self._built[name]

    def __iter__(self) -> Iterator[str]:
        yield from (name for entry in self.entries for name in entry.columns)
        yield from {**self._outside(), **self._own}

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def add(self, feature: Feature) -> str:
        """Add a feature of one's own, in place of an earlier one of its name; return the name."""
        if any(feature.name in entry.columns for entry in self.entries):
            raise InvalidValue(f"feature: name must not be that of a feature of cgid, got {feature.name!r}; rename it")
        self._own[feature.name] = feature
        return feature.name

    def is_own(self, name: str) -> bool:
        """Return whether this process has added a feature, which others do not know."""
        return name in self._own

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Return the names of a kind's features that need neither an extra nor a beam."""
        names = (
            entry
            for entry in self.entries
            if entry.kind == kind and not entry.extra and not (isinstance(entry, Feature) and entry.beam)
        )
        return tuple(name for entry in names for name in entry.columns)

    def expand(self, name: str) -> tuple[str, ...]:
        """Return the columns of the bank of this name; for any other name, the name alone."""
        return next((bank.columns for bank in self._banks if bank.name == name), (name,))

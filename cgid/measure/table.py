"""The table of features: entries of one feature, banks of many, and the lookup by name.

An entry says what a feature is called, its unit, definition and source, and how it is measured. Entries stand in the
module that measures them, below the batch that they read: `PULSE_FEATURES` in `pulses.py`, `VIBRATION_FEATURES` in
`vibration.py`, `WINDOW_FEATURES` in `windows.py`. To add a feature, add a line there::

    Feature("form_factor", "1", "peak_force times contact_duration over impulse", "cgid",
            lambda p: p.peak * p.duration / p.moments[0], positive=True),

and, if it needs a new measurement, a property of the batch. Nothing else changes: extraction, models, tables of scenes
and `cgid features` find it by its name. Features that differ in a band, a packet or a lag are one `Bank`; its columns
are built when they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from cgid.validation import Floats

#: What an impact looks like: one positive pulse, or a vibration of both signs that decays.
ImpactKind = Literal["pulse", "vibration"]
#: What a feature is measured on: an impact, or a window of a recording with any number of impacts in it.
Kind = Literal[ImpactKind, "window"]
#: Vibrations and windows need at least this bandwidth, half of the lowest sampling rate [Hz].
LEAST_BANDWIDTH = 1000.0
#: Part of the definition of features that depend on all of the spectrum, including its faint end.
OF_THE_RATE = "taken up to half the sampling rate, on which it depends: compare at one rate"


@dataclass(frozen=True, eq=False)
class Feature:
    """One feature.

    Attributes
    ----------
    name : str
    unit : str
        `U` stands for the unit of the signal.
    definition, source : str
    measure : callable
        From a `PulseBatch`, `VibrationBatch` or `WindowBatch` to one number per row.
    fitted : bool
        Whether it is read from the fitted pulse, which exists even where the samples alone do not show the pulse.
    positive : bool
        Whether it is without a unit but always above 0, so that its ratios count.
    spectral : bool
        Whether it is read from the spectrum.
    whole_frame : bool
        Whether it depends on samples far from the pulse.
    kind : {"pulse", "vibration", "window"}
        What it is measured on.
    highest_frequency : float
        Half the sampling rate must be at least this [Hz].
    shortest_frame : float
        A frame must last at least this long [s].
    extra : str
        The extra of cgid that it needs; such a feature is measured only when it is named.
    """

    name: str
    unit: str
    definition: str
    source: str
    measure: Callable[[Any], Floats]
    fitted: bool = False
    positive: bool = False
    spectral: bool = False
    whole_frame: bool = False
    kind: Kind = "pulse"
    highest_frequency: float = 0.0
    shortest_frame: float = 0.0
    extra: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """The name of the feature, its only column."""
        return (self.name,)

    def unit_for(self, signal_unit: str) -> str:
        """Return the unit when the signal is in `signal_unit`."""
        compound = self.unit != "U" and not signal_unit.isalpha()
        return self.unit.replace("U", f"({signal_unit})" if compound else signal_unit)

    @property
    def linear(self) -> bool:
        """Whether its logarithm makes no sense: it is a logarithm already, or may have either sign."""
        return self.unit.startswith("log10") or (self.unit == "1" and not self.positive)


@dataclass(frozen=True, eq=False)
class Bank:
    """Features that differ only in a band, a packet or a lag: one entry, a column for each label.

    Attributes
    ----------
    name : str
        With `*` in place of the label: `mel_*_hz` has the column `mel_1000_hz`.
    unit, definition, source : str
        As in `Feature`; `*` in the definition stands for the label.
    measure : callable
        From a batch and the number of a column to one number per row.
    labels : sequence of str
    spectral, kind, extra
        As in `Feature`.
    highest_frequency, shortest_frame : float or sequence of float
        As in `Feature`, for all columns or for each.
    """

    name: str
    unit: str
    definition: str
    source: str
    measure: Callable[[Any, int], Floats]
    labels: Sequence[str]
    spectral: bool = False
    kind: Kind = "pulse"
    highest_frequency: float | Sequence[float] = 0.0
    shortest_frame: float | Sequence[float] = 0.0
    extra: str = ""

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns."""
        return tuple(self.name.replace("*", label) for label in self.labels)

    def column(self, name: str) -> Feature | None:
        """Return the feature of a column, None if the bank has no column of this name."""
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
            spectral=self.spectral,
            kind=self.kind,
            highest_frequency=float(np.broadcast_to(self.highest_frequency, n)[number]),
            shortest_frame=float(np.broadcast_to(self.shortest_frame, n)[number]),
            extra=self.extra,
        )

    def less(self, name: str, total: Feature) -> Bank:
        """Return the bank of the levels minus a total level, from which the gain of the sensor cancels."""
        return Bank(
            name,
            "1",
            f"{self.name} minus {total.name}: the gain of the sensor cancels",
            self.source,
            lambda batch, number: self.measure(batch, number) - total.measure(batch),
            self.labels,
            kind=self.kind,
            highest_frequency=self.highest_frequency,
            shortest_frame=self.shortest_frame,
            extra=self.extra,
        )


class Table(Mapping[str, Feature]):
    """Features by name, in the order of the columns; those of a bank are built when they are asked for.

    Parameters
    ----------
    entries : sequence of Feature or Bank
    """

    def __init__(self, entries: Sequence[Feature | Bank]) -> None:
        self.entries = tuple(entries)
        self._built = {entry.name: entry for entry in entries if isinstance(entry, Feature)}
        self._banks = [entry for entry in entries if isinstance(entry, Bank)]

    def __getitem__(self, name: str) -> Feature:
        if name not in self._built:
            for bank in self._banks:
                feature = bank.column(name)
                if feature is not None:
                    self._built[name] = feature
                    break
        return self._built[name]

    def __iter__(self) -> Iterator[str]:
        return (name for entry in self.entries for name in entry.columns)

    def __len__(self) -> int:
        return sum(len(entry.columns) for entry in self.entries)

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Return the features of a kind that need no extra."""
        own = (entry for entry in self.entries if entry.kind == kind and not entry.extra)
        return tuple(name for entry in own for name in entry.columns)

    def expand(self, name: str) -> tuple[str, ...]:
        """Return the columns of the bank of this name; any other name as it is."""
        return next((bank.columns for bank in self._banks if bank.name == name), (name,))

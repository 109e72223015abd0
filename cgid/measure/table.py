"""What a feature is: one line of the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from cgid.validation import Floats

#: What a signal is like: a single positive pulse, a vibration of both signs that dies away, or a window of a recording
#: in which anything may happen.
ImpactKind = Literal["pulse", "vibration"]
#: What features are measured on: an impact, or a window of a recording, in which any number of them may lie.
Kind = Literal[ImpactKind, "window"]
#: What a definition says of a feature that the whole spectrum tells, where little energy lies, too.
OF_THE_RATE = "taken up to half the sampling rate, on which it depends: compare at one rate"


@dataclass(frozen=True)
class Feature:
    """One feature of an impact.

    Attributes
    ----------
    name : str
    unit : str
        `U` stands for the unit of the signal.
    definition : str
    source : str
    measure : callable
        From a `PulseBatch`, a `VibrationBatch` or a `WindowBatch` to one number a row.
    fitted : bool
        Whether it is read from the fitted pulse, which can be had where samples alone tell nothing.
    positive : bool
        Whether, without a unit, it is always above 0 and its ratios are what counts.
    spectral : bool
        Whether it is read from the spectrum.
    whole_frame : bool
        Whether it looks at samples far from the pulse.
    kind : {"pulse", "vibration", "window"}
        What it can be measured on.
    highest_frequency : float
        Half the sampling rate must be at least this [Hz].
    shortest_frame : float
        A frame must last at least this long [s].
    extra : str
        The extra of cgid that it needs installed; such a feature is measured only when asked by its name.
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

    def unit_for(self, signal_unit: str) -> str:
        """Return the unit when the signal is in `signal_unit`."""
        compound = self.unit != "U" and not signal_unit.isalpha()
        return self.unit.replace("U", f"({signal_unit})" if compound else signal_unit)

    @property
    def linear(self) -> bool:
        """Whether a logarithm of it makes no sense: it is one already, or may be of either sign."""
        return self.unit.startswith("log10") or (self.unit == "1" and not self.positive)

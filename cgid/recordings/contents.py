"""What a file holds before the options have spoken, and how both become signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.signals import UNITS, Signal, quantity_of

#: More channels than this are samples written along the wrong axis.
MAX_CHANNELS = 4096

#: Two statements of one sampling rate may differ by this part; clocks are that good, typing errors are not.
RATE_TOLERANCE = 1e-3


@dataclass(frozen=True, kw_only=True)
class Contents:
    """Channels of a file with what the file itself says about them.

    Parameters
    ----------
    samples : ndarray, (n_channels, n_samples)
        float32 or float64.
    names : sequence of str
        One a channel, "" where the file gives none.
    units : sequence of str or None
        One a channel, None where the file gives none that is known.
    sampling_rate : float or None
        [Hz], as the file says.
    rate_from : str
        Where in the file the sampling rate is said.
    fallback_unit : str or None
        The unit if neither the file nor the user gives one.
    """

    samples: NDArray[Any]
    names: Sequence[str] = ()
    units: Sequence[str | None] = ()
    sampling_rate: float | None = None
    rate_from: str = "header"
    fallback_unit: str | None = None

    def signals(
        self, source: str, *, sampling_rate: float | None, unit: str | None, channel: int | str | None
    ) -> list[Signal]:
        """Return one `Signal` a channel, or the one selected.

        Raises
        ------
        BadData, MissingOption, InvalidValue
            As `cgid.recordings.read_recording` says.
        """
        if not self.samples.size:
            raise BadData(f"{source}: a recording must hold at least one sample, there is none; record it again")
        if len(self.samples) > MAX_CHANNELS:
            raise BadData(
                f"{source}: at most {MAX_CHANNELS} channels, got {len(self.samples)} of {self.samples.shape[1]} "
                "samples; transpose it if each row is one channel in full"
            )
        selected = range(len(self.samples)) if channel is None else [self._selected(channel, source)]
        rate = self._rate(sampling_rate, source)
        return [
            Signal(
                samples=np.ascontiguousarray(self.samples[index]),
                sampling_rate=rate,
                unit=self._unit(index, unit, source),
                source=source,
                channel=self._label(index),
            )
            for index in selected
        ]

    def _name(self, index: int) -> str:
        return self.names[index] if index < len(self.names) else ""

    def _label(self, index: int) -> str:
        # A single channel needs no name to be told apart.
        return "1" if len(self.samples) == 1 else self._name(index) or str(index + 1)

    def _selected(self, channel: int | str, source: str) -> int:
        names = [self._name(index) for index in range(len(self.samples))]
        if isinstance(channel, str) and channel and names.count(channel) == 1:
            return names.index(channel)
        wanted = str(channel)
        # By way of its text, as True would otherwise quietly be the first channel.
        if wanted.isascii() and wanted.isdigit() and len(wanted) < 9:
            number = int(wanted)
            if 1 <= number <= len(names):
                return number - 1
        listed = ", ".join(f"{k} ({name})" if name else str(k) for k, name in enumerate(names[:20], 1))
        more = ", ..." if len(names) > 20 else ""
        fault = "is the name of several" if names.count(wanted) > 1 else "is none of them"
        raise InvalidValue(f"{source}: channel {channel!r} {fault}; choose one of {listed}{more} by --channel")

    def _rate(self, given: float | None, source: str) -> float:
        stated = self.sampling_rate
        if stated is not None and not (np.isfinite(stated) and stated > 0):
            raise BadData(
                f"{source}: sampling rate must be above 0 and finite, the {self.rate_from} says {stated:g} Hz; "
                "correct it"
            )
        if stated is None:
            if given is None:
                raise MissingOption(f"{source}: the file does not say the sampling rate; give it with --rate HZ")
            return given
        if given is None:
            return stated
        if not rates_agree(given, stated):
            raise InvalidValue(
                f"{source}: sampling_rate must agree with the file to 0.1 %, got {given:.10g} Hz where the "
                f"{self.rate_from} says {stated:.10g} Hz; leave out --rate or correct it"
            )
        return given

    def _unit(self, index: int, given: str | None, source: str) -> str | None:
        stated = self.units[index] if index < len(self.units) else None
        if given is None or stated is None:
            return given or stated or self.fallback_unit
        if _meaning(given) == _meaning(stated):
            return stated
        raise BadData(
            f"{source}: channel {self._label(index)} must be in one unit, its header says {stated} "
            f"({quantity_of(stated)}) and --unit says {given} ({quantity_of(given)}); leave out --unit or correct the "
            "header, or pick another channel with --channel"
        )


def rates_agree(first: float, second: float) -> bool:
    """Return whether two statements of one sampling rate [Hz] agree to 0.1 %.

    Examples
    --------
    >>> rates_agree(50_000.0, 49_993.05), rates_agree(50_000.0, 51_200.0)
    (True, False)
    """
    return abs(first - second) <= RATE_TOLERANCE * min(first, second)


def _meaning(unit: str) -> tuple[str, float]:
    quantity = quantity_of(unit)
    return quantity, UNITS[quantity][unit]

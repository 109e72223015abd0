"""A single signal, and a labelled batch of signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import units
from cgid._lib import validation
from cgid._lib.notebook import counts_text, facts_table
from cgid._lib.terminal import counted
from cgid._lib.validation import rates_agree, require_rate
from cgid.errors import BadData, InvalidValue


@dataclass(frozen=True, eq=False)
class Signal:
    """One channel of samples with its sampling rate, unit and origin.

    Parameters
    ----------
    samples : ndarray, (n_samples,)
        Finite numbers in `unit`; float32 and float64 are kept, integers become float64.
    sampling_rate : float
        [Hz], above 0.
    unit : str or None
        One of `cgid.units.UNITS`; None if unknown.
    source : str
        Origin, such as a file name.
    channel : str
        Channel of the source.
    pre_trigger : int or None
        Number of samples before onset, if known.
    start_time : datetime or None
        Time of the first sample, if known.
    warnings : tuple of str
        Damaged parts of the source that were skipped.

    Raises
    ------
    BadData
        Samples are not one-dimensional, empty or not finite (the message names the sample).
    InvalidValue
        Sampling rate, unit or pre-trigger is invalid, or samples are masked.
    """

    samples: NDArray[Any]
    sampling_rate: float
    unit: str | None = None
    _: KW_ONLY
    source: str = "signal"
    channel: str = "1"
    pre_trigger: int | None = None
    start_time: datetime | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        name = channel_name(self.source, self.channel)
        samples = validation.plain(f"{name}: samples", self.samples)
        if samples.dtype.kind not in "fiu":
            raise BadData(f"{name}: samples must be real numbers, got type {samples.dtype}")
        if samples.dtype not in (np.float32, np.float64):
            samples = samples.astype(np.float64)
        if samples.ndim != 1 or not samples.size:
            raise BadData(f"{name}: samples must be one row of at least one number, got shape {samples.shape}")
        finite = np.isfinite(samples)
        if not finite.all():
            first = int(np.argmin(finite))
            raise BadData(
                f"{name}: samples must be finite, sample {first} is {samples[first]} "
                f"({np.sum(~finite)} of {samples.size} are not finite); cut or repair the recording there"
            )
        rate = require_rate(self.sampling_rate)
        if self.unit is not None:
            units.quantity_of(self.unit)
        if self.pre_trigger is not None:
            validation.whole("pre_trigger", self.pre_trigger, 0, samples.size - 1)
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "sampling_rate", rate)

    def __repr__(self) -> str:
        return (
            f"Signal({self.name!r}: {len(self.samples)} samples at {self.sampling_rate:g} Hz "
            f"[{self.unit or 'unit unknown'}], {self.duration:.4g} s)"
        )

    def _repr_html_(self) -> str:
        unit = self.unit or ""
        facts = {
            "samples": f"{len(self.samples)} at {self.sampling_rate:g} Hz, {self.duration:.4g} s",
            "quantity": f"{self.quantity} [{unit}]" if unit else "unit unknown",
            "range": f"{self.samples.min():.4g} to {self.samples.max():.4g} {unit}",
        }
        if self.start_time is not None:
            facts["start"] = self.start_time.isoformat(" ")
        return facts_table(
            f"Signal {self.name}", facts | ({"warnings": "; ".join(self.warnings)} if self.warnings else {})
        )

    def spectrum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return frequencies [Hz] and the magnitude of the Fourier transform of the signal.

        Returns
        -------
        frequency : ndarray, (n_samples // 2 + 1,) [Hz]
        magnitude : ndarray
            [unit s]; at 0 Hz that of the integral of the signal.

        Examples
        --------
        >>> frequency, magnitude = Signal(samples=np.ones(4), sampling_rate=2.0).spectrum()
        >>> frequency.tolist(), magnitude.tolist()
        ([0.0, 0.5, 1.0], [2.0, 0.0, 0.0])
        """
        frequency = np.arange(self.samples.size // 2 + 1) * self.sampling_rate / self.samples.size
        return frequency, np.abs(np.fft.rfft(self.samples.astype(np.float64))) / self.sampling_rate

    def plot(self, axes: Any = None) -> Any:
        """Draw the signal over time.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            New ones by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        MissingExtra
            matplotlib is not installed.
        """
        from cgid.plots.objects import plot_signal

        return plot_signal(self, axes)

    @property
    def name(self) -> str:
        """Source, and the channel unless it is "1"."""
        return channel_name(self.source, self.channel)

    @property
    def quantity(self) -> str | None:
        """Physical quantity of the unit; None if the unit is unknown."""
        return None if self.unit is None else units.quantity_of(self.unit)

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return len(self.samples) / self.sampling_rate

    def in_si(self) -> Signal:
        """Return the signal in the SI unit of its quantity.

        Returns
        -------
        Signal

        Examples
        --------
        >>> signal = Signal(samples=np.array([1.0, 2.0]), sampling_rate=1e5, unit="kN").in_si()
        >>> signal.samples.tolist(), signal.unit
        ([1000.0, 2000.0], 'N')
        """
        if self.unit is None:
            return self
        factor, si = units.si_of(self.unit)
        return self if self.unit == si else replace(self, samples=self.samples * factor, unit=si)

    def inverted(self) -> Signal:
        """Return the signal with the opposite sign.

        Returns
        -------
        Signal
        """
        return replace(self, samples=-self.samples)


def require_stated(samples: Any, sampling_rate: float | None = None, unit: str | None = None) -> None:
    """Raise `InvalidValue` if a given rate [Hz] or unit is not that of a signal, batch or dataset, which states it."""
    stated, kind = samples.sampling_rate, type(samples).__name__
    if sampling_rate is not None and not rates_agree(rate := require_rate(sampling_rate), stated):
        raise InvalidValue(
            f"sampling_rate must be that of the {kind}, {stated:.10g} Hz, got {rate:.10g} Hz; correct one"
        )
    if unit is not None and units.meaning_of(unit) != units.meaning_of(samples.unit):
        raise InvalidValue(f"unit must be that of the {kind}, {samples.unit}, got {unit}; correct one")


def channel_name(source: str, channel: str) -> str:
    """Return the name of a source, and of its channel unless that is "1"."""
    return source if channel == "1" else f"{source} channel {channel}"


def force_factor(unit: str | None, mass: float, name: str) -> float:
    """Return the factor from an acceleration to the contact force [N] of an impactor of this mass [kg]."""
    mass = validation.number("mass", mass, "kg", validation.positive)
    quantity = None if unit is None else units.quantity_of(unit)
    if unit is None or quantity != "acceleration":
        raise InvalidValue(f"{name}: mass turns an acceleration into a force, this is {quantity}; leave the mass out")
    return mass * units.UNITS[quantity][unit]


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Signals of one kind, one impact each, as a rule with their labels.

    Parameters
    ----------
    signals : ndarray, (n_signals, n_samples), or (n_signals, n_sensors, n_samples)
        In `unit`.
    labels : ndarray of str, (n_signals,), optional
        Empty texts if they are not known.
    sampling_rate : float
        [Hz].
    unit : str
    pre_trigger : int
        Number of samples before onset.
    specimen : ndarray of uint64, (n_signals,), optional
        Number of the rock; all impacts of a rock must be on the same side of a split. By default each is of another.
    parameters : dict of ndarray, each (n_signals,)
        Values from which the signals were made, if known.
    source : str
        Identity of the data, such as the SHA-256 of the scene.

    Raises
    ------
    BadData
        The signals are not rows of real numbers, or another column has not one entry for each of them.
    InvalidValue
        Sampling rate, unit, pre-trigger or a specimen is invalid, or a label breaks the rule of
        `cgid._lib.validation.label`.
    """

    signals: NDArray[Any]
    labels: NDArray[np.str_] = None  # type: ignore[assignment]
    sampling_rate: float
    unit: str
    pre_trigger: int
    specimen: NDArray[np.uint64] = None  # type: ignore[assignment]
    parameters: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        signals = validation.plain("signals", self.signals)
        if signals.ndim not in (2, 3) or signals.dtype.kind not in "fiu":
            raise BadData(f"signals must be rows of real numbers, got shape {signals.shape} of type {signals.dtype}")
        if signals.dtype not in (np.float32, np.float64):
            signals = signals.astype(np.float64)
        n = len(signals)
        labels = np.full(n, "") if self.labels is None else validation.plain("labels", self.labels)
        specimen = np.arange(n) if self.specimen is None else validation.plain("specimen", self.specimen)
        for name, column in {"labels": labels, "specimen": specimen, **self.parameters}.items():
            if np.shape(column) != (n,):
                raise BadData(f"{name} must have one entry for each of {n} signals, got shape {np.shape(column)}")
        if (names := set(labels.tolist())) != {""}:
            for label in names:
                validation.label("label", label)
        if specimen.dtype != np.uint64:
            if specimen.dtype.kind not in "iu" or (n and specimen.min() < 0):
                raise InvalidValue(
                    f"specimen must be whole numbers of 0 or more, got {validation.shown(specimen[:3].tolist())}; "
                    "number them, as by np.unique(names, return_inverse=True)[1]"
                )
            specimen = specimen.astype(np.uint64)
        units.quantity_of(self.unit)
        validation.whole("pre_trigger", self.pre_trigger, 0, max(signals.shape[-1] - 1, 0))
        checked = {"signals": signals, "labels": labels.astype(str, copy=False), "specimen": specimen}
        for name, value in {**checked, "sampling_rate": require_rate(self.sampling_rate)}.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.signals)

    def __getitem__(self, rows: Any) -> Batch:
        """Return the signals of a slice, a mask or an array of indices, with their labels, specimens and parameters."""
        try:
            chosen = np.arange(len(self))[rows]
        except IndexError:
            chosen = None
        if np.ndim(chosen) != 1:
            raise InvalidValue(
                f"index must be a slice, a mask or indices of {len(self)} signals, as in batch[:5], got "
                f"{validation.shown(rows)}; batch.signals[0] has the samples of a signal"
            )
        parameters = {name: column[chosen] for name, column in self.parameters.items()}
        columns = {name: getattr(self, name)[chosen] for name in ("signals", "labels", "specimen")}
        return replace(self, **columns, parameters=parameters)

    def __repr__(self) -> str:
        size = f"{counted(len(self), 'signal')} of {self.signals.shape[-1]} samples"
        return f"Batch({size} at {self.sampling_rate:g} Hz [{self.unit}]: {counts_text(self.counts) or 'no labels'})"

    def _repr_html_(self) -> str:
        facts = {
            "signals": f"{len(self)} of {self.signals.shape[-1]} samples at {self.sampling_rate:g} Hz [{self.unit}]",
            "labels": counts_text(self.counts) or "none",
            "rocks": len(np.unique(self.specimen)),
            "parameters": ", ".join(self.parameters) or "none",
        }
        return facts_table("Batch", facts)

    @property
    def labelled(self) -> bool:
        """Whether its labels are known."""
        return bool(len(self) and self.labels[0])

    @property
    def counts(self) -> dict[str, int]:
        """Number of signals of each label."""
        labels, counts = np.unique(self.labels[: len(self) * self.labelled], return_counts=True)
        return dict(zip(labels.tolist(), counts.tolist(), strict=True))

    def in_si(self) -> Batch:
        """Return the batch in the SI unit of its quantity.

        Returns
        -------
        Batch
        """
        factor, si = units.si_of(self.unit)
        return self if factor == 1 else replace(self, signals=self.signals * factor, unit=si)

    def plot(self, n: int = 20, axes: Any = None) -> Any:
        """Draw the first signals of each label over time.

        Parameters
        ----------
        n : int
            Number of signals of each label, at most 200.
        axes : matplotlib.axes.Axes, optional
            New ones by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        MissingExtra
            matplotlib is not installed.
        """
        from cgid.plots.objects import plot_batches

        return plot_batches([self], n, "Batch", axes)

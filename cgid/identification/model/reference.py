"""The reference run of a sensor: its mean spectrum, the equalisation from it, and the drift of a session.

Sensors and supports differ in response by some 4 dB, which costs more accuracy than noise. So each sensor records the
same kind of flow once, and signals are equalised from the spectrum of their sensor to the mean of all sensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, require_rate
from cgid.errors import BadData, InvalidValue
from cgid.measure.features.windows import WindowBatch
from cgid.measure.filters import Equalisation
from cgid.measure.spectra import MEL_BANDS

#: Drift of a session that causes a warning [dB].
MAX_DRIFT = 3.0
#: Standard errors subtracted before the warning: the spectrum of few impacts is uncertain.
_STANDARD_ERRORS = 2.0
#: Windows measured at once.
_ROWS = 32
#: Sensor -> equalisation of each channel.
Equalisations = Mapping[str, Sequence[Equalisation]]


class MeanSpectrum:
    """The mean power of a run in each mel band; bands above half the rate [Hz] get the highest level below it."""

    def __init__(self, sampling_rate: float) -> None:
        self.sampling_rate = require_rate(sampling_rate)
        self.n_bands = len(MEL_BANDS.within(0.5 * self.sampling_rate))
        if not self.n_bands:
            raise InvalidValue(
                f"sampling_rate must be {2 * np.ceil(MEL_BANDS.corners[2]):g} Hz or more for a mel band, "
                f"got {self.sampling_rate:g} Hz"
            )
        self.n_windows = 0
        self._sum, self._squares = np.zeros(self.n_bands), np.zeros(self.n_bands)

    def feed(self, windows: NDArray[np.floating]) -> None:
        """Add non-overlapping windows (n_windows, n_samples); those without a signal are skipped."""
        for first in range(0, len(windows), _ROWS):
            batch = WindowBatch(windows[first : first + _ROWS], self.sampling_rate)
            usable = np.setdiff1d(np.arange(len(batch.samples)), list(batch.problems()))
            power = batch.mel_power[usable]
            self.n_windows += usable.size
            self._sum += power.sum(axis=0)
            self._squares += np.square(power).sum(axis=0)

    @property
    def levels(self) -> Floats:
        """Log10 of the mean square in each of `MEL_BANDS`, (n_bands,); `BadData` if no window had a signal."""
        return self._for_all_bands(np.log10(self._mean))

    @property
    def deviations(self) -> Floats:
        """Standard error of the levels from the variation between windows [dB], (n_bands,); infinite for one window."""
        mean, n = self._mean, self.n_windows
        if n < 2:
            return np.full(len(MEL_BANDS), np.inf)
        variance = np.maximum(self._squares / n - mean**2, 0.0) / (n - 1)
        return self._for_all_bands(10.0 / np.log(10.0) * np.sqrt(variance) / mean)

    @property
    def _mean(self) -> Floats:
        if not self.n_windows:
            raise BadData(
                "a reference run must contain a window of signal, it has none: check the sensor and its cable"
            )
        return np.maximum(self._sum / self.n_windows, np.finfo(np.float64).tiny)

    def _for_all_bands(self, values: Floats) -> Floats:
        return np.append(values, np.full(len(MEL_BANDS) - values.size, values[-1]))


def target_spectrum(references: Iterable[ArrayLike]) -> Floats:
    """Return the target of all equalisations: the mean of the reference spectra, (n_bands,)."""
    rows = [validation.real("reference spectrum", row) for row in references]
    if not rows or any(row.shape != (len(MEL_BANDS),) for row in rows):
        raise InvalidValue(f"reference spectra must be one or more rows of {len(MEL_BANDS)} levels, got {len(rows)}")
    return np.asarray(np.mean(rows, axis=0))


def equalisations_of(spectra: Mapping[str, Floats]) -> Equalisations:
    """Return the equalisations of sensors from their reference spectra (n_channels, n_bands) to the mean of all."""
    if not spectra:
        return {}
    n_channels = len(next(iter(spectra.values())))
    targets = [target_spectrum([of_sensor[channel] for of_sensor in spectra.values()]) for channel in range(n_channels)]
    return {
        sensor: tuple(Equalisation.between(measured, meant) for measured, meant in zip(of_sensor, targets, strict=True))
        for sensor, of_sensor in spectra.items()
    }


@dataclass(frozen=True, kw_only=True)
class Drift:
    """The difference of a session from the reference run of its sensor."""

    level: float  # mean over the bands [dB]
    largest: float  # difference in the band that differs most clearly [dB]
    frequency: float  # centre of that band [Hz]
    certain: float  # smallest difference in that band compatible with the variation between windows [dB]

    def warning(self, sensor: str) -> str | None:
        """Return a one-line warning, or None if the drift is small enough."""
        if self.certain <= MAX_DRIFT:
            return None
        return (
            f"sensor {sensor} must be within {MAX_DRIFT:g} dB of its reference run, it is {self.largest:+.1f} dB "
            f"off at {self.frequency:.0f} Hz ({self.level:+.1f} dB in the mean): check its mount, cable and gain, or "
            "record a new reference run"
        )


def drift(session: MeanSpectrum, reference: ArrayLike) -> Drift:
    """Return the drift of a session from the reference spectrum (n_bands,) of its sensor, for a similar flow."""
    of_session = slice(0, session.n_bands)
    difference = 10.0 * (session.levels - validation.real("reference", reference))[of_session]
    # The band with the most significant difference, not one raised by a single impact.
    certain = np.maximum(np.abs(difference) - _STANDARD_ERRORS * session.deviations[of_session], 0.0)
    strongest = int(np.argmax(certain)) if certain.any() else int(np.argmax(np.abs(difference)))
    return Drift(
        level=float(difference.mean()),
        largest=float(difference[strongest]),
        frequency=float(MEL_BANDS.centres[strongest]),
        certain=float(certain[strongest]),
    )

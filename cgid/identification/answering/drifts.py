"""How far the sensors of a session have drifted from their reference runs, while its samples pass by."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cgid.identification.model import Model
from cgid.identification.reference import MeanSpectrum, drift


class Drifts:
    """The mean spectra of channels whose sensors are known.

    Parameters
    ----------
    model : Model
    sensors : sequence of str or None
        Of each channel, or of each group of channels that the model looks at together.
    sampling_rate : float
        [Hz].
    """

    def __init__(self, model: Model, sensors: Sequence[str | None], sampling_rate: float) -> None:
        self._model, self._sensors = model, sensors
        # Windows that overlap tell the same again, and a spectrum would seem surer than it is.
        self._every = max(math.ceil(model.window_time / model.hop_time - 1e-9), 1) if model.hop_time else 1
        self._seen = [0] * len(sensors)
        self._spectra = [[MeanSpectrum(sampling_rate) for _ in range(model.n_channels)] if s else [] for s in sensors]

    def see(self, number: int, windows: NDArray[np.floating]) -> None:
        """Look at the next windows (n_windows, n_channels, n_samples) of one of the sensors."""
        apart = windows[-self._seen[number] % self._every :: self._every]
        self._seen[number] += len(windows)
        for channel, spectrum in enumerate(self._spectra[number]):
            spectrum.feed(apart[:, channel])

    def warnings(self) -> tuple[str, ...]:
        """Return what is to be said of those that have drifted too far, one line each."""
        said: list[str] = []
        for sensor, spectra in zip(self._sensors, self._spectra, strict=True):
            if sensor is None:
                continue
            own = self._model.arrays["reference.spectra"][self._model.sensors.index(sensor)]
            for spectrum, reference in zip(spectra, own, strict=True):
                if spectrum.n_windows and (warning := drift(spectrum, reference).warning(sensor)):
                    said.append(warning)
        return tuple(dict.fromkeys(said))

"""The energy of transients over frequency, and how much of it lies between two frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cgid.validation import Floats


@dataclass(frozen=True, eq=False)
class EnergySpectrum:
    """One-sided energy spectra of rows of samples, all on the same frequencies.

    Attributes
    ----------
    spacing : float
        Width of a bin [Hz]; the first is centred at 0 Hz.
    energy : ndarray, (n_signals, n_bins)
        In each bin [unit^2 s]; the bins of a row add up to its sum of squares over the sampling rate (Parseval).
    """

    spacing: float
    energy: Floats

    @classmethod
    def of(cls, samples: Floats, sampling_rate: float, finer: int = 1) -> EnergySpectrum:
        """Return the spectra of rows of samples, padded with zeros to a length of small factors.

        Parameters
        ----------
        samples : ndarray, (n_signals, n_samples)
        sampling_rate : float
            [Hz].
        finer : int
            The padded length is at least this many times that of the rows.
        """
        wanted = finer * samples.shape[1]
        # Four to eight times a power of two.
        step = 1 << max(wanted.bit_length() - 3, 1)
        length = -(-wanted // step) * step
        transform = np.fft.rfft(samples, n=length, axis=1)
        energy = transform.real**2 + transform.imag**2
        energy *= 2 / (length * sampling_rate)
        # 0 Hz and half the sampling rate have no mirror image.
        energy[:, 0] *= 0.5
        energy[:, -1] *= 0.5
        return cls(sampling_rate / length, np.asarray(energy))

    @property
    def frequency(self) -> Floats:
        """Centres of the bins [Hz], (n_bins,)."""
        return np.arange(self.energy.shape[1], dtype=np.float64) * self.spacing

    @cached_property
    def _running(self) -> Floats:
        """Energy below each bin's lower edge, (n_signals, n_bins + 1)."""
        out = np.zeros((len(self.energy), self.energy.shape[1] + 1))
        np.cumsum(self.energy, axis=1, out=out[:, 1:])
        return out

    @property
    def total(self) -> Floats:
        """Energy of each row [unit^2 s]."""
        return np.asarray(self._running[:, -1])

    def between(self, low: float, high: float) -> Floats:
        """Return the energy between two frequencies [Hz]; that of a bin is spread evenly over its width."""
        return np.asarray(self._below(high) - self._below(low))

    def _below(self, frequency: float) -> Floats:
        place, last = frequency / self.spacing + 0.5, self.energy.shape[1] - 1
        whole = min(int(place), last)
        # The first and the last bin have half a width, above 0 Hz and below half the sampling rate.
        share = place - whole if 0 < whole < last else 2 * (place - whole) - (whole == 0)
        before, after = self._running[:, whole], self._running[:, whole + 1]
        return np.asarray(before + min(share, 1.0) * (after - before))

"""Making up for a sensor whose response differs from that of another: a gain for each band, applied to the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.measure.bands import MEL_BANDS, mel
from cgid.measure.energy_spectrum import padded_length
from cgid.validation import Floats

#: No band is raised or lowered by more [dB]: what a sensor does not hear cannot be had back.
LARGEST_GAIN = 40.0
#: What the filter makes of a blow has died away after this [s]: its narrowest band is 70 Hz wide.
_TAIL = 30e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Equalisation:
    """Gains of the mel bands.

    Between the centres of the mel bands the gain is straight in dB over mel, beyond them it stays. The filter
    is of minimum phase: nothing comes before its cause, and the resonance of a sensor's mount is undone in time, too.

    Parameters
    ----------
    gains : ndarray, (n_bands,)
        [dB], each within 40 dB of none.

    Raises
    ------
    InvalidValue
        The gains are not one finite number a band, or one is too large.
    """

    gains: Floats

    def __post_init__(self) -> None:
        gains = validation.real("gains", self.gains, "dB")
        if gains.shape != (len(MEL_BANDS),):
            raise InvalidValue(f"gains must be one number for each of {len(MEL_BANDS)} bands, got shape {gains.shape}")
        if np.abs(gains).max() > LARGEST_GAIN:
            raise InvalidValue(
                f"gains must lie within {LARGEST_GAIN:g} dB of none, got {gains[np.argmax(np.abs(gains))]:g} dB: check "
                "the sensor, its cable and its reference run"
            )
        object.__setattr__(self, "gains", gains)

    @classmethod
    def between(cls, heard: ArrayLike, meant: ArrayLike) -> Equalisation:
        """Return what makes a sensor like another.

        Parameters
        ----------
        heard, meant : array_like, (n_bands,)
            Mean spectra of the reference runs of either, log10 of the mean square in each band.

        Examples
        --------
        >>> n_bands = len(MEL_BANDS)
        >>> quiet, loud = np.full(n_bands, -2.0), np.full(n_bands, -1.4)
        >>> samples = np.sin(np.arange(400.0))[None]
        >>> float((Equalisation.between(quiet, loud).apply(samples, 1e4).std() / samples.std()).round(4))
        1.9953
        """
        return cls(gains=10.0 * (validation.real("meant", meant) - validation.real("heard", heard)))

    def gain(self, frequency: Floats) -> Floats:
        """Return the gain at frequencies [Hz], in dB."""
        return np.asarray(np.interp(mel(frequency), mel(MEL_BANDS.centres), self.gains))

    def apply(self, samples: NDArray[np.floating], sampling_rate: float) -> Floats:
        """Return rows of samples (n_rows, n_samples) as the other sensor would have them; their means stay."""
        n_samples = samples.shape[1]
        length = padded_length(n_samples + round(_TAIL * sampling_rate))
        mean = samples.mean(axis=1, keepdims=True, dtype=np.float64)
        spectrum = np.fft.rfft(samples - mean, n=length, axis=1)
        spectrum *= self._response(length, sampling_rate)
        return np.asarray(np.fft.irfft(spectrum, n=length, axis=1)[:, :n_samples] + mean)

    def _response(self, length: int, sampling_rate: float) -> NDArray[np.complex128]:
        """Return the complex gain at the bins of a transform, of minimum phase by the cepstrum.

        Oppenheim & Schafer, Discrete-Time Signal Processing: of the logarithm of the gain, what is before time 0 is
        folded behind it.
        """
        level = self.gain(np.asarray(np.fft.rfftfreq(length, 1 / sampling_rate), np.float64)) * (np.log(10.0) / 20.0)
        cepstrum = np.fft.irfft(level, n=length)
        cepstrum[1 : length // 2] *= 2.0
        cepstrum[length // 2 + 1 :] = 0.0
        return np.asarray(np.exp(np.fft.rfft(cepstrum)))

"""What can be measured on windows of a recording that nobody has looked for impacts in, lazily, each thing once.

A window is a stretch of a stationary record: many bodies fall, slide and overlap, and none has a beginning. So nothing
here looks for an onset, for noise before touch, or for where a vibration ends.

A window is cut into frames of `FRAME_TIME` that half overlap, each under a Hann bell. Their spectra, averaged, say what
sounds; how much they differ from frame to frame says how: single blows differ, a steady rustle does not.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid.measure.bands import EVEN_BANDS, MEL_BANDS, TriangularBands
from cgid.measure.energy_spectrum import LOWEST_SHARE, EnergySpectrum
from cgid.measure.wavelets import packet_energies
from cgid.validation import Floats

#: Length of a frame [s]; the next begins half of it later.
FRAME_TIME = 10e-3
#: The envelope is the root mean square over so long [s].
ENVELOPE_TIME = 1e-3
#: A blow is where the envelope is highest within `BLOW_TIME` to either side [s], and at least so many times its mean.
BLOW_TIME, BLOW_OVER_MEAN = 3e-3, 1.5
#: What is smaller has no fourth power that is a number.
SMALLEST_RMS = 1e-70


class WindowBatch:
    """Windows of a recording; every row is the same whatever else is in the batch.

    Parameters
    ----------
    samples : ndarray, (n_windows, n_samples)
    sampling_rate : float
        [Hz].
    remove_baseline : bool
        Whether the mean of a window is subtracted.
    """

    def __init__(self, samples: NDArray[np.floating], sampling_rate: float, remove_baseline: bool = True) -> None:
        self.samples = samples
        self.sampling_rate = sampling_rate
        self.remove_baseline = remove_baseline

    # -- in time --------------------------------------------------------------------------------------

    @cached_property
    def swing(self) -> Floats:
        """The samples, baseline removed."""
        swing = self.samples.astype(np.float64)
        if self.remove_baseline:
            swing -= swing.mean(axis=1, keepdims=True)
        return swing

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.square(self.swing))

    @cached_property
    def mean_square(self) -> Floats:
        """Of the samples [unit^2]."""
        return np.asarray(self._square.mean(axis=1))

    @cached_property
    def level(self) -> Floats:
        """Logarithm (base 10) of the mean square."""
        return np.asarray(np.log10(np.maximum(self.mean_square, np.finfo(np.float64).tiny)))

    @cached_property
    def peak(self) -> Floats:
        """Largest distance from the baseline."""
        return np.asarray(np.sqrt(self._square.max(axis=1)))

    @cached_property
    def kurtosis(self) -> Floats:
        """Fourth moment over the square of the second: 3 for Gaussian noise, 1.5 for a tone, more for blows."""
        return np.asarray(np.square(self._square).mean(axis=1) / self.mean_square**2)

    @cached_property
    def zero_crossing_rate(self) -> Floats:
        """Changes of sign over the length of the window [Hz]."""
        sign = np.signbit(self.swing)
        changes = np.count_nonzero(sign[:, 1:] != sign[:, :-1], axis=1)
        return np.asarray(changes * self.sampling_rate / sign.shape[1])

    # -- the envelope ---------------------------------------------------------------------------------

    @cached_property
    def envelope(self) -> Floats:
        """Root mean square over each `ENVELOPE_TIME`, (n_windows, n_steps)."""
        length = min(max(round(ENVELOPE_TIME * self.sampling_rate), 1), self._square.shape[1])
        count = self._square.shape[1] // length
        steps = self._square[:, : count * length].reshape(-1, count, length)
        return np.asarray(np.sqrt(steps.mean(axis=2)))

    @cached_property
    def _envelope_step(self) -> float:
        return max(round(ENVELOPE_TIME * self.sampling_rate), 1) / self.sampling_rate

    @cached_property
    def envelope_moments(self) -> tuple[Floats, Floats, Floats]:
        """Deviation over mean, skewness and kurtosis of the envelope."""
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        square = np.square(centred)
        variance = np.maximum(square.mean(axis=1), LOWEST_SHARE * self.mean_square)
        third, fourth = (square * centred).mean(axis=1), np.square(square).mean(axis=1)
        return np.sqrt(variance) / self._mean_envelope, third / variance**1.5, fourth / variance**2

    @property
    def _mean_envelope(self) -> Floats:
        return np.asarray(np.maximum(self.envelope.mean(axis=1), 1e-6 * np.sqrt(self.mean_square)))

    @cached_property
    def log_envelope(self) -> Floats:
        """Logarithm (base 10) of the envelope."""
        return np.asarray(np.log10(np.maximum(self.envelope, 1e-6 * np.sqrt(self.mean_square)[:, None])))

    def envelope_quantile(self, share: float) -> Floats:
        """Return what a share of the envelope stays below, as a logarithm (base 10)."""
        return np.asarray(np.quantile(self.log_envelope, share, axis=1))

    def envelope_correlation(self, lag: float) -> Floats:
        """Return how the envelope correlates with itself a time [s] later: vibrations that die slowly, much."""
        steps = min(max(round(lag / self._envelope_step), 1), self.envelope.shape[1] - 1)
        centred = self.envelope - self.envelope.mean(axis=1, keepdims=True)
        variance = np.maximum(np.square(centred).sum(axis=1), LOWEST_SHARE * self.mean_square)
        return np.asarray((centred[:, steps:] * centred[:, : centred.shape[1] - steps]).sum(axis=1) / variance)

    @cached_property
    def blow_rate(self) -> Floats:
        """Blows in a second [Hz]: where the envelope is highest around, and well above its mean."""
        reach = max(round(BLOW_TIME / self._envelope_step), 1)
        padded = np.pad(self.envelope, ((0, 0), (reach, reach)))
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
        blows = (self.envelope >= around.max(axis=2)) & (self.envelope > BLOW_OVER_MEAN * self._mean_envelope[:, None])
        return np.asarray(np.count_nonzero(blows, axis=1) / (self.envelope.shape[1] * self._envelope_step))

    # -- spectra --------------------------------------------------------------------------------------

    @cached_property
    def _frames(self) -> tuple[float, Floats]:
        """Width of a bin [Hz], and the mean square in each of them in each frame, (n_windows, n_frames, n_bins)."""
        n_windows, n_samples = self.swing.shape
        length = min(max(round(FRAME_TIME * self.sampling_rate), 2), n_samples)
        bell = _hann(length)
        cut = np.lib.stride_tricks.sliding_window_view(self.swing, length, axis=1)[:, :: max(length // 2, 1)]
        # Twice as long with zeros behind: bins no wider than half a frame's resolution.
        spectrum = EnergySpectrum.of((cut * bell).reshape(-1, length), self.sampling_rate, finer=2)
        power = spectrum.energy.reshape(n_windows, cut.shape[1], -1)
        power *= self.sampling_rate / np.sum(bell**2)
        return spectrum.spacing, power

    @cached_property
    def spectrum(self) -> EnergySpectrum:
        """Mean square in each bin [unit^2], the mean over the frames (Welch)."""
        spacing, power = self._frames
        return EnergySpectrum(spacing, np.asarray(power.mean(axis=1)))

    @cached_property
    def dominant_frequencies(self) -> Floats:
        """Frequencies of the three strongest maxima of the spectrum [Hz], (n_windows, 3)."""
        return self.spectrum.dominant(3, 2 / FRAME_TIME)

    @cached_property
    def _fine_spectrum(self) -> EnergySpectrum:
        """Mean square in the bins of the whole window [unit^2]: narrow, and no mean over frames."""
        bell = _hann(self.swing.shape[1])
        spectrum = EnergySpectrum.of(self.swing * bell, self.sampling_rate)
        return EnergySpectrum(spectrum.spacing, spectrum.energy * (self.sampling_rate / np.sum(bell**2)))

    def band_level(self, low: float, high: float) -> Floats:
        """Return the logarithm (base 10) of the mean square between two frequencies [Hz]."""
        return np.log10(np.maximum(self._fine_spectrum.between(low, high), self._floor))

    @cached_property
    def packets(self) -> Floats:
        """Logarithm (base 10) of the mean square in each wavelet packet, (n_windows, n_packets)."""
        power = packet_energies(self.swing) / self.swing.shape[1]
        return np.asarray(np.log10(np.maximum(power, self._floor[:, None])))

    @cached_property
    def _floor(self) -> Floats:
        return np.maximum(LOWEST_SHARE * self.mean_square, np.finfo(np.float64).tiny)

    def _log_levels(self, bands: TriangularBands) -> Floats:
        """Return the logarithms (base 10) of the mean square in each frame and band, (n_windows, n_frames, n_bands)."""
        spacing, power = self._frames
        sums = bands.within(0.5 * self.sampling_rate).sums(power, spacing)
        return np.asarray(np.log10(np.maximum(sums, self._floor[:, None, None], out=sums), out=sums))

    @cached_property
    def _mel_levels(self) -> Floats:
        return self._log_levels(MEL_BANDS)

    @cached_property
    def mel(self) -> tuple[Floats, Floats]:
        """Mean and deviation of the logarithms (base 10) of `MEL_BANDS` over the frames, (n_windows, n_bands)."""
        return _over_frames(self._mel_levels)

    @cached_property
    def mel_power(self) -> Floats:
        """Mean square in each of `MEL_BANDS` [unit^2], the mean over the frames, (n_windows, n_bands)."""
        return MEL_BANDS.within(0.5 * self.sampling_rate).sums(self.spectrum.energy, self.spectrum.spacing)

    @cached_property
    def even(self) -> tuple[Floats, Floats]:
        """The same of `EVEN_BANDS`."""
        return _over_frames(self._log_levels(EVEN_BANDS))

    @cached_property
    def flux(self) -> Floats:
        """How much the logarithms of the mel bands change from frame to frame, root mean square over bands."""
        return np.asarray(np.sqrt(np.square(np.diff(self._mel_levels, axis=1)).mean(axis=1).mean(axis=1)))

    # -- what is wrong with it ------------------------------------------------------------------------

    def problems(self) -> dict[int, str]:
        """Return, for each row that cannot be measured, the rule it breaks, its value and the cure."""
        found: dict[int, str] = {}
        constant = np.ptp(self.samples, axis=1) == 0
        for row in np.flatnonzero(constant | ~(self.mean_square > SMALLEST_RMS**2)):
            found[int(row)] = (
                f"a window must hold a signal, all its samples are {self.samples[row, 0]:g}; check the sensor and its "
                "cable"
            )
        return found


def _hann(length: int) -> Floats:
    """Return one period of the bell; it is never zero."""
    return np.asarray(np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2)


def _over_frames(levels: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviation over the frames, (n_windows, n_bands)."""
    mean = levels.mean(axis=1)
    return np.asarray(mean), np.sqrt(np.square(levels - mean[:, None]).mean(axis=1))

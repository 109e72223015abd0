"""Autoregressive (AR) noise: fitted to the samples before onset, and the filter that whitens it.

In coloured noise least squares is not the most likely pulse, and its standard deviations are wrong; whitened samples
are fitted instead. A hundred samples determine few coefficients, so the candidates are power density f^-a on white
noise (two parameters) and an autoregression of low order, selected by Schwarz's criterion (1978, Ann. Stat. 6, 461).
Noise with small first autocorrelations (Box & Pierce 1970, J. Am. Stat. Assoc. 65, 1509) counts as white.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats

#: Number of coefficients, minimum number of samples to fit them, and maximum number of samples used.
ORDER, MIN_SAMPLES, MAX_SAMPLES = 16, 40, 512
#: Highest order of an autoregression of any colour.
_FREE_ORDER = 4
#: Increase of twice the log-likelihood, beyond Schwarz's criterion, that an autoregression of any colour needs.
_MARGIN = 6.0
#: Autocorrelations that are tested, and the sum of their squares times the samples from which noise may be coloured:
#: white noise exceeds it once in twenty times.
_TESTED, _SUSPICION = 4, 9.5
#: Exponents, fractions of white noise, and samples per period of the slowest noise.
_EXPONENTS, _WHITE, _PERIOD = np.arange(0.25, 2.01, 0.25), np.array([0.0, 0.1, 0.3, 0.6]), 4096
#: Minimum fraction of white noise: a counter, a sawtooth or a ramp follows exactly from its past, which no noise does.
_LEAST_WHITE = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class ARNoise:
    """Autoregressive model of the noise of some rows."""

    coefficients: Floats  # (n, ORDER), 0 for white noise
    innovation: Floats  # (n,), standard deviation of what earlier samples do not predict

    @property
    def rows(self) -> NDArray[np.intp]:
        """Rows whose noise is not white."""
        return np.flatnonzero(self.coefficients.any(axis=1))

    def of(self, rows: NDArray[np.intp]) -> ARNoise:
        """Return the models of some rows."""
        return ARNoise(self.coefficients[rows], self.innovation[rows])

    def power(self, frequency: Floats) -> Floats:
        """Return the power density (n, n_frequencies) at frequencies [cycles per sample]; 1 if white with std 1."""
        lag = np.exp(-2j * np.pi * np.outer(np.arange(1, ORDER + 1), frequency))
        return np.asarray(self.innovation[:, None] ** 2 / np.abs(1 - self.coefficients @ lag) ** 2)

    def whitened(self, curves: Floats, rows: NDArray[np.intp]) -> Floats:
        """Return curves (n, ..., n_samples) of some rows minus their prediction; the first `ORDER` samples are 0."""
        coefficients = self.coefficients[rows].reshape(len(rows), *(1,) * (curves.ndim - 2), ORDER)
        out = np.zeros(curves.shape)
        out[..., ORDER:] = curves[..., ORDER:]
        for lag in range(1, ORDER + 1):
            out[..., ORDER:] -= coefficients[..., lag - 1 : lag] * curves[..., ORDER - lag : -lag]
        return out


def ar_noise_of(samples: NDArray[np.floating], n_quiet: Floats, floor: Floats, run: int = 1) -> ARNoise:
    """Return the AR noise in the first `n_quiet` (n,) samples of frames (n, n_samples), averaged over runs first."""
    # `floor` (n,) is the standard deviation of white noise to add: the error of the pulse model.
    n = len(samples)
    colour = ARNoise(np.zeros((n, ORDER)), np.zeros(n))
    n_samples = samples.shape[1]
    stop = np.minimum(n_quiet.astype(np.intp), n_samples)
    # Rows with the same number of samples go together, so that a row does not depend on its neighbours.
    for length in sorted(set(np.minimum(stop // run, MAX_SAMPLES).tolist())):
        if length < MIN_SAMPLES:
            continue
        rows = np.flatnonzero(np.minimum(stop // run, MAX_SAMPLES) == length)
        first = rows * n_samples + stop[rows] - length * run
        seen = samples.ravel().take(first[:, None] + np.arange(length * run)).astype(np.float64)
        if run > 1:
            seen = seen.reshape(rows.size, length, run).mean(axis=2)
        seen -= seen.mean(axis=1, keepdims=True)
        power = np.mean(seen**2, axis=1)
        white = floor[rows] ** 2 / run + _LEAST_WHITE * power + 1e-300
        power += white
        lags = [np.einsum("nt,nt->n", seen[:, lag:], seen[:, :-lag]) / length / power for lag in range(1, _TESTED + 1)]
        colour.innovation[rows] = np.sqrt(power)
        suspect = np.flatnonzero(length * np.sum(np.square(lags), axis=0) > _SUSPICION)
        if suspect.size:
            selected = rows[suspect]
            colour.coefficients[selected], colour.innovation[selected] = _coloured(seen[suspect], white[suspect])
    return colour


def _coloured(seen: Floats, white: Floats) -> tuple[Floats, Floats]:
    """Return coefficients and innovation of the most likely candidate for samples (n, n_samples)."""
    n, count = len(seen), seen.shape[1] - ORDER
    lagged = np.stack([seen[:, ORDER - lag : seen.shape[1] - lag] for lag in range(ORDER + 1)], axis=1)
    lagged -= lagged.mean(axis=2, keepdims=True)
    gram = lagged @ np.swapaxes(lagged, 1, 2) / count
    gram[:, np.arange(ORDER + 1), np.arange(ORDER + 1)] += white[:, None]
    candidates = _power_laws()
    left = np.einsum("nmj,mj->nm", np.matmul(candidates, gram), candidates)
    best = np.argmin(left, axis=1)
    coefficients, left = -candidates[best, 1:], left[np.arange(n), best]
    criterion = count * np.log(left / gram[:, 0, 0]) + np.log(count)
    for order in range(1, _FREE_ORDER + 1):
        inner = slice(1, order + 1)
        free = np.linalg.solve(gram[:, inner, inner], gram[:, inner, :1])[:, :, 0]
        residual = gram[:, 0, 0] - np.sum(free * gram[:, inner, 0], axis=1)
        score = count * np.log(residual / gram[:, 0, 0]) + order * np.log(count) + _MARGIN
        better = score < criterion
        coefficients[better] = 0.0
        coefficients[better, :order], left[better] = free[better], residual[better]
        criterion = np.where(better, score, criterion)
    coefficients[criterion >= 0], left[criterion >= 0] = 0.0, gram[criterion >= 0, 0, 0]
    return coefficients, np.sqrt(left)


@cache
def _power_laws() -> Floats:
    """Return the filters that whiten power-law noise on white noise: 1 and minus the coefficients, (n, ORDER + 1)."""
    frequency = np.fft.rfftfreq(_PERIOD)
    frequency[0] = frequency[1]
    lag_table = np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))
    filters = []
    for exponent in _EXPONENTS:
        lags = np.fft.irfft(frequency**-exponent)[: ORDER + 1]
        for white in _WHITE:
            correlation = (1 - white) * lags / lags[0] + white * (np.arange(ORDER + 1) == 0)
            filters.append(np.append(1.0, -np.linalg.solve(correlation[lag_table], correlation[1:])))
    return np.array(filters)

"""The FFT filter, which is the low-pass of a sensor.

It has zero phase and brick-wall (taper 0) or tapered edges. A low-pass changes a clean damped-Hertz pulse
of duration T as follows (measured in `tests/test_filters.py`):

| edge | taper | peak, restitution 1 / .5 | ringing T/10 before onset | ringing T before onset |
|---|---|---|---|---|
| 4/T | 0 | +0.2 % / +0.9 % | 0.3 % / 1.3 % | 0.07 % / 0.3 % |
| 4/T | 0.5 | +0.1 % / +0.7 % | 0.3 % / 1.1 % | under 0.03 % |
| 2/T | 0 | +1.3 % / -6.8 % | 2.0 % / 7.9 % | 0.4 % / 2.0 % |
| 2/T | 0.5 | +1.1 % / -7.3 % | 1.9 % / 7.3 % | 0.1 % / 0.3 % |

A taper hardly improves the peak or the ringing near the pulse, but its ringing decays sooner. At restitution .3, an
edge at 2/T costs 22 % of the peak, one at 4/T about 1 %.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, require_rate
from cgid.errors import InvalidValue

__all__ = ["fft_filter", "filter_gain"]

#: Rows transformed at once: their spectra fit in the processor's cache.
_ROWS = 32
#: Width of the edge of a scene's sensor, over the edge frequency.
SENSOR_TAPER = 0.5


def fft_filter(
    samples: ArrayLike,
    sampling_rate: float,
    low: float | None = None,
    high: float | None = None,
    taper: float = 0.0,
) -> NDArray[np.floating]:
    """Return the part of a signal between two frequencies.

    Parameters
    ----------
    samples : array_like, (..., n_samples)
        Filtered along the last axis; float32 stays float32, everything else becomes float64.
    sampling_rate : float
        [Hz].
    low, high : float, optional
        Edges of the pass band [Hz]; None leaves that side open.
    taper : float
        Width of each edge over its frequency, in [0, 1]. 0 is the brick wall of Yang, Zeng & Wan (2018);
        otherwise the gain falls like a raised cosine and is 1/2 at the edge.

    Returns
    -------
    ndarray, (..., n_samples)
        With zero phase. The transform is circular: ringing that leaves the frame at one end enters at the other.

    Raises
    ------
    InvalidValue
        Edges out of order or above the Nyquist frequency, samples masked or not finite, or taper outside [0, 1].

    Examples
    --------
    >>> t = np.arange(1000) / 1e4
    >>> two = np.sin(2 * np.pi * 100 * t) + np.sin(2 * np.pi * 3000 * t)
    >>> bool(np.allclose(fft_filter(two, 1e4, high=1000), np.sin(2 * np.pi * 100 * t)))
    True
    """
    given = validation.plain("samples", samples)
    values: NDArray[np.floating] = given if given.dtype == np.float32 else validation.real("samples", given)
    if values.ndim == 0 or values.shape[-1] < 2:
        raise InvalidValue(f"samples must contain at least 2 samples along the last axis, got shape {values.shape}")
    if not np.isfinite(values).all():
        raise InvalidValue(f"samples must be finite, {np.sum(~np.isfinite(values))} of {values.size} are not")
    rate = require_rate(sampling_rate)
    frequency = np.asarray(np.fft.rfftfreq(values.shape[-1], 1 / rate), np.float64)
    gain = filter_gain(frequency, rate, low, high, taper).astype(values.dtype)
    rows = values.reshape(-1, values.shape[-1])
    out = np.empty(rows.shape, rows.dtype)
    for first in range(0, len(rows), _ROWS):
        block = slice(first, first + _ROWS)
        out[block] = np.fft.irfft(np.fft.rfft(rows[block]) * gain, n=rows.shape[-1])
    return out.reshape(values.shape)


def filter_gain(frequency: Floats, sampling_rate: float, low: float | None, high: float | None, taper: float) -> Floats:
    """Return the gain of `fft_filter`.

    Parameters
    ----------
    frequency : ndarray [Hz]
    sampling_rate : float [Hz]
    low, high, taper : float or None
        As in `fft_filter`.

    Returns
    -------
    ndarray
        Between 0 and 1.
    """
    width = validation.number("taper", validation.between("taper", taper, 0, 1))
    nyquist = sampling_rate / 2
    gain = np.ones(frequency.shape)
    for name, edge in (("low", low), ("high", high)):
        if edge is None:
            continue
        cut = validation.number(name, edge, "Hz", validation.positive)
        if cut > nyquist:
            raise InvalidValue(
                f"{name} must be at most half the sampling rate, {nyquist:g} Hz, got {cut:g} Hz: "
                f"lower it or sample at {2 * cut:g} Hz or more"
            )
        gain *= _below(frequency, cut, width) if name == "high" else 1 - _below(frequency, cut, width)
    if low is not None and high is not None and low >= high:
        raise InvalidValue(f"low must be below high, got low {low:g} Hz and high {high:g} Hz")
    return gain


def _below(frequency: Floats, edge: float, taper: float) -> Floats:
    if taper == 0:
        return np.asarray(frequency <= edge, np.float64)
    position = np.clip((frequency - edge) / (taper * edge), -0.5, 0.5)
    return np.asarray(0.5 - 0.5 * np.sin(np.pi * position))

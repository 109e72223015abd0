"""Energies of wavelet packets, by PyWavelets, which is loaded only here and only when they are asked for."""

from __future__ import annotations

from typing import Any

import numpy as np

from cgid.errors import MissingExtra
from cgid.validation import Floats

#: Daubechies' wavelet with eight vanishing moments: its bands overlap little, and it is short.
WAVELET = "db8"
#: How often the band is halved, and how many bands that makes.
LEVEL, N_PACKETS = 4, 16


def packet_energies(samples: Floats) -> Floats:
    """Return the sum of squares of each wavelet packet, the lowest band first.

    Parameters
    ----------
    samples : ndarray, (n_rows, n_samples)
        Taken as periodic, after zeros that make a multiple of 16 samples: so the energies of a row add up to its own.

    Returns
    -------
    ndarray, (n_rows, 16)
        Of bands of a sixteenth of half the sampling rate each.

    Raises
    ------
    MissingExtra
        PyWavelets is not installed.
    """
    pywt = _pywt()
    packets = [np.pad(samples, ((0, 0), (0, -samples.shape[1] % N_PACKETS)))]
    for _ in range(LEVEL):
        halves: list[Floats] = []
        for number, packet in enumerate(packets):
            low, high = pywt.dwt(packet, WAVELET, "periodization", axis=1)
            # Every second band was turned upside down when it was thinned out.
            halves += [high, low] if number % 2 else [low, high]
        packets = halves
    return np.stack([np.square(packet).sum(axis=1) for packet in packets], axis=1)


def _pywt() -> Any:
    try:
        import pywt
    except ImportError:
        raise MissingExtra(
            "wavelet packets need PyWavelets, which is not installed: pip install 'cgid[wavelets]'"
        ) from None
    return pywt

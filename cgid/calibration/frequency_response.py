"""The frequency response of a beam between hammer and sensor: as taps measure it, and as its modes respond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cgid._lib.validation import Complex, Floats
from cgid.calibration.joint import Blow, spectra_of
from cgid.measure.modal.finite import bins_in
from cgid.measure.modal.modes import Modes
from cgid.physics.structure.response import Quantity, Response


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponse:
    """A frequency response, motion over force in SI units.

    Attributes
    ----------
    frequency : ndarray, (n,) [Hz]
    measured : ndarray, (n,), complex
        Least squares over the taps (H1).
    coherence : ndarray, (n,)
        Fraction of the power of the response that all taps together explain by one response; 1 of a single tap.
    modelled : ndarray, (n,), complex
    quantity : str
        Of the motion.
    """

    frequency: Floats
    measured: Complex
    coherence: Floats
    modelled: Complex
    quantity: str

    @classmethod
    def of(
        cls,
        blows: Sequence[Blow],
        modes: Modes,
        sampling_rate: float,
        quantity: Quantity,
        band: tuple[float, float],
        delay: float,
    ) -> FrequencyResponse:
        """Return the response in a band [Hz] from taps with forces recorded `delay` [s] too late, and from modes."""
        n = blows[0].response.size
        inside = bins_in(n, sampling_rate, band)
        frequency = inside * sampling_rate / n
        motion, force = spectra_of(blows, inside)
        force = force * np.exp(2j * np.pi * frequency * delay)
        cross = (motion * force.conj()).sum(axis=0)
        power = np.maximum(np.square(np.abs(force)).sum(axis=0), 1e-300)
        heard = np.maximum(np.square(np.abs(motion)).sum(axis=0), 1e-300)
        own = Response(sampling_rate=sampling_rate, quantity=quantity, modes=modes)
        return cls(
            frequency=frequency,
            measured=cross / power,
            coherence=np.square(np.abs(cross)) / power / heard,
            modelled=own.frequency_response(frequency, modes.participation()),
            quantity=quantity,
        )

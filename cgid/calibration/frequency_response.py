"""The frequency response of a beam between hammer and sensor: as taps measure it, and as its modes respond.

Layout of files: "Universal Dataset Number 58", SDRL of the University of Cincinnati, https://www.ceas3.uc.edu/sdrluff/.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cgid._lib.validation import Complex, Floats
from cgid.calibration.joint import Blow, spectra_of
from cgid.measure.modal.finite import bins_in
from cgid.measure.modal.modes import Modes
from cgid.physics.structure.response import Quantity, Response

#: Numbers of data sets 58: a frequency response, complex numbers of double precision at even steps, and of quantities.
_FUNCTION, _COMPLEX, _EVEN = 4, 6, 1
_OF_QUANTITY = {"frequency": 18, "force": 13, "acceleration": 12, "velocity": 11, "displacement": 8}
_UNITS = {"frequency": "Hz", "force": "N", "acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"}


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

    def universal(self, source: str) -> bytes:
        """Return the measured and the modelled response as a universal file with two data sets 58."""
        lines = [
            *self._lines("measured", self.measured, source, 1),
            *self._lines("modelled", self.modelled, source, 2),
        ]
        return ("\n".join(lines) + "\n").encode("ascii", "replace")

    def _lines(self, name: str, values: Complex, source: str, number: int) -> Iterator[str]:
        step = float(np.diff(self.frequency).mean())
        yield from ("    -1", "    58")
        yield from (
            f"{name} response of {source}"[:80],
            f"{self.quantity} over force, SI units",
            "NONE",
            "cgid tap",
            "NONE",
        )
        yield f"{_FUNCTION:5d}{number:10d}{0:5d}{0:10d} {'NONE':10s}{1:10d}{3:4d} {'NONE':10s}{1:10d}{3:4d}"
        yield f"{_COMPLEX:10d}{values.size:10d}{_EVEN:10d}{self.frequency[0]:13.5e}{step:13.5e}{0.0:13.5e}"
        for quantity in ("frequency", self.quantity, "force"):
            yield f"{_OF_QUANTITY[quantity]:10d}{0:5d}{0:5d}{0:5d} {quantity:20s} {_UNITS[quantity]:20s}"
        yield f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE':20s}"
        parts = np.stack([values.real, values.imag], axis=1).ravel()
        for first in range(0, parts.size, 4):
            yield "".join(f"{part:20.11e}" for part in parts[first : first + 4].tolist())
        yield "    -1"

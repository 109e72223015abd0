"""Transforms of the vibrations of modes over a finite stretch of a recording, exact at its own frequencies.

A stretch of n samples cuts a vibration off. With its states at the two ends, its discrete Fourier transform at
multiples of the sampling rate over n is known in closed form, so that windows are not needed and nothing leaks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Complex, Floats
from cgid.measure.modal.modes import residues


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """Some frequencies of a stretch of a recording, and the modes that vibrate in it."""

    pole: Complex  # (n_modes,) [1/s]
    bins: NDArray[np.intp]  # (n_bins,), numbers of frequencies in the transform of the stretch
    n_samples: int
    sampling_rate: float
    derivatives: int  # of the displacement

    @cached_property
    def line(self) -> Floats:
        """Return the frequencies, (n_bins,) [rad/s]."""
        return np.asarray(2 * np.pi * self.bins * self.sampling_rate / self.n_samples)

    def transform(self, force: Floats, delay: float = 0.0) -> Complex:
        """Return the transform (n_bins, ...) of forces (n, ...) at the first samples, recorded `delay` [s] too late."""
        step = 1 / self.sampling_rate
        return np.asarray(np.exp(-1j * np.outer(self.line, np.arange(len(force)) * step - delay)) @ force * step)

    def states(self, force: Floats, samples: float, delay: float = 0.0) -> Complex:
        """Return the state of each mode (n_modes, ...) some samples after the first sample of forces (n, ...)."""
        step = 1 / self.sampling_rate
        ago = (samples - np.arange(len(force))) * step + delay
        return np.asarray(np.exp(np.outer(self.pole, ago)) @ force * step)

    def by_mode(self, force: Floats, before: Complex, delay: float = 0.0) -> tuple[Complex, Complex]:
        """Return the transforms of each mode's vibration for a force (n,) and states before it, each (n_bins, n_modes).

        The first is that of a participation of 1, the second of one of 1j.
        """
        after = np.exp(self.pole * self.n_samples / self.sampling_rate) * before
        change = before - after - self.states(force, self.n_samples, delay)
        (steady, steady_mirrored), (own, mirrored) = self._steady, self._ends
        transform = self.transform(force, delay)[:, None]
        turning = steady * transform + own * change
        returning = steady_mirrored * transform + mirrored * change.conj()
        return turning + returning, 1j * (turning - returning)

    def by_force(self, participation: Floats | Complex, forces: Floats) -> Complex:
        """Return the transform of the vibration of all modes for forces (n, n_forces), (n_bins, n_forces)."""
        steady, mirrored = self._steady
        gain = steady @ participation + mirrored @ np.conj(participation)
        return np.asarray(
            gain[:, None] * self.transform(forces) - self._added(participation, self.states(forces, self.n_samples))
        )

    def free(self, participation: Floats | Complex, before: Complex) -> Complex:
        """Return the transform of the vibration that remains from states before, (n_bins,)."""
        return self._added(participation, (1 - np.exp(self.pole * self.n_samples / self.sampling_rate)) * before)

    def _added(self, participation: Floats | Complex, states: Complex) -> Complex:
        """Return what states (n_modes, ...) at the beginning of the stretch add, (n_bins, ...)."""
        own, mirrored = self._ends
        return np.asarray(own * participation @ states + mirrored * np.conj(participation) @ states.conj())

    # Both of a participation of 1, each (n_bins, n_modes): the first turns by 1j with it, the second by -1j.

    @cached_property
    def _steady(self) -> tuple[Complex, Complex]:
        """Response of each mode to a unit force that never ends."""
        s, unit, direct = 1j * self.line[:, None], residues(self.pole, self.derivatives), self.derivatives == 2
        return 0.5 * (unit / (s - self.pole) + direct), 0.5 * (unit.conj() / (s - self.pole.conj()) + direct)

    @cached_property
    def _ends(self) -> tuple[Complex, Complex]:
        """What a state and its conjugate at the beginning add, and take away at the end."""
        step, unit = 1 / self.sampling_rate, 0.5 * residues(self.pole, self.derivatives)
        turn = np.exp(-1j * self.line * step)[:, None]
        own = unit * step / (1 - np.exp(self.pole * step) * turn)
        mirrored = unit.conj() * step / (1 - np.exp(self.pole.conj() * step) * turn)
        return own, mirrored


def bins_in(n_samples: int, sampling_rate: float, band: Sequence[float]) -> NDArray[np.intp]:
    """Return the numbers of the frequencies of a stretch in a band [Hz]."""
    frequency = np.fft.rfftfreq(n_samples, 1 / sampling_rate)
    return np.flatnonzero((frequency >= band[0]) & (frequency <= band[1]))

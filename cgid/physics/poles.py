"""Poles of what oscillates on the way from a contact force to a recorder: modes, a sensor's mounting, a filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.elementary import complex_of, sincos
from cgid.errors import InvalidValue
from cgid.validation import Floats

Complex = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class Resonance:
    """A resonance that passes what is slow, `w^2 / (s^2 + 2 zeta w s + w^2)`: a sensor on its mounting.

    Parameters
    ----------
    frequency : float
        [Hz], above 0.
    damping_ratio : float
        Above 0 and below 1.
    """

    frequency: float
    damping_ratio: float

    def __post_init__(self) -> None:
        validation.positive("frequency of the resonance", self.frequency, "Hz")
        require_damping_ratio(self.damping_ratio)

    @property
    def poles(self) -> Complex:
        """The pole in the upper half-plane [rad/s], (1,)."""
        return resonator_poles(np.array([self.frequency]), np.array([self.damping_ratio]))


@dataclass(frozen=True, kw_only=True)
class LowPass:
    """A Butterworth low-pass, as an anti-alias filter before the converter.

    Parameters
    ----------
    frequency : float
        Where it is 3 dB down [Hz].
    order : int
        1 to 12.
    """

    frequency: float
    order: int = 8

    def __post_init__(self) -> None:
        validation.positive("frequency of the low-pass", self.frequency, "Hz")
        if not 1 <= validation.count("order of the low-pass", self.order) <= 12:
            raise InvalidValue(f"order of the low-pass must be at most 12, got {self.order}")

    @property
    def poles(self) -> Complex:
        """The poles of the upper half-plane and the real axis [rad/s]."""
        angles = np.pi * (2 * np.arange((self.order + 1) // 2) + self.order + 1) / (2 * self.order)
        sine, cosine = sincos(angles)
        radius = 2 * np.pi * self.frequency
        return complex_of(radius * cosine, radius * np.where(np.abs(sine) < 1e-9, 0.0, sine))


def require_damping_ratio(damping_ratio: ArrayLike) -> Floats:
    """Return damping ratios that leave an oscillation that dies out: above 0 and below 1."""
    ratio = validation.positive("damping_ratio", damping_ratio)
    if (ratio >= 1).any():
        raise InvalidValue(f"damping_ratio must be below 1, got {ratio.max():g}")
    return ratio


def resonator_poles(frequency: Floats, damping_ratio: Floats) -> Complex:
    """Return `-zeta w + i w sqrt(1 - zeta^2)` [rad/s]."""
    angular, ratio = 2 * np.pi * np.asarray(frequency), np.asarray(damping_ratio)
    return complex_of(-angular * ratio, angular * np.sqrt((1 - ratio) * (1 + ratio)))

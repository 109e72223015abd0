"""Contact forces on fine grids, and their effect on a pole over a sample: see `cgid.physics._response`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from cgid.elementary import Complex, complex_exp, complex_product, modulus, power
from cgid.errors import InvalidValue
from cgid.validation import Floats

#: Steps of a contact for an error of 1 (see `steps_for`), fewest steps of a contact, most steps of a sample.
_STEPS_FOR_ONE, _LEAST_STEPS, _MOST_STRIDE = 4.0, 32, 1 << 16
#: Share of the tolerance for the force itself.
_SHARE_OF_FORCE = 0.3


class Pulses(Protocol):
    """Contact forces of impacts, computed or given."""

    @property
    def contact_duration(self) -> Floats:
        """Of the first contact [s], (n,)."""

    @property
    def end_of_contact(self) -> Floats:
        """From the first touch to the last separation [s], (n,)."""

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: Any, onset: Any, *, tolerance: float) -> None:
        """Add the forces to frames (n, n_samples), each at its own sampling rate, within an error over the peak."""


def steps_for(tolerance: float) -> int:
    """Return the number of steps of a contact for this error over the largest sample.

    The force is linear between steps after a correction by its second difference. The remaining error comes from touch
    and separation, where the force goes as `t^(3/2)`, and falls with the power 5/2 of the number of steps.
    """
    return max(_LEAST_STEPS, int(np.ceil(_STEPS_FOR_ONE * power(tolerance, -0.4))))


@dataclass(frozen=True)
class DrivenSample:
    """Effect of a sample of some steps on all poles; `Response._driven` describes the arrays."""

    polynomials: Floats
    shares: Floats
    edge: Floats


def driven_sample(poles: Complex, sampling_rate: float, stride: int, n_polynomials: int) -> DrivenSample:
    """Return the effect of a sample of `stride` steps on these poles, by polynomials of the number of the step."""
    h = 1 / (sampling_rate * stride)
    # g0 = h (phi1 - phi2), g1 = h phi2 with phi1 = (e^x - 1) / x, phi2 = (e^x - 1 - x) / x^2.
    phi1, phi2 = _phi(poles * h)
    edge = h * phi2
    drive = h * (phi1 - phi2) + complex_product(complex_exp(poles * h), edge)
    polynomials = np.zeros((stride, n_polynomials))
    shares = np.zeros((n_polynomials, poles.size), complex)
    if stride <= n_polynomials:  # every step by itself
        polynomials[:, :stride] = np.eye(stride)
        shares[:stride] = complex_product(drive, complex_exp(np.arange(stride)[::-1, None] * (poles * h)))
    else:
        polynomials[:] = legendre.legvander(np.linspace(-1, 1, stride), n_polynomials - 1)
        shares[:] = complex_product(drive, _powers_by_legendre(poles * h * (stride - 1) / 2, n_polynomials))
    return DrivenSample(polynomials, np.stack([shares.real, shares.imag]), np.stack([edge.real, edge.imag]))


def _powers_by_legendre(c: Complex, n_polynomials: int) -> Complex:
    """Return the Legendre coefficients of `exp(c (1 - v))` over v in [-1, 1], (n_polynomials, n)."""
    # They are e^c (2 n + 1) (-1)^n i_n(c).
    n = np.arange(n_polynomials)[:, None]
    return complex_product(complex_exp(c), (2 * n + 1) * np.where(n % 2, -1.0, 1.0) * _bessel(c, n_polynomials))


def _bessel(c: Complex, count: int) -> Complex:
    """Return the modified spherical Bessel functions i_0(c), i_1(c), ..., (count, n).

    Miller's backward recurrence gives their ratios, `e^c = sum (2 n + 1) i_n(c)` their scale.
    """
    start = count + int(np.ceil(1.5 * modulus(c).max(initial=0.0))) + 30
    above = np.zeros((start + 2, *c.shape), complex)
    above[start] = 1e-30
    safe = np.where(modulus(c) < 1e-30, 1e-30, c)
    inverse = np.asarray(1 / safe, np.complex128)
    for n in range(start, 0, -1):
        above[n - 1] = above[n + 1] + (2 * n + 1) * complex_product(above[n], inverse)
        largest = modulus(above[n - 1])
        above *= np.where(largest > 1e100, 1e-100, 1.0)
    total = ((2 * np.arange(start + 2) + 1)[:, None] * above).sum(axis=0)
    return complex_product(above[:count], complex_exp(safe) / total)


@cache
def polynomials_for(phase: float, tolerance: float) -> int:
    """Return the number of polynomials for a pole that turns by this phase in a sample [rad]."""
    n = np.arange(400)
    size = (2 * n + 1) * _bessel(np.array([phase / 2 + 0j]), n.size)[:, 0].real
    quiet = np.flatnonzero(size[2:] < 1e-2 * tolerance)
    return 2 + int(quiet[0]) if quiet.size else n.size


def _phi(x: Complex) -> tuple[Complex, Complex]:
    """Return (e^x - 1) / x and (e^x - 1 - x) / x^2, by their series where these would cancel."""
    small = modulus(x) < 0.5
    safe = np.where(small, 1.0, x)
    grown = complex_exp(safe) - 1
    first, second = np.ones_like(x), np.full_like(x, 0.5)
    term = np.ones_like(x)
    for n in range(2, 20):
        term = complex_product(term, np.where(small, x, 0.0)) / n
        first, second = first + term, second + term / (n + 1)
    return np.where(small, first, grown / safe), np.where(small, second, (grown / safe - 1) / safe)


@dataclass(frozen=True)
class Windows:
    """The forces of n pulses, each on its own grid with as many steps per sample as its contact needs.

    Attributes
    ----------
    first, count : ndarray of int, (n,)
        First sample of each grid, and its samples.
    stride : ndarray of int, (n,)
        Steps per sample, a power of 2.
    strides : ndarray of int, (n_levels,)
        The different strides, ascending.
    level : ndarray of int, (n,)
        Index of each stride among them.
    force, drive : ndarray, (n, n_steps)
        Force [N], and the force corrected for linear interpolation.
    """

    first: NDArray[np.int64]
    count: NDArray[np.int64]
    stride: NDArray[np.int64]
    strides: NDArray[np.int64]
    level: NDArray[np.intp]
    force: Floats
    drive: Floats


def windows_of(pulses: Pulses, onset: Floats, sampling_rate: float, tolerance: float) -> Windows:
    """Return the forces of pulses that touch at onset [s], on grids fine enough for the tolerance."""
    duration = pulses.contact_duration * sampling_rate
    fraction, exponent = np.frexp(steps_for(tolerance) / duration)
    needed = np.maximum(exponent - (fraction == 0.5), 0).astype(np.int64)  # the logarithm to base 2, rounded up
    if (needed >= 31).any() or (1 << needed.max(initial=0)) > _MOST_STRIDE:
        shortest = float(pulses.contact_duration.min())
        raise InvalidValue(
            f"sampling_rate must give a contact at least a {_MOST_STRIDE}th of a sample, got {sampling_rate:g} Hz for "
            f"one of {shortest:.3g} s; raise it"
        )
    stride = np.int64(1) << needed
    place = onset * sampling_rate
    first = np.floor(place).astype(np.int64)
    # Two steps without force after the contact: the correction below still changes the last of them.
    length = np.floor(place + pulses.end_of_contact * sampling_rate + 2 / stride).astype(np.int64) + 1 - first
    force = np.zeros((len(onset), int((length * stride).max(initial=0)) + 1))
    pulses.add_to_frames(
        force, sampling_rate * stride, (place - first) / sampling_rate, tolerance=_SHARE_OF_FORCE * tolerance
    )
    # Linear interpolation of a curve errs by a twelfth of its second difference on average.
    drive = force.copy()
    drive[:, 1:-1] -= (force[:, 2:] - 2 * force[:, 1:-1] + force[:, :-2]) / 12
    strides, level = np.unique(stride, return_inverse=True)
    return Windows(first, length, stride, strides, level, force, drive)

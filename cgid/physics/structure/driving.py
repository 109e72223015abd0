"""Contact forces on fine grids, and their effect on a pole over one sample; see `cgid.physics.structure._response`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np
import scipy  # loads its submodules on first use
from numpy import fft
from numpy.polynomial import legendre
from numpy.typing import NDArray

from cgid._lib.validation import Complex, Floats
from cgid.errors import InvalidValue
from cgid.measure.modal.modes import phi

#: Steps per contact for an error of 1 (see `steps_for`), minimum steps per contact, maximum steps per sample.
_STEPS_FOR_ONE, _MIN_STEPS, _MAX_STRIDE = 4.0, 32, 1 << 16
#: Fraction of the tolerance used for the force itself.
_SHARE_OF_FORCE = 0.3


class Pulses(Protocol):
    """Contact forces of impacts, computed or given."""

    @property
    def contact_duration(self) -> Floats:
        """Duration of the first contact [s], (n,)."""

    @property
    def end_of_contact(self) -> Floats:
        """Time from first onset to last separation [s], (n,)."""

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: Any, onset: Any, *, tolerance: float) -> None:
        """Add the forces to frames (n, n_samples), each with its sampling rate, within an error over the peak."""


class ImpulseResponse(Protocol):
    """A filter of finite impulse response, which comes to its middle after `delay` [s]."""

    @property
    def delay(self) -> float: ...  # noqa: D102
    def taps(self, step: float) -> Floats:
        """Return its impulse response at steps [s], times the step."""


def steps_for(tolerance: float) -> int:
    """Return the number of steps per contact for this error over the largest sample."""
    # The error comes from onset and separation, where the force grows as `t^(3/2)`: it falls as the number to the -5/2.
    return max(_MIN_STEPS, int(np.ceil(_STEPS_FOR_ONE * np.power(tolerance, -0.4))))


class DrivenSample:
    """Effect of one sample of `stride` steps on poles, as polynomials in the step number; see `Response._driven`."""

    def __init__(self, poles: Complex, sampling_rate: float, stride: int, n_polynomials: int) -> None:
        h = 1 / (sampling_rate * stride)
        # g0 = h (phi1 - phi2), g1 = h phi2 with phi1 = (e^x - 1) / x, phi2 = (e^x - 1 - x) / x^2.
        phi1, phi2 = phi(poles * h)
        edge = h * phi2
        drive = h * (phi1 - phi2) + np.exp(poles * h) * edge
        self.polynomials = np.zeros((stride, n_polynomials))
        weights = np.zeros((n_polynomials, poles.size), complex)
        if stride <= n_polynomials:  # each step separately
            self.polynomials[:, :stride] = np.eye(stride)
            weights[:stride] = drive * np.exp(np.arange(stride)[::-1, None] * (poles * h))
        else:
            self.polynomials[:] = legendre.legvander(np.linspace(-1, 1, stride), n_polynomials - 1)
            weights[:] = drive * _powers_by_legendre(poles * h * (stride - 1) / 2, n_polynomials)
        self.weights, self.edge = np.stack([weights.real, weights.imag]), np.stack([edge.real, edge.imag])


def _powers_by_legendre(c: Complex, n_polynomials: int) -> Complex:
    """Return the Legendre coefficients of `exp(c (1 - v))` over v in [-1, 1], (n_polynomials, n)."""
    # They are e^c (2 n + 1) (-1)^n i_n(c).
    n = np.arange(n_polynomials)[:, None]
    return np.exp(c) * (2 * n + 1) * np.where(n % 2, -1.0, 1.0) * _bessel(c, n_polynomials)


def _bessel(c: Complex, count: int) -> Complex:
    """Return the modified spherical Bessel functions i_0(c), i_1(c), ..., (count, n), by Miller's recurrence."""
    start = count + int(np.ceil(1.5 * np.abs(c).max(initial=0.0))) + 30
    above = np.zeros((start + 2, *c.shape), complex)
    above[start] = 1e-30
    safe = np.where(np.abs(c) < 1e-30, 1e-30, c)
    inverse = np.asarray(1 / safe, np.complex128)
    for n in range(start, 0, -1):
        above[n - 1] = above[n + 1] + (2 * n + 1) * above[n] * inverse
        largest = np.abs(above[n - 1])
        above *= np.where(largest > 1e100, 1e-100, 1.0)
    total = ((2 * np.arange(start + 2) + 1)[:, None] * above).sum(axis=0)
    return np.asarray(above[:count] * np.exp(safe) / total)


@cache
def polynomials_for(phase: float, tolerance: float) -> int:
    """Return the number of polynomials for a pole that turns by `phase` [rad] in one sample."""
    n = np.arange(400)
    size = (2 * n + 1) * _bessel(np.array([phase / 2 + 0j]), n.size)[:, 0].real
    quiet = np.flatnonzero(size[2:] < 1e-2 * tolerance)
    return 2 + int(quiet[0]) if quiet.size else n.size


class Windows:
    """The forces of n pulses that begin at `onset` [s], each on its own grid, as fine as its contact needs."""

    # `smooth` are filters of linear phase, through which the forces pass.
    # stride : steps per sample, a power of 2, (n,); strides, level : the distinct ones, and the index of each pulse's
    # force, drive : force [N], and the force corrected for linear interpolation, (n, n_steps)

    def __init__(
        self,
        pulses: Pulses,
        onset: Floats,
        sampling_rate: float,
        tolerance: float,
        smooth: Sequence[ImpulseResponse] = (),
    ) -> None:
        duration = pulses.contact_duration * sampling_rate
        fraction, exponent = np.frexp(steps_for(tolerance) / duration)
        needed = np.maximum(exponent - (fraction == 0.5), 0).astype(np.int64)  # log2, rounded up
        if (needed >= 31).any() or (1 << needed.max(initial=0)) > _MAX_STRIDE:
            shortest = float(pulses.contact_duration.min())
            raise InvalidValue(
                f"a contact must last at least a {_MAX_STRIDE}th of a sample, got {shortest:.3g} s at a sampling_rate "
                f"of {sampling_rate:g} Hz; raise the rate"
            )
        self.stride = np.int64(1) << needed
        self.strides, self.level = np.unique(self.stride, return_inverse=True)
        position = onset * sampling_rate
        self.first = np.floor(position).astype(np.int64)
        # Two steps without force follow the contact, as the correction below reaches past its end.
        last = pulses.end_of_contact + 2 * sum(part.delay for part in smooth)
        end = np.floor(position + last * sampling_rate + 2 / self.stride).astype(np.int64) + 1
        self.count = end - self.first
        force = np.zeros((len(onset), int((self.count * self.stride).max(initial=0)) + 1))
        since = (position - self.first) / sampling_rate
        pulses.add_to_frames(force, sampling_rate * self.stride, since, tolerance=_SHARE_OF_FORCE * tolerance)
        for part in smooth:
            for stride in self.strides.tolist():
                rows, taps = self.stride == stride, part.taps(1 / (sampling_rate * stride))
                n_steps = int(self.count[rows].max()) * stride + 1
                n = scipy.fft.next_fast_len(n_steps + taps.size, real=True)
                spectrum = fft.rfft(force[rows, :n_steps], n) * fft.rfft(taps, n)
                force[rows, :n_steps] = fft.irfft(spectrum, n)[:, :n_steps]
        # The mean error of linear interpolation is a twelfth of the second difference.
        drive = force.copy()
        drive[:, 1:-1] -= (force[:, 2:] - 2 * force[:, 1:-1] + force[:, :-2]) / 12
        self.force, self.drive = force, drive

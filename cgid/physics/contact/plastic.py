"""Curves of impacts whose loss does not depend on speed: the contact loads along one path and unloads along another.

Such a pulse has three branches: Hertzian loading, loading at a constant slope, and unloading. Each is a piece of the
elastic curve or of a sine, so that all results have closed forms and no pulse is integrated. Units are L, T0 and
`K L^(3/2)`, as in `cgid.physics.contact.curves`.

**Thornton** (1997, J. Appl. Mech. 64, 383). One number describes an impact: the displacement y at which the contact
yields. Loading is `f = x^(3/2)` up to y; from there on the slope stays at `k = 3/2 y^(1/2)`, which in SI units is
`pi R p_y`. With `u^2 = 1 - 4/5 y^(5/2)` the squared speed at yield, the motion is harmonic about y/3:

    A^2 = (2/3 y)^2 + u^2 / k,  x_max = y/3 + A,  f_max = k A.

The flattened contact keeps its area as it unloads, so its radius of curvature is larger by the factor
`rho = x_max^(3/2) / f_max`. It unloads over `z = x_max / rho` with `f = rho^(1/2) (x - x_max + z)^(3/2)`, and the
restitution is `e^2 = 4/5 f_max z`. Written with `s^2 = (v_y / v)^2 = 4/5 y^(5/2)`, this is Thornton's

    e = (6 sqrt(3) / 5)^(1/2) (1 - s^2 / 6)^(1/2) [s / (s + 2 (6/5 - s^2 / 5)^(1/2))]^(1/4).

**Walton & Braun** (1986, J. Rheol. 30, 949). The contact loads with the slope `k` and unloads with `k / e^2`: a quarter
of a sine each, and restitution is the same at every speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import DTypeLike, NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit import family
from cgid.physics.contact.closed_forms import peak_displacement, peak_force
from cgid.physics.contact.curves import TOLERANCE, Curves, Law, Quantity, in_threads, kernel

_N_TERMS = 50  # of the two series, whose arguments are at most 1/2
_ANGLE_STEPS = 3  # the initial value is within .005, and each step cubes the error


@dataclass(frozen=True)
class PlasticCurves(Curves):
    """The curves of n impacts of three branches; all fields are (n,), and numbers are the restitutions.

    end_of_elastic : time until which loading is elastic, 0 for a linear spring
    rate : angular frequency of the second branch
    time_of_peak : of both the largest force and the largest displacement
    unloading_unit : unit of time of the third branch
    largest_force, largest_displacement : both at `time_of_peak`
    left : displacement at separation
    linear : whether the contact unloads as a linear spring; else as a Hertzian contact
    """

    SHARED: ClassVar[tuple[str, ...]] = (*Curves.SHARED, "linear")

    end_of_elastic: Floats
    rate: Floats
    time_of_peak: Floats
    unloading_unit: Floats
    largest_force: Floats
    largest_displacement: Floats
    left: Floats
    linear: bool

    @classmethod
    def of(cls, restitution: Floats, *branches: Any) -> PlasticCurves:
        """Return the curves of these restitutions; `branches` are the fields of this class."""
        nothing = np.zeros(restitution.shape)
        return cls(Law, restitution[:, None], nothing, nothing, TOLERANCE, *branches)

    @property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed."""
        return self.numbers[:, 0]

    @property
    def rebound(self) -> Floats:
        """The restitution: without weight every sphere rebounds."""
        return self.restitution

    @property
    def plate_energy(self) -> Floats:
        """None: the target has no losses."""
        return self.inelasticity

    @property
    def peak_force(self) -> Floats:
        """Largest force."""
        return self.largest_force

    @property
    def peak_displacement(self) -> Floats:
        """Largest displacement."""
        return self.largest_displacement

    @property
    def end_displacement(self) -> Floats:
        """Displacement at separation."""
        return self.left

    @cached_property
    def times(self) -> tuple[Floats, Floats, Floats]:
        """Contact time, time of the peak force, and time of the largest displacement."""
        quarter = np.pi / 2 if self.linear else _HALF
        return self.time_of_peak + self.unloading_unit * quarter, self.time_of_peak, self.time_of_peak

    def require_rebound(self) -> None:
        """Check nothing: without weight every sphere rebounds."""

    def _branches(self, quantity: Quantity) -> Floats:
        """Return the columns `_kernels.BRANCHES` of force or displacement, (n, n_columns)."""
        if quantity == "force":
            peak, level, rest, unit = self.largest_force, 0.0 * self.left, 0.0 * self.left, _FORCE
        else:
            peak, rest, unit = self.largest_displacement, self.left, _DEPTH
            # The centre of the harmonic motion: the amplitude is f_max / rate^2.
            level = peak - self.largest_force / (self.rate * self.rate)
        times = (self.end_of_elastic, self.rate, self.time_of_peak, self.times[0], self.unloading_unit)
        return np.stack([*times, level, peak - level, rest, (peak - rest) / (1.0 if self.linear else unit)], axis=1)

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """Return force or displacement at times (n, k) [s], shape (n, k); 0 outside contact."""
        from cgid.physics.contact import _kernels

        out = np.empty(times.shape, dtype)
        shape, columns = (self._branches(quantity), self.linear), getattr(family.table(), quantity)
        numbers = (times, time_scale, *shape, amplitude, columns, quantity == "force", out)
        in_threads(kernel(_kernels, "branches_at_times", *times.shape), numbers, np.arange(len(times)), threads)
        return out

    def add_to_frames(
        self, frames: NDArray[Any], onset: Floats, step: Floats, amplitude: Floats, threads: int, tolerance: float = 0.0
    ) -> None:
        """Add a force pulse to each of the frames in place; see `Curves.add_to_frames`. Every pulse is exact."""
        from cgid.physics.contact import _kernels

        numbers = (frames, onset, step, self._branches("force"), self.linear, amplitude, family.table().force)
        in_threads(kernel(_kernels, "add_branches_to_frames", *frames.shape), numbers, np.arange(len(frames)), threads)


def thornton_curves(yield_displacement: Floats) -> PlasticCurves:
    """Return the curves of elastic-plastic spheres that yield at these displacements [L], (n,)."""
    yields = yield_displacement < _DEPTH
    y = np.minimum(yield_displacement, _DEPTH)
    square = np.minimum(0.8 * np.power(y, 2.5), 1.0)  # (v_y / v)^2
    speed = np.where(yields, np.sqrt(1 - square), 0.0)
    rate = np.sqrt(1.5 * np.sqrt(y))
    along, across = rate * (2 / 3 * y), speed
    swing = np.sqrt(along * along + across * across)  # f_max over the rate
    largest_force = rate * swing
    largest = y / 3 + swing / rate
    way = largest_force / np.sqrt(largest)  # z = f_max x_max / x_max^(3/2)
    restitution = np.where(yields, np.sqrt(0.8 * largest_force * way), 1.0)
    end_of_elastic = np.where(yields, _elastic_time(y, square, speed), _HALF)
    time_of_peak = end_of_elastic + _angle(along / swing, across / swing) / rate
    return PlasticCurves.of(
        restitution, end_of_elastic, rate, time_of_peak, way / _DEPTH / restitution, largest_force, largest,
        np.where(yields, largest - way, 0.0), False,
    )  # fmt: skip


def walton_braun_curves(restitution: Floats, stiffness: Floats) -> PlasticCurves:
    """Return the curves of bilinear contacts of these restitutions and loading slopes [K L^(1/2)], each (n,)."""
    rate = np.sqrt(stiffness)
    largest = 1 / rate
    return PlasticCurves.of(
        restitution, np.zeros(restitution.shape), rate, np.pi / 2 / rate, restitution / rate, rate, largest,
        largest * (1 - restitution) * (1 + restitution), True,
    )  # fmt: skip


#: Maximum depth and force of an elastic impact.
_DEPTH, _FORCE = float(peak_displacement(0.0)), float(peak_force(0.0))
#: Slope of a linear spring with the same maximum compression as a Hertzian contact [K L^(1/2)].
EQUIVALENT_STIFFNESS = 1 / (_DEPTH * _DEPTH)


def _series(first: float, step: float) -> Floats:
    """Return the coefficients of the integral of `(1 - w)^(-first)`: `(first)_n / n! / (1 + n step)`."""
    terms = [1.0]
    for n in range(1, _N_TERMS):
        terms.append(terms[-1] * (first + n - 1) / n)
    return np.array([term / (1 + n * step) for n, term in enumerate(terms)])


_FROM_TOUCH, _TO_PEAK = _series(0.5, 2.5), _series(0.6, 2.0)


def _time_to_peak(speed: Floats) -> Floats:
    """Return the time from this speed u to rest: the integral of `dx' / x^(3/2)`, for `u^2` up to 1/2."""
    return np.asarray(speed * polyval(speed * speed, _TO_PEAK) / _FORCE)


_HALF = float(np.power(0.625, 0.4) * polyval(0.5, _FROM_TOUCH) + _time_to_peak(np.sqrt(0.5)))


def _elastic_time(depth: Floats, square: Floats, speed: Floats) -> Floats:
    """Return when an elastic contact has this depth; square is `4/5 depth^(5/2)`, and speed^2 is 1 - square."""
    early = square < 0.5
    touch = depth * polyval(np.where(early, square, 0.0), _FROM_TOUCH)
    return np.where(early, touch, _HALF - _time_to_peak(np.where(early, 0.0, speed)))


def _angle(cosine: Floats, sine: Floats) -> Floats:
    """Return the angle from 0 to pi/2 of this cosine and sine, with the same bits everywhere."""
    tangent = sine / (1 + cosine)
    angle = 2 * tangent / (1 + 0.28 * tangent * tangent)
    for _ in range(_ANGLE_STEPS):
        now = np.sin(angle), np.cos(angle)
        angle = angle + (sine * now[1] - cosine * now[0])
    return np.asarray(angle)

"""The exact dimensionless damped-Hertz pulse by quadrature, and the table of pulses made from it.

`python tests/references/make_family.py` writes `cgid/measure/fit/family.npz`. Each entry is accurate to about 1e-14;
the remaining error comes from interpolation. `tests/test_family.py` checks the shipped file against a fresh evaluation.

With `p = ln(1 + D x')` the equation `x'' = -x^(3/2) (1 + D x')` reads `p' = -D x^(3/2)`. Its first integral
(Hunt & Crossley 1975) gives x in closed form, `(2/5) D^2 x^(5/2) = phi(p_end) - phi(p)` with `phi(p) = e^p - 1 - p`. So
time is an integral over p of a known function. At a distance `y^5` from touch (p = ln(1 + D)) or back from separation
(p = ln(1 - e D)), the integrand is analytic in y: Gauss-Legendre quadrature reaches machine precision without solving a
differential equation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cgid._lib.validation import Floats
from cgid.measure.fit.family import INTERVALS, MIN_RESTITUTION, ORDERS, POWERS, SEGMENTS, TABLE_PATH, FamilyTable
from cgid.physics.contact.closed_forms import damping_number, exponential_rest, logarithms, peak_logarithm

# Measured with the sizes of `cgid.measure.fit.family`: the force error over the peak is 3e-11 at e = .05, 1e-12 from .1
# on, 1e-13 from .2 on.
N_TIME_ORDERS = 14  # the time of the peak force has a branch point just above e = 1 and converges slowly
#: Exponent of the cut between the two halves: near the largest displacement for large e, late enough for the long tail
#: for small e. 0.6 balances the errors of both halves.
_CUT = 0.6
_PANELS, _NODES = 6, 24
_NEWTON_STEPS = 12
# The elastic pulse is the limit D -> 0; with this D it differs by a fraction below 1e-17.
_ELASTIC = 1e-18


@dataclass(frozen=True)
class ReferencePulse:
    """A dimensionless damped-Hertz pulse, evaluated by quadrature.

    restitution, damping : equivalent values of the one parameter
    compression_time, contact_time : touch to largest displacement, and touch to separation [T0 = L / v]
    """

    restitution: float
    damping: float
    compression_time: float
    contact_time: float

    def evaluate(self, times: Floats) -> tuple[Floats, Floats]:
        """Return displacement and force at dimensionless times, 0 outside contact."""
        times = np.asarray(times, dtype=np.float64)
        displacement, force = np.zeros(times.shape), np.zeros(times.shape)
        rising = (times > 0) & (times <= self.compression_time)
        falling = (times > self.compression_time) & (times < self.contact_time)
        displacement[rising], force[rising] = self._branch("touch", times[rising])
        displacement[falling], force[falling] = self._branch("separation", self.contact_time - times[falling])
        return displacement, force

    def _branch(self, end: str, times: Floats) -> tuple[Floats, Floats]:
        branch = _Branch(self.damping, self.restitution, end)
        return branch.state(branch.invert(times))


def reference_pulse(restitution: float) -> ReferencePulse:
    """Return the exact dimensionless pulse for a restitution in (0, 1].

    >>> round(reference_pulse(0.5).contact_time, 12)
    3.603560584046
    """
    damping = float(damping_number(restitution))
    compression, expansion = (_Branch(damping, restitution, end).duration() for end in ("touch", "separation"))
    return ReferencePulse(restitution, damping, compression, compression + expansion)


def time_of_peak(restitution: float) -> float:
    """Return the dimensionless time of the largest force, which precedes the largest displacement."""
    branch = _Branch(float(damping_number(restitution)), restitution, "touch")
    distance = branch.length - peak_logarithm(branch.damping)
    return float(branch.time(np.asarray([distance**0.2]))[0])


class _Branch:
    """Half a pulse, as a function of `y = |p - p_end|^(1/5)`."""

    def __init__(self, damping: float, restitution: float, end: str) -> None:
        self.damping = max(damping, _ELASTIC)
        touch, separation = logarithms(self.damping, restitution)
        self.from_touch = end == "touch"
        self.length = float(touch if self.from_touch else separation)
        self.end_rate = self.damping if self.from_touch else -np.expm1(-self.length)
        self.end_power = float(np.exp(self.length if self.from_touch else -self.length))
        edges = np.linspace(0, self.length**0.2, _PANELS + 1)
        # A sphere that hardly rebounds turns around on a scale of 1 in p, far shorter than its creep.
        turning = self.length - np.array([40.0, 12.0, 4.0, 1.0])
        self.edges = np.sort(np.append(edges, turning[turning > 0] ** 0.2))

    def energy(self, distance: Floats) -> Floats:
        """Return `phi(p_end) - phi(p)` without cancellation."""
        if self.from_touch:
            return -self.end_rate * np.expm1(-distance) - exponential_rest(-distance)
        if self.length < 1:
            return self.end_rate * np.expm1(distance) - exponential_rest(distance)
        # e^(p_end) (e^distance - 1), without overflow as e -> 0.
        near = self.end_power * np.expm1(np.minimum(distance, 1.0))
        return distance - np.where(distance < 1, near, np.exp(distance - self.length) - self.end_power)

    def state(self, y: Floats) -> tuple[Floats, Floats]:
        distance = y**5
        displacement = (2.5 * self.energy(distance) / self.damping**2) ** 0.4
        power = np.exp(self.length - distance if self.from_touch else distance - self.length)
        return displacement, displacement**1.5 * power

    def rate(self, y: Floats) -> Floats:
        """Return d(time) / dy."""
        inside = np.maximum(y, 1e-60)
        force_over_power = (2.5 * self.energy(inside**5) / self.damping**2) ** 0.6
        return 5 * inside**4 / (self.damping * force_over_power)

    def time(self, y: Floats) -> Floats:
        """Return the time between the end of the branch and y, in the shape of y."""
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        edges = np.minimum(self.edges, y[..., None])
        width = np.diff(edges)[..., None]
        rates = self.rate(edges[..., :-1, None] + 0.5 * (1 + nodes) * width)
        return np.asarray((rates * weights * width).sum(axis=(-2, -1)) / 2)

    def duration(self) -> float:
        return float(self.time(np.asarray([self.length**0.2]))[0])

    def invert(self, times: Floats) -> Floats:
        """Return y at the given times, by Newton in `sqrt(time)`, which is nearly linear in y."""
        longest = self.length**0.2
        y = longest * np.sqrt(times / self.duration())
        for _ in range(_NEWTON_STEPS):
            reached = self.time(y)
            step = (np.sqrt(reached) - np.sqrt(times)) * 2 * np.sqrt(reached) / self.rate(y)
            y = np.asarray(np.clip(y - step, 0.5 * y, longest))
        return np.asarray(y, dtype=np.float64)


def tabulate() -> FamilyTable:
    """Compute the table of the family (half a minute)."""
    pulses = [[_columns(e) for e in nodes] for nodes in _nodes(ORDERS)]
    return FamilyTable(
        force=_series([[force for force, _ in interval] for interval in pulses]),
        displacement=_series([[displacement for _, displacement in interval] for interval in pulses]),
        times=_series([[_times(e) for e in nodes] for nodes in _nodes(N_TIME_ORDERS)]),
    )


def _points(n: int) -> Floats:
    """Return the n Chebyshev points of (-1, 1)."""
    return np.cos(np.pi * (np.arange(n) + 0.5) / n)


def _nodes(n_orders: int) -> list[list[float]]:
    places = np.arange(INTERVALS)[:, None] + 0.5 * (1 + _points(n_orders))
    return [[float(e) for e in row] for row in MIN_RESTITUTION ** (places / INTERVALS)]


def _powers(values: Floats) -> Floats:
    """Return the power-series coefficients of the polynomial through values at the Chebyshev points (last axis).

    It takes the decreasing terms of the Chebyshev series as an intermediate step: inverting the Vandermonde matrix, or
    both steps as one matrix, would lose five digits.
    """
    n = values.shape[-1]
    to_terms = 2 / n * np.polynomial.chebyshev.chebvander(_points(n), n - 1)
    to_terms[:, 0] /= 2
    to_powers = np.zeros((n, n))
    for order, unit in enumerate(np.eye(n)):
        of_term = np.polynomial.chebyshev.cheb2poly(unit)
        to_powers[order, : of_term.size] = of_term
    return np.asarray((values @ to_terms) @ to_powers)


def _series(values: list[list[Floats]]) -> Floats:
    """Return polynomials (interval, order, column) through values (interval, point, column)."""
    return np.ascontiguousarray(np.swapaxes(_powers(np.swapaxes(np.array(values), 1, 2)), 1, 2))


def _times(e: float) -> Floats:
    pulse = reference_pulse(e)
    return np.array([pulse.contact_time, time_of_peak(e), pulse.compression_time])


def _columns(e: float) -> tuple[Floats, Floats]:
    pulse = reference_pulse(e)
    contact = pulse.contact_time
    cut = pulse.compression_time ** (1 - _CUT) * (0.5 * contact) ** _CUT
    sigma = (np.arange(SEGMENTS)[:, None] + 0.5 * (1 + _points(POWERS))) / SEGMENTS
    times = np.stack([cut * sigma**2, contact - (contact - cut) * sigma**2])
    displacement, force = pulse.evaluate(times)
    ends = [contact, cut]
    return np.append(_powers(force / sigma**3), ends), np.append(_powers(displacement / sigma**2), ends)


def main() -> None:
    """Write the table next to the module `cgid.measure.fit.family`."""
    made = tabulate()
    np.savez(TABLE_PATH, force=made.force, displacement=made.displacement, times=made.times)
    print(f"{TABLE_PATH.name}: {TABLE_PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

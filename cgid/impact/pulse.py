"""Impact: one blow, or as many as the arrays hold, scaled from the dimensionless family."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cgid import family, validation
from cgid.impact import bodies
from cgid.impact.bodies import Sphere, Target
from cgid.impact.dissipation import Dissipation
from cgid.impact.hertz import contact_stiffness
from cgid.impact.quadrature import peak_logarithm, reference_pulse, time_of_peak
from cgid.impact.restitution import energy_below
from cgid.validation import Floats

#: Beyond this displacement over radius Hertz's small-strain contact is out of its range.
HERTZ_LIMIT = 0.1


class HertzRangeWarning(UserWarning):
    """The displacement is too large a part of the radius for Hertz's theory."""


@dataclass(frozen=True, kw_only=True)
class Impact:
    """A normal impact of a sphere on a target; every number may be an array, and they broadcast.

    Parameters
    ----------
    sphere : Sphere
        What falls.
    target : HalfSpace, Sphere or RIGID
        What it falls on, at rest.
    velocity : array_like
        Normal impact speed [m/s], above 0 (relative speed for two spheres).
    stiffness : {"hertz", "rigid-sphere", "series"}
        The theory of the contact stiffness (`cgid.impact.hertz`); it has no default.
    dissipation : Elastic or HuntCrossley
        Where the energy goes.

    Raises
    ------
    InvalidValue
        A number breaks its rule, a theory is unknown, or shapes do not broadcast.

    Warns
    -----
    HertzRangeWarning
        If the displacement passes a tenth of the radius.

    Examples
    --------
    The constants under Eq. 18 of Yang, Zeng & Wan (2018) belong to 2 m/s:

    >>> from cgid.impact import Elastic, HalfSpace, Impact, Sphere
    >>> from cgid.materials import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL),
    ...     velocity=2.0,
    ...     stiffness="series",
    ...     dissipation=Elastic(),
    ... )
    >>> round(float(impact.peak_displacement) / 0.025, 12)
    0.01337310606
    """

    sphere: Sphere
    target: Target
    velocity: ArrayLike
    stiffness: str
    dissipation: Dissipation

    def __post_init__(self) -> None:
        validation.positive("velocity", self.velocity, "m/s")
        strain = np.max(self.peak_displacement / self.reduced_radius)
        if strain > HERTZ_LIMIT:
            warnings.warn(
                f"displacement / radius reaches {strain:.3g}; Hertz's theory holds up to {HERTZ_LIMIT:g}",
                HertzRangeWarning,
                stacklevel=3,
            )

    @cached_property
    def _parameters(self) -> dict[str, Floats]:
        """The five numbers of the equation of motion, broadcast to one shape."""
        names = ("radius", "mass", "stiffness", "velocity", "damping", "restitution")
        values = (
            bodies.reduced_radius(self.sphere, self.target),
            bodies.reduced_mass(self.sphere, self.target),
            contact_stiffness(
                bodies.reduced_radius(self.sphere, self.target),
                bodies.reduced_modulus(self.sphere, self.target),
                self.stiffness,
            ),
            validation.real("velocity", self.velocity, "m/s"),
            self.dissipation.damping_number,
            self.dissipation.delivered_restitution,
        )
        named = dict(zip(names, values, strict=True))
        return dict(zip(names, validation.broadcast(**named), strict=True))

    @property
    def reduced_radius(self) -> Floats:
        """R of the contact [m]."""
        return self._parameters["radius"]

    @property
    def reduced_modulus(self) -> Floats:
        """E of the contact [Pa]."""
        return bodies.reduced_modulus(self.sphere, self.target)

    @property
    def reduced_mass(self) -> Floats:
        """Mass of the relative motion [kg]."""
        return self._parameters["mass"]

    @property
    def contact_stiffness(self) -> Floats:
        """K of `P = K delta^(3/2)` [N/m^(3/2)]."""
        return self._parameters["stiffness"]

    @property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed, as delivered."""
        return self._parameters["restitution"]

    @property
    def length_scale(self) -> Floats:
        """`L = (m v^2 / K)^(2/5)` [m], the unit of displacement."""
        p = self._parameters
        return np.asarray((p["mass"] * p["velocity"] ** 2 / p["stiffness"]) ** 0.4)

    @property
    def time_scale(self) -> Floats:
        """`T0 = L / v` [s], the unit of time."""
        return self.length_scale / self._parameters["velocity"]

    @property
    def force_scale(self) -> Floats:
        """`K L^(3/2)` [N], the unit of force."""
        return self._parameters["stiffness"] * self.length_scale**1.5

    @property
    def peak_displacement(self) -> Floats:
        """Largest displacement of the sphere centre [m], `L (5/2 G(1))^(2/5)`; closed form."""
        return self.length_scale * (2.5 * energy_below(self._parameters["damping"])) ** 0.4

    @property
    def peak_force(self) -> Floats:
        """Largest contact force [N]; closed form, before the largest displacement when damped."""
        damping = self._parameters["damping"]
        p = peak_logarithm(damping)
        # (2/5) x^(5/2) = 3 x' / (5 D) at the peak, and x' / D = expm1(p) / D^2.
        ratio = np.divide(np.expm1(p), damping**2, out=np.full(damping.shape, 5 / 6), where=damping > 1e-8)
        return np.asarray(self.force_scale * (1.5 * ratio) ** 0.6 * np.exp(p))

    @property
    def contact_duration(self) -> Floats:
        """Time from touch to separation [s]."""
        return self.time_scale * self._family_times[0]

    @property
    def time_of_peak(self) -> Floats:
        """Time from touch to the largest force [s]."""
        return self.time_scale * self._family_times[1]

    @property
    def rebound_velocity(self) -> Floats:
        """Speed of separation, `e v` [m/s]."""
        return self._parameters["restitution"] * self._parameters["velocity"]

    @property
    def impulse(self) -> Floats:
        """Integral of the force over the contact, `(1 + e) m v` [N s]."""
        p = self._parameters
        return np.asarray((1 + p["restitution"]) * p["mass"] * p["velocity"])

    def force(self, times: ArrayLike) -> Floats:
        """Return the contact force over time.

        Parameters
        ----------
        times : array_like, (..., n_times)
            Time since touch [s], along the last axis.

        Returns
        -------
        ndarray
            [N], zero outside contact, never attractive. Shape of `times` for a single impact, else the
            impacts' shape broadcast against the leading axes of `times`, then n_times.
        """
        return self._over_time(times, self.force_scale, "force")

    def displacement(self, times: ArrayLike) -> Floats:
        """Return the displacement of the sphere centre [m] over time, zero outside contact; as `force`."""
        return self._over_time(times, self.length_scale, "displacement")

    @cached_property
    def _family_times(self) -> tuple[Floats, Floats, Floats]:
        """Contact time, time of peak and compression time, dimensionless."""
        e = self._parameters["restitution"]
        served = family.in_table(e)
        found = np.stack(np.broadcast_arrays(*family.times(np.where(served, e, 1.0))))
        for index in map(tuple, np.argwhere(~served)):
            pulse = reference_pulse(float(e[index]))
            found[(slice(None), *index)] = pulse.contact_time, time_of_peak(float(e[index])), pulse.compression_time
        return found[0], found[1], found[2]

    def _over_time(self, times: ArrayLike, amplitude: Floats, quantity: str) -> Floats:
        times = validation.real("times", times, "s")
        e = self._parameters["restitution"]
        if times.ndim == 0:
            return self._over_time(times[None], amplitude, quantity)[..., 0]
        leading = np.broadcast_shapes(e.shape, times.shape[:-1])
        rows = np.ascontiguousarray(np.broadcast_to(times, (*leading, times.shape[-1]))).reshape(-1, times.shape[-1])

        def flat(values: Floats) -> Floats:
            return np.ascontiguousarray(np.broadcast_to(values, leading), dtype=np.float64).ravel()

        out = np.empty(rows.shape)
        restitution = flat(e)
        served = family.in_table(restitution)
        scale, height = flat(self.time_scale), flat(amplitude)
        if served.any():
            _fill(out, rows, restitution, scale, height, [flat(t) for t in self._family_times], quantity, served)
        for row in np.flatnonzero(~served):
            displacement, force = reference_pulse(float(restitution[row])).evaluate(rows[row] / scale[row])
            out[row] = height[row] * (force if quantity == "force" else displacement)
        return out.reshape(*leading, times.shape[-1])


def _fill(
    out: Floats,
    times: Floats,
    restitution: Floats,
    time_scale: Floats,
    amplitude: Floats,
    family_times: list[Floats],
    quantity: str,
    served: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
) -> None:
    # numba is loaded here and not above: the closed forms do not need it.
    from cgid.impact import _kernels

    table = family.table()
    terms = table.force if quantity == "force" else table.displacement
    contact, _, compression = (values[served] for values in family_times)
    filled = np.empty((int(served.sum()), times.shape[1]))
    _kernels.at_times(
        times[served],
        family.chebyshev_basis(restitution[served], 2)[:, 1].copy(),
        contact,
        family.cut_time(contact, compression),
        time_scale[served],
        amplitude[served],
        terms,
        quantity == "force",
        filled,
    )
    out[served] = filled

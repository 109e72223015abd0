"""Collision: who meets whom, how fast and by which laws, and the scales that follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.elementary import power
from cgid.errors import InvalidValue
from cgid.physics import bodies
from cgid.physics.bodies import HalfSpace, RigidWall, Sphere, Target, ThinPlate
from cgid.physics.curves import Curves
from cgid.physics.dissipation import Dissipation, Elastic, HuntCrossley, Viscoelastic
from cgid.physics.hertz import contact_stiffness
from cgid.validation import Floats

#: A weight g L / v^2 below this, times e^0.6, is left out: over the contact it changes the speed by some 3e-12 of it.
NEGLIGIBLE_WEIGHT = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class Collision:
    """What `Impact` is given, checked and broadcast, with its units of length, time and force; see `Impact`."""

    sphere: Sphere
    target: Target
    velocity: ArrayLike
    stiffness: str
    dissipation: Dissipation
    gravity: ArrayLike = 0.0

    def __post_init__(self) -> None:
        validation.instance("sphere", self.sphere, Sphere)
        validation.instance("target", self.target, HalfSpace, ThinPlate, Sphere, RigidWall)
        validation.instance("dissipation", self.dissipation, Elastic, HuntCrossley, Viscoelastic)
        validation.positive("velocity", self.velocity, "m/s")
        validation.not_negative("gravity", self.gravity, "m/s^2")
        validation.hold(self, "velocity", "gravity")
        self._require_reach()
        self.curves.require_rebound()

    def _require_reach(self) -> None:
        with np.errstate(all="ignore"):
            scales = {
                "mass": (self.reduced_mass, "kg"),
                "contact stiffness": (self.contact_stiffness, "N/m^(3/2)"),
                "displacement": (self.length_scale, "m"),
                "duration": (self.time_scale, "s"),
                "force": (self.force_scale, "N"),
                "energy": (self.reduced_mass * self._velocity**2, "J"),
                "square of the velocity": (self._velocity**2, "m^2/s^2"),
                "weight": (1 + self._weight, "times the force"),  # nothing is a weight, too
            }
            if isinstance(self.dissipation, Viscoelastic):
                scales["dissipative constant"] = (self._given["dissipative_constant"], "s")
            if isinstance(self.target, ThinPlate):
                scales["plate impedance"] = (self.target.impedance, "kg/s")
        for name, (scale, unit) in scales.items():
            held = (scale > 1e-290) & (scale < 1e290)
            if not held.all():
                raise InvalidValue(
                    f"the {name} of the impact must lie between 1e-290 and 1e290 {unit} for double precision to hold "
                    f"it, got {scale[~held].ravel()[0]:g} {unit}; check radius, material, velocity and loss"
                )

    @cached_property
    def _given(self) -> dict[str, Floats]:
        """What the parts come to, broadcast to one shape."""
        restitution, dissipative_constant = self.dissipation.loss(self.sphere, self.target)
        named = {
            "radius": bodies.reduced_radius(self.sphere, self.target),
            "mass": bodies.reduced_mass(self.sphere, self.target),
            "modulus": bodies.reduced_modulus(self.sphere, self.target),
            "velocity": np.asarray(self.velocity, dtype=np.float64),
            "gravity": np.asarray(self.gravity, dtype=np.float64),
            "restitution": restitution,
            "dissipative_constant": dissipative_constant,
            "thickness": np.asarray(self.target.thickness if isinstance(self.target, ThinPlate) else 0.0),
        }
        return dict(zip(named, validation.broadcast(**named), strict=True))

    @property
    def _velocity(self) -> Floats:
        return self._given["velocity"]

    @cached_property
    def _weight(self) -> Floats:
        """G L / v^2."""
        return self._given["gravity"] * self.length_scale / self._velocity**2

    @property
    def reduced_radius(self) -> Floats:
        """R of the contact [m]."""
        return self._given["radius"]

    @property
    def reduced_modulus(self) -> Floats:
        """E of the contact [Pa]."""
        return self._given["modulus"]

    @property
    def reduced_mass(self) -> Floats:
        """Mass of the relative motion [kg]."""
        return self._given["mass"]

    @cached_property
    def contact_stiffness(self) -> Floats:
        """K of `P = K delta^(3/2)` [N/m^(3/2)]."""
        return _fixed(contact_stiffness(self.reduced_radius, self.reduced_modulus, self.stiffness))

    @cached_property
    def length_scale(self) -> Floats:
        """`L = (m v^2 / K)^(2/5)` [m], the unit of displacement."""
        return _fixed(power(self.reduced_mass * self._velocity**2 / self.contact_stiffness, 0.4))

    @cached_property
    def time_scale(self) -> Floats:
        """`T0 = L / v` [s], the unit of time."""
        return _fixed(self.length_scale / self._velocity)

    @cached_property
    def force_scale(self) -> Floats:
        """`K L^(3/2)` [N], the unit of force."""
        return _fixed(self.contact_stiffness * self.length_scale * np.sqrt(self.length_scale))

    @cached_property
    def inelasticity(self) -> Floats:
        """Zener's `lambda = m / (Z T0)` of a thin plate; 0 for any other target."""
        if not isinstance(self.target, ThinPlate):
            return _fixed(np.zeros(self.reduced_mass.shape))
        return _fixed(self.reduced_mass / (self.target.impedance * self.time_scale))

    @cached_property
    def curves(self) -> Curves:
        """The dimensionless curves, one row for each impact in C order."""
        restitution, constant = self._given["restitution"], self._given["dissipative_constant"]
        # The harder the damping, the longer the contact: it lasts about e^-0.6 in units of T0.
        # Only what else comes from the table gains by it.
        plain = (constant == 0) & (self.inelasticity == 0)
        weight = np.where(plain & (self._weight < NEGLIGIBLE_WEIGHT * power(restitution, 0.6)), 0.0, self._weight)
        return Curves(
            restitution.ravel(), (constant / self.time_scale).ravel(), np.ravel(self.inelasticity), weight.ravel()
        )


def _fixed(values: Floats) -> Floats:
    """Return what is kept for later as an array that nobody can write to."""
    fixed = np.asarray(values)
    fixed.setflags(write=False)
    return fixed

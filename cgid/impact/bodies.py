"""The two bodies of an impact: a sphere, and a half space, another sphere or a rigid wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.materials import Material
from cgid.validation import Floats


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A solid elastic sphere of `material` and `radius` [m]."""

    material: Material
    radius: ArrayLike

    def __post_init__(self) -> None:
        validation.positive("radius", self.radius, "m")

    @property
    def mass(self) -> Floats:
        """`4/3 pi R^3 rho` [kg]."""
        radius = validation.real("radius", self.radius, "m")
        return 4 / 3 * np.pi * radius**3 * validation.real("density", self.material.density, "kg/m^3")


@dataclass(frozen=True, kw_only=True)
class HalfSpace:
    """An elastic half space of `material`, at rest and of infinite mass: a thick plate."""

    material: Material


@dataclass(frozen=True)
class RigidWall:
    """A flat wall that does not deform; use the constant `RIGID`."""


RIGID = RigidWall()

Target = HalfSpace | Sphere | RigidWall


def reduced_radius(sphere: Sphere, target: Target) -> Floats:
    """Return R of the contact [m]: `1/R = 1/R1 + 1/R2`, R1 itself against a flat target (Yang 2018, Eq. 8)."""
    radius = validation.real("radius", sphere.radius, "m")
    if not isinstance(target, Sphere):
        return radius
    return 1 / (1 / radius + 1 / validation.real("radius", target.radius, "m"))


def reduced_modulus(sphere: Sphere, target: Target) -> Floats:
    """Return E of the contact [Pa]: `1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2`, no second term for a rigid wall."""
    compliance = sphere.material.plane_strain_compliance
    if not isinstance(target, RigidWall):
        compliance = compliance + target.material.plane_strain_compliance
    return 1 / compliance


def reduced_mass(sphere: Sphere, target: Target) -> Floats:
    """Return m of the relative motion [kg]: `1/m = 1/m1 + 1/m2`, m1 itself against a target at rest."""
    if not isinstance(target, Sphere):
        return sphere.mass
    return 1 / (1 / sphere.mass + 1 / target.mass)

"""The bodies of an impact: a sphere, and its target (half space, thin plate, second sphere or rigid wall)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.physics.materials import Material
from cgid.validation import Floats


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A solid elastic sphere.

    Parameters
    ----------
    material : Material
    radius : array_like, above 0 [m]
    """

    material: Material
    radius: ArrayLike

    def __post_init__(self) -> None:
        validation.instance("material", self.material, Material)
        validation.positive("radius", self.radius, "m")
        validation.hold(self, "radius")

    @property
    def mass(self) -> Floats:
        """`4/3 pi R^3 rho` [kg]."""
        radius = np.asarray(self.radius, np.float64)
        return 4 / 3 * np.pi * (radius * radius * radius) * np.asarray(self.material.density, np.float64)


@dataclass(frozen=True, kw_only=True)
class HalfSpace:
    """An elastic half space at rest, of infinite mass: a model of a thick plate.

    Parameters
    ----------
    material : Material
    """

    material: Material

    def __post_init__(self) -> None:
        validation.instance("material", self.material, Material)


@dataclass(frozen=True, kw_only=True)
class ThinPlate:
    """A plate so wide that no wave returns from its edges during contact.

    The point of impact moves at the speed `P / Z`, and flexural waves carry the energy away
    (Zener 1941, Phys. Rev. 59, 669).

    Parameters
    ----------
    material : Material
    thickness : array_like, above 0 [m]
    """

    material: Material
    thickness: ArrayLike = np.nan

    def __post_init__(self) -> None:
        validation.instance("material", self.material, Material)
        validation.positive("thickness", self.thickness, "m")
        validation.hold(self, "thickness")

    @property
    def impedance(self) -> Floats:
        """`Z = 8 sqrt(B rho h)` with `B = E h^3 / (12 (1 - nu^2))` [kg/s].

        Examples
        --------
        >>> from cgid.physics.materials import STEEL
        >>> round(float(ThinPlate(material=STEEL, thickness=0.008).impedance))
        6291
        """
        return impedance_of_unit_thickness(self.material) * np.asarray(self.thickness, np.float64) ** 2


def impedance_of_unit_thickness(material: Material) -> Floats:
    """Return `Z / h^2` of a thin plate [kg/(s m^2)]."""
    density = np.asarray(material.density, np.float64)
    return 8 * np.sqrt(density / (12 * material.plane_strain_compliance))


@dataclass(frozen=True)
class RigidWall:
    """A flat, undeformable wall; use the constant `RIGID`."""


RIGID = RigidWall()

Target = HalfSpace | ThinPlate | Sphere | RigidWall


def reduced_radius(sphere: Sphere, target: Target) -> Floats:
    """Return R of the contact [m]: `1/R = 1/R1 + 1/R2` (Yang 2018, Eq. 8), or R1 on a flat target."""
    radius = np.asarray(sphere.radius, np.float64)
    if not isinstance(target, Sphere):
        return radius
    return 1 / (1 / radius + 1 / np.asarray(target.radius, np.float64))


def reduced_modulus(sphere: Sphere, target: Target) -> Floats:
    """Return E of the contact [Pa]: `1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2`; a rigid wall has no second term."""
    compliance = sphere.material.plane_strain_compliance
    if not isinstance(target, RigidWall):
        compliance = compliance + target.material.plane_strain_compliance
    return 1 / compliance


def sphere_share(sphere: Sphere, target: Target) -> Floats:
    """Return the sphere's share of the total compliance, `(1 - nu1^2) E / E1`: 1 on a rigid wall."""
    return sphere.material.plane_strain_compliance * reduced_modulus(sphere, target)


def reduced_mass(sphere: Sphere, target: Target) -> Floats:
    """Return the reduced mass m [kg]: `1/m = 1/m1 + 1/m2` for two spheres, otherwise m1."""
    if not isinstance(target, Sphere):
        return sphere.mass
    return 1 / (1 / sphere.mass + 1 / target.mass)

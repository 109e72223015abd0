"""The bodies of an impact: a sphere, and its target (half space, thin plate, second sphere or rigid wall)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.physics.contact.materials import Material, require_material

#: Radius [m] above which a number is likely to be in another unit: no rock is larger.
MAX_RADIUS = 10.0


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A solid elastic sphere, or a rock of its size with another curvature at the contact or an eccentric contact.

    Parameters
    ----------
    material : Material
    radius : array_like, above 0 [m]
        Of the sphere; of a rock, that of the sphere of equal mass.
    curvature : array_like, above 0
        Radius of curvature of a rock at the contact, over `radius`: below 1 at a corner, above 1 on a flat side.
    effective_mass : array_like, in (0, 1]
        Effective mass of the impact over the mass: `1 / (1 + b^2 / k^2)` without friction for a rock of radius of
        gyration k whose contact is at a distance b from the vertical through its centre; the remainder is rotational.

    Raises
    ------
    InvalidValue
        A value is out of range.

    Warns
    -----
    UserWarning
        A radius exceeds 10 m.

    Examples
    --------
    A rock that hits with a corner of 5 mm, as far off its centre as its radius of gyration:

    >>> from cgid.physics import YANG2018_SPHERES
    >>> rock = Sphere(material=YANG2018_SPHERES[1], radius=0.025, curvature=0.2, effective_mass=0.5)
    >>> round(float(rock.contact_radius), 9), float(rock.impact_mass / rock.mass)
    (0.005, 0.5)
    """

    material: Material
    radius: ArrayLike
    curvature: ArrayLike = 1.0
    effective_mass: ArrayLike = 1.0

    def __post_init__(self) -> None:
        require_material(self.material)
        radius = validation.positive("radius", self.radius, "m")
        if (radius > MAX_RADIUS).any():
            largest = radius.max()
            text = f"radius is {largest:g} m, larger than any rock; if it is in mm, give {largest / 1e3:g}"
            warnings.warn(text, UserWarning, stacklevel=3)
        validation.positive("curvature", self.curvature)
        validation.share("effective_mass", self.effective_mass)
        validation.hold(self, "radius", "curvature", "effective_mass")

    @property
    def mass(self) -> Floats:
        """`4/3 pi R^3 rho` [kg]."""
        radius = np.asarray(self.radius, np.float64)
        return 4 / 3 * np.pi * (radius * radius * radius) * np.asarray(self.material.density, np.float64)

    @property
    def contact_radius(self) -> Floats:
        """Radius of curvature at the contact [m]."""
        return np.asarray(self.radius, np.float64) * np.asarray(self.curvature, np.float64)

    @property
    def impact_mass(self) -> Floats:
        """Effective mass of an eccentric impact [kg]."""
        return self.mass * np.asarray(self.effective_mass, np.float64)


@dataclass(frozen=True, kw_only=True)
class HalfSpace:
    """An elastic half space of infinite mass at rest: a model of a thick plate.

    Parameters
    ----------
    material : Material
    """

    material: Material

    def __post_init__(self) -> None:
        require_material(self.material)


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
    thickness: ArrayLike

    def __post_init__(self) -> None:
        require_material(self.material)
        validation.positive("thickness", self.thickness, "m")
        validation.hold(self, "thickness")

    @property
    def impedance(self) -> Floats:
        """`Z = 8 sqrt(B rho h)` with `B = E h^3 / (12 (1 - nu^2))` [kg/s].

        Examples
        --------
        >>> from cgid.physics import STEEL
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
    if not isinstance(target, Sphere):
        return sphere.contact_radius
    return 1 / (1 / sphere.contact_radius + 1 / target.contact_radius)


def reduced_modulus(sphere: Sphere, target: Target) -> Floats:
    """Return E of the contact [Pa]: `1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2`; a rigid wall has no second term."""
    compliance = sphere.material.plane_strain_compliance
    if not isinstance(target, RigidWall):
        compliance = compliance + target.material.plane_strain_compliance
    return 1 / compliance


def sphere_share(sphere: Sphere, target: Target) -> Floats:
    """Return the sphere's fraction of the total compliance, `(1 - nu1^2) E / E1`: 1 on a rigid wall."""
    return sphere.material.plane_strain_compliance * reduced_modulus(sphere, target)


def reduced_mass(sphere: Sphere, target: Target) -> Floats:
    """Return the reduced mass m [kg] of effective masses: `1/m = 1/m1 + 1/m2` for two spheres, otherwise m1."""
    if not isinstance(target, Sphere):
        return sphere.impact_mass
    return 1 / (1 / sphere.impact_mass + 1 / target.impact_mass)

"""Impacts that several finite-element tests share: the paper's spheres on its plate, and Hertz's limit."""

from __future__ import annotations

import numpy as np

from cgid.physics import Sphere
from cgid.physics.contact.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from studies.finite_element import ElasticPlate, FiniteElementImpact

RADIUS = YANG2018_RADIUS
VOLUME = 4 / 3 * np.pi * RADIUS**3


def sphere(number: int = 1) -> Sphere:
    """Return a sphere of the paper's Table 2."""
    return Sphere(material=YANG2018_SPHERES[number], radius=RADIUS)


def plate(**changes) -> ElasticPlate:
    """Return the paper's plate, 8 mm of steel with its lower face fixed, or another one."""
    given = {"material": STEEL, "thickness": 0.008, "radius": 0.2, "lower_face": "fixed"}
    return ElasticPlate(**given | changes)


def impact(number: int = 1, velocity: float = 10.0, elements: int = 7, **changes) -> FiniteElementImpact:
    """Return an impact of a sphere of Table 2 on its plate."""
    given = {"sphere": sphere(number), "plate": plate(), "velocity": velocity, "elements": elements}
    return FiniteElementImpact(**given | changes)


def velocity_for(share: float, material: Material, radius: float = RADIUS) -> float:
    """Return the speed at which Hertz's contact on steel grows to a share of the sphere's radius [m/s].

    By energy: `m v^2 / 2 = 2/5 K delta^(5/2)`, with `delta = share^2 R` and `K = 4/3 sqrt(R) E`.
    """
    compliance = float(material.plane_strain_compliance + STEEL.plane_strain_compliance)
    mass = 4 / 3 * np.pi * radius**3 * float(np.asarray(material.density))
    return float(np.sqrt(16 / 15 * share**5 * radius**3 / compliance / mass))

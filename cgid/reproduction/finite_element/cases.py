"""The impacts of the finite-element study: which are computed, and what was chosen for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cgid.physics.bodies import sphere_share
from cgid.physics.materials import YANG2018_SPHERES
from cgid.physics.sensitivity import dissipative_constant
from cgid.reproduction import paper
from cgid.reproduction.impacts import paper_impact

#: Elements over Hertz's contact radius.
ELEMENTS = 14
#: Restitution of the damped impacts, chosen here: the paper gives no number for its damping. (It has one during the
#: contact, ours is another: the sphere is a Kelvin-Voigt body.)
RESTITUTION = 0.8
#: Radius of the round plate [m]: half the length of the paper's rectangular one.
PLATE_RADIUS = paper.PLATE_SIZE[0] / 2
#: Stiffness of a soft contact per area, times element size over bulk modulus: LS-DYNA's unless told
#: otherwise.
PENALTY_FACTOR = 0.1
#: Factors of a soft contact tried on two spheres at one speed [m/s].
FACTORS, FACTOR_SPHERES, FACTOR_VELOCITY = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0), (1, 3), 6.0

#: Groups of cases: the paper's twenty impacts with hard contact, elastic and damped; elastic with a contact as soft as
#: our elements make it, and as soft as that of larger ones (the mesh stays ours); and two of them with every factor.
UNDAMPED, DAMPED, SOFT, SOFT_BY_FACTOR = "undamped", "damped", "soft", "soft_by_factor"
SOFT_1_MM, SOFT_2_MM = "soft_1_mm", "soft_2_mm"
GROUPS = (UNDAMPED, DAMPED, SOFT, SOFT_1_MM, SOFT_2_MM, SOFT_BY_FACTOR)
#: Size of those larger elements, which are not meshed [m]: of the paper's sphere (section 3.1), and half of it, for its
#: contact has finer ones.
ELEMENT_SIZES = {SOFT_1_MM: 0.001, SOFT_2_MM: 0.002}
#: Impacts of the study.
N_CASES = (3 + len(ELEMENT_SIZES)) * len(YANG2018_SPHERES) * len(paper.VELOCITIES) + len(FACTOR_SPHERES) * len(FACTORS)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One impact of the study, of a sphere of Table 2 on the plate.

    Parameters
    ----------
    group : str
    sphere : int
        Number in Table 2.
    velocity : float
        [m/s].
    retardation_time : float
        Of the sphere as a Kelvin-Voigt body [s].
    penalty_factor : float
        Of a soft contact; 0 for a hard one.
    """

    group: str
    sphere: int
    velocity: float
    retardation_time: float = 0.0
    penalty_factor: float = 0.0


def all_cases() -> list[Case]:
    """Return every case, group by group, the four spheres at five speeds each."""
    twenty = [(sphere, velocity) for sphere in YANG2018_SPHERES for velocity in paper.VELOCITIES]
    return [
        *(Case(group=UNDAMPED, sphere=sphere, velocity=velocity) for sphere, velocity in twenty),
        *(
            Case(group=DAMPED, sphere=sphere, velocity=velocity, retardation_time=retardation_time)
            for sphere in YANG2018_SPHERES
            for velocity, retardation_time in zip(paper.VELOCITIES, retardation_times(sphere), strict=True)
        ),
        *(
            Case(group=SOFT, sphere=sphere, velocity=velocity, penalty_factor=PENALTY_FACTOR)
            for sphere, velocity in twenty
        ),
        *(
            Case(group=group, sphere=sphere, velocity=velocity, penalty_factor=factor_of(size, sphere, velocity))
            for group, size in ELEMENT_SIZES.items()
            for sphere, velocity in twenty
        ),
        *(
            Case(group=SOFT_BY_FACTOR, sphere=sphere, velocity=FACTOR_VELOCITY, penalty_factor=factor)
            for sphere in FACTOR_SPHERES
            for factor in FACTORS
        ),
    ]


def retardation_times(sphere: int) -> list[float]:
    """Return b [s] of a Kelvin-Voigt sphere that has the chosen restitution at each speed of the paper.

    By Kuwabara and Kono's `A = 3/2 b s`, the contact law of such a sphere (s is its share in the compliance of both
    bodies): so nothing is fitted, and what restitution the finite elements then have is a result.
    """
    impact = paper_impact(sphere, paper.VELOCITIES, "hertz")
    share = sphere_share(impact.sphere, impact.target)
    return [float(time) for time in dissipative_constant(RESTITUTION, impact) / (1.5 * share)]


def factor_of(size: float, sphere: int, velocity: float) -> float:
    """Return the factor with which our elements press as softly as `PENALTY_FACTOR` does with elements of this size."""
    return PENALTY_FACTOR * element_size(sphere, velocity) / size


def element_size(sphere: int, velocity: float) -> float:
    """Return the size of our elements at the contact [m]: a part of Hertz's contact radius."""
    impact = paper_impact(sphere, velocity, "hertz")
    return float(np.sqrt(impact.reduced_radius * impact.peak_displacement)) / ELEMENTS


def element_sizes() -> list[float]:
    """Return the size of our elements at the contact of each of the twenty impacts [m]."""
    return [element_size(sphere, velocity) for sphere in YANG2018_SPHERES for velocity in paper.VELOCITIES]

"""The printed tables of Yang, Zeng & Wan (2018), Shock and Vibration, and the impacts that they belong to.

The inputs of Tables 1 and 2 are in `cgid.physics.contact.materials`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib.validation import Floats
from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics.contact.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material

#: Impact speeds of the simulations [m/s], section 3.1.
VELOCITIES = (2.0, 4.0, 6.0, 8.0, 10.0)
#: Gravity of the simulations [m/s^2], section 3.1.
GRAVITY = 9.8
#: Gap between sphere and plate at the start of a simulation [m], section 3.1.
START_GAP = 0.000326
#: Length, width and thickness of the metal plate [m], Table 2.
PLATE_SIZE = (0.4584, 0.360, 0.008)


@dataclass(frozen=True)
class PrintedContact:
    """Reduced modulus [GPa] and Hertz's stiffness [N/m^(3/2)] of a sphere on the plate, digits as printed."""

    reduced_modulus: str
    stiffness: str


#: Table 1; both rows are equal.
TABLE_1 = PrintedContact("2.4265", "5.1155e8")
#: Table 2, by sphere number.
TABLE_2 = {
    1: PrintedContact("2.4265", "5.1155e8"),
    2: PrintedContact("4.6305", "9.7619e8"),
    3: PrintedContact("21.559", "4.5450e9"),
    4: PrintedContact("4.1618", "8.7739e8"),
}

_COMPARED = ("peak_displacement", "peak_force", "peak_pressure", "peak_sphere_energy", "peak_plate_energy")
#: Table 3: squared linear correlation R^2 of simulation and theory, by sphere and quantity.
TABLE_3 = {
    sphere: dict(zip(_COMPARED, row, strict=True))
    for sphere, row in {
        1: (0.99278, 0.96221, 0.8174, 0.85459, 0.94942),
        2: (0.99864, 0.97592, 0.85486, 0.99078, 0.90207),
        3: (0.99724, 0.99872, 0.7483, 0.99215, 0.94612),
        4: (0.99714, 0.99868, 0.79499, 0.97595, 0.84714),
    }.items()
}


@dataclass(frozen=True)
class ParameterRange:
    """A range `start : step : stop` of Tables 4 and 5, in SI units."""

    start: float
    step: float
    stop: float

    @property
    def values(self) -> Floats:
        """Every value, including both ends."""
        return np.linspace(self.start, self.stop, round((self.stop - self.start) / self.step) + 1)


class PoissonRange(ParameterRange):
    """A range of Poisson's ratio. It replaces 0.5, the incompressible limit, by the largest float below."""

    @property
    def values(self) -> Floats:
        """Every value, including both ends."""
        return np.minimum(super().values, np.nextafter(0.5, 0.0))


_ROCK_MODULUS, _POISSON = ParameterRange(1e9, 0.5e9, 21e9), PoissonRange(0.1, 0.01, 0.5)
#: Table 4: sphere 1 on the metal plate.
TABLE_4 = {
    "radius": ParameterRange(0.010, 0.005, 0.210),
    "density": ParameterRange(1000.0, 60.0, 3400.0),
    "youngs_modulus": _ROCK_MODULUS,
    "poisson_ratio": _POISSON,
    "target_youngs_modulus": ParameterRange(20e9, 40e9, 1620e9),
    "target_poisson_ratio": _POISSON,
}
#: Table 5: sphere 1 on a plate of its own material. It has no range of radius and density.
TABLE_5 = {
    "youngs_modulus": _ROCK_MODULUS,
    "poisson_ratio": _POISSON,
    "target_youngs_modulus": _ROCK_MODULUS,
    "target_poisson_ratio": _POISSON,
}


#: The paper's own theory, used in every theoretical figure except 4 to 6.
OWN_THEORY = "series"
#: The elastic bodies of each theory, in the paper's words.
THEORY_LABELS = {
    "hertz": "K1: elastic sphere, rigid surface (Hertz)",
    "rigid-sphere": "K2: rigid sphere, elastic half space",
    "series": "series: elastic sphere, elastic half space",
}
#: Short names of the theories.
THEORY_NAMES = {"hertz": "K1 (Hertz)", "rigid-sphere": "K2", "series": "series (the paper's own)"}
#: Speed implied by the constants under Eq. 18 [m/s]; the paper does not state it.
SECTION_4_VELOCITY = 2.0
#: Restitutions of damped impacts, chosen here: the paper does not quantify its damping.
RESTITUTIONS = (0.8, 0.5)
#: Restitution of Figures 16 and 17, chosen here.
SECTION_5_RESTITUTION = 0.5
#: Speed of Figures 16 and 17 [m/s].
SECTION_5_VELOCITY = 10.0


def paper_impact(
    number: int,
    velocity: ArrayLike,
    stiffness: str = OWN_THEORY,
    restitution: ArrayLike | None = None,
    target: Material = STEEL,
) -> Impact:
    """Return the impact of a sphere of Table 2 on a half space; elastic unless a restitution is given."""
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[number], radius=YANG2018_RADIUS),
        target=HalfSpace(material=target),
        velocity=velocity,
        stiffness=stiffness,
        dissipation=Elastic() if restitution is None else HuntCrossley(restitution=restitution),
    )


def table_4_impact() -> Impact:
    """Return the base impact of Table 4: sphere 1 on the metal plate."""
    return paper_impact(1, SECTION_4_VELOCITY)


def table_5_impact() -> Impact:
    """Return the base impact of Table 5: sphere 1 on a plate of its own material."""
    return paper_impact(1, SECTION_4_VELOCITY, target=YANG2018_SPHERES[1])

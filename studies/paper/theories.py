"""The predictions of each theory for the impacts of the study, and their errors against the finite elements.

Force and displacement come from the paper's formulas. The largest pressure is Hertz's, `3 P / (2 pi a^2)`, with
`a^2 = R delta` and each theory's own displacement. At the largest displacement all energy `m v^2 / 2` is elastic. In
the paper's reading it is stored in the springs of the theory: in the sphere (K1), in the plate (K2), or in both
(series), divided like their displacements under one force, `1 : (K1/K2)^(2/3)`, that is 4/7 and 3/7. But the E in K1
holds the compliance of both bodies. In Hertz's own reading the same pressure acts on both bodies, and the displacement
and energy of each are proportional to its `(1 - nu^2) / E`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from cgid._lib.validation import Floats
from cgid.physics import STIFFNESS_THEORIES
from cgid.physics.contact.bodies import sphere_share
from studies.paper.printed import THEORY_LABELS, paper_impact
from studies.paper.study import UNDAMPED, Study

#: The quantities of Figure 9 and Table 3, and the contact duration, which the paper does not compare.
QUANTITIES_COMPARED = (
    "peak_displacement",
    "peak_force",
    "peak_pressure",
    "peak_sphere_energy",
    "peak_plate_energy",
    "contact_duration",
)
#: K1 with the energy shared by compliance; its other quantities equal those of K1.
SHARED = "hertz-shared"
#: The compared readings: the paper's three theories, and Hertz's reading of the first.
READINGS = {**THEORY_LABELS, SHARED: "K1, energy shared by compliance"}


@dataclass(frozen=True)
class Agreement:
    """The agreement of a theory with the finite elements in one quantity.

    error : mean of theory / finite elements - 1
    squared_correlation : the paper's measure, blind to a constant factor; nan for a constant prediction
    determination : `1 - SSres / SStot`, which reveals a wrong factor and may be negative
    """

    error: float
    squared_correlation: float
    determination: float


@cache
def predicted(reading: str, sphere: int, velocities: tuple[float, ...]) -> dict[str, Floats]:
    """Return each of `QUANTITIES_COMPARED` for the elastic impacts of a sphere, (n_velocities,)."""
    theory = "hertz" if reading == SHARED else reading
    impact = paper_impact(sphere, np.asarray(velocities), theory)
    energy = 0.5 * impact.reduced_mass * np.square(impact.velocity)
    in_sphere = sphere_part(reading, sphere)
    contact_area = np.pi * impact.reduced_radius * impact.peak_displacement
    return {
        "peak_displacement": impact.peak_displacement,
        "peak_force": impact.peak_force,
        "peak_pressure": 1.5 * impact.peak_force / contact_area,
        "peak_sphere_energy": in_sphere * energy,
        "peak_plate_energy": (1 - in_sphere) * energy,
        "contact_duration": impact.contact_duration,
    }


def sphere_part(reading: str, sphere: int) -> float:
    """Return the share of the elastic energy that the sphere stores."""
    if reading == SHARED:
        impact = paper_impact(sphere, 1.0, "hertz")
        return float(sphere_share(impact.sphere, impact.target))
    if reading == "series":
        plate_over_sphere = (STIFFNESS_THEORIES["hertz"] / STIFFNESS_THEORIES["rigid-sphere"]) ** (2 / 3)
        return float(1 / (1 + plate_over_sphere))
    return {"hertz": 1.0, "rigid-sphere": 0.0}[reading]


def of_theory(study: Study, reading: str, name: str, group: str = UNDAMPED, sphere: int | None = None) -> Floats:
    """Return the predictions of a reading for the impacts of a group, of all spheres or of one."""
    return np.array([
        predicted(reading, run.case.sphere, (run.case.velocity,))[name][0]
        for run in study.of(group)
        if sphere in (None, run.case.sphere)
    ])  # fmt: skip


def of_simulation(study: Study, name: str, group: str = UNDAMPED, sphere: int | None = None) -> Floats:
    """Return the finite-element results for the impacts of a group, of all spheres or of one."""
    return np.array([run.numbers[name] for run in study.of(group) if sphere in (None, run.case.sphere)])


def agreement(study: Study, reading: str, name: str, group: str = UNDAMPED, sphere: int | None = None) -> Agreement:
    """Return the agreement of a reading with the finite elements in one quantity."""
    found = of_theory(study, reading, name, group, sphere)
    wanted = of_simulation(study, name, group, sphere)
    residual, total = np.sum((found - wanted) ** 2), np.sum((wanted - wanted.mean()) ** 2)
    constant = np.ptp(found) == 0
    return Agreement(
        float(np.mean(found / wanted - 1)),
        float("nan") if constant else float(np.corrcoef(found, wanted)[0, 1] ** 2),
        float(1 - residual / total),
    )

"""Impact against impacts in 32-digit arithmetic (tests/references/make_impacts.py), which share no code with it.

The table is dimensionless; here each of its rows becomes a sphere of coal on steel, and what Impact says of that
is made dimensionless again.
"""

import csv
import warnings
from pathlib import Path

import numpy as np
import pytest

from cgid.physics import (
    HUNT_CROSSLEY_LAWS,
    STEEL,
    YANG2018_SPHERES,
    Elastic,
    HalfSpace,
    HuntCrossley,
    Impact,
    Sphere,
    ThinPlate,
    ThinPlateWarning,
    Viscoelastic,
)

TABLE = Path(__file__).parent / "references" / "impacts.csv"
RADIUS, VELOCITY = 0.025, 2.0
N_SAMPLES = 50
#: The default tolerance of Impact.
TOLERANCE = 1e-8


def read():
    """Return the rows of the table by family."""
    families = {}
    with TABLE.open(newline="") as file:
        for row in csv.DictReader(file):
            families.setdefault(row["family"], []).append(row)
    return families


ROWS = read()


def scales():
    """Return mass, L and T0 of the sphere, from the formulas of Hertz and of L and T0 themselves."""
    coal = YANG2018_SPHERES[1]
    mass = 4 / 3 * np.pi * RADIUS**3 * coal.density
    modulus = 1 / ((1 - coal.poisson_ratio**2) / coal.youngs_modulus + (1 - STEEL.poisson_ratio**2) / 210e9)
    length = (mass * VELOCITY**2 / (4 / 3 * np.sqrt(RADIUS) * modulus)) ** 0.4
    return mass, length, length / VELOCITY


def plate_of(inelasticity):
    """Return a steel plate of this lambda = m / (Z T0), Z = 8 sqrt(B rho h) with B = E h^3 / (12 (1 - nu^2))."""
    mass, _, time = scales()
    per_square = 8 * np.sqrt(210e9 / (12 * (1 - STEEL.poisson_ratio**2)) * STEEL.density)
    return ThinPlate(material=STEEL, thickness=np.sqrt(mass / (inelasticity * time) / per_square))


def impact_of(row):
    _, length, time = scales()
    zeta, inelasticity = float(row["zeta"]), float(row["lambda"])
    dissipation = Elastic()
    if row["law"]:
        dissipation = HuntCrossley(restitution=float(row["asked"]), law=row["law"])
    elif zeta:
        dissipation = Viscoelastic(dissipative_constant=zeta * time)
    with warnings.catch_warnings():
        if abs(inelasticity - 1.5) < 1e-9:  # rounding decides whether that is beyond Zener's theory
            warnings.simplefilter("ignore", ThinPlateWarning)
        return Impact(
            sphere=Sphere(material=YANG2018_SPHERES[1], radius=RADIUS),
            target=plate_of(inelasticity) if inelasticity else HalfSpace(material=STEEL),
            velocity=VELOCITY,
            stiffness="hertz",
            dissipation=dissipation,
            gravity=float(row["gamma"]) * VELOCITY**2 / length,
        )


def test_the_table_has_every_mechanism_and_every_law():
    assert {
        "hunt-crossley", "published", "kuwabara-kono", "plate", "plate hunt-crossley", "plate kuwabara-kono",
        "gravity hunt-crossley", "gravity kuwabara-kono", "gravity plate",
    } == set(ROWS)  # fmt: skip
    laws = {row["law"] for rows in ROWS.values() for row in rows} - {""}
    assert laws == set(HUNT_CROSSLEY_LAWS)
    assert sum(map(len, ROWS.values())) >= 200


@pytest.mark.parametrize("family", ROWS)
def test_impact_agrees_with_32_digits(family):
    """Forces within the default tolerance of the peak, all else within that of itself."""
    mass, length, time = scales()
    force = mass * VELOCITY / time
    for row in ROWS[family]:
        impact = impact_of(row)
        found = {
            "lambda": impact.inelasticity,
            "restitution": impact.restitution,
            "contact_time": impact.contact_duration / time,
            "peak_force": impact.peak_force / force,
            "time_of_peak": impact.time_of_peak / time,
            "peak_displacement": impact.peak_displacement / length,
            "time_of_peak_displacement": impact.compression_time / time,
            "end_displacement": impact.end_displacement / length,
            "plate_energy": impact.radiated_energy / (mass * VELOCITY**2),
        }
        if row["law"]:
            found["D"] = impact.dissipation.damping_number
            found["material_restitution"] = impact.dissipation.delivered_restitution
        about = {name: row[name] for name in ("law", "asked", "zeta", "lambda", "gamma")}
        for name, value in found.items():
            # Where the force is greatest it is flat, so its time is known less well.
            limit = 5 * TOLERANCE if name == "time_of_peak" else TOLERANCE
            assert float(value) == pytest.approx(float(row[name]), rel=limit, abs=0), (name, about)
        times, forces = (np.array([float(row[f"{name}_{k}"]) for k in range(N_SAMPLES)]) for name in ("tau", "force"))
        deviation = np.abs(impact.force(times * time) / force - forces).max() / float(row["peak_force"])
        assert deviation < TOLERANCE, about

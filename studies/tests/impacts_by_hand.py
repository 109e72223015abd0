"""The impacts of the finite-element study as rows, and the theories' results for them from the formulas."""

from __future__ import annotations

import numpy as np
import pandas as pd

from studies.paper.study import UNDAMPED

# rho, E, nu of Table 2 of the paper, independent of the package.
SPHERES = {1: (1380, 2.26e9, 0.28), 2: (1550.6, 4.3e9, 0.30), 3: (2412, 21.64e9, 0.30), 4: (2400, 3.906e9, 0.28)}
RADIUS, STEEL_COMPLIANCE = 0.025, 0.91 / 210e9
FACTORS = {"hertz": 1.0, "rigid-sphere": 8 * 3**0.5 / 9, "series": 1.75**-1.5}
RESPONSES = ("peak_force", "peak_displacement", "contact_duration")


def table(study, group=UNDAMPED):
    """Return sphere, speed and numbers of a group, a row for each impact."""
    return pd.DataFrame(
        [{"sphere": found.case.sphere, "velocity": found.case.velocity, **found.numbers} for found in study.of(group)]
    )


def by_hand(theory, sphere, velocity):
    """Return force, DCS, contact time, pressure and energy of an elastic impact, from the formulas."""
    density, modulus, nu = SPHERES[sphere]
    mass = 4 / 3 * np.pi * RADIUS**3 * density
    stiffness = FACTORS[theory] * 4 / 3 * RADIUS**0.5 / ((1 - nu**2) / modulus + STEEL_COMPLIANCE)
    displacement = (5 * mass * velocity**2 / (4 * stiffness)) ** 0.4
    force = stiffness * displacement**1.5
    return {
        "peak_force": force,
        "peak_displacement": displacement,
        "contact_duration": 2.943275184 * displacement / velocity,
        "peak_pressure": 3 * force / (2 * np.pi * RADIUS * displacement),
        "energy": mass * velocity**2 / 2,
    }

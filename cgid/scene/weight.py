"""A falling body's weight during contact: where it is felt, and what leaving it out costs.

In the dimensionless equation the weight is `gamma = g L / v^2`. Without it the impact comes from closed forms and the
table, with it every impact is integrated. Left out, peak force, contact duration, restitution and every sample of the
pulse are each wrong by less than `2.4 gamma / e` of the peak, the duration, the restitution and the peak, with e the
restitution without weight. The coefficient is measured against the integrated impacts for e from .05 to 1
(`tests/test_plan.py`); the largest share of it is the restitution's (2.34 gamma / e at e = .05).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from cgid.errors import InvalidValue
from cgid.physics import (
    Elastic,
    HuntCrossley,
    Impact,
    Sphere,
    ThinPlate,
    free_fall_velocity,
)
from cgid.physics.bodies import Target
from cgid.physics.materials import Material
from cgid.scene.range_warnings import unwarned
from cgid.scene.sections import ImpactSection, Population
from cgid.validation import Floats

#: Largest relative error from leaving gravity out, where the scene says nothing else.
TOLERANCE = 1e-3
#: Relative error of whatever is wrong most, over gamma / e.
_ERROR = 2.4


def tolerance_of(section: ImpactSection) -> float:
    """Return the largest relative error that a scene allows for leaving gravity out."""
    return TOLERANCE if section.gravity_tolerance is None else section.gravity_tolerance


def error_without_weight(impact: Impact, gravity: float) -> Floats:
    """Return the bound on the relative error of weightless impacts, of their shape.

    It is not one for a thin plate, which takes from the rebound what the weight acts on: there weight always counts.
    """
    speed = impact.length_scale / impact.time_scale
    return np.asarray(_ERROR * gravity * impact.length_scale / (speed * speed) / impact.restitution)


def largest_error(section: ImpactSection, target: Target, populations: Iterable[Population]) -> float:
    """Return the bound on the error of leaving gravity out of any impact of these; 0 where a scene has no gravity."""
    if section.gravity is None:
        return 0.0
    if isinstance(target, ThinPlate):
        return np.inf
    heaviest = (heaviest_impact(section, target, population) for population in populations)
    return max((float(error_without_weight(impact, section.gravity)) for impact in heaviest), default=0.0)


def weighed(section: ImpactSection, **parts: Any) -> Impact:
    """Return impacts with gravity where its effect passes the tolerance; each is judged by itself."""
    if section.gravity is None:
        return Impact(**parts)
    if isinstance(parts["target"], ThinPlate):
        return Impact(**parts, gravity=section.gravity)
    weightless = Impact(**parts)
    felt = error_without_weight(weightless, section.gravity) > tolerance_of(section)
    if not felt.any():
        return weightless
    return Impact(**parts, gravity=np.where(felt, section.gravity, 0.0))


def heaviest_impact(
    section: ImpactSection, target: Target, population: Population, *, with_weight: bool = False
) -> Impact:
    """Return the impact of a population in which weight counts most: every number at its extreme.

    `gamma = g L / v^2` with `L = (m v^2 / K)^(2/5)` grows with mass, falls with stiffness and with speed.
    """
    if population.velocity is not None:
        velocity = population.velocity.extremes[0]
    else:
        assert population.drop_height is not None  # the population has checked that it has one of the two
        velocity = float(free_fall_velocity(population.drop_height.extremes[0]))
    low, high = population.poisson_ratio.extremes
    softest = min(abs(low), abs(high)) if low * high > 0 else 0.0
    sphere = Sphere(
        material=Material(
            density=population.density.extremes[1],
            youngs_modulus=population.youngs_modulus.extremes[0],
            poisson_ratio=softest,
        ),
        radius=population.radius.extremes[1],
    )
    if population.restitution is None:
        loss: Elastic | HuntCrossley = Elastic()
    else:
        loss = HuntCrossley(restitution=population.restitution.extremes[0], law=section.law)
    with unwarned():
        parts: dict[str, Any] = {
            "sphere": sphere,
            "target": target,
            "velocity": velocity,
            "stiffness": section.stiffness,
        }
        return weighed(section, **parts, dissipation=loss) if with_weight else Impact(**parts, dissipation=loss)


def problem_of_weight(section: ImpactSection, target: Target, population: Population) -> str | None:
    """Return what is wrong with the gravity of this scene for this population; None where all of it rebounds."""
    if section.gravity is None:
        return None
    try:
        heaviest_impact(section, target, population, with_weight=True)
    except InvalidValue as error:
        return (
            f"the slowest, largest and softest impact that can be drawn must be one that gravity leaves a rebound: "
            f"{error}; or leave impact.gravity out"
        )
    return None

"""Impacts at the extremes of a population: invalid scenes, and the effect of gravity.

In the dimensionless equation a body's weight is `gamma = g L / v^2`. Impacts without it come from closed forms and the
table; impacts with it are integrated. Leaving it out changes peak force, contact duration, restitution and, relative to
the peak, every sample of the pulse by less than `2.4 gamma / e`, with the restitution e without weight. The coefficient
is measured against integrated impacts for e from 0.05 to 1 (`tests/test_plan.py`); the restitution takes the largest
share of it (2.34 gamma / e at e = 0.05).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from cgid._lib.validation import Floats, unchecked
from cgid.errors import InvalidValue
from cgid.physics.contact.bodies import Sphere, Target, ThinPlate, reduced_modulus, reduced_radius
from cgid.physics.contact.curves import Law, is_builtin, own_code
from cgid.physics.contact.impact import Contacts, Impact
from cgid.physics.contact.laws import STIFFNESS_THEORIES, Elastic, HuntCrossley, named, speed_of_fall, stiffness_of
from cgid.physics.contact.materials import YIELD_OVER_STRENGTH, Material
from cgid.scene.file.sections import ImpactSection, Population

#: Default maximum relative error of neglecting gravity.
GRAVITY_TOLERANCE = 1e-3
#: Largest relative error over gamma / e.
_ERROR = 2.4
#: Zener's lambda up to which the integration works for every restitution of a scene (from 49 on some fail). His theory
#: holds to 1.5, where the plate takes some 80 % of the speed; here it takes all but a few parts in 1e8.
MAX_INELASTICITY = 30.0


def tolerance_of(section: ImpactSection) -> float:
    """Return the maximum relative error of a scene for neglecting gravity."""
    return GRAVITY_TOLERANCE if section.gravity_tolerance is None else section.gravity_tolerance


def error_without_weight(impact: Impact, gravity: float) -> Floats:
    """Return the bound on the relative error of weightless impacts; infinite on a thin plate."""
    speed = impact.length_scale / impact.time_scale
    return np.asarray(_ERROR * gravity * impact.length_scale / (speed * speed) / impact.restitution)


def largest_error(section: ImpactSection, target: Target, populations: Iterable[Population]) -> float:
    """Return the bound on the error of neglecting gravity in any impact; 0 for a scene without gravity."""
    if section.gravity is None:
        return 0.0
    heaviest = [heaviest_impact(section, target, population) for population in populations]
    if not all(_has_bound(target, impact.dissipation) for impact in heaviest):
        return np.inf
    return max((float(error_without_weight(impact, section.gravity)) for impact in heaviest), default=0.0)


def _has_bound(target: Target, dissipation: Law) -> bool:
    """Return whether the error of neglecting gravity has a bound."""
    return isinstance(dissipation, Elastic | HuntCrossley) and not isinstance(target, ThinPlate)


def weighed(section: ImpactSection, **parts: Any) -> Contacts:
    """Return impacts, each with gravity if its effect exceeds the tolerance."""
    if section.gravity is None:
        return Contacts(**parts)
    if not _has_bound(parts["target"], parts["dissipation"]):
        return Contacts(**parts, gravity=section.gravity)
    weightless = Contacts(**parts)
    felt = error_without_weight(weightless, section.gravity) > tolerance_of(section)
    if not felt.any():
        return weightless
    return Contacts(**parts, gravity=np.where(felt, section.gravity, 0.0))


def heaviest_impact(
    section: ImpactSection, target: Target, population: Population, *, with_weight: bool = False
) -> Contacts:
    """Return the impact of a population with the largest effect of weight: every number at its extreme."""
    # `gamma = g L / v^2` with `L = (m v^2 / K)^(2/5)` grows with mass and falls with stiffness and speed.
    low, high = population.poisson_ratio.extremes
    softest = min(abs(low), abs(high)) if low * high > 0 else 0.0
    parts: dict[str, Any] = {
        "sphere": _largest_sphere(population, population.youngs_modulus.extremes[0], softest, sharp=True),
        "target": target,
        "velocity": _speeds(population)[0],
        "stiffness": section.stiffness,
        "dissipation": _largest_loss(section, population),
    }
    return weighed(section, **parts) if with_weight else Contacts(**parts)


def _largest_loss(section: ImpactSection, population: Population) -> Law:
    """Return the law of a population with its lowest restitutions and yield pressure."""
    law = named(population.dissipation or section.dissipation)
    drawn = {name: getattr(population, name) for name in law.keys}
    lowest = {name: one.extremes[0] for name, one in drawn.items() if one is not None}
    if population.strength is not None:
        lowest["yield_pressure"] = YIELD_OVER_STRENGTH * population.strength.extremes[0]
    more = {"law": section.law} if law is HuntCrossley else {}
    if is_builtin(law):
        return unchecked(law, **lowest, **more)
    with own_code(law):
        return law(**lowest)


def problem_of_law(section: ImpactSection, target: Target, population: Population) -> str | None:
    """Return an error message if a custom law of this population cannot be used, else None."""
    if is_builtin(named(population.dissipation or section.dissipation)):
        return None
    try:
        heaviest_impact(section, target, population).curves.require_rebound()
    except InvalidValue as error:
        return f"its slowest, largest and softest impact: {error}"
    return None


def problem_of_weight(section: ImpactSection, target: Target, population: Population) -> str | None:
    """Return an error message if gravity prevents a rebound of this population, else None."""
    if section.gravity is None:
        return None
    try:
        heaviest_impact(section, target, population, with_weight=True).curves.require_rebound()
    except InvalidValue as error:
        return (
            f"the slowest, largest and softest possible impact must rebound under gravity: {error}; or leave "
            "impact.gravity out"
        )
    return None


def problem_on_plate(section: ImpactSection, target: Target, population: Population, thickness: str) -> str | None:
    """Return an error message if the target is a plate too thin for this population, else None."""
    if not isinstance(target, ThinPlate):
        return None
    poisson_ratio = max(population.poisson_ratio.extremes[::-1], key=abs)
    sphere = _largest_sphere(population, population.youngs_modulus.extremes[1], poisson_ratio, sharp=False)
    velocity = _speeds(population)[1]
    # lambda = m / (Z T0) with T0 = (m / K)^(2/5) v^(-1/5) grows with all of these.
    mass = float(sphere.impact_mass)
    factor = STIFFNESS_THEORIES[section.stiffness]
    stiffness = stiffness_of(reduced_radius(sphere, target), reduced_modulus(sphere, target), factor)
    inelasticity = float(np.power(mass, 0.6) * np.power(stiffness, 0.4) * np.power(velocity, 0.2) / target.impedance)
    if inelasticity <= MAX_INELASTICITY:
        law = _largest_loss(section, population)
        if isinstance(law, Elastic | HuntCrossley):
            return None
        parts: dict[str, Any] = {"sphere": sphere, "target": target, "velocity": velocity}
        try:
            Contacts(**parts, stiffness=section.stiffness, dissipation=law).curves.require_rebound()
        except InvalidValue as error:
            return f"the heaviest, stiffest and fastest possible impact must rebound: {error}; or raise {thickness}"
        return None
    return (
        f"lambda of the thin plate must be at most {MAX_INELASTICITY:g}, its maximum is {inelasticity:.3g}; "
        f"raise {thickness}, or give radius, density, youngs_modulus and speed a lower highest value"
    )


def _speeds(population: Population) -> tuple[float, float]:
    """Return the lowest and the highest possible speed at onset [m/s]."""
    if population.velocity is not None:
        return population.velocity.extremes
    assert population.drop_height is not None  # checked by the population
    low, high = population.drop_height.extremes
    return float(speed_of_fall(np.asarray(low))), float(speed_of_fall(np.asarray(high)))


def _largest_sphere(population: Population, youngs_modulus: float, poisson_ratio: float, *, sharp: bool) -> Sphere:
    """Return the heaviest rock of a population, hitting with its sharpest corner or its flattest side."""
    material = unchecked(
        Material, density=population.density.extremes[1], youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio
    )
    curvature = (1.0, 1.0) if population.curvature is None else population.curvature.extremes
    return unchecked(
        Sphere,
        material=material,
        radius=population.radius.extremes[1],
        curvature=curvature[0 if sharp else 1],
        effective_mass=1.0 if population.effective_mass is None else population.effective_mass.extremes[1],
    )

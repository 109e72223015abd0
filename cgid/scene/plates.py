"""Whether a thin plate bears the hardest impact that a population can make."""

from __future__ import annotations

from cgid.elementary import power
from cgid.physics import Sphere, ThinPlate, contact_stiffness, free_fall_velocity
from cgid.physics.bodies import Target, reduced_modulus, reduced_radius
from cgid.physics.materials import Material
from cgid.scene.sections import Population

#: Zener's lambda up to which every restitution of a scene can be followed (from 49 on some cannot). His theory holds
#: to 1.5: up to there the plate takes some 80 % of the speed, here all but a few parts in 1e8.
HIGHEST_INELASTICITY = 30.0


def problem_on_plate(target: Target, theory: str, population: Population, thickness: str) -> str | None:
    """Return what is wrong with this population on this target; None for any target but a plate too thin.

    thickness is where the scene file says it.
    """
    if not isinstance(target, ThinPlate):
        return None
    lowest, highest = population.poisson_ratio.extremes
    sphere = Sphere(
        material=Material(
            density=population.density.extremes[1],
            youngs_modulus=population.youngs_modulus.extremes[1],
            poisson_ratio=lowest if abs(lowest) > abs(highest) else highest,
        ),
        radius=population.radius.extremes[1],
    )
    if population.velocity is not None:
        velocity = population.velocity.extremes[1]
    else:
        assert population.drop_height is not None  # the population has checked that it has one of the two
        velocity = float(free_fall_velocity(population.drop_height.extremes[1]))
    # lambda = m / (Z T0) with T0 = (m / K)^(2/5) v^(-1/5) grows with all of these.
    mass = float(sphere.mass)
    stiffness = contact_stiffness(reduced_radius(sphere, target), reduced_modulus(sphere, target), theory)
    inelasticity = float(power(mass, 0.6) * power(stiffness, 0.4) * power(velocity, 0.2) / target.impedance)
    if inelasticity <= HIGHEST_INELASTICITY:
        return None
    return (
        f"lambda of the thin plate must be at most {HIGHEST_INELASTICITY:g}, it can be drawn as {inelasticity:.3g}; "
        f"raise {thickness}, or give radius, density, youngs_modulus and speed a lower highest value"
    )

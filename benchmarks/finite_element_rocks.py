"""The rocks of `datasets/finite_element.npz`: by impact laws, and solved again on other meshes or without loss.

A part of `finite_element_identification.py`.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cgid.finite_element import ElasticPlate, FiniteElementImpact, History
from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Sphere, Viscoelastic, dissipative_constant
from cgid.physics.materials import STEEL, Material
from cgid.physics.sampled import SampledPulses, shares_of_contact, smoothed
from cgid.scene import Scene
from cgid.scene.given_pulses import SolvedImpacts

ELASTIC = "finite elements without loss"
FINITE_ELEMENTS, VISCOELASTIC, FAMILY = "finite elements", "Kuwabara-Kono", "Hunt-Crossley (the family)"
#: Points of a pulse.
POINTS = 192


def sphere_of(rocks: Mapping[str, np.ndarray], radius: float | np.ndarray = 1.0) -> Sphere:
    """Return rocks as spheres."""
    names = ("density", "youngs_modulus", "poisson_ratio")
    return Sphere(material=Material(**{name: rocks[name] for name in names}), radius=radius)


def by_law(rocks: Mapping[str, np.ndarray], scene: Scene, law: str, radius: float | np.ndarray = 1.0) -> SampledPulses:
    """Return the pulses of rocks by a law, each with its restitution."""
    common = {
        "sphere": sphere_of(rocks, radius),
        "target": HalfSpace(material=scene.impact.target.material),
        "velocity": rocks["velocity"],
        "stiffness": scene.impact.stiffness,
    }
    dissipation = HuntCrossley(restitution=rocks["restitution"])
    if law == VISCOELASTIC:
        constant = dissipative_constant(rocks["restitution"], Impact(dissipation=Elastic(), **common))
        dissipation = Viscoelastic(dissipative_constant=constant)
    impact = Impact(dissipation=dissipation, **common)
    shares = shares_of_contact(POINTS)
    forces = impact.force(shares * impact.contact_duration[:, None])
    forces[:, -1] = 0.0  # rounding may put it just inside the contact
    return SampledPulses(shares=shares, forces=forces, contact_duration=impact.contact_duration)


def solved_again(solved: SolvedImpacts, row: int, elements: int, steps: int | None = None) -> History:
    """Solve one impact again: in implicit steps, this many over Hertz's duration, or explicitly without loss."""
    rock = {name: float(values[row]) for name, values in solved.columns.items()}
    velocity, steel = rock["velocity"], HalfSpace(material=STEEL)
    law = Impact(sphere=sphere_of(rock), target=steel, velocity=velocity, stiffness="hertz", dissipation=Elastic())
    contact_radius = float(np.sqrt(law.peak_displacement))
    plate = ElasticPlate(
        material=STEEL,
        thickness=solved.made["target_thickness"] * contact_radius,
        radius=solved.made["target_radius"] * contact_radius,
        lower_face=solved.made["lower_face"],
    )
    common = {"sphere": sphere_of(rock), "plate": plate, "velocity": velocity, "elements": elements}
    if steps is None:
        return FiniteElementImpact(**common).run()
    step = float(law.contact_duration) / steps
    return FiniteElementImpact(
        **common, retardation_time=rock["retardation_time"], method="implicit", time_step=step
    ).run()


def extreme_rocks(solved: SolvedImpacts, n: int) -> list[int]:
    """Return n rows: the hardest, softest, liveliest and most damped rock, then others from the first on."""
    modulus, restitution = solved.columns["youngs_modulus"], solved.columns["restitution"]
    rows = [np.argmax(modulus), np.argmin(modulus), np.argmax(restitution), np.argmin(restitution)]
    more = max(n - len(rows), 0)
    return [int(row) for row in (*rows, *(np.arange(more) * len(solved) // max(more, 1)))][:n]


def without_loss(solved: SolvedImpacts, n: int) -> SolvedImpacts:
    """Solve n of the rocks again as elastic spheres, by explicit steps."""
    rows = np.linspace(0, len(solved) - 1, n).astype(int)
    shares = shares_of_contact(POINTS)
    courses = [solved_again(solved, row, elements=14) for row in rows]
    forces = [smoothed(c.times, c.contact_force.samples, c.contact_duration, shares) for c in courses]
    durations = np.array([c.contact_duration for c in courses])
    columns = {name: values[rows] for name, values in solved.columns.items()}
    return replace(
        solved,
        pulses=SampledPulses(shares=shares, forces=np.array(forces), contact_duration=durations),
        labels=solved.labels[rows],
        columns=columns | {"restitution": np.array([c.restitution for c in courses])},
    )


def all_three(solved: SolvedImpacts, scene: Scene) -> dict[str, SolvedImpacts]:
    """Return the impacts as solved, and the same impacts by the two laws."""
    by = {law: replace(solved, pulses=by_law(solved.columns, scene, law)) for law in (VISCOELASTIC, FAMILY)}
    return {FINITE_ELEMENTS: solved} | by

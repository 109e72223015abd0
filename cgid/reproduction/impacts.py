"""The paper's impacts, as `cgid.physics` has them."""

from __future__ import annotations

from numpy.typing import ArrayLike

from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material

#: The paper's own theory, behind every figure but 4 to 6.
OWN_THEORY = "series"
#: What each theory takes to be elastic, in the paper's words.
THEORY_LABELS = {
    "hertz": "K1: elastic sphere, rigid surface (Hertz)",
    "rigid-sphere": "K2: rigid sphere, elastic half space",
    "series": "series: elastic sphere, elastic half space",
}
#: The theories in a few words.
THEORY_NAMES = {"hertz": "K1 (Hertz)", "rigid-sphere": "K2", "series": "series (the paper's own)"}
#: Speed that belongs to the constants under Eq. 18 [m/s]; the paper does not say it.
SECTION_4_VELOCITY = 2.0
#: Restitutions chosen here for damped impacts: the paper gives no number for its damping.
RESTITUTIONS = (0.8, 0.5)
#: The restitution of Figures 16 and 17, chosen here.
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
    """Return the impact whose parameters Table 4 varies: sphere 1 on the metal plate."""
    return paper_impact(1, SECTION_4_VELOCITY)


def table_5_impact() -> Impact:
    """Return the impact whose parameters Table 5 varies: sphere 1 on a plate of its own material."""
    return paper_impact(1, SECTION_4_VELOCITY, target=YANG2018_SPHERES[1])

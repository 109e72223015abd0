"""One impact: its pulse, its peaks, its rebound."""

from cgid.impact.bodies import RIGID, HalfSpace, RigidWall, Sphere
from cgid.impact.dissipation import Elastic, HuntCrossley
from cgid.impact.hertz import STIFFNESS_THEORIES, contact_stiffness, free_fall_velocity
from cgid.impact.pulse import HertzRangeWarning, Impact
from cgid.impact.restitution import damping_number, delivered_restitution

__all__ = [
    "RIGID",
    "STIFFNESS_THEORIES",
    "Elastic",
    "HalfSpace",
    "HertzRangeWarning",
    "HuntCrossley",
    "Impact",
    "RigidWall",
    "Sphere",
    "contact_stiffness",
    "damping_number",
    "delivered_restitution",
    "free_fall_velocity",
]

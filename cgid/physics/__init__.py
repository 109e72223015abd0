"""Physics of an impact: pulse, peaks and rebound, from materials and geometry."""

from cgid.physics.bodies import RIGID, HalfSpace, RigidWall, Sphere, ThinPlate
from cgid.physics.closed_forms import damping_number, delivered_restitution
from cgid.physics.coupled import ModalImpact
from cgid.physics.curves import Law
from cgid.physics.impact import HertzRangeWarning, Impact, ThinPlateWarning
from cgid.physics.laws import (
    HUNT_CROSSLEY_LAWS,
    STIFFNESS_THEORIES,
    Elastic,
    HuntCrossley,
    Thornton,
    Viscoelastic,
    WaltonBraun,
    contact_stiffness,
    free_fall_velocity,
)

__all__ = [
    "HUNT_CROSSLEY_LAWS",
    "RIGID",
    "STIFFNESS_THEORIES",
    "Elastic",
    "HalfSpace",
    "HertzRangeWarning",
    "HuntCrossley",
    "Impact",
    "Law",
    "ModalImpact",
    "RigidWall",
    "Sphere",
    "ThinPlate",
    "ThinPlateWarning",
    "Thornton",
    "Viscoelastic",
    "WaltonBraun",
    "contact_stiffness",
    "damping_number",
    "delivered_restitution",
    "free_fall_velocity",
]

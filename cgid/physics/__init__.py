"""One impact: its pulse, its peaks, its rebound, and how they hang on the material."""

from cgid.physics.bodies import RIGID, HalfSpace, RigidWall, Sphere, ThinPlate
from cgid.physics.coupled import ModalImpact
from cgid.physics.damping_factors import HUNT_CROSSLEY_LAWS
from cgid.physics.dissipation import Elastic, HuntCrossley, Viscoelastic
from cgid.physics.hertz import STIFFNESS_THEORIES, contact_stiffness, free_fall_velocity
from cgid.physics.inverse import dissipative_constant, plate_thickness
from cgid.physics.pulse import HertzRangeWarning, Impact, ThinPlateWarning
from cgid.physics.restitution import damping_number, delivered_restitution
from cgid.physics.sensitivity import Sensitivity, local_sensitivity, ordering, range_influence, response_grid

__all__ = [
    "HUNT_CROSSLEY_LAWS",
    "RIGID",
    "STIFFNESS_THEORIES",
    "Elastic",
    "HalfSpace",
    "HertzRangeWarning",
    "HuntCrossley",
    "Impact",
    "ModalImpact",
    "RigidWall",
    "Sensitivity",
    "Sphere",
    "ThinPlate",
    "ThinPlateWarning",
    "Viscoelastic",
    "contact_stiffness",
    "damping_number",
    "delivered_restitution",
    "dissipative_constant",
    "free_fall_velocity",
    "local_sensitivity",
    "ordering",
    "plate_thickness",
    "range_influence",
    "response_grid",
]

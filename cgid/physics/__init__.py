"""Physics of an impact: pulse, peaks and rebound, from materials and geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.physics.contact.bodies import RIGID, HalfSpace, RigidWall, Sphere, ThinPlate
    from cgid.physics.contact.closed_forms import damping_number, delivered_restitution
    from cgid.physics.contact.curves import Law
    from cgid.physics.contact.impact import HertzRangeWarning, Impact, ThinPlateWarning
    from cgid.physics.contact.laws import (
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
    from cgid.physics.contact.materials import (
        COAL,
        COAL_STRENGTH,
        LIMESTONE_STRENGTH,
        MUDSTONE_STRENGTH,
        SANDSTONE,
        SANDSTONE_STRENGTH,
        SHALE,
        STEEL,
        YANG2018_SPHERES,
        Material,
        MaterialRange,
        StrengthRange,
    )
    from cgid.physics.contact.sampled import SampledPulses
    from cgid.physics.structure.coupled import ModalImpact
    from cgid.physics.structure.response import LowPass, Resonance, Response
    from cgid.physics.structure.tail_beam import Ribs, TailBeam

#: Module -> the public names that it defines.
_NAMES = {
    "contact.bodies": ("HalfSpace", "RIGID", "RigidWall", "Sphere", "ThinPlate"),
    "contact.closed_forms": ("damping_number", "delivered_restitution"),
    "contact.curves": ("Law",),
    "contact.impact": ("HertzRangeWarning", "Impact", "ThinPlateWarning"),
    "contact.laws": (
        "Elastic",
        "HUNT_CROSSLEY_LAWS",
        "HuntCrossley",
        "STIFFNESS_THEORIES",
        "Thornton",
        "Viscoelastic",
        "WaltonBraun",
        "contact_stiffness",
        "free_fall_velocity",
    ),
    "contact.materials": (
        "COAL",
        "COAL_STRENGTH",
        "LIMESTONE_STRENGTH",
        "MUDSTONE_STRENGTH",
        "Material",
        "MaterialRange",
        "SANDSTONE",
        "SANDSTONE_STRENGTH",
        "SHALE",
        "STEEL",
        "StrengthRange",
        "YANG2018_SPHERES",
    ),
    "contact.sampled": ("SampledPulses",),
    "structure.coupled": ("ModalImpact",),
    "structure.response": ("LowPass", "Resonance", "Response"),
    "structure.tail_beam": ("Ribs", "TailBeam"),
}

__all__ = [
    "COAL",
    "COAL_STRENGTH",
    "HUNT_CROSSLEY_LAWS",
    "LIMESTONE_STRENGTH",
    "MUDSTONE_STRENGTH",
    "RIGID",
    "SANDSTONE",
    "SANDSTONE_STRENGTH",
    "SHALE",
    "STEEL",
    "STIFFNESS_THEORIES",
    "YANG2018_SPHERES",
    "Elastic",
    "HalfSpace",
    "HertzRangeWarning",
    "HuntCrossley",
    "Impact",
    "Law",
    "LowPass",
    "Material",
    "MaterialRange",
    "ModalImpact",
    "Resonance",
    "Response",
    "Ribs",
    "RigidWall",
    "SampledPulses",
    "Sphere",
    "StrengthRange",
    "TailBeam",
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

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __getattr__, __dir__ = on_first_use(__name__, _NAMES)

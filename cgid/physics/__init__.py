"""Physics of an impact: pulse, peaks and rebound, from materials and geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.physics.contact.bodies import RIGID as RIGID
    from cgid.physics.contact.bodies import HalfSpace as HalfSpace
    from cgid.physics.contact.bodies import RigidWall as RigidWall
    from cgid.physics.contact.bodies import Sphere as Sphere
    from cgid.physics.contact.bodies import ThinPlate as ThinPlate
    from cgid.physics.contact.closed_forms import damping_number as damping_number
    from cgid.physics.contact.closed_forms import delivered_restitution as delivered_restitution
    from cgid.physics.contact.curves import Law as Law
    from cgid.physics.contact.impact import HertzRangeWarning as HertzRangeWarning
    from cgid.physics.contact.impact import Impact as Impact
    from cgid.physics.contact.impact import ThinPlateWarning as ThinPlateWarning
    from cgid.physics.contact.laws import HUNT_CROSSLEY_LAWS as HUNT_CROSSLEY_LAWS
    from cgid.physics.contact.laws import STIFFNESS_THEORIES as STIFFNESS_THEORIES
    from cgid.physics.contact.laws import Elastic as Elastic
    from cgid.physics.contact.laws import HuntCrossley as HuntCrossley
    from cgid.physics.contact.laws import PowerLaw as PowerLaw
    from cgid.physics.contact.laws import Thornton as Thornton
    from cgid.physics.contact.laws import Viscoelastic as Viscoelastic
    from cgid.physics.contact.laws import WaltonBraun as WaltonBraun
    from cgid.physics.contact.laws import contact_stiffness as contact_stiffness
    from cgid.physics.contact.laws import free_fall_velocity as free_fall_velocity
    from cgid.physics.contact.materials import COAL as COAL
    from cgid.physics.contact.materials import COAL_STRENGTH as COAL_STRENGTH
    from cgid.physics.contact.materials import LIMESTONE_STRENGTH as LIMESTONE_STRENGTH
    from cgid.physics.contact.materials import MUDSTONE_STRENGTH as MUDSTONE_STRENGTH
    from cgid.physics.contact.materials import SANDSTONE as SANDSTONE
    from cgid.physics.contact.materials import SANDSTONE_STRENGTH as SANDSTONE_STRENGTH
    from cgid.physics.contact.materials import SHALE as SHALE
    from cgid.physics.contact.materials import STEEL as STEEL
    from cgid.physics.contact.materials import YANG2018_SPHERES as YANG2018_SPHERES
    from cgid.physics.contact.materials import Material as Material
    from cgid.physics.contact.materials import MaterialRange as MaterialRange
    from cgid.physics.contact.materials import StrengthRange as StrengthRange
    from cgid.physics.contact.own_laws import add_laws as add_laws
    from cgid.physics.contact.sampled import SampledPulses as SampledPulses
    from cgid.physics.structure.coupled import ModalImpact as ModalImpact
    from cgid.physics.structure.response import HighPass as HighPass
    from cgid.physics.structure.response import LinearPhase as LinearPhase
    from cgid.physics.structure.response import LowPass as LowPass
    from cgid.physics.structure.response import Resonance as Resonance
    from cgid.physics.structure.response import Response as Response
    from cgid.physics.structure.tail_beam import Ribs as Ribs
    from cgid.physics.structure.tail_beam import TailBeam as TailBeam

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
        "PowerLaw",
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
    "contact.own_laws": ("add_laws",),
    "contact.sampled": ("SampledPulses",),
    "structure.coupled": ("ModalImpact",),
    "structure.response": ("HighPass", "LinearPhase", "LowPass", "Resonance", "Response"),
    "structure.tail_beam": ("Ribs", "TailBeam"),
}

if not TYPE_CHECKING:  # else a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, _NAMES)

"""What only a finite-element impact knows: a plate with a size, and a contact that gives way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from numpy.typing import ArrayLike

from cgid import validation
from cgid.errors import InvalidValue
from cgid.physics.materials import Material

LOWER_FACES = ("fixed", "free")


@dataclass(frozen=True, kw_only=True)
class ElasticPlate:
    """A round plate of `material`, `thickness` and `radius` [m] that is hit in its middle; its edge is free.

    Parameters
    ----------
    lower_face : {"fixed", "free"}
        Whether its lower face is held, as in the simulations of Yang, Zeng & Wan (2018), or nothing holds the plate.
    retardation_time : float, optional
        Of Kelvin and Voigt: stress = E (strain + retardation time x strain rate) [s].
    """

    material: Material
    thickness: float
    radius: float
    lower_face: Literal["fixed", "free"]
    retardation_time: float = 0.0

    def __post_init__(self) -> None:
        validation.instance("material", self.material, Material)
        for name in ("density", "youngs_modulus", "poisson_ratio"):
            single_number(name, getattr(self.material, name))
        hold_number(self, "thickness", validation.positive("thickness", self.thickness, "m"))
        hold_number(self, "radius", validation.positive("radius", self.radius, "m"))
        hold_number(self, "retardation_time", validation.not_negative("retardation_time", self.retardation_time, "s"))
        validation.choice("lower_face", self.lower_face, LOWER_FACES)


@dataclass(frozen=True, kw_only=True)
class PenaltyContact:
    """Surfaces that press into each other, as in many finite-element programs, in place of a hard contact.

    The pressure is `factor` x bulk modulus (the lower of both) / element size x how far they press in: the contact
    gives way the more, the coarser the mesh. Element size is Hertz's contact radius over the number of elements.
    LS-DYNA's default factor is .1 (LS-DYNA Theory Manual, chapter 29).
    """

    factor: float = 0.1

    def __post_init__(self) -> None:
        hold_number(self, "factor", validation.positive("factor", self.factor))

    def softness(self, first: Material, second: Material, element_size: float) -> float:
        """Return how far the surfaces press in, over the pressure [m/Pa]."""
        return element_size / (float(self.factor) * min(bulk_modulus(first), bulk_modulus(second)))


def bulk_modulus(material: Material) -> float:
    """Return `E / (3 (1 - 2 nu))` [Pa]."""
    return single_number("youngs_modulus", material.youngs_modulus) / (
        3 * (1 - 2 * single_number("poisson_ratio", material.poisson_ratio))
    )


def hold_number(owner: object, name: str, value: ArrayLike) -> None:
    """Give a frozen dataclass its number as a float: small types of numpy would wrap or round."""
    object.__setattr__(owner, name, single_number(name, value))


def single_number(name: str, value: ArrayLike) -> float:
    """Return a value that must be a single number; raises `InvalidValue` for an array."""
    values = validation.real(name, value)
    if values.ndim:
        raise InvalidValue(f"{name} must be one number, got an array of shape {values.shape}; run impacts one by one")
    return float(values)

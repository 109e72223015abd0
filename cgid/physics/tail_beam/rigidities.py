"""Rigidities of a steel skin with ribs, smeared to a plate that is stiffer one way than the other.

Huber's orthotropic plate: Timoshenko & Woinowsky-Krieger (1959), Theory of Plates and Shells, sections 86-87.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.elementary import expm1
from cgid.errors import InvalidValue
from cgid.physics.bodies import ThinPlate
from cgid.physics.materials import Material
from cgid.validation import Floats

_PI_TO_THE_FIFTH = 306.01968478528147


@dataclass(frozen=True, kw_only=True)
class Ribs:
    """Equal flat bars along the length of a skin, welded on edge to its back, evenly spaced over its width.

    Parameters
    ----------
    number : int
        1 or more.
    depth : float
        How far they stand off the skin [m].
    thickness : float
        Of one bar [m].
    """

    number: int
    depth: float
    thickness: float

    def __post_init__(self) -> None:
        validation.count("number", self.number)
        for name in ("depth", "thickness"):
            object.__setattr__(self, name, single(f"ribs {name}", getattr(self, name), "m"))

    @property
    def torsion_constant(self) -> float:
        """J of one bar [m^4], a rectangle `a >= b`: Timoshenko & Goodier (1970), Theory of Elasticity, section 109.

        `J = a b^3 (1/3 - 64/pi^5 b/a sum_odd tanh(n pi a / (2 b)) / n^5)`, of which 12 terms leave 1e-8.
        """
        long, short = max(self.depth, self.thickness), min(self.depth, self.thickness)
        odd = np.arange(1, 25, 2)
        falling = expm1(-odd * np.pi * long / short)
        tanh = -falling / (2 + falling)
        series = float(np.sum(tanh / (odd * odd * odd * odd * odd)))
        return long * (short * short * short) * (1 / 3 - 64 / _PI_TO_THE_FIFTH * short / long * series)


@dataclass(frozen=True, kw_only=True)
class Rigidities:
    """Bending and twisting of an orthotropic plate [N m] and its mass per area [kg/m^2].

    Its energy per area is `(Dx wxx^2 + 2 D1 wxx wyy + Dy wyy^2 + 4 Dxy wxy^2) / 2`.

    Parameters
    ----------
    along : float
        Dx: bending along x, the ribs' own direction.
    across : float
        Dy.
    coupling : float
        D1, `nu D` of the skin.
    twist : float
        Dxy.
    mass : float
        Per area.
    """

    along: float
    across: float
    coupling: float
    twist: float
    mass: float

    @property
    def mixed(self) -> float:
        """`H = D1 + 2 Dxy` [N m], with which waves run: `D(theta) = Dx c^4 + 2 H c^2 s^2 + Dy s^4`."""
        return self.coupling + 2 * self.twist

    @property
    def impedance(self) -> float:
        """Force over velocity at a point of the infinite plate [kg/s], a real number at every frequency.

        The receptance `1/(4 pi^2) integral dk / (D(theta) k^4 - m omega^2)` with a trace of damping leaves of the
        integral over |k| half the residue of its pole, so `Z = 16 pi / integral_0^2pi dtheta / sqrt(m D(theta))`. With
        `t = tan theta` that is a complete elliptic integral, which Gauss's arithmetic-geometric mean gives:
        `Z = 8 sqrt(m sqrt(Dx Dy)) agm(1, sqrt((1 + H / sqrt(Dx Dy)) / 2))`, for an isotropic plate
        `8 sqrt(B rho h)`: Cremer, Heckl & Petersson (2005), Structure-Borne Sound, section 4.
        """
        mean = math.sqrt(self.along * self.across)
        return 8 * math.sqrt(self.mass * mean) * _agm(1.0, math.sqrt((1 + self.mixed / mean) / 2))


@dataclass(frozen=True, kw_only=True)
class RibbedPlate(ThinPlate):
    """A thin plate whose ribs raise its impedance: what `Impact` meets on a ribbed beam.

    Parameters
    ----------
    ribbed_impedance : array_like
        Impedance of skin and ribs together [kg/s]; `thickness` is the skin's.
    """

    ribbed_impedance: ArrayLike = np.nan

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.positive("ribbed_impedance", self.ribbed_impedance, "kg/s")
        validation.hold(self, "ribbed_impedance")

    @property
    def impedance(self) -> Floats:
        """`ribbed_impedance` [kg/s]."""
        return validation.real("ribbed_impedance", self.ribbed_impedance, "kg/s")


def _agm(a: float, b: float) -> float:
    """Return Gauss's arithmetic-geometric mean of two positive numbers."""
    while abs(a - b) > 1e-15 * a:
        a, b = (a + b) / 2, math.sqrt(a * b)
    return (a + b) / 2


def single(name: str, value: ArrayLike, unit: str) -> float:
    """Return one number above zero, or raise `InvalidValue`."""
    number = validation.positive(name, value, unit)
    if number.ndim:
        raise InvalidValue(f"{name} must be one number, a beam has only one, got an array of shape {number.shape}")
    return float(number)


def smeared(material: Material, thickness: float, ribs: Ribs | None, spacing: float) -> Rigidities:
    """Return the rigidities of a skin and ribs a `spacing` [m] apart.

    Along the ribs a strip one spacing wide bends about the neutral axis of its T-section: the skin with the modulus
    of a wide plate, `E / (1 - nu^2)`, the bar with E. Across them only the skin bends, and the bars twist along with
    it: `H = D + G J / (2 spacing)`. Good for waves longer than about two spacings; shorter ones see each rib.
    """
    modulus = float(validation.real("youngs_modulus", material.youngs_modulus, "Pa"))
    density = float(validation.real("density", material.density, "kg/m^3"))
    ratio = float(validation.real("poisson_ratio", material.poisson_ratio))
    wide_modulus = modulus / (1 - ratio * ratio)
    skin = wide_modulus * (thickness * thickness * thickness) / 12
    along, twist, mass = skin, skin * (1 - ratio) / 2, density * thickness
    if ribs is not None:
        bar_stretch, skin_stretch = modulus * ribs.depth * ribs.thickness / spacing, wide_modulus * thickness
        between = (ribs.depth + thickness) / 2
        along += bar_stretch * (ribs.depth * ribs.depth) / 12
        along += bar_stretch * skin_stretch / (bar_stretch + skin_stretch) * (between * between)
        twist += modulus / (2 * (1 + ratio)) * ribs.torsion_constant / (4 * spacing)
        mass += density * ribs.depth * ribs.thickness / spacing
    return Rigidities(along=along, across=skin, coupling=ratio * skin, twist=twist, mass=mass)

"""Materials: the spheres and steel of Yang et al. (2018), and published ranges for rocks, with sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib import validation
from cgid.errors import InvalidValue

__all__ = [
    "COAL",
    "GANGUE",
    "SANDSTONE",
    "SHALE",
    "STEEL",
    "YANG2018_COAL_1",
    "YANG2018_COAL_2",
    "YANG2018_GANGUE_3",
    "YANG2018_GANGUE_4",
    "YANG2018_SPHERES",
    "MaterialRange",
]


@dataclass(frozen=True, kw_only=True)
class Material:
    """An isotropic elastic material.

    Parameters
    ----------
    density : array_like, above 0 [kg/m^3]
    youngs_modulus : array_like, above 0 [Pa]
    poisson_ratio : array_like, in (-1, 0.5)

    Raises
    ------
    InvalidValue
        A value is out of range.

    Examples
    --------
    >>> coal = Material(density=1380, youngs_modulus=2.26e9, poisson_ratio=0.28)
    >>> round(float(coal.plane_strain_compliance) * 1e12, 3)  # (1 - .28^2) / 2.26 GPa, in 1/TPa
    407.788
    """

    density: ArrayLike
    youngs_modulus: ArrayLike
    poisson_ratio: ArrayLike

    def __post_init__(self) -> None:
        validation.positive("density", self.density, "kg/m^3")
        validation.positive("youngs_modulus", self.youngs_modulus, "Pa")
        validation.poisson_ratio("poisson_ratio", self.poisson_ratio)
        validation.hold(self, "density", "youngs_modulus", "poisson_ratio")

    @property
    def plane_strain_compliance(self) -> validation.Floats:
        """`(1 - nu^2) / E` [1/Pa]."""
        nu = np.asarray(self.poisson_ratio, np.float64)
        return (1 - nu * nu) / np.asarray(self.youngs_modulus, np.float64)


@dataclass(frozen=True, kw_only=True)
class MaterialRange:
    """Lowest and highest published values for a rock, with their sources.

    They are sample measurements, not bounds: real rock may be outside. An impact takes one material of the range, its
    `middle` or what `draw` returns.

    Parameters
    ----------
    density : tuple of two floats [kg/m^3]
    youngs_modulus : tuple of two floats [Pa]
    poisson_ratio : tuple of two floats
    sources : tuple of str

    Examples
    --------
    >>> float(COAL.middle.density), COAL.draw(np.random.default_rng(0), 3).density.shape
    (1420.0, (3,))
    """

    density: tuple[float, float]
    youngs_modulus: tuple[float, float]
    poisson_ratio: tuple[float, float]
    sources: tuple[str, ...]

    @property
    def middle(self) -> Material:
        """The material in the middle of the range, of Young's modulus the geometric one."""
        return self._at((0.5, 0.5, 0.5))

    def draw(self, rng: np.random.Generator, size: int | tuple[int, ...] | None = None) -> Material:
        """Return materials drawn from the range, each number independently.

        Parameters
        ----------
        rng : numpy.random.Generator
        size : int or tuple of int, optional
            Shape of the numbers of the material; by default a single one.

        Returns
        -------
        Material
            Density and Poisson's ratio are uniform, Young's modulus is log-uniform.
        """
        validation.instance("rng", rng, np.random.Generator)
        return self._at([rng.random(size) for _ in range(3)])

    def _at(self, places: Sequence[ArrayLike]) -> Material:
        """Return the material at a place of each range, from 0 to 1."""
        density, modulus, ratio = (np.asarray(one, np.float64) for one in places)
        (low, high), (soft, hard), (least, most) = self.density, self.youngs_modulus, self.poisson_ratio
        return Material(
            density=low + (high - low) * density,
            youngs_modulus=soft * (hard / soft) ** modulus,
            poisson_ratio=least + (most - least) * ratio,
        )


def require_material(material: object) -> None:
    """Raise `InvalidValue` unless it is one material."""
    if isinstance(material, MaterialRange):
        raise InvalidValue("material must be a Material, got a range of them; take its .middle or .draw(rng)")
    validation.instance("material", material, Material)


#: Largest contact pressure at first yield over the uniaxial strength: von Mises, Poisson's ratio 0.3; Johnson 1985,
#: Contact Mechanics, section 6.1.
YIELD_OVER_STRENGTH = 1.6

#: Yang, Zeng & Wan (2018), Shock and Vibration, Tables 1 and 2: two spheres that resemble coal, and two gangue.
YANG2018_COAL_1 = Material(density=1380.0, youngs_modulus=2.26e9, poisson_ratio=0.28)
YANG2018_COAL_2 = Material(density=1550.6, youngs_modulus=4.3e9, poisson_ratio=0.30)
YANG2018_GANGUE_3 = Material(density=2412.0, youngs_modulus=21.64e9, poisson_ratio=0.30)
YANG2018_GANGUE_4 = Material(density=2400.0, youngs_modulus=3.906e9, poisson_ratio=0.28)
#: The same by the numbers of the paper's tables.
YANG2018_SPHERES = {1: YANG2018_COAL_1, 2: YANG2018_COAL_2, 3: YANG2018_GANGUE_3, 4: YANG2018_GANGUE_4}
#: Radius of all four spheres [m].
YANG2018_RADIUS = 0.025
#: The metal plate of the same tables, with the values of EN 1993-1-1, section 3.2.6.
STEEL = Material(density=7850.0, youngs_modulus=210e9, poisson_ratio=0.30)

_LIU = "Liu et al. 2021, Shock and Vibration, doi 10.1155/2021/7649459, Table 4"
_DISTURBED = "Shock and Vibration 2021, article 6625233, Table 1"
_GAS = "Shock and Vibration 2021, article 8854538, Table 5 (without gas pressure)"
_STAGGERED = "Advances in Civil Engineering 2021, article 1499675, Table 2 (E, nu from its K, G)"
_XCT = "Complexity 2019, article 4021368, Table 3 (calibrated particles of a discrete-element model)"
_NUCLEAR = "Advances in Civil Engineering 2019, article 4815236, Table 2"

COAL = MaterialRange(
    density=(1300.0, 1540.0),
    youngs_modulus=(0.58e9, 23.9e9),
    poisson_ratio=(0.16, 0.30),
    sources=(
        f"{_LIU}: 1339 kg/m^3 (apparent), 23.87 GPa, .25",
        f"{_DISTURBED}: 1350 kg/m^3, .6 GPa, .24",
        f"{_GAS}: 1.99-2.26 GPa, .28-.30",
        f"{_STAGGERED}: 1400 kg/m^3, 4.65 GPa, .163",
        f"{_NUCLEAR}: 1340 kg/m^3, 3.66 GPa, .20",
        f"{_XCT}: 1540 kg/m^3",
        "Complexity 2023, article 7775116, Table 2: 1300 kg/m^3, .58 GPa, .26 (E, nu from its K, G)",
    ),
)
SHALE = MaterialRange(
    density=(2410.0, 2620.0),
    youngs_modulus=(3.1e9, 15.2e9),
    poisson_ratio=(0.10, 0.21),
    sources=(
        f"{_DISTURBED}, mudstone: 2450 kg/m^3, 3.14 GPa, .21",
        f"{_STAGGERED}, sandy mudstone: 2410 kg/m^3, 15.2 GPa, .10",
        "Complexity 2023, article 7775116, Table 2, mudstone: 2620 kg/m^3",
    ),
)
SANDSTONE = MaterialRange(
    density=(2480.0, 2720.0),
    youngs_modulus=(6.4e9, 52e9),
    poisson_ratio=(0.10, 0.29),
    sources=(
        f"{_DISTURBED}, medium sandstone, packsand: 2690-2720 kg/m^3, 6.37-8.21 GPa, .10-.17",
        f"{_STAGGERED}, fine and coarse sandstone: 2480-2510 kg/m^3, 29.9-52.0 GPa, .24-.29",
    ),
)
#: Gangue of coal seams: shale and mudstone to sandstone.
GANGUE = MaterialRange(
    density=(SHALE.density[0], SANDSTONE.density[1]),
    youngs_modulus=(SHALE.youngs_modulus[0], SANDSTONE.youngs_modulus[1]),
    poisson_ratio=(min(SHALE.poisson_ratio), max(SANDSTONE.poisson_ratio)),
    sources=SHALE.sources + SANDSTONE.sources,
)

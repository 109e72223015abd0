"""The tail beam: a rectangular steel panel, plain or with ribs on its back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.modal.modes import Modes
from cgid.physics.contact.bodies import ThinPlate
from cgid.physics.contact.materials import Material, require_material
from cgid.physics.structure.plates import PanelShapes, PolynomialShapes, Rigidities, SineShapes, ritz_modes

__all__ = ["Ribs", "TailBeam"]

#: Clamped ends along x and y by type of edges; None has a closed form.
EDGES: dict[str, tuple[str, str] | None] = {
    "simply-supported": None,
    "clamped": ("both", "both"),
    "cantilever": ("start", "none"),
}
#: Largest number of modes, by closed form and by eigenproblem.
MAX_MODES, MAX_RITZ_MODES = 20_000, 1_000
_PI_TO_THE_FIFTH = 306.01968478528147


@dataclass(frozen=True, kw_only=True)
class Ribs:
    """Equal flat bars along the length of a skin, welded on edge to its back, evenly spaced over its width.

    Parameters
    ----------
    number : int
        Number of bars.
    depth : float [m]
        Depth perpendicular to the skin.
    thickness : float [m]
        Thickness of one bar.
    """

    number: int
    depth: float
    thickness: float

    def __post_init__(self) -> None:
        validation.count("number", self.number)
        for name in ("depth", "thickness"):
            number = validation.number(f"ribs {name}", getattr(self, name), "m", validation.positive)
            object.__setattr__(self, name, number)

    @property
    def torsion_constant(self) -> float:
        """J of one bar [m^4], a rectangle `a >= b`: Timoshenko & Goodier (1970), Theory of Elasticity, section 109.

        `J = a b^3 (1/3 - 64/pi^5 b/a sum_odd tanh(n pi a / (2 b)) / n^5)`; 12 terms give an error of 1e-8.
        """
        long, short = max(self.depth, self.thickness), min(self.depth, self.thickness)
        odd = np.arange(1, 25, 2)
        falling = np.expm1(-odd * np.pi * long / short)
        tanh = -falling / (2 + falling)
        series = float(np.sum(tanh / (odd * odd * odd * odd * odd)))
        return long * (short * short * short) * (1 / 3 - 64 / _PI_TO_THE_FIFTH * short / long * series)


@dataclass(frozen=True, kw_only=True)
class RibbedPlate(ThinPlate):
    """A thin plate whose ribs raise its impedance [kg/s]: the target of an `Impact` on a ribbed beam."""

    ribbed_impedance: ArrayLike = np.nan

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.positive("ribbed_impedance", self.ribbed_impedance, "kg/s")
        validation.hold(self, "ribbed_impedance")

    @property
    def impedance(self) -> Floats:
        """`ribbed_impedance` [kg/s]."""
        return np.asarray(self.ribbed_impedance, np.float64)


@dataclass(frozen=True, kw_only=True)
class TailBeam:
    """A rectangular panel that bends as a thin (Kirchhoff) plate, with its ribs smeared over the width.

    Kirchhoff's plate has neither shear nor rotary inertia: its frequencies are about 5 % too high at a wavelength of 12
    thicknesses, 18 % at 6. Smeared ribs are valid for waves longer than `2 * rib_spacing`: see
    `highest_smeared_frequency`.

    Parameters
    ----------
    material : Material
        Its constants are scalars.
    length : float [m]
        Along x, from the clamped edge of a cantilever to its free edge.
    width : float [m]
        Along y.
    thickness : float [m]
        Of the skin.
    edges : {"simply-supported", "clamped", "cantilever"}
        All four edges simply supported or clamped, or one edge clamped, at x = 0.
    damping_ratio : float
        Damping ratio of every mode, above 0 and below 1.
    ribs : Ribs, optional
        Bars under the skin.

    Examples
    --------
    The plate of Yang, Zeng & Wan (2018), simply supported:

    >>> from cgid.physics import STEEL
    >>> plate = TailBeam(
    ...     material=STEEL,
    ...     length=0.4584,
    ...     width=0.36,
    ...     thickness=0.008,
    ...     edges="simply-supported",
    ...     damping_ratio=0.01,
    ... )
    >>> plate.modes(1000.0).frequency.round(1).tolist()
    [245.4, 526.2, 700.7, 981.5, 994.2]
    """

    material: Material
    length: float
    width: float
    thickness: float
    edges: str
    damping_ratio: float
    ribs: Ribs | None = None

    def __post_init__(self) -> None:
        require_material(self.material)
        validation.instance("ribs", self.ribs, Ribs, type(None))
        validation.choice("edges", self.edges, tuple(EDGES))
        for name in ("length", "width", "thickness"):
            object.__setattr__(self, name, validation.number(name, getattr(self, name), "m", validation.positive))
        damping = validation.number("damping_ratio", self.damping_ratio, rule=validation.damping_ratio)
        object.__setattr__(self, "damping_ratio", damping)
        # Plain floats make the beam hashable, so that its modes are cached.
        constants = ("density", "youngs_modulus", "poisson_ratio")
        plain = {name: validation.number(f"{name} of the beam", getattr(self.material, name)) for name in constants}
        object.__setattr__(self, "material", Material(**plain))
        if self.ribs is not None and self.ribs.thickness > self.rib_spacing:
            raise InvalidValue(
                f"ribs must fit side by side: {self.ribs.number} of {self.ribs.thickness:g} m do not on a width of "
                f"{self.width:g} m; use fewer or thinner ones"
            )

    @property
    def rib_spacing(self) -> float:
        """Width over number of ribs [m]; infinite without ribs."""
        return self.width / self.ribs.number if self.ribs else math.inf

    @cached_property
    def rigidities(self) -> Rigidities:
        """Bending and twisting [N m] and mass per area [kg/m^2], ribs included."""
        return smeared(self.material, self.thickness, self.ribs, self.rib_spacing)

    @property
    def mass_per_area(self) -> float:
        """Mass per area, ribs included [kg/m^2]."""
        return self.rigidities.mass

    @property
    def mass(self) -> float:
        """Total mass, ribs included [kg]."""
        return self.mass_per_area * self.length * self.width

    @property
    def skin(self) -> ThinPlate:
        """The skin without ribs: the target of a short impact between two ribs."""
        return ThinPlate(material=self.material, thickness=self.thickness)

    @cached_property
    def plate(self) -> ThinPlate:
        """The panel as the target of an `Impact`: an unbounded plate with the impedance of skin and ribs.

        Valid until waves return (`echoes`), and with ribs up to `highest_smeared_frequency`.
        """
        if self.ribs is None:
            return self.skin
        return RibbedPlate(material=self.material, thickness=self.thickness, ribbed_impedance=self.rigidities.impedance)

    @property
    def impedance(self) -> float:
        """Force over velocity at a point of the infinite panel [kg/s]: `Rigidities.impedance`."""
        return float(self.plate.impedance)

    @property
    def modal_density(self) -> float:
        """Modes per hertz at high frequencies, `4 mass / impedance` [1/Hz].

        The panel has `A / (4 pi^2)` waves with `k^2 = omega sqrt(m / D(theta))` per area of the wave-number plane, over
        half a turn: the integral is that of the impedance.
        """
        return 4 * self.mass / self.impedance

    @property
    def highest_smeared_frequency(self) -> float:
        """Frequency [Hz] at which the wave across the ribs is two spacings long; infinite without ribs.

        Above it the skin bends between the ribs, which a smeared model neglects.
        """
        if self.ribs is None:
            return math.inf
        wave_number = math.pi / self.rib_spacing
        return wave_number * wave_number * math.sqrt(self.rigidities.across / self.mass_per_area) / (2 * math.pi)

    def echoes(self, along: Floats, across: Floats, frequency: Floats) -> Floats:
        """Return the time [s] in which flexural waves of a frequency [Hz] return from the nearest edge.

        The points are fractions of length and width. A packet travels at the group velocity `2 sqrt(omega) (D /
        m)^(1/4)`, straight to an edge and back. Higher frequencies are faster: for an impact use its highest, about
        the inverse contact duration.
        """
        omega = 2 * np.pi * frequency
        times = []
        for fraction, extent, rigidity in (
            (along, self.length, self.rigidities.along),
            (across, self.width, self.rigidities.across),
        ):
            position = fraction * extent
            velocity = 2 * np.sqrt(omega) * math.sqrt(math.sqrt(rigidity / self.mass_per_area))
            times.append(2 * np.minimum(position, extent - position) / velocity)
        return np.minimum(*times)

    def modes(self, highest_frequency: float) -> Modes:
        """Return all modes up to a frequency [Hz], cached.

        Simply supported panels have a closed form. Clamped and cantilever ones use `cgid.physics.structure.plates`:
        every frequency is above the exact one, by at most 3e-5 of it. Two hundred modes take a second, four hundred
        about four, a thousand of a cantilever about forty. More than 20,000 (1,000 unless simply supported) raise
        `InvalidValue`.
        """
        highest = validation.number("highest_frequency", highest_frequency, "Hz", validation.positive)
        expected, limit = self.modal_density * highest, MAX_RITZ_MODES if EDGES[self.edges] else MAX_MODES
        if expected > limit:
            raise InvalidValue(
                f"highest_frequency must leave at most {limit} modes of a {self.edges} beam, {highest:g} Hz means "
                f"about {expected:.0f}; take {limit / self.modal_density:.3g} Hz or less"
            )
        return modes_of(self, highest)


def smeared(material: Material, thickness: float, ribs: Ribs | None, spacing: float) -> Rigidities:
    """Return the rigidities of a skin with ribs at a `spacing` [m], for waves longer than about two spacings."""
    # Along the ribs a strip one spacing wide bends about the neutral axis of its T-section, the skin with `E / (1 -
    # nu^2)`. Across them the skin bends, and the bars twist with it: `H = D + G J / (2 spacing)` (Huber's plate,
    # Timoshenko & Woinowsky-Krieger 1959, Theory of Plates and Shells, sections 86-87).
    modulus, density, ratio = (
        float(np.asarray(value)) for value in (material.youngs_modulus, material.density, material.poisson_ratio)
    )
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


@lru_cache(maxsize=16)
def modes_of(beam: TailBeam, highest: float) -> Modes:
    """Return the modes up to a frequency [Hz]; those of the last beams are kept."""
    clamped = EDGES[beam.edges]
    frequency: Floats
    shapes: SineShapes | PolynomialShapes
    if clamped is None:
        frequency, shapes = _simply_supported(beam, highest)
    else:
        omega, shapes = ritz_modes(beam.rigidities, beam.length, beam.width, clamped, 2 * math.pi * highest)
        frequency = omega / (2 * math.pi)
    return Modes(
        frequency=frequency,
        damping_ratio=np.full(frequency.size, beam.damping_ratio),
        at_impact=PanelShapes(beam.length, beam.width, 2 / math.sqrt(beam.mass), shapes),
        # The real part of the mobility is 1/Z at every frequency, so the static compliance above w is 2 / (pi Z w).
        residual=1 / (math.pi * math.pi * beam.impedance * frequency.max()) if frequency.size else 0.0,
    )


def _simply_supported(beam: TailBeam, highest: float) -> tuple[Floats, SineShapes]:
    """Return the frequencies [Hz] and shapes of Navier's solution (Timoshenko & Woinowsky-Krieger 1959, section 85)."""
    # `omega^2 = pi^4 / m (Dx (i/a)^4 + 2 H (i j / (a b))^2 + Dy (j/b)^4)`
    rigidities, sides = beam.rigidities, (beam.length, beam.width)
    max_indices = [
        math.floor(extent / math.pi * math.sqrt(2 * math.pi * highest * math.sqrt(rigidities.mass / rigidity)))
        for extent, rigidity in zip(sides, (rigidities.along, rigidities.across), strict=True)
    ]
    along, across = (1 + index.ravel() for index in np.indices(max_indices))
    p, q = (along / beam.length) ** 2, (across / beam.width) ** 2
    bending = rigidities.along * p**2 + 2 * rigidities.mixed * p * q + rigidities.across * q**2
    frequency = math.pi / 2 * np.sqrt(bending / rigidities.mass)
    order = np.argsort(frequency, kind="stable")
    order = order[frequency[order] <= highest]
    return frequency[order], SineShapes(along[order], across[order])

"""Contact laws: the stiffness of the contact, and the loss in the material.

Every stiffness theory has the form `P = K delta^(3/2)`. Hertz's reduced modulus already includes the compliance of both
bodies, so the series theory of Yang et al. (2018) counts it twice; an independent finite-element run agrees with
`"hertz"`. All three theories are available, and none is the default.

The damping factors of a Hunt-Crossley contact, `P = K delta^(3/2) (1 + chi delta')`, differ in the damping number
`D = chi v` for a restitution e. All but the exact one are approximations, good near e = 1:
`HuntCrossley.delivered_restitution` is the restitution that results. A new factor needs one more table entry.

A law of loss is a class with the methods of `cgid.physics.Law`, here or in your own module.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.chebyshev import chebval
from numpy.typing import ArrayLike
from scipy.special import gammaln

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.fit import family
from cgid.physics.contact.bodies import sphere_share
from cgid.physics.contact.closed_forms import damping_number, delivered_restitution
from cgid.physics.contact.curves import Curves, Law, hunt_crossley_curves
from cgid.physics.contact.plastic import EQUIVALENT_STIFFNESS, thornton_curves, walton_braun_curves
from cgid.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from cgid.physics.contact.impact import Impact

#: K over Hertz's `K1 = 4/3 sqrt(R) E`; Yang, Zeng & Wan (2018), Eq. 5-6, 7-8 and 9-13.
STIFFNESS_THEORIES = {
    "hertz": 1.0,
    "rigid-sphere": 8 * np.sqrt(3) / 9,
    "series": 1 / (1.75 * math.sqrt(1.75)),
}


def contact_stiffness(reduced_radius: ArrayLike, reduced_modulus: ArrayLike, theory: str) -> Floats:
    """Return K of `P = K delta^(3/2)`.

    Parameters
    ----------
    reduced_radius : array_like [m]
    reduced_modulus : array_like [Pa]
    theory : {"hertz", "rigid-sphere", "series"}
        `K1 = 4/3 sqrt(R) E`; `K2 = 8 sqrt(3)/9 K1`; or both springs in series, `K1 / 1.75^(3/2)`.

    Returns
    -------
    ndarray [N/m^(3/2)]

    Examples
    --------
    >>> f"{contact_stiffness(0.025, 2.4265e9, 'hertz'):.4e}"  # Yang 2018, Table 1
    '5.1155e+08'
    """
    factor = STIFFNESS_THEORIES[validation.choice("stiffness", theory, STIFFNESS_THEORIES)]
    radius = validation.positive("reduced_radius", reduced_radius, "m")
    modulus = validation.positive("reduced_modulus", reduced_modulus, "Pa")
    return stiffness_of(radius, modulus, factor)


def stiffness_of(radius: Floats, modulus: Floats, factor: float) -> Floats:
    """Return K for a factor of `STIFFNESS_THEORIES`, without checks."""
    return np.asarray(factor * 4 / 3 * np.sqrt(radius) * modulus)


def free_fall_velocity(height: ArrayLike, gravity: float = STANDARD_GRAVITY) -> Floats:
    """Return the speed after a free fall, `sqrt(2 g H)` (Yang 2018, Eq. 15).

    Parameters
    ----------
    height : array_like [m]
        Not negative.
    gravity : float [m/s^2]

    Returns
    -------
    ndarray [m/s]

    Examples
    --------
    >>> round(float(free_fall_velocity(1.0)), 4)
    4.4287
    """
    pull = validation.not_negative("gravity", gravity, "m/s^2")
    return speed_of_fall(validation.not_negative("height", height, "m"), pull)


def speed_of_fall(height: Floats, gravity: float | Floats = STANDARD_GRAVITY) -> Floats:
    """Return `free_fall_velocity` without checks."""
    return np.asarray(np.sqrt(2 * gravity * height))


#: Damping number D = chi v for a requested restitution e, by law. Only "exact" delivers e.
HUNT_CROSSLEY_LAWS: dict[str, Callable[[Floats], Floats]] = {
    "exact": damping_number,
    # Hunt & Crossley (1975), J. Appl. Mech. 42, 440.
    "hunt-crossley": lambda e: 1.5 * (1 - e),
    # Herbert & McWhannell (1977), J. Eng. Ind. 99, 663.
    "herbert-mcwhannell": lambda e: 6 * (1 - e) / ((2 * e - 1) * (2 * e - 1) + 3),
    # Lee & Wang (1983), J. Mech. Transm. Autom. Des. 105, 534.
    "lee-wang": lambda e: 0.75 * (1 - e),
    # Lankarani & Nikravesh (1990), J. Mech. Des. 112, 369.
    "lankarani-nikravesh": lambda e: 0.75 * (1 - e) * (1 + e),
    # Gonthier, McPhee, Lange & Piedboeuf (2004), Multibody Syst. Dyn. 11, 209: their approximation.
    "gonthier": lambda e: (1 - e) * (1 + e) / e,
    # Zhang Zhiying & Lu Qishao (2006).
    "zhiying-qishao": lambda e: 0.75 * (1 - e) * (1 + e) * np.exp(2 * (1 - e)),
    # Flores, Machado, Silva & Martins (2011), Multibody Syst. Dyn. 25, 357.
    "flores": lambda e: 1.6 * (1 - e) / e,
    # Hu & Guo (2015), Multibody Syst. Dyn. 35, 131.
    "hu-guo": lambda e: 1.5 * (1 - e) / e,
}
#: Exponents of a face and of a cone, and what may be left of the force of a rock that breaks: it must rebound.
EXPONENTS, REMAINING = (1.0, 2.0), (0.01, 1.0)
#: An approach that no impact reaches.
_NEVER = 1e100
#: Double precision cannot represent an impact with more damping anyway.
_MAX_DAMPING = 1e100


def _hertz(p: Any, _history: Any, w: float) -> tuple[float, float]:
    """Return `x^(3/2)` and `D x^(3/2)`."""
    g = w * w * w
    return g, p[0] * g


@dataclass(frozen=True)
class Elastic(Law):
    """No loss in the material: except on a thin plate, the sphere rebounds at its impact speed."""

    name = "elastic"
    force = staticmethod(_hertz)

    @property
    def damping_number(self) -> Floats:
        """D = 0."""
        return np.zeros(())

    @property
    def delivered_restitution(self) -> Floats:
        """Exactly 1."""
        return np.ones(())

    def closed(self, impact: Impact) -> Curves:
        """Return the curves of Hunt and Crossley: the table if nothing else acts."""
        return hunt_crossley_curves(impact, self.delivered_restitution)


@dataclass(frozen=True, kw_only=True)
class HuntCrossley(Law):
    """Hysteretic damping, `P = K delta^(3/2) (1 + chi delta')` (Hunt & Crossley 1975).

    Parameters
    ----------
    restitution : array_like, in (0, 1]
        Requested rebound speed over impact speed.
    law : str
        Relation of chi to the restitution: "exact", which delivers it, or one of the published factors "hunt-crossley",
        "herbert-mcwhannell", "lee-wang", "lankarani-nikravesh", "gonthier", "zhiying-qishao", "flores", "hu-guo".

    Raises
    ------
    InvalidValue
        The restitution is outside (0, 1], or the law is unknown.

    Examples
    --------
    >>> round(float(HuntCrossley(restitution=0.5, law="lankarani-nikravesh").delivered_restitution), 3)
    0.725
    """

    restitution: ArrayLike
    law: str = "exact"
    name = "hunt-crossley"
    keys = ("restitution",)
    force = staticmethod(_hertz)

    def __post_init__(self) -> None:
        validation.restitution("restitution", self.restitution)
        validation.choice("law", self.law, HUNT_CROSSLEY_LAWS)
        validation.hold(self, "restitution")

    @property
    def damping_number(self) -> Floats:
        """D = chi v by this law."""
        restitution = np.asarray(self.restitution, np.float64)
        with np.errstate(over="ignore"):
            damping = np.asarray(HUNT_CROSSLEY_LAWS[self.law](restitution))
        if not (damping < _MAX_DAMPING).all():
            raise InvalidValue(
                f"restitution must give a damping number within double precision, got {restitution.min():g}"
            )
        return damping

    @property
    def delivered_restitution(self) -> Floats:
        """Restitution of this damping on a target without losses."""
        if self.law == "exact":
            return np.asarray(self.restitution, np.float64)
        return delivered_restitution(self.damping_number)

    def closed(self, impact: Impact) -> Curves:
        """Return the curves of `Elastic.closed`."""
        return hunt_crossley_curves(impact, self.delivered_restitution)


#: Chebyshev coefficients of `zeta e^(3/5) / (1 - e)` over `2 (1 - e^(1/5))^(1/2) - 1`, in which it is smooth from
#: e = 1, where it is 1 / 1.15345 (Schwager & Poeschel 1998, Phys. Rev. E 57, 650), to e = 0, where e ~ zeta^(-5/3).
_OF_RESTITUTION = (
    1.0132606334492797, 0.1822220075918886, 0.013792523295350434, -0.03157421915270771, -0.007560752185743709,
    0.0035771704827647936, 0.0023593117970594386, 0.0006269063041832185, -0.00016393233929581883,
    -0.00019303720967917644, -7.738087057894107e-05, -9.858518223975059e-06, 8.465960090754827e-06,
    7.243992564569245e-06, 3.4979479176734328e-06, 1.277591562873119e-06, 3.9477489620800123e-07,
    1.1283821339657341e-07, 3.1962657000828093e-08, 9.087841684804903e-09, 2.3469956301850767e-09,
    4.848605218946283e-10, 6.645667873857326e-11, 3.690065363644148e-12,
)  # fmt: skip
#: Smallest restitution that these cover.
MIN_VISCOELASTIC = 0.003
_OF_VISCOELASTIC = ("dissipative_constant", "time_constant", "restitution")


def viscoelastic_number(restitution: ArrayLike) -> Floats:
    """Return zeta = A v / L of a viscoelastic impact of this restitution, in [0.003, 1]; there is no closed form.

    In units of L and T0 the contact is `x'' = -x^(3/2) - zeta x^(1/2) x'`, so that restitution follows from zeta alone.
    The inverse is a series fitted to integrated impacts; relative error below 1e-11.

    >>> round(float(viscoelastic_number(0.39393060323)), 9)
    1.0
    """
    e = np.asarray(restitution, np.float64)
    fifth = np.power(e, 0.2)
    series = chebval(2 * np.sqrt(1 - fifth) - 1, _OF_RESTITUTION)
    return np.asarray((1 - e) / (fifth * fifth * fifth) * series)


@dataclass(frozen=True, kw_only=True)
class Viscoelastic(Law):
    """A viscoelastic sphere, `P = K (delta^(3/2) + A delta^(1/2) delta')` (Kuwabara & Kono 1987).

    Restitution is a result and falls with speed. Contact ends when the force reaches 0, with the sphere still
    flattened; the force is never attractive. Give exactly one of the three parameters.

    Parameters
    ----------
    dissipative_constant : array_like, optional, above 0 [s]
        A. Brilliantov et al. (1996), Phys. Rev. E 53, 5382, call it `3/2 A`.
    time_constant : array_like, optional, above 0 [s]
        b of a Kelvin-Voigt sphere, stress = E (strain + b x strain rate). Then `A = 3/2 b s`, with s the sphere's share
        of the total compliance. The target is elastic, even if it is a sphere: for two viscoelastic spheres give the
        dissipative constant of their contact.
    restitution : array_like, optional, in [0.003, 1]
        Rebound speed over impact speed by this loss alone, at the speed of each impact; A follows from it.

    Raises
    ------
    InvalidValue
        None or several are given, or a value is out of range.

    Examples
    --------
    >>> from cgid.physics import RIGID, Impact, Sphere
    >>> from cgid.physics import YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=RIGID, velocity=[1.0, 5.0],
    ...     stiffness="hertz", dissipation=Viscoelastic(restitution=0.4),
    ... )
    >>> impact.restitution.round(8).tolist()
    [0.4, 0.4]
    """

    dissipative_constant: ArrayLike | None = None
    time_constant: ArrayLike | None = None
    restitution: ArrayLike | None = None
    name = "kuwabara-kono"
    keys = ("restitution",)
    pulls = True

    @staticmethod
    def force(p: Any, history: Any, w: float) -> tuple[float, float]:
        """Return `x^(3/2)` and `zeta x^(1/2)`."""
        return w * w * w, p[0] * w

    def __post_init__(self) -> None:
        given = [name for name in _OF_VISCOELASTIC if getattr(self, name) is not None]
        if len(given) != 1:
            raise InvalidValue(
                "Viscoelastic needs one of dissipative_constant [s], time_constant [s] and restitution, "
                f"got {' and '.join(given) or 'none'}"
            )
        if self.restitution is None:
            validation.positive(given[0], getattr(self, given[0]), "s")
        else:
            validation.between("restitution", self.restitution, MIN_VISCOELASTIC, 1.0)
        validation.hold(self, *_OF_VISCOELASTIC)

    def numbers(self, impact: Impact) -> dict[str, ArrayLike]:
        """Return the number `zeta = A / T0`."""
        if self.restitution is not None:
            return {"zeta": viscoelastic_number(self.restitution)}
        constant = self.dissipative_constant
        if self.time_constant is not None:
            constant = 1.5 * np.asarray(self.time_constant) * sphere_share(impact.sphere, impact.target)
        return {"dissipative constant": np.asarray(constant) / impact.time_scale}


@dataclass(frozen=True, kw_only=True)
class Thornton(Law):
    """An elastic-plastic sphere (Thornton 1997, J. Appl. Mech. 64, 383): rock that crushes at the contact.

    The contact is Hertzian until the pressure in its middle reaches the yield pressure p_y. From then on the force
    grows linearly, with the slope `pi R p_y`, and the flattened contact unloads as a Hertzian one of a larger radius.
    Restitution is a result. It falls with speed from 1 at the yield velocity, asymptotically as `v^(-1/4)`. A slower
    impact is elastic. The yield displacement is `(2 pi R p_y / (3 K))^2`; with Hertz's stiffness this is Thornton's
    `(pi p_y / (2 E))^2 R`, other theories keep the slope.

    Parameters
    ----------
    yield_pressure : array_like, above 0 [Pa]
        Largest contact pressure p_y; about 1.6 times the uniaxial compressive strength.
    viscous_restitution : array_like, in [0.05, 1], optional
        Rebound speed over impact speed by a viscous loss alone, at the speed of each impact. The force
        on every branch is then multiplied by Hunt and Crossley's `1 + chi delta'`; see `HuntCrossley`. By default, the
        sphere only crushes.

    Raises
    ------
    InvalidValue
        The yield pressure is not above 0, or the viscous restitution is outside [0.05, 1].

    Examples
    --------
    Restitution and force of a coal sphere of 25 mm that crushes at 41 MPa, at 2 m/s on steel:

    >>> from cgid.physics import HalfSpace, Impact, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=HalfSpace(material=STEEL),
    ...     velocity=2.0, stiffness="hertz", dissipation=Thornton(yield_pressure=41e6),
    ... )
    >>> round(float(impact.restitution), 3), round(float(impact.peak_force))
    (0.522, 1078)

    The same sphere, of a material that by itself would leave .7 of the speed:

    >>> both = Thornton(yield_pressure=41e6, viscous_restitution=0.7)
    >>> impact = Impact(
    ...     sphere=impact.sphere, target=impact.target, velocity=2.0, stiffness="hertz", dissipation=both,
    ... )
    >>> round(float(impact.restitution), 3), round(float(impact.peak_force))
    (0.416, 1025)
    """

    yield_pressure: ArrayLike
    viscous_restitution: ArrayLike | None = None
    name = "thornton"
    keys = ("yield_pressure", "viscous_restitution")

    @staticmethod
    def force(p: Any, history: Any, w: float) -> tuple[float, float]:
        """Return the force of the current path; the history is origin, largest approach, path, stiffness."""
        if history[2] == 0.0:
            g = w * w * w
        elif history[2] == 1.0:
            g = math.sqrt(p[0]) * (1.5 * w * w - 0.5 * p[0])
        else:
            g = history[3] * w * w * w
        return g, p[1] * g

    @staticmethod
    def corner(p: Any, history: Any) -> float:
        """Return where the contact yields, or yields again."""
        if history[2] == 1.0:
            return math.inf
        largest: float = p[0] if history[2] == 0.0 else history[1]
        return largest

    @staticmethod
    def turn(p: Any, history: Any, x: float) -> float:
        """Yield, or unload by a flatter sphere."""
        if history[2] == 1.0:
            largest = math.sqrt(p[0]) * (1.5 * x - 0.5 * p[0])
            rest: float = largest / math.sqrt(x)
            history[0], history[1], history[2] = x - rest, x, 2.0
            history[3] = largest / (rest * math.sqrt(rest))
            return rest
        if history[2] == 0.0 and x >= p[0]:
            history[2] = 1.0
        elif history[2] == 2.0 and x >= history[1]:
            history[0], history[2] = 0.0, 1.0
        way: float = x - history[0]
        return way

    def __post_init__(self) -> None:
        validation.positive("yield_pressure", self.yield_pressure, "Pa")
        _hold_viscous(self, "yield_pressure")

    def numbers(self, impact: Impact) -> dict[str, ArrayLike]:
        """Return the yield displacement and the damping number."""
        root = 2 / 3 * np.pi * impact.reduced_radius * np.asarray(self.yield_pressure) / impact.contact_stiffness
        depth = root * root / impact.length_scale
        if not (depth > 1e-290).all():
            raise InvalidValue(
                "the yield displacement of the impact must be between 1e-290 and 1e290 of that of the impact for "
                f"double precision, got {depth.min():g}; check radius, material, velocity and loss"
            )
        return {"yield displacement": depth, "damping number": _viscous_damping(self)}

    def closed(self, impact: Impact) -> Curves | None:
        """Return the curves of three branches if only crushing dissipates energy."""
        return impact.plain_curves(thornton_curves, "yield displacement") if self.viscous_restitution is None else None


@dataclass(frozen=True, kw_only=True)
class WaltonBraun(Law):
    """A bilinear contact (Walton & Braun 1986, J. Rheol. 30, 949): `P = k delta` loading, `k / e^2` unloading.

    The force rises as a quarter of a sine and falls as another, shorter by the factor e. Restitution is the same at
    every speed.

    Parameters
    ----------
    restitution : array_like, in (0, 1]
        Rebound speed over impact speed.
    loading_stiffness : array_like, optional, above 0 [N/m]
        The slope k; codes of the discrete-element method often take `5 R Y` with the yield strength Y. Without it, it
        is the slope of equal depth: `4/5 K delta_max^(1/2)`, at which a contact without loss is as deep as by the
        chosen stiffness theory at the same speed.
    viscous_restitution : array_like, in [0.05, 1], optional
        As for `Thornton`.

    Raises
    ------
    InvalidValue
        The restitution is outside (0, 1], the stiffness is not above 0, or the viscous restitution is outside
        [0.05, 1].

    Examples
    --------
    >>> from cgid.physics import RIGID, Impact, Sphere
    >>> from cgid.physics import YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=RIGID, velocity=2.0, stiffness="hertz",
    ...     dissipation=WaltonBraun(restitution=0.5, loading_stiffness=1e6),
    ... )
    >>> round(float(impact.peak_force / np.sqrt(impact.reduced_mass * 1e6)), 12)  # sqrt(k m) v
    2.0
    """

    restitution: ArrayLike
    loading_stiffness: ArrayLike | None = None
    viscous_restitution: ArrayLike | None = None
    name = "walton-braun"
    keys = ("restitution", "viscous_restitution")

    @staticmethod
    def force(p: Any, history: Any, w: float) -> tuple[float, float]:
        """Return the force of the current path; the history is origin, largest approach, 1 once it has unloaded."""
        g = p[0] * w * w
        if history[2] == 1.0:
            g = g / (p[1] * p[1])
        return g, p[2] * g

    @staticmethod
    def corner(p: Any, history: Any) -> float:
        """Return the approach at which a recompressed contact loads as before."""
        largest: float = history[1] if history[2] == 1.0 else math.inf
        return largest

    @staticmethod
    def turn(p: Any, history: Any, x: float) -> float:
        """Unload, or load as before."""
        way: float = x - history[0]
        if history[2] == 0.0:
            history[0], history[1], history[2] = x * (1.0 - p[1]) * (1.0 + p[1]), x, 1.0
            way = x * p[1] * p[1]
        elif x >= history[1]:
            history[0], history[2] = 0.0, 0.0
            way = x
        return way

    def __post_init__(self) -> None:
        validation.restitution("restitution", self.restitution)
        if self.loading_stiffness is not None:
            validation.positive("loading_stiffness", self.loading_stiffness, "N/m")
        _hold_viscous(self, "restitution", "loading_stiffness")

    def numbers(self, impact: Impact) -> dict[str, ArrayLike]:
        """Return the loading stiffness, the restitution and the damping number."""
        stiffness: ArrayLike = EQUIVALENT_STIFFNESS
        if self.loading_stiffness is not None:
            unit = impact.contact_stiffness * np.sqrt(impact.length_scale)
            stiffness = np.asarray(self.loading_stiffness) / unit
        return {
            "loading stiffness": stiffness,
            "restitution": self.restitution,
            "damping number": _viscous_damping(self),
        }

    def closed(self, impact: Impact) -> Curves | None:
        """See `Thornton.closed`."""
        if self.viscous_restitution is not None:
            return None
        return impact.plain_curves(walton_braun_curves, "restitution", "loading stiffness")


@dataclass(frozen=True, kw_only=True)
class PowerLaw(Law):
    """A corner, an edge or a face in place of a sphere: `P = k delta^n (1 + chi delta')`, which may break.

    The rock touches as a body of revolution of the shape `z = (c R / 2) c (r / c R)^(1 / (n - 1))`, which crosses the
    sphere of its radius of curvature R where the contact radius is c R (Sneddon 1965, Int. J. Eng. Sci. 3, 47). A face
    of radius c R has the exponent n = 1; a sphere 3/2, whatever c; a cone 2, whose half angle from its axis is
    `arccot(c / 2)`, 60 to 80 degrees for c of 1.15 to 0.35. The damping delivers the restitution at every exponent,
    since chi depends on the energy alone.

    A rock that breaks loses a part of its force at once, at the approach b^(1 / n) of the largest one without loss, at
    which `k delta^n` is the fraction b of the peak force without loss; from then on the force is the remaining fraction
    of an unbroken one at every approach. Damping does not count: the force itself is higher when the rock breaks, and a
    rock whose loss stops it before never breaks, at a restitution of 0.5 and n = 3/2 from b = 0.69 on.

    Parameters
    ----------
    restitution : array_like, in [0.05, 1]
        Rebound speed over impact speed of an unbroken rock.
    exponent : array_like, in [1, 2]
        n; 3/2 by default.
    contact_radius : array_like, above 0
        c; 1 by default.
    breaking_force : array_like, above 0
        b: `k delta^n` where it breaks, without damping, over the peak force without loss; from 1 on it never breaks.
    remaining_force : array_like, in [0.01, 1]
        What is left of the force.

    Raises
    ------
    InvalidValue
        A value is out of range.

    Examples
    --------
    A corner is softer than the sphere it replaces, so that its contact lasts longer:

    >>> from cgid.physics import RIGID, YANG2018_SPHERES, Impact, PowerLaw, Sphere
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=RIGID, velocity=2.0, stiffness="hertz",
    ...     dissipation=PowerLaw(restitution=0.5, exponent=[1.5, 2.0], contact_radius=0.7),
    ... )
    >>> impact.restitution.round(6).tolist(), (impact.contact_duration * 1e6).round().tolist()
    ([0.5, 0.5], [392.0, 814.0])

    The last rock stops before it would break:

    >>> law = PowerLaw(restitution=0.5, breaking_force=[0.4, 0.68, 0.69], remaining_force=0.5)
    >>> impact = Impact(sphere=impact.sphere, target=RIGID, velocity=2.0, stiffness="hertz", dissipation=law)
    >>> impact.restitution.round(2).tolist()
    [0.47, 0.4, 0.5]
    """

    restitution: ArrayLike
    exponent: ArrayLike = 1.5
    contact_radius: ArrayLike = 1.0
    breaking_force: ArrayLike = 1.0
    remaining_force: ArrayLike = 1.0
    name = "power-law"
    keys = ("restitution", "exponent", "contact_radius", "breaking_force", "remaining_force")

    @staticmethod
    def force(p: Any, history: Any, w: float) -> tuple[float, float]:
        """Return the force, whose history is its loss, and its damping."""
        g = p[0] * (1.0 - history[1]) * math.pow(abs(w), p[1])
        return g, p[2] * g

    @staticmethod
    def corner(p: Any, history: Any) -> float:
        """Return where the rock breaks."""
        depth: float = p[3] if history[1] == 0.0 else math.inf
        return depth

    @staticmethod
    def turn(p: Any, history: Any, x: float) -> float:
        """Break, unless the rock only turns."""
        if x >= p[3]:
            history[1] = p[4]
        way: float = x
        return way

    def __post_init__(self) -> None:
        validation.between("restitution", self.restitution, family.MIN_RESTITUTION, family.MAX_RESTITUTION)
        validation.between("exponent", self.exponent, *EXPONENTS)
        validation.positive("contact_radius", self.contact_radius)
        validation.positive("breaking_force", self.breaking_force)
        validation.between("remaining_force", self.remaining_force, *REMAINING)
        validation.hold(self, *self.keys)

    def numbers(self, impact: Impact) -> dict[str, ArrayLike]:
        """Return stiffness, twice the exponent, damping number, where it breaks, and what it loses."""
        n, c = np.asarray(self.exponent, np.float64), np.asarray(self.contact_radius, np.float64)
        # Depth over height where the shape has the contact radius: 2 for a sphere, pi / 2 for a cone.
        m = 1 / np.maximum(n - 1, 1e-9)
        ratio = np.exp((1 - n) * (0.5 * np.log(np.pi) + gammaln(m / 2 + 1) - gammaln((m + 1) / 2) - np.log(2)))
        depth = impact.length_scale / impact.reduced_radius
        stiffness = 1.5 / n * c ** (3 - 2 * n) * ratio * depth ** (n - 1.5)
        deepest = ((n + 1) / (2 * stiffness)) ** (1 / (n + 1))
        broken = np.asarray(self.breaking_force)
        return {
            "stiffness": stiffness,
            "twice the exponent": 2 * n,
            "damping number": damping_number(self.restitution),
            "breaks at": np.where(broken < 1, broken ** (1 / n) * deepest, _NEVER),
            "loss": 1 - np.asarray(self.remaining_force),
        }


def _hold_viscous(law: Thornton | WaltonBraun, *names: str) -> None:
    """Check the viscous restitution of a law, and store it with its other parameters."""
    if law.viscous_restitution is not None:
        lowest, highest = family.MIN_RESTITUTION, family.MAX_RESTITUTION
        validation.between("viscous_restitution", law.viscous_restitution, lowest, highest)
    validation.hold(law, *names, "viscous_restitution")


def _viscous_damping(law: Thornton | WaltonBraun) -> Floats:
    return np.zeros(()) if law.viscous_restitution is None else damping_number(law.viscous_restitution)


#: The laws of scenes by name. The order defines their indices in data.
LAWS: dict[str, type[Law]] = {
    law.name: law for law in (Elastic, HuntCrossley, Thornton, WaltonBraun, Viscoelastic, PowerLaw)
}


def known(name: str) -> type[Law] | None:
    """Return the built-in or custom contact law of this name; None for an unknown one."""
    if name in LAWS:
        return LAWS[name]
    from cgid.physics.contact.own_laws import own_law

    values = own_law(name)
    return None if values is None else values.law


def named(name: str) -> type[Law]:
    """Return the contact law of this name; raises `InvalidValue` for an unknown one."""
    law = known(name)
    if law is None:
        from cgid.physics.contact.own_laws import how_to_add

        raise InvalidValue(f"dissipation must be one of {', '.join(LAWS)}, got {name!r}; {how_to_add()}")
    return law


#: Laws with different paths of loading and unloading.
Plastic = Thornton | WaltonBraun

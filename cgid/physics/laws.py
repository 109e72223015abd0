"""Hertz contact: the paper's three stiffness theories and the closed forms of an elastic impact.

Every theory has the form `P = K delta^(3/2)`. Hertz's reduced modulus already holds the compliance of both
bodies, so the paper's own series theory counts it twice, and an independent finite-element run agrees with
`"hertz"`; all three are kept, and none is chosen silently.

The published damping factors of a Hunt-Crossley contact, each under the name by which it is selected.

All have one form, `P = K delta^(3/2) (1 + chi delta')`, and differ in the damping number `D = chi v` that they
give a restitution e. All but the exact one are approximations, good near e = 1: what an impact then really
delivers is `HuntCrossley.delivered_restitution`. Another factor is one more function in the table.

How the material loses energy: not at all, by Hunt-Crossley damping, or as a viscoelastic solid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.counting import count
from cgid.elementary import exp
from cgid.errors import InvalidValue
from cgid.physics.bodies import Sphere, Target, sphere_share
from cgid.physics.closed_forms import damping_number, delivered_restitution
from cgid.signals import STANDARD_GRAVITY
from cgid.validation import Floats

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
    reduced_radius : array_like
        [m].
    reduced_modulus : array_like
        [Pa].
    theory : {"hertz", "rigid-sphere", "series"}
        `K1 = 4/3 sqrt(R) E`; `K2 = 8 sqrt(3)/9 K1`; both springs in series, `K1 / 1.75^(3/2)`.

    Returns
    -------
    ndarray
        [N/m^(3/2)].

    Examples
    --------
    >>> f"{contact_stiffness(0.025, 2.4265e9, 'hertz'):.4e}"  # Yang 2018, Table 1
    '5.1155e+08'
    """
    factor = STIFFNESS_THEORIES[validation.choice("stiffness", theory, STIFFNESS_THEORIES)]
    radius = validation.positive("reduced_radius", reduced_radius, "m")
    modulus = validation.positive("reduced_modulus", reduced_modulus, "Pa")
    return np.asarray(factor * 4 / 3 * np.sqrt(radius) * modulus)


def free_fall_velocity(height: ArrayLike, gravity: float = STANDARD_GRAVITY) -> Floats:
    """Return the speed after a free fall, `sqrt(2 g H)` [m/s] (Yang 2018, Eq. 15).

    Examples
    --------
    >>> round(float(free_fall_velocity(1.0)), 4)
    4.4287
    """
    pull = validation.not_negative("gravity", gravity, "m/s^2")
    return np.asarray(np.sqrt(2 * pull * validation.not_negative("height", height, "m")))


def _hunt_crossley(e: Floats) -> Floats:
    """Hunt & Crossley (1975), J. Appl. Mech. 42, 440."""
    return 1.5 * (1 - e)


def _herbert_mcwhannell(e: Floats) -> Floats:
    """Herbert & McWhannell (1977), J. Eng. Ind. 99, 663."""
    return 6 * (1 - e) / ((2 * e - 1) * (2 * e - 1) + 3)


def _lee_wang(e: Floats) -> Floats:
    """Lee & Wang (1983), J. Mech. Transm. Autom. Des. 105, 534."""
    return 0.75 * (1 - e)


def _lankarani_nikravesh(e: Floats) -> Floats:
    """Lankarani & Nikravesh (1990), J. Mech. Des. 112, 369."""
    return 0.75 * (1 - e) * (1 + e)


def _gonthier(e: Floats) -> Floats:
    """Gonthier, McPhee, Lange & Piedboeuf (2004), Multibody Syst. Dyn. 11, 209: their approximation."""
    return (1 - e) * (1 + e) / e


def _zhiying_qishao(e: Floats) -> Floats:
    """Zhang Zhiying & Lu Qishao (2006)."""
    return 0.75 * (1 - e) * (1 + e) * exp(2 * (1 - e))


def _flores(e: Floats) -> Floats:
    """Flores, Machado, Silva & Martins (2011), Multibody Syst. Dyn. 25, 357."""
    return 1.6 * (1 - e) / e


def _hu_guo(e: Floats) -> Floats:
    """Hu & Guo (2015), Multibody Syst. Dyn. 35, 131."""
    return 1.5 * (1 - e) / e


#: Law by name: the damping number D = chi v of the restitution asked for. "exact" delivers what is asked.
HUNT_CROSSLEY_LAWS: dict[str, Callable[[Floats], Floats]] = {
    "exact": damping_number,
    "hunt-crossley": _hunt_crossley,
    "herbert-mcwhannell": _herbert_mcwhannell,
    "lee-wang": _lee_wang,
    "lankarani-nikravesh": _lankarani_nikravesh,
    "gonthier": _gonthier,
    "zhiying-qishao": _zhiying_qishao,
    "flores": _flores,
    "hu-guo": _hu_guo,
}


#: An impact so damped that it would lie outside the reach of double precision anyway.
_MOST_DAMPING = 1e100


@dataclass(frozen=True)
class Elastic:
    """No loss in the material: against anything but a thin plate the sphere leaves as fast as it came."""

    @property
    def damping_number(self) -> Floats:
        """D = 0."""
        return np.zeros(())

    @property
    def delivered_restitution(self) -> Floats:
        """Exactly 1."""
        return np.ones(())

    def loss(self, sphere: Sphere, target: Target) -> tuple[Floats, Floats]:
        """Return what `Collision` asks of every dissipation: restitution by Hunt-Crossley damping, and A [s]."""
        return self.delivered_restitution, np.zeros(())


@dataclass(frozen=True, kw_only=True)
class HuntCrossley:
    """Hysteretic damping, `P = K delta^(3/2) (1 + chi delta')` (Hunt & Crossley 1975).

    Parameters
    ----------
    restitution : array_like
        Rebound speed over impact speed asked for, in (0, 1].
    law : str
        How chi follows from the restitution: "exact", which delivers what is asked, or one of the published
        factors "hunt-crossley", "herbert-mcwhannell", "lee-wang", "lankarani-nikravesh", "gonthier",
        "zhiying-qishao", "flores", "hu-guo" (`cgid.physics.laws`).

    Raises
    ------
    InvalidValue
        A restitution outside (0, 1], or an unknown law.

    Examples
    --------
    >>> round(float(HuntCrossley(restitution=0.5, law="lankarani-nikravesh").delivered_restitution), 3)
    0.725
    """

    restitution: ArrayLike
    law: str = "exact"

    def __post_init__(self) -> None:
        validation.restitution("restitution", self.restitution)
        validation.choice("law", self.law, HUNT_CROSSLEY_LAWS)
        validation.hold(self, "restitution")

    @property
    def damping_number(self) -> Floats:
        """D = chi v, for this law."""
        restitution = validation.restitution("restitution", self.restitution)
        with np.errstate(over="ignore"):
            damping = np.asarray(HUNT_CROSSLEY_LAWS[self.law](restitution))
        if not (damping < _MOST_DAMPING).all():
            raise InvalidValue(
                f"restitution must leave a damping number that double precision holds, got {restitution.min():g}"
            )
        return damping

    @property
    def delivered_restitution(self) -> Floats:
        """The restitution that this damping really gives on a target that takes no energy."""
        if self.law == "exact":
            return validation.restitution("restitution", self.restitution)
        damping = self.damping_number
        count("damping_solves", damping.size)
        return delivered_restitution(damping)

    def loss(self, sphere: Sphere, target: Target) -> tuple[Floats, Floats]:
        """Return what `Collision` asks of every dissipation: restitution by Hunt-Crossley damping, and A [s]."""
        return self.delivered_restitution, np.zeros(())


@dataclass(frozen=True, kw_only=True)
class Viscoelastic:
    """A viscoelastic sphere, `P = K (delta^(3/2) + A delta^(1/2) delta')` (Kuwabara & Kono 1987).

    Restitution is a result: it falls with speed. Contact ends where the force has fallen to zero, while the
    sphere is still flattened; there is never attraction. Give one of the two numbers.

    Parameters
    ----------
    dissipative_constant : array_like, optional
        A [s] as written above. (Brilliantov et al. 1996, Phys. Rev. E 53, 5382, write `3/2 A` for it.)
    time_constant : array_like, optional
        b [s] of a Kelvin-Voigt sphere, whose stress is that of the strain plus b times its rate. Then
        `A = 3/2 b s`, where s is the sphere's share in the compliance of both bodies: the target, a second sphere too,
        is elastic. For two viscoelastic spheres give the dissipative constant of their contact.

    Raises
    ------
    InvalidValue
        Neither or both are given, or a number is not above 0.
    """

    dissipative_constant: ArrayLike | None = None
    time_constant: ArrayLike | None = None

    def __post_init__(self) -> None:
        if (self.dissipative_constant is None) == (self.time_constant is None):
            raise InvalidValue("Viscoelastic needs one of dissipative_constant [s] and time_constant [s], not both")
        for name in ("dissipative_constant", "time_constant"):
            if getattr(self, name) is not None:
                validation.positive(name, getattr(self, name), "s")
        validation.hold(self, "dissipative_constant", "time_constant")

    def loss(self, sphere: Sphere, target: Target) -> tuple[Floats, Floats]:
        """Return what `Collision` asks of every dissipation: restitution by Hunt-Crossley damping, and A [s]."""
        if self.time_constant is not None:
            time_constant = validation.positive("time_constant", self.time_constant, "s")
            constant = np.asarray(1.5 * time_constant * sphere_share(sphere, target))
        else:
            assert self.dissipative_constant is not None  # __post_init__ saw to it
            constant = validation.positive("dissipative_constant", self.dissipative_constant, "s")
        return np.ones(()), constant


Dissipation = Elastic | HuntCrossley | Viscoelastic

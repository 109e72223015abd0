"""How the material loses energy: not at all, by Hunt-Crossley damping, or as a viscoelastic solid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.counting import count
from cgid.errors import InvalidValue
from cgid.physics.bodies import Sphere, Target, sphere_share
from cgid.physics.damping_factors import HUNT_CROSSLEY_LAWS
from cgid.physics.restitution import delivered_restitution
from cgid.validation import Floats

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
        "zhiying-qishao", "flores", "hu-guo" (`cgid.physics.damping_factors`).

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

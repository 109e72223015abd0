"""How an impact loses energy: not at all, or by Hunt-Crossley damping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.impact.restitution import damping_number
from cgid.validation import Floats

#: Damping laws by name: each gives the damping number D = chi v of the restitution asked for.
HUNT_CROSSLEY_LAWS = {"exact": damping_number}


@dataclass(frozen=True)
class Elastic:
    """No loss: the sphere leaves as fast as it came."""

    @property
    def damping_number(self) -> Floats:
        """D = 0."""
        return np.zeros(())

    @property
    def delivered_restitution(self) -> Floats:
        """Exactly 1."""
        return np.ones(())


@dataclass(frozen=True, kw_only=True)
class HuntCrossley:
    """Hysteretic damping, `P = K delta^(3/2) (1 + chi delta')` (Hunt & Crossley 1975).

    Parameters
    ----------
    restitution : array_like
        Rebound speed over impact speed asked for, in (0, 1].
    law : {"exact"}
        How chi follows from the restitution. "exact" delivers what is asked.
    """

    restitution: ArrayLike
    law: str = "exact"

    def __post_init__(self) -> None:
        validation.restitution("restitution", self.restitution)
        validation.choice("law", self.law, HUNT_CROSSLEY_LAWS)

    @property
    def damping_number(self) -> Floats:
        """D = chi v, for this law."""
        return HUNT_CROSSLEY_LAWS[self.law](self.restitution)

    @property
    def delivered_restitution(self) -> Floats:
        """The restitution that really comes out: the exact law delivers what is asked."""
        return validation.restitution("restitution", self.restitution)


Dissipation = Elastic | HuntCrossley

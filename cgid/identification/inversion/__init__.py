"""Location and contact force of an impact, from the motion of a beam."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cgid._lib.lazy import on_first_use

if TYPE_CHECKING:
    from cgid.identification.inversion.recovered import RecoveredForce as RecoveredForce
    from cgid.identification.inversion.recovered import recover_force as recover_force
else:  # a name that does not exist would have a type
    __all__, __getattr__, __dir__ = on_first_use(__name__, {"recovered": ("RecoveredForce", "recover_force")})

"""The published damping factors of a Hunt-Crossley contact, each under the name by which it is selected.

All have one form, `P = K delta^(3/2) (1 + chi delta')`, and differ in the damping number `D = chi v` that they
give a restitution e. All but the exact one are approximations, good near e = 1: what an impact then really
delivers is `HuntCrossley.delivered_restitution`. Another factor is one more function in the table.
"""

from __future__ import annotations

from collections.abc import Callable

from cgid.elementary import exp
from cgid.physics.restitution import damping_number
from cgid.validation import Floats


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

"""Claims of section 5: how the four spheres differ."""

from __future__ import annotations

from cgid.physics import Impact
from cgid.physics.materials import YANG2018_SPHERES
from cgid.reproduction import impacts, paper
from cgid.reproduction.claims.claim import Claim, judged_ordering, symbol, written

_RESPONSES = {"peak_displacement": "DCS", "peak_force": "force"}
#: Coal and gangue differ "obviously" if the smallest difference of two spheres is at least this part.
_OBVIOUS = 0.1


def sphere_claims() -> list[Claim]:
    """Return the claims of section 5, judged."""
    return [*_spheres(), _separation()]


def _spheres() -> list[Claim]:
    elastic = {n: impacts.paper_impact(n, impacts.SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    restitution = impacts.SECTION_5_RESTITUTION
    damped = {n: impacts.paper_impact(n, i.velocity, restitution=restitution) for n, i in elastic.items()}
    shown = {
        "density": (1.0, "kg/m³"),
        "youngs_modulus": (1e-9, "GPa"),
        "poisson_ratio": (1.0, ""),
        "peak_force": (1e-3, "kN"),
        "peak_displacement": (1e3, "mm"),
    }
    speed = f"at {impacts.SECTION_5_VELOCITY:g} m/s"
    labels = {"peak_force": f"maximum force {speed}", "peak_displacement": f"DCS {speed}"}
    claims = []
    for name, ordering in paper.SPHERES_BY.items():
        factor, unit = shown[name]
        kinds: dict[str, dict[int, Impact]] = {"": elastic}
        if name in _RESPONSES:
            kinds = {"elastic: ": elastic, f"restitution {restitution:g}: ": damped}
        judged = {}
        for kind, made in kinds.items():
            source = {n: i if name in _RESPONSES else i.sphere.material for n, i in made.items()}
            judged[kind] = judged_ordering(ordering, {str(n): factor * getattr(s, name) for n, s in source.items()})
        claims.append(
            Claim(
                f"spheres by {name}",
                "Section 5 (Figures 16 and 17)",
                f"By {labels.get(name, symbol(name)[0])}: {written(ordering)}.",
                "; ".join(f"{kind}{text}" for kind, (_, text) in judged.items()) + (f" [{unit}]." if unit else "."),
                all(holds for holds, _ in judged.values()),
            )
        )
    return claims


def _separation() -> Claim:
    made = {n: impacts.paper_impact(n, impacts.SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    least = {}
    for response, label in _RESPONSES.items():
        value = {n: float(getattr(impact, response)) for n, impact in made.items()}
        pairs = {(c, g): max(value[c], value[g]) / min(value[c], value[g]) - 1 for c in (1, 2) for g in (3, 4)}
        pair = min(pairs, key=lambda key: pairs[key])
        least[label] = (pairs[pair], pair)
    return Claim(
        "coal and gangue differ obviously",
        "Section 5",
        "Spheres 1, 2 (coal) differ obviously from spheres 3, 4 (gangue) in maximum force and DCS.",
        "Smallest difference of a coal from a gangue sphere: "
        + ", ".join(f"{label} {part:.1%} (spheres {pair[0]} and {pair[1]})" for label, (part, pair) in least.items())
        + f" (obvious: {_OBVIOUS:.0%} or more, all at one radius).",
        min(part for part, _ in least.values()) >= _OBVIOUS,
    )

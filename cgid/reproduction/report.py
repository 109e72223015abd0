"""The report in Markdown: what agrees with the paper and what does not, and every picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cgid.physics.impact import HERTZ_LIMIT
from cgid.reproduction.claims import Claim, all_claims
from cgid.reproduction.claims.claim import symbol
from cgid.reproduction.claims.influence import measures
from cgid.reproduction.finite_element import Study
from cgid.reproduction.finite_element.section import finite_element_section
from cgid.reproduction.impacts import RESTITUTIONS
from cgid.reproduction.markdown import table
from cgid.reproduction.paper_figure import PaperFigure
from cgid.reproduction.tables import PaperTable

_SOURCE = (
    "Yang, Zeng & Wan (2018), *Contact Response Analysis of Vertical Impact between Elastic Sphere and Elastic Half "
    "Space*, Shock and Vibration"
)


def write_report(figures: Sequence[PaperFigure], tables: Sequence[PaperTable], study: Study) -> str:
    """Return the report; its verdicts are computed anew."""
    claims = all_claims(study)
    failing = [claim for claim in claims if not claim.holds]
    holding = [claim for claim in claims if claim.holds]
    return "\n".join([
        "# The paper, reproduced",
        "",
        f"The figures and tables of {_SOURCE}, computed, and {len(claims)} judgements of what it "
        f"says, by the numbers: {len(holding)} agree, {len(failing)} do not. (A ranking is judged once for each of two "
        "measures, and what must follow from an equation counts as said.) DCS is the displacement of the sphere's "
        "centre. Figures 4 to 6 compare the paper's three theories, all others that are not simulated "
        "use its own (`series`). `>>` is read as "
        "`>`: the paper does not say how much larger is much larger.",
        "",
        "What the paper leaves open and was chosen here: the axes of Figures 4 to 7, the impact speed of section 4 (it "
        "follows from the constants under Eq. 18), and the damping, restitution "
        f"{' and '.join(f'{value:g}' for value in RESTITUTIONS)} by the exact Hunt-Crossley relation. The paper prints "
        "no numbers of its simulated curves (Figures 9 to 11, 16, 17), only of Table 3; what stands here as simulated "
        "is cgid's own finite-element study.",
        "",
        f"## What does not agree ({len(failing)})",
        "",
        *_claim_list(failing),
        "",
        f"## What agrees ({len(holding)})",
        "",
        *_claim_list(holding),
        "",
        *_sensitivities(),
        *finite_element_section(study),
        *_hertz_range(figures),
        "## Tables",
        "",
        *(line for table in tables for line in _entry(table.name, table.title, table.note)),
        "## Figures",
        "",
        *(line for figure in figures for line in _entry(figure.name, figure.title, figure.note)),
    ])  # fmt: skip


def _claim_list(claims: Iterable[Claim]) -> list[str]:
    return [f"* **{claim.place}**: {claim.says} *Found:* {claim.found}" for claim in claims]


def _sensitivities() -> list[str]:
    """Return both measures of every parameter, for both pairs of bodies."""
    bodies = (measures(equal_bodies=False), measures(equal_bodies=True))
    rows = []
    for name in bodies[0]["locally"].peak_force:
        row = [symbol(name)]
        for sensitivities in bodies:
            for sensitivity in sensitivities.values():
                responses = (sensitivity.peak_force[name], sensitivity.peak_displacement[name])
                row.append(" / ".join(f"{float(value):.4g}" for value in responses))
        rows.append(row)
    return [
        "## Sensitivity by two measures",
        "",
        "The paper ranks by a sensitivity Ω that it gives no formula for, and so its rankings are judged by both. "
        "Force / DCS. Locally: d ln P / d ln X and d ln δ / d ln X at the paper's values. Over the range: largest / "
        "smallest - 1 while one parameter runs through its range and the others are held (Table 5 has no range of R "
        "and ρ1, so there Table 4's are used).",
        "",
        *table(
            (
                "parameter",
                "on steel, locally",
                "on steel, range of Table 4",
                "equal bodies, locally",
                "equal bodies, range of Table 5",
            ),
            rows,
        ),
    ]


def _hertz_range(figures: Sequence[PaperFigure]) -> list[str]:
    highest = max(figures, key=lambda figure: figure.highest_strain)
    outside = [
        f"{figure.name} ({figure.highest_strain:.3g})" for figure in figures if figure.highest_strain > HERTZ_LIMIT
    ]
    return [
        "## Range of Hertz's theory",
        "",
        f"Hertz's small strains are taken to hold up to a displacement of {HERTZ_LIMIT:g} R. "
        + (f"Beyond it are: {', '.join(outside)}. " if outside else "No figure passes it. ")
        + f"The largest is {highest.highest_strain:.3g} R, in {highest.name}.",
        "",
    ]


def _entry(name: str, title: str, note: str) -> list[str]:
    kind, number, *_ = name.split("_")
    # Some pictures are of none of the paper's figures.
    heading = f"### {kind.capitalize()} {number.lstrip('0')}: {title}" if number.isdigit() else f"### {title}"
    return [heading, "", f"{note} ([data]({name}.csv))".strip(), "", f"![{title}]({name}.png)", ""]

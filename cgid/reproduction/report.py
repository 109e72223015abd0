"""The report in Markdown: what agrees with the paper and what does not, and every picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cgid.impact.pulse import HERTZ_LIMIT
from cgid.reproduction import finite_element
from cgid.reproduction.claims import Claim, all_claims, simulation
from cgid.reproduction.claims.claim import symbol
from cgid.reproduction.claims.influence import measures
from cgid.reproduction.impacts import RESTITUTIONS, THEORY_LABELS
from cgid.reproduction.paper_figure import PaperFigure
from cgid.reproduction.tables import PaperTable

_SOURCE = (
    "Yang, Zeng & Wan (2018), *Contact Response Analysis of Vertical Impact between Elastic Sphere and Elastic Half "
    "Space*, Shock and Vibration"
)
_SHOWN_THEORY = {"hertz": "K1 (Hertz)", "rigid-sphere": "K2", "series": "series (the paper's own)"}


def write_report(figures: Sequence[PaperFigure], tables: Sequence[PaperTable]) -> str:
    """Return the report; its verdicts are computed anew."""
    claims = all_claims()
    failing = [claim for claim in claims if not claim.holds]
    holding = [claim for claim in claims if claim.holds]
    return "\n".join([
        "# The paper, reproduced",
        "",
        f"The theoretical figures and tables of {_SOURCE}, computed, and {len(claims)} judgements of what it "
        f"says, by the numbers: {len(holding)} agree, {len(failing)} do not. (A ranking is judged once for each of two "
        "measures, and what must follow from an equation counts as said.) DCS is the displacement of the sphere's "
        "centre. Figures 4 to 6 compare the paper's three theories, all others use its own (`series`). `>>` is read as "
        "`>`: the paper does not say how much larger is much larger.",
        "",
        "What the paper leaves open and was chosen here: the axes of Figures 4 to 7, the impact speed of section 4 (it "
        "follows from the constants under Eq. 18), and the damping, restitution "
        f"{' and '.join(f'{value:g}' for value in RESTITUTIONS)} by the exact Hunt-Crossley relation. The paper's "
        "simulated curves (Figures 9 to 11, Table 3) cannot be made again, since their numbers are not printed.",
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
        *_finite_element(),
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


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(row)} |" for row in rows), ""]


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
        *_table(
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


def _finite_element() -> list[str]:
    wanted = simulation.finite_element_values()
    values = {theory: simulation.theory_values(theory) for theory in THEORY_LABELS}
    shown = ((1e-3, ".2f"), (1e3, ".3f"), (1e6, ".0f"))
    rows = []
    for number, row in enumerate(finite_element.IMPACTS):
        columns = [wanted[number], *(value[number] for value in values.values())]
        cells = [" / ".join(f"{c[k] * factor:{digits}}" for c in columns) for k, (factor, digits) in enumerate(shown)]
        rows.append([f"{row.sphere}, {row.velocity:g} m/s", *cells])
    judged = []
    for theory, table in simulation.errors().items():
        lists = (simulation.mean_errors(table), finite_element.ERRORS_OVER_TWENTY[theory])
        yardsticks = (simulation.squared_correlation(theory), simulation.determination(theory))
        judged.append([
            _SHOWN_THEORY[theory],
            *(" / ".join(f"{value:+.0%}" for value in values) for values in lists),
            *(" / ".join(f"{value:.3f}" for value in values) for values in yardsticks),
        ])  # fmt: skip
    return [
        "## What an independent finite-element run says of the three theories",
        "",
        "The finite-element figures are quoted from an independent axisymmetric run "
        f"({finite_element.METHOD}). That run is not part of this package and cannot be made again with it yet; the "
        "theories are computed here.",
        "",
        *_table(
            (
                "sphere, speed",
                "force [kN] FE / K1 / K2 / series",
                "DCS [mm] FE / K1 / K2 / series",
                "contact time [µs] FE / K1 / K2 / series",
            ),
            rows,
        ),
        "Errors of force / DCS / contact time, and two yardsticks for them:",
        "",
        *_table(
            (
                "theory",
                "mean error, these four",
                "over all twenty (quoted)",
                "squared correlation, these four",
                "1 - SSres/SStot, these four",
            ),
            judged,
        ),
        "Quoted from the same run:",
        "",
        *(f"* {fact}" for fact in finite_element.FACTS),
        "",
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
    number = name.split("_")[1].lstrip("0")
    heading = f"### {name.split('_')[0].capitalize()} {number}: {title}"
    return [heading, "", f"{note} ([data]({name}.csv))".strip(), "", f"![{title}]({name}.png)", ""]

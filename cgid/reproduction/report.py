"""The report in Markdown: claims with verdicts, finite elements against the theories, tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from cgid.physics import STIFFNESS_THEORIES
from cgid.physics.impact import HERTZ_LIMIT
from cgid.physics.materials import YANG2018_RADIUS, YANG2018_SPHERES
from cgid.reproduction.claims import all_claims
from cgid.reproduction.drawing import PaperFigure
from cgid.reproduction.judging import Claim, symbol
from cgid.reproduction.paper import RESTITUTIONS, THEORY_NAMES, paper_impact
from cgid.reproduction.parameter_claims import measures
from cgid.reproduction.study import (
    DAMPED,
    ELEMENT_SIZES,
    PENALTY_FACTOR,
    RESTITUTION,
    SOFT,
    UNDAMPED,
    Study,
    element_sizes,
)
from cgid.reproduction.tables import PaperTable
from cgid.reproduction.theories import (
    FILTERED,
    HIGH_CORRELATION,
    SHARED,
    WAVES,
    agreement,
    filtered_errors,
    of_simulation,
    of_theory,
    ripples,
    size_of_errors,
    sphere_part,
)
from cgid.validation import Floats

_SOURCE = (
    "Yang, Zeng & Wan (2018), *Contact Response Analysis of Vertical Impact between Elastic Sphere and Elastic Half "
    "Space*, Shock and Vibration"
)
#: Quantities of the finite-element section, with factor, format and head of their column.
_RESPONSES = (
    ("peak_force", 1e-3, ".2f", "force [kN]"),
    ("peak_displacement", 1e3, ".3f", "DCS [mm]"),
    ("contact_duration", 1e6, ".0f", "contact time [µs]"),
)
_NAMES = [name for name, *_ in _RESPONSES]
#: Smallest increase of an error between neighbouring speeds that counts as growth.
_GROWTH = 0.001
_HEAD = "force / DCS / contact time"
_SHOWN_GROUP = {
    UNDAMPED: "hard",
    SOFT: f"soft, {PENALTY_FACTOR:g} x bulk modulus / our elements",
    **{group: f"as soft as that of elements of {size * 1e3:g} mm" for group, size in ELEMENT_SIZES.items()},
}


def write_report(figures: Sequence[PaperFigure], tables: Sequence[PaperTable], study: Study) -> str:
    """Return the report; every verdict and sentence follows from the numbers."""
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
    # Some pictures have no counterpart in the paper.
    heading = f"### {kind.capitalize()} {number.lstrip('0')}: {title}" if number.isdigit() else f"### {title}"
    return [heading, "", f"{note} ([data]({name}.csv))".strip(), "", f"![{title}]({name}.png)", ""]


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(row)} |" for row in rows), ""]


# ---- finite elements against the three theories ---------------------------------------------------------------------


def finite_element_section(study: Study) -> list[str]:
    """Return the lines of the section on finite elements."""
    return [
        "## What finite elements say of the three theories",
        "",
        _verdict(study),
        "",
        _made(study),
        "",
        "All impacts without damping, finite elements (FE) and theories:",
        "",
        *_impacts(study),
        _yardsticks(study),
        "",
        *_errors(study),
        _excess(study),
        "",
        _energies(study),
        "",
        *_soft(study),
        *_waves(study),
    ]  # fmt: skip


def _verdict(study: Study) -> str:
    size = {theory: size_of_errors(study, theory, _NAMES) for theory in THEORY_NAMES}
    best = _nearest(study)
    said = ", ".join(f"{THEORY_NAMES[theory]} by {size[theory]:.0%}" for theory in sorted(size, key=lambda t: size[t]))
    text = (
        f"**They support {THEORY_NAMES[best]}.** Over {len(study.of(UNDAMPED))} impacts the theories err in "
        f"force, DCS and contact time by this much in the mean: {said}."
    )
    if best == "hertz":
        text += (
            " The paper takes K1 for a theory with one elastic body. It is not: its E holds the compliance of both, so "
            "that the paper's own theory, K1 and K2 in series, counts it twice."
        )
    return text


def _nearest(study: Study, group: str = UNDAMPED) -> str:
    """Return the theory with the smallest errors against a group."""
    return min(THEORY_NAMES, key=lambda theory: size_of_errors(study, theory, _NAMES, group))


def _made(study: Study) -> str:
    return (
        f"How they were made: {study.made}. The damped impacts have a Kelvin-Voigt sphere. That is another damping "
        "than one in the contact: the paper says that its own was applied while the bodies touch, and gives no number. "
        "The retardation time is chosen for each impact so that Kuwabara-Kono's restitution, with A = 3/2 b s, is "
        f"{RESTITUTION:g}, and {_range(study.values(DAMPED, 'restitution'), '.3f')} is what comes out. "
        "Small steps in the damped curves are nodes that come into contact one after the other. Without "
        "damping all energies together change by "
        f"{study.values(UNDAMPED, 'energy_error').max():.0e} of the impact energy at most, and momentum and "
        f"impulse differ by {study.values(UNDAMPED, 'momentum_error').max():.0e}. Strains are taken to be small, "
        "as in Hertz's theory: what larger ones do, neither can tell. `cgid reproduce --finite-element` makes it all "
        "anew."
    )


def _impacts(study: Study) -> list[str]:
    columns = {
        name: [of_simulation(study, name), *(of_theory(study, theory, name) for theory in THEORY_NAMES)]
        for name in _NAMES
    }
    rows = []
    for place, run in enumerate(study.of(UNDAMPED)):
        cells = [
            " / ".join(f"{column[place] * factor:{digits}}" for column in columns[name])
            for name, factor, digits, _ in _RESPONSES
        ]
        rows.append([f"{run.case.sphere}, {run.case.velocity:g} m/s", *cells])
    return _table(("sphere, speed", *(f"{head} FE / K1 / K2 / series" for *_, head in _RESPONSES)), rows)


def _yardsticks(study: Study) -> str:
    lowest = min(agreement(study, theory, name).squared_correlation for theory in THEORY_NAMES for name in _NAMES)
    is_high = (
        "is high for all of them and tells nothing" if lowest > HIGH_CORRELATION else "tells none of them from another"
    )
    return (
        f"Errors of {_HEAD} over all {len(study.of(UNDAMPED))}, and two yardsticks for them. Squared correlation "
        f"is the paper's (Table 3). All theories have the same powers of the speed, so that it {is_high}. "
        "1 - SSres/SStot sees a wrong factor."
    )


def _errors(study: Study) -> list[str]:
    rows = []
    for theory, shown in THEORY_NAMES.items():
        found = [agreement(study, theory, name) for name in _NAMES]
        damped = [agreement(study, theory, name, DAMPED) for name in _NAMES]
        rows.append([
            shown,
            *(" / ".join(f"{value.error:+.1%}" for value in values) for values in (found, damped)),
            " / ".join(f"{value.squared_correlation:.5f}" for value in found),
            " / ".join(f"{value.determination:.3f}" for value in found),
        ])  # fmt: skip
    heads = ("theory", "mean error", "against the damped", "squared correlation", "1 - SSres/SStot")
    return _table(heads, rows)


def _excess(study: Study) -> str:
    """Return a sentence on whether, and how, K1's error grows with the contact."""
    errors = _k1_errors(study)
    said = f"in force {errors[0]:+.1%} at the lowest speed and {errors[-1]:+.1%} at the highest, in the spheres' mean"
    if np.diff(np.abs(errors)).min() <= _GROWTH:
        return f"K1's error does not grow with the contact: it is {said}."
    texts = []
    for sphere in YANG2018_SPHERES:
        stiffness = float(paper_impact(sphere, 1.0, "hertz").contact_stiffness)
        force, displacement = (
            of_simulation(study, name, sphere=sphere) for name in ("peak_force", "peak_displacement")
        )
        excess = force / (stiffness * displacement**1.5) - 1
        texts.append(f"{_range(excess / np.sqrt(displacement / YANG2018_RADIUS), '.2f')} (sphere {sphere})")
    return (
        f"K1's error is one of finite size, it grows with the contact: {said}. At the peaks P = K1 δ^(3/2) (1 + c "
        f"√(δ/R)) with c = {', '.join(texts)}. "
        "How much of it is due to the small strains of the finite elements, and so not nature's, "
        "these runs cannot tell: a fact to know, not a law to build in."
    )


def _k1_errors(study: Study) -> Floats:
    """Return K1's error in force at each speed, averaged over the spheres."""
    errors = of_theory(study, "hertz", "peak_force") / of_simulation(study, "peak_force") - 1
    return np.asarray(errors.reshape(len(YANG2018_SPHERES), -1).mean(axis=0), np.float64)


def _energies(study: Study) -> str:
    in_plate = study.values(UNDAMPED, "peak_plate_energy").reshape(len(YANG2018_SPHERES), -1)
    in_sphere = study.values(UNDAMPED, "peak_sphere_energy").reshape(len(YANG2018_SPHERES), -1)
    part = in_plate / (in_sphere + in_plate)
    texts = [
        f"{values.min():.2%} to {values.max():.2%} (sphere {sphere}; Hertz {1 - sphere_part(SHARED, sphere):.2%})"
        for sphere, values in zip(YANG2018_SPHERES, part, strict=True)
    ]
    return (
        "Of the elastic energy the plate takes "
        + ", ".join(texts)
        + ". In the paper's words it would be nothing (K1), "
        "all (K2) or 3/7 (series). Hertz's share is that of the compliance: one pressure works on both bodies, over "
        "displacements that go with (1 - ν²)/E."
    )


def _soft(study: Study) -> list[str]:
    rows = []
    for group, shown in _SHOWN_GROUP.items():
        cells = [" / ".join(f"{_mean_ratio(study, group, name):+.0%}" for name in _NAMES)]
        for theory in ("hertz", "series"):
            found = [agreement(study, theory, name, group) for name in _NAMES]
            cells += [
                " / ".join(f"{value.error:+.0%}" for value in found),
                " / ".join(f"{value.determination:.2f}" for value in found),
            ]
        rows.append([shown, *cells])
    return [
        "### A soft contact",
        "",
        "Many explicit programs let surfaces enter each other and press them back, with pressure = factor x bulk "
        "modulus / element size x depth; .1 is the factor of LS-DYNA unless told otherwise. The paper's sphere has "
        "elements of 2 mm, finer ones at the contact; ours there have "
        f"{_range([size * 1e3 for size in element_sizes()], '.2f')} mm. Such a contact is one more spring in "
        "series, which belongs to the mesh and not to the bodies. The last rows have a contact as soft as that of "
        f"elements of {' or '.join(f'{size * 1e3:g}' for size in ELEMENT_SIZES.values())} mm; the mesh is ours. "
        f"What it does to the {len(study.of(SOFT))} impacts, and where the theories then stand ({_HEAD}):",
        "",
        *_table(
            (
                "contact",
                "against the hard one",
                "error of K1",
                "1 - SSres/SStot of K1",
                "error of series",
                "1 - SSres/SStot of series",
            ),
            rows,
        ),
        _softened(study),
        "",
        _contact_of_the_paper(study),
        "",
    ]


def _softened(study: Study) -> str:
    """Return a sentence on whether a soft contact moves the finite elements from K1 to the paper's theory."""
    softened = [group for group in _SHOWN_GROUP if group != UNDAMPED]
    moves = _nearest(study) == "hertz" and "series" in [_nearest(study, group) for group in softened]
    if not moves:
        return "A soft contact does not move the finite elements from K1 to the paper's theory."
    furthest = max(agreement(study, "series", "peak_force", group).error for group in softened)
    return (
        f"A soft contact moves the finite elements from K1 to the paper's theory{' and beyond' if furthest > 0 else ''}"
        ": nothing else was changed. That makes it a likely reason for the agreement that the paper finds with its own "
        "simulation. It is not proven: the paper gives no number for the stiffness of its contact."
    )


def _contact_of_the_paper(study: Study) -> str:
    text = (
        "What the paper does say of its contact (section 3.1): the stiffness was set by the one that Hertz's theory "
        "gives a contact, and damping was applied while the bodies touch. Numbers and details are missing."
    )
    if _nearest(study) == "hertz":
        own = (STIFFNESS_THEORIES["hertz"] / STIFFNESS_THEORIES["series"]) ** (2 / 3)
        text += (
            " If a spring of Hertz's stiffness stands between the meshed bodies, which have that stiffness already, "
            "the simulation counts the compliance twice, much as the series theory does: at one force it has 2 times "
            f"K1's DCS, the series theory {own:.2f} times."
        )
    return text


def _mean_ratio(study: Study, group: str, name: str) -> float:
    return float(np.mean(of_simulation(study, name, group) / of_simulation(study, name) - 1))


def _waves(study: Study) -> list[str]:
    of_force, of_centre = (np.median(ripples(study, name)) > WAVES for name in ("force", "centre_node_force"))
    leaves = np.abs(filtered_errors(study, 4)).max() <= FILTERED
    found = "; ".join(f"at {edge}/T {_range(filtered_errors(study, edge), '+.1%')}" for edge in (4, 5))
    return [
        "### The vibration waves",
        "",
        f"The contact force {'has waves' if of_force else 'is smooth'}. Mass x acceleration of the node at the "
        f"sphere's centre (Figure 10) {'has' if of_centre else 'does not have'} the paper's dense vibration waves. "
        f"An FFT low-pass at 4/T {'leaves' if leaves else 'does not leave'} the maximum of the contact force: the peak "
        f"that is left, against that of the contact force, is {found}.",
        "",
    ]


def _range(values: Iterable[float], digits: str) -> str:
    values = list(values)
    return f"{min(values):{digits}} to {max(values):{digits}}"

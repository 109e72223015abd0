"""Claims of sections 2 and 3: the three theories, Tables 1 and 2, Figures 4 to 7, hysteresis loops."""

from __future__ import annotations

import numpy as np

from cgid.physics import RIGID, STIFFNESS_THEORIES, Impact, contact_stiffness
from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from cgid.reproduction import impacts, paper
from cgid.reproduction.claims.claim import Claim, judged_exponential, judged_ordering, powers, written
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.impacts import paper_impact
from cgid.reproduction.tables import computed_contact
from cgid.validation import Floats


def contact_claims() -> list[Claim]:
    """Return the claims of sections 2 and 3 but for those on the simulation, judged."""
    return [
        *_formulas(),
        *_printed_tables(),
        *_bodies(),
        *_figures_4_to_6(),
        *_figure_7(),
        _start_gap(),
        _loops(),
    ]


def _formulas() -> list[Claim]:
    sphere = YANG2018_SPHERES[1]
    bodies = [(float(np.asarray(m.youngs_modulus)), float(np.asarray(m.poisson_ratio))) for m in (sphere, STEEL)]
    as_printed = 1 / sum(1 - nu**2 / modulus for modulus, nu in bodies)
    modulus, stiffness = computed_contact(1)
    printed = float(paper.TABLE_1.reduced_modulus) * 1e9
    root = np.sqrt(YANG2018_RADIUS)
    second = 32 * np.sqrt(3) * root / 27 * modulus
    series = paper_impact(1, np.array(paper.VELOCITIES))
    worst = max(
        float(np.max(np.abs(found / expected - 1)))
        for found, expected in zip(_eq_12_13(series) + _eq_17_18(series), 2 * _peaks(series), strict=True)
    )
    ratio = second / stiffness
    return [
        Claim(
            "reduced modulus without brackets",
            "Section 2, under Eq. 8",
            "1/E = (1 - ν1²/E1) + (1 - ν2²/E2).",
            f"As printed, sphere 1 on the plate has E = {as_printed:.3g} Pa; with 1/E = (1 - ν1²)/E1 + (1 - ν2²)/E2 it "
            f"has {modulus / 1e9:.5g} GPa, and Table 1 says {printed / 1e9:.5g} GPa. Eq. 17 and 18 are printed right.",
            bool(np.isclose(as_printed, printed, rtol=1e-4)),
        ),
        Claim(
            "two forms of K2",
            "Section 2, under Eq. 8",
            "K2 = 32√3 √R/27 E = 8√3/9 K1.",
            f"32√3 √R/27 E is {ratio:.12g} K1, 8√3/9 is {8 * np.sqrt(3) / 9:.12g}.",
            bool(np.isclose(ratio, 8 * np.sqrt(3) / 9, rtol=1e-12)),
        ),
        Claim(
            "own theory is two springs in series",
            "Eq. 9 to 13, 17 and 18",
            "Eq. 12, 13 and Eq. 17, 18 give DCS and force of the paper's own theory.",
            f"Both pairs are the stiffness K1 / 1.75^(3/2) of the springs K1 and K2 in series, to {worst:.0e}.",
            worst < 1e-12,
        ),
    ]


def _peaks(impact: Impact) -> tuple[Floats, Floats]:
    return impact.peak_displacement, impact.peak_force


def _eq_12_13(impact: Impact) -> tuple[Floats, Floats]:
    first = 4 / 3 * np.sqrt(impact.reduced_radius) * impact.reduced_modulus
    second = 8 * np.sqrt(3) / 9 * first
    energy = (
        5 * impact.reduced_mass * np.square(impact.velocity) / (4 * (first + first ** (5 / 3) * second ** (-2 / 3)))
    )
    return energy**0.4 * (1 + (first / second) ** (2 / 3)), first * energy**0.6


def _eq_17_18(impact: Impact) -> tuple[Floats, Floats]:
    radius, density = impact.reduced_radius, np.asarray(impact.sphere.material.density)
    compliance, square = 1 / impact.reduced_modulus, 5 * np.square(impact.velocity) / 7
    volume = 4 * np.pi / 3
    displacement = 7 / 4 * square**0.4 * volume**0.4 * radius * density**0.4 * (9 / 16) ** 0.2 * compliance**0.4
    force = (16 / 9) ** 0.2 * compliance**-0.4 * square**0.6 * density**0.6 * volume**0.6 * radius**2
    return np.asarray(displacement), np.asarray(force)


def _printed_tables() -> list[Claim]:
    claims = []
    for table, rows in (("Table 1", {1: paper.TABLE_1}), ("Table 2", paper.TABLE_2)):
        off = []
        for number, printed in rows.items():
            modulus, stiffness = computed_contact(number)
            if f"{modulus / 1e9:#.5g}" != printed.reduced_modulus:
                off.append(f"E of sphere {number} is {modulus / 1e9:.6g} GPa")
            if f"{stiffness:.4e}" != f"{float(printed.stiffness):.4e}":
                off.append(f"K of sphere {number} is {stiffness:.6g}")
        claims.append(
            Claim(
                f"{table} digits",
                table,
                "E and K of every row follow from its inputs (K is K1).",
                "; ".join(off) or f"All {2 * len(rows)} numbers, to the five digits printed.",
                not off,
            )
        )
    return claims


def _bodies() -> list[Claim]:
    """Whether K1 and the series theory are what the paper takes them for."""
    softer = {}
    for number, sphere in YANG2018_SPHERES.items():
        rigid = float(1 / sphere.plane_strain_compliance)
        softer[number] = 1 - computed_contact(number)[0] / rigid
    impact = paper_impact(1, impacts.SECTION_4_VELOCITY, "hertz")
    on_rigid = Impact(
        sphere=impact.sphere, target=RIGID, velocity=impact.velocity, stiffness="hertz", dissipation=impact.dissipation
    )
    stiff = Material(density=7850.0, youngs_modulus=1e30, poisson_ratio=0.3)
    limit = paper_impact(1, impacts.SECTION_4_VELOCITY, "series", target=stiff)
    ratio = float(limit.contact_stiffness / on_rigid.contact_stiffness)
    second = paper_impact(1, impacts.SECTION_4_VELOCITY, "rigid-sphere")
    of_rigid_sphere = float(
        second.contact_stiffness / contact_stiffness(YANG2018_RADIUS, 1 / STEEL.plane_strain_compliance, "hertz")
    )
    return [
        Claim(
            "K1 has one elastic body",
            "Section 2, text of Figure 6",
            "The traditional theory, K1, takes only one of the two bodies as elastic (K of Table 1 and 2).",
            "The E in K1 holds the compliance of both. On a rigid surface K1 would be larger: the printed one is "
            + ", ".join(f"{part:.1%} below it for sphere {number}" for number, part in softer.items())
            + ".",
            max(softer.values()) < 1e-4,
        ),
        Claim(
            "K2 has one elastic body",
            "Section 2, Eq. 2",
            "K2 is the stiffness of a rigid sphere on an elastic half space.",
            f"K2 of sphere 1 is {of_rigid_sphere:.3g} of the stiffness that Hertz gives a rigid sphere on this plate, "
            "4/3 √R E2/(1 - ν2²): its E holds the sphere's compliance, too.",
            abs(of_rigid_sphere - 1) < 1e-4,
        ),
        Claim(
            "series theory has K1 as its limit",
            "Eq. 10 to 13 (must follow, not said)",
            "On a plate that does not give, E2 towards infinity, the paper's theory becomes that of an elastic sphere "
            "on a rigid surface.",
            f"It becomes {ratio:.4f} of that stiffness: the compliance is counted twice.",
            abs(ratio - 1) < 1e-6,
        ),
    ]


def _figures_4_to_6() -> list[Claim]:
    claims = []
    force = FIGURES["figure_05"]().data.pivot(index="velocity", columns="theory", values="peak_force")
    displacement = FIGURES["figure_04"]().data.pivot(index="velocity", columns="theory", values="peak_displacement")
    factor = displacement["series"] / displacement["hertz"], force["series"] / force["hertz"]
    for place, what, unit, table, ordering in (
        ("Figure 4", "DCS", "mm", displacement * 1e3, paper.THEORIES_BY_DISPLACEMENT),
        ("Figure 5", "maximum force", "kN", force / 1e3, paper.THEORIES_BY_FORCE),
    ):
        verdicts = [judged_ordering(ordering, row) for row in table.to_dict("records")]
        rising = all((np.diff(table[theory]) > 0).all() for theory in ordering.names)
        claims.append(
            Claim(
                f"{what} of the theories",
                place,
                f"{what} at the same speed: {written(ordering)}; it grows with the speed.",
                f"At {table.index[-1]:g} m/s: {verdicts[-1][1]} {unit}; "
                f"so at {sum(holds for holds, _ in verdicts)} of {len(verdicts)} speeds.",
                rising and all(holds for holds, _ in verdicts),
            )
        )
    holds, text = judged_ordering(paper.THEORIES_BY_FORCE, STIFFNESS_THEORIES)
    own = FIGURES["figure_06"]().data.query("theory == 'series'")
    exponential, course = judged_exponential(own["peak_displacement"].to_numpy(), own["peak_force"].to_numpy())
    return [
        *claims,
        Claim(
            "maximum force of the theories at the same DCS",
            "Figure 6",
            f"Maximum force at the same DCS: {written(paper.THEORIES_BY_FORCE)}.",
            f"It goes with K: {text} times K1.",
            holds,
        ),
        Claim(
            "own theory against the traditional one",
            "Section 2, text of Figure 6",
            "The paper's theory predicts a larger DCS and a smaller force than the traditional theory.",
            f"DCS x {factor[0].mean():.4f} and force x {factor[1].mean():.4f} of K1, at every speed.",
            bool((factor[0] > 1).all() and (factor[1] < 1).all()),
        ),
        Claim(
            "Figure 6 is exponential",
            "Section 2, text of Figure 6",
            "The contact force increases exponentially with the DCS.",
            course,
            exponential,
        ),
    ]


def _figure_7() -> list[Claim]:
    data = FIGURES["figure_07"]().data
    height, displacement, force = (data[c].to_numpy() for c in ("drop_height", "peak_displacement", "peak_force"))
    found = powers(height, displacement), powers(height, force)
    exponential = [judged_exponential(height, response) for response in (displacement, force)]
    return [
        Claim(
            "powers of the drop height",
            "Figure 7",
            "DCS and force grow with the drop height in the power of 2/5 and 3/5.",
            f"Powers {found[0].mean():.6f} and {found[1].mean():.6f}.",
            bool(np.allclose(found[0], 0.4, atol=1e-9) and np.allclose(found[1], 0.6, atol=1e-9)),
        ),
        Claim(
            "Figure 7 is exponential",
            "Section 2, text of Figure 7",
            "DCS and force increase exponentially with the drop height.",
            f"DCS: {exponential[0][1]} Force: {exponential[1][1]}",
            all(holds for holds, _ in exponential),
        ),
    ]


def _start_gap() -> Claim:
    velocity = np.array(paper.VELOCITIES)
    gain = np.sqrt(velocity**2 + 2 * paper.GRAVITY * paper.START_GAP) - velocity
    return Claim(
        "gap at the start",
        "Section 3.1",
        "Over the gap of 0.326 mm the sphere gains less than 0.01 m/s, less than 1/200 of its speed.",
        f"At most {gain.max():.4f} m/s, {(gain / velocity).max():.1e} of the speed.",
        bool(gain.max() < 0.01 and (gain / velocity).max() < 1 / 200),
    )


def _loops() -> Claim:
    data = FIGURES["figure_11_loops"]().data
    closed, errors = True, []
    for (number, restitution, velocity), loop in data.groupby(["sphere", "restitution", "velocity"]):
        force, displacement = loop["force"].to_numpy(), loop["displacement"].to_numpy()
        ends = np.abs([force[0] / force.max(), force[-1] / force.max(), displacement[-1] / displacement.max()])
        closed &= bool(ends.max() < 1e-6)
        energy = 0.5 * float(paper_impact(number, velocity).reduced_mass) * velocity**2
        errors.append(float(np.trapezoid(force, displacement)) / (energy * (1 - restitution**2)) - 1)
    worst = max(map(abs, errors))
    return Claim(
        "closed hysteresis loops",
        "Figure 11",
        "Force-displacement curves of damped impacts are closed loops, because energy is dissipated.",
        f"All {len(errors)} loops {'are' if closed else 'are not all'} closed, and their area is the energy lost, "
        f"(1 - e²) m v²/2, to {worst:.1e} (201 points a loop).",
        closed and worst < 1e-3,
    )

"""A claim of the paper, and how claims are judged: by code, none by hand.

Claims of sections 2 and 3: the three theories, Tables 1 and 2, Figures 4 to 7, hysteresis loops.

Claims that rest on the paper's simulation, judged by the finite elements.

Claims of section 4 and conclusions 3 to 5: what each parameter does, and how much it matters.

Claims of section 5: how the four spheres differ.

What the paper says, against what is computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid.physics import RIGID, STIFFNESS_THEORIES, Impact, contact_stiffness
from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from cgid.physics.sensitivity import Sensitivity, local_sensitivity, range_influence
from cgid.reproduction import paper
from cgid.reproduction.drawing import SYMBOLS
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.paper import (
    OWN_THEORY,
    SECTION_4_VELOCITY,
    SECTION_5_RESTITUTION,
    SECTION_5_VELOCITY,
    THEORY_LABELS,
    Ordering,
    paper_impact,
    table_4_impact,
    table_5_impact,
)
from cgid.reproduction.study import DAMPED, RESTITUTION, UNDAMPED, Study, shipped_study
from cgid.reproduction.tables import computed_contact
from cgid.reproduction.theories import (
    FILTERED,
    HIGH_CORRELATION,
    WAVES,
    agreement,
    filtered_errors,
    of_simulation,
    ripples,
    size_of_errors,
)
from cgid.validation import Floats

#: Two values are "equal" if they differ by less than this part.
_EQUAL = 1e-9
#: An exponential's rate changes by less than this part along the curve.
_STEADY = 0.05


@dataclass(frozen=True)
class Claim:
    """One statement of the paper.

    Parameters
    ----------
    name : str
        Short and unique.
    place : str
        Where the paper says it.
    says : str
    found : str
        What was computed.
    holds : bool
        Whether both agree.
    """

    name: str
    place: str
    says: str
    found: str
    holds: bool


def judged_ordering(ordering: Ordering, sizes: Mapping[str, ArrayLike]) -> tuple[bool, str]:
    """Return whether sizes are ordered as said, and a text with the sizes and with every link that fails.

    `>>` is read as `>`: the paper does not say how much larger is "much larger".
    """
    size = {name: abs(float(np.asarray(sizes[name]))) for name in ordering.names}
    failing = []
    for first, relation, second in zip(ordering.names, ordering.relations, ordering.names[1:], strict=False):
        equal = abs(size[first] - size[second]) <= _EQUAL * max(size[first], size[second])
        if not (equal if relation == "=" else size[first] > size[second] and not equal):
            failing.append(f"{symbol(first)} {relation} {symbol(second)}")
    falling = sorted(size, key=lambda name: -size[name])
    text = ", ".join(f"{symbol(name)} {size[name]:.4g}" for name in falling)
    return not failing, text + (f" (not: {', '.join(failing)})" if failing else "")


def written(ordering: Ordering) -> str:
    """Return an ordering as the paper writes it."""
    words = [symbol(ordering.names[0])]
    for relation, name in zip(ordering.relations, ordering.names[1:], strict=True):
        words += [relation, symbol(name)]
    return " ".join(words)


def symbol(name: str) -> str:
    """Return the symbol of a parameter or a theory, or a sphere's number as the paper writes it."""
    return SYMBOLS.get(name, f"{name}#")


def powers(x: Floats, y: Floats) -> Floats:
    """Return the local power `d ln y / d ln x` between neighbouring points: a constant one makes a power law."""
    return np.asarray(np.diff(np.log(y)) / np.diff(np.log(x)))


def judged_exponential(x: Floats, y: Floats) -> tuple[bool, str]:
    """Return whether y is an exponential of x, that is `d ln y / dx` the same along the curve, and what was found."""
    rates, power = np.abs(np.diff(np.log(y)) / np.diff(x)), powers(x, y)
    factor = float(rates.max() / rates.min())
    text = (
        f"d ln y / dx, constant for an exponential, changes by a factor of {factor:.3g} along the curve; the local "
        f"power d ln y / d ln x, constant for a power law, goes from {power[0]:.4f} to {power[-1]:.4f}."
    )
    return factor < 1 + _STEADY, text


def trend(x: Floats, y: Floats) -> tuple[str, str]:
    """Return whether y "rises", "falls" or "neither", and whether its steepness "grows", "shrinks" or "neither"."""
    slopes = np.diff(y) / np.diff(x)
    steepness = np.diff(np.abs(slopes))
    course = "rises" if (slopes > 0).all() else "falls" if (slopes < 0).all() else "neither"
    change = "grows" if (steepness > 0).all() else "shrinks" if (steepness < 0).all() else "neither"
    return course, change


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
    impact = paper_impact(1, SECTION_4_VELOCITY, "hertz")
    on_rigid = Impact(
        sphere=impact.sphere, target=RIGID, velocity=impact.velocity, stiffness="hertz", dissipation=impact.dissipation
    )
    stiff = Material(density=7850.0, youngs_modulus=1e30, poisson_ratio=0.3)
    limit = paper_impact(1, SECTION_4_VELOCITY, "series", target=stiff)
    ratio = float(limit.contact_stiffness / on_rigid.contact_stiffness)
    second = paper_impact(1, SECTION_4_VELOCITY, "rigid-sphere")
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


#: What the paper compares in Figure 10 and its conclusions.
_RESPONSES = ("peak_force", "peak_displacement")
#: A prediction is close to the simulation within this part of it.
_CLOSE = 0.1
#: Powers of the speed are alike within this.
_SAME_POWER = 0.05


def simulation_claims(study: Study) -> list[Claim]:
    """Return the claims that rest on the paper's simulation, judged."""
    return [
        *_theories(study),
        _yardstick(study),
        _pressure(study),
        _trend(study),
        *_waves(study),
        _compression(study),
        *_spheres(study),
    ]


def _theories(study: Study) -> list[Claim]:
    groups = (UNDAMPED, DAMPED)
    mean = {
        (theory, group): [agreement(study, theory, name, group).error for name in _RESPONSES]
        for theory in THEORY_LABELS
        for group in groups
    }
    own, damped = (mean[OWN_THEORY, group] for group in groups)
    size = {theory: [size_of_errors(study, theory, _RESPONSES, group) for group in groups] for theory in THEORY_LABELS}
    return [
        Claim(
            "own theory is close to the simulation",
            "Figure 10, conclusion 1",
            "The paper's theory agrees with the simulation in maximum force and DCS.",
            f"Against finite elements ({len(study.of(UNDAMPED))} impacts) it errs by {own[0]:+.0%} in force and "
            f"{own[1]:+.0%} in DCS (close: within {_CLOSE:.0%}); against damped ones by {damped[0]:+.0%} and "
            f"{damped[1]:+.0%}.",
            max(abs(value) for value in own) <= _CLOSE,
        ),
        Claim(
            "own theory is more accurate",
            "Abstract, conclusion 2",
            "The paper's theory predicts force and DCS more accurately than the traditional theory.",
            "Mean size of the errors against the finite elements: "
            + ", ".join(f"{symbol(theory)} {values[0]:.0%}" for theory, values in size.items())
            + " (against damped ones: "
            + ", ".join(f"{values[1]:.0%}" for values in size.values())
            + ").",
            size["series"][0] < min(size["hertz"][0], size["rigid-sphere"][0]),
        ),
        Claim(
            "traditional force is too large",
            "Conclusion 2",
            "The maximum contact force of the traditional theory is too large.",
            f"Against the finite elements K1 gives {mean['hertz', UNDAMPED][0]:+.0%}, K2 "
            f"{mean['rigid-sphere', UNDAMPED][0]:+.0%}. (Damping, which none of the theories has, lowers the "
            f"force: against damped impacts of restitution {RESTITUTION:g} K1 gives "
            f"{mean['hertz', DAMPED][0]:+.0%}.)",
            min(mean[theory, UNDAMPED][0] for theory in ("hertz", "rigid-sphere")) > 0,
        ),
    ]


def _yardstick(study: Study) -> Claim:
    found = {theory: [agreement(study, theory, name) for name in _RESPONSES] for theory in THEORY_LABELS}
    least = {theory: min(value.squared_correlation for value in values) for theory, values in found.items()}
    fooled = [
        theory
        for theory, values in found.items()
        if least[theory] > HIGH_CORRELATION and max(abs(value.error) for value in values) > _CLOSE
    ]
    return Claim(
        "squared correlation as a yardstick",
        "Section 3.2, Table 3",
        "A squared correlation above 0.96 between theory and simulation shows that the theory is right.",
        f"With the {len(study.of(UNDAMPED))} finite-element impacts it is at least "
        + ", ".join(f"{value:.5f} ({symbol(theory)})" for theory, value in least.items())
        + ": it does not see a wrong factor.",
        not fooled,
    )


def _pressure(study: Study) -> Claim:
    printed = [row["peak_pressure"] for row in paper.TABLE_3.values()]
    found = [agreement(study, OWN_THEORY, "peak_pressure", sphere=n).squared_correlation for n in YANG2018_SPHERES]
    return Claim(
        "pressure is uncertain",
        "Section 3.2, Table 3",
        f"Contact pressure is so uncertain that its squared correlation is only {min(printed):g} to {max(printed):g}.",
        f"With the finite elements it is {min(found):.5f} to {max(found):.5f}, as for force and DCS: it is the "
        "paper's simulation that scatters, not the pressure.",
        max(found) < HIGH_CORRELATION,
    )


def _trend(study: Study) -> Claim:
    powers = {}
    for name in _RESPONSES:
        logarithms = np.log(of_simulation(study, name).reshape(len(YANG2018_SPHERES), -1))
        powers[name] = np.polyfit(np.log(paper.VELOCITIES), logarithms.T, 1)[0]
    theory = {"peak_force": 1.2, "peak_displacement": 0.8}
    return Claim(
        "same trends in simulation and theory",
        "Section 3.2, conclusion 1",
        "Simulated responses change with the speed as the theoretical ones do.",
        f"Force grows with the speed in the power of {powers['peak_force'].min():.3f} to "
        f"{powers['peak_force'].max():.3f} (theories: 6/5), DCS of {powers['peak_displacement'].min():.3f} to "
        f"{powers['peak_displacement'].max():.3f} (4/5). Every theory here has these powers.",
        all(np.abs(found - theory[name]).max() < _SAME_POWER for name, found in powers.items()),
    )


def _waves(study: Study) -> list[Claim]:
    force, centre = (ripples(study, name) for name in ("force", "centre_node_force"))
    at_4, at_5 = (np.abs(filtered_errors(study, edge)) for edge in (4, 5))
    return [
        Claim(
            "contact force has dense vibration waves",
            "Section 3.2, text of Figure 10",
            "The contact force shows dense vibration waves instead of a smooth curve.",
            "Largest distance from its own low-pass at 10/T, over the peak, in the median impact: contact force "
            f"{np.median(force):.1%} (worst of {force.size}: {force.max():.1%}), mass x acceleration of the sphere's "
            f"centre {np.median(centre):.0%} (waves: {WAVES:.0%}). The waves are those of the sphere, not of the "
            "contact.",
            bool(np.median(force) > WAVES),
        ),
        Claim(
            "FFT filter takes the waves off",
            "Section 3.2, text of Figure 10",
            "Behind an FFT filter the simulated force has the right maximum. (The paper does not say which filter.)",
            f"Mass x acceleration of the centre behind a low-pass at 4/T has the contact force's maximum within "
            f"{at_4.max():.1%} in all {at_4.size} impacts; at 5/T it is off by up to {at_5.max():.1%}.",
            bool(at_4.max() <= FILTERED),
        ),
    ]


def _compression(study: Study) -> Claim:
    own = {group: _work(study, group, OWN_THEORY) for group in (UNDAMPED, DAMPED)}
    hertz = {group: float(np.mean(_work(study, group, "hertz"))) for group in own}
    shown = {group: f"{min(parts):.0%} to {max(parts):.0%}" for group, parts in own.items()}
    return Claim(
        "simulated loops lie around the own theory",
        "Figure 11",
        "During compression the simulated force fluctuates around the curve of the paper's theory.",
        f"Up to the largest DCS of each impact the theory's curve takes {shown[UNDAMPED]} of the work that the "
        f"undamped finite elements take, {shown[DAMPED]} with damping (close: within {_CLOSE:.0%}); K1's takes "
        f"{hertz[UNDAMPED]:.0%} and {hertz[DAMPED]:.0%} in the mean.",
        max(abs(part - 1) for parts in own.values() for part in parts) <= _CLOSE,
    )


def _work(study: Study, group: str, theory: str) -> list[float]:
    """Return the work under a theory's curve over that under the simulated one during compression, of each impact."""
    parts = []
    for run in study.of(group):
        last = int(np.argmax(run.courses["displacement"]))
        force, displacement = (run.courses[name][: last + 1] for name in ("force", "displacement"))
        stiffness = float(paper_impact(run.case.sphere, run.case.velocity, theory).contact_stiffness)
        parts.append(0.4 * stiffness * displacement[-1] ** 2.5 / float(np.trapezoid(force, displacement)))
    return parts


def _spheres(study: Study) -> list[Claim]:
    """Whether the simulated spheres are ordered as in Figures 16 and 17."""
    places = {
        "peak_force": ("Figure 16", "maximum force", 1e-3, "kN"),
        "peak_displacement": ("Figure 17", "DCS", 1e3, "mm"),
    }
    claims = []
    for name, (place, label, factor, unit) in places.items():
        ordering = paper.SPHERES_BY[name]
        judged = {
            group: judged_ordering(
                ordering,
                {
                    str(run.case.sphere): factor * run.numbers[name]
                    for run in study.of(group)
                    if run.case.velocity == SECTION_5_VELOCITY
                },
            )
            for group in (UNDAMPED, DAMPED)
        }
        claims.append(
            Claim(
                f"simulated spheres by {name}",
                place,
                f"Simulated, by {label} at {SECTION_5_VELOCITY:g} m/s: {written(ordering)}.",
                "; ".join(f"{group}: {text}" for group, (_, text) in judged.items()) + f" [{unit}].",
                all(holds for holds, _ in judged.values()),
            )
        )
    return claims


OVER_RANGE = "over the range"
_RESPONSES_influence = {"peak_displacement": "DCS", "peak_force": "force"}


def influence_claims() -> list[Claim]:
    """Return the claims of section 4 and of conclusions 3 to 5, judged."""
    return [
        _constants(),
        *_proportional(),
        *_trends(),
        _poisson_power(),
        *_pair("E1 matters more than density", "Section 4, text of Figure 12", "youngs_modulus > density"),
        *_ordering("sphere's parameters", "Section 4 (Figure 12) and section 5", paper.SPHERE_ORDERING),
        *_ordering("plate's parameters", "Section 4 (Figure 13)", paper.PLATE_ORDERING),
        *_figure_14(),
        *_ordering("conclusion 4", "Section 4 and conclusion 4 (Table 5)", paper.CONCLUSION_4, equal_bodies=True),
        *_figure_15(),
        _compliances(),
        *_ordering("conclusion 5", "Section 4 and conclusion 5 (Table 4)", paper.CONCLUSION_5),
    ]


def measures(*, equal_bodies: bool) -> dict[str, Sensitivity]:
    """Return both measures of sensitivity for the bodies of Table 5 (equal) or 4; where 5 has no range, 4 has it."""
    impact = table_5_impact() if equal_bodies else table_4_impact()
    ranges = paper.TABLE_4 | paper.TABLE_5 if equal_bodies else paper.TABLE_4
    values = {name: values.values for name, values in ranges.items()}
    return {"locally": local_sensitivity(impact), OVER_RANGE: range_influence(impact, values)}


def _ordering(name: str, place: str, ordering: paper.Ordering, *, equal_bodies: bool = False) -> list[Claim]:
    claims = []
    for measure, sensitivity in measures(equal_bodies=equal_bodies).items():
        judged = {r: judged_ordering(ordering, getattr(sensitivity, r)) for r in _RESPONSES_influence}
        note = _where_held() if equal_bodies and measure == OVER_RANGE else ""
        claims.append(
            Claim(
                f"{name}, {measure}",
                place,
                f"Sensitivity of DCS and force, {measure}: {written(ordering)}.",
                "; ".join(f"{_RESPONSES_influence[r]}: {text}" for r, (_, text) in judged.items()) + f".{note}",
                all(holds for holds, _ in judged.values()),
            )
        )
    return claims


def _where_held() -> str:
    """Return what a range of E1 does to the force of equal bodies when E2 is not held at Table 5's value."""
    surface = _surface("figure_14", "youngs_modulus", "target_youngs_modulus", "peak_force")
    highest, together = surface[:, -1], surface.diagonal()
    return (
        f" With E2 held at its highest value instead, E1 moves the force by {highest.max() / highest.min() - 1:.4g}; "
        f"both moduli together by {together.max() / together.min() - 1:.4g}."
    )


def _pair(name: str, place: str, text: str) -> list[Claim]:
    return _ordering(name, place, paper.Ordering.of(text))


def _constants() -> Claim:
    # Radius and speed follow from two of the constants; then all four must fit.
    impact = table_4_impact()
    printed = {(c.response, c.parameter): c.value for c in paper.CONSTANTS}
    density = float(np.asarray(YANG2018_SPHERES[1].density))
    per_radius = printed["peak_displacement", "radius"]
    radius = printed["peak_displacement", "density"] * density**0.4 / per_radius
    velocity = SECTION_4_VELOCITY * (per_radius / float(impact.peak_displacement / YANG2018_RADIUS)) ** 1.25
    held = {"radius": YANG2018_RADIUS, "density": density}
    errors = [float(getattr(impact, c.response)) / held[c.parameter] ** c.power / c.value - 1 for c in paper.CONSTANTS]
    worst = max(map(abs, errors))
    return Claim(
        "constants under Eq. 18",
        "Section 4, under Eq. 18",
        "From Table 4: δ/R, P/R², δ/ρ^(2/5) and P/ρ^(3/5) have the four values printed.",
        f"They belong to an impact speed of {velocity:.9g} m/s, which the paper does not say, and a radius of "
        f"{radius * 1e3:.9g} mm; with {SECTION_4_VELOCITY:g} m/s, {YANG2018_RADIUS * 1e3:g} mm and the paper's "
        f"own theory all four agree to {worst:.0e}.",
        worst < 1e-12,
    )


def _proportional() -> list[Claim]:
    impact = table_4_impact()
    found = local_sensitivity(impact)
    wanted = {"radius": (1.0, 2.0), "density": (0.4, 0.6)}
    spread = range_influence(impact, {name: paper.TABLE_4[name].values for name in wanted})
    texts, holds = [], True
    for name, expected in wanted.items():
        values = paper.TABLE_4[name].values
        over_range = [np.log1p(getattr(spread, r)[name]) / np.log(values[-1] / values[0]) for r in _RESPONSES_influence]
        local = [getattr(found, r)[name] for r in _RESPONSES_influence]
        holds &= bool(np.allclose([local, over_range], expected, rtol=1e-9))
        texts.append(f"{symbol(name)}: {local[0]:.6g} (DCS) and {local[1]:.6g} (force)")
    return [
        Claim(
            "powers of radius and density",
            "Eq. 17 and 18",
            "DCS goes with R and ρ^(2/5), force with R² and ρ^(3/5).",
            "Powers of " + "; of ".join(texts) + ", over the whole ranges of Table 4.",
            holds,
        ),
        *_pair("radius matters more than density", "Section 4, under Eq. 18", "radius >> density"),
    ]


def _curve(varied: str) -> tuple[Floats, Floats, Floats]:
    """Return parameter, DCS and force of one curve of Figures 12 and 13."""
    figure = "figure_13" if varied.startswith("target_") else "figure_12"
    data = FIGURES[figure]().data
    rows = data[data["varied"] == varied]
    return tuple(rows[column].to_numpy() for column in (varied, *_RESPONSES_influence))


def _trends() -> list[Claim]:
    said = {
        "density": ("Conclusion 3", "rises", "rises", None),
        "youngs_modulus": ("Section 4 (Figure 12), conclusion 3", "falls", "rises", "shrinks"),
        "poisson_ratio": ("Section 4 (Figure 12), conclusion 3", "falls", "rises", "grows"),
        "target_youngs_modulus": ("Section 4 (Figure 13), conclusion 3", "falls", "rises", "shrinks"),
        "target_poisson_ratio": ("Section 4 (Figure 13), conclusion 3", "falls", "rises", "grows"),
    }
    claims = []
    for name, (place, displacement, force, steepness) in said.items():
        x, *responses = _curve(name)
        found = [trend(x, response) for response in responses]
        claims.append(
            Claim(
                f"trend of {name}",
                place,
                f"With {symbol(name)} the DCS {displacement} and the force {force}"
                + (f"; the rate of change {steepness}." if steepness else "."),
                f"The DCS {found[0][0]} (its steepness {found[0][1]}), the force {found[1][0]} "
                f"(its steepness {found[1][1]}).",
                all(
                    course == wanted and steepness in (None, change)
                    for (course, change), wanted in zip(found, (displacement, force), strict=True)
                ),
            )
        )
    x, displacement_curve, _ = _curve("youngs_modulus")
    exponential, text = judged_exponential(x, displacement_curve)
    claims.append(
        Claim(
            "DCS falls exponentially with E1",
            "Section 4, text of Figure 12",
            "The DCS decreases exponentially with E1.",
            text,
            exponential,
        )
    )
    return claims


def _poisson_power() -> Claim:
    nu, displacement, force = _curve("poisson_ratio")
    deviation = []
    for response, power in ((displacement, 0.4), (force, -0.4)):
        ratio = response / (1 - nu**2) ** power
        deviation.append(float(np.ptp(ratio) / ratio.mean()))
    return Claim(
        "power of Poisson's ratio",
        "Section 4, text of Figure 12",
        "DCS and force are approximately proportional to (1 - ν1²)^(2/5) and (1 - ν1²)^(-2/5).",
        f"Over the range of Table 4 the ratio stays within {max(deviation):.2%}.",
        max(deviation) < 0.01,
    )


def _surface(figure: str, first: str, second: str, response: str) -> Floats:
    data = FIGURES[figure]().data
    rows = data[data["varied"] == f"{first} and {second}"]
    return np.asarray(rows.pivot(index=first, columns=second, values=response).to_numpy())


def _course(surface: Floats) -> str:
    """Return what a surface does along both of its axes."""
    return _one_word(np.sign(np.diff(surface, axis=axis)) for axis in (0, 1))


def _one_word(signs: Iterable[Floats]) -> str:
    values = {value for sign in signs for value in np.unique(sign).tolist()}
    return {(1.0,): "rises", (-1.0,): "falls"}.get(tuple(values), "neither rises nor falls")


def _figure_14() -> list[Claim]:
    claims, asymmetry = [], 0.0
    for first, second in (("youngs_modulus", "target_youngs_modulus"), ("poisson_ratio", "target_poisson_ratio")):
        for response, label in _RESPONSES_influence.items():
            surface = _surface("figure_14", first, second, response)
            asymmetry = max(asymmetry, float(np.abs(surface / surface.T - 1).max()))
            course = _course(surface)
            claims.append(
                Claim(
                    f"Figure 14, {label} over {first}",
                    "Section 4, text of Figure 14",
                    f"With {symbol(first)} and {symbol(second)} the {label} decreases.",
                    f"Everywhere on the surface it {course} along both axes."
                    + (
                        ""
                        if course == "falls"
                        else " The paper's own Eq. 18, Figure 12 and conclusion 3 say that it rises."
                    ),
                    course == "falls",
                )
            )
    claims.append(
        Claim(
            "Figure 14, symmetry",
            "Section 4, text of Figure 14",
            "With equal values and ranges, E1 and E2 (and ν1 and ν2) act in exactly the same way.",
            f"Each surface is its own mirror image to {asymmetry:.0e}.",
            asymmetry < 1e-12,
        )
    )
    return claims


def _figure_15() -> list[Claim]:
    names = ("youngs_modulus", "target_youngs_modulus")
    surfaces = {r: _surface("figure_15", *names, r) for r in _RESPONSES_influence}
    courses = {r: _course(surface) for r, surface in surfaces.items()}
    # Along one modulus at every value of the other: the least that E1 does, and the most that E2 does.
    by_first = {r: float((s.max(axis=0) / s.min(axis=0)).min() - 1) for r, s in surfaces.items()}
    by_second = {r: float((s.max(axis=1) / s.min(axis=1)).max() - 1) for r, s in surfaces.items()}
    return [
        Claim(
            "Figure 15, trends",
            "Section 4, text of Figure 15",
            "With E1 and E2 the DCS decreases and the force increases.",
            f"The DCS {courses['peak_displacement']}, the force {courses['peak_force']} along both axes.",
            courses == {"peak_displacement": "falls", "peak_force": "rises"},
        ),
        Claim(
            "Figure 15, E2 against E1",
            "Section 4, text of Figure 15",
            "E2 changes DCS and force much more than E1: E2 > E1.",
            "Over its range and at the most favourable E1, E2 moves "
            + ", ".join(f"the {label} by {by_second[r]:.0%}" for r, label in _RESPONSES_influence.items())
            + "; at the least favourable E2, E1 moves "
            + ", ".join(f"the {label} by {by_first[r]:.0%}" for r, label in _RESPONSES_influence.items())
            + ".",
            all(by_second[r] > by_first[r] for r in _RESPONSES_influence),
        ),
    ]


def _compliances() -> Claim:
    first, second = (float(body.plane_strain_compliance) for body in (YANG2018_SPHERES[1], STEEL))
    local = local_sensitivity(table_4_impact()).peak_force
    ratio = float(local["youngs_modulus"] / local["target_youngs_modulus"])
    return Claim(
        "compliance of sphere and plate",
        "Section 4, text of Figure 15",
        "(1 - ν1²)/E1 is much larger than (1 - ν2²)/E2, and so ν1 matters more than ν2.",
        f"It is {first / second:.0f} times as large, {first / (first + second):.1%} of the whole. Locally E1 matters "
        f"{ratio:.0f} times as much as E2 for the same reason.",
        first > 10 * second and bool(local["poisson_ratio"] > local["target_poisson_ratio"]),
    )


_RESPONSES_spheres = {"peak_displacement": "DCS", "peak_force": "force"}
#: Coal and gangue differ "obviously" if the smallest difference of two spheres is at least this part.
_OBVIOUS = 0.1


def sphere_claims() -> list[Claim]:
    """Return the claims of section 5, judged."""
    return [*_spheres_spheres(), _separation()]


def _spheres_spheres() -> list[Claim]:
    elastic = {n: paper_impact(n, SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    restitution = SECTION_5_RESTITUTION
    damped = {n: paper_impact(n, i.velocity, restitution=restitution) for n, i in elastic.items()}
    shown = {
        "density": (1.0, "kg/m³"),
        "youngs_modulus": (1e-9, "GPa"),
        "poisson_ratio": (1.0, ""),
        "peak_force": (1e-3, "kN"),
        "peak_displacement": (1e3, "mm"),
    }
    speed = f"at {SECTION_5_VELOCITY:g} m/s"
    labels = {"peak_force": f"maximum force {speed}", "peak_displacement": f"DCS {speed}"}
    claims = []
    for name, ordering in paper.SPHERES_BY.items():
        factor, unit = shown[name]
        kinds: dict[str, dict[int, Impact]] = {"": elastic}
        if name in _RESPONSES_spheres:
            kinds = {"elastic: ": elastic, f"restitution {restitution:g}: ": damped}
        judged = {}
        for kind, made in kinds.items():
            source = {n: i if name in _RESPONSES_spheres else i.sphere.material for n, i in made.items()}
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
    made = {n: paper_impact(n, SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    least = {}
    for response, label in _RESPONSES_spheres.items():
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


__all__ = ["Claim", "all_claims"]


def all_claims(study: Study | None = None) -> list[Claim]:
    """Return every claim of the paper that is checked, judged, in the order of the paper.

    Parameters
    ----------
    study : Study, optional
        Finite elements that judge what rests on a simulation; those that come with the package if not given.
    """
    return [*contact_claims(), *simulation_claims(study or shipped_study()), *influence_claims(), *sphere_claims()]

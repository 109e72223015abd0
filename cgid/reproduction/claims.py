"""The claims of sections 2 and 3 of the paper: contact theories and simulation.

`all_claims` adds those of sections 4 and 5. `tests/test_claims.py` asserts every verdict and number.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cgid.physics import RIGID, STIFFNESS_THEORIES, Impact, contact_stiffness
from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from cgid.reproduction import paper
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.judging import (
    RESPONSES,
    Claim,
    Claims,
    Verdict,
    columns,
    combined,
    judged_exponential,
    judged_ordering,
    powers,
    symbol,
    written,
)
from cgid.reproduction.paper import SECTION_4_VELOCITY, SECTION_5_VELOCITY, THEORY_LABELS, paper_impact
from cgid.reproduction.parameter_claims import PARAMETER_CLAIMS
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

#: Largest relative error of a prediction that counts as "close" to the simulation.
_CLOSE = 0.1
#: Exponents of the speed that differ by less than this count as equal.
_SAME_POWER = 0.05

CLAIMS = Claims()


def all_claims(study: Study | None = None) -> list[Claim]:
    """Return every claim with its verdict, in the order of the paper; `study` is the shipped one by default."""
    study = study or shipped_study()
    return [*CLAIMS.judged(study), *PARAMETER_CLAIMS.judged(study)]


# ---- sections 2 and 3: the three theories, Tables 1 and 2, Figures 4 to 7 -------------------------------------------


@CLAIMS.add("Section 2, under Eq. 8", "1/E = (1 - ν1²/E1) + (1 - ν2²/E2).")
def _reduced_modulus_without_brackets(_: Study) -> Verdict:
    bodies = (YANG2018_SPHERES[1], STEEL)
    as_printed = float(1 / sum(1 - np.square(body.poisson_ratio) / np.asarray(body.youngs_modulus) for body in bodies))
    modulus, printed = computed_contact(1)[0] / 1e9, float(paper.TABLE_1.reduced_modulus)
    return bool(np.isclose(as_printed / 1e9, printed, rtol=1e-4)), (
        f"As printed, sphere 1 on the plate has E = {as_printed:.3g} Pa; with 1/E = (1 - ν1²)/E1 + (1 - ν2²)/E2 it "
        f"has {modulus:.5g} GPa, and Table 1 says {printed:.5g} GPa. Eq. 17 and 18 are printed right."
    )


@CLAIMS.add("Section 2, under Eq. 8", "K2 = 32√3 √R/27 E = 8√3/9 K1.")
def _two_forms_of_k2(_: Study) -> Verdict:
    modulus, stiffness = computed_contact(1)
    ratio, wanted = 32 * np.sqrt(3) * np.sqrt(YANG2018_RADIUS) / 27 * modulus / stiffness, 8 * np.sqrt(3) / 9
    return bool(np.isclose(ratio, wanted, rtol=1e-12)), f"32√3 √R/27 E is {ratio:.12g} K1, 8√3/9 is {wanted:.12g}."


@CLAIMS.add("Eq. 9 to 13, 17 and 18", "Eq. 12, 13 and Eq. 17, 18 give DCS and force of the paper's own theory.")
def _own_theory_is_two_springs_in_series(_: Study) -> Verdict:
    series = paper_impact(1, np.array(paper.VELOCITIES))
    wanted = 2 * (series.peak_displacement, series.peak_force)
    pairs = zip(_eq_12_13(series) + _eq_17_18(series), wanted, strict=True)
    worst = max(float(np.max(np.abs(found / expected - 1))) for found, expected in pairs)
    text = f"Both pairs are the stiffness K1 / 1.75^(3/2) of the springs K1 and K2 in series, to {worst:.0e}."
    return worst < 1e-12, text


def _eq_12_13(impact: Impact) -> tuple[Floats, Floats]:
    """Return DCS [m] and force [N] by Eq. 12 and 13."""
    first = 4 / 3 * np.sqrt(impact.reduced_radius) * impact.reduced_modulus
    second = 8 * np.sqrt(3) / 9 * first
    stiffness = first + first ** (5 / 3) * second ** (-2 / 3)
    energy = 5 * impact.reduced_mass * np.square(impact.velocity) / (4 * stiffness)
    return energy**0.4 * (1 + (first / second) ** (2 / 3)), first * energy**0.6


def _eq_17_18(impact: Impact) -> tuple[Floats, Floats]:
    """Return DCS [m] and force [N] by Eq. 17 and 18."""
    radius, density = impact.reduced_radius, np.asarray(impact.sphere.material.density)
    compliance, square = 1 / impact.reduced_modulus, 5 * np.square(impact.velocity) / 7
    volume = 4 * np.pi / 3
    displacement = 7 / 4 * square**0.4 * volume**0.4 * radius * density**0.4 * (9 / 16) ** 0.2 * compliance**0.4
    force = (16 / 9) ** 0.2 * compliance**-0.4 * square**0.6 * density**0.6 * volume**0.6 * radius**2
    return np.asarray(displacement), np.asarray(force)


@CLAIMS.add("Table 2", "E and K of every row follow from its inputs (K is K1).", "Table 2 digits", table="Table 2")
@CLAIMS.add("Table 1", "E and K of every row follow from its inputs (K is K1).", "Table 1 digits", table="Table 1")
def _printed_digits(_: Study, table: str) -> Verdict:
    rows = {"Table 1": {1: paper.TABLE_1}, "Table 2": paper.TABLE_2}[table]
    off = []
    for number, printed in rows.items():
        modulus, stiffness = computed_contact(number)
        if f"{modulus / 1e9:#.5g}" != printed.reduced_modulus:
            off.append(f"E of sphere {number} is {modulus / 1e9:.6g} GPa")
        if f"{stiffness:.4e}" != f"{float(printed.stiffness):.4e}":
            off.append(f"K of sphere {number} is {stiffness:.6g}")
    return not off, "; ".join(off) or f"All {2 * len(rows)} numbers, to the five digits printed."


@CLAIMS.add(
    "Section 2, text of Figure 6",
    "The traditional theory, K1, takes only one of the two bodies as elastic (K of Table 1 and 2).",
)
def _k1_has_one_elastic_body(_: Study) -> Verdict:
    softer = {
        number: 1 - computed_contact(number)[0] * float(sphere.plane_strain_compliance)
        for number, sphere in YANG2018_SPHERES.items()
    }
    return max(softer.values()) < 1e-4, (
        "The E in K1 holds the compliance of both. On a rigid surface K1 would be larger: the printed one is "
        + ", ".join(f"{part:.1%} below it for sphere {number}" for number, part in softer.items())
        + "."
    )


@CLAIMS.add("Section 2, Eq. 2", "K2 is the stiffness of a rigid sphere on an elastic half space.")
def _k2_has_one_elastic_body(_: Study) -> Verdict:
    rigid_sphere = contact_stiffness(YANG2018_RADIUS, 1 / STEEL.plane_strain_compliance, "hertz")
    ratio = float(paper_impact(1, SECTION_4_VELOCITY, "rigid-sphere").contact_stiffness / rigid_sphere)
    return abs(ratio - 1) < 1e-4, (
        f"K2 of sphere 1 is {ratio:.3g} of the stiffness that Hertz gives a rigid sphere on this plate, "
        "4/3 √R E2/(1 - ν2²): its E holds the sphere's compliance, too."
    )


@CLAIMS.add(
    "Eq. 10 to 13 (must follow, not said)",
    "On a plate that does not give, E2 towards infinity, the paper's theory becomes that of an elastic sphere on a "
    "rigid surface.",
)
def _series_theory_has_k1_as_its_limit(_: Study) -> Verdict:
    hertz = paper_impact(1, SECTION_4_VELOCITY, "hertz")
    on_rigid = Impact(
        sphere=hertz.sphere, target=RIGID, velocity=hertz.velocity, stiffness="hertz", dissipation=hertz.dissipation
    )
    stiff = Material(density=7850.0, youngs_modulus=1e30, poisson_ratio=0.3)
    limit = paper_impact(1, SECTION_4_VELOCITY, target=stiff)
    ratio = float(limit.contact_stiffness / on_rigid.contact_stiffness)
    return abs(ratio - 1) < 1e-6, f"It becomes {ratio:.4f} of that stiffness: the compliance is counted twice."


def _by_theory(figure: str, response: str) -> Any:
    """Return a response as a data frame: a row for each speed, a column for each theory."""
    return FIGURES[figure]().data.pivot(index="velocity", columns="theory", values=response)


@CLAIMS.add(
    "Figure 5",
    f"maximum force at the same speed: {written(paper.THEORIES_BY_FORCE)}; it grows with the speed.",
    "maximum force of the theories",
    figure="figure_05",
    response="peak_force",
    factor=1e-3,
    unit="kN",
)
@CLAIMS.add(
    "Figure 4",
    f"DCS at the same speed: {written(paper.THEORIES_BY_DISPLACEMENT)}; it grows with the speed.",
    "DCS of the theories",
    figure="figure_04",
    response="peak_displacement",
    factor=1e3,
    unit="mm",
)
def _theories_at_one_speed(_: Study, figure: str, response: str, factor: float, unit: str) -> Verdict:
    ordering = paper.THEORIES_BY_DISPLACEMENT if response == "peak_displacement" else paper.THEORIES_BY_FORCE
    table = _by_theory(figure, response) * factor
    verdicts = [judged_ordering(ordering, row) for row in table.to_dict("records")]
    n_holding = sum(holds for holds, _ in verdicts)
    rising = all((np.diff(table[theory]) > 0).all() for theory in ordering.names)
    return rising and n_holding == len(verdicts), (
        f"At {table.index[-1]:g} m/s: {verdicts[-1][1]} {unit}; so at {n_holding} of {len(verdicts)} speeds."
    )


@CLAIMS.add("Figure 6", f"Maximum force at the same DCS: {written(paper.THEORIES_BY_FORCE)}.")
def _maximum_force_of_the_theories_at_the_same_dcs(_: Study) -> Verdict:
    holds, text = judged_ordering(paper.THEORIES_BY_FORCE, STIFFNESS_THEORIES)
    return holds, f"It goes with K: {text} times K1."


@CLAIMS.add(
    "Section 2, text of Figure 6",
    "The paper's theory predicts a larger DCS and a smaller force than the traditional theory.",
)
def _own_theory_against_the_traditional_one(_: Study) -> Verdict:
    displacement, force = _by_theory("figure_04", "peak_displacement"), _by_theory("figure_05", "peak_force")
    larger, smaller = displacement["series"] / displacement["hertz"], force["series"] / force["hertz"]
    text = f"DCS x {larger.mean():.4f} and force x {smaller.mean():.4f} of K1, at every speed."
    return bool((larger > 1).all() and (smaller < 1).all()), text


@CLAIMS.add("Section 2, text of Figure 6", "The contact force increases exponentially with the DCS.")
def _figure_6_is_exponential(_: Study) -> Verdict:
    own = FIGURES["figure_06"]().data.query("theory == 'series'")
    return judged_exponential(own["peak_displacement"].to_numpy(), own["peak_force"].to_numpy())


@CLAIMS.add("Figure 7", "DCS and force grow with the drop height in the power of 2/5 and 3/5.")
def _powers_of_the_drop_height(_: Study) -> Verdict:
    height, *responses = columns("figure_07", "drop_height", *RESPONSES)
    found = [powers(height, response) for response in responses]
    holds = all(np.allclose(power, wanted, atol=1e-9) for power, wanted in zip(found, (0.4, 0.6), strict=True))
    return holds, f"Powers {found[0].mean():.6f} and {found[1].mean():.6f}."


@CLAIMS.add("Section 2, text of Figure 7", "DCS and force increase exponentially with the drop height.")
def _figure_7_is_exponential(_: Study) -> Verdict:
    height, *responses = columns("figure_07", "drop_height", *RESPONSES)
    displacement, force = (judged_exponential(height, response) for response in responses)
    return displacement[0] and force[0], f"DCS: {displacement[1]} Force: {force[1]}"


@CLAIMS.add(
    "Section 3.1", "Over the gap of 0.326 mm the sphere gains less than 0.01 m/s, less than 1/200 of its speed."
)
def _gap_at_the_start(_: Study) -> Verdict:
    velocity = np.array(paper.VELOCITIES)
    gain = np.sqrt(velocity**2 + 2 * paper.GRAVITY * paper.START_GAP) - velocity
    highest, share = gain.max(), (gain / velocity).max()
    return bool(highest < 0.01 and share < 1 / 200), f"At most {highest:.4f} m/s, {share:.1e} of the speed."


@CLAIMS.add("Figure 11", "Force-displacement curves of damped impacts are closed loops, because energy is dissipated.")
def _closed_hysteresis_loops(_: Study) -> Verdict:
    closed, errors = True, []
    for (number, restitution, velocity), loop in (
        FIGURES["figure_11_loops"]().data.groupby(["sphere", "restitution", "velocity"])
    ):  # fmt: skip
        force, displacement = loop["force"].to_numpy(), loop["displacement"].to_numpy()
        ends = np.abs([force[0] / force.max(), force[-1] / force.max(), displacement[-1] / displacement.max()])
        closed &= bool(ends.max() < 1e-6)
        energy = 0.5 * float(paper_impact(number, velocity).reduced_mass) * velocity**2
        errors.append(float(np.trapezoid(force, displacement)) / (energy * (1 - restitution**2)) - 1)
    worst = max(map(abs, errors))
    return closed and worst < 1e-3, (
        f"All {len(errors)} loops {'are' if closed else 'are not all'} closed, and their area is the energy lost, "
        f"(1 - e²) m v²/2, to {worst:.1e} (201 points a loop)."
    )


# ---- claims about the simulation, judged by the finite-element study ------------------------------------------------


def _errors(study: Study, theory: str, group: str = UNDAMPED) -> tuple[float, float]:
    """Return the mean relative errors of a theory in force and DCS against the finite elements."""
    force, displacement = (agreement(study, theory, name, group).error for name in ("peak_force", "peak_displacement"))
    return force, displacement


@CLAIMS.add("Figure 10, conclusion 1", "The paper's theory agrees with the simulation in maximum force and DCS.")
def _own_theory_is_close_to_the_simulation(study: Study) -> Verdict:
    own, damped = (_errors(study, paper.OWN_THEORY, group) for group in (UNDAMPED, DAMPED))
    return max(map(abs, own)) <= _CLOSE, (
        f"Against finite elements ({len(study.of(UNDAMPED))} impacts) it errs by {own[0]:+.0%} in force and "
        f"{own[1]:+.0%} in DCS (close: within {_CLOSE:.0%}); against damped ones by {damped[0]:+.0%} and "
        f"{damped[1]:+.0%}."
    )


@CLAIMS.add(
    "Abstract, conclusion 2", "The paper's theory predicts force and DCS more accurately than the traditional theory."
)
def _own_theory_is_more_accurate(study: Study) -> Verdict:
    size, damped = (
        {theory: size_of_errors(study, theory, RESPONSES, group) for theory in THEORY_LABELS}
        for group in (UNDAMPED, DAMPED)
    )
    return size["series"] < min(size["hertz"], size["rigid-sphere"]), (
        "Mean size of the errors against the finite elements: "
        + ", ".join(f"{symbol(theory)} {value:.0%}" for theory, value in size.items())
        + f" (against damped ones: {', '.join(f'{value:.0%}' for value in damped.values())})."
    )


@CLAIMS.add("Conclusion 2", "The maximum contact force of the traditional theory is too large.")
def _traditional_force_is_too_large(study: Study) -> Verdict:
    (first, _), (second, _), (damped, _) = (
        _errors(study, *of) for of in (("hertz",), ("rigid-sphere",), ("hertz", DAMPED))
    )
    return min(first, second) > 0, (
        f"Against the finite elements K1 gives {first:+.0%}, K2 {second:+.0%}. (Damping, which none of the theories "
        f"has, lowers the force: against damped impacts of restitution {RESTITUTION:g} K1 gives {damped:+.0%}.)"
    )


@CLAIMS.add(
    "Section 3.2, Table 3",
    "A squared correlation above 0.96 between theory and simulation shows that the theory is right.",
)
def _squared_correlation_as_a_yardstick(study: Study) -> Verdict:
    found = {theory: [agreement(study, theory, name) for name in RESPONSES] for theory in THEORY_LABELS}
    least = {theory: min(value.squared_correlation for value in values) for theory, values in found.items()}
    wrong = {theory for theory, values in found.items() if max(abs(value.error) for value in values) > _CLOSE}
    return not any(least[theory] > HIGH_CORRELATION for theory in wrong), (
        f"With the {len(study.of(UNDAMPED))} finite-element impacts it is at least "
        + ", ".join(f"{value:.5f} ({symbol(theory)})" for theory, value in least.items())
        + ": it does not see a wrong factor."
    )


_PRINTED_PRESSURE = [row["peak_pressure"] for row in paper.TABLE_3.values()]


@CLAIMS.add(
    "Section 3.2, Table 3",
    "Contact pressure is so uncertain that its squared correlation is only "
    f"{min(_PRINTED_PRESSURE):g} to {max(_PRINTED_PRESSURE):g}.",
)
def _pressure_is_uncertain(study: Study) -> Verdict:
    found = [
        agreement(study, paper.OWN_THEORY, "peak_pressure", sphere=number).squared_correlation
        for number in YANG2018_SPHERES
    ]
    return max(found) < HIGH_CORRELATION, (
        f"With the finite elements it is {min(found):.5f} to {max(found):.5f}, as for force and DCS: it is the "
        "paper's simulation that scatters, not the pressure."
    )


@CLAIMS.add("Section 3.2, conclusion 1", "Simulated responses change with the speed as the theoretical ones do.")
def _same_trends_in_simulation_and_theory(study: Study) -> Verdict:
    displacement, force = (
        np.polyfit(
            np.log(paper.VELOCITIES), np.log(of_simulation(study, name).reshape(len(YANG2018_SPHERES), -1)).T, 1
        )[0]
        for name in RESPONSES
    )
    return max(np.abs(force - 1.2).max(), np.abs(displacement - 0.8).max()) < _SAME_POWER, (
        f"Force grows with the speed in the power of {force.min():.3f} to {force.max():.3f} (theories: 6/5), DCS of "
        f"{displacement.min():.3f} to {displacement.max():.3f} (4/5). Every theory here has these powers."
    )


@CLAIMS.add(
    "Section 3.2, text of Figure 10", "The contact force shows dense vibration waves instead of a smooth curve."
)
def _contact_force_has_dense_vibration_waves(study: Study) -> Verdict:
    force, centre = (ripples(study, name) for name in ("force", "centre_node_force"))
    return bool(np.median(force) > WAVES), (
        "Largest distance from its own low-pass at 10/T, over the peak, in the median impact: contact force "
        f"{np.median(force):.1%} (worst of {force.size}: {force.max():.1%}), mass x acceleration of the sphere's "
        f"centre {np.median(centre):.0%} (waves: {WAVES:.0%}). The waves are those of the sphere, not of the contact."
    )


@CLAIMS.add(
    "Section 3.2, text of Figure 10",
    "Behind an FFT filter the simulated force has the right maximum. (The paper does not say which filter.)",
)
def _fft_filter_takes_the_waves_off(study: Study) -> Verdict:
    at_4, at_5 = (np.abs(filtered_errors(study, edge)) for edge in (4, 5))
    return bool(at_4.max() <= FILTERED), (
        f"Mass x acceleration of the centre behind a low-pass at 4/T has the contact force's maximum within "
        f"{at_4.max():.1%} in all {at_4.size} impacts; at 5/T it is off by up to {at_5.max():.1%}."
    )


@CLAIMS.add("Figure 11", "During compression the simulated force fluctuates around the curve of the paper's theory.")
def _simulated_loops_lie_around_the_own_theory(study: Study) -> Verdict:
    own, hertz = (
        [_work(study, group, theory) for group in (UNDAMPED, DAMPED)] for theory in (paper.OWN_THEORY, "hertz")
    )
    elastic, damped = (f"{min(parts):.0%} to {max(parts):.0%}" for parts in own)
    return max(abs(part - 1) for parts in own for part in parts) <= _CLOSE, (
        f"Up to the largest DCS of each impact the theory's curve takes {elastic} of the work that the undamped finite "
        f"elements take, {damped} with damping (close: within {_CLOSE:.0%}); K1's takes {np.mean(hertz[0]):.0%} and "
        f"{np.mean(hertz[1]):.0%} in the mean."
    )


def _work(study: Study, group: str, theory: str) -> list[float]:
    """Return the compression work of a theory divided by that of the finite elements, for each impact."""
    parts = []
    for run in study.of(group):
        last = int(np.argmax(run.courses["displacement"]))
        force, displacement = (run.courses[name][: last + 1] for name in ("force", "displacement"))
        stiffness = float(paper_impact(run.case.sphere, run.case.velocity, theory).contact_stiffness)
        parts.append(0.4 * stiffness * displacement[-1] ** 2.5 / float(np.trapezoid(force, displacement)))
    return parts


def _simulated_spheres(study: Study, response: str, factor: float, unit: str) -> Verdict:
    judged = {}
    for group in (UNDAMPED, DAMPED):
        runs = (run for run in study.of(group) if run.case.velocity == SECTION_5_VELOCITY)
        sizes = {str(run.case.sphere): factor * run.numbers[response] for run in runs}
        judged[group] = judged_ordering(paper.SPHERES_BY[response], sizes)
    holds, text = combined(judged)
    return holds, f"{text} [{unit}]."


for _response, _place, _label, _factor, _unit in (
    ("peak_force", "Figure 16", "maximum force", 1e-3, "kN"),
    ("peak_displacement", "Figure 17", "DCS", 1e3, "mm"),
):
    CLAIMS.add(_place, f"Simulated, by {_label} at {SECTION_5_VELOCITY:g} m/s: {written(paper.SPHERES_BY[_response])}.",
        f"simulated spheres by {_response}", response=_response, factor=_factor, unit=_unit,
    )(_simulated_spheres)  # fmt: skip

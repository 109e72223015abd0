"""The claims of sections 4 and 5 of the paper: the effect of each parameter, and differences between the spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES
from cgid.physics.sensitivity import Sensitivity, local_sensitivity, range_influence
from cgid.reproduction import paper
from cgid.reproduction.judging import (
    RESPONSES,
    Claims,
    Verdict,
    columns,
    combined,
    course_of,
    judged_exponential,
    judged_ordering,
    response_surface,
    symbol,
    trend,
    written,
)
from cgid.reproduction.paper import (
    SECTION_4_VELOCITY,
    SECTION_5_RESTITUTION,
    SECTION_5_VELOCITY,
    Ordering,
    paper_impact,
    table_4_impact,
    table_5_impact,
)
from cgid.reproduction.study import Study
from cgid.validation import Floats

#: Smallest relative difference between two spheres at which coal and gangue differ "obviously".
_OBVIOUS = 0.1

PARAMETER_CLAIMS = Claims()


# ---- section 4 and conclusions 3 to 5: effect and sensitivity of each parameter -------------------------------------

_OVER_RANGE = "over the range"


def measures(*, equal_bodies: bool) -> dict[str, Sensitivity]:
    """Return both measures of sensitivity for the bodies of Table 5 (equal) or 4.

    Table 4 supplies the ranges that Table 5 lacks.
    """
    impact = table_5_impact() if equal_bodies else table_4_impact()
    ranges = paper.TABLE_4 | paper.TABLE_5 if equal_bodies else paper.TABLE_4
    values = {name: values.values for name, values in ranges.items()}
    return {"locally": local_sensitivity(impact), _OVER_RANGE: range_influence(impact, values)}


def _ranking(_: Study, measure: str, ordering: Ordering, equal_bodies: bool) -> Verdict:
    sensitivity = measures(equal_bodies=equal_bodies)[measure]
    judged = {label: judged_ordering(ordering, getattr(sensitivity, r)) for r, label in RESPONSES.items()}
    holds, text = combined(judged)
    return holds, f"{text}.{_where_held() if equal_bodies and measure == _OVER_RANGE else ''}"


def _where_held() -> str:
    """Return how a range of E1 changes the force of equal bodies if E2 is not held at Table 5's value."""
    surface = response_surface("figure_14", "youngs_modulus", "target_youngs_modulus", "peak_force")
    highest, together = surface[:, -1], surface.diagonal()
    return (
        f" With E2 held at its highest value instead, E1 moves the force by {highest.max() / highest.min() - 1:.4g}; "
        f"both moduli together by {together.max() / together.min() - 1:.4g}."
    )


def _claim_ranking(name: str, place: str, ordering: Ordering, *, equal_bodies: bool = False) -> None:
    """Register a ranking of parameters, once for each measure of sensitivity."""
    for measure in ("locally", _OVER_RANGE):
        says = f"Sensitivity of DCS and force, {measure}: {written(ordering)}."
        arguments = {"measure": measure, "ordering": ordering, "equal_bodies": equal_bodies}
        PARAMETER_CLAIMS.add(place, says, f"{name}, {measure}", **arguments)(_ranking)


@PARAMETER_CLAIMS.add(
    "Section 4, under Eq. 18", "From Table 4: δ/R, P/R², δ/ρ^(2/5) and P/ρ^(3/5) have the four values printed."
)
def _constants_under_eq_18(_: Study) -> Verdict:
    # Two of the constants determine radius and speed; then all four must fit.
    impact = table_4_impact()
    printed = {(c.response, c.parameter): c.value for c in paper.CONSTANTS}
    density = float(np.asarray(YANG2018_SPHERES[1].density))
    per_radius = printed["peak_displacement", "radius"]
    radius = printed["peak_displacement", "density"] * density**0.4 / per_radius
    velocity = SECTION_4_VELOCITY * (per_radius / float(impact.peak_displacement / YANG2018_RADIUS)) ** 1.25
    held = {"radius": YANG2018_RADIUS, "density": density}
    errors = [float(getattr(impact, c.response)) / held[c.parameter] ** c.power / c.value - 1 for c in paper.CONSTANTS]
    worst = max(map(abs, errors))
    return worst < 1e-12, (
        f"They belong to an impact speed of {velocity:.9g} m/s, which the paper does not say, and a radius of "
        f"{radius * 1e3:.9g} mm; with {SECTION_4_VELOCITY:g} m/s, {YANG2018_RADIUS * 1e3:g} mm and the paper's "
        f"own theory all four agree to {worst:.0e}."
    )


@PARAMETER_CLAIMS.add("Eq. 17 and 18", "DCS goes with R and ρ^(2/5), force with R² and ρ^(3/5).")
def _powers_of_radius_and_density(_: Study) -> Verdict:
    local, over_range = measures(equal_bodies=False).values()
    texts, holds = [], True
    for name, wanted in {"radius": (1.0, 2.0), "density": (0.4, 0.6)}.items():
        values = paper.TABLE_4[name].values
        found = [getattr(local, r)[name] for r in RESPONSES]
        along = [np.log1p(getattr(over_range, r)[name]) / np.log(values[-1] / values[0]) for r in RESPONSES]
        holds &= bool(np.allclose([found, along], wanted, rtol=1e-9))
        texts.append(f"{symbol(name)}: {found[0]:.6g} (DCS) and {found[1]:.6g} (force)")
    return holds, "Powers of " + "; of ".join(texts) + ", over the whole ranges of Table 4."


_claim_ranking("radius matters more than density", "Section 4, under Eq. 18", Ordering.of("radius >> density"))


def _curve(varied: str) -> list[Floats]:
    """Return parameter, DCS and force of one curve of Figures 12 and 13."""
    figure = "figure_13" if varied.startswith("target_") else "figure_12"
    return columns(figure, varied, *RESPONSES, varied=varied)


def _trends(_: Study, parameter: str, displacement: str, steepness: str) -> Verdict:
    x, *responses = _curve(parameter)
    (of_displacement, change), (of_force, change_of_force) = (trend(x, response) for response in responses)
    holds = (of_displacement, of_force) == (displacement, "rises")
    return holds and (not steepness or change == change_of_force == steepness), (
        f"The DCS {of_displacement} (its steepness {change}), the force {of_force} (its steepness {change_of_force})."
    )


for _name, _place, _displacement, _steepness in (
    ("density", "Conclusion 3", "rises", ""),
    ("youngs_modulus", "Section 4 (Figure 12), conclusion 3", "falls", "shrinks"),
    ("poisson_ratio", "Section 4 (Figure 12), conclusion 3", "falls", "grows"),
    ("target_youngs_modulus", "Section 4 (Figure 13), conclusion 3", "falls", "shrinks"),
    ("target_poisson_ratio", "Section 4 (Figure 13), conclusion 3", "falls", "grows"),
):
    PARAMETER_CLAIMS.add(_place, f"With {symbol(_name)} the DCS {_displacement} and the force rises"
        + (f"; the rate of change {_steepness}." if _steepness else "."),
        f"trend of {_name}", parameter=_name, displacement=_displacement, steepness=_steepness,
    )(_trends)  # fmt: skip


@PARAMETER_CLAIMS.add("Section 4, text of Figure 12", "The DCS decreases exponentially with E1.")
def _dcs_falls_exponentially_with_e1(_: Study) -> Verdict:
    modulus, displacement, _force = _curve("youngs_modulus")
    return judged_exponential(modulus, displacement)


@PARAMETER_CLAIMS.add(
    "Section 4, text of Figure 12",
    "DCS and force are approximately proportional to (1 - ν1²)^(2/5) and (1 - ν1²)^(-2/5).",
)
def _power_of_poissons_ratio(_: Study) -> Verdict:
    nu, displacement, force = _curve("poisson_ratio")
    ratios = displacement / (1 - nu**2) ** 0.4, force * (1 - nu**2) ** 0.4
    deviation = max(float(np.ptp(ratio) / ratio.mean()) for ratio in ratios)
    return deviation < 0.01, f"Over the range of Table 4 the ratio stays within {deviation:.2%}."


_claim_ranking("E1 matters more than density", "Section 4, text of Figure 12", Ordering.of("youngs_modulus > density"))
_claim_ranking("sphere's parameters", "Section 4 (Figure 12) and section 5", paper.SPHERE_ORDERING)
_claim_ranking("plate's parameters", "Section 4 (Figure 13)", paper.PLATE_ORDERING)

#: The parameters that span the surfaces of Figure 14.
_PAIRS = (("youngs_modulus", "target_youngs_modulus"), ("poisson_ratio", "target_poisson_ratio"))


def _falls_on_figure_14(_: Study, first: str, second: str, response: str) -> Verdict:
    course = course_of(response_surface("figure_14", first, second, response))
    note = "" if course == "falls" else " The paper's own Eq. 18, Figure 12 and conclusion 3 say that it rises."
    return course == "falls", f"Everywhere on the surface it {course} along both axes.{note}"


for _first, _second in _PAIRS:
    for _response, _label in RESPONSES.items():
        PARAMETER_CLAIMS.add(
            "Section 4, text of Figure 14", f"With {symbol(_first)} and {symbol(_second)} the {_label} decreases.",
            f"Figure 14, {_label} over {_first}", first=_first, second=_second, response=_response,
        )(_falls_on_figure_14)  # fmt: skip


@PARAMETER_CLAIMS.add(
    "Section 4, text of Figure 14",
    "With equal values and ranges, E1 and E2 (and ν1 and ν2) act in exactly the same way.",
)
def _figure_14_symmetry(_: Study) -> Verdict:
    surfaces = [response_surface("figure_14", *pair, response) for pair in _PAIRS for response in RESPONSES]
    asymmetry = max(float(np.abs(surface / surface.T - 1).max()) for surface in surfaces)
    return asymmetry < 1e-12, f"Each surface is its own mirror image to {asymmetry:.0e}."


_claim_ranking("conclusion 4", "Section 4 and conclusion 4 (Table 5)", paper.CONCLUSION_4, equal_bodies=True)


@PARAMETER_CLAIMS.add("Section 4, text of Figure 15", "With E1 and E2 the DCS decreases and the force increases.")
def _figure_15_trends(_: Study) -> Verdict:
    displacement, force = (course_of(response_surface("figure_15", *_PAIRS[0], response)) for response in RESPONSES)
    text = f"The DCS {displacement}, the force {force} along both axes."
    return (displacement, force) == ("falls", "rises"), text


@PARAMETER_CLAIMS.add("Section 4, text of Figure 15", "E2 changes DCS and force much more than E1: E2 > E1.")
def _figure_15_e2_against_e1(_: Study) -> Verdict:
    surfaces = {label: response_surface("figure_15", *_PAIRS[0], response) for response, label in RESPONSES.items()}
    # The smallest effect of E1 over all E2, and the largest effect of E2 over all E1.
    by_first = {label: float((s.max(axis=0) / s.min(axis=0)).min() - 1) for label, s in surfaces.items()}
    by_second = {label: float((s.max(axis=1) / s.min(axis=1)).max() - 1) for label, s in surfaces.items()}
    first, second = (
        ", ".join(f"the {label} by {part:.0%}" for label, part in parts.items()) for parts in (by_first, by_second)
    )
    return all(by_second[label] > by_first[label] for label in surfaces), (
        f"Over its range and at the most favourable E1, E2 moves {second}; at the least favourable E2, E1 moves "
        f"{first}."
    )


@PARAMETER_CLAIMS.add(
    "Section 4, text of Figure 15", "(1 - ν1²)/E1 is much larger than (1 - ν2²)/E2, and so ν1 matters more than ν2."
)
def _compliance_of_sphere_and_plate(_: Study) -> Verdict:
    first, second = (float(body.plane_strain_compliance) for body in (YANG2018_SPHERES[1], STEEL))
    local = local_sensitivity(table_4_impact()).peak_force
    ratio = float(local["youngs_modulus"] / local["target_youngs_modulus"])
    return first > 10 * second and bool(local["poisson_ratio"] > local["target_poisson_ratio"]), (
        f"It is {first / second:.0f} times as large, {first / (first + second):.1%} of the whole. Locally E1 matters "
        f"{ratio:.0f} times as much as E2 for the same reason."
    )


_claim_ranking("conclusion 5", "Section 4 and conclusion 5 (Table 4)", paper.CONCLUSION_5)


# ---- section 5: differences between the four spheres ----------------------------------------------------------------


def _spheres(_: Study, quantity: str, factor: float, unit: str) -> Verdict:
    elastic = {str(n): paper_impact(n, SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    damped = {n: paper_impact(int(n), SECTION_5_VELOCITY, restitution=SECTION_5_RESTITUTION) for n in elastic}
    kinds: dict[str, Mapping[str, Any]] = {"": {n: impact.sphere.material for n, impact in elastic.items()}}
    if quantity in RESPONSES:
        kinds = {"elastic": elastic, f"restitution {SECTION_5_RESTITUTION:g}": damped}
    judged = {
        kind: judged_ordering(
            paper.SPHERES_BY[quantity], {n: factor * getattr(one, quantity) for n, one in made.items()}
        )
        for kind, made in kinds.items()
    }
    holds, text = combined(judged)
    return holds, f"{text} [{unit}]." if unit else f"{text}."


for _name, _label, _factor, _unit in (
    ("density", "ρ", 1.0, "kg/m³"),
    ("youngs_modulus", "E", 1e-9, "GPa"),
    ("poisson_ratio", "ν", 1.0, ""),
    ("peak_force", f"maximum force at {SECTION_5_VELOCITY:g} m/s", 1e-3, "kN"),
    ("peak_displacement", f"DCS at {SECTION_5_VELOCITY:g} m/s", 1e3, "mm"),
):
    PARAMETER_CLAIMS.add(
        "Section 5 (Figures 16 and 17)", f"By {_label}: {written(paper.SPHERES_BY[_name])}.",
        f"spheres by {_name}", quantity=_name, factor=_factor, unit=_unit,
    )(_spheres)  # fmt: skip


@PARAMETER_CLAIMS.add(
    "Section 5", "Spheres 1, 2 (coal) differ obviously from spheres 3, 4 (gangue) in maximum force and DCS."
)
def _coal_and_gangue_differ_obviously(_: Study) -> Verdict:
    made = {n: paper_impact(n, SECTION_5_VELOCITY) for n in YANG2018_SPHERES}
    least = {}
    for response, label in RESPONSES.items():
        value = {n: float(getattr(impact, response)) for n, impact in made.items()}
        pairs = {(c, g): max(value[c], value[g]) / min(value[c], value[g]) - 1 for c in (1, 2) for g in (3, 4)}
        least[label] = min((part, pair) for pair, part in pairs.items())
    return min(part for part, _ in least.values()) >= _OBVIOUS, (
        "Smallest difference of a coal from a gangue sphere: "
        + ", ".join(f"{label} {part:.1%} (spheres {pair[0]} and {pair[1]})" for label, (part, pair) in least.items())
        + f" (obvious: {_OBVIOUS:.0%} or more, all at one radius)."
    )

"""Claims of section 4 and conclusions 3 to 5: what each parameter does, and how much it matters."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES
from cgid.physics.sensitivity import Sensitivity, local_sensitivity, range_influence
from cgid.reproduction import impacts, paper
from cgid.reproduction.claims.claim import Claim, judged_exponential, judged_ordering, symbol, trend, written
from cgid.reproduction.figures import FIGURES
from cgid.validation import Floats

OVER_RANGE = "over the range"
_RESPONSES = {"peak_displacement": "DCS", "peak_force": "force"}


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
    impact = impacts.table_5_impact() if equal_bodies else impacts.table_4_impact()
    ranges = paper.TABLE_4 | paper.TABLE_5 if equal_bodies else paper.TABLE_4
    values = {name: values.values for name, values in ranges.items()}
    return {"locally": local_sensitivity(impact), OVER_RANGE: range_influence(impact, values)}


def _ordering(name: str, place: str, ordering: paper.Ordering, *, equal_bodies: bool = False) -> list[Claim]:
    claims = []
    for measure, sensitivity in measures(equal_bodies=equal_bodies).items():
        judged = {r: judged_ordering(ordering, getattr(sensitivity, r)) for r in _RESPONSES}
        note = _where_held() if equal_bodies and measure == OVER_RANGE else ""
        claims.append(
            Claim(
                f"{name}, {measure}",
                place,
                f"Sensitivity of DCS and force, {measure}: {written(ordering)}.",
                "; ".join(f"{_RESPONSES[r]}: {text}" for r, (_, text) in judged.items()) + f".{note}",
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
    impact = impacts.table_4_impact()
    printed = {(c.response, c.parameter): c.value for c in paper.CONSTANTS}
    density = float(np.asarray(YANG2018_SPHERES[1].density))
    per_radius = printed["peak_displacement", "radius"]
    radius = printed["peak_displacement", "density"] * density**0.4 / per_radius
    velocity = impacts.SECTION_4_VELOCITY * (per_radius / float(impact.peak_displacement / YANG2018_RADIUS)) ** 1.25
    held = {"radius": YANG2018_RADIUS, "density": density}
    errors = [float(getattr(impact, c.response)) / held[c.parameter] ** c.power / c.value - 1 for c in paper.CONSTANTS]
    worst = max(map(abs, errors))
    return Claim(
        "constants under Eq. 18",
        "Section 4, under Eq. 18",
        "From Table 4: δ/R, P/R², δ/ρ^(2/5) and P/ρ^(3/5) have the four values printed.",
        f"They belong to an impact speed of {velocity:.9g} m/s, which the paper does not say, and a radius of "
        f"{radius * 1e3:.9g} mm; with {impacts.SECTION_4_VELOCITY:g} m/s, {YANG2018_RADIUS * 1e3:g} mm and the paper's "
        f"own theory all four agree to {worst:.0e}.",
        worst < 1e-12,
    )


def _proportional() -> list[Claim]:
    impact = impacts.table_4_impact()
    found = local_sensitivity(impact)
    wanted = {"radius": (1.0, 2.0), "density": (0.4, 0.6)}
    spread = range_influence(impact, {name: paper.TABLE_4[name].values for name in wanted})
    texts, holds = [], True
    for name, expected in wanted.items():
        values = paper.TABLE_4[name].values
        over_range = [np.log1p(getattr(spread, r)[name]) / np.log(values[-1] / values[0]) for r in _RESPONSES]
        local = [getattr(found, r)[name] for r in _RESPONSES]
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
    return tuple(rows[column].to_numpy() for column in (varied, *_RESPONSES))


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
        for response, label in _RESPONSES.items():
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
    surfaces = {r: _surface("figure_15", *names, r) for r in _RESPONSES}
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
            + ", ".join(f"the {label} by {by_second[r]:.0%}" for r, label in _RESPONSES.items())
            + "; at the least favourable E2, E1 moves "
            + ", ".join(f"the {label} by {by_first[r]:.0%}" for r, label in _RESPONSES.items())
            + ".",
            all(by_second[r] > by_first[r] for r in _RESPONSES),
        ),
    ]


def _compliances() -> Claim:
    first, second = (float(body.plane_strain_compliance) for body in (YANG2018_SPHERES[1], STEEL))
    local = local_sensitivity(impacts.table_4_impact()).peak_force
    ratio = float(local["youngs_modulus"] / local["target_youngs_modulus"])
    return Claim(
        "compliance of sphere and plate",
        "Section 4, text of Figure 15",
        "(1 - ν1²)/E1 is much larger than (1 - ν2²)/E2, and so ν1 matters more than ν2.",
        f"It is {first / second:.0f} times as large, {first / (first + second):.1%} of the whole. Locally E1 matters "
        f"{ratio:.0f} times as much as E2 for the same reason.",
        first > 10 * second and bool(local["poisson_ratio"] > local["target_poisson_ratio"]),
    )

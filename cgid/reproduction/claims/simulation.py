"""Claims that rest on the paper's simulation, judged by the finite elements."""

from __future__ import annotations

import numpy as np

from cgid.physics.materials import YANG2018_SPHERES
from cgid.reproduction import impacts, paper
from cgid.reproduction.claims.claim import Claim, judged_ordering, symbol, written
from cgid.reproduction.finite_element import Study, cases
from cgid.reproduction.finite_element.theories import HIGH_CORRELATION, agreement, of_simulation, size_of_errors
from cgid.reproduction.finite_element.waves import FILTERED, WAVES, filtered_errors, ripples
from cgid.reproduction.impacts import THEORY_LABELS, paper_impact

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
    groups = (cases.UNDAMPED, cases.DAMPED)
    mean = {
        (theory, group): [agreement(study, theory, name, group).error for name in _RESPONSES]
        for theory in THEORY_LABELS
        for group in groups
    }
    own, damped = (mean[impacts.OWN_THEORY, group] for group in groups)
    size = {theory: [size_of_errors(study, theory, _RESPONSES, group) for group in groups] for theory in THEORY_LABELS}
    return [
        Claim(
            "own theory is close to the simulation",
            "Figure 10, conclusion 1",
            "The paper's theory agrees with the simulation in maximum force and DCS.",
            f"Against finite elements ({len(study.of(cases.UNDAMPED))} impacts) it errs by {own[0]:+.0%} in force and "
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
            f"Against the finite elements K1 gives {mean['hertz', cases.UNDAMPED][0]:+.0%}, K2 "
            f"{mean['rigid-sphere', cases.UNDAMPED][0]:+.0%}. (Damping, which none of the theories has, lowers the "
            f"force: against damped impacts of restitution {cases.RESTITUTION:g} K1 gives "
            f"{mean['hertz', cases.DAMPED][0]:+.0%}.)",
            min(mean[theory, cases.UNDAMPED][0] for theory in ("hertz", "rigid-sphere")) > 0,
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
        f"With the {len(study.of(cases.UNDAMPED))} finite-element impacts it is at least "
        + ", ".join(f"{value:.5f} ({symbol(theory)})" for theory, value in least.items())
        + ": it does not see a wrong factor.",
        not fooled,
    )


def _pressure(study: Study) -> Claim:
    printed = [row["peak_pressure"] for row in paper.TABLE_3.values()]
    found = [
        agreement(study, impacts.OWN_THEORY, "peak_pressure", sphere=n).squared_correlation for n in YANG2018_SPHERES
    ]
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
    own = {group: _work(study, group, impacts.OWN_THEORY) for group in (cases.UNDAMPED, cases.DAMPED)}
    hertz = {group: float(np.mean(_work(study, group, "hertz"))) for group in own}
    shown = {group: f"{min(parts):.0%} to {max(parts):.0%}" for group, parts in own.items()}
    return Claim(
        "simulated loops lie around the own theory",
        "Figure 11",
        "During compression the simulated force fluctuates around the curve of the paper's theory.",
        f"Up to the largest DCS of each impact the theory's curve takes {shown[cases.UNDAMPED]} of the work that the "
        f"undamped finite elements take, {shown[cases.DAMPED]} with damping (close: within {_CLOSE:.0%}); K1's takes "
        f"{hertz[cases.UNDAMPED]:.0%} and {hertz[cases.DAMPED]:.0%} in the mean.",
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
                    if run.case.velocity == impacts.SECTION_5_VELOCITY
                },
            )
            for group in (cases.UNDAMPED, cases.DAMPED)
        }
        claims.append(
            Claim(
                f"simulated spheres by {name}",
                place,
                f"Simulated, by {label} at {impacts.SECTION_5_VELOCITY:g} m/s: {written(ordering)}.",
                "; ".join(f"{group}: {text}" for group, (_, text) in judged.items()) + f" [{unit}].",
                all(holds for holds, _ in judged.values()),
            )
        )
    return claims

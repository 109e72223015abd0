"""The three theories against the independent finite-element figures, and the claims that rest on a simulation."""

from __future__ import annotations

import numpy as np

from cgid.reproduction import finite_element, impacts
from cgid.reproduction.claims.claim import Claim, symbol
from cgid.validation import Floats

#: The responses compared, in the order of the columns.
RESPONSES = ("peak_force", "peak_displacement", "contact_duration")
#: A prediction is close to the simulation within this part of it.
_CLOSE = 0.1
#: The paper's threshold for a high correlation, section 3.2.
_HIGH_CORRELATION = 0.96


def finite_element_values() -> Floats:
    """Return the finite-element results, (n_impacts, 3) [N, m, s]."""
    return np.array([[getattr(row, name) for name in RESPONSES] for row in finite_element.IMPACTS])


def theory_values(theory: str) -> Floats:
    """Return what a theory gives for the same impacts, elastic, (n_impacts, 3) [N, m, s]."""
    made = [impacts.paper_impact(row.sphere, row.velocity, theory) for row in finite_element.IMPACTS]
    return np.array([[float(getattr(impact, name)) for name in RESPONSES] for impact in made])


def errors() -> dict[str, Floats]:
    """Return theory over finite elements - 1 of each theory, each (n_impacts, 3)."""
    return {theory: theory_values(theory) / finite_element_values() - 1 for theory in impacts.THEORY_LABELS}


def mean_errors(table: Floats) -> tuple[float, float, float]:
    """Return the mean error of each response."""
    force, displacement, duration = table.mean(axis=0).tolist()
    return force, displacement, duration


def squared_correlation(theory: str) -> tuple[float, float, float]:
    """Return the squared linear correlation of each response: blind to a constant factor."""
    force, displacement, duration = (
        float(np.corrcoef(found, wanted)[0, 1] ** 2)
        for found, wanted in zip(theory_values(theory).T, finite_element_values().T, strict=True)
    )
    return force, displacement, duration


def determination(theory: str) -> tuple[float, float, float]:
    """Return `1 - SSres / SStot` of each response: it sees a wrong factor, and may be negative."""
    wanted = finite_element_values()
    residual = ((theory_values(theory) - wanted) ** 2).sum(axis=0)
    total = ((wanted - wanted.mean(axis=0)) ** 2).sum(axis=0)
    force, displacement, duration = (1 - residual / total).tolist()
    return force, displacement, duration


def simulation_claims() -> list[Claim]:
    """Return the claims that rest on the paper's simulation, judged by the independent finite-element run."""
    found = errors()
    mean = {theory: mean_errors(table) for theory, table in found.items()}
    size = {theory: float(np.abs(table[:, :2]).mean()) for theory, table in found.items()}
    squared = {theory: squared_correlation(theory) for theory in found}
    fooled = [t for t in found if min(squared[t][:2]) > _HIGH_CORRELATION and size[t] > _CLOSE]
    rows = len(finite_element.IMPACTS)
    return [
        Claim(
            "own theory is close to the simulation",
            "Figure 10, conclusion 1",
            "The paper's theory agrees with the simulation in maximum force and DCS.",
            f"Against an independent finite-element run ({rows} impacts) it errs by {mean['series'][0]:+.0%} in force "
            f"and {mean['series'][1]:+.0%} in DCS (close: within {_CLOSE:.0%}).",
            max(abs(value) for value in mean["series"][:2]) <= _CLOSE,
        ),
        Claim(
            "own theory is more accurate",
            "Abstract, conclusion 2",
            "The paper's theory predicts force and DCS more accurately than the traditional theory.",
            "Mean size of the errors against the finite elements: "
            + ", ".join(f"{symbol(theory)} {value:.0%}" for theory, value in size.items())
            + ".",
            size["series"] < min(size["hertz"], size["rigid-sphere"]),
        ),
        Claim(
            "traditional force is too large",
            "Conclusion 2",
            "The maximum contact force of the traditional theory is too large.",
            f"Against the finite elements K1 gives {mean['hertz'][0]:+.0%}, K2 {mean['rigid-sphere'][0]:+.0%}.",
            mean["hertz"][0] > 0 and mean["rigid-sphere"][0] > 0,
        ),
        Claim(
            "squared correlation as a yardstick",
            "Section 3.2, Table 3",
            "A squared correlation above 0.96 between theory and simulation shows that the theory is right.",
            f"With the {rows} finite-element impacts it is at least "
            + ", ".join(f"{min(squared[theory][:2]):.5f} ({symbol(theory)})" for theory in found)
            + ": it does not see a wrong factor.",
            not fooled,
        ),
    ]

"""The theories next to the finite-element study: their numbers, errors and Table 3."""

from __future__ import annotations

import numpy as np
import pytest

from studies.paper import theories
from studies.paper.simulated import SIMULATED_FIGURES
from studies.paper.study import ELEMENT_SIZES, SOFT, UNDAMPED, shipped_study
from studies.paper.tables import table_3
from studies.tests.impacts_by_hand import FACTORS, RADIUS, RESPONSES, SPHERES, STEEL_COMPLIANCE, by_hand, table

#: An independent program's mean errors of the theories over all twenty: force, DCS, contact time.
INDEPENDENT_ERRORS = {
    "hertz": (-0.06, 0.05, 0.05),
    "rigid-sphere": (0.12, -0.12, -0.11),
    "series": (-0.33, 0.47, 0.48),
}


@pytest.fixture(scope="module")
def study():
    return shipped_study()


@pytest.mark.parametrize("theory", FACTORS)
def test_theories_by_hand(theory):
    for sphere in SPHERES:
        found = theories.predicted(theory, sphere, (2.0, 10.0))
        for place, velocity in enumerate((2.0, 10.0)):
            wanted = by_hand(theory, sphere, velocity)
            for name in (*RESPONSES, "peak_pressure"):
                assert found[name][place] == pytest.approx(wanted[name], rel=1e-9)
            energies = found["peak_sphere_energy"][place], found["peak_plate_energy"][place]
            part = {"hertz": 1, "rigid-sphere": 0, "series": 4 / 7}[theory]
            assert energies == pytest.approx((part * wanted["energy"], (1 - part) * wanted["energy"]), rel=1e-12)


def test_energy_of_hertz_goes_with_the_compliance():
    for sphere, (_, modulus, nu) in SPHERES.items():
        compliance = (1 - nu**2) / modulus
        part = compliance / (compliance + STEEL_COMPLIANCE)
        assert theories.sphere_part(theories.SHARED, sphere) == pytest.approx(part, rel=1e-12)


def test_pressure_of_k1_is_that_of_hertz():
    """The textbook's p0 = (6 P E^2 / (pi^3 R^2))^(1/3)."""
    found = theories.predicted("hertz", 1, (4.0,))
    modulus = 1 / ((1 - 0.28**2) / 2.26e9 + STEEL_COMPLIANCE)
    wanted = (6 * found["peak_force"][0] * modulus**2 / (np.pi**3 * RADIUS**2)) ** (1 / 3)
    assert found["peak_pressure"][0] == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("theory", FACTORS)
def test_errors_over_the_twenty_and_both_yardsticks(study, theory):
    rows = table(study)
    for name, independent in zip(RESPONSES, INDEPENDENT_ERRORS[theory], strict=True):
        theoretical = np.array([by_hand(theory, row.sphere, row.velocity)[name] for row in rows.itertuples()])
        simulated = rows[name].to_numpy()
        found = theories.agreement(study, theory, name)
        assert found.error == pytest.approx(np.mean(theoretical / simulated) - 1, abs=1e-9)
        assert found.error == pytest.approx(independent, abs=0.02)
        assert found.squared_correlation == pytest.approx(np.corrcoef(theoretical, simulated)[0, 1] ** 2, abs=1e-9)
        residual = np.sum((theoretical - simulated) ** 2) / np.sum((simulated - simulated.mean()) ** 2)
        assert found.determination == pytest.approx(1 - residual, abs=1e-7)
        # The paper's yardstick cannot tell them apart.
        assert found.squared_correlation > 0.998
        if theory == "hertz":
            assert found.determination > 0.96


def test_yardstick_that_sees_a_factor_condemns_the_series_theory(study):
    for sphere in SPHERES:
        force, displacement = (
            theories.agreement(study, "series", name, sphere=sphere) for name in ("peak_force", "peak_displacement")
        )
        assert 0.48 < force.determination < 0.56 and displacement.determination < 0
        assert min(force.squared_correlation, displacement.squared_correlation) > 0.999


def test_table_3(study):
    made = table_3(study)
    assert len(made.data) == 4 * 4 * 5 and len(made.cells) == 4 * 5
    rows = made.data.set_index(["sphere", "theory", "quantity"])
    printed = rows["printed_squared_correlation"].dropna()
    assert len(printed) == 20 and printed[(3, "series", "peak_pressure")] == 0.7483
    # K1 in the paper's words has nothing in the plate: one value, no correlation.
    assert np.isnan(rows.loc[(1, "hertz", "peak_plate_energy"), "squared_correlation"])
    assert rows.loc[(1, theories.SHARED, "peak_sphere_energy"), "determination"] > 0.99
    (row,) = (cells for cells in made.cells[:5] if cells[1] == "K1")
    assert row[-1].startswith("\N{EM DASH} / -")


def test_soft_contact_moves_the_finite_elements_to_the_series_theory(study):
    hard, soft = (table(study, group) for group in (UNDAMPED, SOFT))
    ratio = soft[list(RESPONSES)] / hard[list(RESPONSES)]
    assert (ratio["peak_force"] < 0.95).all() and (ratio["peak_displacement"] > 1.1).all()
    errors = {
        group: {theory: theories.agreement(study, theory, "peak_force", group) for theory in ("hertz", "series")}
        for group in ELEMENT_SIZES
    }
    for group in ELEMENT_SIZES:
        assert errors[group]["series"].determination > 0.95 > errors[group]["hertz"].determination


def test_a_stiff_penalty_is_a_hard_contact(study):
    data = SIMULATED_FIGURES["penalty_factor"](study).data
    rows = data[data["kind"] == "simulation"]
    for _, of_sphere in rows.groupby("sphere"):
        assert np.all(np.diff(of_sphere["force_over_hard"]) > 0)
        assert np.all(np.diff(of_sphere["displacement_over_hard"]) < 0)
        assert of_sphere["force_over_hard"].iloc[-1] == pytest.approx(1, abs=0.003)

"""The finite-element study of the paper: what is shipped, what it says of the theories, how it is made and kept."""

from __future__ import annotations

import dataclasses
import io
import re
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue, NoInput
from cgid.filters import fft_filter
from cgid.reproduction import n_steps, reproduce
from cgid.reproduction.claims import simulation
from cgid.reproduction.finite_element import cases, packed, read_study, running, shipped_study, theories, waves
from cgid.reproduction.finite_element.figures import SIMULATED_FIGURES
from cgid.reproduction.finite_element.section import finite_element_section
from cgid.reproduction.finite_element.study import COURSES, NUMBERS, Run, Study
from cgid.reproduction.finite_element.table import table_3
from cgid.signals import Signal

# rho, E, nu of Table 2 of the paper, written again.
SPHERES = {1: (1380, 2.26e9, 0.28), 2: (1550.6, 4.3e9, 0.30), 3: (2412, 21.64e9, 0.30), 4: (2400, 3.906e9, 0.28)}
RADIUS, STEEL_COMPLIANCE = 0.025, 0.91 / 210e9
FACTORS = {"hertz": 1.0, "rigid-sphere": 8 * 3**0.5 / 9, "series": 1.75**-1.5}
#: An independent program's force [N], DCS [m] and contact time [s] of four of the impacts.
INDEPENDENT = {
    (1, 2.0): (1.98e3, 0.231e-3, 338e-6),
    (1, 10.0): (14.20e3, 0.811e-3, 239e-6),
    (3, 2.0): (6.57e3, 0.121e-3, 177e-6),
    (3, 10.0): (46.66e3, 0.428e-3, 125e-6),
}
#: The same program's mean errors of the theories over all twenty: force, DCS, contact time.
INDEPENDENT_ERRORS = {
    "hertz": (-0.06, 0.05, 0.05),
    "rigid-sphere": (0.12, -0.12, -0.11),
    "series": (-0.33, 0.47, 0.48),
}
RESPONSES = ("peak_force", "peak_displacement", "contact_duration")


@pytest.fixture(scope="module")
def study():
    return shipped_study()


def table(study, group=cases.UNDAMPED):
    """Return sphere, speed and numbers of a group, a row for each impact."""
    return pd.DataFrame(
        [{"sphere": found.case.sphere, "velocity": found.case.velocity, **found.numbers} for found in study.of(group)]
    )


def by_hand(theory, sphere, velocity):
    """Return force, DCS, contact time, pressure and energy of an elastic impact, from the formulas."""
    density, modulus, nu = SPHERES[sphere]
    mass = 4 / 3 * np.pi * RADIUS**3 * density
    stiffness = FACTORS[theory] * 4 / 3 * RADIUS**0.5 / ((1 - nu**2) / modulus + STEEL_COMPLIANCE)
    displacement = (5 * mass * velocity**2 / (4 * stiffness)) ** 0.4
    force = stiffness * displacement**1.5
    return {
        "peak_force": force,
        "peak_displacement": displacement,
        "contact_duration": 2.943275184 * displacement / velocity,
        "peak_pressure": 3 * force / (2 * np.pi * RADIUS * displacement),
        "energy": mass * velocity**2 / 2,
    }


# ---- what is shipped ------------------------------------------------------------------------------------------------


def test_every_case_is_there_as_it_is_chosen_today(study):
    wanted = cases.all_cases()
    assert len(study.runs) == len(wanted) == cases.N_CASES == n_steps(finite_element=True) - n_steps()
    for found, case in zip(study.runs, wanted, strict=True):
        assert (found.case.group, found.case.sphere) == (case.group, case.sphere)
        for name in ("velocity", "retardation_time", "penalty_factor"):
            assert getattr(found.case, name) == pytest.approx(getattr(case, name), rel=1e-9)
    assert study.made == running.made()


def test_independent_program_agrees(study):
    rows = table(study).set_index(["sphere", "velocity"])
    for place, wanted in INDEPENDENT.items():
        assert rows.loc[place, list(RESPONSES)].to_numpy() == pytest.approx(wanted, rel=0.01)


def test_balances(study):
    rows = table(study)
    assert len(rows) == 20
    assert rows["energy_error"].max() < 1e-6 and rows["momentum_error"].max() < 1e-6
    assert rows["restitution"].between(0.99, 1.0).all()
    for row in rows.itertuples():
        energy = by_hand("hertz", row.sphere, row.velocity)["energy"]
        # Nearly all of it is elastic at some moment, and both have their peaks at nearly the same.
        assert (row.peak_sphere_energy + row.peak_plate_energy) / energy == pytest.approx(1, abs=1e-3)
    assert table(study, cases.DAMPED)["energy_error"].isna().all()


def test_damped_spheres_have_the_restitution_of_kuwabara_and_kono(study):
    assert table(study, cases.DAMPED)["restitution"].to_numpy() == pytest.approx(cases.RESTITUTION, abs=0.015)
    assert len({run.case.retardation_time for run in study.of(cases.DAMPED)}) == 20


def test_courses_and_peaks_belong_together(study):
    kept = {cases.UNDAMPED: set(COURSES), cases.DAMPED: set(COURSES)}
    kept |= {group: {"force", "displacement"} for group in cases.ELEMENT_SIZES}
    for found in study.runs:
        assert set(found.courses) == kept.get(found.case.group, set())
        if found.courses:
            assert found.times[0] == 0 and found.times[-1] == pytest.approx(found.duration)
            assert found.duration > 1.1 * found.numbers["contact_duration"]
            for course, peak in (("force", "peak_force"), ("displacement", "peak_displacement")):
                assert found.courses[course].max() == pytest.approx(found.numbers[peak], rel=2e-3)
            mass = 4 / 3 * np.pi * RADIUS**3 * SPHERES[found.case.sphere][0]
            impulse = np.trapezoid(found.courses["force"], found.times)
            change = (1 + found.numbers["restitution"]) * mass * found.case.velocity
            assert impulse == pytest.approx(change, rel=2e-3)


# ---- the theories ---------------------------------------------------------------------------------------------------


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
    hard, soft = (table(study, group) for group in (cases.UNDAMPED, cases.SOFT))
    ratio = soft[list(RESPONSES)] / hard[list(RESPONSES)]
    assert (ratio["peak_force"] < 0.95).all() and (ratio["peak_displacement"] > 1.1).all()
    errors = {
        group: {theory: theories.agreement(study, theory, "peak_force", group) for theory in ("hertz", "series")}
        for group in cases.ELEMENT_SIZES
    }
    for group in cases.ELEMENT_SIZES:
        assert errors[group]["series"].determination > 0.95 > errors[group]["hertz"].determination


def test_a_stiff_penalty_is_a_hard_contact(study):
    data = SIMULATED_FIGURES["penalty_factor"](study).data
    rows = data[data["kind"] == "simulation"]
    for _, of_sphere in rows.groupby("sphere"):
        assert np.all(np.diff(of_sphere["force_over_hard"]) > 0)
        assert np.all(np.diff(of_sphere["displacement_over_hard"]) < 0)
        assert of_sphere["force_over_hard"].iloc[-1] == pytest.approx(1, abs=0.003)


# ---- claims and report ----------------------------------------------------------------------------------------------


def as_series(study):
    """Return a study whose undamped impacts are those of the series theory."""
    runs = []
    for found in study.runs:
        if found.case.group == cases.UNDAMPED:
            wanted = theories.predicted("series", found.case.sphere, (found.case.velocity,))
            found = dataclasses.replace(found, numbers={**found.numbers, **{k: float(v[0]) for k, v in wanted.items()}})
        runs.append(found)
    return dataclasses.replace(study, runs=tuple(runs))


def test_verdicts_follow_the_numbers(study):
    """A finite-element run that agreed with the series theory would turn the verdicts over."""
    names = (
        "own theory is close to the simulation",
        "own theory is more accurate",
        "traditional force is too large",
        "squared correlation as a yardstick",
    )
    found, turned = (
        {claim.name: claim.holds for claim in simulation.simulation_claims(each)} for each in (study, as_series(study))
    )
    assert [found[name] for name in names] == [False] * 4
    assert [turned[name] for name in names] == [True, True, True, False]
    assert "**They support series (the paper's own).**" in "\n".join(finite_element_section(as_series(study)))


def test_filtered_peaks_are_those_of_the_contact_force(study):
    at_4, at_5 = (np.abs(waves.filtered_errors(study, edge)) for edge in (4, 5))
    assert at_4.max() < 0.015 < at_5.max()


def test_the_force_is_smooth_and_the_centre_is_not(study):
    for found in study.of(cases.UNDAMPED):
        assert waves.ripple(found, "force") < 0.01
        assert waves.ripple(found, "centre_node_force") > 0.3


def test_a_report_without_words_that_the_numbers_do_not_bear_out(study):
    text = "\n".join(finite_element_section(study))
    assert "**They support K1 (Hertz).**" in text and "counts it twice" in text
    assert text.count("| 3, 10 m/s |") == 1 and "not proven" in text
    assert re.search(r"\| K1 \(Hertz\) \| -6\.\d% / \+4\.\d% / \+4\.\d% \|", text)
    assert re.search(r"own\) \| -32\.\d% / \+46\.\d% / \+46\.\d% \|", text)


@pytest.mark.parametrize("name", sorted(SIMULATED_FIGURES))
def test_every_panel_has_lines(study, name):
    figure = SIMULATED_FIGURES[name](study)
    assert 0 < figure.highest_strain < 0.1
    for panel in figure.panels:
        for lines in (panel, *panel.over):
            rows = figure.data
            for column, value in lines.where.items():
                rows = rows[rows[column] == value]
            assert np.isfinite(rows[[lines.x, lines.y]].to_numpy(np.float64)).any()


# ---- how it is made -------------------------------------------------------------------------------------------------


def test_a_case_computed_again_is_the_shipped_one(study):
    """The quickest of the cases, with the real solver."""
    place = [(found.case.group, found.case.sphere, found.case.velocity) for found in study.runs].index(
        (cases.UNDAMPED, 3, 10.0)
    )
    shipped, again = study.runs[place], running.computed(running.N_POINTS, cases.all_cases()[place])
    for name in NUMBERS:
        if not name.endswith("error"):
            # What hangs on the waves' last digits is the same to fewer.
            assert again.numbers[name] == pytest.approx(shipped.numbers[name], rel=1e-4), name
    assert again.courses["force"] == pytest.approx(shipped.courses["force"], abs=1e-4 * again.numbers["peak_force"])


def history(velocity=2.0):
    """Return what the solver would return of a half sine with a wave on the centre node's force."""
    times = np.arange(2501) / 2000 * 300e-6

    def signal(samples):
        return Signal(samples=samples, sampling_rate=2000 / 300e-6)

    force = np.where(times < 300e-6, 1e3 * np.sin(np.pi * times / 300e-6) ** 2, 0)
    centre = force + 400 * np.sin(2 * np.pi * 8 / 300e-6 * times)
    return SimpleNamespace(
        contact_force=signal(force), centre_displacement=signal(force * 1e-7), contact_pressure=signal(force * 1e5),
        sphere_energy=signal(force * 1e-3), plate_energy=signal(force * 1e-5), centre_node_force=signal(centre),
        peak_force=1e3, peak_displacement=1e-4, peak_pressure=1e8, peak_sphere_energy=1.0, peak_plate_energy=0.01,
        contact_duration=300e-6, times=times, restitution=1.0, momentum_error=1e-9, energy_error=None,
    )  # fmt: skip


def test_what_is_kept_of_a_history():
    case = cases.Case(group=cases.DAMPED, sphere=1, velocity=2.0, retardation_time=1e-5)
    kept = running.shortened(case, history(), 126)
    assert set(kept.numbers) == set(NUMBERS) and np.isnan(kept.numbers["energy_error"])
    assert set(kept.courses) == set(COURSES) and kept.times.size == 126
    assert kept.duration == pytest.approx(375e-6)
    assert kept.courses["force"][50] == pytest.approx(1e3 * np.sin(np.pi / 2) ** 2, rel=1e-12)
    # The low-pass at 4/T takes the wave at 8/T off.
    assert kept.numbers["filtered_at_4"] == pytest.approx(1e3, rel=0.03)
    assert kept.courses["centre_node_force"].max() > 1.2e3
    soft = dataclasses.replace(case, group=cases.SOFT_BY_FACTOR, penalty_factor=0.1)
    assert running.shortened(soft, history(), 126).courses == {}


def test_low_pass_does_not_ring_round_the_ends():
    """A course that ends high must not disturb its own beginning."""
    signal = Signal(samples=np.concatenate((np.zeros(500), np.full(500, 1.0))), sampling_rate=1e6)
    quiet = waves.low_passed(signal.samples, signal.sampling_rate, 2e4)[:100]
    assert np.abs(quiet).max() < 0.1 * np.abs(fft_filter(signal.samples, 1e6, high=2e4)[:100]).max() + 0.02


def few(study):
    """Return a study of three runs, and what makes them."""
    made = {(found.case.group, found.case.sphere, found.case.velocity): found for found in study.runs}
    chosen = [study.runs[k] for k in (0, 20, 60)]
    return chosen, lambda n_points, case: made[case.group, case.sphere, case.velocity]


def test_runs_come_in_order_and_are_counted(study, monkeypatch):
    chosen, compute = few(study)
    monkeypatch.setattr(running, "all_cases", lambda: [found.case for found in chosen])
    monkeypatch.setattr(running, "computed", compute)
    steps = []
    found = running.run_study(1, steps.append)
    assert list(found.runs) == chosen and steps == [1, 1, 1] and found.made == running.made()
    with pytest.raises(InvalidValue, match="jobs must be 1 or more, got 0"):
        running.run_study(0)


def test_command_makes_the_study_anew_and_writes_it(study, monkeypatch, tmp_path, capsys):
    asked = []

    def computed(jobs, progress):
        asked.append(jobs)
        for _ in range(cases.N_CASES):
            progress(1)
        return study

    monkeypatch.setattr("cgid.reproduction.output.run_study", computed)
    # Drawing is not what is tested here.
    monkeypatch.setattr("cgid.reproduction.output.draw", lambda *_: b"picture")
    monkeypatch.setattr("cgid.reproduction.output.draw_table", lambda *_: b"picture")
    assert run(["reproduce", "--finite-element", "--jobs", "3", "-o", str(tmp_path / "out")]) == 0
    assert asked == [3]
    assert str(tmp_path / "out" / "finite_element.npz") in capsys.readouterr().out
    assert (tmp_path / "out" / "finite_element.npz").read_bytes() == packed(study)
    steps = []
    reproduce(tmp_path / "again", finite_element=True, progress=steps.append)
    assert asked == [3, None] and steps == [1] * n_steps(finite_element=True)
    reproduce(tmp_path / "shipped")
    assert asked == [3, None] and not (tmp_path / "shipped" / "finite_element.npz").exists()


@pytest.mark.parametrize(
    ("options", "exit_code", "says"),
    [
        (["--jobs", "2"], 65, "jobs are for the finite-element study"),
        (["--finite-element", "--jobs", "0"], 65, "jobs must be 1 or more, got 0"),
        (["--finite-element", "--jobs", "two"], 2, "--jobs"),
    ],
)
def test_bad_options(options, exit_code, says, tmp_path, capsys):
    assert run(["reproduce", "-o", str(tmp_path / "out"), *options]) == exit_code
    out, err = capsys.readouterr()
    assert out == "" and says in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


# ---- the data file --------------------------------------------------------------------------------------------------


def test_what_is_packed_is_read_again(study, tmp_path):
    (tmp_path / "study.npz").write_bytes(packed(study))
    again = read_study(tmp_path / "study.npz")
    assert again.made == study.made and [found.case for found in again.runs] == [found.case for found in study.runs]
    for found, wanted in zip(again.runs, study.runs, strict=True):
        assert found.numbers == pytest.approx(wanted.numbers, rel=0, nan_ok=True)
        assert found.duration == wanted.duration and set(found.courses) == set(wanted.courses)
        assert all(np.array_equal(found.courses[name], wanted.courses[name]) for name in wanted.courses)
    assert packed(again) == packed(study)


def test_small_enough_to_ship(study):
    assert len(packed(study)) < 400_000


def without(study, name):
    with np.load(io.BytesIO(packed(study))) as stored:
        arrays = {key: stored[key] for key in stored.files if key != name}
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        lambda study: b"",
        lambda study: b"no archive at all",
        lambda study: packed(study)[:5000],
        lambda study: without(study, "peak_force"),
        lambda study: without(study, "course_force"),
        lambda study: with_objects(),
    ],
)
def test_damaged_files_are_refused(content, study, tmp_path):
    path = tmp_path / "study.npz"
    path.write_bytes(content(study))
    with pytest.raises(BadData, match="must hold a finite-element study"):
        read_study(path)


def with_objects():
    """Return an archive that would have to be unpickled."""
    stream = io.BytesIO()
    np.savez(stream, made=np.array([{}], object))
    return stream.getvalue()


def test_missing_file_says_its_cure(tmp_path):
    with pytest.raises(NoInput, match="--finite-element"):
        read_study(tmp_path / "study.npz")


def test_a_run_without_courses_has_no_times():
    bare = Run(case=cases.all_cases()[-1], numbers=dict.fromkeys(NUMBERS, 1.0), duration=1e-4, courses={})
    assert read_back(Study(runs=(bare,), made="by hand")).runs[0].courses == {}


def read_back(study):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "study.npz").write_bytes(packed(study))
        return read_study(Path(folder) / "study.npz")

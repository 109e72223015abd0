"""The finite-element study of the paper: what is shipped, and how it is made."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.measure.filters import fft_filter
from cgid.signals import Signal
from studies.paper import study as running
from studies.paper.study import (
    COURSES,
    DAMPED,
    ELEMENT_SIZES,
    N_CASES,
    NUMBERS,
    RESTITUTION,
    SOFT_2_MM,
    SOFT_BY_FACTOR,
    UNDAMPED,
    Case,
    Run,
    Study,
    all_cases,
    packed,
    shipped_study,
    unpacked,
)
from studies.tests.impacts_by_hand import RADIUS, RESPONSES, SPHERES, by_hand, table

#: An independent program's force [N], DCS [m] and contact time [s] of four of the impacts.
INDEPENDENT = {
    (1, 2.0): (1.98e3, 0.231e-3, 338e-6),
    (1, 10.0): (14.20e3, 0.811e-3, 239e-6),
    (3, 2.0): (6.57e3, 0.121e-3, 177e-6),
    (3, 10.0): (46.66e3, 0.428e-3, 125e-6),
}


@pytest.fixture(scope="module")
def study():
    return shipped_study()


# ---- what is shipped ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_every_case_is_there_as_it_is_chosen_today(study):
    wanted = all_cases()
    assert len(study.runs) == len(wanted) == N_CASES
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
    assert table(study, DAMPED)["energy_error"].isna().all()


def test_damped_spheres_have_the_restitution_of_kuwabara_and_kono(study):
    assert table(study, DAMPED)["restitution"].to_numpy() == pytest.approx(RESTITUTION, abs=0.015)
    assert len({run.case.retardation_time for run in study.of(DAMPED)}) == 20


def test_courses_and_peaks_belong_together(study):
    kept = {UNDAMPED: set(COURSES), DAMPED: set(COURSES)}
    kept |= {group: {"force", "displacement"} for group in ELEMENT_SIZES}
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


# ---- how it is made -------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("group", [UNDAMPED, SOFT_2_MM, DAMPED])
def test_a_case_computed_again_is_the_shipped_one(study, group):
    """The quickest of the cases of a group, with the real solver (damped: its implicit steps)."""
    place = [(found.case.group, found.case.sphere, found.case.velocity) for found in study.runs].index((group, 3, 10.0))
    shipped, again = study.runs[place], running.computed(running.N_POINTS, all_cases()[place])
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
    case = Case(group=DAMPED, sphere=1, velocity=2.0, retardation_time=1e-5)
    kept = running.shortened(case, history(), 126)
    assert set(kept.numbers) == set(NUMBERS) and np.isnan(kept.numbers["energy_error"])
    assert set(kept.courses) == set(COURSES) and kept.times.size == 126
    assert kept.duration == pytest.approx(375e-6)
    assert kept.courses["force"][50] == pytest.approx(1e3 * np.sin(np.pi / 2) ** 2, rel=1e-12)
    # The low-pass at 4/T takes the wave at 8/T off.
    assert kept.numbers["filtered_at_4"] == pytest.approx(1e3, rel=0.03)
    assert kept.courses["centre_node_force"].max() > 1.2e3
    soft = dataclasses.replace(case, group=SOFT_BY_FACTOR, penalty_factor=0.1)
    assert running.shortened(soft, history(), 126).courses == {}


def test_low_pass_does_not_ring_round_the_ends():
    """A course that ends high must not disturb its own beginning."""
    signal = Signal(samples=np.concatenate((np.zeros(500), np.full(500, 1.0))), sampling_rate=1e6)
    quiet = running.low_passed(signal.samples, signal.sampling_rate, 2e4)[:100]
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
    with pytest.raises(InvalidValue, match="jobs"):
        running.run_study(0)


# ---- the data file --------------------------------------------------------------------------------------------------


def test_what_is_packed_is_read_again(study):
    again = unpacked(packed(study))
    assert again.made == study.made and [found.case for found in again.runs] == [found.case for found in study.runs]
    for found, wanted in zip(again.runs, study.runs, strict=True):
        assert found.numbers == pytest.approx(wanted.numbers, rel=0, nan_ok=True)
        assert found.duration == wanted.duration and set(found.courses) == set(wanted.courses)
        assert all(np.array_equal(found.courses[name], wanted.courses[name]) for name in wanted.courses)
    assert packed(again) == packed(study)


def test_small_enough_to_ship(study):
    assert len(packed(study)) < 400_000


def test_a_run_without_courses_has_no_times():
    case = Case(group=SOFT_BY_FACTOR, sphere=1, velocity=6.0, penalty_factor=0.1)
    bare = Run(case=case, numbers=dict.fromkeys(NUMBERS, 1.0), duration=1e-4, courses={})
    (again,) = unpacked(packed(Study(runs=(bare,), made="by hand"))).runs
    assert again.case == bare.case and again.courses == {}
    assert bare.times.size == again.times.size == 0

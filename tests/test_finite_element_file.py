"""The data file of the finite-element study: what is written is read again, and what is none is refused."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest

from cgid.errors import BadData, NoInput
from cgid.reproduction.study import NUMBERS, Run, Study, all_cases, packed, read_study, shipped_study


@pytest.fixture(scope="module")
def study():
    return shipped_study()


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


def with_changed(study, **changed):
    """Return the file of a study with other arrays; those that are None are left out."""
    with np.load(io.BytesIO(packed(study))) as stored:
        arrays = {**stored, **changed}
    return archive(**{name: array for name, array in arrays.items() if array is not None})


def archive(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def plain_array():
    stream = io.BytesIO()
    np.save(stream, np.arange(3.0))
    return stream.getvalue()


def with_one(study, name, value):
    """Return the file of a study with one value of a column (or course) exchanged."""
    with np.load(io.BytesIO(packed(study))) as stored:
        array = stored[name].copy()
    array[(0,) * array.ndim] = value
    return with_changed(study, **{name: array})


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (lambda study: b"", "No data left"),
        (lambda study: b"no archive at all", "allow_pickle"),
        (lambda study: packed(study)[:5000], "zip"),
        (lambda study: encrypted(packed(study)), "encrypted"),
        (lambda study: plain_array(), "single array"),
        (lambda study: archive(made=np.array([{}], object)), "allow_pickle"),
        (lambda study: with_changed(study, peak_force=None), "peak_force is missing"),
        (lambda study: with_changed(study, course_force=None), "course_force is missing"),
        (lambda study: with_changed(study, made=np.array(3.0)), "made must be one text"),
        (lambda study: with_changed(study, sphere=np.array(3)), r"sphere must be 114 whole numbers, got int64 \(\)"),
        (lambda study: with_changed(study, velocity=np.full(114, "fast")), "velocity must be 114 numbers in floating"),
        (lambda study: with_changed(study, duration=np.ones(113)), r"duration must be 114 .* got float64 \(113,\)"),
        (lambda study: with_one(study, "peak_force", np.nan), "peak_force must be finite everywhere"),
        (lambda study: with_one(study, "velocity", np.inf), "velocity must be finite everywhere"),
        (lambda study: with_one(study, "course_force", np.nan), "course_force must be finite everywhere"),
        (lambda study: with_one(study, "group", "unheard"), "group must be one of undamped, .* got unheard"),
        (lambda study: with_one(study, "sphere", 7), "sphere must be a number of Table 2, got 7"),
        (lambda study: with_one(study, "runs_force", 114), "runs_force must be places among 114 impacts"),
        (lambda study: with_one(study, "runs_force", -1), "runs_force must be places among 114 impacts"),
        (lambda study: with_one(study, "runs_force", 1), "each once"),
        (lambda study: with_changed(study, course_force=np.ones((2, 200))), "course_force must be .* courses"),
        (lambda study: with_changed(study, course_pressure=np.ones((40, 3))), r"one number of points, got \[3, 200\]"),
    ],
)
def test_damaged_files_are_refused(content, fault, study, tmp_path):
    path = tmp_path / "study.npz"
    path.write_bytes(content(study))
    with pytest.raises(BadData, match=f"must hold a finite-element study, and cannot be read .*{fault}") as caught:
        read_study(path)
    assert "\n" not in str(caught.value)


def encrypted(content):
    """Return an archive whose members say that they are encrypted."""
    changed = bytearray(content)
    for mark, place in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        for found in re.finditer(re.escape(mark), content):
            changed[found.start() + place] |= 1
    return bytes(changed)


def test_missing_file_says_its_cure(tmp_path):
    with pytest.raises(NoInput, match="--finite-element"):
        read_study(tmp_path / "study.npz")


def test_a_run_without_courses_has_no_times(tmp_path):
    bare = Run(case=all_cases()[-1], numbers=dict.fromkeys(NUMBERS, 1.0), duration=1e-4, courses={})
    (tmp_path / "study.npz").write_bytes(packed(Study(runs=(bare,), made="by hand")))
    (again,) = read_study(tmp_path / "study.npz").runs
    assert again.case == bare.case and again.courses == {}
    assert bare.times.size == again.times.size == 0

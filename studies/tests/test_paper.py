"""The paper's figures and tables: their numbers against formulas written out again here, and their files."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies.paper import __main__ as command
from studies.paper import study as running
from studies.paper.drawing import drawing
from studies.paper.figures import FIGURES, REJECTED
from studies.paper.simulated import SIMULATED_FIGURES
from studies.paper.study import Study, packed, shipped_study
from studies.tests.impacts_by_hand import FACTORS, SPHERES

NAMES = {*FIGURES, *SIMULATED_FIGURES, "table_1", "table_2", "table_3", "table_4", "table_5"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return what the command writes; of the pictures, a figure and a table are drawn, the others are copies."""
    found = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        for name in ("draw", "draw_table"):
            patch.setattr(command, name, drawn_once(getattr(command, name)))
        assert command.main(["-o", str(found)]) == 0
    return found


def drawn_once(draw):
    pictures = []

    def drawn(*arguments):
        if not pictures:
            pictures.append(draw(*arguments))
        return pictures[0]

    return drawn


def read(folder: Path, name: str) -> pd.DataFrame:
    """Return the CSV data with the units taken off the names."""
    data = pd.read_csv(folder / f"{name}.csv")
    return data.rename(columns=lambda title: title.split(" [")[0])


def peaks(velocity, density=1380, modulus=2.26e9, nu=0.28, modulus_2=210e9, nu_2=0.3, radius=0.025, theory="series"):
    """Return peak force and DCS of an elastic impact on a half space."""
    mass = 4 / 3 * np.pi * radius**3 * density
    stiffness = FACTORS[theory] * 4 / 3 * radius**0.5 / ((1 - nu**2) / modulus + (1 - nu_2**2) / modulus_2)
    displacement = (5 * mass * velocity**2 / (4 * stiffness)) ** 0.4
    return stiffness * displacement**1.5, displacement


def test_every_figure_and_table_is_a_picture_and_data_on_the_page(folder):
    assert len(NAMES) == 27
    expected = {f"{name}.{ending}" for name in NAMES for ending in ("png", "csv")} | {"index.md"}
    assert {path.name for path in folder.iterdir()} == expected
    for name in expected - {"index.md"}:
        assert f"({name})" in (folder / "index.md").read_text()
        assert not name.endswith("png") or len((folder / name).read_bytes()) > 5000


@pytest.mark.long
def test_every_picture_is_drawn(tmp_path):
    command.write(tmp_path / "out")
    pictures = {path.read_bytes() for path in (tmp_path / "out").glob("*.png")}
    assert len(pictures) == len(NAMES) and all(one.startswith(b"\x89PNG\r\n") for one in pictures)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_columns_of_numbers_name_their_unit(folder, name):
    with (folder / f"{name}.csv").open(newline="") as stream:
        heads, *rows = list(csv.reader(stream))
    without_unit = {
        "sphere",
        "theory",
        "varied",
        "body",
        "parameter",
        "unit",
        "held",
        "start",
        "step",
        "stop",
        "values",
        "kind",
        "group",
        "quantity",
    }
    assert all(re.fullmatch(r"\w+ \[\S+\]", head) or head in without_unit for head in heads)
    assert rows and all(len(row) == len(heads) for row in rows)


def test_figures_4_to_6(folder):
    for name in ("figure_04", "figure_05", "figure_06"):
        data = read(folder, name)
        assert set(data["theory"]) == set(FACTORS)
        for theory, rows in data.groupby("theory"):
            force, displacement = peaks(rows["velocity"], theory=theory)
            if name != "figure_04":
                assert np.allclose(rows["peak_force"], force, rtol=1e-9)
            if name != "figure_05":
                assert np.allclose(rows["peak_displacement"], displacement, rtol=1e-9)


def test_figure_7(folder):
    data = read(folder, "figure_07")
    force, displacement = peaks(np.sqrt(2 * 9.8 * data["drop_height"]))
    assert np.allclose(data["peak_force"], force, rtol=1e-9)
    assert np.allclose(data["peak_displacement"], displacement, rtol=1e-9)


def test_figure_10(folder):
    maxima, pulses = read(folder, "figure_10_peaks"), read(folder, "figure_10_pulses")
    assert len(maxima) == 20
    for row in maxima.itertuples():
        force, displacement = peaks(row.velocity, *SPHERES[row.sphere])
        assert (row.peak_force, row.peak_displacement) == pytest.approx((force, displacement), rel=1e-9)
        pulse = pulses[(pulses["sphere"] == row.sphere) & (pulses["velocity"] == row.velocity)]
        assert pulse["time"].max() == pytest.approx(2.943275184 * displacement / row.velocity, rel=1e-9)
        middle = pulse.iloc[100]
        assert (middle["force"], middle["displacement"]) == pytest.approx((force, displacement), rel=1e-9)
        # Hertz's law at every sample.
        assert np.allclose(pulse["force"], force * (pulse["displacement"] / displacement) ** 1.5, atol=1e-8 * force)


def test_figure_11(folder):
    for (number, velocity), rows in read(folder, "figure_11_compression").groupby(["sphere", "velocity"]):
        force, displacement = peaks(velocity, *SPHERES[number])
        assert rows["displacement"].iloc[-1] == pytest.approx(displacement, rel=1e-9)
        assert np.allclose(rows["force"], force * (rows["displacement"] / displacement) ** 1.5, rtol=1e-9)
    loops = read(folder, "figure_11_loops")
    assert set(loops["restitution"]) == {0.8, 0.5}
    for (number, e, velocity), rows in loops.groupby(["sphere", "restitution", "velocity"]):
        mass = 4 / 3 * np.pi * 0.025**3 * SPHERES[number][0]
        impulse = np.trapezoid(rows["force"], rows["time"])
        assert impulse == pytest.approx((1 + e) * mass * velocity, rel=1e-3)
        lost = np.trapezoid(rows["force"], rows["displacement"])
        assert lost == pytest.approx((1 - e**2) * mass * velocity**2 / 2, rel=1e-3)


@pytest.mark.parametrize("name", ["figure_12", "figure_13", "figure_14", "figure_15"])
def test_figures_12_to_15_are_equations_17_and_18_at_2_m_per_s(folder, name):
    data = read(folder, name)
    columns = ("radius", "density", "youngs_modulus", "poisson_ratio", "target_youngs_modulus", "target_poisson_ratio")
    radius, density, modulus, nu, modulus_2, nu_2 = (data[column] for column in columns)
    force, displacement = peaks(2.0, density, modulus, nu, modulus_2, nu_2, radius)
    assert np.allclose(data["peak_force"], force, rtol=1e-9)
    assert np.allclose(data["peak_displacement"], displacement, rtol=1e-9)
    assert len(data) == {"figure_12": 3 * 41, "figure_13": 2 * 41, "figure_14": 2 * 41**2, "figure_15": 41**2}[name]


def test_figures_12_and_13_run_through_table_4(folder):
    data = pd.concat([read(folder, name) for name in ("figure_12", "figure_13")])
    ends = {name: (rows[name].min(), rows[name].max()) for name, rows in data.groupby("varied")}
    assert ends == {
        "density": (1000, 3400), "youngs_modulus": (1e9, 21e9), "poisson_ratio": (0.1, 0.5),
        "target_youngs_modulus": (20e9, 1620e9), "target_poisson_ratio": (0.1, 0.5),
    }  # fmt: skip


def test_figures_16_and_17_show_the_same_damped_impacts(folder):
    first, second = read(folder, "figure_16"), read(folder, "figure_17")
    assert first.equals(second)
    assert set(first["restitution"]) == {0.5} and set(first["velocity"]) == {10.0}
    for number, rows in first.groupby("sphere"):
        density, modulus, nu = SPHERES[number]
        mass = 4 / 3 * np.pi * 0.025**3 * density
        stiffness = 1.75**-1.5 * 4 / 3 * 0.025**0.5 / ((1 - nu**2) / modulus + 0.91 / 210e9)
        length = (mass * 100 / stiffness) ** 0.4
        # x_max and f_max of a pulse of restitution 1/2.
        assert rows["displacement"].max() == pytest.approx(0.8479929129779 * length, rel=1e-3)
        assert rows["force"].max() == pytest.approx(1.0628707219377 * stiffness * length**1.5, rel=1e-3)


def test_tables_1_and_2(folder):
    for name in ("table_1", "table_2"):
        data = read(folder, name).dropna(subset="reduced_modulus")
        assert np.allclose(data["reduced_modulus"], data["printed_reduced_modulus"], rtol=2.5e-5)
        assert np.allclose(data["contact_stiffness"], data["printed_contact_stiffness"], rtol=2.5e-5)
    table = read(folder, "table_2")
    assert table[["density", "youngs_modulus", "poisson_ratio"]].to_numpy().tolist() == [
        *(list(map(float, row)) for row in SPHERES.values()),
        [7850.0, 210e9, 0.3],
    ]
    assert table[["length", "width", "thickness"]].iloc[-1].tolist() == [0.4584, 0.36, 0.008]


def test_tables_4_and_5(folder):
    table = read(folder, "table_4").set_index(["body", "parameter"])
    assert table.loc[("sphere", "radius"), "peak_force_influence"] == pytest.approx(21**2 - 1, rel=1e-11)
    assert table.loc[("sphere", "density"), "peak_displacement_influence"] == pytest.approx(3.4**0.4 - 1, rel=1e-11)
    assert (table["values"] == 41).all()
    equal = read(folder, "table_5").set_index(["body", "parameter"])
    plane = 1 - 0.28**2
    by_hand = ((plane / 1 + plane / 2.26) / (plane / 21 + plane / 2.26)) ** 0.4 - 1
    for body in ("sphere", "plate"):
        assert equal.loc[(body, "youngs_modulus"), "peak_force_influence"] == pytest.approx(by_hand, rel=1e-11)


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_pictures_of_the_series_theory_say_that_it_is_rejected(name):
    picture = drawing(FIGURES[name]())
    labels = [text for text in picture.texts if text.get_text() == REJECTED]
    # Figures 4 to 6 compare the three theories and name them in the legend.
    assert len(labels) == (name not in ("figure_04", "figure_05", "figure_06"))
    for label in labels:
        assert "rejected by the finite-element reference" in label.get_text()
        assert label.get_position()[1] > max(axes.get_position().y1 for axes in picture.axes)


@pytest.mark.parametrize("name", sorted(SIMULATED_FIGURES))
def test_every_panel_has_lines(name):
    figure = SIMULATED_FIGURES[name](shipped_study())
    for panel in figure.panels:
        for lines in (panel, *panel.over):
            rows = figure.data
            for column, value in lines.where.items():
                rows = rows[rows[column] == value]
            assert np.isfinite(rows[[lines.x, lines.y]].to_numpy(np.float64)).any()


@pytest.mark.long
def test_a_study_computed_anew_is_written_and_drawn_as_it_is_read(tmp_path, monkeypatch):
    """What was just computed has more digits than its file; the figures must have those of the file."""
    shipped = shipped_study()
    fresh = [
        running.Run(
            case=one.case,
            numbers=one.numbers,
            duration=one.duration,
            courses={name: course * (1 + 1e-9) for name, course in one.courses.items()},
        )
        for one in shipped.runs
    ]
    anew = Study(runs=tuple(fresh), made=shipped.made)
    monkeypatch.setattr(command, "run_study", lambda jobs, _: anew if jobs == 3 else None)
    # A picture is its data here.
    monkeypatch.setattr(command, "draw", lambda figure: figure.data.to_csv().encode())
    monkeypatch.setattr(command, "draw_table", lambda _, cells: str(cells).encode())
    found = [command.write(tmp_path / "anew", finite_element=True, jobs=3), command.write(tmp_path / "shipped")]
    anew_files, shipped_files = ({path.name: path.read_bytes() for path in paths} for paths in found)
    assert anew_files.pop("finite_element.npz") == packed(anew) == packed(shipped)
    assert anew_files == shipped_files


@pytest.mark.parametrize(
    ("output", "exit_code"), [("full", 73), ("file.txt", 73), ("missing/out", 73), ("n" * 300, 73), ("plain", 69)]
)
def test_bad_output_and_missing_matplotlib(tmp_path, monkeypatch, capsys, output, exit_code):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "_contents", lambda _: {"a.csv": b""})
    if output == "plain":
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "file.txt").write_text("kept")
    before = sorted(tmp_path.rglob("*"))
    assert command.main(["-o", output]) == exit_code
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_only_what_is_ours_is_overwritten(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "_contents", lambda _: {"a.csv": b"new"})
    for name in ("notes.txt", "a.csv"):
        (tmp_path / name).write_text("mine")
    assert command.write(tmp_path, overwrite=True) == [tmp_path / "a.csv"]
    assert [(tmp_path / name).read_text() for name in ("notes.txt", "a.csv")] == ["mine", "new"]

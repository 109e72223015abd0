"""The reproduced paper: its numbers against formulas written out again here, its verdicts, its files."""

from __future__ import annotations

import csv
import dataclasses
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cgid.cli.main import run
from cgid.errors import CannotCreate, MissingExtra
from cgid.reproduction import n_steps, output, reproduce
from cgid.reproduction.claims import all_claims
from cgid.reproduction.drawing import drawing
from cgid.reproduction.figures import FIGURES, REJECTED
from cgid.reproduction.report import write_report
from cgid.reproduction.study import shipped_study
from tests.impacts_by_hand import FACTORS, SPHERES

NAMES = {
    "figure_04",
    "figure_05",
    "figure_06",
    "figure_07",
    "figure_10_pulses",
    "figure_10_peaks",
    "figure_11_compression",
    "figure_11_loops",
    "figure_12",
    "figure_13",
    "figure_14",
    "figure_15",
    "figure_16",
    "figure_17",
    "table_1",
    "table_2",
    "table_4",
    "table_5",
}
SIMULATED = {
    "figure_09", "figure_10_simulated", "figure_10_waves", "figure_11_simulated", "figure_16_simulated",
    "figure_17_simulated", "penalty_factor", "penalty_loops", "table_3",
}  # fmt: skip


@pytest.fixture(scope="module")
def written_by_command(tmp_path_factory):
    """What the command writes and prints; of the pictures, a figure and a table are drawn, the others are copies."""
    folder = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        lines = []
        patch.setattr("cgid.cli.studies.click.echo", lambda text, err=False, **_: err or lines.append(text))
        for name in ("draw", "draw_table"):
            patch.setattr(output, name, drawn_once(getattr(output, name)))
        assert run(["reproduce", "-o", str(folder)]) == 0
    return folder, lines


def drawn_once(draw):
    pictures = []

    def drawn(*arguments):
        if not pictures:
            pictures.append(draw(*arguments))
        return pictures[0]

    return drawn


@pytest.fixture(scope="module")
def folder(written_by_command):
    return written_by_command[0]


@pytest.fixture(scope="module")
def claims():
    return {claim.name: claim for claim in all_claims()}


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


def test_every_figure_and_table_is_a_picture_and_data(written_by_command):
    folder, lines = written_by_command
    assert sorted(lines) == sorted(str(path) for path in folder.iterdir())
    assert_complete(folder)


@pytest.mark.long
def test_every_picture_is_drawn(tmp_path):
    reproduce(tmp_path / "out")
    assert_complete(tmp_path / "out")
    assert len({path.read_bytes() for path in (tmp_path / "out").glob("*.png")}) == len(NAMES | SIMULATED)


def assert_complete(folder):
    expected = {f"{name}.{ending}" for name in NAMES | SIMULATED for ending in ("png", "csv")} | {"report.md"}
    assert {path.name for path in folder.iterdir()} == expected
    for name in NAMES | SIMULATED:
        picture = (folder / f"{name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG\r\n") and len(picture) > 5000
        assert f"({name}.png)" in (folder / "report.md").read_text()
        assert f"({name}.csv)" in (folder / "report.md").read_text()


@pytest.mark.parametrize("name", sorted(NAMES | SIMULATED))
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


def test_report_puts_each_claim_where_its_verdict_says(folder, claims):
    report = (folder / "report.md").read_text()
    against, rest = report.split("## What does not agree (24)")[1].split("## What agrees (39)")
    for claim in claims.values():
        assert claim.found in (rest if claim.holds else against)
        assert claim.found not in (against if claim.holds else rest)
    assert re.search(r"No figure passes it\. The largest is 0\.05\d* R, in penalty_loops\.", report)
    assert "| 1, 2 m/s | 1.99 / 1.89 / 2.25 / 1.35 | 0.231 / 0.239 / 0.201 / 0.334 | 341 / 352 / 296 / 492 |" in report
    assert "**They support K1 (Hertz).**" in report


def test_report_names_figures_beyond_the_range_of_hertz():
    figure = dataclasses.replace(FIGURES["figure_07"](), highest_strain=0.123)
    assert "Beyond it are: figure_07 (0.123)." in write_report([figure], [], shipped_study())


def test_only_what_is_ours_is_overwritten(tmp_path, monkeypatch):
    # Drawing is not what is tested here.
    monkeypatch.setattr("cgid.reproduction.output.draw", lambda *_: b"picture")
    monkeypatch.setattr("cgid.reproduction.output.draw_table", lambda *_: b"picture")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "table_1.png").write_text("old")
    with pytest.raises(CannotCreate, match="--overwrite"):
        reproduce(tmp_path)
    steps = []
    written_paths = reproduce(tmp_path, overwrite=True, progress=steps.append)
    assert steps == [1] * n_steps() and written_paths[-1] == tmp_path / "report.md"
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "table_1.png").read_text() == "picture"
    assert len(list(tmp_path.iterdir())) == len(written_paths) + 1


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_pictures_of_the_series_theory_say_that_it_is_rejected(name):
    picture = drawing(FIGURES[name]())
    labels = [text for text in picture.texts if text.get_text() == REJECTED]
    # Figures 4 to 6 compare the three theories and name them in the legend.
    assert len(labels) == (name not in ("figure_04", "figure_05", "figure_06"))
    for label in labels:
        assert "rejected by the finite-element reference" in label.get_text()
        assert label.get_position()[1] > max(axes.get_position().y1 for axes in picture.axes)


def test_without_matplotlib_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match=r"cgid\[plot\]"):
        reproduce(tmp_path / "out")
    assert run(["reproduce", "-o", str(tmp_path / "out")]) == 69
    assert "cgid[plot]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("output", "exit_code", "says"),
    [
        ("full", 73, "--overwrite"),
        ("file.txt", 73, "is a file"),
        ("missing/out", 73, "must exist"),
        ("file.txt/out", 73, "must exist"),
        ("n" * 300, 73, "choose another name"),
        (None, 2, "--output"),
    ],
)
def test_bad_output(tmp_path, monkeypatch, capsys, output, exit_code, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "file.txt").write_text("kept")
    before = sorted(tmp_path.rglob("*"))
    assert run(["reproduce", *(["-o", output] if output else [])]) == exit_code
    out, err = capsys.readouterr()
    assert out == "" and says in err and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before

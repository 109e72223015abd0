"""The fraction of gangue from the coal of a seam: summaries, networks in a model file, anchors and cycles."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.anchor import (
    FULL,
    MIN_ANCHOR,
    N_CLASSES,
    N_SUMMARY,
    SHIFT,
    Anchor,
    Basis,
    Committee,
    Impacts,
    SeamNetworks,
    class_edges,
    impacts_of,
    inputs_of,
    pulse_names,
    summary,
)
from cgid.identification.model.families import Network, softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.support import CavingWatch
from cgid.scene import load_scene, parse_scene, record
from cgid.shipped import ACCELERATION_MODEL, DEFAULT_MODEL, path_of, scene_path
from tests.streams_of_pulses import stream

PULSE = (2e3, 3e-4, 0.4)


def drawn(n: int, seed: int = 0) -> Impacts:
    rng = np.random.default_rng(seed)
    return Impacts(rng.normal((8.0, -8.0, -1.0), (1.0, 0.5, 0.3), (n, 3)), rng.normal(0, 2, n), 3)


def networks(seed: int = 1, n_cells: int = 5) -> SeamNetworks:
    """Return networks of random numbers."""
    rng, n = np.random.default_rng(seed), N_SUMMARY + n_cells

    def network(n_inputs: int, n_classes: int) -> Network:
        sizes = n_inputs, 6, 4, 1 if n_classes == 2 else n_classes
        arrays = {f"weights_{k + 1}": rng.normal(size=sizes[k : k + 2]) for k in range(3)}
        arrays |= {f"biases_{k + 1}": rng.normal(size=sizes[k + 1]) for k in range(3)}
        return Network(arrays, n_inputs, n_classes)

    def committee(n_inputs: int) -> Committee:
        return Committee.of([network(n_inputs, N_CLASSES) for _ in range(3)])

    return SeamNetworks(
        cells=rng.normal((8.0, -16.0, -3.0), 1.0, (n_cells, 3)),
        cell_scale=np.array([1.0, 0.5, 0.3]),
        mean=rng.normal(size=3 * n),
        scale=rng.uniform(0.5, 2.0, 3 * n),
        limit=1.5,
        anchored=committee(3 * n),
        alone=committee(n),
        foreign=network(3 * n, 2),
        sharpened=committee(4 * n),
        lumps_limit=0.0,  # any lumps are gangue
    )


def test_a_summary_holds_quantiles_histograms_and_counts() -> None:
    impacts, own = drawn(37), networks()
    found = summary(impacts, own.cells, own.cell_scale)
    (peak, width, restitution), logits = impacts.pulses.T, impacts.logits
    quantities = [peak, width, restitution, logits, peak - width, peak + width, peak - 2 * width]
    expected = [np.quantile(one, q) for one in quantities for q in (0.1, 0.25, 0.5, 0.75, 0.9)]
    assert found[:35] == pytest.approx(expected)
    assert found[35:37] == pytest.approx([logits.mean(), np.mean(1 / (1 + np.exp(-logits)))])
    nearest = [np.argmin([np.sum((row / own.cell_scale - cell) ** 2) for cell in own.cells]) for row in impacts.pulses]
    counts = found[37:42] ** 2 * 37
    assert counts == pytest.approx([nearest.count(k) for k in range(5)])
    assert found[42:52] @ found[42:52] == pytest.approx(1)
    assert found[42] ** 2 == pytest.approx(np.mean(logits <= -4))
    assert found[52:] == pytest.approx([3 / 40, np.log(37)])


def test_a_summary_of_one_impact_is_finite() -> None:
    assert np.isfinite(networks().summary(drawn(1))).all()


def test_networks_return_from_a_model_file() -> None:
    model, own = StoredModel.load(path_of("models", DEFAULT_MODEL)), networks()
    with_networks = StoredModel.from_bytes(with_arrays(model, {**without_networks(model), **own.arrays}).to_bytes())
    assert with_networks.seams is not None
    window, anchor, lumps = (own.summary(drawn(n, seed)) for n, seed in ((30, 1), (50, 2), (10, 3)))
    for again, one in (
        (with_networks.seams.density(window, anchor), own.density(window, anchor)),
        (with_networks.seams.density(window), own.density(window)),
        (with_networks.seams.density(window, anchor, lumps), own.density(window, anchor, lumps)),
        (with_networks.seams.gangue_of(lumps, anchor), own.gangue_of(lumps, anchor)),
        (with_networks.seams.foreignness(window, anchor), own.foreignness(window, anchor)),
    ):
        assert again.tolist() == one.tolist()
    assert with_networks.seams.lumps_limit == own.lumps_limit
    assert own.density(window, anchor).sum() == pytest.approx(1)
    # Lumps are standardised as a window is, and of a window that is lumps alone half the classes are above one half.
    inputs = inputs_of(window, anchor, own.mean, own.scale, lumps)
    assert inputs[-lumps.size :].tolist() == inputs_of(lumps, anchor, own.mean, own.scale)[: lumps.size].tolist()
    assert own.gangue_of(lumps, anchor) == pytest.approx(own.density(lumps, anchor)[:, class_edges()[:-1] > 0.49].sum())
    assert (
        own.foreignness(window, anchor)
        == own.foreign.scores(inputs_of(window, anchor, own.mean, own.scale)[None]) - 1.5
    )


def test_a_committee_is_the_mean_of_its_networks() -> None:
    own = networks()
    window = own.summary(drawn(30))
    inputs = ((window - own.mean[: window.size]) / own.scale[: window.size]).clip(-6, 6)[None]
    each = [softmax(one.scores(inputs)) for one in own.alone.networks]
    assert len(each) == 3 and np.abs(each[0] - each[1]).max() > 1e-3
    assert own.density(window) == pytest.approx(np.mean(each, axis=0))


def without_networks(model: StoredModel) -> dict[str, np.ndarray]:
    return {name: array for name, array in model.arrays.items() if not name.startswith(SeamNetworks.PREFIX)}


def with_arrays(model: StoredModel, arrays: dict[str, np.ndarray]) -> StoredModel:
    return replace(model, arrays=arrays)


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("limit", None, "seams.limit is missing"),
        ("cells", np.zeros((5, 2)), "rows of 3"),
        ("cell_scale", np.zeros(3), "at least 1e-30"),
        ("mean", np.zeros(7), "seams.mean must have shape"),
        ("alone.weights_1", np.zeros((3, 7, 6)), "weights_1 must have shape"),
        ("alone.weights_1", np.zeros((2, 58, 6)), "one number of networks"),
        ("anchored.biases_3", None, "biases_3 is missing"),
        ("lumps_limit", None, "seams.lumps_limit is missing"),
        ("sharpened.weights_1", np.zeros((3, 7, 6)), "weights_1 must have shape"),
        ("cells", np.full((5, 3), np.nan), "finite"),
        ("more", np.zeros(3), "seams.more"),
    ],
)
def test_networks_that_do_not_fit_are_refused(name: str, array: np.ndarray | None, words: str) -> None:
    model, arrays = StoredModel.load(path_of("models", DEFAULT_MODEL)), networks().arrays
    arrays[SeamNetworks.PREFIX + name] = array if array is not None else np.zeros(1)
    if array is None:
        del arrays[SeamNetworks.PREFIX + name]
    with pytest.raises(BadData, match=words):
        with_arrays(model, {**without_networks(model), **arrays})


def test_pulses_are_those_of_the_model() -> None:
    assert pulse_names(("beam_restitution", "beam_peak_force", "beam_pulse_width", "other"))[0] == "beam_peak_force"
    assert pulse_names(("fitted_peak", "fitted_width")) == ()


def test_classes_fill_the_fractions() -> None:
    edges = class_edges()
    assert (edges[0], edges[-1], len(edges)) == (0, 1, N_CLASSES + 1)
    assert edges + edges[::-1] == pytest.approx(np.ones(N_CLASSES + 1))


def test_unknown_impacts_are_counted_alone() -> None:
    found = impacts_of([(0.2, PULSE), (float("nan"), None), (0.9, (1e3, 1e-4, 0.5))])
    assert found.n_unknown == 1
    assert np.exp(found.pulses) == pytest.approx(np.array([PULSE, (1e3, 1e-4, 0.5)]))
    assert found.logits == pytest.approx([np.log(0.2 / 0.8), np.log(0.9 / 0.1)])


def test_an_anchor_waits_for_its_coal_and_needs_ten_impacts() -> None:
    anchor = Anchor(20.0)
    for k in range(MIN_ANCHOR - 1):
        anchor.add(float(k), 0.1, PULSE)
    anchor.add(9.5, float("nan"), None)
    assert anchor.basis(15.0) == Basis.PENDING
    assert anchor.basis(20.0) == Basis.TOO_FEW
    anchor.add(20.0, 0.1, PULSE)
    assert anchor.basis(20.0) == Basis.ANCHOR
    anchor.add(20.1, 0.9, PULSE)  # after its coal
    assert len(anchor.impacts.logits) == MIN_ANCHOR


def test_a_pause_begins_another_cycle() -> None:
    anchor = Anchor(10.0, cycle_pause=60.0)
    for k in range(30):
        anchor.add(float(k), 0.1, PULSE)
    anchor.is_foreign = True
    assert anchor.basis(30.0) == Basis.FOREIGN
    anchor.add(29.0 + 60.0, 0.2, PULSE)  # as long as the pause, not longer
    assert anchor.basis(90.0) == Basis.FOREIGN
    anchor.add(150.0, 0.3, PULSE)
    assert anchor.basis(159.0) == Basis.PENDING
    assert anchor.basis(160.0) == Basis.TOO_FEW
    assert len(anchor.impacts.logits) == 1
    assert [anchor.has(time) for time in (149.0, 160.0, 160.1)] == [False, True, False]


def test_a_dead_sensor_is_no_pause_and_a_cycle_shorter_than_its_coal_is_known() -> None:
    anchor = Anchor(30.0, 10.0)
    for time in np.arange(0.0, 20.0, 0.5):
        anchor.add(float(time), 0.1, PULSE)
    anchor.lose(33.0)  # dead from 20 to 33 s
    anchor.add(34.0, 0.1, PULSE)
    assert (anchor.cycle, anchor.short) == (0.0, None)
    for time in (60.0, 62.0, 80.0):
        anchor.add(time, 0.1, PULSE)
    # The first cycle was as long as its coal; the second ended two seconds after it began.
    assert (anchor.cycle, anchor.short) == (80.0, (60.0, 62.0))
    before_any = Anchor(30.0, 10.0)
    before_any.lose(50.0)
    before_any.add(51.0, 0.1, PULSE)
    assert before_any.cycle == 0.0


def test_a_cycle_may_begin_when_it_is_said() -> None:
    anchor = Anchor(10.0)
    for time in range(12):
        anchor.add(float(time), 0.1, None)
    anchor.begin_at(20.0)
    assert [anchor.basis(time) for time in (19.0, 21.0, 29.9)] == [Basis.ANCHOR, Basis.PENDING, Basis.PENDING]
    anchor.begin_at(40.0)
    anchor.add(35.0, 0.1, None)
    anchor.add(41.0, 0.1, None)
    assert len(anchor.impacts.logits) == 11 + 1 and anchor.has(50.0) and not anchor.has(50.1)


def test_coal_of_earlier_cycles_fills_up_a_short_one_of_the_same_seam_and_shift() -> None:
    anchor, own = Anchor(3.0, cycle_pause=60.0), replace(networks(), limit=1e3)

    def cycle(begin: float, n: int, probability: float = 0.1, end: float = 8.0) -> int:
        for time in (*np.linspace(0.0, min(end, 3.0), n), *([end] if end > 3 else [])):
            anchor.add(begin + float(time), probability, PULSE)
        return len(anchor.impacts.logits)

    assert [cycle(0.0, 8), cycle(100.0, 4), cycle(200.0, 1)] == [8, 12, 13]
    assert [anchor.basis(time) for time in (202.0, 203.0)] == [Basis.PENDING, Basis.ANCHOR]
    # No more than make it full, of coal of this cycle all; none of a cycle shorter than its coal, or of another shift.
    assert [cycle(300.0, FULL + 50), cycle(400.0, 20), cycle(500.0, 20, end=2.0), cycle(600.0, 1)] == [
        *(FULL + 50, FULL, FULL, FULL)
    ]
    assert anchor.short == (500.0, 502.0)
    assert cycle(SHIFT + 550.0, 2) == 3
    # Coal that the networks take for that of another seam counts no more, nor does coal that did not fit its windows.
    summary = own.summary(anchor.impacts)
    assert anchor.summarised(own).tolist() == summary.tolist()
    assert cycle(SHIFT + 650.0, 5) == 7
    only = replace(own, limit=-1e3)
    assert anchor.summarised(only)[-1] == pytest.approx(np.log(5)) and len(anchor.impacts.logits) == 5
    anchor.is_foreign = True
    assert cycle(SHIFT + 750.0, 2) == 2


def test_what_an_anchor_forgets_is_not_in_its_coal() -> None:
    anchor = Anchor(20.0)
    for k in range(24):
        anchor.add(float(k), 0.2, PULSE)
    anchor.is_foreign = True
    anchor.forget(-3.0, 1.75)
    assert len(anchor.impacts.logits) == 19
    assert anchor.basis(24.0) == Basis.ANCHOR
    anchor.forget(15.0, 40.0)
    assert len(anchor.impacts.logits) == 14


def test_spans_of_coal_make_an_anchor_where_they_are() -> None:
    # A stretch, and later single labelled impacts.
    anchor = Anchor(0.0, spans=[(5.0, 8.0), *((20.0 + k, 20.1 + k) for k in range(8))])
    for k in range(60):
        anchor.add(0.5 * k, 0.1, PULSE)
        if k < 38:
            assert anchor.basis(0.5 * k) == Basis.PENDING
    assert len(anchor.impacts.logits) == 7 + 8
    # Ten are enough, and those that are still to come are taken, too.
    anchor = Anchor(0.0, spans=[(5.0, 8.0), (20.0, 22.0)])
    for k in range(44):
        anchor.add(0.25 * k, 0.1, PULSE)
    assert [anchor.basis(time) for time in (7.9, 8.0, 19.0, 21.0)] == [
        *(Basis.PENDING, Basis.ANCHOR, Basis.ANCHOR, Basis.PENDING)
    ]
    anchor.summary = np.zeros(3)
    anchor.add(21.0, 0.1, PULSE)
    assert anchor.summary is None and len(anchor.impacts.logits) == 14
    assert Anchor(0.0, spans=[(5.0, 8.0)]).basis(8.0) == Basis.TOO_FEW


# -- at the command line ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a stream of impacts, and models whose networks take any anchor, or none."""
    out = tmp_path_factory.mktemp("anchor")
    samples = stream(["coal"] * 30 + ["gangue"] * 30, 0.05)
    np.save(out / "stream.npy", samples.astype("f4"))
    samples.astype("<f4").tofile(out / "stream.raw")
    model, own = StoredModel.load(path_of("models", DEFAULT_MODEL)), networks()
    for name, limit, lumps_limit in (("any", 1e3, 0.0), ("none", -1e3, 0.0), ("no lumps", 1e3, 1.1)):
        arrays = {**model.arrays, **replace(own, limit=limit, lumps_limit=lumps_limit).arrays}
        (out / f"{name}.npz").write_bytes(with_arrays(model, arrays).to_bytes())
    return out


def lines_of(
    folder: Path, capsys: pytest.CaptureFixture[str], command: str, *options: str, model: str = "any"
) -> tuple[list[dict], str]:
    how = ["stream.npy", "--rate", "200000", "--unit", "N"]
    if command == "monitor":
        how = ["stream.raw", "--rate", "200000", "--channels", "1", "--sample-format", "f32le", "--unit", "N"]
    how[0] = str(folder / how[0])
    model_file = str(folder / f"{model}.npz")
    assert run([command, *how, "--json", "--set", "window=0.5", "--model", model_file, *options]) == 0
    out, err = capsys.readouterr()
    return [json.loads(line) for line in out.splitlines()], err


@pytest.mark.parametrize("command", ["predict", "monitor"])
def test_records_say_what_the_fraction_rests_on(command: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, expected in (
        ((), {"any_seam"}),
        (
            (
                "--set",
                "trained_seam=true",
            ),
            {"trained_seam"},
        ),
        (("--coal-until", "1s"), {"anchor_pending", "anchor"}),
        (("--coal-until", "10 ms"), {"anchor_too_few"}),
        (("--coal-until", "1", "--set", "cycle_pause=1 min"), {"anchor_pending", "anchor"}),
    ):
        lines, _ = lines_of(folder, capsys, command, *options)
        shares = [line for line in lines if line["kind"] == "share"]
        assert {line["basis"] for line in shares if line["impacts"]} == expected, options
        if "anchor" in expected:
            assert all((line["basis"] == "anchor") == (line["time_s"] >= 1) for line in shares)


def test_a_window_that_does_not_fit_the_coal_refuses_it_in_a_file_as_in_a_stream(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever it ends: a file is told of fewer windows than a stream."""
    seen: list[bytes] = []
    wrong = [b""]

    def foreignness(_: SeamNetworks, window: np.ndarray, anchor: np.ndarray) -> np.ndarray:
        seen.append(window.tobytes())
        return np.array([1.0 if seen[-1] == wrong[0] else -1.0])

    monkeypatch.setattr(SeamNetworks, "foreignness", foreignness)
    lines_of(folder, capsys, "monitor", "--coal-until", "1")
    for wrong[0] in list(dict.fromkeys(seen))[1:5]:
        lines = {one: lines_of(folder, capsys, one, "--coal-until", "1")[0] for one in ("monitor", "predict")}
        warned = {one: [line["message"] for line in found if line["kind"] == "finding"] for one, found in lines.items()}
        told = {one: [text for text in texts if "hardly" in text] for one, texts in warned.items()}
        assert told["predict"] == told["monitor"] and len(told["predict"]) == 1
        last = {one: [line["basis"] for line in found if line["kind"] == "share"][-1] for one, found in lines.items()}
        assert last == {"monitor": "anchor_foreign", "predict": "anchor_foreign"}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are POSIX")
def test_a_line_on_stdin_begins_another_cycle(folder: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    raw = (folder / "stream.raw").read_bytes()
    half = round(1.6 * 200_000) * 4
    how = ["--rate", "200000", "--channels", "1", "--sample-format", "f32le", "--unit", "N"]
    how += ["--json", "--set", "window=0.5"]
    coal = ["--model", str(folder / "any.npz"), "--coal-until", "1", "--set", "cycle_by=stdin"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = [sys.executable, "-m", "cgid", "monitor", str(tmp_path / "pipe"), *how, *coal]
    with subprocess.Popen(command, text=True, **pipes) as process:
        assert process.stdin and process.stdout and process.stderr
        with (tmp_path / "pipe").open("wb") as pipe:
            pipe.write(raw[:half])
            pipe.flush()
            lines = []
            while not lines or lines[-1].get("to_s", 0.0) < 1.3:
                lines.append(json.loads(process.stdout.readline()))
            process.stdin.write("2\n\n")
            process.stdin.flush()
            told = [process.stderr.readline()]
            while "a caving cycle" not in told[-1]:
                told.append(process.stderr.readline())
            assert any("the support of a cycle must be one of '1', got '2'" in one for one in told)
            begun = float(re.search(r"a caving cycle of all supports begins at (\S+) s", told[-1])[1])
            pipe.write(raw[half:])
        lines += map(json.loads, process.stdout)
        assert process.wait() == 0
    shares = [line for line in lines if line["kind"] == "share" and line["impacts"]]
    assert 1.3 < begun <= 1.6 and shares[-1]["to_s"] > begun + 1
    for line in shares:
        is_anchored = 1.0 <= line["to_s"] < begun or line["to_s"] >= begun + 1.0
        assert line["basis"] == ("anchor" if is_anchored else "anchor_pending")


def test_cycles_without_a_pause_are_told_once(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = "no pause of 1 s came from 0 to 3 s, so this is one caving cycle"
    for command in ("predict", "monitor"):
        assert lines_of(folder, capsys, command, "--coal-until", "1", "--set", "cycle_pause=1s")[1].count(words) == 1
        # A recording that is no longer than its coal and a pause may end with its first cycle.
        assert "no pause" not in lines_of(folder, capsys, command, "--coal-until", "1", "--set", "cycle_pause=2s")[1]
    monkeypatch.setattr("cgid.identification.prediction.telling._LONGEST_CYCLE", 1.2)
    err = lines_of(folder, capsys, "monitor", "--coal-until", "1", "--set", "cycle_pause=1s")[1]
    (told,) = re.findall(r"no pause of 1 s came from 0 to (\S+) s", err)
    assert 1.2 <= float(told) < 2


def test_an_anchor_that_does_not_fit_or_is_too_small_or_late_is_told(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for model, coal, words in (
        ("none", "1", "hardly a mixture with the coal of 1 s"),
        ("any", "0.1", "must give at least 10 identified impacts"),
        ("any", "4", "--coal-until must be within the recording of 3 s, got 4 s"),
    ):
        lines, err = lines_of(folder, capsys, "predict", "--coal-until", coal, model=model)
        told = [line["message"] for line in lines if line["kind"] == "finding"]
        assert sum(words in one for one in told) == 1, told
        assert err.count(words) == 1
    lines, err = lines_of(folder, capsys, "predict", "--coal-until", "1")
    assert "coal" not in err and not any("coal" in line["message"] for line in lines if line["kind"] == "finding")


@pytest.mark.parametrize("command", ["predict", "monitor"])
def test_a_table_labels_the_coal_of_a_recording(
    command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / {"predict": "stream.npy", "monitor": "stream.raw"}[command]

    def shares(*options: str) -> tuple[list[dict], str]:
        lines, err = lines_of(folder, capsys, command, *options)
        return [line | {"wall_time": ""} for line in lines if line["kind"] == "share"], err

    table = tmp_path / "events.csv"
    head = "path,start_s,end_s,label,channel\nanother.wav,0,3,coal,\n"
    table.write_text(f"{head}{file},0,1,coal,1\n")
    by_table, until = (shares(*how)[0] for how in (("--set", f"labelled={table}"), ("--coal-until", "1")))
    assert by_table == until and {line["basis"] for line in by_table} == {"anchor_pending", "anchor"}
    table.write_text(f"{head}{file},0,1,coal,\n{file},9,10,coal,\n")
    assert "got 1 row after it" in shares("--set", f"labelled={table}")[1]
    table.write_text(f"{head}{file},0,0.05,coal,\n")
    assert "the labelled coal must give at least 10" in shares("--set", f"labelled={table}")[1]


@pytest.mark.parametrize("command", ["predict", "monitor"])
def test_labelled_lumps_of_gangue_are_used_beside_the_coal(
    command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, table = folder / {"predict": "stream.npy", "monitor": "stream.raw"}[command], tmp_path / "events.csv"

    def shares(lumps: str, *options: str, model: str = "any") -> tuple[list[dict], str]:
        table.write_text(
            f"path,start_s,end_s,label\n{file},1.6,{lumps},gangue\n{'' if options else f'{file},0,1,coal'}\n"
        )
        lines, err = lines_of(folder, capsys, command, "--set", f"labelled={table}", *options, model=model)
        return [line for line in lines if line["kind"] == "share"], err

    found, err = shares("2.2")
    assert "gangue" not in err
    for line in found:
        expected = "anchor_and_gangue" if line["to_s"] >= 2.2 else "anchor"
        assert line["basis"] == (expected if line["to_s"] >= 1 else "anchor_pending")
    assert [line["low"] for line in shares("2.2", "--coal-until", "1")[0]] == [line["low"] for line in found]
    for lumps, model, basis, words in (
        ("1.7", "any", "gangue_too_few", "the labelled gangue must give at least 6 identified impacts"),
        ("2.2", "no lumps", "gangue_foreign", "the labelled gangue is hardly gangue beside the labelled coal"),
    ):
        told, err = shares(lumps, model=model)
        assert err.count(words) == 1
        assert {line["basis"] for line in told if line["to_s"] > 2.3} == {basis}
        # The fraction is as without them.
        alone = shares("1.61", model=model)[0]
        assert [line["low"] for line in told] == [line["low"] for line in alone]
    assert "labelled gangue must be within the recording" in shares("2.2\n" + f"{file},9,10,gangue\n{file},9,9.1")[1]


def test_lumps_need_stated_coal_and_a_model_that_knows_them(folder: Path) -> None:
    with pytest.raises(InvalidValue, match="labelled gangue must come with stated coal"):
        PredictionSettings(lumps=((1.0, 2.0),))
    with pytest.raises(InvalidValue, match="a span of gangue must rise"):
        PredictionSettings(lumps=((2.0, 1.0),), coal_until=1.0)
    with pytest.raises(InvalidValue, match="labelled gangue must begin after the 3 s of coal alone, got 2 s"):
        PredictionSettings(lumps=((4.0, 5.0), (2.0, 3.5)), coal_until=3.0)
    for bad in ((4.0, 5.0), [(4.0, "5")], "4 to 5", 4.0):
        with pytest.raises(InvalidValue, match="spans of gangue must be begin and end each"):
            PredictionSettings(lumps=bad, coal_until=3.0)
    model = StoredModel.load(folder / "any.npz")
    settings = PredictionSettings(lumps=((1.0, 2.0),), coal_until=1.0)
    CavingWatch(model, ["1"], settings)
    with pytest.raises(InvalidValue, match="lumps must be left out, this model"):
        CavingWatch(with_arrays(model, without_networks(model)), ["1"], settings)


def test_a_table_without_coal_of_the_recording_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, table = folder / "stream.npy", tmp_path / "events.csv"
    given = ["predict", str(file), "--rate", "200000", "--unit", "N", "--set", f"labelled={table}"]
    for rows, words in (
        ("another.wav,coal,", f"some row of {file} must be labelled coal, none is"),
        (f"{file},gangue,", "none is"),
        (f"{file},coal,7", "channel must be one of"),
    ):
        table.write_text(f"path,label,channel\n{rows}\n")
        assert run(given) == 65
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
    table.write_text(f"path,label\n{file},coal\n")
    assert run([*given, "--coal-until", "1"]) == 65
    assert "coal_until and labelled coal must not be given together" in capsys.readouterr().err
    for wrong in (3.0, [(1.0,)], [(0.0, "end")], [(2.0, 1.0)], [(-1.0, 1.0)]):
        with pytest.raises(InvalidValue, match=r"spans? of coal"):
            PredictionSettings(coal=wrong)  # type: ignore[arg-type]


def test_any_seam_is_said_once_in_words(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [str(folder / "stream.npy"), "--rate", "200000", "--unit", "N", "--set", "window=0.5"]
    assert run(["predict", *given, "--model", str(folder / "any.npz"), "--fractions"]) == 0
    err = capsys.readouterr().err
    assert err.count("--coal-until 30s") == 1
    assert err.count("any seam) from") >= 5


def test_a_model_of_single_blows_says_that_rocks_bounce(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    of_streams = StoredModel.load(path_of("models", ACCELERATION_MODEL))
    told = {name: part for name, part in of_streams.training.items() if name not in ("streams", "seams", "world")}
    arrays = {name: part for name, part in of_streams.arrays.items() if name[:5] not in ("share", "seams", "world")}
    replace(of_streams, training=told, arrays=arrays).save(tmp_path / "blows.npz")
    content = json.loads(load_scene(scene_path("caving")).text)
    content["stream"]["duration"] = "14 s"
    signal, _ = record(parse_scene(content), 5)
    np.save(tmp_path / "belt.npy", signal.samples)
    given = ["predict", str(tmp_path / "belt.npy"), "--rate", "25600", "--unit", "m/s^2"]
    for options, count in ((["--model", str(tmp_path / "blows.npz")], 1), (["--set", "trained_seam=true"], 0)):
        assert run([*given, *options]) == 0
        assert capsys.readouterr().err.count("the model learned from single blows; where rocks bounce") == count

"""One record a finding: every output is made of it, its kind stands in two places, and the words fit who reads them."""

from __future__ import annotations

import ast
import json
import logging
import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from cgid import predict
from cgid._lib.spelling import as_argument, as_option
from cgid.cli.answer_rows import AnswerLines
from cgid.cli.hints import NextSteps
from cgid.cli.main import run
from cgid.identification.prediction import findings as module
from cgid.identification.prediction.findings import Finding, Findings, FindingWarning, words
from cgid.identification.prediction.support import Ground
from cgid.identification.prediction.telling import warn
from cgid.plant.modbus import EACH, FINDINGS, registers
from cgid.plant.state import PlantState
from tests.streams_of_pulses import ROOT

LABELS = ["coal", "gangue"] * 8
PACKAGE = ROOT / "cgid"
#: What passes findings on, and knows no kind of them.
OF_PREDICTION = "identification/prediction/"
OUTPUTS = ("cli", "plant", "plots", "labelling", f"{OF_PREDICTION}pipeline.py", f"{OF_PREDICTION}findings.py")


def kinds_told(path: Path) -> set[str]:
    """Return the kinds of which a module makes findings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and "Finding" in ast.unparse(node.func))
    told = (one.value for call in calls for one in call.keywords if one.arg == "kind")
    return {one.value for one in told if isinstance(one, ast.Constant)} & words().keys()


def test_a_kind_is_named_in_its_table_and_where_it_is_found_alone() -> None:
    """A new finding costs two files."""
    places: dict[str, list[str]] = {kind: [] for kind in words()}
    for path in sorted((PACKAGE / "identification").rglob("*.py")):
        for kind in kinds_told(path):
            places[kind].append(path.name)
    assert {kind: names for kind, names in places.items() if len(names) > 1} == {}


def test_no_output_knows_a_kind() -> None:
    grounds, general = {str(one) for one in Ground}, {"reading", "unproven"}  # of what reads files, and of models alone
    of_files = {"missing", "silent"}
    for part in OUTPUTS:
        for path in [PACKAGE / part] if part.endswith(".py") else sorted((PACKAGE / part).rglob("*.py")):
            told = kinds_told(path) - general - grounds - of_files
            assert not told, path
    for path in (PACKAGE / "plant").glob("*.js"):
        text = path.read_text(encoding="utf-8")
        assert not [
            kind for kind in words().keys() - grounds - {"unknown"} if f'"{kind}"' in text or f"'{kind}'" in text
        ]


def test_each_kind_has_a_number_of_its_own_words_and_ways_that_exist() -> None:
    rows = words()
    assert len({row["number"] for row in rows.values()}) == len(rows)
    assert all(0 < row["number"] < 0xFFFF for row in rows.values())
    allowed = {
        "number",
        "what",
        "help",
        "over",
        "moves",
        "note",
        "of_fraction",
        "of_beams",
        "silent",
        "explained",
        "ways",
    }
    for kind, row in rows.items():
        assert row.keys() <= allowed and {"what", "help", "over"} <= row.keys(), kind
        assert all(callable(getattr(NextSteps, f"_{way}")) for way in row.get("ways", ())), kind
    assert {str(one) for one in Ground} - {"seen"} <= rows.keys()


def test_python_and_the_command_line_each_read_their_own_options() -> None:
    finding = Finding(
        kind="same_beam", channels=("1", "2"), fields={"shared": 3, "fewer": 4, "within": 4.0, "beam": "1+2"}
    )
    assert "same_beam=[('1', '2')]" in finding.line("x", 2)
    assert "--same-beam 1+2" in finding.line("x", 2, as_option)
    assert str(finding) == finding.line("", 2).strip() and str(Finding(kind="any_seam")).startswith("the interval")
    for kind, row in words().items():
        for part in ("what", "help", "over"):
            assert "--same-beam" not in row[part] and "--set lines" not in row[part], kind
    assert as_argument("lines", "false") == "lines=False" and as_option("lines", "false") == "--set lines=false"


def test_a_finding_is_told_once_when_it_begins_and_once_when_it_ends() -> None:
    told, wrong = Findings(), Finding(kind="scale", channels=("1",), begin=3.0, factor=5.0)
    told.all = []
    assert told.tell([wrong]) == [wrong]
    (over,) = told.tell([Finding(kind="scale", channels=("1",), end=9.0)])
    assert (over.begin, over.end, over.factor) == (3.0, 9.0, 5.0)
    assert told.tell([Finding(kind="scale", channels=("1",), end=10.0)]) == []  # nothing stands
    # What goes on under another name is not over: one line, not two.
    told.tell([Finding(kind="rings", channels=("1",), begin=1.0)])
    (over,) = told.tell([Finding(kind="rings", channels=("1",), end=2.0, fields={"renamed": True})])
    assert over.is_over and over.line("x") == ""
    # Many channels with one fault are one line.
    silent = [Finding(kind="silent", channels=(f"{k}",), fields={"text": "nothing"}) for k in range(84)]
    (one,) = told.tell(silent)
    assert len(one.channels) == 84 and "and 81 more" in one.line("x", 84)
    assert [one.kind for one in told.in_order][-1] == "scale"


def trial(monkeypatch: pytest.MonkeyPatch) -> Finding:
    """Return a finding of a kind that is a row of the table alone."""
    row = {"number": 999, "moves": True, "what": "the belt is {colour}", "help": "paint it", "over": "it is grey again"}
    rows = {**words(), "trial": row}
    monkeypatch.setattr(module, "words", lambda: rows)
    return Finding(kind="trial", channels=("2",), begin=4.0, fields={"colour": "red"})


def line_of(finding: Finding) -> dict[str, Any]:
    lines: list[dict[str, Any]] = []
    told = AnswerLines(False)
    told.listeners.append(lines.append)
    told.finding("belt", finding, 2)
    return lines[0]


def plant_of(channels: tuple[str, ...]) -> PlantState:
    plant = PlantState()
    plant.begin(source="belt", channels=channels, rows=channels, unit="N", threshold=0.5, behind=lambda: 0.0)
    return plant


def test_every_output_is_made_of_the_record(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    finding, plant = trial(monkeypatch), plant_of(("1", "1+2"))
    line = line_of(finding)
    assert "cgid: warning: belt channel 2: since 4 s: the belt is red; paint it" in capsys.readouterr().err
    assert (line["finding"], line["number"], line["begin_s"], line["end_s"]) == ("trial", 999, 4.0, None)
    plant.take(json.loads(json.dumps(line)))
    # MQTT and commands: the record of its support, and of no other one; the page: its words.
    assert [one["findings"] for one in plant.records()] == [[], ["trial"]]
    assert ["the belt is red" in "".join(one["findings"]) for one in plant.page()["supports"]] == [False, True]
    values = plant.read(lambda supports: registers(plant, supports))
    assert values[FINDINGS + EACH] == 999 and not any(values[FINDINGS : FINDINGS + EACH])
    client = pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")
    from cgid.plant.web import metrics_of

    assert client and b'cgid_finding{channel="1+2",finding="trial"} 1.0' in metrics_of(plant)()
    with caplog.at_level(logging.INFO, "cgid"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn([finding], "belt", 2, 1)
    assert [one.message.finding for one in caught] == [finding] and isinstance(caught[0].message, FindingWarning)
    assert [record.finding for record in caplog.records] == [finding]
    # It ends, everywhere.
    plant.take(line_of(over_of(finding)))
    assert [one["findings"] for one in plant.records()] == [[], []]
    assert "it is grey again at 9 s" in capsys.readouterr().err


def over_of(finding: Finding) -> Finding:
    """Return the end of a finding."""
    told = Findings()
    told.all = [finding]
    (over,) = told.tell([Finding(kind=finding.kind, channels=finding.channels, end=9.0)])
    return over


def test_a_warning_can_be_pickled() -> None:
    warning = Finding(kind="scale", channels=("1",), factor=5.0).warning("x: too large")
    again = pickle.loads(pickle.dumps(warning))
    assert str(again) == "x: too large" and again.finding.content() == warning.finding.content()


# -- the matrix of faults -----------------------------------------------------------------------------------


def forces(seed: int, n: int = 60) -> tuple[np.ndarray, float]:
    """Return a recording of forces of the scene of the model, one impact after the other."""
    from cgid import synthesise

    random = np.random.default_rng(seed)
    batch = next(iter(synthesise("reference", n, seed=seed)))
    signals, gap = np.asarray(batch.signals, float), round(0.01 * batch.sampling_rate)
    noise = np.std(signals[:, : signals.shape[1] // 20])
    quiet = random.normal(0, noise, (n, gap))
    return np.concatenate([np.concatenate([quiet, signals], axis=1).ravel(), quiet[0]]), batch.sampling_rate


def spoilt(seed: int) -> Mapping[str, tuple[np.ndarray, float, set[str]]]:
    """Return recordings with one fault each: samples, the stated rate, and the names that are right."""
    x, rate = forces(seed)
    random, turn = np.random.default_rng(seed + 1), 2 * np.pi * 9e3 / rate
    near = np.exp(-0.03 * turn)  # a resonance at 9 kHz with 3 % of the critical damping
    return {
        "as it is": (x, rate, set()),
        "x5": (5 * x, rate, {"scale"}),
        "x40": (40 * x, rate, {"scale"}),
        "/20": (x / 20, rate, {"scale"}),
        "rate x5": (x, 5 * rate, {"rate"}),
        "rate /3": (x, rate / 3, {"rate"}),
        "clipped": (np.minimum(x, np.percentile(x, 99.3)), rate, {"clipped"}),
        "upside down": (-x, rate, {"upside_down"}),
        "rings": (
            lfilter([1 - 2 * near * np.cos(turn) + near**2], [1, -2 * near * np.cos(turn), near**2], x),
            rate,
            {"ringing"},
        ),
        "noise": (x + random.normal(0, 0.12 * np.abs(x).max(), x.size), rate, {"noise"}),
    }


CASES = ("as it is", "x5", "x40", "/20", "rate x5", "rate /3", "clipped", "upside down", "rings", "noise")


@pytest.mark.parametrize("case", CASES)
def test_a_fault_is_named_first_in_one_line_and_in_python_alike(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples, rate, right = spoilt(101)[case]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        table = predict(samples, rate, "N")
    np.save(tmp_path / "x.npy", samples)
    code = run(["predict", str(tmp_path / "x.npy"), "--rate", f"{rate:g}", "--unit", "N", "--json"])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    found = [line for line in lines if line["kind"] == "finding" and not line["note"]]
    told = [line["finding"] for line in found]
    assert code == 0 or right  # a recording without any impact is an error
    assert [one.message.finding.kind for one in caught] == [one["finding"] for one in table.attrs["findings"]]
    if code == 0:
        assert told == [one["finding"] for one in table.attrs["findings"]]
    assert len(caught) == len(right and {1})
    assert {one.message.finding.kind for one in caught} <= right


def test_a_fault_of_a_stream_is_told_when_it_begins_and_when_it_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, rate = forces(102, 100)
    samples = np.concatenate([x, x, x])
    samples[x.size : 2 * x.size] *= 10  # a gain for a third of the time
    samples.astype("<f4").tofile(tmp_path / "x.f32")
    raw = ["--rate", f"{rate:g}", "--channels", "1", "--sample-format", "f32le", "--unit", "N", "--json"]
    assert run(["monitor", str(tmp_path / "x.f32"), *raw]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    found = [line for line in lines if line["kind"] == "finding" and not line["note"]]
    assert {line["finding"] for line in found} == {"scale"}
    assert [line["end_s"] is None for line in found[:2]] == [True, False][: len(found)]
    assert x.size / rate < found[0]["begin_s"] < 2 * x.size / rate
    assert all(line["begin_s"] == found[0]["begin_s"] and line["end_s"] > line["begin_s"] for line in found[1:])

"""Former names of options, columns and Python objects: each still works, and one line gives the new name."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

import cgid
import cgid.scene
import cgid.site
from cgid.cli.help import RENAMED
from cgid.cli.main import run
from cgid.cli.table import written_table
from cgid.errors import CgidError
from cgid.identification.answers import Answer, identify
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.manifest import read_manifest
from cgid.identification.prediction_settings import PredictionSettings
from cgid.identification.rows import measure
from cgid.impactor import Detection, SizeDistribution
from cgid.measure.modes import Modes
from cgid.physics.materials import STEEL
from cgid.report import Report
from cgid.site import SiteCalibration, TapTest
from cgid.site.tapping import read_times

ROOT = Path(__file__).parents[1]
#: Former Python name -> the present one.
OBJECTS = {
    "cgid.strikers": "cgid.estimate_impactors",
    "cgid.identification.question.Question": "cgid.identification.prediction_settings.PredictionSettings",
    "cgid.recordings.LARGEST_STREAM": "cgid.recordings.MAX_STREAM",
    "cgid.scene.Blow": "cgid.scene.CalibrationImpact",
    "cgid.site.usable_blows": "cgid.site.usable_impacts",
    "cgid.outlets.Outlets": "cgid.plant.PlantOutputs",
    "cgid.plots.MOST_CHANNELS": "cgid.plots.recording.MAX_CHANNELS",
    "cgid.plots.draw_drawn": "cgid.plots.answers.draw_drawn",
    "cgid.plots.png": "cgid.plots.figure.png",
    "cgid.plots.written": "cgid.plots.recording.written",
    "cgid.store.check_output": "cgid.store.run.check_output",
    "cgid.store.table_writer": "cgid.store.table.table_writer",
    "cgid.striker.StrikerColumns": "cgid.impactor.ImpactorColumns",
    "cgid.striker.StrikerPopulation": "cgid.impactor.ImpactorPopulation",
    "cgid.striker.Strikers": "cgid.impactor.ImpactorEstimates",
    "cgid.striker.strikers": "cgid.impactor.estimate_impactors",
    "cgid.striker.size_distribution": "cgid.impactor.size_distribution",
}
#: Former option -> a command line with it.
OPTIONS = {
    "--cost": ("predict", "datasets/sample.csv", "--cost", "gangue=2"),
    "--gangue-cost": ("predict", "datasets/sample.csv", "--gangue-cost=2"),
    "--striker": ("predict", "datasets/sample.csv", "--striker", "reference"),
}


def test_objects() -> None:
    for old, new in OBJECTS.items():
        (old_module, _, old_name), (new_module, _, new_name) = old.rpartition("."), new.rpartition(".")
        with pytest.warns(FutureWarning, match=new.replace(".", r"\.")):
            found = getattr(importlib.import_module(old_module), old_name)
        assert found is getattr(importlib.import_module(new_module), new_name), old


def test_arguments() -> None:
    signal = cgid.read_recording(ROOT / "datasets" / "sample.csv")[0]
    model, settings = cgid.load_model(), PredictionSettings(costs={"gangue": 9.0})
    expected = [answer.label for answer in identify(signal, model, settings=settings)]
    assert expected != [answer.label for answer in identify(signal, model)]
    with pytest.warns(FutureWarning, match="settings"):
        found = [answer.label for answer in identify(signal, model, question=settings)]
    assert found == expected
    with pytest.warns(FutureWarning, match="settings"), pytest.raises(TypeError, match="both"):
        identify(signal, model, question=settings, settings=settings)


def test_arguments_reach_the_function() -> None:
    """Each function under a former argument fails by the rule of the present one, after the warning."""
    scene, frames = cgid.load_scene("tail_beam"), np.zeros((1, 64))
    for call in (
        lambda: cgid.site.calibrate(scene, frames, 25600.0, 8, most_blows=0),
        lambda: cgid.scene.calibrated(scene, blows=[]),
    ):
        with pytest.warns(FutureWarning, match="impacts="), pytest.raises(CgidError, match="impacts"):
            call()
    for function, old, new in (
        (cgid.train, "strangers", "out_of_distribution"),
        (measure, "crew", "workers"),
        (ImpactClassifier().fit, "crew", "workers"),
        (Detection.learned, "found", "detected"),
    ):
        with pytest.warns(FutureWarning, match=new), pytest.raises(TypeError, match="missing"):
            function(**{old: None})
    with pytest.warns(FutureWarning, match="workers"), pytest.raises(TypeError, match="missing"):
        cgid.train(crew=None)


def test_attributes_of_results() -> None:
    site = SiteCalibration.__new__(SiteCalibration)
    object.__setattr__(site, "n_impacts", 7)
    sizes = SizeDistribution.__new__(SizeDistribution)
    for old, new in {"found": "detected", "low_found": "low_detected", "high_found": "high_detected"}.items():
        object.__setattr__(sizes, new, old)
        with pytest.warns(FutureWarning, match=new):
            assert getattr(sizes, old) == old
    with pytest.warns(FutureWarning, match="n_impacts"):
        assert site.n_blows == 7
    object.__setattr__(site, "has_converged", True)
    with pytest.warns(FutureWarning, match="has_converged"):
        assert site.at_rest
    test = TapTest.__new__(TapTest)
    object.__setattr__(test, "modes", Modes.relative(*np.ones((3, 1))))
    with pytest.warns(FutureWarning, match="modes.frequency"):
        assert test.frequency == [1.0]
    with pytest.warns(FutureWarning, match="modes.damping_ratio"):
        assert test.damping_ratio == [1.0]


def test_attribute() -> None:
    model, report = cgid.load_model(), Report.__new__(Report)
    inputs = np.full((1, len(model.inputs)), 0.5)
    with pytest.warns(FutureWarning, match="most_distant"):
        assert model.foremost(inputs) == model.most_distant(inputs)
    with pytest.warns(FutureWarning, match="noise_novelty"):
        assert model.drowned(inputs) == model.noise_novelty(inputs)
    object.__setattr__(report, "shares", ())
    with pytest.warns(FutureWarning, match="has_time_history"):
        assert not report.has_course
    sphere = cgid.Sphere(material=STEEL, radius=0.02)
    with pytest.warns(FutureWarning, match="impact_mass"):
        assert sphere.mass_in_blow == sphere.impact_mass
    recording = cgid.open_recording(ROOT / "datasets" / "sample.csv")
    with pytest.warns(FutureWarning, match="messages"):
        assert recording.said == recording.messages
    answer = Answer(time=1.0, label="coal", probabilities={"coal": 1.0}, novelty=0.1, impactor={"mass": 2.0})
    with pytest.warns(FutureWarning, match="impactor"):
        assert answer.striker == {"mass": 2.0}


@pytest.mark.parametrize("old", OPTIONS)
def test_option(old: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    new = tuple(argument.replace(old, RENAMED[old]) for argument in OPTIONS[old])
    assert run(list(new)) == 0
    expected = capsys.readouterr()
    assert run(list(OPTIONS[old])) == 0
    found = capsys.readouterr()
    assert found.out == expected.out
    assert sum(old in line and RENAMED[old] in line for line in found.err.splitlines()) == 1


# -- columns of tables: what version 54da98c wrote --------------------------------------------------------

EVENTS = """path,start,end,label,time [s],peak,peak_unit
sample.csv,0.0030050,0.0051750,coal,0.005005,8415,N
sample.csv,0.0230100,0.0252100,gangue,0.025010,13636,N
"""
MANIFEST = "path,label,start,end,rate,unit\na.npy,coal,0,0.5,25600,g\na.npy,gangue,0.5,1,25600,g\n"
ANSWERS = """source,channel,time [s],label,p(coal),p(gangue),novelty,overlapping,clipped,cut_off,problem
sample.csv,1,0.0050050,coal,0.6257,0.3743,0.181,false,false,false,
"""


def test_old_tables_of_events_and_manifests(tmp_path: Path) -> None:
    (tmp_path / "events.csv").write_text(EVENTS)
    (tmp_path / "manifest.csv").write_text(MANIFEST)
    new = EVENTS.replace("start,end,", "start_s,end_s,").replace("time [s]", "time_s")
    (tmp_path / "new.csv").write_text(new)
    events = read_manifest(tmp_path / "events.csv").annotations
    assert [(one.start, one.end, one.label) for one in events] == [
        (0.003005, 0.005175, "coal"),
        (0.02301, 0.02521, "gangue"),
    ]
    assert read_manifest(tmp_path / "new.csv").annotations == events
    (first, _) = read_manifest(tmp_path / "manifest.csv").annotations
    assert (first.start, first.end, first.sampling_rate) == (0.0, 0.5, 25600.0)


def test_old_tables_of_answers_and_times(tmp_path: Path) -> None:
    (tmp_path / "answers.csv").write_text(ANSWERS)
    table = written_table(str(tmp_path / "answers.csv"))
    assert table is not None and (table.kind, table.n_rows) == ("table of answers", 1)
    row = dict(zip(ANSWERS.splitlines()[0].split(","), ["sample.csv", "1", 0.005, "coal"], strict=False))
    (tmp_path / "answers.jsonl").write_text(json.dumps(row) + "\n")
    assert written_table(str(tmp_path / "answers.jsonl")) is not None
    with h5py.File(tmp_path / "answers.h5", "w") as file:
        file["columns/source"], file["columns/channel"] = np.array([b"sample.csv"]), np.array([b"1"])
        file["columns/time"] = np.array([0.005])
    assert written_table(str(tmp_path / "answers.h5")) is not None
    for title in ("time_s", "time [s]"):
        (tmp_path / "taps.csv").write_text(f"{title},by\n0.5,me\n")
        assert read_times(tmp_path / "taps.csv") == [0.5]


def test_json_keeps_the_keys_that_scripts_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    assert run(["predict", "datasets/sample.csv", "--json"]) == 0
    first = json.loads(capsys.readouterr().out.splitlines()[0])
    assert first["version"] == 5
    assert first["probabilities"].keys() == {"coal", "gangue"}
    keys = {"kind", "source", "channel", "label", "novelty", "time_s", "end_s", "most_likely", "in_training_range"}
    assert keys <= first.keys()

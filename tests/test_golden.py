"""The golden files under tests/golden: what a release wrote, later ones read, with the same answers.

But for answers.json they are never made again; `tests/golden/make.py` says what they are and by what they were made.
"""

import gzip
import hashlib
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import SCHEMA_VERSION, signed
from cgid.identification.training.classifier import FAMILIES
from cgid.store import Dataset, read_table
from cgid.store.reading import Recording
from tests.golden.make import ANSWERS

GOLDEN = Path(__file__).parent / "golden"
DATA = json.loads((GOLDEN / "data.json").read_text())
DATASETS = sorted({key.partition("/")[0] for key, said in DATA.items() if "signals" in said})
MODELS = {name: said for file in GOLDEN.glob("models-*.json") for name, said in json.loads(file.read_text()).items()}


def sha256_of(values):
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def test_every_golden_model_has_its_answers():
    assert {path.name for path in GOLDEN.glob("models-*.npz")} == MODELS.keys()
    assert {name.removesuffix(".npz") for name in MODELS} >= {f"models-{SCHEMA_VERSION}-{name}" for name in FAMILIES}


@pytest.mark.parametrize("name", sorted(MODELS))
def test_models_answer_as_the_estimators_that_they_were_made_of(name):
    said, model = MODELS[name], StoredModel.load(GOLDEN / name)
    assert list(model.labels) == said["labels"]
    inputs = np.array(said["inputs"])
    np.testing.assert_allclose(model.probabilities(inputs), said["probabilities"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.novelty(inputs), said["novelty"], rtol=1e-9)
    # Written by this version, it is the same model again.
    again = StoredModel.from_bytes(model.to_bytes())
    assert again.header == model.header
    np.testing.assert_array_equal(again.probabilities(inputs), model.probabilities(inputs))


def test_a_model_of_this_schema_is_written_to_the_same_bytes():
    for name in MODELS:
        content = (GOLDEN / name).read_bytes()
        assert (StoredModel.from_bytes(content).to_bytes() == content) == name.startswith(f"models-{SCHEMA_VERSION}-")


@pytest.mark.parametrize("name", DATASETS)
def test_datasets_hold_what_h5py_found_in_them(name):
    shards = [said for key, said in DATA.items() if key.partition("/")[0] == name]
    dataset, first = Dataset(GOLDEN / name), 0
    assert len(dataset) == sum(said["signals"]["shape"][0] for said in shards)
    assert run(["verify", str(GOLDEN / name)]) == run(["info", str(GOLDEN / name)]) == 0
    batches = list(dataset.batches())
    signals = np.concatenate([batch.signals for batch in batches])
    labels = np.concatenate([batch.labels for batch in batches])
    specimen = np.concatenate([batch.specimen for batch in batches])
    assert set(labels) == {"coal", "gangue"}
    for said in shards:
        rows = slice(first, first + said["signals"]["shape"][0])
        assert sha256_of(signals[rows]) == said["signals"]["sha256"]
        assert sha256_of(specimen[rows]) == said["specimen"]["sha256"]
        for parameter in (key.partition("/")[2] for key in said if key.startswith("parameters/")):
            column = np.concatenate([batch.parameters[parameter] for batch in batches])[rows]
            assert sha256_of(column) == said[f"parameters/{parameter}"]["sha256"]
        first = rows.stop


@pytest.mark.parametrize("name", DATASETS)
def test_datasets_are_exported_and_predicted(name, tmp_path, capsys):
    path = tmp_path / "all.h5"
    assert run(["export", str(GOLDEN / name), "-o", str(path)]) == 0
    assert len(Dataset(path)) == len(Dataset(GOLDEN / name))
    for batch, other in zip(Dataset(path).batches(), Dataset(GOLDEN / name).batches(), strict=False):
        np.testing.assert_array_equal(batch.signals[: len(other)], other.signals[: len(batch)])
    assert run(["predict", str(GOLDEN / name), "--json"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(Dataset(path))


def test_the_recording_holds_what_h5py_found_in_it():
    said, recording = DATA["recording.h5"], Recording(GOLDEN / "recording.h5")
    assert sha256_of(recording.samples()) == said["samples"]["sha256"]
    assert run(["verify", str(GOLDEN / "recording.h5")]) == 0
    truth = recording.impacts()
    assert {f"impacts/{name}" for name in truth} | {"samples"} == said.keys()
    for name, column in truth.items():
        if column.dtype.kind != "U":
            assert sha256_of(column) == said[f"impacts/{name}"]["sha256"]


@pytest.mark.parametrize("name", ["table.h5", "table.csv", "table.parquet"])
def test_tables_hold_what_others_found_in_them(name, tmp_path):
    path = GOLDEN / name
    if name == "table.h5":
        path = tmp_path / name
        path.write_bytes(gzip.decompress((GOLDEN / "table.h5.gz").read_bytes()))
    table, said = read_table(path), DATA[name]
    label = "labels" if name == "table.h5" else "label"
    assert table.labels.tolist() == said[label]
    assert table.specimen.tolist() == [int(text) for text in said["specimen"]]
    assert table.columns.keys() == said.keys() - {label, "specimen"}
    for column, values in table.columns.items():
        np.testing.assert_array_equal(values, np.array(said[column], float))


@pytest.mark.parametrize("schema", [5, 9, 10**30])
def test_a_newer_model_is_refused_by_its_version(schema, tmp_path, capsys):
    model = StoredModel.load(GOLDEN / "models-4-linear.npz")
    header = np.frombuffer(signed({**model.header, "schema_version": schema, "colour": "red"}, model.arrays), np.uint8)
    # Of kinds, too, that only a later version knows.
    np.savez(tmp_path / "m.npz", header=header, halves=np.ones(3, np.float16), **model.arrays)
    told = rf"m.npz: schema_version {str(schema)[:20]} is newer than this cgid \(reads 4\): upgrade cgid$"
    with pytest.raises(BadData, match=told):
        StoredModel.load(tmp_path / "m.npz")
    assert run(["info", str(tmp_path / "m.npz")]) == 65
    assert capsys.readouterr().err.count("\n") == 1


# -- what earlier development versions wrote ----------------------------------------------------------------


def refused(capsys, *arguments):
    """Return the one line of a command that refuses its input."""
    assert run([*map(str, arguments)]) == 65
    (line,) = capsys.readouterr().err.splitlines()
    return line


CHANGES = [
    *({"schema_version": 2}, {"schema_version": 3}, {"family": "discriminant"}),
    *({"known": ["drop_height"]}, {"sensors": ["left"]}),
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_a_model_of_a_development_version_is_refused(change, tmp_path, capsys):
    model = StoredModel.load(GOLDEN / "models-4-linear.npz")
    header = np.frombuffer(signed(model.header | change, model.arrays), np.uint8)
    np.savez(tmp_path / "m.npz", header=header, **model.arrays)
    for command in (["info"], ["predict", GOLDEN / "single.h5", "--model"]):
        line = refused(capsys, *command, tmp_path / "m.npz")
        ((name, value),) = change.items()
        assert f"m.npz: not a valid model: {name} must be " in line
        assert f"got {value!r}" in line
        assert line.endswith("train it again with cgid train")


@pytest.mark.parametrize("command", ["info", "verify", "export", "predict"])
@pytest.mark.parametrize("mark", ["manifest.json", "unfinished.jsonl"])
def test_a_dataset_of_a_development_version_is_refused(mark, command, tmp_path, capsys):
    shutil.copytree(GOLDEN / "folder-3", tmp_path / "old", ignore=shutil.ignore_patterns("*[!5]"))
    (tmp_path / "old" / mark).write_text("{}")
    output = ["-o", tmp_path / "all.h5"] if command == "export" else []
    line = refused(capsys, command, tmp_path / "old", *output)
    assert f"{tmp_path / 'old'}: " in line and line.endswith("make it anew in another folder with cgid generate")


def test_recordings_of_a_development_version_are_refused(tmp_path, capsys):
    """They and their sums, without a description."""
    shutil.copy(GOLDEN / "recording.h5", tmp_path / "recording-00000.h5")
    digest = hashlib.sha256((GOLDEN / "recording.h5").read_bytes()).hexdigest()
    (tmp_path / "SHA256SUMS").write_text(f"{digest}  recording-00000.h5\n")
    assert "make it anew in another folder" in refused(capsys, "verify", tmp_path)


def test_a_shard_of_another_schema_is_refused(tmp_path, capsys):
    shutil.copy(GOLDEN / "single.h5", tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5", "r+") as file:
        file.attrs["schema_version"] = 0
    line = refused(capsys, "predict", tmp_path / "old.h5")
    assert "schema_version must be 1, got 0, of an earlier development version of cgid; make the file anew" in line


# -- what this version answers ------------------------------------------------------------------------------
#
# Where a change is meant to move these, make answers.json anew (`python tests/golden/make.py answers`).

TODAY = json.loads((GOLDEN / "answers.json").read_text())


@pytest.mark.parametrize(
    ("name", "p_error", "novelty_error"),
    # Behind a beam the optimum is flat: its last steps may end elsewhere on another processor.
    [("sample", 1e-3, 5e-3), ("sample of acceleration", 0.02, 0.05), ("caving", 0.02, 0.05)],
)
def test_predict_answers_as_before(name, p_error, novelty_error):
    found, before = ANSWERS[name](), TODAY[name]
    assert found.keys() == before.keys()
    for column in ("kinds", "overlapping", "clipped", "cut_off"):
        assert found[column] == before[column], column
    for column in ("time_s", "end_s"):
        np.testing.assert_allclose(found[column], before[column], rtol=0, atol=1e-6, err_msg=column)
    p = np.abs(np.subtract(found["p(gangue)"], before["p(gangue)"]))
    novelty = np.abs(np.log(np.divide(found["novelty"], before["novelty"])))
    same = [own == then for own, then in zip(found["label"], before["label"], strict=True)]
    # In the crowd of a caving window single impacts are near a limit, or have two optima.
    most = 0.97 if name == "caving" else 1.0
    for share in (np.mean(p < p_error), np.mean(novelty < novelty_error), np.mean(same)):
        assert share >= most
    np.testing.assert_allclose(found["share"], before["share"], rtol=0, atol=0.02)


def test_a_card_has_the_same_numbers_as_before():
    """Accuracies to a hundredth of a per cent, but for one signal that may be answered otherwise."""
    np.testing.assert_allclose(ANSWERS["card"](), TODAY["card"], rtol=2e-3, atol=2e-3)


def test_calibration_finds_the_modes_as_before():
    """Within a fifth of the standard deviations that it states."""
    found, before = (
        {name: np.array(own) for name, own in made.items()} for made in (ANSWERS["calibration"](), TODAY["calibration"])
    )
    for name in ("frequency", "damping_ratio"):
        assert (np.abs(np.log(found[name] / before[name])) < 0.2 * before[f"{name}_deviation"]).all(), name
        np.testing.assert_allclose(found[f"{name}_deviation"], before[f"{name}_deviation"], rtol=0.1)

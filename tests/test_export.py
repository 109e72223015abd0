"""Models as C, compiled with all warnings and sanitizers, and as ONNX, against `Model` itself."""

from __future__ import annotations

import csv
import functools
import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cgid import load_model
from cgid._lib.validation import UNKNOWN
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.export import c_source
from cgid.identification.model.conformal import COVERAGES, Conformal
from cgid.identification.model.families import Standardiser
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import FLOOR, NO_FLOOR
from cgid.identification.training.classifier import ImpactClassifier, noise_contrast
from cgid.measure.features.extraction import extract_array
from cgid.shipped import MODELS, path_of
from tests import few
from tests.test_labels import rung

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wmissing-prototypes", "-Werror", "-O1")
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
#: Labels that C would take for something else, were they not escaped.
LABELS = ("coal", "grès 7", "шале")


#: Programs by source and options, each made once.
_PROGRAMS: dict[tuple[str, ...], Path] = {}


def compiled(source: str, folder: Path, *options: str) -> Path:
    """Compile a file with all warnings as errors and with sanitizers; return the program."""
    if (source, *options) in _PROGRAMS:
        return _PROGRAMS[source, *options]
    file = folder / "model.c"
    file.write_text(source, encoding="ascii")
    program = folder / "model"
    done = subprocess.run(
        ["gcc", *STRICT, *SANITIZED, *options, str(file), "-o", str(program), "-lm"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    _PROGRAMS[source, *options] = program
    return program


def answers(program: Path, text: str) -> dict[str, np.ndarray]:
    """Run the program on a CSV; return the columns that it prints."""
    done = subprocess.run([program], input=text, capture_output=True, encoding="utf-8")
    assert (done.returncode, done.stderr) == (0, "")
    head, *lines = csv.reader(io.StringIO(done.stdout))
    columns = dict(zip(head, map(np.array, zip(*lines, strict=True)), strict=True))
    return {
        name: np.array([float(field or "nan") for field in column]) if name[:2] in ("p_", "no") else column
        for name, column in columns.items()
    }


def as_csv(rows: np.ndarray) -> str:
    return "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist())


def judged(model: StoredModel, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return label, probabilities and novelty of each row by `Model`, row by row where it refuses one."""
    n = len(model.inputs)
    inputs, guards = rows[:, :n], rows[:, n:]
    novelties = model.novelty(inputs, guards)
    try:
        probabilities = model.probabilities(inputs)
    except BadData:
        probabilities = np.full((len(rows), len(model.labels)), np.nan)
        for number, row in enumerate(inputs):
            try:
                probabilities[number] = model.probabilities(row[None])[0]
            except BadData:
                continue
    unknown = (novelties > 1) | np.isnan(probabilities[:, 0])
    labels = np.where(unknown, UNKNOWN, model.decide(np.nan_to_num(probabilities)))
    return labels, probabilities, novelties


def compare(found: np.ndarray, probabilities: np.ndarray, novelty: np.ndarray, novelties: np.ndarray) -> None:
    """Compare; of odd rows, whether a sum overflows may depend on its order."""
    sound = np.isfinite(found).all(axis=1) & np.isfinite(probabilities).all(axis=1)
    assert sound[:2000].all() and (novelties[~sound] > 1).all() and (novelty[~sound] > 1).all()
    np.testing.assert_allclose(found[sound], probabilities[sound], rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.minimum(novelty, 1e100), np.minimum(novelties, 1e100), rtol=1e-9)


def usual_rows(model: StoredModel, n: int, seed: int = 1) -> np.ndarray:
    """Return rows around the training of a model, some outside of it."""
    rng = np.random.default_rng(seed)
    standardiser = Standardiser.from_arrays(model.arrays, "standardiser.")
    rows = np.array([standardiser.at(place) for place in rng.normal(0, 1, (n, len(model.inputs)))])
    guards = rng.uniform(0, 1.05, (n, len(model.guards))) * np.array(model.guard_limits)
    return np.hstack([rows, guards])


def odd_rows(model: StoredModel, n: int) -> np.ndarray:
    """Return rows with values that no measurement gives: 0, denormal and huge numbers, and usual ones between."""
    rng = np.random.default_rng(2)
    odd = np.array([0.0, -0.0, 5e-324, -1e-310, 1e-30, -1.0, 1e30, -1e30, 1e154, 1e300, -1e300, 1.7e308])
    usual = usual_rows(model, n, seed=3)
    return np.where(rng.random(usual.shape) < 0.3, rng.choice(odd, usual.shape), usual)


@functools.cache
def made(family: str, n_labels: int) -> StoredModel:
    rng = np.random.default_rng(3)
    labels = np.repeat(LABELS[:n_labels], 300)
    features = rng.normal(size=(len(labels), 3)) + np.repeat(np.eye(3)[:n_labels], 300, axis=0)
    features[:, :2] = np.exp(features[:, :2])
    classifier = ImpactClassifier(family, n_units=7).fit(features, labels)
    order = np.searchsorted(classifier.classes_, labels)
    return StoredModel.from_classifier(
        classifier,
        guards={"asymmetry": 2.5},
        conformal=Conformal.fit(classifier.predict_proba(features[::20]), order[::20]),
        features=("peak_force", "width_10", "skewness"),
        unit="N",
        sampling_rates=(1e5, 2e5),
        training={},
    )


def named(name: str) -> StoredModel:
    """Return a shipped model, or a small one of a family and a number of labels."""
    if name in MODELS:
        return load_model(name)
    family, n_labels, *noise = name.split()
    model = made(family, int(n_labels))
    if not noise:
        return model
    if noise == ["floor"]:
        return replace(model, arrays=model.arrays | {FLOOR: np.array([1.0, NO_FLOOR, 0.1])})
    rows = usual_rows(model, 500)
    contrast = noise_contrast(rows, 10 + 5 * np.log(rows[:, 0]) + rows[:, 2], linear=(2, 3))
    return replace(model, arrays=model.arrays | replace(contrast, limit=-1.5).arrays)


#: One of each kind runs always.
NAMES = few(
    [
        "default",
        "linear 2 noise",
        "logistic 2 floor",
        "logistic 2",
        "linear 3",
        *MODELS[1:],
        "network 3",
        "linear 2",
    ],
    5,
)


@needs_gcc
@pytest.mark.parametrize("name", NAMES)
def test_double_precision_gives_the_models_answers(name: str, tmp_path: Path) -> None:
    model = named(name)
    rows = np.concatenate([usual_rows(model, 2000), odd_rows(model, 3000)])
    found = answers(compiled(c_source(model), tmp_path, "-DCGID_MAIN"), as_csv(rows))
    labels, probabilities, novelties = judged(model, rows)
    np.testing.assert_array_equal(found["label"], labels)
    theirs = np.stack([found[f"p_{label}"] for label in model.labels], axis=1)
    compare(theirs, probabilities, found["novelty"], novelties)
    assert set(labels[:2000]) == {*model.labels, UNKNOWN}


@needs_gcc
@pytest.mark.parametrize("real", ["double", "float"])
def test_what_is_no_number_is_unknown(real: str, tmp_path: Path) -> None:
    """One value after the other is nan, infinite, or missing."""
    model = load_model("default")
    row = usual_rows(model, 1)[0]
    fields = [[repr(value) for value in row.tolist()] for _ in range(3 * len(row))]
    for number, line in enumerate(fields):
        line[number % len(row)] = ("nan", "-inf", "")[number // len(row)]
    text = "".join(",".join(line) + "\n" for line in fields)
    found = answers(compiled(c_source(model), tmp_path, "-DCGID_MAIN", f"-DCGID_REAL={real}"), text)
    assert set(found["label"]) == {UNKNOWN}
    assert set(found["problem"]) == {"a value is missing or not finite"}
    assert np.isnan(found["p_coal"]).all() and np.isnan(found["novelty"]).all()


CALLER = """
#include <stdio.h>
#define CGID_HEADER
#include "model.c"

int main(void)
{
    static const cgid_real costs[CGID_N_LABELS] = {1, 3};
    cgid_real p[CGID_N_LABELS];
    double first;
    while (scanf("%lf", &first) == 1) {
        unsigned char held[CGID_N_LABELS];
        int coverage;
        p[0] = first;
        p[1] = 1 - first;
        printf("%d", cgid_decide(p, costs));
        for (coverage = 0; coverage < CGID_N_COVERAGES; coverage++) {
            int n = cgid_prediction_set(p, coverage, held);
            printf(" %d %d %d", n, held[0], held[1]);
        }
        printf("\\n");
    }
    printf("%d %d %d %d\\n", cgid_covers(9.95e4), cgid_covers(2.1e5), cgid_self_test(), (int)sizeof(cgid_answer));
    return 0;
}
"""


@needs_gcc
def test_another_file_calls_it_and_decides_by_cost_and_coverage(tmp_path: Path) -> None:
    model = made("network", 2)
    (tmp_path / "caller.c").write_text(CALLER)
    program = compiled(c_source(model), tmp_path, str(tmp_path / "caller.c"))
    first = np.linspace(0, 1, 201)
    done = subprocess.run([program], input="\n".join(map(repr, first.tolist())), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    *lines, last = [[int(field) for field in line.split()] for line in done.stdout.splitlines()]
    found, probabilities = np.array(lines), np.stack([first, 1 - first], axis=1)
    assert ["coal" if k == 0 else "grès 7" for k in found[:, 0]] == model.decide(
        probabilities, {"coal": 1, "grès 7": 3}
    ).tolist()
    sets = found[:, 1:].reshape(len(first), len(COVERAGES), 3)
    for number, coverage in enumerate(COVERAGES):
        try:
            held = model.prediction_set(probabilities, coverage)
        except InvalidValue:
            held = np.ones_like(probabilities, bool)
        np.testing.assert_array_equal(sets[:, number, 1:], held)
        np.testing.assert_array_equal(sets[:, number, 0], held.sum(axis=1))
    assert last == [1, 0, 0, 8 + 3 * 8]


@needs_gcc
def test_columns_are_found_by_name_as_cgid_features_prints_them(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """`cgid features` piped into the C program answers as `cgid predict`."""
    model = load_model("default")
    sample = str(path_of("datasets", "sample.csv"))
    assert run(["features", sample, "--features", ",".join(model.measured[::-1])]) == 0
    table = capfd.readouterr().out
    assert run(["predict", sample]) == 0
    expected = list(csv.DictReader(io.StringIO(capfd.readouterr().out)))
    found = answers(compiled(c_source(model), tmp_path, "-DCGID_MAIN"), table)
    assert found["label"].tolist() == [row["label"] for row in expected]
    np.testing.assert_allclose(found["p_coal"], [float(row["p_coal"]) for row in expected], atol=1e-4)


@needs_gcc
def test_channels_of_one_beam_answer_together_as_predict(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """`cgid features --same-beam` piped into the C program answers each rock as `cgid predict --same-beam`."""
    paths = []
    for seed in (3, 4, 5):
        samples, labels, onsets = rung(seed, 30)
        ends = [f"{onset - 0.05:.3f},{onset + 0.3:.3f}" for onset in onsets]
        # The second channel has a smaller signal in as much noise, and some rocks only the first hears.
        samples[1] = 0.5 * samples[1] + 0.02 * np.random.default_rng(seed).standard_normal(samples.shape[1])
        for onset in onsets[::9]:
            begin = round((onset - 0.02) * 10e3)
            samples[1, begin : begin + 3000] = 0.02 * np.random.default_rng(seed).standard_normal(3000)
        np.save(tmp_path / f"{seed}.npy", samples)
        paths += [f"{seed}.npy,{end},{label}" for end, label in zip(ends, labels, strict=True)]
    (tmp_path / "m.csv").write_text("\n".join(["path,start_s,end_s,label", *paths, ""]))
    raw, model = ("--rate", "10000", "--unit", "g"), tmp_path / "m.npz"
    assert run(["train", str(tmp_path / "m.csv"), *raw, "--same-beam", "1+2", "-o", str(model)]) == 0
    trained = StoredModel.load(model)
    assert trained.same_beam == ("1+2",)
    source = c_source(trained)
    assert "Channels of one beam (1+2)" in source
    samples, *_ = rung(9, 30)
    samples[:, 40000:] *= 1.5  # some outside of the training
    samples[1, 10000:20000] = samples[1, :1000].repeat(10)
    np.save(tmp_path / "new.npy", samples)
    file = [str(tmp_path / "new.npy"), *raw, "--same-beam", "1+2"]
    capfd.readouterr()
    assert run(["features", *file, "--features", ",".join(trained.measured)]) == 0
    table = capfd.readouterr().out
    assert run(["predict", *file, "--model", str(model)]) == 0
    expected = list(csv.DictReader(io.StringIO(capfd.readouterr().out)))
    found = answers(compiled(source, tmp_path, "-DCGID_MAIN"), table)
    assert [row["channel"] for row in csv.DictReader(io.StringIO(table))] == [row["channel"] for row in expected]
    assert found["label"].tolist() == [row["label"] for row in expected]
    assert {"coal", "gangue", UNKNOWN} == set(found["label"])
    for name in ("p_coal", "novelty"):
        np.testing.assert_allclose(found[name], [float(row[name] or "nan") for row in expected], rtol=1e-3, atol=1e-4)
    pytest.importorskip("onnx")
    assert run(["export-model", str(model), "--to", "onnx", "-o", str(tmp_path / "m.onnx")]) == 0
    assert b"mean of their log-odds" in (tmp_path / "m.onnx").read_bytes()


@needs_gcc
@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("width_10,skewness\n1,2\n", 65, "line 1: there must be a column peak_force"),
        ("1,2,3,4\n1,2,3\n", 65, "line 2: there must be a field for each value"),
        ("1,2,3,many\n", 65, "line 1: there must be a number, got many"),
        ("# a comment\n\n1,2,3," + "9" * 20000, 65, "line 3: it must be shorter"),
    ],
)
def test_bad_rows_end_with_one_line(text: str, code: int, says: str, tmp_path: Path) -> None:
    program = compiled(c_source(made("linear", 2)), tmp_path, "-DCGID_MAIN")
    if "9" * 20000 in text:
        text += "\n1,2,3,4\n"
    done = subprocess.run([program], input=text, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (code, f"{says}\n")
    gone = subprocess.run([program, "gone.csv"], capture_output=True, text=True)
    assert (gone.returncode, gone.stderr) == (66, "gone.csv: cannot be read (No such file or directory)\n")


@pytest.mark.parametrize(
    "name", few(["default", "logistic 2", "linear 2 noise", "linear 3", *MODELS[1:], "network 3"], 2)
)
def test_onnx_gives_the_models_answers(name: str, tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="onnx is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    model = named(name)
    (tmp_path / "model.npz").write_bytes(model.to_bytes())
    assert run(["export-model", str(tmp_path / "model.npz"), "--to", "onnx", "-o", str(tmp_path / "model.onnx")]) == 0
    session = runtime.InferenceSession(tmp_path / "model.onnx", providers=["CPUExecutionProvider"])
    rows = np.concatenate([usual_rows(model, 2000), odd_rows(model, 10_000)])
    labels, probabilities, novelties = judged(model, rows)
    theirs, novelty, numbers = session.run(["probabilities", "novelty", "label"], {"values": rows})
    compare(theirs, probabilities, novelty, novelties)
    np.testing.assert_array_equal(np.array([*model.labels, UNKNOWN])[numbers], labels)
    about = session.get_modelmeta().custom_metadata_map
    assert json.loads(about["labels"]) == list(model.labels)
    assert json.loads(about["values"]) == [*model.inputs, *model.guards]
    for odd in (np.nan, np.inf, -np.inf):
        places = np.where(np.eye(rows.shape[1], dtype=bool), odd, rows[0])
        assert (session.run(["label"], {"values": places})[0] == -1).all()
    assert len(session.run(["label"], {"values": rows[:0]})[0]) == 0


MEASURER = """
#include <stdio.h>
#define CGID_HEADER
#include "model.c"

int main(void)
{
    static double samples[65536];
    static cgid_real frame[65536];
    int shape[2], i, k;
    double rate;
    while (fread(shape, sizeof(int), 2, stdin) == 2 && fread(&rate, sizeof rate, 1, stdin) == 1) {
        cgid_real values[CGID_N_VALUES];
        if (fread(samples, sizeof(double), (size_t)shape[0], stdin) != (size_t)shape[0]) {
            return 1;
        }
        for (i = 0; i < shape[0]; i++) {
            frame[i] = (cgid_real)samples[i];
        }
        printf("%d", cgid_measure(frame, shape[0], shape[1], rate, values));
        for (k = 0; k < CGID_N_VALUES; k++) {
            printf(",%.17g", (double)values[k]);
        }
        printf("\\n");
    }
    return 0;
}
"""


def levels_model(names: tuple[str, ...]) -> StoredModel:
    rng = np.random.default_rng(4)
    classifier = ImpactClassifier("logistic").fit(
        rng.normal(-2, 1, (200, len(names))), np.repeat(["coal", "gangue"], 100)
    )
    return StoredModel.from_classifier(
        classifier, features=names, unit="m/s^2", sampling_rates=(25600.0, 25600.0), training={}
    )


def vibrations(rng: np.random.Generator, n: int, n_samples: int, pre_trigger: int, rate: float) -> np.ndarray:
    """Return decaying lines that begin some samples after the trigger, on an offset, with noise."""
    times = (np.arange(n_samples) - pre_trigger - rng.integers(0, 5, (n, 1))) / rate
    rows = rng.normal(rng.normal(0, 3, (n, 1)), 0.05, (n, n_samples))
    for _ in range(6):
        frequency, decay = np.exp(rng.uniform(np.log(40), np.log(0.45 * rate), (n, 1))), rng.uniform(20, 300, (n, 1))
        line = (
            rng.lognormal(1, 1, (n, 1)) * np.exp(-decay * np.maximum(times, 0)) * np.sin(2 * np.pi * frequency * times)
        )
        rows += np.where(times > 0, line, 0)
    return rows


@needs_gcc
@pytest.mark.parametrize("real", ["double", "float"])
def test_levels_of_a_vibration_are_those_of_extract(real: str, tmp_path: Path) -> None:
    """Frames of several lengths and rates; some have no impact, some are cut off, constant or not finite."""
    names = ("level_1000_hz", "level_total", "level_200_hz", "early_level_0_500_hz", "level_10000_hz")
    names += ("relative_level_2500_hz", "early_level_4000_8000_hz")
    (tmp_path / "measurer.c").write_text(MEASURER)
    source = c_source(levels_model(names))
    program = compiled(source, tmp_path, f"-DCGID_REAL={real}", "-O2", str(tmp_path / "measurer.c"))
    rng, content, expected = np.random.default_rng(6), b"", []
    for n_samples, pre_trigger, rate in (
        (1024, 100, 25600.0),
        (2500, 64, 51200.0),
        (6000, 200, 25600.0),
        (1100, 0, 48000.0),
    ):
        frames = vibrations(rng, 8, n_samples, pre_trigger, rate)
        frames[5] = rng.normal(0, 1, n_samples)
        frames[6] = 2.5
        frames[7, : n_samples - 20] = rng.normal(0, 0.01, n_samples - 20)
        frames = frames.astype(np.float32).astype(np.float64)
        expected += [*extract_array(frames, rate, names, pre_trigger=pre_trigger, invalid="nan")]
        frames = [*frames, np.where(np.arange(n_samples) == 300, np.nan, frames[0])]
        expected.append(np.full(len(names), np.nan))
        for frame in frames:
            content += (
                np.array([n_samples, pre_trigger], np.int32).tobytes() + np.float64(rate).tobytes() + frame.tobytes()
            )
    for frame in frames[:1]:  # neither long nor quick enough for its bands
        for n_samples, rate in ((100, 25600.0), (1000, 8000.0)):
            content += np.array([n_samples, 10], np.int32).tobytes() + np.float64(rate).tobytes()
            content += frame[:n_samples].tobytes()
            expected.append(np.full(len(names), np.nan))
    done = subprocess.run([program], input=content, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    measured, found = np.split(np.loadtxt(io.StringIO(done.stdout.decode()), delimiter=","), [1], axis=1)
    np.testing.assert_array_equal(measured[:, 0], np.isfinite(expected).all(axis=1))
    assert 20 <= measured.sum() <= 28
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 if real == "double" else 1e-5)

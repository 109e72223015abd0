"""Make the golden files of this version of cgid: data and models that every later release must read.

    python tests/golden/make.py data         # datasets, a recording, tables, and another reader's view of them
    python tests/golden/make.py models       # a model of each family, and the answers of the estimators behind them
    python tests/golden/make.py answers      # what predict, train and calibrate find today

What a release has written is never made again: the files of a later one are added to them. Before the first release,
data and models are of the commits that added them.

answers.json is of this version: make it anew where a change is meant to move an answer, a card or a calibration, and
say so in CHANGELOG.md. `test_golden.py` has the tolerances.

The other JSON files hold the expected content: for data, that which h5py, pyarrow and Python's own csv read, not
cgid; for models, the answers of the underlying scikit-learn estimators to drawn inputs.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gzip
import hashlib
import io
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

HERE = Path(__file__).parent
SCENE, STREAM = HERE / "scene.toml", HERE / "stream.toml"
N_SIGNALS, SEED = 12, 7


def make_data(folder: Path) -> None:
    """Write datasets, recording and tables, and data.json."""
    from cgid.cli.main import run
    from cgid.scene import generate, load_scene
    from cgid.store import Dataset

    scene = load_scene(SCENE)
    whole = generate(scene, folder / "shards", N_SIGNALS, SEED, shard_signals=8)
    version = json.loads((whole / "description.json").read_text())["schema_version"]
    whole = whole.rename(folder / f"folder-{version}")
    generate(scene, folder / "single.h5", N_SIGNALS, SEED)
    # gzip.h5 is of an earlier development version, which could compress: such files are read as before.
    assert len(Dataset(whole)) == N_SIGNALS
    what = ["--features-only", "--features", "peak_force", "-n", str(N_SIGNALS), "--seed", str(SEED)]
    for ending in ("h5", "csv", "parquet"):
        assert run(["generate", str(SCENE), "-o", str(folder / f"table.{ending}"), *what]) == 0
    assert run(["generate", str(STREAM), "-o", str(folder / "recording.h5"), "--seed", str(SEED)]) == 0
    # An HDF5 column takes 32 kB even with few rows; most of it is empty.
    table = folder / "table.h5"
    (folder / "table.h5.gz").write_bytes(gzip.compress(table.read_bytes(), mtime=0))
    files = [*sorted(whole.glob("*.h5")), folder / "single.h5", folder / "gzip.h5", folder / "recording.h5"]
    found: dict[str, Any] = {str(file.relative_to(folder)): _content(file) for file in files}
    found |= {f"table.{ending}": _columns(folder / f"table.{ending}") for ending in ("h5", "csv", "parquet")}
    table.unlink()
    _write(folder / "data.json", found)


def make_models(folder: Path) -> None:
    """Write a model of each family and one of windows, and models-N.json."""
    from cgid.identification.training import train_on_specimens
    from cgid.identification.training.classifier import FAMILIES
    from cgid.scene import load_scene, synthesise

    scene = load_scene(HERE.parents[1] / "datasets" / "reference.toml")
    expected = {}
    for family in FAMILIES:
        impacts = synthesise(scene, 900, seed=SEED)
        training = train_on_specimens(impacts, features=["peak_force", "width_50"], guards=[], family=family)
        version = training.model.header["schema_version"]
        inputs = np.exp(np.random.default_rng(SEED).normal(size=(6, 2))) * [2e4, 3e-4]
        expected[f"models-{version}-{family}.npz"] = {
            "labels": list(training.model.labels),
            "inputs": inputs.tolist(),
            "probabilities": training.classifier.predict_proba(inputs).tolist(),
            "novelty": training.classifier.novelty(inputs).tolist(),
        }
        (folder / f"models-{version}-{family}.npz").write_bytes(training.model.to_bytes())
    _write(folder / f"models-{version}.json", expected)


def make_answers(folder: Path) -> None:
    """Write answers.json."""
    _write(folder / "answers.json", {name: make() for name, make in ANSWERS.items()})


def predicted(*recordings: str) -> dict[str, Any]:
    """Return the columns of what `cgid predict --json` says of the impacts of recordings, and its shares of gangue."""
    from cgid.cli.main import run

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert run(["predict", *recordings, "--json"]) == 0
    rows = [json.loads(line) for line in printed.getvalue().splitlines()]
    impacts = [row for row in rows if row["kind"] == "impact"]
    names = ("label", "time_s", "end_s", "novelty", "overlapping", "clipped", "cut_off", "prediction_set")
    found: dict[str, Any] = {name: [row[name] for row in impacts] for name in names}
    found["p(gangue)"] = [row["probabilities"]["gangue"] for row in impacts]
    found["kinds"] = [row["kind"] for row in rows if row["kind"] != "impact"]
    found["share"] = [row["gangue_share"] for row in rows if row["kind"] == "share"]
    return found


def predicted_in_caving() -> dict[str, Any]:
    """Return what `predicted` does, of twelve seconds of the scene `caving` whose rocks turn to gangue."""
    from cgid.scene import load_scene, parse_scene, record

    content = json.loads(load_scene("caving").text)
    content["stream"] |= {"duration": 12.0, "mixture": {"times": [0.0, 12.0], "gangue": [0.1, 0.9]}}
    signal, _ = record(parse_scene(content), SEED, 0)
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, "caving.npy"), signal.samples)
        return predicted(str(Path(folder, "caving.npy")), "--rate", f"{signal.sampling_rate:g}", "--unit", "m/s^2")


def numbers_of_card() -> list[float]:
    """Return the numbers on the card of a small training."""
    from cgid.cli.main import run

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        assert run(["train", "reference", "-n", "600", "--seed", str(SEED), "-o", f"{folder}/model.npz"]) == 0
        card = Path(folder, "model.md").read_text(encoding="utf-8")
    # Versions, digests and file names are none of them.
    return [float(text) for text in re.findall(r"(?<![\w.:/-])-?\d+\.?\d*(?![\w:/-]|\.\d)", card)]


def calibrated() -> dict[str, list[float]]:
    """Return the modes of the site file of a panel that is truly 1 % thicker, from 40 impacts."""
    from cgid.calibration import calibrate
    from cgid.scene import load_scene, parse_scene, synthesise

    panel = load_scene(HERE / "panel.toml")
    content = json.loads(panel.text)
    content["tail_beam"]["thickness"] *= 1.01
    (batch,) = synthesise(parse_scene(content), 40, SEED)
    found = calibrate(panel, batch.signals, batch.sampling_rate, batch.pre_trigger)
    with tempfile.TemporaryDirectory() as folder:
        found.save(Path(folder, "site.toml"))
        beam = load_scene(Path(folder, "site.toml")).tail_beam
    assert beam is not None and beam.learned_modes is not None
    names = ("frequency", "damping_ratio", "frequency_deviation", "damping_ratio_deviation")
    return {name: beam.learned_modes.columns[name].tolist() for name in names}


#: What answers.json holds, and what makes it.
ANSWERS: dict[str, Callable[[], Any]] = {
    "sample": lambda: predicted("--sample"),
    "sample of acceleration": lambda: predicted(str(HERE.parents[1] / "datasets" / "sample_acceleration.csv")),
    "caving": predicted_in_caving,
    "card": numbers_of_card,
    "calibration": calibrated,
}


def _content(file: Path) -> dict[str, Any]:
    """Return shape and SHA-256 of every dataset in an HDF5 file, as h5py reads them."""
    found: dict[str, Any] = {}
    with h5py.File(file) as stored:

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                values = item[:]
                found[name] = {"shape": list(values.shape), "sha256": sha256_of(values)}

        stored.visititems(note)
    return found


def _columns(file: Path) -> dict[str, list[Any]]:
    """Return the columns of a table, read without cgid."""
    if file.suffix == ".csv":
        with file.open(newline="") as lines:
            next(lines)  # the table's own description
            rows = list(csv.reader(lines))
        return {name: list(values) for name, *values in zip(*rows, strict=True)}
    if file.suffix == ".parquet":
        import pyarrow.parquet

        return {name: list(map(str, values)) for name, values in pyarrow.parquet.read_table(file).to_pydict().items()}
    with h5py.File(file) as stored:
        found: dict[str, list[Any]] = {}

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                texts = [value.decode() if isinstance(value, bytes) else str(value) for value in item[:].tolist()]
                found[name.rpartition("/")[2]] = texts

        stored.visititems(note)
        return found


def sha256_of(values: np.ndarray) -> str:
    """Return the SHA-256 of numbers or texts as stored in memory, in lower-case hexadecimal digits."""
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def _write(path: Path, content: Any) -> None:
    """Write an object as JSON, one line for each file."""
    lines = [f"{json.dumps(name)}: {json.dumps(said)}" for name, said in content.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def main() -> None:
    """Make the requested files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("data", "models", "answers"))
    parser.add_argument("--into", type=Path, default=HERE, help="another folder")
    arguments = parser.parse_args()
    {"data": make_data, "models": make_models, "answers": make_answers}[arguments.what](arguments.into)


if __name__ == "__main__":
    main()

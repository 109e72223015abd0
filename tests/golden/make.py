"""Make the golden files of this version of cgid: data and models that every later version must read.

    python tests/golden/make.py data         # datasets, a recording, tables, and another reader's view of them
    python tests/golden/make.py models       # a model of each family, and the answers of the estimators behind them

Files of an older version are made by a checkout of that version and never again: there, the same command writes the
files of its own schemas, which are then added to the existing ones. Origins:

    models-2-*                                                      by commit 9ae1126
    models-3-*, manifest-1, single, gzip, recording, table, data    by commit 54cf5f0
    models-4-*, manifest-2                                          by the commits that added them

JSON files next to them hold the expected content: for data, that which h5py, pyarrow and Python's own csv read, not
cgid; for models, the answers of the underlying scikit-learn estimators to drawn inputs.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import json
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
    version = json.loads((whole / "manifest.json").read_text()).get("schema_version", 1)
    whole = whole.rename(folder / f"manifest-{version}")
    generate(scene, folder / "single.h5", N_SIGNALS, SEED)
    generate(scene, folder / "gzip.h5", N_SIGNALS, SEED, compression="gzip", dtype="float64")
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
    from cgid.identification.classifier import FAMILIES
    from cgid.identification.training import train
    from cgid.scene import load_scene, synthesise

    scene = load_scene(HERE.parents[1] / "datasets" / "reference.toml")
    expected = {}
    for family in FAMILIES:
        # Few impacts keep the boosted trees small; prediction sets need more impacts.
        impacts = synthesise(scene, 240 if family == "boosting" else 900, seed=SEED)
        training = train(impacts, features=["peak_force", "width_50"], guards=[], family=family)
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
    parser.add_argument("what", choices=("data", "models"))
    parser.add_argument("--into", type=Path, default=HERE, help="another folder")
    arguments = parser.parse_args()
    {"data": make_data, "models": make_models}[arguments.what](arguments.into)


if __name__ == "__main__":
    main()

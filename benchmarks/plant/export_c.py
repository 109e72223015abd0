"""The C file of a model: size, memory, time, and its answers beside those of `Model` to the same signals.

`python benchmarks/plant/export_c.py [--signals 100000]`; needs gcc.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from cgid import load_model, load_scene
from cgid.export import c_source
from cgid.identification.model import Model
from cgid.scene import plan
from cgid.scene.synthesis.synthesis import columns_of

#: Values that no measurement gives.
ODD = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -1e-310, 1e-30, -1.0, 1e30, -1e30, 1e154, 1e300, -1.7e308])


class Library:
    """The C file as a shared library, with one function that answers to many rows."""

    def __init__(self, source: str, folder: Path, real: str, *options: str) -> None:
        self.dtype = np.dtype(np.float32 if real == "float" else np.float64)
        loop = (
            "\nvoid answer_all(const cgid_real *values, int n, cgid_answer *answers)\n{\n"
            "    for (int i = 0; i < n; i++) cgid_identify(values + (long)i * CGID_N_VALUES, answers + i);\n}\n"
        )
        file, self.path = folder / f"{real}.c", folder / f"{real}.so"
        file.write_text(source + loop)
        command = ["gcc", "-std=c99", "-O2", f"-DCGID_REAL={real}", *options]
        subprocess.run([*command, "-shared", "-fPIC", str(file), "-o", str(self.path), "-lm"], check=True)
        subprocess.run([*command, "-fstack-usage", "-c", str(file), "-o", str(folder / f"{real}.o")], check=True)
        self.stack = max(int(line.split("\t")[1]) for line in (folder / f"{real}.su").read_text().splitlines())
        sizes = subprocess.run(["size", str(folder / f"{real}.o")], capture_output=True, text=True, check=True)
        self.text, self.data, self.bss = map(int, sizes.stdout.splitlines()[1].split()[:3])

    def __call__(self, rows: np.ndarray, n_labels: int) -> tuple[np.ndarray, float]:
        """Return the answers, and the time for one row [s]."""
        answer = np.dtype(
            [("status", "i4"), ("label", "i4"), ("novelty", self.dtype), ("probability", self.dtype, n_labels)]
        )
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(rows, self.dtype)
        out = np.zeros(len(rows), answer)
        function = ctypes.CDLL(str(self.path)).answer_all
        start = time.perf_counter()
        function(values.ctypes.data_as(ctypes.c_void_p), len(rows), out.ctypes.data_as(ctypes.c_void_p))
        return out, (time.perf_counter() - start) / len(rows)


def rows_of(model: Model, scene: str, n: int) -> np.ndarray:
    """Return the values of measurable signals of a scene, (n_rows, n_values)."""
    asked = plan(load_scene(scene), "features", features=model.measured)
    parts = [
        np.stack([part.columns[name] for name in (*model.inputs, *model.guards)], axis=1)
        for part in columns_of(asked, n, seed=11)
    ]
    rows = np.concatenate(parts)
    return rows[np.isfinite(rows).all(axis=1)]


def in_training(model: Model, n: int) -> np.ndarray:
    rng = np.random.default_rng(11)
    places = rng.normal(0, 1, (n, len(model.inputs)))
    rows = np.array([model._standardiser.at(place) for place in places])
    return np.hstack([rows, rng.uniform(0, 1.05, (n, len(model.guards))) * np.array(model.guard_limits)])


def judged(model: Model, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the numbers of the labels, -1 for unknown, the probabilities, and the time for one row [s]."""
    n = len(model.inputs)
    start = time.perf_counter()
    probabilities, novelties = model.probabilities(rows[:, :n]), model.novelty(rows[:, :n], rows[:, n:])
    spent = (time.perf_counter() - start) / len(rows)
    return np.where(novelties > 1, -1, np.argmax(probabilities, axis=1)), probabilities, spent


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--signals", type=int, default=100_000)
    n = parser.parse_args().signals
    print(
        "| model | reals | text + data [kB] | stack of a function [B] | us an impact (numpy) | largest error of p |"
        " other labels | of them within .5 +- .001 or novelty 1 +- .001 | odd rows answered otherwise |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, scene in (("default", "reference"), ("default-acceleration", None)):
        model = load_model(name)
        rows = in_training(model, n) if scene is None else rows_of(model, scene, n)
        labels, probabilities, by_numpy = judged(model, rows)
        rng = np.random.default_rng(5)
        odd = rows[:10_000].copy()
        odd = np.where(rng.random(odd.shape) < 0.2, rng.choice(ODD, odd.shape), odd)
        for real in ("double", "float"):
            with tempfile.TemporaryDirectory() as folder:
                library = Library(c_source(model), Path(folder), real)
                found, spent = library(rows, len(model.labels))
                strange, _ = library(odd, len(model.labels))
                other = found["label"] != labels
                near = (np.abs(probabilities[:, 0] - 0.5) < 1e-3) | (np.abs(found["novelty"] - 1) < 1e-3)
                wrong = otherwise(model, odd, strange) if real == "double" else "-"
                error = np.abs(found["probability"] - probabilities).max()
                cells = (
                    f"{name} ({len(rows)} rows)", real, f"{(library.text + library.data) / 1e3:.1f}", library.stack,
                    f"{spent * 1e6:.2f} ({by_numpy * 1e6:.2f})", f"{error:.1e}", other.sum(), (other & near).sum(),
                    f"{wrong} of {len(odd)}",
                )  # fmt: skip
                print("|", " | ".join(map(str, cells)), "|", flush=True)


def otherwise(model: Model, rows: np.ndarray, found: np.ndarray) -> int:
    wrong = 0
    for row, answer in zip(rows, found, strict=True):
        try:
            label = judged(model, row[None])[0][0] if np.isfinite(row).all() else -1
        except ValueError:
            label = -1
        wrong += label != answer["label"]
    return wrong


if __name__ == "__main__":
    main()

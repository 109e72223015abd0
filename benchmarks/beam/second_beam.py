"""A beam of other size and modes than the shipped one, as users have it: calibrated from its own impacts.

    python benchmarks/beam/second_beam.py FOLDER [--impacts 300] [--signals 30000] [--jobs 2] [--windows 60]

Its plate is of finite elements (`independent_beam`). `cgid` knows its nominal sizes, learns its modes from unlabelled
blows, and trains on the scene that this gives, by the commands that a user types; then all is as in `anchor`. Last,
streams of each seam are spoilt, and the table has what is told of them.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
from scipy import signal

from benchmarks.beam import anchor
from benchmarks.beam.independent_beam import RATE, generate
from benchmarks.beam.independent_modes import Beam
from cgid.cli.main import run
from cgid.identification.model import Model
from cgid.identification.prediction import load_model
from cgid.identification.prediction.explanation import explain
from cgid.learning.faults import answers_of

#: A thinner plate with fewer, lower ribs.
PLATE = Beam(thickness=0.025, number=6, depth=0.20, rib_thickness=0.020)
SEED = 741
SEAMS = ("shipped", "wet", "hard", "random 1", "random 2")


def calibrated(folder: Path, n_impacts: int, n_signals: int, jobs: int) -> Path:
    """Return a model of the plate, made by commands from a recording of its blows."""
    text = (Path(__file__).parents[2] / "datasets" / "caving.toml").read_text()
    ribs = f'{{ number = {PLATE.number}, depth = "{PLATE.depth} m", thickness = "{PLATE.rib_thickness} m" }}'
    text = re.sub(r"(?m)^ribs = .*$", f"ribs = {ribs}", text.replace('"30 mm"', f'"{PLATE.thickness} m"'))
    (folder / "nominal.toml").write_text(text)
    made = generate(n_impacts, SEED, anchor.VARIANT, noise=anchor.QUIET, beam=PLATE)["acceleration"]
    fade = np.cos(np.linspace(0, np.pi / 2, 512)) ** 2
    made[:, -512:] *= fade
    gap = np.random.default_rng(SEED).normal(0, anchor.QUIET * anchor.NOISE, (n_impacts, round(0.3 * RATE)))
    np.save(folder / "blows.npy", np.hstack([made, gap]).ravel().astype(np.float32))
    site, model = folder / "site.toml", folder / "site.npz"
    given = ["--rate", f"{RATE:g}", "--unit", "m/s^2", "--scene", str(folder / "nominal.toml"), "-o", str(site)]
    if run(["calibrate", str(folder / "blows.npy"), *given, "--overwrite"]):
        raise SystemExit("it could not be calibrated")
    trained = ["train", str(site), "--signals", str(n_signals), "--jobs", str(jobs), "-o", str(model), "--overwrite"]
    if run(trained):
        raise SystemExit("it could not be trained")
    return model


def spoilt(samples: np.ndarray) -> dict[str, tuple[np.ndarray, float]]:
    """Return samples with each fault, and the rate that is stated [Hz]."""
    w = 2 * np.pi * 6000 / RATE
    r, largest = np.exp(-0.03 * w), np.abs(samples).max()
    limit = np.quantile(np.abs(samples), 0.995)
    made = {
        "sound": samples,
        "upside down": -samples,
        "times 40": 40 * samples,
        "over 20": samples / 20,
        "low-pass of 4 kHz": signal.sosfilt(signal.butter(4, 4000, fs=RATE, output="sos"), samples),
        "rings at 6 kHz": signal.lfilter([1 - 2 * r * np.cos(w) + r * r], [1, -2 * r * np.cos(w), r * r], samples),
        "clipped": np.clip(samples, -limit, limit),
        "noise": samples + np.random.default_rng(0).normal(0, 0.02 * largest, samples.size),
    }
    return {name: (one, RATE) for name, one in made.items()} | {"rate half as high again": (samples, 1.5 * RATE)}


def faults(model: Model) -> None:
    """Print what explains sound and spoilt streams of each seam."""
    streams = [anchor.stream(anchor.SEAMS[name], 45.0, 0.3, 1000 * SEED + 900 + k)[0] for k, name in enumerate(SEAMS)]
    print("\n| fault | " + " | ".join(SEAMS) + " |\n|" + "---|" * (len(SEAMS) + 1))
    for fault in spoilt(streams[0]):
        told = [explain(answers_of(*spoilt(one)[fault], model), model) for one in streams]
        named = (", ".join(one.faults) + (f" {one.factor:.2g}" if one.factor > 0 else "") for one in told)
        print(f"| {fault} | " + " | ".join(named) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", help="one that was made before")
    parser.add_argument("--impacts", type=int, default=300)
    parser.add_argument("--signals", type=int, default=30_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--windows", type=int, default=60, help="of each seam")
    parser.add_argument("--cycles", type=int, default=20, help="of each seam")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    model = load_model(given.model or calibrated(given.folder, given.impacts, given.signals, given.jobs))
    anchor.PLATE = PLATE
    sites = {
        name: anchor.Site.of(anchor.SEAMS[name], 1000 * SEED + number, model, None) for number, name in enumerate(SEAMS)
    }
    anchor.single_windows(model, sites, given.windows)
    anchor.cycles(model, sites, given.cycles)
    faults(model)


if __name__ == "__main__":
    main()

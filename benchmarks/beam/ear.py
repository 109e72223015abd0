"""One ear: how many impacts each command lists of the same vibration, and how many of these `predict` lists, too.

    python benchmarks/beam/ear.py [--seconds 20] [--seed 0] [--only volts]

A stream of `caving` without hum as it is, with tones of machines, gaps, upside down, at other rates (the same rocks on
the same modes), and in volts. `predict` lists impacts with their answer, `events` and `label` those that can be
measured, `info` and `plot` count. Training and the search for silence hear tones with the rocks, as models of labelled
recordings keep them; `train --from` hears as the model that it corrects.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam import rates
from benchmarks.beam.lines import MACHINES, G, tones
from cgid import load_model
from cgid.cli.main import run
from cgid.identification.detection.silence import silence_of
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import Reading, open_all, record
from cgid.identification.training.rows import Slicing
from cgid.recordings import open_recording

Floats = NDArray[np.float64]
#: A row of another command is one of `predict` within this time [s].
SAME = 1.5e-3
#: Sensitivity of the sensor of the recording in volts [V/g].
SENSITIVITY = 0.0102


def told(command: list[str]) -> str:
    """Return what a command prints on stdout."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(command)
    if code:
        raise RuntimeError(f"{' '.join(command)}: {err.getvalue()}")
    return out.getvalue()


def labelled(file: Path, options: list[str]) -> list[float]:
    """Return the times of the impacts of the page of `label` [s]."""
    command = [sys.executable, "-m", "cgid", "label", str(file), *options]
    page = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert page.stdout is not None
        address, key = page.stdout.readline().strip().split("#")

        def asked(path: str) -> Any:
            request = urllib.request.Request(f"{address}api/{path}", headers={"X-Cgid-Key": key})
            with urllib.request.urlopen(request, timeout=20) as answer:
                return json.load(answer)

        while not all(one["ended"] for one in asked("state")["recordings"]):
            time.sleep(0.2)
        return [one[1] for one in asked("impacts?r=0")["impacts"]]
    finally:
        page.terminate()
        page.wait(20)


def row(name: str, samples: Floats, rate: float, folder: Path, *more: str) -> str:
    """Return a row of the table."""
    file = folder / f"{name.replace(' ', '-').replace('/', '-')}.npy"
    np.save(file, samples.astype(np.float32))
    options = ["--rate", repr(rate), *(more or ("--unit", "m/s^2"))]
    lines = told(["predict", str(file), *options, "--json"]).splitlines()
    rows = [one for one in map(json.loads, lines) if one["kind"] == "impact"]
    known = np.array([one["time_s"] for one in rows])

    def beside(times: list[float]) -> str:
        near = [bool(np.abs(known - at).min() < SAME) for at in times]
        return f"{len(times)} ({sum(near)})"

    table = folder / "events.csv"
    told(["events", str(file), *options, "-o", str(table), "--overwrite"])
    with table.open(newline="") as stream:
        events = beside([float(one["time_s"]) for one in csv.DictReader(stream)])
    info = json.loads(told(["info", str(file), *options, "--json"]))
    plot = json.loads(told(["plot", str(file), *options, "-o", str(folder / "p.png"), "--overwrite", "--json"]))
    half = len(samples) / rate / 2
    titles = {"--rate": "rate_Hz", "--unit": "unit"}
    first = {"path": str(file), "start_s": 0, "end_s": half, "label": "coal"}
    for key, value in zip(options[::2], options[1::2], strict=True):
        setting, _, stated = value.partition("=")
        first |= {titles[key]: value} if key in titles else {setting: stated}
    with (folder / "labels.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, first)
        writer.writeheader()
        writer.writerows([first, first | {"start_s": half, "end_s": 2 * half, "label": "gangue"}])
    manifest = read_manifest(folder / "labels.csv")
    trained = [
        beside(record(manifest, slicing=Slicing(by="impact"), model=model, control=False).time.tolist())
        for model in (None, load_model("default-acceleration"))
    ]
    heard = list[float]()
    opened = open_all(manifest, Reading(), [])[0].recording
    silence_of(opened, "vibration", [(0.0, 2 * half)], hear=lambda one, *_: heard.extend(e.time for e in one.events))
    found = len(rows), events, beside(labelled(file, options)), count(info), plot["impacts"], *trained, beside(heard)
    return f"| {name} | " + " | ".join(map(str, found)) + " |"


def count(info: dict[str, Any]) -> int:
    """Return the number of impacts that `info` counts."""
    return int(next(one["impacts"] for key, one in info.items() if key.startswith("channel")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="rows whose name contains this")
    given = parser.parse_args()
    titles = "recording", "predict", "events", "label", "info", "plot", "train", "train --from", "silence"
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def tell(what: str, samples: Floats, rate: float = rates.OWN, *more: str) -> None:
            if given.only in what:
                print(row(what, samples, rate, folder, *more), flush=True)

        def made(rate: float, hum: bool = False) -> Floats:
            path = rates.recorded(rate, 1, given.seed, "500 g", folder, given.seconds, hum=hum)[0]
            return np.concatenate(list(open_recording(path).blocks()), axis=1)[0].astype(float)

        def machine(what: str, rate: float = rates.OWN) -> Floats:
            n_tones, moving, turns = MACHINES[what]
            n, rng = round(given.seconds * rates.OWN), np.random.default_rng([given.seed, 64])
            at = tones(n, rng, level=3.0, moving=moving, count=n_tones, turns=turns)
            return np.interp(np.arange(round(given.seconds * rate)) / rate, np.arange(n) / rates.OWN, at)

        plain = made(rates.OWN)
        tell("plain", plain)
        tell("with hum", with_hum := made(rates.OWN, hum=True))
        for what in ("one tone that wanders", "six tones", "six tones that wander"):
            tell(f"3 g, {what}", plain + machine(what))
        tell("3 g, six tones that wander, with hum", with_hum + machine("six tones that wander"))
        lacking = plain.copy()
        for at in np.linspace(1, given.seconds - 1, 6):
            lacking[round(at * rates.OWN) :][: round(0.21 * rates.OWN)] = np.nan
        tell("six gaps of .21 s", lacking)
        tell("upside down, invert=true", -plain, rates.OWN, "--unit", "m/s^2", "--set", "invert=true")
        tell(
            "in volts",
            plain / G * SENSITIVITY,
            rates.OWN,
            "--unit",
            "V",
            "--set",
            f"sensitivity={1e3 * SENSITIVITY:g} mV/g",
        )
        tell("20 kHz", made(20_000.0), 20_000.0)
        faster, rate = made(51_200.0), 51_200.0
        tell("51.2 kHz", faster, rate)
        tell("51.2 kHz, 3 g, six tones that wander", faster + machine("six tones that wander", rate), rate)


if __name__ == "__main__":
    main()

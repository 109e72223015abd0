"""Impacts of a stream before and after one sample that is far too large, or no number.

    python benchmarks/loud_sample.py [--answers] [--minutes 5] [--raised 1e7 nan ...]

Minutes of `caving` (acceleration, 25.6 kHz) and of force pulses of `reference` (1.2 rocks a second, 50 kHz), as
float32, for `cgid predict` and `cgid monitor`. One sample at 10 s is raised. Shown: the exit code, the impacts of each
minute, those within a second of the sample that are lost or new, and those from one second on whose time differs (with
`--answers` also label, or probability by more than 1e-6). Without `--answers` impacts are found and not identified,
which takes a twentieth of the time.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import tomllib
from pathlib import Path
from unittest import mock

import numpy as np

from cgid.cli.main import run
from cgid.identification.answers import Answer
from cgid.scene import parse_scene, record
from cgid.shipped import scene_path

#: When the sample comes [s], and by how much it is raised.
TIME, RAISED = 10.0, ("0", "1e3", "1e5", "1e6", "1e7", "1e9", "1e10", "1e12", "1e30", "nan", "inf")


def streams(minutes: float) -> dict[str, tuple[np.ndarray, float, str]]:
    """Return samples, rate and unit of each stream."""
    found = {}
    for name in ("caving", "reference"):
        content = tomllib.loads(scene_path(name).read_text())
        if name == "reference":
            content["stream"] = {"arrivals": {"rate": "1.2 Hz"}}
            content["sampling"] = {"sampling_rate": "50 kHz"}
            content["sensor"] = {"noise_density": "0.1 N/sqrt(Hz)"}
        content["stream"]["duration"] = f"{60 * minutes} s"
        signal, _ = record(parse_scene(content), 1)
        found[name] = signal.samples, signal.sampling_rate, signal.unit or ""
    return found


def found_only(events: list, model: object, question: object, *, channels: tuple[str, ...]) -> list[Answer]:
    """Return answers without identification."""
    labels = {"coal": 0.5, "gangue": 0.5}
    return [
        Answer(time=e.time, label="unknown" if e.problem else "coal", probabilities=labels, novelty=0.0, channel="1")
        for e in events
    ]


def answers_of(command: str, samples: np.ndarray, rate: float, unit: str, folder: str) -> tuple[int, list[dict]]:
    """Return exit code and impacts of a command."""
    out, options = io.StringIO(), ["--rate", f"{rate:.10g}", "--unit", unit, "--json"]
    if command == "predict":
        path = Path(folder, "stream.npy")
        np.save(path, samples)
    else:
        path = Path(folder, "stream.f32")
        samples.astype("<f4").tofile(path)
        options += ["--channels", "1", "--sample-format", "f32le"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = run([command, str(path), *options])
    lines = map(json.loads, out.getvalue().splitlines())
    return code, [line for line in lines if line["kind"] == "impact"]


def differ(one: dict, other: dict) -> bool:
    """Return whether two answers at one time differ."""
    pairs = ((one["probabilities"][label], other["probabilities"].get(label)) for label in one["probabilities"])
    return one["label"] != other["label"] or any(abs(p - (2 if q is None else q)) > 1e-6 for p, q in pairs)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--answers", action="store_true")
    parser.add_argument("--minutes", type=int, default=5)
    parser.add_argument("--raised", nargs="+", default=RAISED)
    given = parser.parse_args()
    minutes = [f"minute {number + 1}" for number in range(given.minutes)]
    print(*["stream", "command", "raised by", "exit", *minutes, "lost", "new", "differ"], sep=" | ")
    way = (
        contextlib.nullcontext()
        if given.answers
        else mock.patch("cgid.identification.stream.identify_events", found_only)
    )
    with way, tempfile.TemporaryDirectory() as folder:
        for name, (samples, rate, unit) in streams(given.minutes).items():
            for command in ("predict", "monitor"):
                _, whole = answers_of(command, samples, rate, unit, folder)
                expected = {answer["time_s"]: answer for answer in whole}
                for raised in given.raised:
                    changed = samples.copy()
                    with np.errstate(over="ignore"):
                        changed[round(TIME * rate)] += np.float32(raised)
                    code, answers = answers_of(command, changed, rate, unit, folder)
                    own = {answer["time_s"]: answer for answer in answers}
                    counts = np.histogram(list(own), 60 * np.arange(given.minutes + 1))[0].tolist()
                    odd = set(own) ^ set(expected)
                    near = {time for time in odd if abs(time - TIME) <= 1}
                    late = [time for time in expected if time > TIME + 1 and time in own]
                    n_differ = len(odd - near) + sum(differ(own[time], expected[time]) for time in late)
                    lost, new = len(near & set(expected)), len(near & set(own))
                    print(*[name, command, raised, code, *counts, lost, new, n_differ], sep=" | ", flush=True)


if __name__ == "__main__":
    main()

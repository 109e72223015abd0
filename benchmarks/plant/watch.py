"""What `cgid monitor` says when a sensor is lost, and when the gain of a channel changes.

    python benchmarks/plant/watch.py               # prints Markdown; some fifteen minutes on one core
    python benchmarks/plant/watch.py --streams 8

Five ways to lose a sensor are tried on `caving` by the command line: the sensor is lost after 16 s and comes back
after 32 s. Gains are tried on the levels of simulated streams of the world of the model of acceleration, by seeds that
no training used: the impacts of each stream are repeated in random order, as long as a run lasts, and the gain
changes at the start, after 20 s, 100 minutes or a day, at eight impacts a second.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.plant.wrong_scale import SEED, World, of_acceleration
from cgid import read_recording, shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer
from cgid.identification.prediction.diagnosis import Condition, Diagnosis
from cgid.identification.training.card import table

RATE, IMPACTS_PER_SECOND = 25_600, 8.0
LOST, BACK, END = 16, 32, 60
GAINS = (9.81, 0.102, 2.0, 10.0)
STARTS = {"start": 0, "20 s": 160, "100 min": 48_000, "a day": 691_200}


def lost(samples: np.ndarray, way: str) -> np.ndarray:
    """Return a minute whose sensor is lost for a while."""
    out, own = samples.copy(), slice(LOST * RATE, BACK * RATE)
    if way == "every second sample nan":
        out[own][::2] = np.nan
    else:
        noise = np.random.default_rng(SEED).normal(0, 0.01, out[own].size)
        out[own] = {"nan": np.nan, "zeros": 0.0, "stuck at 500 m/s^2": 500.0, "noise of 0.01 m/s^2": noise}[way]
    return out


def monitored(samples: np.ndarray, sound: np.ndarray) -> list[dict]:
    """Return the lines that the command prints for the minute and, on channel 2, a sound one that begins half-way."""
    both = np.stack([samples, np.roll(sound, len(sound) // 2)], axis=1).astype("<f4")
    raw = ["--rate", str(RATE), "--channels", "2", "--sample-format", "f32le", "--unit", "m/s^2", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "cgid", "monitor", "-", *raw], input=both.tobytes(), capture_output=True, check=True
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def sensors() -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "caving.h5")
        subprocess.run(
            [sys.executable, "-m", "cgid", "generate", "caving", "-o", file], check=True, capture_output=True
        )
        samples = read_recording(file)[0].samples[: END * RATE].astype(float)
    rows = []
    for way in ("(sound)", "nan", "zeros", "stuck at 500 m/s^2", "noise of 0.01 m/s^2", "every second sample nan"):
        lines = monitored(samples if way == "(sound)" else lost(samples, way), samples)
        own = [line for line in lines if line.get("channel") == "1"]
        states = [line for line in own if line["kind"] in ("state", "shut", "open")]
        told = [(line["time_s"], line["ground"], line["decision"]) for line in states]
        other = {line["ground"] for line in lines if line.get("channel") == "2" and "ground" in line}
        impacts = sum(line["kind"] == "impact" and line["time_s"] > BACK for line in own)
        states_told = "; ".join(f"{time:g} s {ground}, {what}" for time, ground, what in told)
        rows.append((way, states_told, impacts, ", ".join(sorted(other))))
    print(f"\nThe sensor of channel 1 is lost after {LOST} s and back after {BACK} s:\n")
    print("\n".join(table(("lost", "ground and decision from", "impacts after", "channel 2"), rows)), flush=True)


def told_after(
    model: StoredModel, own: list[Answer], scaled: list[Answer], start: int, rng: np.random.Generator
) -> int | None:
    """Return after how many impacts a gain that changes is told; -1 if before it, None if not within a thousand."""
    diagnosis = Diagnosis(model, live=True)
    order = rng.integers(0, len(own), start + 1000)
    # A day of levels says no more about the test than its last hour; the whole day is in the false alarms.
    order = order[max(start - 28_800, 0) :]
    start -= max(start - 28_800, 0)
    for number, place in enumerate(order.tolist()):
        answer = (scaled if number >= start else own)[place]
        diagnosis.add([replace(answer, time=number / IMPACTS_PER_SECOND)])
        if number % 4 == 3:
            diagnosis.changes(number / IMPACTS_PER_SECOND)
            if diagnosis.conditions(answer.channel) & {Condition.WRONG_SCALE, Condition.MOSTLY_UNKNOWN}:
                return number + 1 - start if number >= start else -1
    return None


def gains(world: World, rng: np.random.Generator) -> None:
    own = world.answers(1.0)
    streams = [k for k, name in enumerate(world.names) if name == "streams"]
    rows = []
    for gain in GAINS:
        scaled = world.answers(gain)
        for name, start in STARTS.items():
            told = [told_after(world.model, own[k], scaled[k], start, rng) for k in streams]
            after = [one for one in told if one is not None and one >= 0]
            quantiles = "-" if not after else "{:.0f}, {:.0f}".format(*np.quantile(after, [0.5, 0.9]))
            rows.append((f"{gain:g}", name, len(streams), len(after), quantiles, told.count(None), told.count(-1)))
    titles = ("gain", "changes after", "streams", "told", "after impacts: median, 90 %", "not told", "told before")
    print("\n" + "\n".join(table(titles, rows)), flush=True)
    alarms: dict[str, list[int]] = defaultdict(list)
    for k in streams:
        for name, n, order in (
            ("as recorded, a minute", len(own[k]), np.arange(len(own[k]))),
            ("repeated for an hour", 28_800, rng.integers(0, len(own[k]), 28_800)),
        ):
            diagnosis, found = Diagnosis(world.model, live=True), 0
            for number in range(n):
                diagnosis.add([replace(own[k][order[number]], time=number / IMPACTS_PER_SECOND)])
                if number % 8 == 7:
                    found += sum(not one.is_over for one in diagnosis.changes(number / IMPACTS_PER_SECOND))
            alarms[name].append(found)
    print("\nFalse alarms at the right gain:\n")
    rows = [(name, len(found), sum(one > 0 for one in found), sum(found)) for name, found in alarms.items()]
    print("\n".join(table(("stream", "streams", "with an alarm", "alarms"), rows)), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streams", type=int, default=100, help="of a minute each")
    parser.add_argument("--levels-only", action="store_true", help="leave out the lost sensors")
    arguments = parser.parse_args()
    if not arguments.levels_only:
        sensors()
    model = StoredModel.load(shipped.path_of("models", shipped.ACCELERATION_MODEL))
    gains(World(model, of_acceleration(model, 40, arguments.streams)), np.random.default_rng(SEED))


if __name__ == "__main__":
    main()

"""A week at a face that cgid has never seen, made without cgid: four days with known rocks, and a caving cycle.

A beam of eight modes, two accelerometers, 25.6 kHz. Each rock strikes by Hertz's law with a linear dashpot of its own
restitution, solved in small steps; the modes answer as exact oscillators at eight times the recorder's rate, an FIR
filter takes that down. Run as

    python benchmarks/beam/foreign_beam.py FOLDER

It writes `monday.csv` to `thursday.csv` (both channels in volts, as a logger without the sensors' data does: columns
divided by semicolons, decimal commas, no times): coal alone falls for 20 s, then gangue alone. A machine sounds on
Tuesday and Thursday. `friday.f32` is the stream of a caving cycle (float32, volts): coal alone for 25 s, then ever more
gangue; `friday.csv` has the time and the label of each of its rocks. With --learn it then trains on two and on all
four days, by the commands of docs/tutorials/engineer.md, and counts the right answers on Friday.
"""

from __future__ import annotations

import argparse
import csv
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import firwin, lfilter, resample_poly

RATE = 25_600.0
FINE = 8
#: Modal frequencies [Hz] and damping ratios of no beam that is shipped.
FREQUENCIES = np.array([137.0, 392.0, 811.0, 1330.0, 2075.0, 3260.0, 4710.0, 6840.0])
DAMPING = np.array([0.011, 0.008, 0.007, 0.009, 0.012, 0.010, 0.014, 0.018])
MODAL_MASS = 210.0  # [kg]
#: Places of the two sensors along the beam, from 0 to 1.
SENSORS = np.array([0.31, 0.74])
#: Density [kg/m^3], reduced modulus [Pa] and restitution (mean, deviation) of each rock on steel.
ROCKS = {"coal": (1380.0, 3.1e9, 0.34, 0.06), "gangue": (2580.0, 2.6e10, 0.55, 0.06)}
#: Of the sensors [V per m/s^2]: 10.2 and 9.9 mV/g.
SENSITIVITIES = np.array([10.2e-3, 9.9e-3]) / 9.80665
#: Of the machine, frequency [Hz] -> peak [m/s^2].
TONES = {49.0: 2.0, 223.0: 3.0, 812.0: 1.0}
#: Whether it sounds.
DAYS = {"monday": False, "tuesday": True, "wednesday": False, "thursday": True}
#: Time of coal alone in the cycle [s].
COAL = 25.0
#: Time in which the fraction of gangue then rises from 0 to 1 [s].
RISE = 60.0
SITE = """[recorder]
rate = 25600
channels = 2
sample_format = "f32le"
unit = "V"
[channels]
1 = {name = "left", sensitivity = "10.2 mV/g", beam = "support 41"}
2 = {name = "right", sensitivity = "9.9 mV/g", beam = "support 41"}
[decision]
coal_until = "25s"
"""


def shapes(places: np.ndarray) -> np.ndarray:
    return np.sqrt(2) * np.sin(np.outer(places, np.arange(1, 9)) * np.pi * 0.97 + 0.1)


def contact_force(label: str, radius: float, speed: float, restitution: float) -> np.ndarray:
    """Return the force [N] of one impact at the fine rate."""
    density, modulus, _, _ = ROCKS[label]
    mass, stiffness = 4 / 3 * np.pi * radius**3 * density, 4 / 3 * modulus * np.sqrt(radius)
    loss = -np.log(restitution) / np.hypot(np.log(restitution), np.pi)

    def force(depth: float, rate: float) -> float:
        dashpot = 2 * np.sqrt(5 / 6) * loss * np.sqrt(2 * (stiffness * 1.5 * np.sqrt(max(depth, 0))) / 2 * mass)
        return max(stiffness * max(depth, 0) ** 1.5 + dashpot * rate, 0.0)

    scale = (mass / stiffness) ** 0.4 * speed**-0.2
    step = 1 / (RATE * FINE)
    times = np.arange(0, 6 * scale + step, step)
    path = solve_ivp(
        lambda _, y: [y[1], -force(*y) / mass],
        (0, times[-1]),
        [0, speed],
        t_eval=times,
        rtol=1e-8,
        atol=1e-12,
        max_step=scale / 40,
    ).y
    pulse = np.array([force(depth, rate) for depth, rate in path.T])
    lift = np.flatnonzero((path[0] <= 0) & (times > 0))
    pulse[lift[0] if len(lift) else len(pulse) :] = 0
    return pulse


def answer(force: np.ndarray, place: float, n: int) -> np.ndarray:
    """Return the acceleration (n, 2) [m/s^2] of both sensors to a force at a place, at the fine rate."""
    step, drive = 1 / (RATE * FINE), np.zeros(n)
    drive[: len(force)] = force[:n]
    total = np.zeros((n, 2))
    for mode, sensors in enumerate(shapes(SENSORS).T):
        omega, damping = 2 * np.pi * FREQUENCIES[mode], DAMPING[mode]
        root = omega * np.sqrt(1 - damping**2)
        decay, turn = np.exp(-damping * omega * step), root * step
        q = lfilter([0, decay * np.sin(turn) / root * step], [1, -2 * decay * np.cos(turn), decay**2], drive)
        motion = (drive - 2 * damping * omega * np.gradient(q, step) - omega**2 * q) / MODAL_MASS
        total += np.outer(motion, sensors * shapes(np.array([place]))[0, mode])
    return total


def recorded(samples: np.ndarray, random: np.random.Generator) -> np.ndarray:
    low = resample_poly(samples, 1, FINE, axis=0, window=firwin(16 * FINE * 2 + 1, 0.85 / FINE))
    return low + random.normal(0, 0.05, low.shape)


def falling(
    labels: list[str], times: np.ndarray, seconds: float, machine: bool, random: np.random.Generator
) -> np.ndarray:
    """Return what both sensors give [V] while rocks fall at some times, (n_samples, 2)."""
    n = int(seconds * RATE) * FINE
    acceleration = np.zeros((n, 2))
    for label, time in zip(labels, times, strict=True):
        _, _, mean, deviation = ROCKS[label]
        radius, speed = np.exp(random.normal(np.log(0.05), 0.25)), random.uniform(2.0, 5.0)
        pulse = contact_force(label, radius, speed, float(np.clip(random.normal(mean, deviation), 0.15, 0.8)))
        start = int(time * RATE * FINE)
        heard = answer(pulse, random.uniform(0.2, 0.8), min(int(0.7 * RATE * FINE), n - start))
        acceleration[start : start + len(heard)] += heard
    if machine:
        clock = np.arange(n)[:, None] / (RATE * FINE)
        for frequency, peak in TONES.items():
            acceleration += peak * np.sin(2 * np.pi * frequency * clock + random.uniform(0, 6, 2))
    return recorded(acceleration, random) * SENSITIVITIES


def cgid(*words: object) -> str:
    """Run a command of cgid; return what it prints, and show what it states only if it fails."""
    command = [sys.executable, "-P", "-m", "cgid", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"cgid {words[0]}: {done.stderr}")
    return done.stdout + done.stderr


def learn(folder: Path) -> None:
    """Print how good a model is, and how many answers are right on Friday, after two and four labelled days."""
    site, model, table = folder / "learn.toml", folder / "learn.npz", folder / "learn.csv"
    site.write_text(SITE, encoding="utf-8")
    with (folder / "friday.csv").open() as file:
        truth = [(float(row["time_s"]), row["label"]) for row in csv.DictReader(file)]
    print("| labelled days | rocks | accuracy by the card (95 %) | right on Friday | unknown | SHUT at second |")
    print("|---|---|---|---|---|---|")
    for n in (2, 4):
        rows = [f"{day}.csv,0,20,coal\n{day}.csv,20,40,gangue\n" for day in list(DAYS)[:n]]
        table.write_text("path,start_s,end_s,label\n" + "".join(rows), encoding="utf-8")
        said = cgid("--site", site, "train", table, "-o", model, "--overwrite")
        stated = re.search(r"^accuracy (\S+) \(95 % interval (\S+) to (\S+)\)", said, re.M)
        accuracy = "{:.2f} ({:.2f} to {:.2f})".format(*map(float, stated.groups())) if stated else "-"
        lines = cgid("--site", site, "monitor", folder / "friday.f32", "--model", model).splitlines()
        answers = [line.split(",") for line in lines if line.count(",") >= 9 and not line.startswith("source")]
        near = [(row[3], min(truth, key=lambda blow: abs(blow[0] - float(row[2])))[1]) for row in answers]
        answered = [pair for pair in near if pair[0] != "unknown"]
        right = sum(answer == label for answer, label in answered)
        shut = next((line.split()[1] for line in lines if line.startswith("SHUT")), "never")
        cells = (n, 40 * n, accuracy, f"{right} of {len(answered)}", len(near) - len(answered), shut)
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--learn", action="store_true", help="train on two and on four days, and count")
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    given.folder.mkdir(parents=True, exist_ok=True)
    for day, machine in DAYS.items():
        times = 0.5 + np.arange(40) + random.uniform(-0.3, 0.3, 40)
        volts = falling(["coal"] * 20 + ["gangue"] * 20, times, 40.5, machine, random)
        lines = "\n".join(f"{left:.6g};{right:.6g}" for left, right in volts).replace(".", ",")
        path = given.folder / f"{day}.csv"
        path.write_text(f"left (V);right (V)\n{lines}\n", encoding="utf-8")
        print(f"{path}: coal from 0 to 20 s, gangue from 20 to 40 s{', a machine' * machine}", flush=True)
    times = np.cumsum(random.uniform(0.2, 0.5, 330))
    times = times[times < COAL + RISE + 15]
    labels = ["gangue" if random.uniform(0, RISE) < time - COAL else "coal" for time in times]
    falling(labels, times, times[-1] + 1, True, random).astype("<f4").tofile(given.folder / "friday.f32")
    rows = [f"{time:.3f},{label}" for time, label in zip(times, labels, strict=True)]
    (given.folder / "friday.csv").write_text("\n".join(["time_s,label", *rows]) + "\n", encoding="utf-8")
    half = COAL + RISE / 2
    print(f"{given.folder / 'friday.f32'}: a caving cycle of {len(labels)} rocks, half of them gangue at {half:.0f} s")
    if given.learn:
        learn(given.folder)


if __name__ == "__main__":
    main()

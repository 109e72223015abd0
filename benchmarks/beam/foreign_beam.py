"""A tail beam that cgid has never seen, made without cgid: recordings, and the truth of every impact.

Eight modes, two accelerometers, 25.6 kHz, 40 impacts a minute. Each rock strikes by Hertz's law with a linear dashpot
of its own restitution, solved in small steps; the modes answer as exact oscillators at eight times the recorder's
rate, an FIR filter takes that down. Run as

    python benchmarks/beam/foreign_beam.py FOLDER

It writes `train_*.csv` and `new_*.csv` (time and both channels in m/s^2), `truth.csv` (path, time, label, peak
force, speed and radius of each impact), and `tap_*.csv`: an instrumented hammer at the middle of the beam (force in N,
both channels).

    python benchmarks/beam/foreign_beam.py FOLDER --recordings 4 --learn

then labels 1, 2 and 4 of them from the truth, trains by the commands of docs/tutorials/engineer.md, and counts the
right answers on the new recordings (two channels, so two answers an impact), after those of the default model.
"""

from __future__ import annotations

import argparse
import csv
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


def recording(label_of: list[str], random: np.random.Generator) -> tuple[np.ndarray, list[dict[str, object]]]:
    """Return samples (n_samples, 2) [m/s^2] of impacts 1.5 s apart on average, and the truth of each."""
    gaps = random.uniform(0.9, 2.1, len(label_of))
    times = 0.8 + np.cumsum(gaps) - gaps[0]
    n = int((times[-1] + 1.2) * RATE) * FINE
    fine_step = 1 / (RATE * FINE)
    acceleration, truth = np.zeros((n, 2)), []
    for label, time in zip(label_of, times, strict=True):
        _, _, mean, deviation = ROCKS[label]
        radius, speed = np.exp(random.normal(np.log(0.05), 0.25)), random.uniform(2.0, 5.0)
        pulse = contact_force(label, radius, speed, float(np.clip(random.normal(mean, deviation), 0.15, 0.8)))
        start, place = int(time / fine_step), random.uniform(0.2, 0.8)
        heard = answer(pulse, place, min(int(0.7 / fine_step), n - start))
        acceleration[start : start + len(heard)] += heard
        truth.append(
            {
                "time_s": round(time, 6),
                "label": label,
                "peak_force_N": round(float(pulse.max()), 1),
                "speed [m/s]": round(speed, 3),
                "radius [m]": round(float(radius), 4),
            }
        )
    return recorded(acceleration, random), truth


def recorded(samples: np.ndarray, random: np.random.Generator) -> np.ndarray:
    low = resample_poly(samples, 1, FINE, axis=0, window=firwin(16 * FINE * 2 + 1, 0.85 / FINE))
    return low + random.normal(0, 0.05, low.shape)


def tap(random: np.random.Generator) -> np.ndarray:
    """Return samples (n_samples, 3) of a hammer tap at the middle: force [N], both accelerations [m/s^2]."""
    n, start, length = int(1.0 * RATE) * FINE, int(0.1 * RATE) * FINE, int(2.5e-4 * RATE * FINE)
    force = np.zeros(n)
    force[start : start + length] = random.uniform(1500, 2500) * np.sin(np.pi * np.arange(length) / length) ** 2
    return recorded(np.column_stack([force, answer(force, 0.5, n)]), random)


def cgid(*arguments: object) -> None:
    """Run a command of cgid; show what it states only if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "cgid", *map(str, arguments)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"cgid {arguments[0]}: {done.stderr}")


def with_truth(table: Path) -> tuple[list[dict[str, str]], list[str | None]]:
    """Return the rows of a table of impacts, with the label of each: that of an impact within 20 ms."""
    with (table.parent / "truth.csv").open() as file:
        truth = list(csv.DictReader(file))
    with table.open() as file:
        rows = list(csv.DictReader(file))
    labels: list[str | None] = []
    for row in rows:
        name, time = Path(row.get("path") or row["source"]).name, float(row["time_s"])
        near = [blow for blow in truth if blow["path"] == name and abs(float(blow["time_s"]) - time) < 0.02]
        labels.append(near[0]["label"] if near else None)
    return rows, labels


def learn(folder: Path) -> None:
    """Print how many answers are right on the new recordings, after more and more labelled ones."""
    labelled, new = sorted(folder.glob("train_*.csv")), sorted(folder.glob("new_*.csv"))
    print("labelled recordings  impacts  right  wrong  unknown  not an impact")
    for n in [0, *(2**k for k in range(len(labelled).bit_length()))]:
        model: list[object] = []
        n_labelled = 0
        if n:
            events, model = folder / "events.csv", ["--model", folder / "model.npz"]
            cgid("events", *labelled[:n], "-o", events, "--overwrite")
            rows, labels = with_truth(events)
            known = [row | {"label": label} for row, label in zip(rows, labels, strict=True) if label]
            n_labelled = len(known)
            with events.open("w", newline="") as file:
                writer = csv.DictWriter(file, rows[0])
                writer.writeheader()
                writer.writerows(known)
            cgid("train", events, "-o", model[1], "--overwrite")
        cgid("predict", *new, *model, "-o", folder / "answers.csv", "--overwrite")
        rows, labels = with_truth(folder / "answers.csv")
        answers = [(row["label"], label) for row, label in zip(rows, labels, strict=True)]
        right = sum(answer == label for answer, label in answers)
        unknown = sum(answer == "unknown" and label is not None for answer, label in answers)
        stray = labels.count(None)
        print(f"{n:19} {n_labelled:8} {right:6} {len(answers) - right - unknown - stray:6} {unknown:8} {stray:14}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=int, default=4, help="to train on; half as many are new")
    parser.add_argument("--blows", type=int, default=40, help="in each recording, a minute's worth")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--learn", action="store_true", help="count right answers after 1, 2, 4 labelled recordings")
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    given.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    names = [f"train_{k}.csv" for k in range(given.recordings)] + [f"new_{k}.csv" for k in range(given.recordings // 2)]
    for name in names:
        samples, truth = recording(list(random.choice(["coal", "gangue"], given.blows)), random)
        times = np.arange(len(samples)) / RATE
        np.savetxt(
            given.folder / name,
            np.column_stack([times, samples]),
            fmt=["%.8f", "%.5g", "%.5g"],
            delimiter=",",
            header="time (s),left (m/s^2),right (m/s^2)",
            comments="",
        )
        rows += [{"path": name, **row} for row in truth]
        print(f"{given.folder / name}: {len(truth)} impacts in {len(samples) / RATE:.0f} s", flush=True)
    with (given.folder / "truth.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for k in range(5):
        samples = np.column_stack([np.arange(int(RATE)) / RATE, tap(random)])
        header = "time (s),hammer (N),left (m/s^2),right (m/s^2)"
        np.savetxt(given.folder / f"tap_{k}.csv", samples, fmt="%.8g", delimiter=",", header=header, comments="")
    print(f"{given.folder}: truth.csv with {len(rows)} impacts, and tap_0.csv to tap_4.csv")
    if given.learn:
        learn(given.folder)


if __name__ == "__main__":
    main()

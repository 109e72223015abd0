"""Models of recordings at low sampling rates beside a random forest on logarithmic bands, in the same folds.

    python benchmarks/identification/low_rates.py [--rates 250 500 1000 1660 2000] [--files 20]
    python benchmarks/identification/low_rates.py --rates 500 --steps --by impact

The recordings are simulated here, without cgid: half-sine forces, longer ones for coal, on ten modes of a structure, or
(`--steps`) footsteps of two people on a floor, on four days with other weights of its modes and other gains. Both see
the same windows and leave out the same groups, files and days; the forest has 24 bands between 4 Hz and half the rate.
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from sklearn.ensemble import RandomForestClassifier

from cgid.identification.training import train_on_groups
from cgid.identification.training.grouped import leave_groups_out
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import Reading, record
from cgid.identification.training.rows import Slicing
from cgid.recordings import read_recording

MODES = np.array([18.0, 41.0, 67.0, 103.0, 150.0, 218.0, 301.0, 420.0, 560.0, 760.0])
FLOOR = np.array([9.0, 14.0, 22.0, 31.0, 47.0, 70.0, 110.0])
#: Median length of the force [s] of each label, and the spread of its logarithm; those of heels.
FORCES, SPREAD = {"coal": 6e-3, "gangue": 3e-3}, 0.35
HEELS, SPREAD_OF_STEPS = {"coal": 24e-3, "gangue": 15e-3}, 0.25
SECONDS, N_HITS, N_BANDS, N_DAYS = 4.0, 8, 24, 4


def simulated(
    rng: np.random.Generator, rate: float, median: float, shape: np.ndarray, steps: bool = False
) -> np.ndarray:
    """Return an acceleration: each force excites the modes below the recorder's edge, in white noise."""
    times = np.arange(round(SECONDS * rate)) / rate
    out = 0.3 * rng.standard_normal(times.size)
    onsets = np.arange(N_HITS - 1) * 0.52 + rng.uniform(0.1, 0.3) if steps else rng.uniform(0.1, SECONDS - 0.3, N_HITS)
    modes, damping, spread = (FLOOR, 0.03, SPREAD_OF_STEPS) if steps else (MODES, 0.02, SPREAD)
    for onset in onsets:
        length, peak = median * np.exp(spread * rng.standard_normal()), 20 * np.exp(0.5 * rng.standard_normal())
        since = np.maximum(times - onset, 0)
        for mode, part in zip(modes, shape * rng.uniform(0.5, 1.5, modes.size), strict=True):
            if mode < 0.45 * rate:
                turn = 2 * np.pi * mode
                # Spectrum of a half sine at the mode.
                force = abs(np.cos(turn * length / 2) / (1 - (turn * length / np.pi) ** 2 + 1e-9)) * length / 3e-3
                out += (times > onset) * peak * part * force * np.exp(-damping * turn * since) * np.sin(turn * since)
    return out


def write(folder: Path, rate: float, n_files: int, steps: bool) -> None:
    rng = np.random.default_rng(0)
    usual = rng.uniform(0.3, 1, (FLOOR if steps else MODES).size)
    days = [usual * rng.uniform(0.6, 1.6, usual.size) * rng.uniform(0.5, 2) if steps else usual for _ in range(N_DAYS)]
    lines = ["path,label,group"]
    for label, median in (HEELS if steps else FORCES).items():
        (folder / label).mkdir()
        for number in range(n_files):
            samples = simulated(rng, rate, median, days[number % N_DAYS], steps)
            header = f"# sampling_rate: {rate:g} Hz\na (m/s^2)"
            np.savetxt(folder / label / f"{number:03d}.csv", samples, "%.4f", header=header, comments="")
            group = f"day {number % N_DAYS}" if steps else f"{label}/{number}"
            lines.append(f"{label}/{number:03d}.csv,{label},{group}")
    (folder / "manifest.csv").write_text("\n".join(lines) + "\n")


def bands(window: np.ndarray, rate: float) -> np.ndarray:
    """Return the log energies in bands of equal ratio, from its Fourier transform alone."""
    energy = np.abs(np.fft.rfft(window * np.hanning(window.size))) ** 2
    frequency = np.fft.rfftfreq(window.size, 1 / rate)
    edges = np.geomspace(4, rate / 2, N_BANDS + 1)
    return np.log10([1e-12 + energy[(frequency >= low) & (frequency < high)].sum() for low, high in pairwise(edges)])


def compared(rate: float, n_files: int, by: str | None, steps: bool) -> tuple[float, float, int, str]:
    """Return the accuracy of cgid and of the forest, the number of rows and what they are."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, rate, n_files, steps)
        rows = record(read_manifest(folder / "manifest.csv"), reading=Reading(), slicing=Slicing(by=by))
        accuracy = float(train_on_groups(rows).model.header["training"]["metrics"]["accuracy"])
        recordings = {source: read_recording(folder / source.split(" from ")[0])[0].samples for source in rows.sources}
    length = round((rows.slicing.window_time if rows.slicing.by == "window" else 0.35) * rate)
    inputs = []
    for source, time in zip(rows.source, rows.time, strict=True):
        samples, first = recordings[rows.sources[source]], max(round((time - 0.01) * rate), 0)
        window = samples[first : first + length]
        inputs.append(bands(np.pad(window, (0, length - window.size)), rate))
    is_right = np.zeros(len(inputs), bool)
    for fold in leave_groups_out(rows.labels, rows.group, 0):
        forest = RandomForestClassifier(500, random_state=0).fit(np.array(inputs)[~fold], rows.labels[~fold])
        is_right[fold] = forest.predict(np.array(inputs)[fold]) == rows.labels[fold]
    return accuracy, float(is_right.mean()), len(inputs), rows.slicing.by


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[250, 500, 1000, 1660, 2000])
    parser.add_argument("--files", type=int, default=20, help="of each label")
    parser.add_argument("--by", choices=["window", "impact"], help="by default what cgid chooses")
    parser.add_argument("--steps", action="store_true", help="of people on a floor, days left out")
    arguments = parser.parse_args()
    print("| rate [Hz] | rows | cgid | forest |\n|---|---|---|---|")
    for rate in arguments.rates:
        accuracy, forest, n_rows, by = compared(rate, arguments.files, arguments.by, arguments.steps)
        print(f"| {rate:g} | {n_rows} ({by}) | {accuracy:.3f} | {forest:.3f} |", flush=True)


if __name__ == "__main__":
    main()

"""Modes of beams from taps, `cgid tap`: errors against stated deviations, on recordings made without cgid.

    python benchmarks/beam/tap.py [--seeds 10] [--brb HammerImpact.mat --forced ForcedFrequencyResponses.mat]

1. Ten modes from 118 to 1,700 Hz, two pairs 1.5 and 2 % apart (`tests/tapped.py`): six taps, 25.6 kHz, white noise of
   .1 to 20 % of the ringing. Covered is the share of errors within 1.96 stated deviations. A mode that is not found
   within 1 % is missed, one without a true mode within 1 % is extra.
2. Two modes 1 and 2 % apart alone, at several dampings: how often both are found, and what is stated then.
3. A panel of steel by finite elements (`independent_modes.py`), all dampings alike: how many of its modes are found.
4. What a tap test does wrong: a soft hammer that stays on for longer than stated, places that differ from tap to tap,
   one tap, two sensors; a hammer on another module, one bad tap of five.
5. Recordings of 10 s, ten minutes and an hour: processor time and memory (Linux).
6. A hammer blow on a bolted steel beam, three accelerometers, 12.8 kHz, 5 s: github.com/mattiacenedese/BRBtesting, Chen
   et al., Mechanical Systems and Signal Processing 166 (2022) 108401. Files of that repository; not part of cgid.
   Beside it the slopes of phase and logarithm of the envelope behind a band pass, and the resonance of forced tests.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, hilbert, sosfiltfilt

from cgid.calibration import TapTest, tap_test
from cgid.errors import BadData
from tests.tapped import DAMPING, FLAWS, FREQUENCY, PARTICIPATION, flawed, taps

RATE = 25_600.0
#: A mode is found if one is stated this near, relative.
NEAR = 0.01
Modes = tuple[np.ndarray, np.ndarray, np.ndarray]
Recorded = tuple[np.ndarray, np.ndarray, dict[str, float]]
TRUE: Modes = (FREQUENCY, DAMPING, PARTICIPATION)


class Scores:
    """Errors of modes over several tests, and how many were missed or are extra."""

    def __init__(self) -> None:
        self.errors: list[np.ndarray] = []
        self.deviations: list[np.ndarray] = []
        self.missed = self.extra = self.tests = 0
        self.seconds = 0.0

    def add(self, test: TapTest, modes: Modes) -> None:
        """Add a test; every true mode takes the nearest of the modes that no other has taken."""
        frequency, damping, participation = modes
        self.tests += 1
        apart = np.abs(np.log(test.modes.frequency[:, None] / frequency))
        taken = set()
        for k in np.argsort(apart.min(axis=0, initial=np.inf)):
            order = [i for i in np.argsort(apart[:, k]) if i not in taken and apart[i, k] < NEAR]
            if not order:
                self.missed += 1
                continue
            i = order[0]
            taken.add(i)
            part = np.abs(test.modes.participation()[i] / participation[k] - 1) if test.modes.scaled else np.nan
            self.errors.append(
                np.array(
                    [
                        np.log(test.modes.frequency[i] / frequency[k]),
                        np.log(test.modes.damping_ratio[i] / damping[k]),
                        part,
                    ]
                )
            )
            own = (
                test.modes.columns["frequency_deviation"][i],
                test.modes.columns["damping_ratio_deviation"][i],
                test.modes.columns["participation_deviation"][i],
            )
            self.deviations.append(np.array(own))
        self.extra += test.modes.frequency.size - len(taken)

    def row(self) -> str:
        """Return the cells of a table."""
        found = len(self.errors)
        if not found:
            return f"0 | {self.missed} | {self.extra} |  |  |  |  |  |  |"
        errors, deviations = np.abs(self.errors), np.array(self.deviations)
        middle = np.nanmedian(errors, axis=0) if np.isfinite(errors[:, 2]).any() else np.median(errors[:, :2], axis=0)
        covered = [np.mean(e < 1.96 * d) for e, d in zip(errors.T, deviations.T, strict=True)]
        cells = [f"{100 * one:.2g} %" for one in middle] + [""] * (3 - len(middle))
        shares = [f"{one:.2f}" if np.isfinite(one) else "" for one in covered[: len(middle)]] + [""] * (3 - len(middle))
        both = " | ".join(f"{a} | {b}" for a, b in zip(cells, shares, strict=True))
        return f"{found} | {self.missed} | {self.extra} | {both} | {self.seconds / max(self.tests, 1):.1f} s |"


HEAD = (
    "found | missed | extra | frequency error, median | covered | damping error | covered | participation error "
    "| covered | processor time |"
)


def scored(
    make: Callable[[int], tuple[np.ndarray, np.ndarray | None]], seeds: int, modes: Modes = TRUE, **options: object
) -> Scores:
    """Return the scores of tests of recordings, (channels, samples) and force, made for each seed."""
    scores = Scores()
    for seed in range(seeds):
        response, force = make(seed)
        start = time.process_time()
        try:
            test = tap_test(np.atleast_2d(response), RATE, hammer=force, **options)
        except BadData:
            scores.missed += modes[0].size
            scores.tests += 1
            continue
        scores.seconds += time.process_time() - start
        scores.add(test, modes)
    return scores


@cache
def _taps(seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    return taps(6, seed=seed, noise=noise)[:2]


def levels(seeds: int) -> None:
    print(f"| noise | hammer channel | {HEAD}\n|{'---|' * 12}")
    for noise in (0.001, 0.01, 0.05, 0.2):
        for hammer in (True, False):

            def make(seed: int, noise: float = noise, hammer: bool = hammer) -> tuple[np.ndarray, np.ndarray | None]:
                response, force = _taps(seed, noise)
                return response, force if hammer else None

            row = scored(make, seeds, band=(60.0, 2500.0)).row()
            print(f"| {100 * noise:g} % | {'yes' if hammer else 'no'} | {row}", flush=True)


def pairs(seeds: int) -> None:
    print(f"\n| apart | damping | noise | {HEAD}\n|{'---|' * 13}")
    for apart in (0.01, 0.02):
        for damping in (0.003, 0.01, 0.02):
            for noise in (0.003, 0.03):
                frequency = np.array([230.0, 430.0, 430.0 * (1 + apart), 700.0])
                modes = (frequency, np.full(4, damping), np.array([0.5, 0.8, -0.6, 0.4]) * 1e-3)

                def make(seed: int, modes: Modes = modes, noise: float = noise) -> tuple[np.ndarray, np.ndarray]:
                    return taps(6, gap=1.0, seed=seed, noise=noise, modes=modes)[:2]

                row = scored(make, seeds, modes, band=(350.0, 520.0))
                row.missed -= 2 * row.tests  # two lie outside of the band
                print(f"| {100 * apart:g} % | {100 * damping:g} % | {100 * noise:g} % | {row.row()}", flush=True)


def panel(seeds: int) -> None:
    from benchmarks.beam.independent_modes import Beam, modes_of

    found = modes_of(Beam(length=0.9, width=0.7, thickness=0.02, ribs="none"), 4000.0)
    shape = found.shape(np.array([0.63, 0.41]), np.array([0.17, 0.26]))
    print(f"\n| band [Hz] | modes | damping | noise | {HEAD}\n|{'---|' * 14}")
    for damping in (0.005, 0.02):
        modes = (found.frequency, np.full(found.frequency.size, damping), shape[0] * shape[1])
        for low, high in ((15.0, 500.0), (500.0, 1500.0), (1500.0, 2500.0)):
            inside = (modes[0] > low) & (modes[0] < high)

            def make(seed: int, modes: Modes = modes) -> tuple[np.ndarray, np.ndarray]:
                return taps(5, gap=1.0, seed=seed, noise=0.01, modes=modes, width=0.25e-3)[:2]

            own = tuple(one[inside] for one in modes)
            row = scored(make, max(seeds // 3, 1), own, band=(low, high)).row()
            print(f"| {low:g} to {high:g} | {inside.sum()} | {100 * damping:g} % | 1 % | {row}", flush=True)


def mistakes(seeds: int) -> None:
    print(f"\n| what | {HEAD}\n|{'---|' * 11}")

    def hammered(seed: int, n: int = 6, **options: float) -> tuple[np.ndarray, np.ndarray]:
        return taps(n, seed=seed, noise=0.01, **options)[:2]

    def two(seed: int) -> tuple[np.ndarray, np.ndarray]:
        other = (FREQUENCY, DAMPING, PARTICIPATION * np.cos(np.arange(FREQUENCY.size)))
        first, force, _ = taps(6, seed=seed, noise=0.01)
        return np.stack([first, taps(6, seed=seed, noise=0.01, modes=other)[0]]), force

    cases: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray | None]]] = {
        "six taps, 1 % noise": hammered,
        "one tap": lambda seed: hammered(seed, 1),
        "three taps": lambda seed: hammered(seed, 3),
        "two sensors": two,
        "participations differ by 10 % from tap to tap": lambda seed: hammered(seed, spread=0.1),
        "soft hammer of 4 ms, no channel": lambda seed: (hammered(seed, width=4e-3)[0], None),
        "bounces of 20 % after 60 ms, no channel": lambda seed: (
            taps(6, seed=seed, noise=0.01, also=tuple((k, 0.06, 0.2) for k in (1, 3)))[0],
            None,
        ),
    }
    for name, make in cases.items():
        print(f"| {name} | {scored(make, seeds, band=(60.0, 2500.0)).row()}", flush=True)


def recorders(seeds: int) -> None:
    """Print what the test says of late hammers and a bad tap, and its errors."""

    def late(samples: int) -> Callable[[int], Recorded]:
        def make(seed: int) -> Recorded:
            response, force, _ = taps(5, seed=seed, noise=0.01)
            return response, np.roll(force, samples), {}

        return make

    def bad(kind: str) -> Callable[[int], Recorded]:
        def make(seed: int) -> Recorded:
            response, force, times = taps(5, seed=seed, noise=0.01)
            return *flawed(response, force, round(times[1] * RATE), round(times[2] * RATE) - 30, kind), {}

        return make

    cases = {f"hammer {1e3 * n / RATE:.3g} ms late": late(n) for n in (0, 2, 128, 512)}
    cases |= {f"one tap of five: {kind}": bad(kind) for kind in FLAWS}
    print(f"\n| what | delay [ms] | taps left out | {HEAD}\n|{'---|' * 13}")
    for name, make in cases.items():
        scores, told, left = Scores(), [], []
        for seed in range(seeds):
            response, force, options = make(seed)
            start = time.process_time()
            test = tap_test(response[None], RATE, hammer=force, band=(60.0, 2500.0), **options)
            scores.seconds += time.process_time() - start
            scores.add(test, TRUE)
            told.append(1e3 * test.delay)
            left.append("+".join(str(k) for k, tap in enumerate(test.taps, 1) if tap.flaw) or "none")
        print(f"| {name} | {np.mean(told):.3f} | {', '.join(left)} | {scores.row()}", flush=True)


def long_recordings(_: int) -> None:
    """Print processor time and memory of the commands on five taps every ten minutes."""
    response, force, _times = taps(5, seed=1)
    taps_there = np.stack([response, force]).astype(np.float32)
    random = np.random.default_rng(0)
    quiet = random.normal(0, 1, (2, round(10 * RATE))) * [[1e-3 * response.std()], [1e-4 * response.std()]]
    own = "import sys\nfrom cgid.cli.main import run\ncode = run(sys.argv[1:])\n"
    own += "print([line for line in open('/proc/self/status') if line.startswith('VmHWM')][0])\nsys.exit(code)"
    print("\n| length [s] | command | processor time [s] | memory [MB] |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for length in (10, 600, 3600):
            shape = (2, round(length * RATE))
            every = np.lib.format.open_memmap(f"{folder}/long.npy", "w+", np.float32, shape)
            for first in range(0, length, 10):
                every[:, round(first * RATE) :][:, : quiet.shape[1]] = quiet
                if first % 600 == 0:
                    every[:, round(first * RATE) :][:, : response.size] = taps_there
            every.flush()
            given = ["long.npy", "--rate", f"{RATE:g}", "--channel", "1", "--hammer", "2", "--unit", "1=m/s^2,2=N"]
            for command in (["tap", "--band", "60", "2500", "-o"], ["invert", "--modes"]):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                words = [sys.executable, "-c", own, *command, "modes.csv", "--overwrite", *given]
                told = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
                print(f"| {length} | {command[0]} | {seconds:.1f} | {int(told.split()[-2]) // 1024} |", flush=True)


def hammer_blow(path: str, forced: str | None) -> None:
    data = loadmat(path, squeeze_me=True)["HIdata"][()]
    rate = 1 / float(np.diff(data["time"]).mean())
    response = np.stack([data[name] for name in ("acc1", "acc2", "acc3")])
    together = tap_test(response, rate, band=(60.0, 2000.0))
    alone = [tap_test(row[None], rate, band=(60.0, 2000.0)) for row in response]
    tap = together.used[0]
    strong = np.argsort(np.abs(together.poles.amplitude).max(axis=0))[::-1][:8]
    print(f"\n{together.modes.frequency.size} modes from 60 to 2000 Hz, the strongest eight:\n")
    print("| frequency [Hz] | each sensor alone | phase | damping ratio [%] | each alone | envelope |")
    print(f"|{'---|' * 6}")
    for k in sorted(strong):
        frequency, damping = together.modes.frequency[k], together.modes.damping_ratio[k]
        near = [int(np.argmin(np.abs(one.modes.frequency - frequency))) for one in alone]
        phase, envelope = _slopes(response[:, tap.start : tap.stop], rate, frequency, damping)
        print(
            f"| {frequency:.2f} ± {frequency * together.modes.columns['frequency_deviation'][k]:.2g} | "
            f"{', '.join(f'{one.modes.frequency[i]:.2f}' for one, i in zip(alone, near, strict=True))} | {phase:.2f} | "
            f"{100 * damping:.3f} ± {100 * damping * together.modes.columns['damping_ratio_deviation'][k]:.2g} | "
            f"{', '.join(f'{100 * one.modes.damping_ratio[i]:.3f}' for one, i in zip(alone, near, strict=True))} | "
            f"{100 * envelope:.3f} |"
        )
    if forced is not None:
        tests = loadmat(forced, squeeze_me=True)["FRdata"][()]["ForceControl"]
        peaks = [float(one["frequency"][np.argmax(one["amplitude"])]) for one in np.atleast_1d(tests)]
        print(f"\nresonance of the first mode under constant force: {', '.join(f'{one:.2f}' for one in peaks)} Hz")


def _slopes(decays: np.ndarray, rate: float, frequency: float, damping: float) -> tuple[float, float]:
    edges = frequency + np.array([-1, 1]) * max(0.02 * frequency, 8 * damping * frequency, 3.0)
    narrow = sosfiltfilt(butter(3, edges, "bandpass", fs=rate, output="sos"), decays, axis=1)
    loudest = hilbert(narrow[np.argmax(np.square(narrow).sum(axis=1))])
    first = round(0.3 / (damping * 2 * np.pi * frequency) * rate)
    part = slice(first, first + round(1.5 / (damping * 2 * np.pi * frequency) * rate))
    times = np.arange(loudest.size)[part] / rate
    turns = np.polyfit(times, np.unwrap(np.angle(loudest[part])), 1)[0]
    fall = np.polyfit(times, np.log(np.abs(loudest[part])), 1)[0]
    return float(np.hypot(turns, fall) / (2 * np.pi)), float(-fall / np.hypot(turns, fall))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="recordings of each row")
    parser.add_argument("--brb", help="HammerImpact.mat of github.com/mattiacenedese/BRBtesting")
    parser.add_argument("--forced", help="ForcedFrequencyResponses.mat of the same")
    parser.add_argument(
        "--only", choices=("levels", "pairs", "panel", "mistakes", "recorders", "long", "brb"), help="one part alone"
    )
    arguments = parser.parse_args()
    parts = {
        "levels": levels,
        "pairs": pairs,
        "panel": panel,
        "mistakes": mistakes,
        "recorders": recorders,
        "long": long_recordings,
    }
    for name, part in parts.items():
        if arguments.only in (None, name):
            part(arguments.seeds)
    if arguments.brb is None:
        print("\nno real hammer blow: --brb names the file of one")
    else:
        hammer_blow(arguments.brb, arguments.forced)

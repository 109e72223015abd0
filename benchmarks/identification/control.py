"""What sounds between the rocks must not be taken for the material: whether `cgid train` tells.

Recordings of a beam by equations of this file alone (numpy; nothing of cgid.scene): twenty modes, a Hertz pulse for
each rock, tones, noise and rumble of machines, gain, filter and place of the sensor. The labels are recorded in two
states of the machines ("confounded"), or both in one state, or each in both ("sound"). New recordings in the states of
the training (un) and with the states swapped (sw) judge what the trained model does; harm = un - sw.

    python benchmarks/identification/control.py additive      twelve designs whose background harms, or not
    python benchmarks/identification/control.py path          gain, filter, place of the sensor
    python benchmarks/identification/control.py sound -n 300  false alarms, and the accuracy beside a plain training
    python benchmarks/identification/control.py sources -n 24  copies refused, a wrong unit and a gain by label named
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from cgid.errors import BadData, CgidError
from cgid.identification.training.control import odd_sources
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import record
from cgid.identification.training.rows import Slicing, sets_for
from cgid.identification.training.training import train_on_groups
from cgid.measure.features.extraction import supported

RATE = 25_600.0
#: Frequencies [Hz] and damping ratios of the beam.
N_MODES, LOWEST, HIGHEST = 20, 118.0, 8_400.0
#: Stiffness of contact over that of coal in the middle, in natural logarithms: middle and spread of each material.
STIFFNESS = {"coal": (0.0, 0.5), "gangue": (2.2, 0.5)}
MATERIALS = tuple(STIFFNESS)
#: Tones of the machines that always run [Hz], and their amplitude [m/s^2].
TONES, TONE = (50.0, 147.0, 812.0), 1.0
#: Noise that is always there [m/s^2].
NOISE = 1.2


@dataclass(frozen=True)
class State:
    """The machines, and the recorder."""

    tones: tuple[tuple[float, float], ...] = ()  # further tones: frequency [Hz] and amplitude [m/s^2]
    noise: float = NOISE
    rumble: float = 0.0
    gain: float = 1.0
    edge: float = 0.0  # of a low-pass of second order that the noise passes, too [Hz]
    place: float = 0.31  # of the sensor, in lengths of the beam


def beam(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frequencies, damping ratios and phases of the shapes of the modes."""
    frequency = np.geomspace(LOWEST, HIGHEST, N_MODES) * random.uniform(0.93, 1.07, N_MODES)
    return frequency, random.uniform(0.007, 0.03, N_MODES), random.uniform(0, 2 * np.pi, N_MODES)


@dataclass
class Face:
    """One beam, on which rocks fall."""

    seed: int
    modes: tuple[np.ndarray, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.modes = beam(np.random.default_rng([self.seed, 1]))

    def recording(
        self, material: str, state: State, seed: Sequence[int], n_rocks: int = 24, *, dense: bool = False
    ) -> np.ndarray:
        """Return the samples of a recording [m/s^2], (2, n_samples), of two sensors."""
        random = np.random.default_rng([self.seed, 2, *seed])
        gaps = random.uniform(0.18, 0.40, n_rocks) if dense else random.uniform(0.55, 1.1, n_rocks)
        times = 0.6 + np.cumsum(gaps)
        samples = np.zeros((2, int((times[-1] + 1.0) * RATE)))
        n_samples = samples.shape[1]
        n = 1 << 14
        frequency = np.fft.rfftfreq(n, 1 / RATE)
        omega, day = 2j * np.pi * frequency, 1 + 0.004 * random.normal()
        natural, damping, phase = self.modes
        natural = 2 * np.pi * natural * day * (1 + 0.002 * random.normal(size=N_MODES))
        spread = np.arange(1, N_MODES + 1) * np.pi
        at_sensors = [np.sin(spread * place + phase) for place in (state.place, state.place + 0.4)]
        modal = omega[:, None] ** 2 / (natural**2 + omega[:, None] ** 2 + 2 * damping * natural * omega[:, None])
        middle, width = STIFFNESS[material]
        for time_s in times:
            radius, speed = random.uniform(0.015, 0.05), random.uniform(1.5, 4.0)
            stiffness = np.exp(middle + width * random.normal())
            # Hertz: duration ~ (m^2 / (k^2 R v))^(1/5), peak ~ m v / duration.
            mass = 4 / 3 * np.pi * radius**3 * (1500 if material == "coal" else 2500)
            duration = 0.8e-3 * (radius / 0.03) * (mass / (1500 * 4 / 3 * np.pi * radius**3)) ** 0.4
            duration *= stiffness**-0.4 * (speed / 2.5) ** -0.2
            t = np.arange(n) / RATE
            inside = t < duration
            force = np.zeros(n)
            force[inside] = np.sin(np.pi * t[inside] / duration) ** 1.5
            force *= mass * speed / max(force.sum() / RATE, 1e-9)
            at_rock = np.sin(spread * random.uniform(0.1, 0.9) + phase)
            start = int(time_s * RATE)
            for row, at_sensor in zip(samples, at_sensors, strict=True):
                vibration = np.fft.irfft(np.fft.rfft(force) * (modal @ (at_sensor * at_rock)), n)[: n // 2] / 8.0
                row[start : start + n // 2] += vibration[: n_samples - start]
        t, bins = np.arange(n_samples) / RATE, np.fft.rfftfreq(n_samples, 1 / RATE)
        samples += state.noise * np.exp(0.08 * random.normal()) * random.normal(size=samples.shape)
        if state.rumble:
            rumble = np.fft.irfft(np.fft.rfft(random.normal(size=n_samples)) / (1 + (bins / 60.0) ** 2), n_samples)
            samples += state.rumble * rumble / rumble.std()
        for pitch, amplitude in (*((one, TONE) for one in TONES), *state.tones):
            drift, level = 1 + 0.003 * random.normal(), amplitude * np.exp(0.15 * random.normal())
            samples += level * np.sin(2 * np.pi * pitch * drift * t + random.uniform(0, 2 * np.pi))
        if state.edge:
            ratio = bins / state.edge
            samples = np.fft.irfft(np.fft.rfft(samples) / (1 + 1j * 1.4 * ratio - ratio**2), n_samples)
        return samples * state.gain * np.exp(0.05 * random.normal())


@dataclass(frozen=True)
class Design:
    """A training: the states of the labels; with `both`, each label is recorded in both."""

    name: str
    coal: State
    gangue: State
    n_files: int = 6
    n_rocks: int = 24
    both: bool = False
    dense: bool = False
    sensors: int = 1
    features: tuple[str, ...] | None = None

    def states(self, *, swapped: bool = False) -> Iterator[tuple[str, State]]:
        """Yield the label and the state of each recording."""
        for k in range(self.n_files):
            label = MATERIALS[k % 2]
            odd = (k // 2) % 2 if self.both else k % 2
            yield label, (self.coal, self.gangue)[odd ^ swapped]


def written(folder: Path, face: Face, design: Design, key: int, *, swapped: bool = False) -> Path:
    """Write the recordings of a design and return their manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["path,label,rate_Hz,unit,same_beam"]
    for k, (label, state) in enumerate(design.states(swapped=swapped)):
        samples = face.recording(label, state, [key, k, int(swapped)], design.n_rocks, dense=design.dense)
        np.save(folder / f"{k}.npy", samples[: design.sensors].astype(np.float32))
        lines.append(f"{k}.npy,{label},{RATE:g},m/s^2,{'1+2' if design.sensors > 1 else ''}")
    manifest = folder / "manifest.csv"
    manifest.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return manifest


def accuracy(model: Any, manifest: Path) -> float:
    """Return the share of right labels, whether the model knows the impacts or not."""
    rows = record(read_manifest(manifest), slicing=Slicing(by="impact"), model=model)
    found = np.array(model.labels)[np.argmax(model.probabilities(rows.columns(model.features)), axis=1)]
    return float(np.mean(found == rows.labels))


def tried(design: Design, seed: int, *, judged: bool = True) -> dict[str, Any]:
    """Return what the training of a design says, and what its model does."""
    face = Face(seed)
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(name)
        manifest = written(folder / "train", face, design, 0)
        begin = time.process_time()
        training = train_on_groups(manifest, features=design.features)
        row = {"design": design.name, "cpu": time.process_time() - begin, "stated": training.metrics["accuracy"]}
        row |= {"control": dict(training.control or {})}
        if not judged:
            names = None if design.features is None else list(design.features)
            rows = record(read_manifest(manifest), names, augment=True, control=False)
            row["without"] = train_on_groups(rows, features=design.features).metrics["accuracy"]
        else:
            test = replace(design, n_files=6, n_rocks=24, both=False)
            models = {"": training.model}
            if (before := training.unmended) is not None:
                models = {"": before.model, "mended ": training.model}
            paths = [written(folder / f"test{k}", face, test, 1, swapped=bool(k)) for k in range(2)]
            for which, model in models.items():
                row |= {which + what: accuracy(model, path) for what, path in zip(("un", "sw"), paths, strict=True)}
    return row


def additive() -> list[Design]:
    """Return the designs whose labels differ in tones, noise or rumble."""
    base = State()

    def tones(*pairs: tuple[float, float]) -> State:
        return replace(base, tones=pairs)

    loud = replace(tones((223.0, 5.0), (640.0, 5.0), (1800.0, 5.0)), noise=6.0)
    found = {f"tone 223 Hz of {a:g}": tones((223.0, a)) for a in (1.0, 3.0, 10.0, 30.0)}
    found |= {f"tone 1250 Hz of {a:g}": tones((1250.0, a)) for a in (3.0, 10.0, 30.0)}
    found |= {"mains": tones((50.0, 10.0), (100.0, 6.0), (150.0, 4.0)), "three tones, noise 6": loud}
    found |= {f"noise {a:g}": replace(base, noise=a) for a in (2.4, 6.0)}
    found |= {f"rumble {a:g}": replace(base, rumble=a) for a in (3.0, 10.0)}
    return [Design(name, base, state) for name, state in found.items()]


def paths() -> list[Design]:
    """Return the designs whose labels differ in the way from the rock to the file."""
    base = State()
    found = {f"gain {a:g}": replace(base, gain=a) for a in (3.0, 9.8)}
    found |= {f"edge {a:g} Hz": replace(base, edge=a) for a in (1500.0, 3000.0, 6000.0)}
    found["place"] = replace(base, place=0.63)
    return [Design(name, base, state) for name, state in found.items()]


def sound(n: int) -> Iterator[Design]:
    """Yield designs without a confounded state: both labels in one, or each in both."""
    every = [one.gangue for one in (*additive(), *paths()[:-1])]
    sets = {name: supported(names, RATE, 4096) for name, names in sets_for("vibration", RATE).items()}
    for k in range(n):
        state, n_files = every[k % len(every)], (4, 6, 12)[k % 3]
        n_rocks, both = (8, 16, 24)[(k // 3) % 3], k % 2 == 1
        name = f"{n_files} of {n_rocks}, {'each in both' if both and n_files > 4 else 'one state'}"
        both, dense, sensors = both and n_files > 4, k % 7 == 3, 2 if k % 5 == 2 else 1
        features = (None, None, *sets.values())[k % (2 + len(sets))]
        name += f", {sensors} sensors" * (sensors > 1) + ", dense" * dense + ", of one set" * bool(features)
        yield Design(name, State() if both else state, state, n_files, n_rocks, both, dense, sensors, features)


def told(row: dict[str, Any]) -> str:
    """Return by which test a training was told, in the first place if it was mended."""
    control = row["control"]
    return control.get("before", control).get("told", "")


def rate(n: int, of: int) -> str:
    """Return a share with its 95 % interval (Clopper and Pearson 1934)."""
    if not of:
        return "none"
    found = stats.binomtest(n, of).proportion_ci(0.95)
    return f"{n} of {of} ({n / of:.3f}, {found.low:.3f} to {found.high:.3f})"


def number(control: dict[str, Any], name: str) -> float:
    """Return a number of a control, of the path how many more its other one turns wrong."""
    found = control.get(name, np.nan)
    return float(np.subtract(*found)) if name == "path" and np.ndim(found) else float(found)


def table_of_confounded(designs: Sequence[Design], seeds: Sequence[int]) -> None:
    """Print what is told of confounded designs."""
    columns = "un", "sw", "mended un", "mended sw", "stated"
    print("design | seed | told | own | same | other | path | expected | " + " | ".join(columns), flush=True)
    rows = []
    for design in designs:
        for seed in seeds:
            row = tried(design, seed)
            control = row["control"].get("before", row["control"])
            numbers = [number(control, name) for name in ("own", "same", "other", "path", "expected")]
            shown = [f"{x:.2f}" for x in (*numbers, *(row.get(name, np.nan) for name in columns))]
            print(design.name, seed, told(row) or "-", *shown, sep=" | ", flush=True)
            rows.append(row)
    for name, low, high in (("harm < .10", -1.0, 0.10), (".10 to .25", 0.10, 0.25), ("> .25", 0.25, 2.0)):
        some = [row for row in rows if low <= row["un"] - row["sw"] < high]
        print(f"{name}: told {rate(sum(bool(told(row)) for row in some), len(some))}")
    if mended := [row for row in rows if "mended sw" in row]:
        swapped = [row["mended sw"] for row in mended]
        less = [row["un"] - row["mended un"] for row in mended]
        print(
            f"mended {len(mended)}: swapped mean {np.mean(swapped):.3f}, least {min(swapped):.2f}; unswapped at most "
            f"{max(less):.3f} less, mean {np.mean(less):.3f}"
        )
    additive_ones = [row for row in rows if "expected" in row["control"].get("before", row["control"])]
    error = [row["control"].get("before", row["control"])["expected"] - row["sw"] for row in additive_ones]
    print(f"expected minus swapped: {np.mean(error):+.2f} +- {np.std(error):.2f}")


def table_of_sound(n: int, seed: int) -> None:
    """Print the false alarms of sound designs."""
    n_told = n_tried = 0
    moved = []
    for k, design in enumerate(sound(n)):
        try:
            row = tried(design, seed + k, judged=False)
        except CgidError as error:
            print(k, design.name, type(error).__name__, str(error)[:100], sep=" | ", flush=True)
            continue
        control = row["control"]
        n_tried += "same" in control
        n_told += bool(told(row))
        moved.append(row["stated"] - row["without"])
        shown = [f"{number(control, name):.2f}" for name in ("own", "same", "other", "path")]
        shown += [f"{moved[-1]:+.3f}", f"{row['cpu']:.1f} s"]
        print(k, design.name, told(row) or "-", *shown, sep=" | ", flush=True)
    print(f"told {rate(n_told, n_tried)}")
    n_moved = sum(abs(one) > 0.01 for one in moved)
    print(f"accuracy less that without the control: mean {np.mean(moved):+.4f}, {n_moved} of {len(moved)} beyond .01")


def table_of_sources(n: int) -> None:
    """Print in how many trainings a recording or a label of another scale is named, and copies are refused."""
    cases = {"as recorded": {}, "one recording x 9.8": {2: 9.8}, "one recording x 0.1": {2: 0.1}}
    cases |= {f"gangue x {gain:g}": dict.fromkeys((1, 3, 5), gain) for gain in (3.0, 9.8)}
    for name, factors in cases.items():
        named = 0
        for seed in range(n):
            with tempfile.TemporaryDirectory() as folder:
                manifest = written(Path(folder), Face(7000 + seed), Design(name, State(), State()), 0)
                for k, factor in factors.items():
                    file = manifest.parent / f"{k}.npy"
                    np.save(file, np.load(file) * np.float32(factor))
                rows = record(read_manifest(manifest), slicing=Slicing(by="impact"))
                named += bool(list(odd_sources(rows.levels_of_sources)))
        print(f"{name}: named in {named} of {n}", flush=True)
    refused = 0
    for seed in range(n):
        random, recorded = np.random.default_rng(seed), Face(8000 + seed).recording("coal", State(), [0], 30)[0]
        with tempfile.TemporaryDirectory() as folder:
            lines = ["path,label,rate_Hz,unit"]
            for k in range(9):
                copy = recorded[round((0.02 + 0.04 * k) * RATE) :] * 1.01**k
                copy = copy + 0.1 * random.normal(size=copy.size)
                np.save(Path(folder) / f"{k}.npy", copy[None].astype(np.float32))
                lines.append(f"{k}.npy,{random.choice(MATERIALS)},{RATE:g},m/s^2")
            (Path(folder) / "labels.csv").write_text("\n".join(lines), encoding="utf-8")
            try:
                train_on_groups(Path(folder) / "labels.csv")
            except BadData as error:
                refused += "other rocks" in str(error)
    print(f"labels by dice on nine near copies: refused in {refused} of {n}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("additive", "path", "sound", "sources"))
    parser.add_argument("-n", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=50_000, help="the first")
    given = parser.parse_args()
    if given.what in ("additive", "path"):
        designs = additive() if given.what == "additive" else paths()
        table_of_confounded(designs, range(given.seed, given.seed + given.seeds))
    elif given.what == "sound":
        table_of_sound(given.n, given.seed)
    else:
        table_of_sources(given.n)


if __name__ == "__main__":
    main()

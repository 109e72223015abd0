"""What a wrong scale does to the answers of the shipped models, and how often recordings of their own world are warned.

    python benchmarks/plant/wrong_scale.py              # prints Markdown; some ten minutes on one core
    python benchmarks/plant/wrong_scale.py -n 6000 --streams 8
    python benchmarks/plant/wrong_scale.py --labelled   # models of labelled recordings; an hour

Impacts of the scenes that the models were trained on, by seeds that no training used, are cut into recordings of 10, 30
and 100. The models of force get `reference`, `rock`, and `rock` recorded on many rigs (noise, filter, clipping), one
a recording; that of acceleration gets `tail_beam`, blows everywhere, many noises, and all that the detector finds
in streams like `caving` with every share of gangue. A factor on the samples multiplies the measured peak and changes
nothing else that the models see, so that each impact is measured once (a test compares this with scaled samples).
Their levels alone are judged, as of models without explanations of faults, which `false_alarms` and `anchor` measure.

With `--labelled`, models are trained by `cgid train` on a few labelled recordings made by code that shares nothing with
the package: forces, and vibrations of two sensors, of `foreign_beam`; flows on it, by windows; and the default model of
acceleration corrected by labelled impacts on the beam of `independent_beam`. Sizes and speeds of the rocks differ from
recording to recording. `cgid predict` and `cgid monitor` read new recordings at each wrong scale.
"""

import argparse
import contextlib
import csv
import io
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import firwin, resample_poly

from benchmarks.beam import foreign_beam, independent_beam
from cgid import shipped
from cgid._lib.validation import UNKNOWN
from cgid.cli.main import run
from cgid.identification.model.explanations import Explanations
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import PredictionSettings
from cgid.identification.prediction.answers import Answer, answers_from
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.training import Rows, measure
from cgid.identification.training.card import table
from cgid.measure.features import FEATURES
from cgid.scene import load_scene, synthesise
from cgid.scene.synthesis.through_beam import beam_of

sys.path.insert(0, str(Path(__file__).parents[2] / "models"))
from train import acceleration_scenes, on_rigs, shipped_scene, streams

SEED = 4_000_037
SIZES = (10, 30, 100)
FACTORS = (1e-3, 0.01, 0.1, 1 / 9.81, 0.2, 0.5, 0.7, 1.0, 1.4, 2.0, 5.0, 9.81, 10.0, 100.0, 1e3)

Parts = list[tuple[str, Rows]]


def of_force(model: StoredModel, n: int) -> Parts:
    """Return rows of the scenes of the models of force, and of single rigs."""
    parts = [
        (name, measure(synthesise(load_scene(shipped.scene_path(name)), n, SEED), model.measured))
        for name in ("reference", "rock")
    ]
    for scene, _ in on_rigs(shipped_scene("rock"), n):
        # A block of impacts has one rig.
        for batch in synthesise(scene, n // 3, SEED):
            parts.append(("single rigs", measure([batch], model.measured)))
    return parts


def of_acceleration(model: StoredModel, n: int, n_streams: int) -> Parts:
    scenes = [scene for scene, _ in acceleration_scenes(100)]
    beam = beam_of(scenes[-1])
    parts = [(scene.name, measure(synthesise(scene, n // 4, SEED), model.measured, beam=beam)) for scene in scenes]
    return parts + [("streams", stream.rows) for stream in streams(n_streams, SEED, beam)]


class World:
    """The measured impacts of a model's own recordings."""

    def __init__(self, model: StoredModel, parts: Parts) -> None:
        self.model, self.names = model, [name for name, _ in parts]
        self.inputs = [rows.features[:, : len(model.features)] for _, rows in parts]
        self.guards = [rows.features[:, len(model.features) :] for _, rows in parts]
        self.scaled = np.array([name in FEATURES and FEATURES[name].unit in ("U", "N") for name in model.inputs])

    def answers(self, factor: float) -> list[list[Answer]]:
        """Return the answers for each part, its samples times a factor."""
        inputs = [np.where(self.scaled, factor * rows, rows) for rows in self.inputs]
        rate = self.model.sampling_rates[0]
        return [
            list(answers_from(rows, guards, self.model, PredictionSettings(), rate))
            for rows, guards in zip(inputs, self.guards, strict=True)
        ]

    def warned(self, answers: list[list[Answer]], size: int) -> dict[str, list[tuple[bool, bool]]]:
        """Return for each recording of this size whether it is warned, and whether it has a hint instead."""
        found: dict[str, list[tuple[bool, bool]]] = {}
        for name, part in zip(self.names, answers, strict=True):
            for first in range(0, len(part) - size + 1, size):
                diagnosis = Diagnosis(self.model)
                diagnosis.add(part[first : first + size])
                told = {one.kind for one in diagnosis.findings()}
                found.setdefault(name, []).append(("scale" in told, bool(told - {"scale"})))
        return found


def percentage(flags: list[bool]) -> str:
    share = float(np.mean(flags))
    return f"{share:.1%} ± {np.sqrt(share * (1 - share) / len(flags)):.1%}"


def report(name: str, world: World) -> None:
    own, alarms = world.answers(1.0), []
    for size in SIZES:
        warned = world.warned(own, size)
        parts = [[level for level, _ in one] for one in warned.values()]
        together = [flag for part in parts for flag in part]
        alarms.append((size, *map(percentage, parts), percentage(together), len(together)))
    print(f"\n### {name}\n\nWarned at the right scale, of recordings of so many impacts:\n")
    titles = [key for key, _ in groupby(world.names)]
    print("\n".join(table(("impacts", *titles, "all", "recordings"), alarms)), flush=True)
    print("\nAt a wrong scale (answers of all impacts; warned, or with a hint since most are unknown):\n")
    rows = []
    for factor in FACTORS:
        answers = world.answers(factor)
        labels = Counter(answer.label for part in answers for answer in part)
        shares = [f"{labels[label] / labels.total():.1%}" for label in (*world.model.labels, UNKNOWN)]
        told = []
        for size in SIZES:
            flags = [one for part in world.warned(answers, size).values() for one in part]
            level, hint = np.mean(flags, axis=0)
            told.append(f"{level:.1%}" + (f" + {hint:.1%}" if hint >= 0.0005 else ""))
        rows.append((f"{factor:.3g}", *shares, *told))
    titles = [f"told of {size}" for size in SIZES]
    print("\n".join(table(("factor", *world.model.labels, UNKNOWN, *titles), rows)), flush=True)


# -- models of labelled recordings, of worlds that share nothing with cgid --------------------------------

#: Factors on the samples.
LABELLED_FACTORS = (0.1, 1 / 9.81, 0.2, 0.33, 0.5, 2.0, 3.0, 5.0, 9.81, 10.0)
#: By how much the mean size and speed of the rocks of a recording differ from those of others [ln, m/s] (assumed).
DAYS = (0.12, 0.35)


class Made(NamedTuple):
    """An impact without noise: what two sensors or one record of it, from `before` samples before its onset on."""

    label: str
    size: float  # ln of the radius over the mean one
    speed: float  # less the mean one [m/s]
    force: np.ndarray  # (n_fine,)
    heard: np.ndarray  # (n_sensors, n_samples)
    before: int = 0


class Recording(NamedTuple):
    """A made recording: samples (n_channels, n), their rate [Hz] and unit, and start, end [s] and label of the rows."""

    samples: np.ndarray
    rate: float
    unit: str
    rows: list[tuple[float, float, str]]


def foreign_impacts(n: int, seed: int) -> list[Made]:
    random, made = np.random.default_rng(seed), []
    fine = foreign_beam.FINE
    low_pass = firwin(32 * fine + 1, 0.85 / fine)
    for label in random.choice(list(foreign_beam.ROCKS), n):
        mean, deviation = foreign_beam.ROCKS[label][2:]
        size, speed = random.normal(0, 0.25), random.uniform(2, 5)
        restitution = float(np.clip(random.normal(mean, deviation), 0.15, 0.8))
        force = foreign_beam.contact_force(label, 0.05 * np.exp(size), speed, restitution)
        heard = foreign_beam.answer(force, random.uniform(0.2, 0.8), int(0.7 * foreign_beam.RATE) * fine)
        made.append(Made(label, size, speed - 3.5, force, resample_poly(heard, 1, fine, window=low_pass).T))
    return made


def independent_impacts(n: int, seed: int) -> list[Made]:
    # Skin and ribs as thin as in the scene of the model: it does not know other beams.
    found = independent_beam.generate(n, seed, "0.001 mindlin", noise=0.0)
    fade = np.ones(independent_beam.SAMPLES)
    fade[-512:] = 0.5 + 0.5 * np.cos(np.linspace(0, np.pi, 512))
    return [
        Made(label, 0.0, 0.0, np.empty(0), (fade * samples)[None], independent_beam.PRE_TRIGGER)
        for label, samples in zip(found["labels"].tolist(), found["acceleration"], strict=True)
    ]


def of_a_day(made: Sequence[Made], n: int, random: np.random.Generator, label: str | None = None) -> list[Made]:
    """Return impacts of a mixture of its own, or of one label, around the size and speed of a day."""
    share, size, speed = random.uniform(0.15, 0.85), random.normal(0, DAYS[0]), random.normal(0, DAYS[1])
    chosen = []
    for name in random.choice(sorted({one.label for one in made}), n, p=[1 - share, share]):
        alike = [one for one in made if one.label == (label or name)]
        weights = [np.exp(-0.5 * (((one.size - size) / 0.25) ** 2 + ((one.speed - speed) / 0.9) ** 2)) for one in alike]
        chosen.append(alike[random.choice(len(alike), p=np.array(weights) / np.sum(weights))])
    return chosen


def laid(samples: np.ndarray, events: Sequence[np.ndarray], starts: Sequence[int]) -> np.ndarray:
    for event, start in zip(events, starts, strict=True):
        first, part = max(start, 0), event[:, max(-start, 0) :]
        part = part[:, : samples.shape[1] - first]
        samples[:, first : first + part.shape[1]] += part
    return samples


def forces(made: Sequence[Made], random: np.random.Generator) -> Recording:
    rate, impacts = foreign_beam.RATE * foreign_beam.FINE, of_a_day(made, 30, random)
    times = 0.02 + 0.02 * np.arange(30) + random.uniform(0, 0.005, 30)
    samples = random.normal(0, 10, (1, int(0.65 * rate)))
    samples = laid(samples, [one.force[None] for one in impacts], (times * rate).astype(int))
    rows = [(time - 0.005, time + 0.008, one.label) for time, one in zip(times, impacts, strict=True)]
    return Recording(samples, rate, "N", rows)


def vibrations(made: Sequence[Made], random: np.random.Generator, noise: float = 0.05) -> Recording:
    rate, impacts = foreign_beam.RATE, of_a_day(made, 24, random)
    times = 0.6 + np.cumsum(random.uniform(0.9, 1.6, 24))
    samples = random.normal(0, noise, (len(made[0].heard), int((times[-1] + 1) * rate)))
    starts = [int(time * rate) - one.before for time, one in zip(times, impacts, strict=True)]
    rows = [(time - 0.05, time + 0.3, one.label) for time, one in zip(times, impacts, strict=True)]
    return Recording(laid(samples, [one.heard for one in impacts], starts), rate, "m/s^2", rows)


def flow(made: Sequence[Made], random: np.random.Generator, label: str | None = None) -> Recording:
    rate, n, label = foreign_beam.RATE, int(6 * random.uniform(7, 11)), label or random.choice(["coal", "gangue"])
    impacts = of_a_day(made, n, random, label)
    samples = random.normal(0, 0.05, (1, int(6 * rate)))
    starts = (random.uniform(-0.3, 6, n) * rate).astype(int)
    return Recording(laid(samples, [one.heard[:1] for one in impacts], starts), rate, "m/s^2", [(0.0, 6.0, label)])


def trained(folder: Path, recordings: Sequence[Recording], *options: str) -> Path:
    """Return the model that `cgid train` makes of labelled recordings."""
    model, table = folder / "model.npz", folder / "labels.csv"
    with table.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["path", "label", "start_s", "end_s", "rate_Hz", "unit"])
        for k, one in enumerate(recordings):
            np.save(folder / f"labelled_{k}.npy", one.samples)
            rows.writerows(
                [f"labelled_{k}.npy", label, f"{a:.6f}", f"{b:.6f}", one.rate, one.unit] for a, b, label in one.rows
            )
    silently("train", table, *options, "-o", model, "--overwrite")
    return model


def silently(*arguments: object) -> str:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run([str(one) for one in arguments])
    if code:
        sys.exit(f"cgid {' '.join(map(str, arguments))}: {err.getvalue()}")
    return out.getvalue()


def told(command: str, model: Path, one: Recording, factor: float) -> tuple[bool, bool]:
    """Return whether a command warns of the scale of a recording times a factor, and whether it says anything else."""
    path = model.parent / ("new.npy" if command == "predict" else "new.f32")
    raw: list[object] = []
    if command == "predict":
        np.save(path, factor * one.samples)
    else:
        (factor * one.samples.T).astype("<f4").tofile(path)
        raw = ["--channels", len(one.samples), "--sample-format", "f32le"]
    lines = silently(command, path, "--rate", one.rate, "--unit", one.unit, *raw, "--model", model, "--json")
    found = [line for line in map(json.loads, lines.splitlines()) if line["kind"] in ("warning", "hint")]
    scale = [line.get("condition") == "wrong_scale" or line.get("cause") == "amplitude" for line in found]
    return any(scale), not all(scale)


def labelled(n: int) -> None:
    """Print what is told of n sound recordings of each world, and of a tenth as many at each wrong scale."""
    old, new = foreign_impacts(300, 1), foreign_impacts(600, 2)
    by_label = [partial(flow, label=label) for label in ("coal", "gangue") * 5]
    windows = ("--by", "window", "--window", "0.2")
    tell("forces, 6 recordings of 30 impacts", [forces] * 6, forces, old, new, n)
    tell("vibrations, 6 recordings of 24 impacts, two sensors", [vibrations] * 6, vibrations, old, new, n)
    tell("windows, 10 flows of 6 s", by_label, flow, old, new, n, *windows)
    old, new = independent_impacts(200, 3), independent_impacts(1200, 4)
    through = partial(vibrations, noise=independent_beam.NOISE)
    base = ("--from", "default-acceleration")
    tell(
        "through a beam: 2 recordings of 24 impacts correct the default model",
        [through] * 2,
        through,
        old,
        new,
        n,
        *base,
    )


def tell(
    title: str,
    makers: Sequence[Callable[..., Recording]],
    maker: Callable[..., Recording],
    old: Sequence[Made],
    new: Sequence[Made],
    n_sound: int,
    *options: str,
) -> None:
    """Train on old impacts as recordings, and print what the commands tell of new ones at each scale."""
    random, rows = np.random.default_rng(5), []
    with tempfile.TemporaryDirectory() as folder:
        model = trained(Path(folder), [make(old, random) for make in makers], *options)
        for factor in (1.0, *LABELLED_FACTORS):
            cells = []
            for command in ("predict", "monitor"):
                n = n_sound if factor == 1 else max(n_sound // 10, 1)
                made = (maker(new, np.random.default_rng([6, k])) for k in range(n))
                scale, other = np.mean([told(command, model, one, factor) for one in made], axis=0)
                cells += [f"{scale:.1%} of {n}", f"{other:.1%}"]
            rows.append((f"{factor:.3g}", *cells))
    titles = ("factor", "told by predict", "something else", "told by monitor", "something else")
    print("\n".join(["", f"### {title}", "", *table(titles, rows)]), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--impacts", type=int, default=24_000, help="of each scene of force; of a beam a quarter")
    parser.add_argument("--streams", type=int, default=40, help="of a minute each")
    parser.add_argument("--labelled", action="store_true", help="models of labelled recordings instead")
    parser.add_argument("--recordings", type=int, default=200, help="sound ones of each labelled world")
    arguments = parser.parse_args()
    if arguments.labelled:
        labelled(arguments.recordings)
        return
    for name in (shipped.DEFAULT_MODEL, shipped.ACCELERATION_MODEL):
        model = StoredModel.load(shipped.path_of("models", name))
        kept = {key: one for key, one in model.arrays.items() if not key.startswith(Explanations.PREFIXES)}
        model = replace(model, arrays=kept)
        if model.beam is None:
            parts = of_force(model, arguments.impacts)
        else:
            parts = of_acceleration(model, arguments.impacts, arguments.streams)
        report(name, World(model, parts))


if __name__ == "__main__":
    main()

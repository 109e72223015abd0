"""What a wrong scale does to the answers of the shipped models, and how often recordings of their own world are warned.

    python benchmarks/wrong_scale.py              # prints Markdown; some ten minutes on one core
    python benchmarks/wrong_scale.py -n 6000 --streams 8

Impacts of the scenes that the models were trained on, by seeds that no training used, are cut into recordings of 10, 30
and 100. The models of force get `reference`, `rock`, and `rock` recorded on many rigs (noise, filter, clipping), one
a recording; that of acceleration gets `tail_beam`, blows everywhere, many noises, and all that the detector finds
in streams like `caving` with every share of gangue. A factor on the samples multiplies the measured peak and changes
nothing else that the models see, so that each impact is measured once (a test compares this with scaled samples).
"""

import argparse
import sys
from collections import Counter
from itertools import groupby
from pathlib import Path

import numpy as np

from cgid import shipped
from cgid.identification.answers import Answer, answers_from
from cgid.identification.card import table
from cgid.identification.diagnosis import Diagnosis
from cgid.identification.model import Model
from cgid.identification.prediction_settings import PredictionSettings
from cgid.identification.rows import Rows, measure
from cgid.measure.features import FEATURES
from cgid.scene import load_scene, synthesise
from cgid.scene.through_beam import beam_of
from cgid.validation import UNKNOWN

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
from train import acceleration_scenes, on_rigs, shipped_scene, streams

SEED = 4_000_037
SIZES = (10, 30, 100)
FACTORS = (1e-3, 0.01, 0.1, 1 / 9.81, 0.2, 0.5, 0.7, 1.0, 1.4, 2.0, 5.0, 9.81, 10.0, 100.0, 1e3)

Parts = list[tuple[str, Rows]]


def of_force(model: Model, n: int) -> Parts:
    """Return rows of the scenes of the models of force, and of single rigs."""
    heights = model.known
    parts = [
        (name, measure(synthesise(load_scene(shipped.scene_path(name)), n, SEED), model.measured, known=heights))
        for name in ("reference", "rock")
    ]
    for scene, _ in on_rigs(shipped_scene("rock"), n):
        # A block of impacts has one rig.
        for batch in synthesise(scene, n // 3, SEED):
            parts.append(("single rigs", measure([batch], model.measured, known=heights)))
    return parts


def of_acceleration(model: Model, n: int, n_streams: int) -> Parts:
    scenes = [scene for scene, _ in acceleration_scenes(100)]
    beam = beam_of(scenes[-1])
    parts = [(scene.name, measure(synthesise(scene, n // 4, SEED), model.measured, beam=beam)) for scene in scenes]
    return parts + [("streams", stream.rows) for stream in streams(n_streams, SEED, beam)]


class World:
    """The measured impacts of a model's own recordings."""

    def __init__(self, model: Model, parts: Parts) -> None:
        self.model, self.names = model, [name for name, _ in parts]
        self.inputs = [np.hstack([rows.features[:, : len(model.features)], rows.known]) for _, rows in parts]
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
                found.setdefault(name, []).append((bool(diagnosis.wrong_scales()), bool(diagnosis.findings())))
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--impacts", type=int, default=24_000, help="of each scene of force; of a beam a quarter")
    parser.add_argument("--streams", type=int, default=40, help="of a minute each")
    arguments = parser.parse_args()
    for name in (shipped.DEFAULT_MODEL, shipped.DROP_HEIGHT_MODEL, shipped.ACCELERATION_MODEL):
        model = Model.load(shipped.path_of("models", name))
        if model.beam is None:
            parts = of_force(model, arguments.impacts)
        else:
            parts = of_acceleration(model, arguments.impacts, arguments.streams)
        report(name, World(model, parts))


if __name__ == "__main__":
    main()

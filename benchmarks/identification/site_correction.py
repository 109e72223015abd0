"""A shipped model corrected by ten to fifty labelled impacts: accuracy before and after, and the interval it states.

    python benchmarks/identification/site_correction.py [--pool 700] [--seeds 20] [--site "harder seam"]

The impacts are those of tail_beam, of seams of other rock, and of a sensor a fifth off. For each number of labelled
impacts the draws differ by the seed; the impacts that are left judge. Prints Markdown: mean accuracy and log loss of
default-acceleration before and after, the largest loss of accuracy among the seeds, the accuracy that `cgid train
--from` states (each labelled impact judged by the others), and how often its 95 % interval holds the true one.
"""

import argparse
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.training import Rows, measure
from cgid.identification.training.correction import correct
from cgid.scene import parse_scene, synthesise
from cgid.signals import Batch

#: Name -> stiffness and restitution of coal and gangue over those of tail_beam, and gain of the sensor.
SITES = {
    "as in training": ((1.0, 1.0), (0.0, 0.0), 1.0),
    "harder seam": ((1.45, 1.6), (0.07, 0.08), 1.0),
    "softer seam": ((0.65, 0.6), (-0.1, -0.1), 1.0),
    "gain + 20 %": ((1.0, 1.0), (0.0, 0.0), 1.2),
    "gain - 20 %": ((1.0, 1.0), (0.0, 0.0), 0.8),
    "harder seam, gain - 20 %": ((1.45, 1.6), (0.07, 0.08), 0.8),
}
NUMBERS = (10, 20, 50)
SEED = 777


def batches(stiffer: tuple[float, float], livelier: tuple[float, float], gain: float, n: int) -> Iterator[Batch]:
    scene: dict[str, Any] = tomllib.loads(shipped.path_of("datasets", "tail_beam.toml").read_text())
    for rocks, factor, more in zip(scene["populations"], stiffer, livelier, strict=True):
        modulus = float(rocks["youngs_modulus"]["median"].split()[0])
        rocks["youngs_modulus"]["median"] = f"{factor * modulus} GPa"
        rocks["restitution"]["mean"] += more
    for batch in synthesise(parse_scene(scene), n, SEED):
        yield replace(batch, signals=gain * batch.signals)


def draws(rows: Rows, n: int, seeds: int) -> Iterator[NDArray[np.bool_]]:
    for seed in range(seeds):
        chosen = np.zeros(len(rows.labels), bool)
        chosen[np.random.default_rng((n, seed)).permutation(len(chosen))[:n]] = True
        if len(np.unique(rows.labels[chosen])) > 1:
            yield chosen


def judged(model: StoredModel, rows: Rows) -> tuple[float, float]:
    probabilities = model.probabilities(rows.columns(model.features))
    truth = np.array([model.labels.index(label) for label in rows.labels])
    own = probabilities[np.arange(len(truth)), truth]
    return float(np.mean(np.argmax(probabilities, axis=1) == truth)), float(-np.log(np.maximum(own, 1e-12)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pool", type=int, default=700)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--site", choices=SITES, action="append", help="only this one, or several")
    asked = parser.parse_args()
    model = StoredModel.load(shipped.model_path("default-acceleration"))
    assert model.beam is not None
    print("| site | labelled | before | after | most lost | log loss before | after | stated | interval holds |")
    print("|---" * 9 + "|")
    for name in asked.site or SITES:
        rows = measure(batches(*SITES[name], asked.pool), model.measured, beam=model.beam.beam)
        rows = rows[model.novelty(rows.columns(model.features), rows.columns(model.guards)) <= 1]
        for n in NUMBERS:
            found = []
            for chosen in draws(rows, n, asked.seeds):
                correction = correct(model, rows[chosen])
                before, after = judged(model, rows[~chosen]), judged(correction.model, rows[~chosen])
                low, high = correction.after["accuracy_interval_95"]
                found.append((*before, *after, correction.after["accuracy"], low <= after[0] <= high))
            table = np.array(found, float)
            mean, lost = table.mean(axis=0), (table[:, 0] - table[:, 2]).max()
            cells = [f"{mean[0]:.3f}", f"{mean[2]:.3f}", f"{lost:.3f}", f"{mean[1]:.3f}", f"{mean[3]:.3f}"]
            print(f"| {name} | {n} | {' | '.join(cells)} | {mean[4]:.3f} | {mean[5]:.2f} |", flush=True)


if __name__ == "__main__":
    main()

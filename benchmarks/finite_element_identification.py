"""Performance of the default model on impacts of another physics, and the share of them that the pulse family explains.

    python benchmarks/finite_element_identification.py [MODEL.npz] [--sizes 8] [--elastic 8] [--retrained 6000]
    python benchmarks/finite_element_identification.py --sizes 1 --finer 6

The impacts of `datasets/finite_element.npz` are rocks of the reference scene, solved by finite elements. They are
compared with the same rocks, falls and restitutions by the law of Kuwabara and Kono (a viscoelastic sphere, as in the
elements, but with Hertz's contact) and by that of Hunt and Crossley, which the scene and the model's training use. The
scene draws sizes, noise and touch `--sizes` times, equal for all three, with its 1 % of noise and with 10 %. Intervals
resample rocks, which are fewer than signals. --elastic solves this many rocks again without loss. --finer solves this
many on 28 elements in 1000 steps: the hardest, softest, liveliest and most damped rock, then others; a minute each.
--retrained trains a model on this many signals of each law, with rocks drawn by the scene, to measure the loss from a
wrong law. Prints Markdown; some minutes.
"""

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from finite_element_fits import finer_table, physics_table, shape_table
from finite_element_rocks import ELASTIC, FAMILY, FINITE_ELEMENTS, VISCOELASTIC, all_three, by_law, without_loss

from cgid import shipped
from cgid.identification.metrics import evaluate
from cgid.identification.model import Model
from cgid.identification.rows import measure
from cgid.identification.training import train
from cgid.scene import Scene, load_scene, synthesise, synthesise_given, varied
from cgid.scene.given_pulses import SolvedImpacts
from cgid.scene.impacts import draw
from cgid.signals import Batch

SEED, TRAINING_SEED = 3_000_017, 4_000_037
RESAMPLINGS = 2000


# --- identification ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Answers:
    """A model's answers to the signals of all sizes, one size after another."""

    probabilities: np.ndarray
    labels: np.ndarray
    novelty: np.ndarray
    guards: np.ndarray
    n_rocks: int
    classes: tuple[str, ...]

    @property
    def hits(self) -> np.ndarray:
        """Whether the more probable label is right, (n_sizes, n_rocks)."""
        found = np.array(self.classes)[self.probabilities.argmax(axis=1)] == self.labels
        return found.reshape(-1, self.n_rocks)

    @property
    def losses(self) -> np.ndarray:
        """Minus the logarithm of the probability of the truth, (n_sizes, n_rocks)."""
        truth = self.labels[:, None] == np.array(self.classes)
        return -np.log(self.probabilities[truth]).reshape(-1, self.n_rocks)


def answers(model: Model, batches: Iterator[Batch], n_rocks: int) -> Answers:
    """Return a model's answers; every signal must be measurable."""
    measured = measure(batches, model.measured)
    if measured.left_out:
        raise SystemExit(f"{measured.left_out} signals cannot be measured")
    inputs, guards = np.split(measured.features, [len(model.features)], axis=1)
    novelty = model.novelty(inputs, guards)
    return Answers(model.probabilities(inputs), measured.labels, novelty, guards, n_rocks, model.labels)


def signals(impacts: SolvedImpacts, scene: Scene, sizes: int) -> Iterator[Batch]:
    """Yield the signals of all sizes."""
    for size in range(sizes):
        yield from impacts.signals(scene, SEED + size)


def resampled(difference: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of numbers (n_sizes, n_rocks) and its 95 % interval; rocks are resampled with all their sizes."""
    rocks = difference.mean(axis=0)
    draws = np.random.default_rng(0).integers(0, rocks.size, (RESAMPLINGS, rocks.size))
    low, high = np.quantile(rocks[draws].mean(axis=1), [0.025, 0.975])
    return float(rocks.mean()), float(low), float(high)


def identification_table(found: dict[str, Answers], model: Model) -> None:
    """Print the accuracy for the three kinds of pulses, and the novelty of these."""
    guards = ", ".join(model.guards)
    print(
        "| pulses | accuracy | log loss | Brier | calibration error | by chance | ROC area | unknown | of these by ",
        end="",
    )
    print(f"{guards} | median misfit |\n|---|---|---|---|---|---|---|---|---|---|")
    for name, of in found.items():
        figures = evaluate(of.labels, of.probabilities, of.classes)
        unknown = of.novelty > 1
        by = [int((unknown & (of.guards[:, k] > limit)).sum()) for k, limit in enumerate(model.guard_limits)]
        accuracy, low, high = resampled(of.hits.astype(float))
        print(
            f"| {name} | {accuracy:.4f} ({low:.3f} to {high:.3f}) | {figures['log_loss']:.4f} | "
            f"{figures['brier_score']:.4f} | {figures['expected_calibration_error']:.4f} | "
            f"{figures['calibration_error_by_chance']:.4f} | {figures['roc_area'][of.classes[0]]:.4f} | "
            f"{unknown.mean():.4f} | {by} of {unknown.sum()} | {np.median(of.guards[:, 0]):.3f} |"
        )
    family = found[FAMILY]
    for name in (FINITE_ELEMENTS, VISCOELASTIC):
        less = resampled(found[name].hits.astype(float) - family.hits)
        worse = resampled(found[name].losses - family.losses)
        same = np.mean(found[name].probabilities.argmax(axis=1) == family.probabilities.argmax(axis=1))
        print(
            f"\n{name} minus {FAMILY}, signal by signal: accuracy {less[0]:+.4f} ({less[1]:+.4f} to {less[2]:+.4f}), "
            f"log loss {worse[0]:+.4f} ({worse[1]:+.4f} to {worse[2]:+.4f}); the same answer for {same:.4f}."
        )


def confusion_table(found: dict[str, Answers]) -> None:
    """Print the confusions and the confidence of the answers."""
    for name, of in found.items():
        figures = evaluate(of.labels, of.probabilities, of.classes)
        rows = [
            f"{c} as {dict(zip(of.classes, row, strict=True))}"
            for c, row in zip(of.classes, figures["confusion"], strict=True)
        ]
        bins = ", ".join(f"{sure:.2f}: {right:.2f} ({count})" for sure, right, count in figures["reliability"])
        print(f"\n{name}: {'; '.join(rows)}. Confidence: share right (signals): {bins}.")


# --- a model of another law -------------------------------------------------------------------------------------------


def training_signals(scene: Scene, law: str, n_signals: int) -> Iterator[Batch]:
    """Yield signals of the scene with pulses of another law at the same restitutions."""
    if law == FAMILY:
        yield from synthesise(scene, n_signals, TRAINING_SEED)
        return
    drawn = [draw(scene, TRAINING_SEED, block) for block in range(-(-n_signals // 256))]
    names = ("density", "youngs_modulus", "poisson_ratio", "radius", "restitution", "drop_height", "velocity")
    rocks = {name: np.concatenate([of.parameters[name] for of in drawn])[:n_signals] for name in names}
    labels = np.concatenate([of.labels for of in drawn])[:n_signals]
    yield from synthesise_given(scene, by_law(rocks, scene, law, rocks["radius"]), labels, rocks, TRAINING_SEED)


def retrained_table(kinds: dict[str, SolvedImpacts], scene: Scene, model: Model, sizes: int, n_signals: int) -> None:
    """Print the performance of models trained on either law on all three kinds of pulses."""
    print("| trained on | pulses | accuracy | log loss |\n|---|---|---|---|")
    for law in (FAMILY, VISCOELASTIC):
        own = train(training_signals(scene, law, n_signals), features=model.features, family=model.family).model
        for name, impacts in kinds.items():
            of = answers(own, signals(impacts, scene, sizes), len(impacts))
            print(f"| {law} | {name} | {of.hits.mean():.4f} | {of.losses.mean():.4f} |")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="a model file; else the shipped default model")
    parser.add_argument("--impacts", type=Path, default=None, help="else datasets/finite_element.npz")
    parser.add_argument("--sizes", type=int, default=8, help="how often sizes and noise are drawn")
    parser.add_argument("--elastic", type=int, default=0, metavar="N", help="rocks to solve again without loss")
    parser.add_argument("--finer", type=int, default=0, metavar="N", help="rocks to solve again on a finer mesh")
    parser.add_argument("--retrained", type=int, default=0, metavar="N", help="signals to train models of each law")
    arguments = parser.parse_args()
    solved = SolvedImpacts.load(arguments.impacts or shipped.path_of("datasets", shipped.FINITE_ELEMENT_IMPACTS))
    model = Model.load(arguments.model or shipped.path_of("models", shipped.DEFAULT_MODEL))
    scene = load_scene(shipped.scene_path(solved.made["scene"]))
    kinds = all_three(solved, scene)
    print(f"{len(solved)} impacts, {arguments.sizes} sizes each, {scene.sampling.sampling_rate / 1e3:g} kHz.\n")
    physics_table(kinds)
    for noise in (scene.sensor.relative_noise, 10 * scene.sensor.relative_noise):
        print(f"\n**{noise:.0%} of noise**\n")
        heard = varied(scene, relative_noise=noise)
        found = {name: answers(model, signals(of, heard, arguments.sizes), len(of)) for name, of in kinds.items()}
        identification_table(found, model)
        confusion_table(found)
    print("\n**The family fitted to them, without noise**\n")
    shape_table(kinds | ({ELASTIC: without_loss(solved, arguments.elastic)} if arguments.elastic else {}))
    if arguments.finer:
        print("\n**Solved again on a finer mesh**\n")
        finer_table(solved, arguments.finer)
    if arguments.retrained:
        print(f"\n**Models trained on {arguments.retrained} signals, 1 % of noise**\n")
        retrained_table(kinds, scene, model, arguments.sizes, arguments.retrained)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()

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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from cgid import shipped
from cgid.identification.estimation import Estimates, estimate
from cgid.identification.metrics import evaluate
from cgid.identification.model import Model
from cgid.identification.rows import measure
from cgid.identification.training import train
from cgid.measure.template import curve
from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Sphere, Viscoelastic, dissipative_constant
from cgid.physics.materials import STEEL, Material
from cgid.physics.sampled import SampledPulses, shares_of_contact, smoothed
from cgid.scene import Scene, load_scene, synthesise, synthesise_given, varied
from cgid.scene.given_pulses import SolvedImpacts
from cgid.scene.impacts import draw
from cgid.signals import Batch
from studies.finite_element import ElasticPlate, FiniteElementImpact, History

ELASTIC = "finite elements without loss"
FINITE_ELEMENTS, VISCOELASTIC, FAMILY = "finite elements", "Kuwabara-Kono", "Hunt-Crossley (the family)"
#: Points of a pulse.
POINTS = 192
#: Classes of restitution in the tables of shape.
EDGES = (0.1, 0.25, 0.35, 0.45, 0.55, 0.65, 1.0)
#: Samples of a contact in the fit without noise, and the noise that the fit assumes, relative to the peak.
SAMPLES, NO_NOISE = 400, 1e-3
#: Elements over the contact radius and steps over Hertz's duration; the stored impacts have 12 and 250.
FINER_ELEMENTS, FINER_STEPS = 28, 1000
SEED, TRAINING_SEED = 3_000_017, 4_000_037
RESAMPLINGS = 2000


# --- the rocks: by impact laws, and solved again on other meshes or without loss ---


def sphere_of(rocks: Mapping[str, np.ndarray], radius: float | np.ndarray = 1.0) -> Sphere:
    """Return rocks as spheres."""
    names = ("density", "youngs_modulus", "poisson_ratio")
    return Sphere(material=Material(**{name: rocks[name] for name in names}), radius=radius)


def by_law(rocks: Mapping[str, np.ndarray], scene: Scene, law: str, radius: float | np.ndarray = 1.0) -> SampledPulses:
    """Return the pulses of rocks by a law, each with its restitution."""
    common = {
        "sphere": sphere_of(rocks, radius),
        "target": HalfSpace(material=scene.impact.target.material),
        "velocity": rocks["velocity"],
        "stiffness": scene.impact.stiffness,
    }
    dissipation = HuntCrossley(restitution=rocks["restitution"])
    if law == VISCOELASTIC:
        constant = dissipative_constant(rocks["restitution"], Impact(dissipation=Elastic(), **common))
        dissipation = Viscoelastic(dissipative_constant=constant)
    impact = Impact(dissipation=dissipation, **common)
    shares = shares_of_contact(POINTS)
    forces = impact.force(shares * impact.contact_duration[:, None])
    forces[:, -1] = 0.0  # rounding may put it just inside the contact
    return SampledPulses(shares=shares, forces=forces, contact_duration=impact.contact_duration)


def solved_again(solved: SolvedImpacts, row: int, elements: int, steps: int | None = None) -> History:
    """Solve one impact again: in implicit steps, this many over Hertz's duration, or explicitly without loss."""
    rock = {name: float(values[row]) for name, values in solved.columns.items()}
    velocity, steel = rock["velocity"], HalfSpace(material=STEEL)
    law = Impact(sphere=sphere_of(rock), target=steel, velocity=velocity, stiffness="hertz", dissipation=Elastic())
    contact_radius = float(np.sqrt(law.peak_displacement))
    plate = ElasticPlate(
        material=STEEL,
        thickness=solved.made["target_thickness"] * contact_radius,
        radius=solved.made["target_radius"] * contact_radius,
        lower_face=solved.made["lower_face"],
    )
    common = {"sphere": sphere_of(rock), "plate": plate, "velocity": velocity, "elements": elements}
    if steps is None:
        return FiniteElementImpact(**common).run()
    step = float(law.contact_duration) / steps
    return FiniteElementImpact(
        **common, retardation_time=rock["retardation_time"], method="implicit", time_step=step
    ).run()


def extreme_rocks(solved: SolvedImpacts, n: int) -> list[int]:
    """Return n rows: the hardest, softest, liveliest and most damped rock, then others from the first on."""
    modulus, restitution = solved.columns["youngs_modulus"], solved.columns["restitution"]
    rows = [np.argmax(modulus), np.argmin(modulus), np.argmax(restitution), np.argmin(restitution)]
    more = max(n - len(rows), 0)
    return [int(row) for row in (*rows, *(np.arange(more) * len(solved) // max(more, 1)))][:n]


def without_loss(solved: SolvedImpacts, n: int) -> SolvedImpacts:
    """Solve n of the rocks again as elastic spheres, by explicit steps."""
    rows = np.linspace(0, len(solved) - 1, n).astype(int)
    shares = shares_of_contact(POINTS)
    courses = [solved_again(solved, row, elements=14) for row in rows]
    forces = [smoothed(c.times, c.contact_force.samples, c.contact_duration, shares) for c in courses]
    durations = np.array([c.contact_duration for c in courses])
    columns = {name: values[rows] for name, values in solved.columns.items()}
    return replace(
        solved,
        pulses=SampledPulses(shares=shares, forces=np.array(forces), contact_duration=durations),
        labels=solved.labels[rows],
        columns=columns | {"restitution": np.array([c.restitution for c in courses])},
    )


def all_three(solved: SolvedImpacts, scene: Scene) -> dict[str, SolvedImpacts]:
    """Return the impacts as solved, and the same impacts by the two laws."""
    by = {law: replace(solved, pulses=by_law(solved.columns, scene, law)) for law in (VISCOELASTIC, FAMILY)}
    return {FINITE_ELEMENTS: solved} | by


# --- shapes, compared with the fitted family, the laws and finer meshes ---


def without_noise(pulses: SampledPulses) -> tuple[np.ndarray, float]:
    """Return frames of pulses of equal duration (it has no effect) and peak 1, and their sampling rate."""
    alike = pulses.stretched(1 / pulses.peak_force, 1 / pulses.contact_duration)
    frames = np.zeros((len(pulses), 4 * SAMPLES))
    alike.add_to_frames(frames, float(SAMPLES), np.full(len(pulses), 1.0))
    return frames, float(SAMPLES)


def family_curve(found: Estimates, shape: tuple[int, ...], rate: float) -> np.ndarray:
    """Return the fitted pulses on the samples of the frames."""
    times = np.arange(shape[1]) / rate
    share = (times - found.onset[:, None]) / found.contact_duration[:, None]
    return found.peak[:, None] * curve(share, np.log(found.restitution))


@dataclass(frozen=True)
class Fits:
    """The family's best pulse for each noiseless pulse; errors are relative, except for `restitution`."""

    explained: np.ndarray
    rms: np.ndarray
    largest: np.ndarray
    peak: np.ndarray
    duration: np.ndarray
    restitution: np.ndarray


def fits(impacts: SolvedImpacts) -> Fits:
    """Return how well the family's best pulses fit the impacts during contact."""
    frames, rate = without_noise(impacts.pulses)
    found = estimate(frames, rate, pre_trigger=SAMPLES // 2, noise=NO_NOISE)
    inside = slice(SAMPLES, 2 * SAMPLES + 1)
    truth = frames[:, inside]
    error = family_curve(found, frames.shape, rate)[:, inside] - truth
    spread = truth - truth.mean(axis=1, keepdims=True)
    return Fits(
        explained=1 - np.sum(error**2, axis=1) / np.sum(spread**2, axis=1),
        rms=np.sqrt(np.mean(error**2, axis=1)),
        largest=np.abs(error).max(axis=1),
        peak=found.peak - 1,
        duration=found.contact_duration - 1,
        restitution=found.restitution - impacts.columns["restitution"],
    )


def shape_table(kinds: dict[str, SolvedImpacts]) -> None:
    """Print the explained share of the shape, and the errors of numbers read off the fit, by restitution."""
    print("| pulses | restitution | impacts | explained, mean | least | rms / peak | largest / peak | ", end="")
    print("read off: restitution | peak | duration |\n|---|---|---|---|---|---|---|---|---|---|")
    for name, impacts in kinds.items():
        found, truth = fits(impacts), impacts.columns["restitution"]
        for low, high in [(EDGES[0], EDGES[-1]), *pairwise(EDGES)]:
            rows = (truth >= low) & (truth < high)
            if not rows.any():
                continue
            off, explained = found.restitution[rows], found.explained[rows]
            print(
                f"| {name} | {low:g} to {high:g} | {rows.sum()} | {explained.mean():.5f} | {explained.min():.5f} | "
                f"{found.rms[rows].mean():.4f} | {found.largest[rows].mean():.4f} | "
                f"{off.mean():+.4f} ({off.std():.4f}) | {found.peak[rows].mean():+.4f} | "
                f"{found.duration[rows].mean():+.4f} |"
            )


def physics_table(kinds: dict[str, SolvedImpacts]) -> None:
    """Print the solved impacts against the laws at equal restitution, with nothing fitted: mean (deviation)."""
    print("| finite elements over | peak force | contact duration | impulse over peak | impulse | explained |")
    print("|---|---|---|---|---|---|")
    solved = kinds[FINITE_ELEMENTS].pulses
    times = np.linspace(0, 1, SAMPLES) * solved.contact_duration[:, None]
    truth = solved.force(times)
    spread = truth - truth.mean(axis=1, keepdims=True)
    for name in (VISCOELASTIC, FAMILY):
        law = kinds[name].pulses
        columns = [
            solved.peak_force / law.peak_force,
            solved.contact_duration / law.contact_duration,
            solved.impulse / solved.peak_force / (law.impulse / law.peak_force),
            solved.impulse / law.impulse,
            1 - np.sum((law.force(times) - truth) ** 2, axis=1) / np.sum(spread**2, axis=1),
        ]
        print(f"| {name} | " + " | ".join(f"{column.mean():.4f} ({column.std():.4f})" for column in columns) + " |")


def finer_table(solved: SolvedImpacts, n: int) -> None:
    """Print the differences of n stored time series from those of a finer mesh with shorter steps."""
    print("| row | modulus [GPa] | restitution | rms / peak | largest / peak | restitution, stored minus finer |")
    print("|---|---|---|---|---|---|")
    for row in extreme_rocks(solved, n):
        finer = solved_again(solved, row, FINER_ELEMENTS, FINER_STEPS)
        times = np.linspace(0, 1.02, SAMPLES) * finer.contact_duration
        shares = np.clip(times / finer.contact_duration, 0, 1)
        truth = smoothed(finer.times, finer.contact_force.samples, finer.contact_duration, shares, solved.made["knots"])
        error = (solved.pulses.taken(slice(row, row + 1)).force(times)[0] - truth) / truth.max()
        restitution = solved.columns["restitution"][row]
        print(
            f"| {row} | {solved.columns['youngs_modulus'][row] / 1e9:.2f} | {restitution:.3f} | "
            f"{np.sqrt(np.mean(error**2)):.5f} | {np.abs(error).max():.5f} | {restitution - finer.restitution:+.5f} |",
            flush=True,
        )


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

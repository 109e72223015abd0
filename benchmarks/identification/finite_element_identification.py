"""Performance of a model on impacts of another physics, and the share of them that the pulse family explains.

    python benchmarks/identification/finite_element_identification.py [MODEL.npz] [--sizes 8]

The impacts of `datasets/finite_element.npz` are rocks of the reference scene, solved by finite elements. They are
compared with the same rocks, falls and restitutions by the law of Kuwabara and Kono (a viscoelastic sphere, as in the
elements, but with Hertz's contact) and by that of Hunt and Crossley. The scene draws sizes, noise and touch `--sizes`
times, equal for all three. Intervals resample rocks, which are fewer than signals.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.training import measure
from cgid.identification.training.metrics import evaluate
from cgid.measure.fit.template import curve
from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Material, Sphere, Viscoelastic
from cgid.physics.contact.sampled import SampledPulses, shares_of_contact
from cgid.scene import Scene, load_scene, varied
from studies.finite_element.solved import SolvedImpacts
from studies.impactor.estimation import estimate
from studies.paper.sensitivity import dissipative_constant

FINITE_ELEMENTS, VISCOELASTIC, FAMILY = "finite elements", "Kuwabara-Kono", "Hunt-Crossley (the family)"
#: Samples of a contact in the fit without noise, and the noise that the fit assumes, relative to the peak.
SAMPLES, NO_NOISE = 400, 1e-3
SEED = 3_000_017


def by_law(solved: SolvedImpacts, scene: Scene, law: str) -> SolvedImpacts:
    """Return the pulses of the same rocks by a law, each with its restitution."""
    rocks = solved.columns
    material = Material(**{name: rocks[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    elastic = Impact(
        sphere=Sphere(material=material, radius=1.0),
        target=HalfSpace(material=scene.impact.target.material),
        velocity=rocks["velocity"],
        stiffness=scene.impact.stiffness,
        dissipation=Elastic(),
    )
    loss: HuntCrossley | Viscoelastic = HuntCrossley(restitution=rocks["restitution"])
    if law == VISCOELASTIC:
        loss = Viscoelastic(dissipative_constant=dissipative_constant(rocks["restitution"], elastic))
    impact, shares = replace(elastic, dissipation=loss), shares_of_contact(192)
    forces = impact.force(shares * impact.contact_duration[:, None])
    forces[:, -1] = 0.0  # rounding may put it just inside the contact
    pulses = SampledPulses(shares=shares, forces=forces, contact_duration=impact.contact_duration)
    return replace(solved, pulses=pulses)


def fitted(impacts: SolvedImpacts) -> tuple[np.ndarray, np.ndarray]:
    """Return the explained share of each noiseless pulse, and how much its restitution is read off too high."""
    pulses = impacts.pulses.stretched(1 / impacts.pulses.peak_force, 1 / impacts.pulses.contact_duration)
    frames = np.zeros((len(pulses), 4 * SAMPLES))
    pulses.add_to_frames(frames, float(SAMPLES), np.full(len(pulses), 1.0))
    found = estimate(frames, float(SAMPLES), pre_trigger=SAMPLES // 2, noise=NO_NOISE)
    share = (np.arange(4 * SAMPLES) / SAMPLES - found.onset[:, None]) / found.contact_duration[:, None]
    inside = slice(SAMPLES, 2 * SAMPLES + 1)
    fit = (found.peak[:, None] * curve(share, np.log(found.restitution)))[:, inside]
    truth = frames[:, inside]
    spread = ((truth - truth.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    return 1 - ((fit - truth) ** 2).sum(axis=1) / spread, found.restitution - impacts.columns["restitution"]


def row(name: str, impacts: SolvedImpacts, scene: Scene, model: StoredModel, sizes: int) -> str:
    """Return a model's figures on the signals of all sizes, as a line of the table."""
    measured = measure(
        (batch for size in range(sizes) for batch in impacts.signals(scene, SEED + size)), model.measured
    )
    if measured.left_out:
        raise SystemExit(f"{measured.left_out} signals cannot be measured")
    inputs, guards = np.split(measured.features, [len(model.features)], axis=1)
    probabilities = model.probabilities(inputs)
    figures = evaluate(measured.labels, probabilities, model.labels)
    hits = (np.array(model.labels)[probabilities.argmax(axis=1)] == measured.labels).reshape(sizes, -1).mean(axis=0)
    draws = np.random.default_rng(0).integers(0, hits.size, (2000, hits.size))
    low, high = np.quantile(hits[draws].mean(axis=1), [0.025, 0.975])
    shown = (figures[key] for key in ("log_loss", "brier_score", "expected_calibration_error"))
    unknown = (model.novelty(inputs, guards) > 1).mean()
    cells = (f"{value:.4f}" for value in (*shown, unknown))
    return f"| {name} | {hits.mean():.4f} ({low:.3f} to {high:.3f}) | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="a model file; else the shipped default model")
    parser.add_argument("--sizes", type=int, default=8, help="how often sizes and noise are drawn")
    arguments = parser.parse_args()
    solved = SolvedImpacts.load(shipped.path_of("datasets", "finite_element.npz"))
    model = StoredModel.load(arguments.model or shipped.path_of("models", shipped.DEFAULT_MODEL))
    scene = load_scene(shipped.scene_path(solved.made["scene"]))
    kinds = {FINITE_ELEMENTS: solved} | {law: by_law(solved, scene, law) for law in (VISCOELASTIC, FAMILY)}
    for noise in (scene.sensor.relative_noise, 10 * scene.sensor.relative_noise):
        print(f"\n**{noise:.0%} of noise**\n\n| pulses | accuracy | log loss | Brier | calibration error | unknown |")
        print("|---|---|---|---|---|---|")
        for name, impacts in kinds.items():
            print(row(name, impacts, varied(scene, relative_noise=noise), model, arguments.sizes), flush=True)
    print("\n**The family fitted to them, without noise**\n")
    print("| pulses | explained, mean | least | restitution too high by |\n|---|---|---|---|")
    for name, impacts in kinds.items():
        explained, off = fitted(impacts)
        print(f"| {name} | {explained.mean():.5f} | {explained.min():.5f} | {off.mean():+.4f} ({off.std():.4f}) |")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()

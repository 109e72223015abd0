"""How near the model comes to what can be known without noise, and what shuffled labels score.

    python benchmarks/accuracy.py [SCENE] [--signals 100000]

Every line is judged on the same specimens held out. The noise-free limit is a gradient boosting on the exact peak,
duration and restitution of the same impacts, which no measurement gives; the Bayes limit lies at or above it.
"""

import argparse
import time

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier

from cgid import shipped
from cgid.features import FEATURES, extract_array
from cgid.identification.classifier import FAMILIES, ImpactClassifier
from cgid.identification.metrics import evaluate
from cgid.identification.training import DEFAULT_FEATURES, hold_out
from cgid.scene import load_scene, synthesise


def main() -> None:
    """Synthesise once, train several ways, print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="reference")
    parser.add_argument("--signals", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=11)
    arguments = parser.parse_args()
    scene = load_scene(shipped.scene_path(arguments.scene))
    rows, exact, labels, specimen = [], [], [], []
    for batch in synthesise(scene, arguments.signals, arguments.seed):
        rows.append(
            extract_array(
                batch.signals, batch.sampling_rate, DEFAULT_FEATURES, pre_trigger=batch.pre_trigger, invalid="nan"
            )
        )
        known = ("peak_force", "contact_duration", "restitution")
        exact.append(np.stack([batch.parameters[name] for name in known], axis=1))
        labels.append(batch.labels)
        specimen.append(batch.specimen)
    features, truth = np.concatenate(rows), np.concatenate(labels)
    limit, sound = np.log(np.concatenate(exact)), np.isfinite(features).all(axis=1)
    features, truth, limit = features[sound], truth[sound], limit[sound]
    test = hold_out(truth, np.concatenate(specimen)[sound])
    classes = tuple(np.unique(truth).tolist())
    print(f"Scene `{scene.name}`, {int((~test).sum())} impacts to train, {int(test.sum())} held out, ", end="")
    print(f"{int((~sound).sum())} left out.\n")
    print("| | accuracy | 95 % interval | Brier | calibration error | fit [s] |\n|---|---|---|---|---|---|")

    linear = tuple(k for k, name in enumerate(DEFAULT_FEATURES) if FEATURES[name].unit == "1")

    def line(name: str, estimator: object, inputs: np.ndarray, target: np.ndarray) -> None:
        start = time.perf_counter()
        estimator.fit(inputs[~test], target[~test])
        seconds = time.perf_counter() - start
        m = evaluate(target[test], estimator.predict_proba(inputs[test]), classes)
        low, high = m["accuracy_interval_95"]
        print(
            f"| {name} | {m['accuracy']:.4f} | {low:.4f} to {high:.4f} | {m['brier_score']:.4f} | "
            f"{m['expected_calibration_error']:.4f} | {seconds:.1f} |"
        )

    boosting = HistGradientBoostingClassifier(max_iter=300, max_leaf_nodes=31, learning_rate=0.06, random_state=0)
    line("noise-free limit: exact peak, duration, restitution", boosting, limit, truth)
    line("exact peak and duration alone", boosting, limit[:, :2], truth)
    for family in FAMILIES:
        line(f"cgid, {family}, measured under noise", ImpactClassifier(family, linear=linear), features, truth)
    shuffled = np.random.default_rng(0).permutation(truth)
    line("shuffled labels", ImpactClassifier(linear=linear), features, shuffled)


if __name__ == "__main__":
    main()

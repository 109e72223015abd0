"""Accuracy of the models against the ceiling of a scene, and with shuffled labels.

    python benchmarks/identification/accuracy.py [SCENE] [--signals 100000] [--test 20000]

Training and test signals have different seeds, so they share no block of random numbers. All lines use the same test
signals. The difference is the paired number of right answers, ceiling - model, with its standard error; no model can
exceed the ceiling except by chance. An impact that cannot be measured counts as a guess.
"""

import argparse
import time

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier
from threadpoolctl import threadpool_limits

from cgid import shipped
from cgid.identification.training.classifier import FAMILIES, ImpactClassifier
from cgid.identification.training.metrics import evaluate
from cgid.identification.training.rows import linear_columns, measure
from cgid.scene import Scene, load_scene, synthesise
from studies.ceilings.limit import ceiling

TEST_SEED = 1_000_003
EXACT = ("peak_force", "contact_duration", "restitution")


def exact(scene: Scene, n: int, seed: int) -> np.ndarray:
    return np.concatenate(
        [np.log(np.stack([b.parameters[name] for name in EXACT], axis=1)) for b in synthesise(scene, n, seed)]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="reference")
    parser.add_argument("--signals", type=int, default=100_000)
    parser.add_argument("--test", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=11)
    arguments = parser.parse_args()
    scene = load_scene(shipped.scene_path(arguments.scene))
    n, n_test, seed = arguments.signals, arguments.test, arguments.seed
    train, test = (measure(synthesise(scene, count, own)) for count, own in ((n, seed), (n_test, TEST_SEED)))
    if train.left_out or test.left_out:
        raise SystemExit(f"{train.left_out} and {test.left_out} impacts cannot be measured; choose another scene")
    start = time.perf_counter()
    best = ceiling(scene, n_test, TEST_SEED)
    seconds = time.perf_counter() - start
    print(f"Scene `{scene.name}`, {n} impacts to train, {n_test} others to judge.\n")
    print("| | accuracy | below the ceiling | Brier | calibration error | training [s] |\n|---|---|---|---|---|---|")
    print(
        f"| ceiling (Bayes' rule; expected {best.accuracy:.4f} ± {best.accuracy_error:.4f}) | "
        f"{best.hits.mean():.4f} | - | {best.brier_score:.4f} | - | {seconds:.0f} |"
    )

    def line(name: str, estimator: object, rows: np.ndarray, labels: np.ndarray, judged: np.ndarray) -> None:
        start = time.perf_counter()
        with threadpool_limits(1):
            estimator.fit(rows, labels)
        seconds = time.perf_counter() - start
        probabilities = estimator.predict_proba(judged)
        m = evaluate(test.labels, probabilities, best.labels)
        hits = np.array(best.labels)[probabilities.argmax(axis=1)] == test.labels
        difference = best.hits.astype(float) - hits
        error = difference.std(ddof=1) / np.sqrt(n_test)
        print(
            f"| {name} | {m['accuracy']:.4f} | {difference.mean():+.4f} ± {error:.4f} | {m['brier_score']:.4f} | "
            f"{m['expected_calibration_error']:.4f} | {seconds:.0f} |",
            flush=True,
        )

    boosting = HistGradientBoostingClassifier(max_iter=300, max_leaf_nodes=31, learning_rate=0.06, random_state=0)
    clean = [exact(scene, count, own) for count, own in ((n, seed), (n_test, TEST_SEED))]
    line("noise-free: boosting on exact peak, duration, restitution", boosting, clean[0], train.labels, clean[1])
    linear = linear_columns(train.names)
    for family in FAMILIES:
        line(f"cgid, {family}", ImpactClassifier(family, linear=linear), train.features, train.labels, test.features)
    # Also judged on shuffled labels: a direction chosen by noise may lie along the true one, or against it.
    generator = np.random.default_rng(0)
    guess = ImpactClassifier(linear=linear).fit(train.features, generator.permutation(train.labels))
    hits = guess.predict(test.features) == generator.permutation(test.labels)
    print(f"| permuted labels | {hits.mean():.4f} ± {hits.std() / np.sqrt(n_test):.4f} | - | - | - | - |")


if __name__ == "__main__":
    main()

"""How sure models of few recordings are, and how often right, on further recordings that differ from these.

    python benchmarks/identification/few_groups.py [--sets 400] [--first 1000]

A set has 2 to 5 materials with 2 to 10 recordings each, of 20 levels in 20 or 60 windows. Materials, what the windows
of a recording have in common, and its windows are normal (the second in half of the sets Student's t with 4 degrees of
freedom), with covariances, distances and spreads drawn anew for each set. `cgid` trains on it as on recordings, with
temperature T^(1 - part / n) for n recordings of a material, where T is the best one for recordings that are left out in
turn. It is judged on 40 further recordings: confidence minus what is right, and the log loss.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from cgid.identification.model.families import softmax
from cgid.identification.training import grouped
from cgid.identification.training.grouped import Candidate, TrainingSet, choose_candidate
from cgid.identification.training.rows import Rows, sets_for

Floats = NDArray[np.float64]
PARTS, NUMBERS, N_FURTHER = (1.0, 0.5, 0.0), (2, 3, 5, 10), 40
NAMES = sets_for("vibration", 44_100.0)["third octaves, level-free"][:20]
CANDIDATE = Candidate(name="levels", features=NAMES, family="linear")


class Materials:
    """Materials whose recordings differ."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng, n = rng, len(NAMES)
        self.n_materials, self.n = int(rng.choice([2, 2, 3, 5])), int(rng.choice(NUMBERS))
        self._means = rng.uniform(1.0, 4.0) * rng.standard_normal((self.n_materials, n)) * 2 / np.sqrt(n)
        self._spread, self._n_windows = rng.choice([0.2, 0.5, 1.0, 1.5]), int(rng.choice([20, 60]))
        self._is_heavy = rng.random() < 0.5
        self._between, self._within = self._shape(), self._shape()

    def _shape(self) -> Floats:
        """Return a matrix that gives standard normal numbers a covariance drawn at random."""
        powers = np.exp(self._rng.normal(0.0, 1.0, len(NAMES)))
        turned = np.linalg.qr(self._rng.standard_normal((len(NAMES), len(NAMES))))[0]
        return np.asarray(turned * np.sqrt(powers / powers.mean()))

    def recordings(self, n: int) -> Rows:
        """Return the windows of n recordings of each material."""
        rng, features, labels = self._rng, [], []
        for material, mean in enumerate(self._means):
            for _ in range(n):
                size = self._spread * (abs(rng.standard_t(4)) / np.sqrt(2) if self._is_heavy else 1.0)
                common = mean + size * self._between @ rng.standard_normal(len(NAMES))
                features.append(common + rng.standard_normal((self._n_windows, len(NAMES))) @ self._within.T)
                labels.append(f"material {material}")
        group = np.repeat(np.arange(len(labels)), self._n_windows)
        return Rows(
            names=NAMES, features=np.concatenate(features), labels=np.repeat(labels, self._n_windows), group=group
        )


def judged(seed: int) -> tuple[int, list[tuple[float, float]]]:
    """Return recordings a material, and confidence minus right and the log loss for each of `PARTS`."""
    materials = Materials(np.random.default_rng(seed))
    own, further = (materials.recordings(n) for n in (materials.n, max(N_FURTHER // materials.n_materials, 8)))
    training = TrainingSet(rows=own, candidates=(CANDIDATE,), weights=None, seed=0)
    classifier = grouped._fitted(training, CANDIDATE)
    scores = classifier.decision_function(further.features)
    scores = np.stack([np.zeros(len(scores)), scores], axis=1) if scores.ndim == 1 else scores
    truth, rows = np.unique(further.labels, return_inverse=True)[1], np.arange(len(scores))
    found = []
    for part in PARTS:
        grouped._KNOWN_OF_FEW = part
        told = softmax(scores / choose_candidate(training).temperature)
        excess = told.max(axis=1).mean() - np.mean(told.argmax(axis=1) == truth)
        found.append((float(excess), float(-np.log(np.maximum(told[rows, truth], 1e-300)).mean())))
    return materials.n, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first set; the part was chosen by 1000")
    given = parser.parse_args()
    sets = [judged(given.first + k) for k in range(given.sets)]
    print("| recordings | part | sure - right | its RMS | within .05 | above .05 | log loss |")
    print("|---" * 7 + "|")
    for n in (*NUMBERS, 0):
        for k, part in enumerate(PARTS):
            excess, loss = np.array([found[k] for number, found in sets if n in (0, number)]).T
            print(
                f"| {n or 'all'} | {part:g} | {excess.mean():+.3f} | {np.sqrt(np.mean(excess**2)):.3f} | "
                f"{np.mean(np.abs(excess) <= 0.05):.2f} | {np.mean(excess > 0.05):.2f} | {loss.mean():.3f} |"
            )


if __name__ == "__main__":
    main()

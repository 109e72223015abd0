"""Split conformal prediction: sets of labels with guaranteed coverage for any model.

Vovk, Gammerman & Shafer 2005; Lei et al. 2018. The score of a label is 1 minus its probability. A set contains the
labels whose score is at most the ceil((n + 1) coverage)-th smallest true-label score of n calibration impacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue

#: The coverages in a model card.
COVERAGES = (0.80, 0.85, 0.90, 0.95, 0.99)


@dataclass(frozen=True, eq=False, repr=False)
class Conformal:
    """Scores of the true labels of the calibration impacts."""

    scores: Floats  # in [0, 1], ascending within each label
    labels: NDArray[np.int_]  # numbers of the true labels, ascending
    n_labels: int

    def __post_init__(self) -> None:
        scores, labels = self.scores, self.labels
        if scores.ndim != 1 or scores.shape != labels.shape or not len(scores):
            raise BadData(f"calibration scores and labels must be two rows, got shapes {scores.shape}, {labels.shape}")
        if labels.dtype.kind != "i" or (labels < 0).any() or (labels >= self.n_labels).any():
            raise BadData(f"calibration labels must be whole numbers between 0 and {self.n_labels - 1}")
        if scores.dtype.kind != "f" or not ((scores >= 0) & (scores <= 1)).all():
            raise BadData("calibration scores must be between 0 and 1")

    @classmethod
    def fit(cls, probabilities: Floats, truth: NDArray[np.intp]) -> Conformal:
        """Calibrate on probabilities (n, n_labels) and true label numbers of impacts exchangeable with future ones."""
        scores = 1.0 - probabilities[np.arange(len(truth)), truth]
        order = np.lexsort((scores, truth))
        return cls(scores[order], truth[order].astype(np.int32), probabilities.shape[1])

    def threshold(self, coverage: float) -> float:
        """Return the largest score of a label in a set."""
        if not 0 < coverage < 1:
            raise InvalidValue(f"coverage must be between 0 and 1 (exclusive), got {coverage:g}")
        n = len(self.scores)
        # Round first: in binary 100 x 0.07 is slightly above 7, and must not become 8.
        rank = math.ceil(round((n + 1) * coverage, 9))
        if rank > n:
            raise InvalidValue(
                f"coverage must be at most {n / (n + 1):.4g} with {n} calibration impacts, got {coverage:g}; ask for "
                "less, or train on more specimens"
            )
        return float(np.partition(self.scores, rank - 1)[rank - 1])

    def prediction_set(self, probabilities: Floats, coverage: float) -> NDArray[np.bool_]:
        """Return which labels belong to the set of each impact, (n_impacts, n_labels)."""
        return np.asarray(1.0 - probabilities <= self.threshold(coverage))

"""How good a model is on impacts it has not seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn import metrics

from cgid.identification.interval import wilson_interval
from cgid.validation import Floats

#: Bins of the reliability diagram.
_BINS = 10


def evaluate(
    labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...], n_independent: int | None = None
) -> dict[str, Any]:
    """Return the metrics of predictions, as plain numbers for JSON.

    Parameters
    ----------
    labels : ndarray of str, (n_impacts,)
        The truth.
    probabilities : ndarray, (n_impacts, n_classes)
    classes : tuple of str
    n_independent : int, optional
        How many of the impacts count for the interval: that of their specimens, where it is smaller.

    Returns
    -------
    dict
        accuracy and its 95 % interval (Wilson), recall of each class, Brier score (sum over the classes, so 0 to
        2), log loss, expected calibration error, area under the ROC curve, confusion (rows are the truth),
        reliability (mean confidence, accuracy and count of each bin).
    """
    names = np.array(classes)
    predicted = names[np.argmax(probabilities, axis=1)]
    hits = predicted == labels
    truth = (labels[:, None] == names[None]).astype(float)
    counted = len(hits) if n_independent is None else n_independent
    interval = wilson_interval(round(float(hits.mean()) * counted) / counted, counted)
    confusion = metrics.confusion_matrix(labels, predicted, labels=names)
    bins = reliability(probabilities.max(axis=1), hits)
    return {
        "n_impacts": len(labels),
        "accuracy": float(hits.mean()),
        "accuracy_interval_95": list(interval),
        "recall": {c: float(confusion[k, k] / max(confusion[k].sum(), 1)) for k, c in enumerate(classes)},
        "brier_score": float(np.mean(np.sum((probabilities - truth) ** 2, axis=1))),
        "log_loss": float(-np.mean(np.log(np.maximum(probabilities[truth > 0], 1e-300)))),
        "expected_calibration_error": float(sum(n * abs(c - a) for c, a, n in bins) / len(labels)),
        "roc_area": {c: float(metrics.roc_auc_score(truth[:, k], probabilities[:, k])) for k, c in enumerate(classes)},
        "confusion": confusion.tolist(),
        "reliability": bins,
    }


def reliability(confidence: Floats, hits: NDArray[np.bool_]) -> list[list[float]]:
    """Return mean confidence, accuracy and count of each bin of confidence that is not empty."""
    place = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    rows = []
    for k in range(_BINS):
        inside = place == k
        if inside.any():
            rows.append([float(confidence[inside].mean()), float(hits[inside].mean()), int(inside.sum())])
    return rows

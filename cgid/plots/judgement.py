"""How a model did, in pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.plots.figure import png, require_matplotlib
from cgid.validation import Floats


def judgement_pictures(
    labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...], metrics: dict[str, Any]
) -> dict[str, bytes]:
    """Return PNG pictures of how a model did: "confusion", "reliability" and "roc".

    Parameters
    ----------
    labels : ndarray of str, (n_impacts,)
        The truth.
    probabilities : ndarray, (n_impacts, n_classes)
    classes : tuple of str
    metrics : dict
        From `cgid.identification.metrics.evaluate`.
    """
    return {
        "confusion": _confusion(np.array(metrics["confusion"]), classes),
        "reliability": _reliability(metrics["reliability"]),
        "roc": _roc(labels, probabilities, classes),
    }


def _confusion(counts: NDArray[np.int_], classes: tuple[str, ...]) -> bytes:
    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        share = count / counts[row].sum()
        axes.text(column, row, f"{count}\n{share:.1%}", ha="center", va="center", color="w" if share > 0.5 else "k")
    axes.set(xticks=range(len(classes)), xticklabels=classes, xlabel="answer")
    axes.set(yticks=range(len(classes)), yticklabels=classes, ylabel="truth")
    return png(figure)


def _reliability(bins: list[list[float]]) -> bytes:
    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    confidence, accuracy, _ = zip(*bins, strict=True)
    axes.plot([0, 1], [0, 1], color="0.7", label="calibrated")
    axes.plot(confidence, accuracy, "o-", label="model")
    lowest = min(0.5, *confidence, *accuracy)
    axes.set(xlabel="probability of the answer", ylabel="share of right answers", xlim=(lowest, 1), ylim=(lowest, 1))
    axes.legend()
    return png(figure)


def _roc(labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...]) -> bytes:
    from sklearn.metrics import roc_curve

    figure = require_matplotlib()(figsize=(4.2, 3.8), layout="constrained")
    axes = figure.subplots()
    for column, label in enumerate(classes):
        wrong, right, _ = roc_curve(labels == label, probabilities[:, column])
        axes.plot(wrong, right, label=label)
    axes.plot([0, 1], [0, 1], color="0.7")
    axes.set(xlabel="share of the others taken for it", ylabel="share of it that is found")
    axes.legend()
    return png(figure)

"""Metrics of predictions: accuracy and its interval, calibration, prediction sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from sklearn import metrics

from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.model.conformal import COVERAGES, Conformal
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.prediction.vote import MIN_PROBABILITY, RunningVote

if TYPE_CHECKING:
    from cgid.identification.training.rows import Rows

#: Bins of the reliability diagram.
_BINS = 10
#: Durations of the evaluated running votes [s].
VOTE_TIMES = (0.5, 1.0)
#: Minimum number of groups with misses (or hits) from which to estimate how much groups differ.
MIN_GROUPS = 3


def evaluate(
    labels: NDArray[np.str_], probabilities: Floats, classes: tuple[str, ...], n_independent: int | None = None
) -> dict[str, Any]:
    """Return the metrics of predictions (n_impacts, n_classes) as plain numbers for JSON."""
    # The accuracy has a 95 % Wilson interval for `n_independent` trials, such as rocks. The Brier score is summed over
    # the classes (0 to 2); rows of the confusion are the truth; bins hold mean confidence, accuracy and count.
    names = np.array(classes)
    predicted = names[np.argmax(probabilities, axis=1)]
    is_correct = predicted == labels
    truth = (labels[:, None] == names[None]).astype(float)
    counted = len(is_correct) if n_independent is None else n_independent
    interval = wilson_interval(round(float(is_correct.mean()) * counted) / counted, counted)
    confusion = metrics.confusion_matrix(labels, predicted, labels=names)
    confidence = probabilities.max(axis=1)
    bins = reliability(confidence, is_correct)
    return {
        "n_impacts": len(labels),
        "accuracy": float(is_correct.mean()),
        "accuracy_interval_95": list(interval),
        "recall": {c: float(confusion[k, k] / max(confusion[k].sum(), 1)) for k, c in enumerate(classes)},
        "brier_score": float(np.mean(np.sum((probabilities - truth) ** 2, axis=1))),
        "log_loss": float(-np.mean(np.log(np.maximum(probabilities[truth > 0], 1e-300)))),
        "expected_calibration_error": float(sum(n * abs(c - a) for c, a, n in bins) / len(labels)),
        "calibration_error_by_chance": calibration_error_by_chance(confidence),
        "roc_area": {c: float(metrics.roc_auc_score(truth[:, k], probabilities[:, k])) for k, c in enumerate(classes)},
        "confusion": confusion.tolist(),
        "reliability": bins,
    }


def reliability(confidence: Floats, hits: NDArray[np.bool_]) -> list[list[float]]:
    """Return mean confidence, accuracy and count of each non-empty bin of confidence."""
    bin_of = _bin(confidence)
    rows = []
    for k in range(_BINS):
        inside = bin_of == k
        if inside.any():
            rows.append([float(confidence[inside].mean()), float(hits[inside].mean()), int(inside.sum())])
    return rows


def calibration_error_by_chance(confidence: Floats) -> float:
    """Return the expected calibration error of perfectly calibrated predictions."""
    # The number of correct predictions in a bin is normal with variance sum p (1 - p), and E|x| is sqrt(2 / pi) std.
    variances = np.bincount(_bin(confidence), confidence * (1 - confidence), _BINS)
    return float(np.sqrt(2 / np.pi * variances).sum() / len(confidence))


def evaluate_sets(
    labels: NDArray[np.str_],
    probabilities: Floats,
    classes: tuple[str, ...],
    conformal: Conformal,
    coverages: tuple[float, ...] = COVERAGES,
) -> list[dict[str, Any]]:
    """Return coverage, size and accuracy of prediction sets, one row per attainable coverage, for JSON."""
    truth = labels[:, None] == np.array(classes)[None]
    rows: list[dict[str, Any]] = []
    for coverage in coverages:
        try:
            sets = conformal.prediction_set(probabilities, coverage)
        except InvalidValue:  # too few calibration impacts
            continue
        is_covered, size = (sets & truth).any(axis=1), sets.sum(axis=1)
        rows.append(
            {
                "coverage": coverage,
                "achieved": float(is_covered.mean()),
                "achieved_of": {c: float(is_covered[truth[:, k]].mean()) for k, c in enumerate(classes)},
                "single": float((size == 1).mean()),
                "several": float((size > 1).mean()),
                "empty": float((size == 0).mean()),
                "accuracy_of_single": float(is_covered[size == 1].mean()) if (size == 1).any() else None,
            }
        )
    return rows


def _bin(confidence: Floats) -> NDArray[np.int_]:
    return np.asarray(np.minimum((confidence * _BINS).astype(int), _BINS - 1))


# -- dependent predictions --------------------------------------------------------------------------------


def clustered_interval(hits: NDArray[np.bool_], group: NDArray[np.integer]) -> tuple[float, float]:
    """Return the 95 % score interval of a hit rate for hits that are not independent within a group."""
    # The number of independent trials follows from the variance between groups (Korn & Graubard 1998). With fewer than
    # `MIN_GROUPS` that have all misses (or all hits), each group is one trial.
    share, (_, cluster) = float(hits.mean()), np.unique(group, return_inverse=True)
    n_groups = int(cluster.max()) + 1
    if n_groups < 2:
        return 0.0, 1.0
    variance = _clustered_variance(hits.astype(float) - share, cluster)
    trials = share * (1 - share) / variance if variance > 0 else 0.0
    trials *= (stats.norm.ppf(0.975) / stats.t.ppf(0.975, n_groups - 1)) ** 2
    if min(np.unique(cluster[hits]).size, np.unique(cluster[~hits]).size) < MIN_GROUPS:
        trials = 0.0
    low, high = wilson_interval(share, min(max(trials, n_groups), len(hits)))
    return max(float(low), 0.0), min(float(high), 1.0)


def evaluate_drawn(rows: Rows, probabilities: Floats, classes: Sequence[str]) -> dict[str, Any]:
    """Return how many of the impacts that were drawn at random are right; nothing if a table says of none that it was.

    An impact of several channels is one. "accuracy_interval_95" is for the recordings of the table; "of_others" for
    recordings like them, of which each is one trial, where there are several.
    """
    if not len(rows.chosen) or not (drawn := rows.chosen == "random").any():
        return {}
    rows, logs = rows[drawn], np.log(np.maximum(probabilities[drawn], MIN_PROBABILITY))
    _, first, rock = np.unique(rows.rock, return_index=True, return_inverse=True)
    votes = np.stack([np.bincount(rock, column) for column in logs.T], axis=1)
    is_right = np.array(classes)[np.argmax(votes, axis=1)] == rows.labels[first]
    n, recording = len(is_right), (rows.file if len(rows.file) else rows.group)[first]
    several = len(np.unique(recording)) > 1
    return {
        "n": n,
        "n_right": int(is_right.sum()),
        "accuracy": float(is_right.mean()),
        "accuracy_interval_95": list(wilson_interval(float(is_right.mean()), n)),
        "n_recordings": len(np.unique(recording)),
        "of_others": list(clustered_interval(is_right, recording)) if several else None,
    }


def drawn_text(drawn: Mapping[str, Any]) -> str:
    """Return the accuracy of impacts that were drawn at random.

    >>> drawn_text({"n": 48, "n_right": 40, "accuracy": 5 / 6, "accuracy_interval_95": [0.704, 0.913],
    ...             "n_recordings": 1, "of_others": None})
    'right on 40 of 48 impacts drawn at random: 83 % (70 to 91)'
    """
    low, high = (f"{100 * end:.0f}" for end in drawn["accuracy_interval_95"])
    text = f"right on {drawn['n_right']} of {counted(drawn['n'], 'impact')} drawn at random: "
    text += f"{100 * drawn['accuracy']:.0f} % ({low} to {high})"
    if drawn["of_others"] is None:
        return text
    low, high = (f"{100 * end:.0f}" for end in drawn["of_others"])
    return f"{text} in these {drawn['n_recordings']} recordings, ({low} to {high}) in others like them"


#: Minimum number of rows for a vote of a recording or interval; an impact on two channels is two rows.
MIN_VOTING = 3


def evaluate_recordings(rows: Rows, probabilities: Floats) -> dict[str, Any]:
    """Return the metrics of rows, complete recordings and running votes; their intervals count groups."""
    classes = np.unique(rows.labels)
    metrics = evaluate(rows.labels, probabilities, tuple(classes.tolist()))
    is_correct = classes[np.argmax(probabilities, axis=1)] == rows.labels
    metrics["accuracy_interval_95"] = list(clustered_interval(is_correct, rows.group))
    if drawn := evaluate_drawn(rows, probabilities, classes.tolist()):
        metrics["drawn"] = drawn
    if rows.kind == "window":
        metrics["running"] = [_running(rows, probabilities, time) for time in VOTE_TIMES]
    if len(rows.labels) < MIN_VOTING * len(rows.sources):  # intervals around single impacts
        return {**metrics, "prediction_sets": []}
    recordings = _recordings(rows, probabilities)
    voted = np.array([row["vote"] == row["label"] for row in recordings])
    owner = np.array([rows.groups.index(row["group"]) for row in recordings])
    metrics["recordings"] = {"n": len(voted), **_share(voted, owner), "rows": recordings}
    return {**metrics, "prediction_sets": []}


def _share(hits: NDArray[np.bool_], group: NDArray[np.integer]) -> dict[str, Any]:
    return {"accuracy": float(hits.mean()), "accuracy_interval_95": list(clustered_interval(hits, group))}


def _recordings(rows: Rows, probabilities: Floats) -> list[dict[str, Any]]:
    """Return the vote of each recording: the label with the largest mean log probability of its rows."""
    classes = np.unique(rows.labels)
    votes = []
    # Rocks of one file that were labelled one by one are one recording.
    few = np.bincount(rows.source, minlength=len(rows.sources))[rows.source] < MIN_VOTING
    of_file = np.where(few, len(rows.sources) + rows.file, rows.source) if len(rows.file) else rows.source
    units = np.unique(np.stack([of_file, np.unique(rows.labels, return_inverse=True)[1]]), axis=1, return_inverse=True)
    for unit in range(units[0].shape[1]):
        of_source = units[1].ravel() == unit
        source = rows.source[of_source][0]
        name = rows.files[units[0][0, unit] - len(rows.sources)][0] if few[of_source][0] else rows.sources[source]
        total = np.log(np.maximum(probabilities[of_source], MIN_PROBABILITY)).mean(axis=0)
        votes.append(
            {
                "name": name,
                "group": rows.groups[rows.group[of_source][0]],
                "label": str(rows.labels[of_source][0]),
                "n": int(of_source.sum()),
                "accuracy": float(
                    np.mean(classes[np.argmax(probabilities[of_source], axis=1)] == rows.labels[of_source])
                ),
                "vote": str(classes[np.argmax(total)]),
            }
        )
    return votes


def _running(rows: Rows, probabilities: Floats, time: float) -> dict[str, Any]:
    """Return the accuracy of the vote of the windows within a time [s], over recordings at least this long."""
    assert rows.slicing is not None
    classes = np.unique(rows.labels)
    hits, group, short = [], [], 0
    for source in np.unique(rows.source):
        of_source = rows.source == source
        vote = RunningVote.over(time, rows.slicing.window_time, rows.slicing.hop_time)
        voted = vote.feed(probabilities[of_source])[vote.n_windows - 1 :]
        short += not len(voted)
        hits.append(classes[np.argmax(voted, axis=1)] == rows.labels[of_source][0])
        group.append(rows.group[of_source][: len(voted)])
    if not sum(map(len, hits)):
        return {"time": time, "n": 0, "n_too_short": short}
    all_hits, all_groups = np.concatenate(hits), np.concatenate(group)
    return {"time": time, "n": len(all_hits), "n_too_short": short, **_share(all_hits, all_groups)}


def paired_difference(
    hits: NDArray[np.bool_], others: NDArray[np.bool_], specimen: NDArray[np.integer]
) -> tuple[float, float]:
    """Return the difference in frequency of `hits` and `others`, and its standard error with one trial per specimen."""
    difference = hits.astype(float) - others
    mean = float(difference.mean())
    _, cluster = np.unique(specimen, return_inverse=True)
    return mean, float(np.sqrt(_clustered_variance(difference - mean, cluster)))


def _clustered_variance(deviations: Floats, cluster: NDArray[np.intp]) -> float:
    """Return the variance of a mean, as a linearised ratio of sums over clusters (Cochran 1977, 6.3)."""
    sums = np.bincount(cluster, deviations)
    return float(np.sum(sums**2)) * len(sums) / max(len(sums) - 1, 1) / len(deviations) ** 2

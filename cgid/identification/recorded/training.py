"""From recorded rows to a model: chosen and judged by groups left out, trained on all."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid.errors import BadData
from cgid.identification.measuring import Measured
from cgid.identification.metrics import evaluate
from cgid.identification.model import Model
from cgid.identification.recorded.adaptation import is_level, shift, thinned
from cgid.identification.recorded.clustered import clustered_interval
from cgid.identification.recorded.feature_sets import sets_for
from cgid.identification.recorded.grouped import (
    Candidate,
    Lesson,
    Rows,
    Weights,
    candidates_for,
    choose,
    final,
    judge,
    require_groups,
)
from cgid.identification.recorded.measuring import Recorded
from cgid.identification.training import Training, check_class_weights
from cgid.identification.windows import LEAST_PROBABILITY, RunningVote
from cgid.units import quantity_of
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: Running votes are judged over these [s].
VOTE_TIMES = (0.5, 1.0)


def train_recorded(
    recorded: Recorded,
    *,
    features: Sequence[str] | None = None,
    families: Sequence[str] = ("linear",),
    level_free: bool = False,
    class_weights: Weights = None,
    seed: int = 0,
    shuffle_labels: bool = False,
    synthetic: Measured | None = None,
    progress: Callable[[int], object] | None = None,
    crew: Workers = ALONE,
) -> Training:
    """Train a model on recordings; it is judged by groups that neither it nor its choice have seen.

    Parameters
    ----------
    recorded : Recorded
    features : sequence of str, optional
        The only set; else those of `cgid.identification.recorded.feature_sets` are chosen among.
    families : sequence of str
        Chosen among, too; the first is preferred.
    level_free : bool
        Whether only sets are chosen among in which the gain of the sensor cancels.
    class_weights : dict or "balanced", optional
        See `cgid.identification.classifier.ImpactClassifier`.
    seed : int
    shuffle_labels : bool
        A check of the method: labels are shuffled among the recordings, so the accuracy must be no better than
        guessing; it is worse where recordings of a material resemble each other, for these then mislead.
    synthetic : Measured, optional
        Impacts of scenes or datasets, measured as the recorded ones and in their unit: they teach, too, adapted to the
        level and spectrum of the recordings.
    progress : callable, optional
        Called with 1 for each group judged.
    crew : Workers
        Who trains without a group and judges it: see `cgid.workers.workers`.

    Raises
    ------
    BadData
        There are fewer than two labels, a label lies in one group only, or synthetic impacts have another label.
    """
    labels = _shuffled(recorded, seed) if shuffle_labels else recorded.labels
    require_groups(labels, recorded.group)
    check_class_weights(class_weights, np.unique(labels))
    sets = {"asked for": tuple(features)} if features else sets_for(recorded.kind, level_free=level_free)
    candidates = candidates_for(sets, recorded.names, families)
    rows = Rows(names=recorded.names, features=recorded.features, labels=labels, group=recorded.group)
    mixed = rows if synthetic is None else _mixed(rows, synthetic, seed)
    lesson = Lesson(rows=mixed, candidates=candidates, weights=class_weights, seed=seed)
    adapting = {} if synthetic is None else _adaptation(replace(lesson, rows=rows), mixed, crew)
    judged = judge(lesson, progress, crew)
    choice = choose(lesson, crew)
    best = candidates[choice.best]
    classifier = final(lesson, choice, crew)
    metrics = _metrics(recorded, labels, judged.probabilities)
    model = Model.from_classifier(
        classifier,
        features=best.features,
        unit=recorded.unit,
        sampling_rates=recorded.sampling_rates,
        window_time=recorded.slicing.window_time if recorded.kind == "window" else 0.0,
        hop_time=recorded.slicing.hop_time if recorded.kind == "window" else 0.0,
        n_channels=recorded.n_channels,
        references=recorded.references,
        training={
            "sources": list(recorded.sources) + ([] if synthetic is None else list(synthetic.sources)),
            "quantity": quantity_of(recorded.unit),
            "n_left_out": recorded.left_out,
            "versions": {"cgid": __version__, "python": platform.python_version()}
            | {name: version(name) for name in ("numpy", "scikit-learn")},
            "n_train": len(labels),
            "seed": seed,
            "labels_shuffled": shuffle_labels,
            "metrics": metrics,
            "recorded": {
                "by": recorded.slicing.by,
                "n_groups": len(np.unique(recorded.group)),
                "n_recordings": len(recorded.pieces),
                "class_weights": class_weights,
                "level_free": level_free,
                "candidates": _comparison(candidates, choice.accuracies, judged.chosen, choice.best),
                "failures": [str(error) for error in recorded.failures],
                "warnings": list(recorded.warnings),
                **adapting,
            },
        },
    )
    return Training(model, metrics, labels, judged.probabilities, classifier)


def _mixed(rows: Rows, synthetic: Measured, seed: int) -> Rows:
    """Return recorded and synthetic rows together, of each label not too many synthetic ones."""
    strange = np.setdiff1d(synthetic.labels, rows.labels)
    if strange.size:
        raise BadData(
            f"label {strange[0]} of the scene must be one of the recordings' ({', '.join(np.unique(rows.labels))}), it "
            "is not; name them alike in the manifest, or record it"
        )
    kept = thinned(synthetic.labels, rows.labels, seed)
    return Rows(
        names=rows.names,
        features=np.concatenate([rows.features, synthetic.features[kept]]),
        labels=np.concatenate([rows.labels, synthetic.labels[kept]]),
        group=np.concatenate([rows.group, np.full(int(kept.sum()), -1)]),
    )


def _adaptation(recorded: Lesson, mixed: Rows, crew: Workers) -> dict[str, Any]:
    """Return what a card says of synthetic impacts: how many, how far they were moved, and what they are good for."""
    moved = shift(mixed.names, mixed.features, mixed.labels, mixed.group < 0)
    alone = judge(recorded, crew=crew).probabilities
    labels = recorded.rows.labels
    answers = np.unique(labels)[np.argmax(alone, axis=1)]
    return {
        "synthetic": {
            "n": int(np.sum(mixed.group < 0)),
            "moved_db": {name: 10 * by for name, by in zip(mixed.names, moved.tolist(), strict=True) if is_level(name)},
            "accuracy_without": float(np.mean(answers == labels)),
        }
    }


def _shuffled(recorded: Recorded, seed: int) -> NDArray[np.str_]:
    """Return the labels shuffled among the recordings, so that the split that is checked is the one that is used."""
    _, first = np.unique(recorded.piece, return_index=True)
    return np.asarray(np.random.default_rng(seed).permutation(recorded.labels[first])[recorded.piece])


def _comparison(
    candidates: Sequence[Candidate], accuracies: Sequence[float], chosen: Sequence[int], best: int
) -> list[dict[str, Any]]:
    return [
        {
            "name": candidate.name,
            "family": candidate.family,
            "n_features": len(candidate.features),
            "accuracy": accuracy,
            "taken_in_folds": sum(one == k for one in chosen),
            "chosen": k == best,
        }
        for k, (candidate, accuracy) in enumerate(zip(candidates, accuracies, strict=True))
    ]


# -- how good it is ---------------------------------------------------------------------------------------


def _metrics(recorded: Recorded, labels: NDArray[np.str_], probabilities: Floats) -> dict[str, Any]:
    """Return the metrics of rows, of whole recordings and of running votes; intervals count groups."""
    classes = np.unique(labels)
    metrics = evaluate(labels, probabilities, tuple(classes.tolist()))
    hits = classes[np.argmax(probabilities, axis=1)] == labels
    metrics["accuracy_interval_95"] = list(clustered_interval(hits, recorded.group))
    recordings = _recordings(recorded, labels, probabilities)
    voted = np.array([row["vote"] == row["label"] for row in recordings])
    owner = np.array([recorded.groups.index(row["group"]) for row in recordings])
    metrics["recordings"] = {"n": len(voted), **_share(voted, owner), "rows": recordings}
    if recorded.kind == "window":
        metrics["running"] = [_running(recorded, labels, probabilities, time) for time in VOTE_TIMES]
    return {**metrics, "prediction_sets": []}


def _share(hits: NDArray[np.bool_], group: NDArray[np.intp]) -> dict[str, Any]:
    return {"accuracy": float(hits.mean()), "accuracy_interval_95": list(clustered_interval(hits, group))}


def _recordings(recorded: Recorded, labels: NDArray[np.str_], probabilities: Floats) -> list[dict[str, Any]]:
    """Return what each recording's rows say together: the label of the largest mean of logarithms."""
    classes = np.unique(labels)
    rows = []
    for piece in np.unique(recorded.piece):
        own = recorded.piece == piece
        total = np.log(np.maximum(probabilities[own], LEAST_PROBABILITY)).mean(axis=0)
        rows.append(
            {
                "name": recorded.pieces[piece],
                "group": recorded.groups[recorded.group[own][0]],
                "label": str(labels[own][0]),
                "n": int(own.sum()),
                "accuracy": float(np.mean(classes[np.argmax(probabilities[own], axis=1)] == labels[own])),
                "vote": str(classes[np.argmax(total)]),
            }
        )
    return rows


def _running(recorded: Recorded, labels: NDArray[np.str_], probabilities: Floats, time: float) -> dict[str, Any]:
    """Return how often the vote of the windows within a time is right, wherever a recording is that long."""
    classes = np.unique(labels)
    hits, group, short = [], [], 0
    for piece in np.unique(recorded.piece):
        own = recorded.piece == piece
        vote = RunningVote.over(time, recorded.slicing.window_time, recorded.slicing.hop_time)
        voted = vote.feed(probabilities[own])[vote.n_windows - 1 :]
        short += not len(voted)
        hits.append(classes[np.argmax(voted, axis=1)] == labels[own][0])
        group.append(recorded.group[own][: len(voted)])
    if not sum(map(len, hits)):
        return {"time": time, "n": 0, "n_too_short": short}
    all_hits, all_groups = np.concatenate(hits), np.concatenate(group)
    return {"time": time, "n": len(all_hits), "n_too_short": short, **_share(all_hits, all_groups)}

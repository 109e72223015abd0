"""Which family of classifiers to take: all of them on the same folds, by specimen, with everything inside the folds."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.svm import SVC
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import InvalidValue
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.metrics import evaluate
from cgid.identification.model import Model
from cgid.identification.rows import Measured, linear_columns
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: Another family is only taken when its accuracy is higher by more than this.
MARGIN = 0.003
#: Support vector machines cost the square of the number of impacts: a fold's are thinned to so many.
SUPPORT_VECTOR_IMPACTS = 10_000
#: One impact is predicted so often to time it.
_REPEATS = 50


class _Forest(RandomForestClassifier):  # type: ignore[misc]
    """A random forest whose scores are logarithms of probabilities, to be calibrated as the others' are."""

    def decision_function(self, X: Floats) -> Floats:
        logs = np.log(np.maximum(self.predict_proba(X), 0.5 / len(self.estimators_)))
        return np.asarray(logs[:, 1] - logs[:, 0] if len(self.classes_) == 2 else logs)


class Rival(ImpactClassifier):
    """The families that are compared and cannot be exported as plain numbers; all else as `ImpactClassifier`."""

    ESTIMATORS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {
        "random forest": lambda own: _Forest(200, min_samples_leaf=5, random_state=own.random_state),
        "support vectors": lambda own: SVC(C=3.0, random_state=own.random_state),
    }


@dataclass(frozen=True)
class Candidate:
    """One family in the comparison.

    Attributes
    ----------
    name : str
    make : callable
        From the columns without logarithm and the seed to an unfitted classifier.
    exportable : bool
        Whether a model file can hold it.
    most : int or None
        It is trained on at most so many impacts of a fold.
    """

    name: str
    make: Callable[[tuple[int, ...], int], ImpactClassifier]
    exportable: bool
    most: int | None = None


def _candidate(kind: type[ImpactClassifier], family: str, name: str, most: int | None = None) -> Candidate:
    def make(linear: tuple[int, ...], seed: int) -> ImpactClassifier:
        return kind(family, linear=linear, random_state=seed)

    return Candidate(name, make, kind is ImpactClassifier, most)


#: The default first, then what can be exported, then the others.
CANDIDATES = (
    _candidate(ImpactClassifier, "logistic", "logistic"),
    _candidate(ImpactClassifier, "boosting", "gradient boosting"),
    _candidate(ImpactClassifier, "network", "network"),
    _candidate(ImpactClassifier, "linear", "linear discriminant"),
    _candidate(Rival, "random forest", "random forest"),
    _candidate(Rival, "support vectors", "support vectors (RBF)", SUPPORT_VECTOR_IMPACTS),
)


def select(
    measured: Measured,
    *,
    candidates: tuple[Candidate, ...] = CANDIDATES,
    n_folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
    crew: Workers = ALONE,
) -> list[dict[str, Any]]:
    """Compare families by cross-validation, one thread a fold; return one row for each, as plain numbers for JSON.

    The folds are the same for all, stratified by label, and the impacts of a specimen stay together. Standardising,
    fitting and calibrating see the training part of a fold alone.

    Parameters
    ----------
    measured : Measured
    candidates : tuple of Candidate
        The first is what the others are compared with.
    n_folds : int
    seed : int
        Of the folds and the classifiers.
    progress : callable, optional
        Called with the name of each candidate before it starts.
    crew : Workers
        Who does the folds, see `cgid.workers.workers`; beside each other they take longer to fit.

    Returns
    -------
    list of dict
        name, exportable, accuracy, its difference from the first's with the standard error of paired specimens,
        brier_score, expected_calibration_error, n_train (of a fold), fit_s (one fold), predict_us (one impact: the
        exported model, else scikit-learn's), size_bytes (of the model file, else of the pickle), chosen.

    Raises
    ------
    InvalidValue
        A label has fewer specimens than there are folds.
    """
    labels = measured.labels
    fewest = min(len(np.unique(measured.specimen[labels == label])) for label in np.unique(labels))
    if not 2 <= validation.count("n_folds", n_folds) <= fewest:
        raise InvalidValue(f"n_folds must lie between 2 and {fewest}, the specimens of a label, got {n_folds}")
    inputs = np.hstack([measured.features, measured.known])
    splitter = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    folds = list(splitter.split(inputs, labels, measured.specimen))
    rows: list[dict[str, Any]] = []
    hits: list[NDArray[np.bool_]] = []
    for candidate in candidates:
        if progress is not None:
            progress(candidate.name)
        row, own = _judge(candidate, measured, inputs, folds, seed, crew)
        hits.append(own)
        difference, error = paired_difference(own, hits[0], measured.specimen)
        rows.append({**row, "difference": difference, "standard_error": error})
    best = preferred([row["accuracy"] for row in rows])
    return [{**row, "chosen": k == best} for k, row in enumerate(rows)]


def preferred(accuracies: list[float], margin: float = MARGIN) -> int:
    """Return which of the candidates, the preferred ones first, is taken: a later one only if better by the margin."""
    best = 0
    for k, accuracy in enumerate(accuracies):
        if accuracy > accuracies[best] + margin:
            best = k
    return best


def paired_difference(
    hits: NDArray[np.bool_], others: NDArray[np.bool_], specimen: NDArray[np.uint64]
) -> tuple[float, float]:
    """Return by how much more often `hits` holds than `others` on the same impacts, and the standard error.

    Impacts of one specimen are one trial: the error is that of a ratio of sums over specimens (Cochran 1977, 6.3).
    """
    difference = hits.astype(float) - others
    mean = float(difference.mean())
    _, own = np.unique(specimen, return_inverse=True)
    deviations = np.bincount(own, difference - mean)
    n_trials = len(deviations)
    spread = np.sum(deviations**2) * n_trials / max(n_trials - 1, 1)
    return mean, float(np.sqrt(spread) / len(hits))


def _judge(
    candidate: Candidate,
    measured: Measured,
    inputs: Floats,
    folds: list[tuple[NDArray[np.intp], NDArray[np.intp]]],
    seed: int,
    crew: Workers,
) -> tuple[dict[str, Any], NDArray[np.bool_]]:
    labels = measured.labels
    classes = tuple(np.unique(labels).tolist())
    probabilities = np.empty((len(labels), len(classes)))
    parts = [(_thinned(candidate, training, seed), test, test is folds[-1][1]) for training, test in folds]
    judged = list(crew.each(_judge_fold, (candidate, measured, inputs, seed), parts))
    for (_, test, _), (answers, _, _) in zip(parts, judged, strict=True):
        probabilities[test] = answers
    classifier = judged[-1][2]
    assert classifier is not None
    metrics = evaluate(labels, probabilities, classes)
    with threadpool_limits(1):
        predict, size = _in_use(candidate, classifier, measured)
        row = {
            "name": candidate.name,
            "exportable": candidate.exportable,
            **{name: metrics[name] for name in ("accuracy", "brier_score", "expected_calibration_error")},
            "n_train": len(parts[-1][0]),
            "fit_s": float(np.mean([seconds for _, seconds, _ in judged])),
            "predict_us": _microseconds(predict, inputs[:1]),
            "size_bytes": size,
        }
    return row, np.array(classes)[np.argmax(probabilities, axis=1)] == labels


def _judge_fold(
    trial: tuple[Candidate, Measured, Floats, int], part: tuple[NDArray[np.intp], NDArray[np.intp], bool]
) -> tuple[Floats, float, ImpactClassifier | None]:
    """Return probabilities of what is left out, how long the rest took to fit [s], and the classifier if it is kept."""
    candidate, measured, inputs, seed = trial
    training, test, kept = part
    classifier = candidate.make(linear_columns(measured.names), seed)
    with threadpool_limits(1):
        start = time.perf_counter()
        classifier.fit(inputs[training], measured.labels[training], measured.specimen[training])
        seconds = time.perf_counter() - start
        # Not all are sent from one process to another: a forest is large.
        return classifier.predict_proba(inputs[test]), seconds, classifier if kept else None


def _thinned(candidate: Candidate, training: NDArray[np.intp], seed: int) -> NDArray[np.intp]:
    """Return as much of the training as the family can bear."""
    if candidate.most is None or len(training) <= candidate.most:
        return training
    return np.random.default_rng(seed).permutation(training)[: candidate.most]


def _in_use(
    candidate: Candidate, classifier: ImpactClassifier, measured: Measured
) -> tuple[Callable[[Floats], Floats], int]:
    """Return what a user would call for probabilities, and how large the file is."""
    if not candidate.exportable:
        return classifier.predict_proba, len(pickle.dumps(classifier))
    model = Model.from_classifier(
        classifier,
        features=measured.names,
        known=measured.known_names,
        unit=measured.unit,
        sampling_rates=measured.sampling_rates,
        training={},
    )
    return model.probabilities, len(model.to_bytes())


def _microseconds(predict: Callable[[Floats], Floats], one: Floats) -> float:
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        predict(one)
        times.append(time.perf_counter() - start)
    return 1e6 * float(np.median(times))

"""Comparison of all families of classifiers by cross-validation on the same folds."""

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
from cgid.identification.metrics import evaluate, paired_difference
from cgid.identification.model import Model
from cgid.identification.rows import Rows, linear_columns
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: A later family must be better by this accuracy.
MARGIN = 0.003
#: Most training impacts of support vector machines in a fold: the cost grows with their square.
SUPPORT_VECTOR_IMPACTS = 10_000
#: Repetitions for the time of one prediction.
_REPEATS = 50


class _Forest(RandomForestClassifier):  # type: ignore[misc]
    """A random forest with a decision function for the calibration: log probabilities."""

    def decision_function(self, X: Floats) -> Floats:
        logs = np.log(np.maximum(self.predict_proba(X), 0.5 / len(self.estimators_)))
        return np.asarray(logs[:, 1] - logs[:, 0] if len(self.classes_) == 2 else logs)


class Rival(ImpactClassifier):
    """Families for comparison only, which cannot be exported as plain numbers."""

    ESTIMATORS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {
        "random forest": lambda own: _Forest(200, min_samples_leaf=5, random_state=own.random_state),
        "support vectors": lambda own: SVC(C=3.0, random_state=own.random_state),
    }


@dataclass(frozen=True)
class Candidate:
    """One family in the comparison.

    `make` returns an unfitted classifier from the columns without logarithm and the seed, `exportable` says whether a
    model file can hold it, and `most` is the largest number of training impacts in a fold.
    """

    name: str
    make: Callable[[tuple[int, ...], int], ImpactClassifier]
    exportable: bool
    most: int | None = None


def _candidate(kind: type[ImpactClassifier], family: str, name: str, most: int | None = None) -> Candidate:
    def make(linear: tuple[int, ...], seed: int) -> ImpactClassifier:
        return kind(family, linear=linear, random_state=seed)

    return Candidate(name, make, kind is ImpactClassifier, most)


#: The default, then the other exportable families, then those for comparison only.
CANDIDATES = (
    _candidate(ImpactClassifier, "logistic", "logistic"),
    _candidate(ImpactClassifier, "boosting", "gradient boosting"),
    _candidate(ImpactClassifier, "network", "network"),
    _candidate(ImpactClassifier, "linear", "linear discriminant"),
    _candidate(Rival, "random forest", "random forest"),
    _candidate(Rival, "support vectors", "support vectors (RBF)", SUPPORT_VECTOR_IMPACTS),
)


def select(
    measured: Rows,
    *,
    candidates: tuple[Candidate, ...] = CANDIDATES,
    n_folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
    crew: Workers = ALONE,
) -> list[dict[str, Any]]:
    """Compare families by cross-validation; return one row for each, as plain numbers for JSON.

    All share the folds, which are stratified by label and never divide a specimen. Fits use one thread and only the
    training part; in parallel folds they take longer. `difference` is to the first candidate, `standard_error` over
    paired specimens; `n_train` and `fit_s` are per fold; `predict_us` (one impact) and `size_bytes` are those of the
    exported model, else of scikit-learn's and its pickle. Raises `InvalidValue` if a label has fewer specimens than
    folds.
    """
    labels = measured.labels
    fewest = min(len(np.unique(measured.group[labels == label])) for label in np.unique(labels))
    if not 2 <= validation.count("n_folds", n_folds) <= fewest:
        raise InvalidValue(f"n_folds must lie between 2 and {fewest}, the specimens of a label, got {n_folds}")
    inputs = np.ascontiguousarray(measured.inputs(measured.names))
    splitter = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    folds = list(splitter.split(inputs, labels, measured.group))
    rows: list[dict[str, Any]] = []
    hits: list[NDArray[np.bool_]] = []
    for candidate in candidates:
        if progress is not None:
            progress(candidate.name)
        row, own = _judge(candidate, measured, inputs, folds, seed, crew)
        hits.append(own)
        difference, error = paired_difference(own, hits[0], measured.group)
        rows.append({**row, "difference": difference, "standard_error": error})
    best = preferred([row["accuracy"] for row in rows])
    return [{**row, "chosen": k == best} for k, row in enumerate(rows)]


def preferred(accuracies: list[float], margin: float = MARGIN) -> int:
    """Return the best candidate; a later one must be better than an earlier one by the margin."""
    best = 0
    for k, accuracy in enumerate(accuracies):
        if accuracy > accuracies[best] + margin:
            best = k
    return best


def _judge(
    candidate: Candidate,
    measured: Rows,
    inputs: Floats,
    folds: list[tuple[NDArray[np.intp], NDArray[np.intp]]],
    seed: int,
    crew: Workers,
) -> tuple[dict[str, Any], NDArray[np.bool_]]:
    labels = measured.labels
    classes = tuple(np.unique(labels).tolist())
    probabilities = np.empty((len(labels), len(classes)))
    parts = []
    for training, test in folds:
        if candidate.most is not None and len(training) > candidate.most:
            training = np.random.default_rng(seed).permutation(training)[: candidate.most]
        parts.append((training, test, test is folds[-1][1]))
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
    trial: tuple[Candidate, Rows, Floats, int], part: tuple[NDArray[np.intp], NDArray[np.intp], bool]
) -> tuple[Floats, float, ImpactClassifier | None]:
    """Return probabilities for the test rows, the time of the fit [s], and the classifier if it is kept."""
    candidate, measured, inputs, seed = trial
    training, test, kept = part
    classifier = candidate.make(linear_columns(measured.names), seed)
    with threadpool_limits(1):
        start = time.perf_counter()
        classifier.fit(inputs[training], measured.labels[training], measured.group[training])
        seconds = time.perf_counter() - start
        # Sending all classifiers between processes would be slow: a forest is large.
        return classifier.predict_proba(inputs[test]), seconds, classifier if kept else None


def _in_use(
    candidate: Candidate, classifier: ImpactClassifier, measured: Rows
) -> tuple[Callable[[Floats], Floats], int]:
    """Return the function that a user calls for probabilities, and the size of the file [bytes]."""
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

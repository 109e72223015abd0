"""Choosing and judging where few recordings hold many windows: groups are left out as a whole, twice over.

Outside, each group in turn only judges. Inside, on what is left, each group in turn says which of the candidates to
take and how much to trust its probabilities. So nothing that was chosen has seen what judges it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import StratifiedGroupKFold
from threadpoolctl import threadpool_limits

from cgid.errors import BadData
from cgid.identification.classifier import ImpactClassifier, best_temperature
from cgid.identification.families import Neighbourhood, softmax
from cgid.identification.rows import Sets, shift
from cgid.identification.selection import preferred
from cgid.identification.windows import columns_of
from cgid.measure.features import FEATURES
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: Up to so many groups are left out one by one; more are left out together, in so many folds.
MOST_FOLDS = 20
#: A candidate further down the list must be better by this: of a few recordings, more tells little.
MARGIN = 0.01
Weights = dict[str, float] | str | None


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One way to make a classifier.

    Attributes
    ----------
    name : str
    features : tuple of str
        Measured on each channel.
    family : str
        Out of `cgid.identification.classifier.FAMILIES`.
    """

    name: str
    features: tuple[str, ...]
    family: str


def candidates_for(sets: Sets, measured: Sequence[str], families: Sequence[str]) -> tuple[Candidate, ...]:
    """Return every set of features with every family; of a set, what could be measured."""
    found = []
    for family in families:
        for name, wanted in sets.items():
            features = tuple(feature for feature in wanted if feature in measured)
            if features:
                found.append(Candidate(name=name, features=features, family=family))
    return tuple(found)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """What is learned from: a row a window or an impact.

    Attributes
    ----------
    names : tuple of str
        Of the features of one channel.
    features : ndarray, (n_rows, n_channels * n_names)
    labels : ndarray of str, (n_rows,)
    group : ndarray of int, (n_rows,)
        Below 0: synthetic, which teaches and never judges.
    """

    names: tuple[str, ...]
    features: Floats
    labels: NDArray[np.str_]
    group: NDArray[np.intp]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return some of the rows."""
        return replace(self, features=self.features[chosen], labels=self.labels[chosen], group=self.group[chosen])

    @property
    def n_channels(self) -> int:
        """Whose features stand beside each other."""
        return int(self.features.shape[1] // len(self.names))

    @property
    def adapted(self) -> Rows:
        """The rows with the synthetic ones moved to the level and spectrum of the others."""
        synthetic = self.group < 0
        if not synthetic.any():
            return self
        features = self.features.copy()
        features[synthetic] += shift(self.names, features, self.labels, synthetic)
        return replace(self, features=features)

    def inputs(self, features: Sequence[str]) -> Floats:
        """Return the columns of some features, channel after channel."""
        return self.features[:, columns_of(self.names, features, self.features.shape[1])]


@dataclass(frozen=True)
class Choice:
    """What the groups left out inside say of the candidates.

    Attributes
    ----------
    best : int
    accuracies : tuple of float
        Of each candidate.
    temperature : float
        Of the best.
    """

    best: int
    accuracies: tuple[float, ...]
    temperature: float


@dataclass(frozen=True, eq=False)
class Judged:
    """What candidates chosen inside answer for the groups left out.

    Attributes
    ----------
    probabilities : ndarray, (n_rows, n_labels)
        Of the recorded rows.
    chosen : tuple of int
        Which candidate each fold took.
    """

    probabilities: Floats
    chosen: tuple[int, ...]


def require_groups(labels: NDArray[np.str_], group: NDArray[np.intp]) -> None:
    """Raise `BadData` unless every label can be trained on and judged by different groups."""
    different = np.unique(labels)
    if len(different) < 2:
        raise BadData(
            f"recordings must have at least 2 labels to tell apart, got {', '.join(different) or 'none'}; add others"
        )
    if len(np.unique(group)) < 2:
        raise BadData(
            "recordings must lie in at least 2 groups, one to train and one to judge, got 1; name groups in the "
            "manifest (recording, day, support), or add recordings"
        )
    for label in different.tolist():
        count = len(np.unique(group[labels == label]))
        if count < 2:
            raise BadData(
                f"label {label} must have recordings in at least 2 groups, one to train and one to judge, got {count}; "
                "add some, or correct the label"
            )


def leave_groups_out(labels: NDArray[np.str_], group: NDArray[np.intp], seed: int) -> Iterator[NDArray[np.bool_]]:
    """Yield which rows are left out: each group in turn, or folds of groups where there are many."""
    recorded = np.flatnonzero(group >= 0)
    groups = np.unique(group[recorded])
    if len(groups) <= MOST_FOLDS:
        for one in groups:
            yield group == one
        return
    # No more folds than the rows of a label, which are spread over them: it may be one row a group.
    n_folds = min(MOST_FOLDS, int(np.unique(labels[recorded], return_counts=True)[1].max()))
    splitter = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # A rare label is in some of the folds only.
        warnings.simplefilter("ignore", UserWarning)
        folds = list(splitter.split(recorded, labels[recorded], group[recorded]))
    for _, test in folds:
        left_out = np.zeros(len(labels), bool)
        left_out[recorded[test]] = True
        yield left_out


@dataclass(frozen=True, kw_only=True, eq=False)
class Lesson:
    """What there is to learn from, and how."""

    rows: Rows
    candidates: Sequence[Candidate]
    weights: Weights
    seed: int


def choose_candidate(lesson: Lesson, crew: Workers = ALONE) -> Choice:
    """Return which candidate answers best for groups left out, and its temperature."""
    rows, weights = lesson.rows, lesson.weights
    labels, accuracies = np.unique(rows.labels), []
    truth = np.searchsorted(labels, rows.labels)
    folds = [fold for fold in leave_groups_out(rows.labels, rows.group, lesson.seed) if _teaches_all(rows.labels, fold)]
    judged = np.any(folds, axis=0) if folds else np.zeros(len(rows.labels), bool)
    scores = np.zeros((len(lesson.candidates), len(truth), len(labels)))
    for fold, answers in zip(folds, crew.each(_scores_of_all, lesson, folds), strict=True):
        scores[:, fold] = answers
    for own in scores:
        hits = np.argmax(own[judged], axis=1) == truth[judged]
        accuracies.append(
            float(np.average(hits, weights=_row_weights(rows.labels[judged], weights))) if hits.size else 0.0
        )
    best = preferred(accuracies, MARGIN)
    temperature = 1.0
    if judged.any():
        temperature = best_temperature(scores[best][judged], truth[judged], _row_weights(rows.labels[judged], weights))
    return Choice(best, tuple(accuracies), temperature)


def judge(lesson: Lesson, progress: Callable[[int], object] | None = None, crew: Workers = ALONE) -> Judged:
    """Return what is answered for each group by what was chosen and trained on the others."""
    rows = lesson.rows
    probabilities, chosen = np.empty((len(rows.labels), len(np.unique(rows.labels)))), []
    folds = list(leave_groups_out(rows.labels, rows.group, lesson.seed))
    if not all(_teaches_all(rows.labels, fold) for fold in folds):
        raise BadData(
            "groups must leave recordings of every label to train on when one is left out; add recordings, or name "
            "smaller groups"
        )
    with closing(crew.each(_judged, lesson, folds)) as judged:
        for fold, (best, answers) in zip(folds, judged, strict=True):
            chosen.append(best)
            probabilities[fold] = answers
            if progress is not None:
                progress(1)
    return Judged(probabilities[rows.group >= 0], tuple(chosen))


def final(lesson: Lesson, choice: Choice, crew: Workers = ALONE) -> ImpactClassifier:
    """Return the candidate chosen trained on all rows, its edge of the known where groups left out still lie inside."""
    rows = lesson.rows
    only = replace(lesson, candidates=(lesson.candidates[choice.best],))
    folds = list(leave_groups_out(rows.labels, rows.group, lesson.seed))
    distances = list(crew.each(_distances, only, folds))
    with threadpool_limits(1):
        classifier = _fitted(only.candidates[0], rows, lesson.weights, lesson.seed, rejects=True)
    limit = float(np.quantile(np.concatenate(distances), Neighbourhood.INSIDE))
    classifier.temperature_ = choice.temperature
    classifier.neighbourhood_ = replace(classifier.neighbourhood_, limit=limit)
    return classifier


# -- one fold, wherever it is done -------------------------------------------------------------------------


def _scores_of_all(lesson: Lesson, fold: NDArray[np.bool_]) -> Floats:
    """Return what each candidate trained outside of a fold answers inside it, (n_candidates, n_rows, n_labels)."""
    with threadpool_limits(1):
        return np.stack([_scores(candidate, lesson, fold) for candidate in lesson.candidates])


def _judged(lesson: Lesson, fold: NDArray[np.bool_]) -> tuple[int, Floats]:
    """Return which candidate is chosen outside of a fold, and its probabilities inside it."""
    with threadpool_limits(1):
        choice = choose_candidate(replace(lesson, rows=lesson.rows[~fold]))
        scores = _scores(lesson.candidates[choice.best], lesson, fold)
        return choice.best, softmax(scores / choice.temperature)


def _distances(lesson: Lesson, fold: NDArray[np.bool_]) -> Floats:
    """Return how far the rows of a fold lie from those that the only candidate learns from outside of it."""
    (candidate,) = lesson.candidates
    with threadpool_limits(1):
        without = _fitted(candidate, lesson.rows[~fold], lesson.weights, lesson.seed, rejects=True)
        novelty = without.novelty(lesson.rows.inputs(candidate.features)[fold])
    return novelty * without.neighbourhood_.limit


def _teaches_all(labels: NDArray[np.str_], fold: NDArray[np.bool_]) -> bool:
    return len(np.unique(labels[~fold])) == len(np.unique(labels))


def _fitted(
    candidate: Candidate, rows: Rows, weights: Weights, seed: int, *, rejects: bool = False
) -> ImpactClassifier:
    linear = [FEATURES[name].linear for name in candidate.features] * rows.n_channels
    classifier = ImpactClassifier(
        candidate.family,
        linear=tuple(np.flatnonzero(linear).tolist()),
        calibration_folds=0,  # by groups left out instead
        class_weight=weights,
        rejects=rejects,
        random_state=seed,
    )
    return classifier.fit(rows.adapted.inputs(candidate.features), rows.labels)


def _scores(candidate: Candidate, lesson: Lesson, fold: NDArray[np.bool_]) -> Floats:
    """Return what a candidate trained outside of a fold answers inside it, (n_rows, n_labels)."""
    fitted = _fitted(candidate, lesson.rows[~fold], lesson.weights, lesson.seed)
    scores = fitted.decision_function(lesson.rows[fold].inputs(candidate.features))
    return np.stack([np.zeros(len(scores)), scores], axis=1) if scores.ndim == 1 else scores


def _row_weights(labels: NDArray[np.str_], weights: Weights) -> Floats | None:
    """Return what each row counts; None where all count 1."""
    if weights is None:
        return None
    different, own, counts = np.unique(labels, return_inverse=True, return_counts=True)
    if weights == "balanced":
        return np.asarray(1 / counts[own])
    assert isinstance(weights, dict)
    return np.array([weights.get(label, 1.0) for label in different.tolist()])[own]

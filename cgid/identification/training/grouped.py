"""Nested cross-validation by group, for a few recordings of many windows each.

The outer loop leaves out each group in turn for evaluation. The inner loop, over the other groups, selects a candidate
and calibrates its probabilities, so the evaluation group never takes part in a selection.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import minimize_scalar
from sklearn.base import ClassifierMixin
from sklearn.model_selection import StratifiedGroupKFold
from threadpoolctl import threadpool_limits

from cgid._lib.terminal import counted
from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.errors import BadData
from cgid.identification.detection.events import EVENT_TIME, SAME_IMPACT
from cgid.identification.detection.windows import CLEAR
from cgid.identification.model.families import Contrast, Neighbourhood, softmax
from cgid.identification.model.model import MIN_GROUPS, inputs_of, level_weights
from cgid.identification.prediction.levels import MIN_LEVELS, upper_end
from cgid.identification.prediction.vote import VOTE_TIME, RunningVote, independent_windows
from cgid.identification.training.classifier import (
    ImpactClassifier,
    Weights,
    best_temperature,
    log_loss,
    noise_contrast,
    row_weights,
)
from cgid.identification.training.control import OTHER, in_backgrounds
from cgid.identification.training.metrics import paired_difference
from cgid.identification.training.rows import Rows, Sets, linear_columns

#: Maximum number of folds: up to this number of groups each is a fold; more groups share this many folds, in the inner
#: loop a quarter of it, since it is run for each fold of the outer one.
MAX_FOLDS, INNER_FOLDS = 20, 5
#: Minimum number of labelled stretches of each label of a single recording for these to be its groups.
MIN_STRETCHES = 3
#: Minimum number of blocks of time of a single recording; more, up to `MAX_FOLDS`, if a label is in too few of them.
MIN_BLOCKS = 8
#: Part of the certainty that the model of all groups gains over those of the folds, which few groups can show.
_KNOWN_OF_FEW = 0.5


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A set of features, measured on each channel, and the family of an `ImpactClassifier`."""

    name: str
    features: tuple[str, ...]
    family: str | ClassifierMixin


def candidates_for(sets: Sets, measured: Sequence[str], family: str | ClassifierMixin) -> tuple[Candidate, ...]:
    """Return a candidate for each set of features of which at least one was measured."""
    measured_sets = {name: tuple(feature for feature in names if feature in measured) for name, names in sets.items()}
    return tuple(
        Candidate(name=name, features=features, family=family) for name, features in measured_sets.items() if features
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSet:
    """The rows to train on, and the settings."""

    rows: Rows
    candidates: Sequence[Candidate]
    weights: Weights
    seed: int
    copies: bool = False  # whether each row trains with another label's background, too


class Selection(NamedTuple):
    """Result of the inner loop: the best candidate, all accuracies, its temperature, and that of its votes."""

    best: int
    accuracies: tuple[float, ...]
    temperature: float
    vote_correlation: float = 1.0


class CrossValidation(NamedTuple):
    """Result of the outer loop: probabilities (n_recorded, n_labels), candidate of each fold, answers in backgrounds.

    `again` (n_recorded, n_ways) are the labels of rows with other backgrounds, "" where there is no silence.
    """

    probabilities: Floats
    chosen: tuple[int, ...]
    again: NDArray[np.str_]


def require_groups(labels: NDArray[np.str_], group: NDArray[np.integer]) -> None:
    """Raise `BadData` unless every label has at least two groups, for training and test."""
    different = np.unique(labels)
    if len(different) < 2:
        raise BadData(
            f"recordings must have at least 2 labels to tell apart, got {', '.join(different) or 'none'}; add others"
        )
    if len(np.unique(group)) < 2:
        raise BadData(
            "recordings must be in at least 2 groups, for training and test, got 1; add recordings, name "
            "groups in the manifest (recording, day, support), or label more of a single recording: from some 16 "
            "impacts on, cross-validation uses blocks of its time"
        )
    for label in different.tolist():
        count = len(np.unique(group[labels == label]))
        if count < 2:
            raise BadData(
                f"label {label} must have recordings in at least 2 groups, for training and test, got {count}; add "
                "some, or correct the label"
            )


def in_blocks_of_time(rows: Rows) -> Rows:
    """Return the rows of a single recording with successive blocks of time as groups, without rows in two blocks."""
    assert rows.slicing is not None
    before, after = (0.0, rows.slicing.window_time) if rows.slicing.by == "window" else (SAME_IMPACT, EVENT_TIME)
    time = np.unique(rows.time)
    for min_groups, n_blocks in product((3, 2), range(MIN_BLOCKS, MAX_FOLDS + 1)):
        last = np.arange(1, n_blocks) * len(time) // n_blocks
        edges = (time[last - 1] + time[last]) / 2 if len(time) >= n_blocks else np.empty(0)
        block = np.searchsorted(edges, rows.time - before)
        is_inside = block == np.searchsorted(edges, rows.time + after)
        if all(
            len(np.unique(block[is_inside & (rows.labels == label)])) >= min_groups for label in np.unique(rows.labels)
        ):
            ends = [f"{edge:.6g}" for edge in (float(time[0]), *edges.tolist(), float(time[-1]))]
            names = tuple(f"{start} to {end} s" for start, end in pairwise(ends))
            warning = (
                f"all rows are from one recording: cross-validated over {n_blocks} blocks of its time, so the accuracy "
                "is optimistic; add recordings of other days or supports"
            )
            return replace(rows, group=block, groups=names, warnings=(*rows.warnings, warning))[is_inside]
    return rows


def in_stretches(rows: Rows) -> Rows | None:
    """Return the rows of a single recording with its labelled stretches as groups; None if few rows are of stretches.

    Impacts of one stretch are labelled by one word, so they are one trial.
    """
    of_stretch = rows.chosen == "stretch"
    if not len(of_stretch) or np.mean(of_stretch) <= 0.5:
        return None
    stretches = [len(np.unique(rows.source[of_stretch & (rows.labels == one)])) for one in np.unique(rows.labels)]
    if min(stretches) < MIN_STRETCHES:
        return None
    warning = (
        f"all rows are from one recording: cross-validated over its {sum(stretches)} stretches, with equal weights of "
        "the labels, so the accuracy is optimistic; add recordings of other days or supports"
    )
    return replace(rows, group=rows.source, groups=rows.sources, warnings=(*rows.warnings, warning))


def leave_groups_out(
    labels: NDArray[np.str_], group: NDArray[np.integer], seed: int, n_folds: int = MAX_FOLDS
) -> Iterator[NDArray[np.bool_]]:
    """Yield a mask of the rows of each fold: one group, or several if there are many groups."""
    groups = np.unique(group)
    if len(groups) <= MAX_FOLDS:
        for one in groups:
            yield group == one
        return
    # StratifiedGroupKFold allows no more folds than the most frequent label has rows.
    n_folds = min(n_folds, int(np.unique(labels, return_counts=True)[1].max()))
    splitter = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    with warnings.catch_warnings():
        # A rare label may be missing in some folds.
        warnings.simplefilter("ignore", UserWarning)
        folds = list(splitter.split(labels, labels, group))
    for _, test in folds:
        left_out = np.zeros(len(labels), bool)
        left_out[test] = True
        yield left_out


def choose_candidate(training_set: TrainingSet, workers: Workers = SERIAL) -> Selection:
    """Return the best candidate for held-out groups, and its temperature (the inner loop)."""
    rows = training_set.rows
    labels, truth = np.unique(rows.labels, return_inverse=True)
    folds = [
        fold
        for fold in leave_groups_out(rows.labels, rows.group, training_set.seed, INNER_FOLDS)
        if _teaches_all(rows.labels, fold)
    ]
    if not folds:
        return Selection(0, (0.0,) * len(training_set.candidates), 1.0)
    scores = np.zeros((len(training_set.candidates), len(truth), len(labels)))
    for fold, answers in zip(folds, workers.each(_scores_of_all, training_set, folds), strict=True):
        scores[:, fold] = answers
    evaluation = np.any(folds, axis=0) & rows.is_clear
    scores, truth = scores[:, evaluation], truth[evaluation]
    weights = row_weights(rows.labels[evaluation], training_set.weights)
    is_correct = np.argmax(scores, axis=2) == truth
    accuracies = tuple(float(np.average(of_candidate, weights=weights)) for of_candidate in is_correct)
    best = smallest_as_good(training_set.candidates, accuracies, is_correct, rows.group[evaluation])
    # After n correct rows, the next one is wrong with this probability (Laplace).
    doubt = 1 / (len(truth) + 2)
    temperature = best_temperature(scores[best], truth, weights, doubt)
    # A fold leaves out one of n groups of a label, so its model is less certain than that of all, which lowers the
    # logarithm of the temperature by some 1 / n. But few groups do not show how much others differ. In simulated
    # recordings that differ, half of it is right where n is 2 and 3, and loses nothing where it is 10
    # (`python benchmarks/identification/few_groups.py`). Where doubt sets the temperature, nothing is taken off.
    n_groups = np.inf if is_correct[best].all() else np.mean(list(groups_of_labels(rows).values()))
    correlation = 1.0
    if rows.kind == "window" and rows.slicing is not None:
        correlation = vote_correlation(rows[evaluation], softmax(scores[best] / temperature), doubt)
    return Selection(best, accuracies, float(temperature ** (1 - _KNOWN_OF_FEW / n_groups)), correlation)


def vote_correlation(rows: Rows, probabilities: Floats, doubt: float) -> float:
    """Return the correlation of windows whose votes have the smallest log loss, from 0 to 1."""
    # All windows of a group share its peculiarities, so they contain less information than their overlap suggests.
    assert rows.slicing is not None
    truth, parts = np.unique(rows.labels, return_inverse=True)[1], []
    for source in np.unique(rows.source[rows.is_recorded]):
        of_source = (rows.source == source) & rows.is_recorded
        vote = RunningVote.over(VOTE_TIME, rows.slicing.window_time, rows.slicing.hop_time)
        counts = np.minimum(np.arange(1, np.sum(of_source) + 1), vote.n_windows)
        parts.append((np.log(vote.feed(probabilities[of_source])), truth[of_source], counts))
    logs, encoded, counts = (np.concatenate(part) for part in zip(*parts, strict=True))

    def loss(correlation: float) -> float:
        return log_loss(logs * independent_windows(counts, correlation)[:, None], encoded, doubt=doubt)

    return float(minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded").x)


def smallest_as_good(
    candidates: Sequence[Candidate], accuracies: Sequence[float], hits: NDArray[np.bool_], group: NDArray[np.integer]
) -> int:
    """Return the candidate with the fewest features within one standard error of the best (Breiman et al. 1984)."""
    best = int(np.argmax(accuracies))
    errors = [paired_difference(hits[best], of_candidate, group)[1] for of_candidate in hits]
    good = [k for k, of_candidate in enumerate(accuracies) if accuracies[best] - of_candidate <= errors[k]]
    return min(good, key=lambda k: len(candidates[k].features))


def groups_of_labels(rows: Rows) -> dict[str, int]:
    """Return the number of groups in which each label was recorded."""
    return {str(label): len(np.unique(rows.group[rows.labels == label])) for label in np.unique(rows.labels)}


def warnings_of_few(rows: Rows) -> list[str]:
    """Return a warning if a label has too few groups for an interval valid beyond them."""
    counts = groups_of_labels(rows)
    label = min(counts, key=lambda one: counts[one])
    if counts[label] >= MIN_GROUPS:
        return []
    what = "of recordings (days, supports)" if len(np.unique(rows.file)) != 1 else "within one recording"
    return [
        f"label {label} has {counted(counts[label], 'group')} {what}; with fewer than {MIN_GROUPS} of each label, "
        "expect lower accuracy on another day, which the intervals do not cover; add recordings of other days"
    ]


def cross_validate(
    training_set: TrainingSet, progress: Callable[[int], object] | None = None, workers: Workers = SERIAL
) -> CrossValidation:
    """Return the probabilities for each group by the candidate chosen and trained on the others (the outer loop)."""
    rows = training_set.rows
    probabilities, selected = np.empty((len(rows.labels), len(np.unique(rows.labels)))), []
    again = np.zeros(rows.background.shape[:2] if len(rows.background) else (len(rows.labels), 0), rows.labels.dtype)
    folds = list(leave_groups_out(rows.labels, rows.group, training_set.seed))
    if not all(_teaches_all(rows.labels, fold) for fold in folds):
        raise BadData(
            "each label must be in two or more groups, since one is left out for the test; add recordings, or name "
            "smaller groups"
        )
    with closing(workers.each(_evaluate, training_set, folds)) as evaluation:
        for fold, (best, answers, in_backgrounds) in zip(folds, evaluation, strict=True):
            selected.append(best)
            probabilities[fold], again[fold] = answers, in_backgrounds
            if progress is not None:
                progress(1)
    return CrossValidation(probabilities[rows.is_recorded], tuple(selected), again[rows.is_recorded])


def final(
    training_set: TrainingSet, selection: Selection, workers: Workers = SERIAL
) -> tuple[ImpactClassifier, Floats]:
    """Return the chosen candidate trained on all rows, and the levels (n_rows,) of rows in held-out groups, else nan.

    The novelty limit comes from held-out groups, too.
    """
    only = replace(training_set, candidates=(training_set.candidates[selection.best],))
    folds = list(leave_groups_out(training_set.rows.labels, training_set.rows.group, training_set.seed))
    distances, levels = [], np.full(len(training_set.rows.labels), np.nan)
    for fold, (distance, level) in zip(folds, workers.each(_held_out, only, folds), strict=True):
        distances.append(distance)
        levels[fold] = level
    classifier = _fitted(training_set, training_set.candidates[selection.best], rejects=True)
    limit = float(np.quantile(np.concatenate(distances), Neighbourhood.INSIDE))
    classifier.temperature_ = selection.temperature
    classifier.neighbourhood_ = replace(classifier.neighbourhood_, limit=limit)
    return classifier, levels


#: Standard deviation of the levels of a recording relative to that of its impacts (assumed), which counts as so many
#: groups; and relative variance of the upper end of n normal levels, times n.
_BETWEEN, _COUNTS_AS, _OF_UPPER_END = 0.3, 4, 1.5
#: Fewest rows of a recording whose level counts, and probability of a warning on either side of a sound recording.
_MIN_LEVELS_EACH, _FALSE_WARNING = 5, 0.0025


#: Impacts by which a wrong scale should be told.
_TOLD_BY = 20


def level_range(rows: Rows, levels: Floats) -> dict[str, float]:
    """Return the range of the upper end of the levels of a recording, and its uncertainty; empty without levels.

    The upper end of n levels is between "low" and "high", which differ by the labels, within the square root of
    "between" + "within" / n: by how much recordings differ, and their rows. `levels` (n_rows,) are those of rows that
    did not train.
    """
    counted = rows.is_recorded & np.isfinite(levels)
    if not counted.any():
        return {}
    rows, levels = rows[counted], levels[counted]
    n = len(levels)
    time, file, channel = (one if len(one) else np.zeros(n) for one in (rows.time, rows.file, rows.channel))
    label = np.unique(rows.labels, return_inverse=True)[1]
    offsets = np.bincount(label, levels) / np.bincount(label)
    residuals = levels - offsets[label]
    deviation = max(float(residuals.std()), 1e-6)
    # A channel is warned on its own. Rows in order of time, because neighbours may be alike.
    order = np.lexsort((time, file, channel, rows.group))
    keys = np.stack([rows.group.astype(str), channel.astype(str)])[:, order]
    units = np.split(residuals[order], np.flatnonzero((keys[:, 1:] != keys[:, :-1]).any(axis=0)) + 1)
    units = [unit for unit in units if len(unit) >= _MIN_LEVELS_EACH] or [residuals]
    ends = np.array([upper_end(unit, deviation) for unit in units])
    centre, within = float(ends.mean()), _OF_UPPER_END * deviation**2
    blocks = [[upper_end(part, deviation) for part in _parts(unit)] for unit in units if len(unit) >= MIN_LEVELS]
    n_free = sum(len(unit) - 1 for unit in blocks)
    if n_free:
        within = max(within, MIN_LEVELS * sum(float(np.var(unit)) * len(unit) for unit in blocks) / n_free)
    # Blocks of time of one recording do not show how recordings differ.
    n_groups = len(np.unique(rows.group)) if len(set(rows.digests)) > 1 and len(units) > 1 else 1
    found = float(np.var(ends)) * len(ends) / max(len(ends) - 1, 1) - float(np.mean([within / len(u) for u in units]))
    counts = _COUNTS_AS + n_groups - 1
    between = (_COUNTS_AS * (_BETWEEN * deviation) ** 2 + (n_groups - 1) * max(found, 0.0)) / counts
    chance = float(stats.t.isf(_FALSE_WARNING, counts)) ** 2
    return {
        "deviation": deviation,
        "low": centre + float(offsets.min()),
        "high": centre + float(offsets.max()),
        "between": chance * (between * (1 + 1 / n_groups) + within / n),
        "within": chance * within,
    }


def untold_scale(levels: Mapping[str, float]) -> str:
    """Return in one line up to which factor a wrong scale of a model with levels is not told; empty without levels."""
    if not levels:
        return ""
    # All impacts may be of the label whose levels are lowest, or highest.
    factor = np.exp(levels["high"] - levels["low"] + np.sqrt(levels["between"] + levels["within"] / _TOLD_BY))
    return (
        f"the model looks at levels: a scale wrong by less than {factor:.1f} times (unit, sensitivity, gain) changes "
        f"its answers and is not told by {_TOLD_BY} impacts"
    )


def _parts(levels: Floats) -> list[Floats]:
    """Return successive levels in blocks of `MIN_LEVELS`, without what remains."""
    n = len(levels) // MIN_LEVELS
    return list(levels[: n * MIN_LEVELS].reshape(n, MIN_LEVELS))


def noise_guard(training_set: TrainingSet, selection: Selection, workers: Workers = SERIAL) -> Contrast | None:
    """Return the noise novelty of windows; None without noisy copies."""
    # Its limit includes recorded windows, and copies with a recognisable label.
    if not np.isfinite(training_set.rows.snr).any():
        return None
    only = replace(training_set, candidates=(training_set.candidates[selection.best],))
    folds = list(leave_groups_out(training_set.rows.labels, training_set.rows.group, training_set.seed))
    scores = np.concatenate(list(workers.each(_noise_scores, only, folds)))
    limit = max(float(np.quantile(scores, Neighbourhood.INSIDE)), -CLEAR * np.log(10) / 10)
    return replace(_contrast(only, training_set.rows), limit=limit)


# -- one fold, in any process -----------------------------------------------------------------------------


def _scores_of_all(training_set: TrainingSet, fold: NDArray[np.bool_]) -> Floats:
    """Return the scores of a fold by each candidate trained on the other rows, (n_candidates, n_rows, n_labels)."""
    with threadpool_limits(1):
        return np.stack([_scores(candidate, training_set, fold) for candidate in training_set.candidates])


def _evaluate(training_set: TrainingSet, fold: NDArray[np.bool_]) -> tuple[int, Floats, NDArray[np.str_]]:
    """Return the candidate chosen on the other rows, its probabilities for the fold, and its answers in backgrounds."""
    with threadpool_limits(1):
        selection = choose_candidate(replace(training_set, rows=training_set.rows[~fold]))
        candidate = training_set.candidates[selection.best]
        rows, classifier = training_set.rows, _fitted(training_set, candidate, ~fold)
        scores = _scores_by(classifier, rows.only(candidate.features, fold).columns(candidate.features))
        again = np.zeros((int(fold.sum()), 0), rows.labels.dtype)
        if len(rows.background):
            again = in_backgrounds(classifier.predict, rows.background[fold][:, :, rows.places(candidate.features)])
        return selection.best, softmax(scores / selection.temperature), again


def _held_out(training_set: TrainingSet, fold: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return the distances of the clear rows of a fold from the other rows, and the levels of all its rows."""
    (candidate,), rows = training_set.candidates, training_set.rows
    with threadpool_limits(1):
        without, inputs = _fitted(training_set, candidate, ~fold, rejects=True), rows.columns(candidate.features)
        novelty = without.novelty(inputs[fold & rows.is_clear])
        standardiser, neighbourhood = without.standardiser_, without.neighbourhood_
        weights = level_weights(inputs_of(candidate.features, rows.n_channels), standardiser, neighbourhood)
        levels = np.full(int(fold.sum()), np.nan) if weights is None else standardiser.apply(inputs[fold]) @ weights[0]
    return novelty * without.neighbourhood_.limit, levels


def _noise_scores(training_set: TrainingSet, fold: NDArray[np.bool_]) -> Floats:
    """Return the noise novelty of the recorded rows of a fold by the other rows, for the only candidate."""
    with threadpool_limits(1):
        inputs = training_set.rows[fold & training_set.rows.is_recorded].columns(training_set.candidates[0].features)
        return _contrast(training_set, training_set.rows[~fold]).scores(inputs)


def _contrast(training_set: TrainingSet, rows: Rows) -> Contrast:
    features = training_set.candidates[0].features
    copies = rows[np.isfinite(rows.snr)]
    return noise_contrast(copies.columns(features), copies.snr, linear_columns(features * rows.n_channels))


def _teaches_all(labels: NDArray[np.str_], fold: NDArray[np.bool_]) -> bool:
    return len(np.unique(labels[~fold])) == len(np.unique(labels))


def _fitted(
    training_set: TrainingSet, candidate: Candidate, selected: NDArray[np.bool_] | None = None, *, rejects: bool = False
) -> ImpactClassifier:
    """Return a candidate trained on the chosen rows, or on all."""
    clear = training_set.rows.is_clear
    used = clear if selected is None else selected & clear
    rows = training_set.rows.only(candidate.features, used)
    inputs, labels = rows.columns(candidate.features), rows.labels
    if training_set.copies:
        # The silence of a group that is left out does not train.
        every = training_set.rows
        known = used & np.isin(every.donor, every.group[used])
        copies = every.background[known, OTHER][:, every.places(candidate.features)]
        measured = np.isfinite(copies).all(axis=1)
        inputs = np.concatenate([inputs, copies[measured]])
        labels = np.concatenate([labels, every.labels[known][measured]])
    classifier = ImpactClassifier(
        candidate.family,
        linear=linear_columns(candidate.features * rows.n_channels),
        calibration_folds=0,  # held-out groups calibrate
        class_weight=training_set.weights,
        rejects=rejects,
        random_state=training_set.seed,
    )
    return classifier.fit(inputs, labels)


def _scores(candidate: Candidate, training_set: TrainingSet, fold: NDArray[np.bool_]) -> Floats:
    """Return the scores of a fold by a candidate trained on the other rows, (n_rows, n_labels)."""
    left_out = training_set.rows.only(candidate.features, fold).columns(candidate.features)
    return _scores_by(_fitted(training_set, candidate, ~fold), left_out)


def _scores_by(classifier: ImpactClassifier, inputs: Floats) -> Floats:
    scores = classifier.decision_function(inputs)
    return np.stack([np.zeros(len(scores)), scores], axis=1) if scores.ndim == 1 else scores

"""The ceiling from below: the accuracy of a learner on the output of the estimator.

It is judged on the signals of the ceiling, so that most of the statistical error cancels in the difference.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.ceiling.bayes import MOST_SIGNALS, Ceiling, ceiling
from cgid.errors import InvalidValue
from cgid.measure.features import extract_array
from cgid.scene import Scene, synthesise
from cgid.validation import Floats

#: Features whose logarithms are the inputs of the learner.
_POSITIVE = ("fitted_peak", "fitted_width", "fitted_restitution", "fitted_restitution_deviation")
#: Fewest signals to train a learner on.
FEWEST = 100
#: Share of the training signals held out to decide between the learners, and units of the network's layers.
_HELD_BACK = 0.2
_NEURONS = (32, 32)


@dataclass(frozen=True)
class Learner:
    """The result of a learner.

    Attributes
    ----------
    n_signals : int
        Training signals.
    kind : str
        "network" or "quadratic", the better one on a held-out part of the training; "guess" if neither can be trained.
    hits : ndarray of bool, (n_test,)
        Whether it was right. For a signal that cannot be measured the answer is the most frequent label.
    difference, difference_error : float
        Accuracy of the ceiling's answers minus the learner's, on the same signals, and the standard error.
    regret, regret_error : float
        The same with the ceiling's probabilities in place of the truth, which reduces the statistical error.
    """

    n_signals: int
    kind: str
    hits: NDArray[np.bool_]
    difference: float
    difference_error: float
    regret: float
    regret_error: float

    @property
    def accuracy(self) -> float:
        """Share of right answers."""
        return float(self.hits.mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.hits.std(ddof=1) / np.sqrt(len(self.hits)))


@dataclass(frozen=True)
class Bracket:
    """The ceiling and the learners below it.

    Attributes
    ----------
    ceiling : Ceiling
    learners : tuple of Learner
        By the number of training signals.
    unmeasured : int
        Test signals that cannot be measured.
    """

    ceiling: Ceiling
    learners: tuple[Learner, ...]
    unmeasured: int


def sizes_up_to(highest: int) -> tuple[int, ...]:
    """Return 1,000, 3,000, 10,000, ... and finally `highest`.

    >>> sizes_up_to(20_000)
    (1000, 3000, 10000, 20000)
    """
    if validation.count("learner", highest) < FEWEST:
        raise InvalidValue(f"learner must have at least {FEWEST} signals to train on, got {highest}; give more")
    if highest > MOST_SIGNALS:
        raise InvalidValue(f"learner must have at most {MOST_SIGNALS} signals to train on, got {highest}; give fewer")
    steps = [base * 10**power for power in range(3, 10) for base in (1, 3)]
    return (*(step for step in steps if step < highest), highest)


def bracket(
    scene: Scene,
    sizes: tuple[int, ...] = (1_000, 3_000, 10_000),
    n_test: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    limit: Ceiling | None = None,
    progress: Callable[[int], object] | None = None,
) -> Bracket:
    """Return the ceiling of a scene and the accuracy of learners below it.

    Parameters
    ----------
    scene : Scene
    sizes : tuple of int
        Numbers of training signals; each set contains the smaller ones. Their seed differs from that of the test.
    n_test, seed, drop_height_known
        As in `ceiling`.
    limit : Ceiling, optional
        The ceiling of the same signals, if already known.
    progress : callable, optional
        Called with the number of signals done.

    Returns
    -------
    Bracket

    Raises
    ------
    InvalidValue
        As `ceiling`, or a size is out of range.
    """
    for size in sizes or (0,):
        sizes_up_to(size)
    if limit is None:
        limit = ceiling(scene, n_test, seed, drop_height_known=drop_height_known, progress=progress)
    test, truth = _measured(scene, n_test, seed, drop_height_known, progress)
    if not np.array_equal(truth, limit.truth):
        raise InvalidValue(f"limit must be the ceiling of the {n_test} signals of seed {seed}, it is of others")
    inputs, labels = _measured(scene, max(sizes), seed + 1 if seed < 2**63 - 1 else 0, drop_height_known, progress)
    learners = [_learn(inputs[:size], labels[:size], test, limit) for size in sorted(sizes)]
    return Bracket(limit, tuple(learners), int((~np.isfinite(test).all(axis=1)).sum()))


def _measured(
    scene: Scene, n_signals: int, seed: int, drop_height_known: bool, progress: Callable[[int], object] | None
) -> tuple[Floats, NDArray[np.str_]]:
    """Return the inputs of the learner, nan where a signal cannot be measured, and the labels."""
    rows, labels = [], []
    for batch in synthesise(scene, n_signals, seed):
        values = extract_array(
            batch.signals, batch.sampling_rate, _POSITIVE, pre_trigger=batch.pre_trigger, invalid="nan"
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            columns = [np.log(values)]
        if drop_height_known:
            # 2 ln(velocity), which all scenes have, is the logarithm of the height up to a constant.
            columns.append(2 * np.log(batch.parameters["velocity"])[:, None])
        rows.append(np.hstack(columns))
        labels.append(batch.labels)
        if progress is not None:
            progress(len(batch))
    return np.concatenate(rows), np.concatenate(labels)


def _learn(inputs: Floats, labels: NDArray[np.str_], test: Floats, limit: Ceiling) -> Learner:
    from threadpoolctl import threadpool_limits

    # Numbers, because in scikit-learn before 1.8 early stopping of a network fails with string labels.
    names, numbers, counts = np.unique(labels, return_inverse=True, return_counts=True)
    sound = np.isfinite(inputs).all(axis=1)
    measured = np.isfinite(test).all(axis=1)
    answers = np.full(len(test), names[counts.argmax()], dtype=names.dtype)
    kind = "guess"
    if len(np.unique(numbers[sound])) > 1 and measured.any():
        with threadpool_limits(1), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a network need not converge
            kind, model = _best(inputs[sound], numbers[sound])
            answers[measured] = names[model.predict(test[measured])]
    return _judged(len(inputs), kind, answers, limit)


def _best(inputs: Floats, labels: NDArray[np.intp]) -> tuple[str, Any]:
    """Return the learner that is better on a held-out part, retrained on all signals."""
    held = max(int(_HELD_BACK * len(inputs)), 1)
    scores = {}
    for kind in ("quadratic", "network"):
        if len(np.unique(labels[held:])) > 1:
            scores[kind] = (
                _learner(kind, len(inputs) - held).fit(inputs[held:], labels[held:]).score(inputs[:held], labels[:held])
            )
    kind = max(scores, key=lambda name: scores[name]) if scores else "quadratic"
    return kind, _learner(kind, len(inputs)).fit(inputs, labels)


def _learner(kind: str, n_signals: int) -> Any:
    from sklearn.linear_model import LogisticRegression
    from sklearn.neural_network import MLPClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    if kind == "quadratic":
        return make_pipeline(StandardScaler(), PolynomialFeatures(2), LogisticRegression(C=10.0, max_iter=1000))
    network = MLPClassifier(
        _NEURONS,
        alpha=1e-3,
        batch_size=min(256, n_signals),
        early_stopping=n_signals >= 1000,
        n_iter_no_change=8,
        max_iter=80,
        random_state=0,
    )
    return make_pipeline(StandardScaler(), network)


def _judged(n_signals: int, kind: str, answers: NDArray[np.str_], limit: Ceiling) -> Learner:
    hits = answers == limit.truth
    lost = limit.hits.astype(float) - hits
    given = np.searchsorted(np.array(limit.labels), answers)
    regret = limit.probabilities.max(axis=1) - limit.probabilities[np.arange(len(answers)), given]
    root = np.sqrt(len(answers))
    return Learner(
        n_signals=n_signals,
        kind=kind,
        hits=hits,
        difference=float(lost.mean()),
        difference_error=float(lost.std(ddof=1) / root),
        regret=float(regret.mean()),
        regret_error=float(regret.std(ddof=1) / root),
    )

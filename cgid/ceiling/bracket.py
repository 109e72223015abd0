"""The ceiling from below: what a strong learner reaches on the estimator's own output, the more it sees.

Judged on the very signals of the ceiling, so that most of the chance in both cancels in their difference.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
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

#: What the learner is given the logarithms of.
_POSITIVE = ("fitted_peak", "fitted_width", "fitted_restitution", "fitted_restitution_deviation")
#: Fewest signals that a learner can be trained on.
FEWEST = 100
#: Share of the training that decides between the learners, and the neurons of the network.
_HELD_BACK = 0.2
_NEURONS = (32, 32)


@dataclass(frozen=True)
class Learner:
    """What a learner reached.

    Attributes
    ----------
    n_signals : int
        It was trained on.
    kind : str
        "network" or "quadratic", whichever did better on signals held back from the training.
    hits : ndarray of bool, (n_test,)
        Where it was right; a signal that cannot be measured is taken for the commonest label.
    difference, difference_error : float
        Accuracy of the ceiling's answers less its own, on the same signals, and the standard error.
    regret, regret_error : float
        The same by the ceiling's probabilities in place of the truth: far less chance, as certain as these are.
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
    """The ceiling and what a learner reached below it.

    Attributes
    ----------
    ceiling : Ceiling
    learners : tuple of Learner
        By the number of signals they were trained on.
    unmeasured : int
        Test signals that cannot be measured.
    """

    ceiling: Ceiling
    learners: tuple[Learner, ...]
    unmeasured: int


def sizes_up_to(highest: int) -> tuple[int, ...]:
    """Return 1,000, 3,000, 10,000, ... and last `highest`.

    Examples
    --------
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
    permute_labels: bool = False,
    limit: Ceiling | None = None,
    progress: Callable[[int], object] | None = None,
) -> Bracket:
    """Return the ceiling of a scene and what a learner reaches below it.

    Parameters
    ----------
    scene : Scene
    sizes : tuple of int
        Numbers of signals to train on, each set holding the one before. They are of another seed than the test.
    n_test, seed, drop_height_known
        Of the ceiling, as in `ceiling`.
    permute_labels : bool
        Whether the learner is trained on labels in random order: a check, accuracy must be that of guessing.
    limit : Ceiling, optional
        That of these very signals, where it is there already.
    progress : callable, optional
        Called with the number of signals done.

    Raises
    ------
    InvalidValue
        As `ceiling`, and if a size is too small to train on.
    """
    for size in sizes or (0,):
        sizes_up_to(size)
    if limit is None:
        limit = ceiling(scene, n_test, seed, drop_height_known=drop_height_known, progress=progress)
    test, truth = _measured(scene, n_test, seed, drop_height_known, progress)
    if not np.array_equal(truth, limit.truth):
        raise InvalidValue(f"limit must be the ceiling of the {n_test} signals of seed {seed}, it is of others")
    inputs, labels = _measured(scene, max(sizes), _training_seed(seed), drop_height_known, progress)
    if permute_labels:
        labels = np.random.default_rng(seed).permutation(labels)
    learners = [_learn(inputs[:size], labels[:size], test, limit) for size in sorted(sizes)]
    return Bracket(limit, tuple(learners), int((~np.isfinite(test).all(axis=1)).sum()))


def _training_seed(seed: int) -> int:
    return seed + 1 if seed < 2**63 - 1 else 0


def _measured(
    scene: Scene, n_signals: int, seed: int, drop_height_known: bool, progress: Callable[[int], object] | None
) -> tuple[Floats, NDArray[np.str_]]:
    """Return what the learner is given, nan where a signal cannot be measured, and the labels."""
    rows, labels = [], []
    for batch in _several(synthesise(scene, n_signals, seed)):
        values = [
            extract_array(b.signals, b.sampling_rate, _POSITIVE, pre_trigger=b.pre_trigger, invalid="nan")
            for b in batch
        ]
        with np.errstate(invalid="ignore", divide="ignore"):
            columns = [np.log(np.concatenate(values))]
        if drop_height_known:
            # By the speed at touch, which scenes that give a velocity know, too: their logarithms differ by a constant.
            columns.append(2 * np.log(np.concatenate([b.parameters["velocity"] for b in batch]))[:, None])
        rows.append(np.hstack(columns))
        labels += [b.labels for b in batch]
        if progress is not None:
            progress(sum(map(len, batch)))
    return np.concatenate(rows), np.concatenate(labels)


def _several(batches: Iterator[Any]) -> Iterator[list[Any]]:
    held = []
    for batch in batches:
        held.append(batch)
        if len(held) == 4:
            yield held
            held = []
    if held:
        yield held


def _learn(inputs: Floats, labels: NDArray[np.str_], test: Floats, limit: Ceiling) -> Learner:
    from threadpoolctl import threadpool_limits

    # By their numbers: scikit-learn before 1.8 cannot stop a network early that learns texts.
    names, numbers, counts = np.unique(labels, return_inverse=True, return_counts=True)
    sound = np.isfinite(inputs).all(axis=1)
    measured = np.isfinite(test).all(axis=1)
    answers = np.full(len(test), names[counts.argmax()], dtype=names.dtype)
    kind = "guess"
    if len(np.unique(numbers[sound])) > 1 and measured.any():
        with threadpool_limits(1), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a network that has not converged is judged by what it does
            kind, model = _best(inputs[sound], numbers[sound])
            answers[measured] = names[model.predict(test[measured])]
    return _judged(len(inputs), kind, answers, limit)


def _best(inputs: Floats, labels: NDArray[np.intp]) -> tuple[str, Any]:
    """Return the learner that is right more often on signals held back, trained on all."""
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
        n_signals,
        kind,
        hits,
        float(lost.mean()),
        float(lost.std(ddof=1) / root),
        float(regret.mean()),
        float(regret.std(ddof=1) / root),
    )

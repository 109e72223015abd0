"""From labelled batches to a model: measure, split by specimen, fit, calibrate, judge."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid import __version__, validation
from cgid.errors import BadData, InvalidValue
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.conformal import Conformal
from cgid.identification.measuring import Measured, chosen_for, default_guards, measure
from cgid.identification.metrics import evaluate, evaluate_sets
from cgid.identification.model import Model
from cgid.identification.transform import Neighbourhood
from cgid.measure.features import FEATURES, choose
from cgid.signals import Batch
from cgid.units import quantity_of
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: Share of the specimens that only judge.
TEST_SHARE = 0.25
#: Share of the specimens that only calibrate the prediction sets.
CALIBRATION_SHARE = 0.1
#: Guards that may be 0 in all of the training have a limit all the same: a pulse cut off by 5 % is taken.
LEAST_LIMITS = {"overload": 0.05}
#: With fewer specimens of a label to calibrate on, all of them train: a promise of .95 takes 19.
FEWEST_CALIBRATION_SPECIMENS = 20


@dataclass(frozen=True)
class Training:
    """A trained model and what it answered for the impacts held out.

    Attributes
    ----------
    model : Model
    metrics : dict
        See `cgid.identification.metrics.evaluate` and `evaluate_sets` (under "prediction_sets").
    test_labels : ndarray of str
    test_probabilities : ndarray, (n_test, n_labels)
    classifier : ImpactClassifier
        The scikit-learn estimator behind the model.
    """

    model: Model
    metrics: dict[str, Any]
    test_labels: NDArray[np.str_]
    test_probabilities: Floats
    classifier: ImpactClassifier


def hold_out(
    labels: NDArray[np.str_], specimen: NDArray[np.uint64], share: float = TEST_SHARE, seed: int = 0
) -> NDArray[np.bool_]:
    """Return which impacts are held out: whole specimens, the same share of each label.

    Raises
    ------
    InvalidValue
        The share is not between 0 and 1, or a label has too few specimens for one on either side.
    """
    if not 0 < share < 1:
        raise InvalidValue(f"test share must lie between 0 and 1, got {share:g}")
    generator = np.random.default_rng(seed)
    held: list[NDArray[np.uint64]] = []
    for label in np.unique(labels):
        own = np.unique(specimen[labels == label])
        if len(own) < 2:
            raise InvalidValue(
                f"label {label} must have at least 2 specimens, one to train and one to judge, got {len(own)}"
            )
        count = min(max(round(share * len(own)), 1), len(own) - 1)
        held.append(generator.permutation(own)[:count])
    return np.isin(specimen, np.concatenate(held))


def set_apart(
    labels: NDArray[np.str_],
    specimen: NDArray[np.uint64],
    test: NDArray[np.bool_],
    share: float = CALIBRATION_SHARE,
    seed: int = 0,
) -> NDArray[np.bool_]:
    """Return which impacts that do not judge calibrate: whole specimens, the same share of each label.

    No impact does when the share is 0, or is fewer than `FEWEST_CALIBRATION_SPECIMENS` of a label.

    Raises
    ------
    InvalidValue
        The share is not between 0 and 1, or nothing is left to train on.
    """
    if not 0 <= share < 1:
        raise InvalidValue(f"calibration share must lie between 0 and 1, got {share:g}")
    apart = np.zeros(len(labels), bool)
    counts = [len(np.unique(specimen[labels == label])) for label in np.unique(labels)]
    if share * min(counts) < FEWEST_CALIBRATION_SPECIMENS:
        return apart
    left = 1 - len(np.unique(specimen[test])) / sum(counts)
    if share >= left:
        raise InvalidValue(f"test and calibration share must leave some to train on, got {1 - left:.3g} and {share:g}")
    # Another seed than that of the test, or the same ranks of the same specimens would be drawn.
    apart[~test] = hold_out(labels[~test], specimen[~test], share / left, seed + 1)
    return apart


def train(
    batches: Iterable[Batch],
    *,
    features: Iterable[str] | None = None,
    guards: Iterable[str] | None = None,
    known: Iterable[str] = (),
    family: str = "logistic",
    test_share: float = TEST_SHARE,
    calibration_share: float = CALIBRATION_SHARE,
    seed: int = 0,
    judged_on: str | None = None,
    class_weights: Mapping[str, float] | str | None = None,
    shuffle_labels: bool = False,
    selection: Sequence[Mapping[str, Any]] | None = None,
    progress: Callable[[int], object] | None = None,
    crew: Workers = ALONE,
) -> Training:
    """Train a model on labelled impacts and judge it on specimens it has not seen.

    One thread does each fit, so that the same data give the same model to the last digit wherever many are allowed.

    Parameters
    ----------
    batches : iterable of Batch
        A dataset's, or a scene's as it is synthesised.
    features : iterable of str, optional
        Names of features; if not given, what `cgid.identification.measuring` has for the quantity.
    guards : iterable of str, optional
        Features that only say how strange an impact is: the larger, the stranger. They are left out of `features`.
        If not given, `DEFAULT_GUARDS` for features of pulses, none for those of vibrations.
    known : iterable of str
        What the model is told beside the signal, out of `cgid.identification.known.KNOWN`.
    family : {"boosting", "discriminant", "logistic", "network"}
    test_share : float
        Share of the specimens held out, in (0, 1).
    calibration_share : float
        Share of the specimens that only calibrate the prediction sets, in [0, 1); 0 for none.
    seed : int
        Of the splits, the folds and the network.
    judged_on : str, optional
        The `source` of the batches that judge and calibrate the prediction sets; all others only train. By default
        every source does all.
    class_weights : dict or "balanced", optional
        What an impact of a label counts: see `cgid.identification.classifier.ImpactClassifier`.
    shuffle_labels : bool
        A check of the method: labels are shuffled first, so the accuracy must be that of guessing.
    selection : sequence of dict, optional
        How the family was chosen (`cgid.identification.selection.select`), for the model card.
    progress : callable, optional
        Called with the number of signals measured.
    crew : Workers
        Who measures, and fits the folds that calibrate: see `cgid.workers.workers`.

    Raises
    ------
    BadData
        There are fewer than two labels, nothing to train on, or nobody says what has to be known.
    InvalidValue
        A choice is unknown, a label has a single specimen, or a guard is no positive number.
    """
    batches, names = chosen_for(batches, features)
    guards = default_guards(names) if guards is None else tuple(guards)
    guards = choose(guards) if guards else ()
    names = tuple(name for name in names if name not in guards)
    known = tuple(known)
    with threadpool_limits(1):
        measured = measure(batches, names + guards, progress, known=known, crew=crew)
        labels, specimen = measured.labels, measured.specimen
        _require_two(labels)
        if shuffle_labels:
            # Among the specimens, so that the split that is checked is the one that is used.
            _, first, own = np.unique(specimen, return_index=True, return_inverse=True)
            labels = np.random.default_rng(seed).permutation(labels[first])[own]
        home = _home(measured, judged_on)
        test, calibration = np.zeros_like(home), np.zeros_like(home)
        test[home] = hold_out(labels[home], specimen[home], test_share, seed)
        calibration[home] = set_apart(labels[home], specimen[home], test[home], calibration_share, seed)
        # A particle that judges trains nowhere, not even as it fell in another source.
        training = ~np.isin(specimen, specimen[test | calibration])
        inputs = np.hstack([measured.features[:, : len(names)], measured.known])
        check_class_weights(class_weights, np.unique(labels))
        classifier = ImpactClassifier(
            family=family, linear=linear_columns(names), class_weight=class_weights, random_state=seed
        )
        classifier.fit(inputs[training], labels[training], specimen[training], crew=crew)
        conformal = _calibrated(classifier, inputs[calibration], labels[calibration], specimen[calibration], seed)
        probabilities = classifier.predict_proba(inputs[test])
    metrics = _judged(labels[test], probabilities, classifier, conformal, len(np.unique(specimen[test])))
    parts = {"train": training, "calibration": calibration, "test": test}
    model = Model.from_classifier(
        classifier,
        features=names,
        known=known,
        guards=_guard_limits(guards, measured.features[training, len(names) :]),
        conformal=conformal,
        unit=measured.unit,
        sampling_rates=measured.sampling_rates,
        training={
            **_origin(measured),
            **{f"n_{part}_specimens": len(np.unique(specimen[rows])) for part, rows in parts.items()},
            "n_train": int(training.sum()),
            "seed": seed,
            "test_share": test_share,
            "calibration_share": calibration_share,
            "labels_shuffled": shuffle_labels,
            "judged_on": judged_on,
            **({} if class_weights is None else {"class_weights": class_weights}),
            "metrics": metrics,
            **({} if selection is None else {"selection": [dict(row) for row in selection]}),
        },
    )
    return Training(model, metrics, labels[test], probabilities, classifier)


def check_class_weights(weights: Mapping[str, float] | str | None, labels: NDArray[np.str_]) -> None:
    """Raise `InvalidValue` unless weights are those of labels that there are, and above 0."""
    for label, weight in weights.items() if isinstance(weights, Mapping) else ():
        validation.choice("label of class_weights", label, tuple(labels.tolist()))
        validation.positive(f"class weight of {label}", weight)


def linear_columns(features: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that never get a logarithm: they are logarithms already, or may be of either sign."""
    return tuple(column for column, name in enumerate(features) if FEATURES[name].linear)


def _home(measured: Measured, judged_on: str | None) -> NDArray[np.bool_]:
    """Return which impacts may judge."""
    if judged_on is None:
        return np.ones(len(measured.labels), bool)
    validation.choice("judged_on", judged_on, measured.sources)
    return np.asarray(measured.source == measured.sources.index(judged_on))


def _require_two(labels: NDArray[np.str_]) -> None:
    if len(np.unique(labels)) < 2:
        raise BadData(
            f"data must have at least 2 labels to tell apart, got {', '.join(np.unique(labels)) or 'none'}; "
            "add data of another material"
        )


def _calibrated(
    classifier: ImpactClassifier, inputs: Floats, labels: NDArray[np.str_], specimen: NDArray[np.uint64], seed: int
) -> Conformal | None:
    """Return the calibration by one impact of each specimen: those of one specimen are no independent trials."""
    if not len(labels):
        return None
    order = np.random.default_rng(seed).permutation(len(labels))
    one = order[np.unique(specimen[order], return_index=True)[1]]
    return Conformal.fit(classifier.predict_proba(inputs[one]), np.searchsorted(classifier.classes_, labels[one]))


def _judged(
    labels: NDArray[np.str_],
    probabilities: Floats,
    classifier: ImpactClassifier,
    conformal: Conformal | None,
    n_independent: int,
) -> dict[str, Any]:
    classes = tuple(str(label) for label in classifier.classes_)
    sets = [] if conformal is None else evaluate_sets(labels, probabilities, classes, conformal)
    return evaluate(labels, probabilities, classes, n_independent) | {"prediction_sets": sets}


def _guard_limits(guards: tuple[str, ...], values: Floats) -> dict[str, float]:
    limits = {
        name: max(float(np.quantile(column, Neighbourhood.INSIDE)), LEAST_LIMITS.get(name, 0.0))
        for name, column in zip(guards, values.T, strict=True)
    }
    for name, limit in limits.items():
        if limit <= 0:
            raise InvalidValue(
                f"guard {name} must be above 0 for strange impacts, {Neighbourhood.INSIDE:.1%} of the training "
                f"have at most {limit:g}; use it as a feature"
            )
    return limits


def _origin(measured: Measured) -> dict[str, Any]:
    return {
        "sources": list(measured.sources),
        "quantity": quantity_of(measured.unit),
        "n_left_out": measured.left_out,
        "versions": {"cgid": __version__, "python": platform.python_version()}
        | {name: version(name) for name in ("numpy", "scikit-learn")},
    }

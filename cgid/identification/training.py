"""From labelled batches to a model: measure, split by specimen, fit, judge."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid.errors import BadData, InvalidValue
from cgid.features import FEATURES, choose, extract_array
from cgid.identification.classifier import ImpactClassifier
from cgid.identification.metrics import evaluate
from cgid.identification.model import Model
from cgid.signals import Batch, quantity_of
from cgid.validation import Floats

#: What a model looks at by default: everything but the band energies, whose bands are in Hz and not in 1/T
#: and which bring nothing that the other spectral features do not say.
DEFAULT_FEATURES = tuple(name for name in FEATURES if not name.startswith("band_energy"))
#: Share of the specimens that only judge.
TEST_SHARE = 0.25


@dataclass(frozen=True)
class Measured:
    """The features of all labelled impacts.

    Attributes
    ----------
    features : ndarray, (n_impacts, n_features)
    labels : ndarray of str, (n_impacts,)
    specimen : ndarray of uint64, (n_impacts,)
    unit : str
    sampling_rates : tuple of float
    sources : tuple of str
    left_out : int
        Impacts that could not be measured.
    """

    features: Floats
    labels: NDArray[np.str_]
    specimen: NDArray[np.uint64]
    unit: str
    sampling_rates: tuple[float, float]
    sources: tuple[str, ...]
    left_out: int


@dataclass(frozen=True)
class Training:
    """A trained model and what it answered for the impacts held out.

    Attributes
    ----------
    model : Model
    metrics : dict
        See `cgid.identification.metrics.evaluate`.
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


def measure(
    batches: Iterable[Batch], features: Iterable[str] | None = None, progress: Callable[[int], object] | None = None
) -> Measured:
    """Return the features of labelled batches; memory holds one batch of signals at a time.

    Raises
    ------
    BadData
        There is no signal, or batches are of different quantities.
    """
    names = choose(DEFAULT_FEATURES if features is None else features)
    rows, labels, specimen, rates, sources = [], [], [], set(), []
    unit = ""
    for batch in batches:
        if unit and batch.unit != unit:
            raise BadData(f"all signals must be in one unit, got {unit} and {batch.unit}; convert or train apart")
        unit = batch.unit
        rows.append(
            extract_array(
                batch.signals, batch.sampling_rate, names, pre_trigger=batch.pre_trigger or None, invalid="nan"
            )
        )
        labels.append(batch.labels)
        sources += [batch.source] if batch.source not in sources else []
        specimen.append(batch.specimen)
        rates.add(batch.sampling_rate)
        if progress is not None:
            progress(len(batch))
    if not rows:
        raise BadData("there must be signals to train on; there are none")
    table = np.concatenate(rows)
    sound = np.isfinite(table).all(axis=1)
    return Measured(
        features=table[sound],
        labels=np.concatenate(labels)[sound],
        specimen=np.concatenate(specimen)[sound],
        unit=unit,
        sampling_rates=(min(rates), max(rates)),
        sources=tuple(sources),
        left_out=int((~sound).sum()),
    )


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


def train(
    batches: Iterable[Batch],
    *,
    features: Iterable[str] | None = None,
    family: str = "logistic",
    test_share: float = TEST_SHARE,
    seed: int = 0,
    shuffle_labels: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Training:
    """Train a model on labelled impacts and judge it on specimens it has not seen.

    Parameters
    ----------
    batches : iterable of Batch
        A dataset's, or a scene's as it is synthesised.
    features : iterable of str, optional
        Out of `cgid.features.FEATURES`; `DEFAULT_FEATURES` if not given.
    family : {"boosting", "discriminant", "logistic"}
    test_share : float
        Share of the specimens held out, in (0, 1).
    seed : int
        Of the split and the folds.
    shuffle_labels : bool
        A check of the method: labels are shuffled first, so the accuracy must be that of guessing.
    progress : callable, optional
        Called with the number of signals measured.

    Raises
    ------
    BadData
        There are fewer than two labels, or nothing to train on.
    InvalidValue
        A choice is unknown, or a label has a single specimen.
    """
    names = choose(DEFAULT_FEATURES if features is None else features)
    measured = measure(batches, names, progress)
    labels, specimen = measured.labels, measured.specimen
    if len(np.unique(labels)) < 2:
        raise BadData(
            f"data must have at least 2 labels to tell apart, got {', '.join(np.unique(labels)) or 'none'}; "
            "add data of another material"
        )
    if shuffle_labels:
        # Among the specimens, so that the split that is checked is the one that is used.
        _, first, own = np.unique(specimen, return_index=True, return_inverse=True)
        labels = np.random.default_rng(seed).permutation(labels[first])[own]
    test = hold_out(labels, specimen, test_share, seed)
    # Features without a unit may be of either sign: no logarithm for them.
    linear = tuple(column for column, name in enumerate(names) if FEATURES[name].unit == "1")
    classifier = ImpactClassifier(family=family, linear=linear, random_state=seed)
    classifier.fit(measured.features[~test], labels[~test], specimen[~test])
    probabilities = classifier.predict_proba(measured.features[test])
    classes = tuple(str(label) for label in classifier.classes_)
    metrics = evaluate(labels[test], probabilities, classes, n_independent=len(np.unique(specimen[test])))
    model = Model.from_classifier(
        classifier,
        features=names,
        unit=measured.unit,
        sampling_rates=measured.sampling_rates,
        training={
            "sources": list(measured.sources),
            "quantity": quantity_of(measured.unit),
            "seed": seed,
            "test_share": test_share,
            "n_train": int((~test).sum()),
            "n_train_specimens": len(np.unique(specimen[~test])),
            "n_test_specimens": len(np.unique(specimen[test])),
            "n_left_out": measured.left_out,
            "labels_shuffled": shuffle_labels,
            "versions": {"cgid": __version__, "python": platform.python_version()}
            | {name: version(name) for name in ("numpy", "scikit-learn")},
            "metrics": metrics,
        },
    )
    return Training(model, metrics, labels[test], probabilities, classifier)

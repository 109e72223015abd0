"""The scikit-learn estimator of all families: standardise, fit, calibrate by temperature, learn the training range."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar
from sklearn.base import BaseEstimator, ClassifierMixin, clone, is_classifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold
from sklearn.neural_network import MLPClassifier
from sklearn.utils.class_weight import compute_sample_weight
from sklearn.utils.metadata_routing import UNUSED
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, has_fit_parameter, validate_data
from threadpoolctl import ThreadpoolController

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid._lib.workers import Workers
from cgid.errors import InvalidValue
from cgid.identification.model.families import (
    Contrast,
    Fitted,
    Linear,
    Neighbourhood,
    Network,
    Standardiser,
    require_family,
    softmax,
    squares,
)
from cgid.measure.features.extraction import in_units, units_of

#: Maximum number of rows of either side in the training of a contrast, and its iterations.
_MAX_CONTRASTED, _CONTRAST_ITERATIONS = 100_000, 300
#: Fraction of the known rows inside the limit of a contrast: .86 instead of .81 of `anything` are rejected if .3 %
#: instead of .1 % of the known rows are.
_INSIDE = 0.997

Weights = Mapping[str, float] | str | None


@cache
def _libraries() -> ThreadpoolController:
    # Finding them takes longer than a fit; this module has loaded all that a fit needs.
    return ThreadpoolController()


class ShrunkenDiscriminant(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Linear discriminant analysis with a shrunken covariance: that of scikit-learn in a fifth of the time."""

    # A nested cross-validation fits it a thousand times on many features and few recordings.

    def fit(self, X: Floats, y: NDArray[Any], sample_weight: Floats | None = None) -> ShrunkenDiscriminant:
        """Fit to features (n_rows, n_features) and labels (n_rows,) with weights above 0."""
        # The weights of a class count for its prior probability; within the class only their ratios count.
        self.classes_, encoded = np.unique(y, return_inverse=True)
        counts = np.bincount(encoded, sample_weight)
        priors = counts / counts.sum()
        within = np.ones(len(X)) if sample_weight is None else sample_weight * (np.bincount(encoded) / counts)[encoded]
        means = np.stack(
            [np.average(X[encoded == k], axis=0, weights=within[encoded == k]) for k in range(len(self.classes_))]
        )
        self.covariance_ = _shrunken_covariance((X - means[encoded]) * np.sqrt(within)[:, None], encoded, priors)
        # A ridge near rounding, so that the factor exists if a feature is constant.
        ridge = 1e-10 * max(float(np.trace(self.covariance_)) / X.shape[1], np.finfo(float).tiny)
        factor = cho_factor(self.covariance_ + ridge * np.eye(X.shape[1]))
        coefficients = cho_solve(factor, means.T).T
        intercepts = np.log(priors) - 0.5 * np.sum(means * coefficients, axis=1)
        if len(self.classes_) == 2:
            coefficients, intercepts = np.diff(coefficients, axis=0), np.diff(intercepts)
        self.coef_, self.intercept_ = coefficients, intercepts
        return self

    def decision_function(self, X: Floats) -> Floats:
        """Return the scores of the classes; for two classes only those of the second."""
        scores = X @ self.coef_.T + self.intercept_
        return np.asarray(scores[:, 0] if len(self.classes_) == 2 else scores)


def _shrunken_covariance(centred: Floats, encoded: NDArray[np.intp], priors: Floats) -> Floats:
    """Return the mean of the classes' covariances by prior, each shrunken to a diagonal one."""
    weights, diagonal = np.empty(len(centred)), np.zeros(centred.shape[1])
    for k, prior in enumerate(priors):
        rows = centred[encoded == k]
        spread = rows.std(axis=0)  # scaled features: units do not matter
        spread[spread <= 1e-12 * np.abs(rows).max(axis=0)] = 1.0
        share, variance = _shrinkage(rows / spread)
        weights[encoded == k] = prior * (1 - share) / len(rows)
        diagonal += prior * share * variance * spread**2
    weighted = centred * np.sqrt(weights)[:, None]
    return np.asarray(weighted.T @ weighted + np.diag(diagonal))


def _shrinkage(centred: Floats) -> tuple[float, float]:
    """Return the Ledoit-Wolf (2004) shrinkage towards a multiple of the identity, and that multiple."""
    n_rows, n_features = centred.shape
    lengths = np.square(centred).sum(axis=1)
    # Products of rows or of columns have the same sum of squares; there are fewer of the fewer ones.
    products = centred @ centred.T if n_rows < n_features else centred.T @ centred
    variance = float(lengths.sum()) / (n_rows * n_features)
    size = float(np.sum(products**2)) / n_rows**2
    distance = size - n_features * variance**2
    noise = (float(np.sum(lengths**2)) / n_rows - size) / n_rows
    return (min(max(noise, 0.0), distance) / distance if distance > 0 else 0.0), variance


class _Perceptron(MLPClassifier):  # type: ignore[misc]
    """A scikit-learn network with a decision function: the scores before the softmax."""

    def fit(self, X: Floats, y: NDArray[Any], sample_weight: Floats | None = None) -> _Perceptron:
        with warnings.catch_warnings():
            # The number of iterations is fixed; convergence is not required.
            warnings.simplefilter("ignore", ConvergenceWarning)
            super().fit(X, y, sample_weight)
        return self

    def decision_function(self, X: Floats) -> Floats:
        arrays = Network.export(self)
        return Network(arrays, X.shape[1], len(self.classes_)).scores(X)


def _logistic(_: ImpactClassifier) -> Any:
    return LogisticRegression(C=10.0, solver="newton-cholesky", max_iter=100)


def _linear(_: ImpactClassifier) -> Any:
    return ShrunkenDiscriminant()


def _network(settings: ImpactClassifier) -> Any:
    # In the same time, L-BFGS on all impacts is better and more stable than Adam on batches.
    return _Perceptron(
        (settings.n_units, settings.n_units),
        activation="tanh",
        solver="lbfgs",
        alpha=1.0,
        max_iter=settings.n_iterations,
        random_state=settings.random_state,
    )


def contrast_of(known: Floats, others: Floats, linear: tuple[int, ...], seed: int) -> Contrast:
    """Return a contrast of known and other rows (n, n_features); its limit includes 99.7 % of the known."""
    pick = np.random.default_rng(seed)
    rows = [part[pick.permutation(len(part))[:_MAX_CONTRASTED]] for part in (known, others)]
    inputs, other = np.concatenate(rows), np.repeat([0, 1], [len(part) for part in rows])
    with _libraries().limit(limits=1):
        standardiser, standardised = Standardiser.fit(inputs, linear)
        network = _Perceptron(
            (32, 32), activation="tanh", solver="lbfgs", alpha=0.1, max_iter=_CONTRAST_ITERATIONS, random_state=seed
        ).fit(standardised, other)
        contrast = Contrast(standardiser, Network(Network.export(network), inputs.shape[1], 2), 0.0)
        return replace(contrast, limit=float(np.quantile(contrast.scores(known), _INSIDE)))


#: Powers over that of noise [dB] beyond which the level is clipped; ridge of the regression, per row.
_NOISE_RANGE, _NOISE_RIDGE = (-10.0, 25.0), 0.2


def noise_contrast(copies: Floats, snr: Floats, linear: tuple[int, ...]) -> Contrast:
    """Return a ridge regression of ln(noise power / window power) on noisy copies; the caller sets its limit."""
    standardiser, inputs = Standardiser.fit(copies, linear)
    targets = -np.clip(snr, *_NOISE_RANGE) * np.log(10) / 10
    middle = inputs.mean(axis=0)
    centred = inputs - middle
    ridge = _NOISE_RIDGE * len(inputs) * np.eye(inputs.shape[1])
    slopes = cho_solve(cho_factor(centred.T @ centred + ridge), centred.T @ (targets - targets.mean()))
    arrays = {"coefficients": slopes[None], "intercepts": np.array([targets.mean() - middle @ slopes])}
    return Contrast(standardiser, Linear(arrays, inputs.shape[1], 2), 0.0)


class ImpactClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Identifies the material of an impact from its features, with calibrated probabilities.

    Parameters
    ----------
    family : {"logistic", "network", "linear"} or classifier
        Logistic regression on features and their products; network of two hidden layers;
        linear discriminant analysis with a shrunken covariance, for many features and few recordings; or any classifier
        of scikit-learn's kind with scores or probabilities, which learns from standardised features.
    linear : tuple of int
        Columns that never get a logarithm; the others do if all their training values are above 0.
    n_units, n_iterations : int
        Units of each layer of a network, and iterations of its training.
    calibration_folds : int
        Folds of the temperature scaling of probabilities (Guo et al. 2017); 0 for no calibration.
    class_weight : dict or "balanced", optional
        Weight of an impact of each class, default 1; "balanced" gives all classes the same total weight.
    rejects : bool
        Learn the training range as well, for `novelty`.
    random_state : int
        Seed of the folds and the network's initial weights, and of a classifier whose own random_state is None.
    n_jobs : int, optional
        Processes that fit the folds of the calibration, as in scikit-learn: None for this one, -1 for all cores. The
        result is the same.

    Attributes
    ----------
    classes_ : ndarray
    standardiser_ : Standardiser
    estimator_ : fitted scikit-learn classifier of the family
    temperature_ : float
        Divisor of the scores.
    held_out_loss_ : float
        Log loss of the rows of the training, each by a fit without it; nan if they were too few for that.
    neighbourhood_ : Neighbourhood
        Only if `rejects`.
    units_ : dict
        Unit of each column, if the table of the training is a DataFrame whose `attrs["units"]` states it, as that of
        `cgid.extract`. Tables that state another scale, such as kN, are converted. pandas drops `attrs` easily;
        numbers without it must be in the units of the training.
    """

    #: Family -> function that returns its estimator for a classifier's settings.
    ESTIMATORS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {
        "logistic": _logistic,
        "network": _network,
        "linear": _linear,
    }
    #: For scikit-learn's routing of metadata: not one of them.
    __metadata_request__fit: ClassVar[Mapping[str, str]] = {"workers": UNUSED}

    def __init__(
        self,
        family: str | ClassifierMixin = "logistic",
        *,
        linear: tuple[int, ...] = (),
        n_units: int = 32,
        n_iterations: int = 200,
        calibration_folds: int = 3,
        class_weight: Weights = None,
        rejects: bool = True,
        random_state: int = 0,
        n_jobs: int | None = None,
    ) -> None:
        self.family = family
        self.linear = linear
        self.n_units = n_units
        self.n_iterations = n_iterations
        self.calibration_folds = calibration_folds
        self.class_weight = class_weight
        self.rejects = rejects
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        groups: ArrayLike | None = None,
        sample_weight: ArrayLike | None = None,
        *,
        workers: Workers | None = None,
    ) -> ImpactClassifier:
        """Fit to features (n_impacts, n_features) and labels (n_impacts,).

        A fold never splits one of the `groups` (n_impacts,), usually specimens. The `workers` fit the folds with one
        thread each, because the number of threads would change the last digits of sums.

        Parameters
        ----------
        X : array_like, (n_impacts, n_features)
            Features, in the order of the training.
        y : array_like, (n_impacts,)
            Labels.
        groups : array_like, (n_impacts,), optional
            Number of the specimen of each impact; those of one specimen stay together.
        sample_weight : array_like, (n_impacts,), optional
            Weight of each impact, 0 or more, times that of its class. A weight of 2 is not a row given twice where
            rows are counted: in the shrinkage of "linear", the folds of the calibration and
            the training range.
        workers : Workers, optional
            Processes for the fits, in place of `n_jobs`.

        Returns
        -------
        ImpactClassifier
            The fitted estimator.
        """
        estimator = self._unfitted()
        validation.plain("X", X)
        self.units_ = units_of(X)
        features, labels = validate_data(self, X, y, dtype=np.float64, ensure_min_samples=2)
        check_classification_targets(labels)
        group_array = None if groups is None else _one_group_a_row(groups, len(labels))
        given = None if sample_weight is None else _one_weight_a_row(sample_weight, len(labels))
        if given is not None:
            used = given > 0  # a row of no weight is as if it were not there
            features, labels, given = features[used], labels[used], given[used]
            group_array = None if group_array is None else group_array[used]
        self.classes_, encoded = np.unique(labels, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"classifier needs at least 2 classes, got 1 class: {self.classes_[0]!r}")
        _require_classes(self.class_weight, self.classes_)
        if any(not 0 <= column < features.shape[1] for column in self.linear):
            raise InvalidValue(f"linear must be columns of X, 0 to {features.shape[1] - 1}, got {self.linear}")
        weights = row_weights(labels, self.class_weight)
        if weights is not None or given is not None:
            _require_weights(estimator)
        if given is not None:
            weights = given if weights is None else given * weights
        crew = Workers(effective_n_jobs(self.n_jobs)) if workers is None else workers
        with _libraries().limit(limits=1):
            self.standardiser_, standardised = Standardiser.fit(features, self.linear, given)
            inputs = self._inputs(standardised)
            self.estimator_ = _fit(estimator, inputs, encoded, weights)
            if self.rejects:
                covariance = self.estimator_.covariance_ if self.family == "linear" else None
                self.neighbourhood_ = Neighbourhood.fit(standardised, encoded, covariance)
            self.temperature_, self.held_out_loss_ = self._temperature(inputs, encoded, weights, group_array, crew)
        return self

    def decision_function(self, X: ArrayLike) -> Floats:
        """Return the scores from which the probabilities follow.

        Parameters
        ----------
        X : array_like, (n_impacts, n_features)
            Features, in the order of the training.

        Returns
        -------
        ndarray, (n_impacts, n_classes), or (n_impacts,) for two classes
        """
        inputs = self._inputs(self._standardised(X))
        return self._scores(self.estimator_, inputs)

    def predict_proba(self, X: ArrayLike) -> Floats:
        """Return the probabilities.

        Parameters
        ----------
        X : array_like, (n_impacts, n_features)
            Features, in the order of the training.

        Returns
        -------
        ndarray, (n_impacts, n_classes)
            In the order of `classes_`.
        """
        return softmax(self.decision_function(X) / self.temperature_)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the most probable labels.

        Parameters
        ----------
        X : array_like, (n_impacts, n_features)
            Features, in the order of the training.

        Returns
        -------
        ndarray of str, (n_impacts,)
        """
        best = np.argmax(self.predict_proba(X), axis=1)
        return np.asarray(self.classes_[best])

    def novelty(self, X: ArrayLike) -> Floats:
        """Return the distance of each impact from the training.

        Parameters
        ----------
        X : array_like, (n_impacts, n_features)
            Features, in the order of the training.

        Returns
        -------
        ndarray, (n_impacts,)
            1 at the edge of the training.
        """
        standardised = self._standardised(X)
        if not self.rejects:
            raise InvalidValue("rejects must be True for novelty, got False; fit with it")
        return self.neighbourhood_.novelty(standardised)

    def _standardised(self, X: ArrayLike) -> Floats:
        check_is_fitted(self)
        validation.plain("X", X)
        return self.standardiser_.apply(validate_data(self, in_units(X, self.units_), dtype=np.float64, reset=False))

    def _unfitted(self) -> Any:
        """Return the classifier of the family; raises `InvalidValue` without one."""
        if isinstance(self.family, str):
            require_family(self.family, self.ESTIMATORS)
            return self.ESTIMATORS[self.family](self)
        able = not isinstance(self.family, type) and hasattr(self.family, "get_params") and is_classifier(self.family)
        if not able or not (hasattr(self.family, "decision_function") or hasattr(self.family, "predict_proba")):
            raise InvalidValue(
                f"family must be {', '.join(self.ESTIMATORS)}, or a classifier of scikit-learn with scores or "
                f"probabilities, such as RandomForestClassifier(), got {str(self.family)[:60]}"
            )
        made = clone(self.family)
        states = {name: one for name, one in made.get_params().items() if name.split("__")[-1] == "random_state"}
        return made.set_params(**{name: self.random_state for name, one in states.items() if one is None})

    def _scores(self, estimator: Any, inputs: Floats) -> Floats:
        if isinstance(self.family, str):
            return np.asarray(estimator.decision_function(inputs))
        return Fitted(estimator, inputs.shape[1], len(self.classes_)).scores(inputs)

    def _inputs(self, standardised: Floats) -> Floats:
        return squares(standardised) if self.family == "logistic" else standardised

    def _temperature(
        self,
        inputs: Floats,
        encoded: NDArray[np.intp],
        weights: Floats | None,
        groups: NDArray[Any] | None,
        workers: Workers,
    ) -> tuple[float, float]:
        """Return the divisor of the scores, and the log loss of left-out rows with it; 1 and nan for too few rows."""
        if groups is None or len(np.unique(groups)) == len(groups):
            groups = None
            counts = np.bincount(encoded)
        else:
            counts = np.array([len(np.unique(groups[encoded == k])) for k in range(len(self.classes_))])
        folds = min(self.calibration_folds, int(counts.min()))
        # Too few impacts, or specimens of a class, to calibrate on.
        if folds < 2 or len(encoded) < 50 * folds or counts.min() < 5 * folds * (groups is not None):
            return 1.0, np.nan
        kind = StratifiedKFold if groups is None else StratifiedGroupKFold
        splitter = kind(folds, shuffle=True, random_state=self.random_state)
        scores = np.empty((len(encoded), len(self.classes_)) if len(self.classes_) > 2 else len(encoded))
        parts = list(splitter.split(inputs, encoded, groups))
        answers = workers.each(_scores_left_out, (self, inputs, encoded, weights), parts)
        for (_, test), answer in zip(parts, answers, strict=True):
            scores[test] = answer
        temperature = best_temperature(scores, encoded, weights)
        return temperature, log_loss(scores / temperature, encoded, weights)


def _scores_left_out(
    fitting: tuple[ImpactClassifier, Floats, NDArray[np.intp], Floats | None],
    part: tuple[NDArray[np.intp], NDArray[np.intp]],
) -> Floats:
    """Return the scores of the rows of a fold by a fit to the other rows."""
    classifier, inputs, encoded, weights = fitting
    training, test = part
    with _libraries().limit(limits=1):
        part_weights = None if weights is None else weights[training]
        estimator = _fit(classifier._unfitted(), inputs[training], encoded[training], part_weights)
        return classifier._scores(estimator, inputs[test])


def _fit(estimator: Any, inputs: Floats, encoded: NDArray[np.intp], weights: Floats | None) -> Any:
    """Return a classifier fitted to rows, with their weights if there are any."""
    return estimator.fit(inputs, encoded, **({} if weights is None else {"sample_weight": weights}))


def _require_weights(estimator: Any) -> None:
    """Raise `InvalidValue` unless a classifier can be fitted to weighted rows."""
    if not has_fit_parameter(estimator, "sample_weight"):
        raise InvalidValue(
            f"weights must be left out, {type(estimator).__name__} takes no sample_weight; use another family"
        )


def _one_weight_a_row(sample_weight: ArrayLike, n_rows: int) -> Floats:
    """Return the weights (n_rows,), some of them above 0; raises `InvalidValue` for any other."""
    weights = validation.not_negative("sample_weight", sample_weight)
    if weights.shape != (n_rows,):
        raise InvalidValue(f"sample_weight must be one number for each of {n_rows} rows, got shape {weights.shape}")
    if not weights.any():
        raise InvalidValue("sample_weight must be above zero for some rows, got zero for all; leave it out")
    return weights


def _one_group_a_row(groups: ArrayLike, n_rows: int) -> NDArray[Any]:
    """Return the groups (n_rows,); raises `InvalidValue` for another number of them, and for nan."""
    array = np.asarray(groups)
    if array.shape != (n_rows,):
        raise InvalidValue(f"groups must be one value for each of {n_rows} rows, got shape {array.shape}")
    if (array != array).any():
        raise InvalidValue("groups must not be nan, got it; name the group of each row")
    return array


def _require_classes(class_weight: Weights, classes: NDArray[Any]) -> None:
    """Raise `InvalidValue` if weights name a class that is not there, and do not name one that is."""
    if not isinstance(class_weight, Mapping):
        return
    there = classes.tolist()
    foreign = [name for name in class_weight if name not in there]
    if foreign and not set(there) <= set(class_weight):
        raise InvalidValue(f"class_weight must name the classes {there}, got {foreign}; check the spelling")


def row_weights(labels: NDArray[Any], class_weight: Weights) -> Floats | None:
    """Return the weight of each row; None if all are 1."""
    if class_weight is None:
        return None
    if isinstance(class_weight, str):
        validation.choice("class_weight", class_weight, ("balanced",))
        return np.asarray(compute_sample_weight(class_weight, labels))
    return validation.positive("class_weight", [class_weight.get(label, 1.0) for label in labels.tolist()])


def best_temperature(
    scores: Floats, encoded: NDArray[np.intp], weights: Floats | None = None, doubt: float = 0.0
) -> float:
    """Return the divisor of held-out scores whose probabilities have the smallest log loss; see `log_loss`."""

    def loss(log_temperature: float) -> float:
        return log_loss(scores / np.exp(log_temperature), encoded, weights, doubt)

    return float(np.exp(minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded").x))


def log_loss(scores: Floats, encoded: NDArray[np.intp], weights: Floats | None = None, doubt: float = 0.0) -> float:
    """Return the mean log loss of scores; `doubt` is the prior probability of any other class (Platt 2000)."""
    logs = np.log(np.maximum(softmax(scores), 1e-300))
    log_probabilities = logs[np.arange(len(encoded)), encoded]
    if doubt:
        log_probabilities = (1 - doubt) * log_probabilities + doubt * (logs.sum(axis=1) - log_probabilities) / (
            logs.shape[1] - 1
        )
    return float(-np.average(log_probabilities, weights=weights))


#: The families of models; all can be exported as plain numbers.
FAMILIES = tuple(ImpactClassifier.ESTIMATORS)

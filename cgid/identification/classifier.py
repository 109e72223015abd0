"""Linear discriminants with a shrunken covariance, for many features of few recordings.

The scikit-learn estimator: standardise, one of the families, calibrate by temperature, know its limits.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold
from sklearn.neural_network import MLPClassifier
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.identification.families import Neighbourhood, Network, Standardiser, softmax, squares
from cgid.validation import Floats
from cgid.workers import ALONE, Workers


class ShrunkenDiscriminant(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Gaussians of one covariance: the mean of the classes', each drawn towards a plain one.

    It is scikit-learn's `LinearDiscriminantAnalysis(solver="lsqr", shrinkage=...)` to rounding, in a fifth of the time
    where features are many: recordings are left out a thousand times.

    Parameters
    ----------
    shrinkage : float, optional
        In [0, 1]; by the rule of Ledoit & Wolf (2004) if not given.
    priors : ndarray, (n_classes,), optional
        As often as the classes come if not given.

    Attributes
    ----------
    classes_, coef_, intercept_
        As scikit-learn's.
    covariance_ : ndarray, (n_features, n_features)
    """

    def __init__(self, shrinkage: float | None = None, priors: Floats | None = None) -> None:
        self.shrinkage = shrinkage
        self.priors = priors

    def fit(self, X: Floats, y: NDArray[Any]) -> ShrunkenDiscriminant:
        """Fit to features (n_rows, n_features) and labels (n_rows,)."""
        self.classes_, encoded = np.unique(y, return_inverse=True)
        priors = np.bincount(encoded) / len(y) if self.priors is None else np.asarray(self.priors)
        means = np.stack([X[encoded == k].mean(axis=0) for k in range(len(self.classes_))])
        centred = X - means[encoded]
        self.covariance_ = self._covariance(centred, encoded, priors)
        # Where nothing varies nothing is told: a ridge of rounding lets the factor exist.
        ridge = 1e-10 * max(float(np.trace(self.covariance_)) / X.shape[1], np.finfo(float).tiny)
        factor = cho_factor(self.covariance_ + ridge * np.eye(X.shape[1]))
        coefficients = cho_solve(factor, means.T).T
        intercepts = np.log(priors) - 0.5 * np.sum(means * coefficients, axis=1)
        if len(self.classes_) == 2:
            coefficients, intercepts = np.diff(coefficients, axis=0), np.diff(intercepts)
        self.coef_, self.intercept_ = coefficients, intercepts
        return self

    def decision_function(self, X: Floats) -> Floats:
        """Return the scores of the classes; of the second alone where there are two."""
        scores = X @ self.coef_.T + self.intercept_
        return np.asarray(scores[:, 0] if len(self.classes_) == 2 else scores)

    def predict(self, X: Floats) -> NDArray[Any]:
        """Return the most probable labels, (n_rows,)."""
        scores = self.decision_function(X)
        best = np.argmax(scores, axis=1) if scores.ndim == 2 else (scores > 0).astype(int)
        return np.asarray(self.classes_[best])

    def _covariance(self, centred: Floats, encoded: NDArray[np.intp], priors: Floats) -> Floats:
        """Return the mean of the classes' covariances by their priors, each drawn towards a plain one."""
        weights, plain = np.empty(len(centred)), np.zeros(centred.shape[1])
        for k, prior in enumerate(priors):
            rows = centred[encoded == k]
            # By the rule each feature is taken over its deviation, so that units do not matter.
            spread = rows.std(axis=0) if self.shrinkage is None else np.ones(rows.shape[1])
            spread[spread <= 1e-12 * np.abs(rows).max(axis=0)] = 1.0
            share, variance = _shrinkage(rows / spread)
            share = share if self.shrinkage is None else self.shrinkage
            weights[encoded == k] = prior * (1 - share) / len(rows)
            plain += prior * share * variance * spread**2
        weighted = centred * np.sqrt(weights)[:, None]
        return np.asarray(weighted.T @ weighted + np.diag(plain))


def _shrinkage(centred: Floats) -> tuple[float, float]:
    """Return how far a covariance is drawn towards a multiple of the identity (Ledoit & Wolf 2004), and the multiple.

    All norms follow from the products of rows, of which there are fewer than of features.
    """
    n_rows, n_features = centred.shape
    products = centred @ centred.T
    variance = float(np.trace(products)) / (n_rows * n_features)
    size = float(np.sum(products**2)) / n_rows**2
    distance = size - n_features * variance**2
    noise = (float(np.sum(np.diag(products) ** 2)) / n_rows - size) / n_rows
    return (min(max(noise, 0.0), distance) / distance if distance > 0 else 0.0), variance


class _Perceptron(MLPClassifier):  # type: ignore[misc]
    """A scikit-learn network that also tells its scores before they become probabilities."""

    def fit(self, X: Floats, y: NDArray[Any], sample_weight: Floats | None = None) -> _Perceptron:
        with warnings.catch_warnings():
            # So many iterations are what was asked for, converged or not.
            warnings.simplefilter("ignore", ConvergenceWarning)
            super().fit(X, y, sample_weight)
        return self

    def decision_function(self, X: Floats) -> Floats:
        arrays = Network.export(self)
        return Network(arrays, X.shape[1], len(self.classes_)).scores(X)


def _logistic(_: ImpactClassifier) -> Any:
    return LogisticRegression(C=10.0, solver="newton-cholesky", max_iter=100)


def _boosting(settings: ImpactClassifier) -> Any:
    return HistGradientBoostingClassifier(
        max_iter=settings.n_trees,
        max_leaf_nodes=settings.n_leaves,
        learning_rate=settings.learning_rate,
        l2_regularization=1.0,
        early_stopping=False,
        random_state=settings.random_state,
    )


def _discriminant(_: ImpactClassifier) -> Any:
    return QuadraticDiscriminantAnalysis(reg_param=2e-4)


def _linear(settings: ImpactClassifier) -> Any:
    return ShrunkenDiscriminant(settings.shrinkage)


def _network(settings: ImpactClassifier) -> Any:
    # L-BFGS on all impacts at once: of equal time, better and steadier than Adam on batches.
    return _Perceptron(
        (settings.n_units, settings.n_units),
        activation="tanh",
        solver="lbfgs",
        alpha=1.0,
        max_iter=settings.n_iterations,
        random_state=settings.random_state,
    )


class ImpactClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Identifies the material of an impact from its features, with calibrated probabilities.

    Parameters
    ----------
    family : {"logistic", "boosting", "discriminant", "network", "linear"}
        Logistic regression on the features and their products; histogram gradient boosting; quadratic
        discriminant analysis; a network of two hidden layers; linear discriminant analysis with a shrunken covariance,
        for many features and few recordings.
    linear : tuple of int
        Columns that never get a logarithm; the others do where all training values are above 0.
    n_trees : int
        Boosting rounds.
    n_leaves : int
        Largest number of leaves of a tree.
    learning_rate : float
        Of boosting.
    n_units : int
        Of each hidden layer of the network.
    n_iterations : int
        At most so many steps of the network's optimiser.
    calibration_folds : int
        Probabilities are calibrated on predictions for folds left out (Guo et al. 2017, temperature scaling);
        0 leaves them as they are.
    shrinkage : float, optional
        Of the covariance of the linear family, in [0, 1]; by the rule of Ledoit & Wolf (2004) if not given.
    class_weight : dict, optional
        What an impact of a class counts, 1 where not said; "balanced" makes all classes count the same.
    rejects : bool
        Whether it learns the edge of the training, too; without, it has no novelty.
    random_state : int
        Of the folds and of the network's first weights.

    Attributes
    ----------
    classes_ : ndarray
    standardiser_ : Standardiser
    estimator_ : the fitted scikit-learn classifier of the family
    temperature_ : float
        What the scores are divided by.
    neighbourhood_ : Neighbourhood
        Only if it rejects.
    """

    #: A family's name -> its estimator with the settings of a classifier.
    ESTIMATORS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {
        "logistic": _logistic,
        "boosting": _boosting,
        "discriminant": _discriminant,
        "network": _network,
        "linear": _linear,
    }

    def __init__(
        self,
        family: str = "logistic",
        *,
        linear: tuple[int, ...] = (),
        n_trees: int = 200,
        n_leaves: int = 15,
        learning_rate: float = 0.08,
        n_units: int = 32,
        n_iterations: int = 200,
        calibration_folds: int = 3,
        shrinkage: float | None = None,
        class_weight: Mapping[Any, float] | str | None = None,
        rejects: bool = True,
        random_state: int = 0,
    ) -> None:
        self.family = family
        self.linear = linear
        self.n_trees = n_trees
        self.n_leaves = n_leaves
        self.learning_rate = learning_rate
        self.n_units = n_units
        self.n_iterations = n_iterations
        self.calibration_folds = calibration_folds
        self.shrinkage = shrinkage
        self.class_weight = class_weight
        self.rejects = rejects
        self.random_state = random_state

    def fit(
        self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None, *, crew: Workers = ALONE
    ) -> ImpactClassifier:
        """Fit to features (n_impacts, n_features) and labels (n_impacts,).

        Impacts of the same of `groups` (n_impacts,), their specimens, are never on both sides of a fold. The `crew`
        fits the folds, one thread each: sums made by several would differ in their last digits.
        """
        validation.choice("family", self.family, tuple(self.ESTIMATORS))
        validation.plain("X", X)
        features, labels = validate_data(self, X, y, dtype=np.float64, ensure_min_samples=2)
        check_classification_targets(labels)
        self.classes_, encoded = np.unique(labels, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"classifier needs at least 2 classes, got 1 class: {self.classes_[0]!r}")
        with threadpool_limits(1):
            self.standardiser_ = Standardiser.fit(features, self.linear)
            standardised = self.standardiser_.apply(features)
            inputs, weights = self._inputs(standardised), self._class_weights(encoded)
            self.estimator_ = self._fitted(inputs, encoded, weights)
            if self.rejects:
                covariance = self.estimator_.covariance_ if self.family == "linear" else None
                self.neighbourhood_ = Neighbourhood.fit(standardised, encoded, covariance)
            own = None if groups is None else np.asarray(groups)
            self.temperature_ = self._temperature(inputs, encoded, weights, own, crew)
        return self

    def decision_function(self, X: ArrayLike) -> Floats:
        """Return the scores that become probabilities, (n_impacts, n_classes), or (n_impacts,) for two classes."""
        inputs = self._inputs(self._standardised(X))
        return np.asarray(self.estimator_.decision_function(inputs))

    def predict_proba(self, X: ArrayLike) -> Floats:
        """Return probabilities, (n_impacts, n_classes), in the order of `classes_`."""
        return softmax(self.decision_function(X) / self.temperature_)

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the most probable labels, (n_impacts,)."""
        best = np.argmax(self.predict_proba(X), axis=1)
        return np.asarray(self.classes_[best])

    def novelty(self, X: ArrayLike) -> Floats:
        """Return how far each impact lies from the training, 1 at the limit, (n_impacts,)."""
        return self.neighbourhood_.novelty(self._standardised(X))

    def _standardised(self, X: ArrayLike) -> Floats:
        check_is_fitted(self)
        validation.plain("X", X)
        return self.standardiser_.apply(validate_data(self, X, dtype=np.float64, reset=False))

    def _inputs(self, standardised: Floats) -> Floats:
        return squares(standardised) if self.family == "logistic" else standardised

    def _class_weights(self, encoded: NDArray[np.intp]) -> Floats | None:
        """Return what an impact of each class counts; None where all count 1."""
        if self.class_weight is None:
            return None
        if isinstance(self.class_weight, str):
            validation.choice("class_weight", self.class_weight, ("balanced",))
            return np.asarray(len(encoded) / (len(self.classes_) * np.bincount(encoded)))
        weights = [self.class_weight.get(label, 1.0) for label in self.classes_.tolist()]
        return validation.positive("class_weight", weights)

    def _fitted(self, inputs: Floats, encoded: NDArray[np.intp], weights: Floats | None) -> Any:
        estimator = self.ESTIMATORS[self.family](self)
        if weights is None:
            return estimator.fit(inputs, encoded)
        if hasattr(estimator, "priors"):  # the discriminants': all that a weight does to them
            counts = weights * np.bincount(encoded, minlength=len(weights))
            return estimator.set_params(priors=counts / counts.sum()).fit(inputs, encoded)
        return estimator.fit(inputs, encoded, sample_weight=weights[encoded])

    def _temperature(
        self,
        inputs: Floats,
        encoded: NDArray[np.intp],
        weights: Floats | None,
        groups: NDArray[Any] | None,
        crew: Workers,
    ) -> float:
        if groups is None or len(np.unique(groups)) == len(groups):
            groups = None
            counts = np.bincount(encoded)
        else:
            counts = np.array([len(np.unique(groups[encoded == k])) for k in range(len(self.classes_))])
        folds = min(self.calibration_folds, int(counts.min()))
        # With a handful of impacts or of specimens of a class there is nothing to calibrate on.
        if folds < 2 or len(encoded) < 50 * folds or counts.min() < 5 * folds * (groups is not None):
            return 1.0
        kind = StratifiedKFold if groups is None else StratifiedGroupKFold
        splitter = kind(folds, shuffle=True, random_state=self.random_state)
        scores = np.empty((len(encoded), len(self.classes_)) if len(self.classes_) > 2 else len(encoded))
        parts = list(splitter.split(inputs, encoded, groups))
        answers = crew.each(_scores_left_out, (self, inputs, encoded, weights), parts)
        for (_, test), answer in zip(parts, answers, strict=True):
            scores[test] = answer
        return best_temperature(scores, encoded, None if weights is None else weights[encoded])


def _scores_left_out(
    fitting: tuple[ImpactClassifier, Floats, NDArray[np.intp], Floats | None],
    part: tuple[NDArray[np.intp], NDArray[np.intp]],
) -> Floats:
    """Return the scores of what is left out by what is fitted to the rest."""
    classifier, inputs, encoded, weights = fitting
    training, test = part
    with threadpool_limits(1):
        fitted = classifier._fitted(inputs[training], encoded[training], weights)
        return np.asarray(fitted.decision_function(inputs[test]))


def best_temperature(scores: Floats, encoded: NDArray[np.intp], weights: Floats | None = None) -> float:
    """Return what scores of impacts left out are divided by for probabilities of the smallest log loss.

    Parameters
    ----------
    scores : ndarray, (n_impacts, n_classes) or (n_impacts,)
        As a scikit-learn decision function gives them.
    encoded : ndarray of int, (n_impacts,)
        Numbers of the true classes.
    weights : ndarray, (n_impacts,), optional
        What each impact counts.
    """
    rows = np.arange(len(encoded))

    def loss(log_temperature: float) -> float:
        chosen = softmax(scores / np.exp(log_temperature))[rows, encoded]
        return float(-np.average(np.log(np.maximum(chosen, 1e-300)), weights=weights))

    return float(np.exp(minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded").x))


#: The families a model may be of, each exportable as plain numbers.
FAMILIES = tuple(ImpactClassifier.ESTIMATORS)

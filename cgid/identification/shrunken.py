"""Linear discriminants with a shrunken covariance, for many features of few recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from sklearn.base import BaseEstimator, ClassifierMixin

from cgid.validation import Floats


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

"""What both training and prediction do to a row of features; numpy only, so that they do the very same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats


@dataclass(frozen=True)
class Standardiser:
    """Logarithms of what is always positive, then zero mean and unit variance.

    Attributes
    ----------
    logarithmic : ndarray of bool, (n_features,)
    floor : ndarray, (n_features,)
        Below this a logarithmic feature is taken as this.
    mean, scale : ndarray, (n_features,)
    """

    logarithmic: NDArray[np.bool_]
    floor: Floats
    mean: Floats
    scale: Floats

    @classmethod
    def fit(cls, features: Floats, linear: Sequence[int] = ()) -> Standardiser:
        """Return the standardiser of these rows; the columns named linear never get a logarithm."""
        logarithmic = np.asarray((features > 0).all(axis=0))
        logarithmic[list(linear)] = False
        # A thousandth of the smallest value ever seen: far outside, and still a logarithm.
        floor = np.where(logarithmic, np.maximum(1e-3 * features.min(axis=0), np.finfo(float).tiny), 1.0)
        plain = cls(logarithmic, floor, np.zeros(features.shape[1]), np.ones(features.shape[1])).apply(features)
        spread = plain.std(axis=0)
        usable = spread > 1e-12 * np.maximum(np.abs(plain).max(axis=0), 1e-300)
        return cls(logarithmic, floor, plain.mean(axis=0), np.where(usable, spread, 1.0))

    def apply(self, features: Floats) -> Floats:
        """Return the standardised rows."""
        logs = np.log(np.maximum(features, self.floor), where=self.logarithmic, out=features.copy())
        return np.asarray((logs - self.mean) / self.scale)


def squares(standardised: Floats) -> Floats:
    """Return all features and all their products in pairs, (n, m + m (m + 1) / 2)."""
    rows, columns = np.triu_indices(standardised.shape[1])
    return np.hstack([standardised, standardised[:, rows] * standardised[:, columns]])


def softmax(scores: Floats) -> Floats:
    """Return probabilities from the scores of the classes; a single column is the second of two classes."""
    if scores.ndim == 1:
        scores = np.stack([np.zeros(len(scores)), scores], axis=1)
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class Neighbourhood:
    """How far a row lies from what the model was trained on.

    The distance is Mahalanobis' to the nearest class; 1 is the distance that 99.9 % of the training impacts keep.

    Attributes
    ----------
    centres : ndarray, (n_classes, n_features)
    whitening : ndarray, (n_classes, n_features, n_features)
        Or a single one, (1, n_features, n_features), for all of them.
    limit : float
    """

    centres: Floats
    whitening: Floats
    limit: float

    #: Share of the training impacts that lie inside.
    INSIDE = 0.999
    #: Added to the variances: directions in which all training impacts agree must not decide alone.
    RIDGE = 1e-3

    @classmethod
    def fit(cls, standardised: Floats, classes: NDArray[np.intp], covariance: Floats | None = None) -> Neighbourhood:
        """Return the neighbourhood of these rows; `classes` are numbers from 0.

        Each class has a covariance of its own, unless one (n_features, n_features) is given for all of them.
        """
        centres, whitening = [], []
        for k in range(int(classes.max()) + 1):
            rows = standardised[classes == k]
            centred = rows - rows.mean(axis=0)
            centres.append(rows.mean(axis=0))
            if covariance is None or k == 0:
                own = centred.T @ centred / max(len(rows) - 1, 1) if covariance is None else covariance
                whitening.append(np.linalg.inv(np.linalg.cholesky(own + cls.RIDGE * np.eye(rows.shape[1]))))
        found = cls(np.array(centres), np.array(whitening), 1.0)
        limit = float(np.quantile(found.novelty(standardised), cls.INSIDE))
        return cls(found.centres, found.whitening, max(limit, 1e-12))

    def novelty(self, standardised: Floats) -> Floats:
        """Return the distance over the limit; above 1 is outside of what was trained."""
        offsets = standardised[None] - self.centres[:, None]
        white = offsets @ np.swapaxes(self.whitening, 1, 2)
        return np.asarray(np.sqrt(np.sum(white**2, axis=2)).min(axis=0) / self.limit)

"""The classifiers as plain arrays: standardising, scores, probabilities and novelty, in numpy alone.

Training and prediction share this code. A family is one class with `scores(standardised) -> (n,) or (n, n_classes)`;
its `arrays` are what a model file holds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.validation import Floats


@dataclass(frozen=True)
class Standardiser:
    """Logarithms of features that are always positive, then zero mean and unit variance.

    Attributes
    ----------
    logarithmic : ndarray of bool, (n_features,)
    floor : ndarray, (n_features,)
        Smallest value of a logarithmic feature; smaller ones are raised to it.
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
        # A thousandth of the smallest training value: far outside, but with a finite logarithm.
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
    """Novelty: Mahalanobis' distance of a row to the nearest class, 1 where 99.9 % of the training lie inside.

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
    #: Added to the variances, so that directions in which the training hardly varies do not decide alone.
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
        """Return the distance over the limit; above 1 is outside of the training range."""
        offsets = standardised[None] - self.centres[:, None]
        white = offsets @ np.swapaxes(self.whitening, 1, 2)
        return np.asarray(np.sqrt(np.sum(white**2, axis=2)).min(axis=0) / self.limit)


Arrays = Mapping[str, NDArray[Any]]
#: Trees, and nodes from the root of one to a leaf: each row passes through all trees.
_MOST_TREES, _LONGEST_WAY = 1 << 15, 256


class Family(ABC):
    """A fitted classifier as arrays."""

    #: The arrays, and the number of their axes.
    AXES: ClassVar[Mapping[str, int]]

    def __init__(self, arrays: Arrays, n_features: int, n_classes: int) -> None:
        self.arrays, self.n_features, self.n_classes = arrays, n_features, n_classes
        for name, n_axes in self.AXES.items():
            if name not in arrays:
                raise BadData(f"array {name} is missing")
            if arrays[name].ndim != n_axes:
                raise BadData(f"array {name} must have {n_axes} axes, got shape {arrays[name].shape}")
        self.check()

    @abstractmethod
    def check(self) -> None:
        """Raise `BadData` unless the arrays can be used without harm."""

    @abstractmethod
    def scores(self, standardised: Floats) -> Floats:
        """Return the scores of the classes; one column for two classes: that of the second."""

    @property
    @abstractmethod
    def width(self) -> int:
        """Numbers held in memory for each row that is scored."""

    @property
    def n_scores(self) -> int:
        """Columns of scores: one for two classes."""
        return 1 if self.n_classes == 2 else self.n_classes

    def _require(self, name: str, shape: tuple[int, ...]) -> None:
        if self.arrays[name].shape != shape:
            raise BadData(f"array {name} must have shape {shape}, got {self.arrays[name].shape}")


class Linear(Family):
    """Linear in the features: Gaussians with one covariance, shrunken towards a diagonal one (Ledoit & Wolf 2004)."""

    AXES: ClassVar[Mapping[str, int]] = {"coefficients": 2, "intercepts": 1}

    @staticmethod
    def export(estimator: Any) -> dict[str, NDArray[Any]]:
        """Return the arrays of a fitted estimator with `coef_` and `intercept_`."""
        return {"coefficients": estimator.coef_, "intercepts": estimator.intercept_}

    def check(self) -> None:
        """Check that the shapes follow from the numbers of features and classes."""
        self._require("coefficients", (self.n_scores, self.width))
        self._require("intercepts", (self.n_scores,))

    @property
    def width(self) -> int:
        """The features."""
        return self.n_features

    def scores(self, standardised: Floats) -> Floats:
        """Return `x w + b`."""
        scores = self._terms(standardised) @ self.arrays["coefficients"].T + self.arrays["intercepts"]
        return np.asarray(scores[:, 0] if self.n_scores == 1 else scores)

    def _terms(self, standardised: Floats) -> Floats:
        return standardised


class Logistic(Linear):
    """Linear in the features and their products in pairs."""

    @property
    def width(self) -> int:
        """The features and their products."""
        return self.n_features + self.n_features * (self.n_features + 1) // 2

    def _terms(self, standardised: Floats) -> Floats:
        return squares(standardised)


class Boosting(Family):
    """Sums of decision trees; all trees of all columns in one table of nodes."""

    AXES: ClassVar[Mapping[str, int]] = {
        "baseline": 1,
        "roots": 1,
        "columns": 1,
        "feature": 1,
        "threshold": 1,
        "left": 1,
        "right": 1,
        "value": 1,
    }

    @staticmethod
    def export(estimator: Any) -> dict[str, NDArray[Any]]:
        """Return the arrays of a fitted scikit-learn HistGradientBoostingClassifier without missing values."""
        roots, columns, tables = [], [], []
        first = 0
        for iteration in estimator._predictors:
            for column, tree in enumerate(iteration):
                nodes = tree.nodes
                leaf = nodes["is_leaf"].astype(bool)
                own = np.arange(len(nodes)) + first
                tables.append(
                    (
                        np.where(leaf, 0, nodes["feature_idx"]).astype(np.int32),
                        np.where(leaf, 0.0, nodes["num_threshold"]),
                        # A leaf is its own child: a walk that arrives there stays.
                        np.where(leaf, own, nodes["left"].astype(np.int64) + first).astype(np.int32),
                        np.where(leaf, own, nodes["right"].astype(np.int64) + first).astype(np.int32),
                        np.where(leaf, nodes["value"], 0.0),
                    )
                )
                roots.append(first)
                columns.append(column)
                first += len(nodes)
        named = zip(("feature", "threshold", "left", "right", "value"), zip(*tables, strict=True), strict=True)
        return {
            "baseline": np.ravel(estimator._baseline_prediction).astype(np.float64),
            "roots": np.array(roots, np.int32),
            "columns": np.array(columns, np.int32),
            **{name: np.concatenate(parts) for name, parts in named},
        }

    def check(self) -> None:
        """Check that children follow their parent within the same tree, and that features and columns exist."""
        a, n_nodes = self.arrays, len(self.arrays["feature"])
        for name in ("threshold", "left", "right", "value"):
            self._require(name, (n_nodes,))
        for name in ("roots", "columns", "feature", "left", "right"):
            if a[name].dtype.kind != "i":
                raise BadData(f"array {name} must hold whole numbers, got {a[name].dtype}")
        self._require("baseline", (self.n_scores,))
        self._require("columns", a["roots"].shape)
        roots = a["roots"]
        if not len(roots) or roots[0] != 0 or (np.diff(roots) <= 0).any() or roots[-1] >= n_nodes:
            raise BadData("array roots must rise from 0 and stay below the number of nodes")
        if (a["columns"] < 0).any() or (a["columns"] >= self.n_scores).any():
            raise BadData(f"array columns must lie between 0 and {self.n_scores - 1}")
        if (a["feature"] < 0).any() or (a["feature"] >= self.n_features).any():
            raise BadData(f"array feature must lie between 0 and {self.n_features - 1}")
        if len(roots) > _MOST_TREES:
            raise BadData(f"array roots must name at most {_MOST_TREES} trees, got {len(roots)}")
        own = np.arange(n_nodes)
        end = np.append(roots[1:], n_nodes)[np.searchsorted(roots, own, side="right") - 1]
        leaf = (a["left"] == own) & (a["right"] == own)
        for name in ("left", "right"):
            if not (leaf | ((a[name] > own) & (a[name] < end))).all():
                raise BadData(f"array {name} must point to a later node of the same tree")
        self._check_ways(own[~leaf])

    def _check_ways(self, inner: NDArray[np.intp]) -> None:
        """Raise unless each node except the roots has one parent, and every leaf is near enough."""
        a = self.arrays
        parents = np.bincount(np.append(a["left"][inner], a["right"][inner]), minlength=len(a["feature"]))
        parents[a["roots"]] += 1
        if (parents != 1).any():
            raise BadData("arrays left and right must name each node once, except the roots")
        level = a["roots"]
        for _ in range(_LONGEST_WAY):
            level = level[a["left"][level] != level]
            level = np.append(a["left"][level], a["right"][level])
            if not level.size:
                return
        raise BadData(f"arrays left and right must lead to a leaf in {_LONGEST_WAY} steps")

    @property
    def width(self) -> int:
        """A node of each tree."""
        return len(self.arrays["roots"])

    def scores(self, standardised: Floats) -> Floats:
        """Walk all trees at once, level by level, and add up their leaves in the order of training."""
        out = np.empty((len(standardised), self.n_scores))
        leaves = self.arrays["value"][self._walk(standardised)]
        for column in range(self.n_scores):
            own = leaves[:, self.arrays["columns"] == column]
            out[:, column] = self.arrays["baseline"][column] + own.sum(axis=1)
        return out[:, 0] if self.n_scores == 1 else out

    def _walk(self, rows: Floats) -> NDArray[np.int32]:
        a, order = self.arrays, np.arange(len(rows))[:, None]
        node = np.broadcast_to(a["roots"], (len(rows), len(a["roots"])))
        while True:
            below = rows[order, a["feature"][node]] <= a["threshold"][node]
            child = np.where(below, a["left"][node], a["right"][node])
            if np.array_equal(child, node):
                return np.asarray(node, np.int32)
            node = child


class Network(Family):
    """Two hidden layers of hyperbolic tangents."""

    AXES: ClassVar[Mapping[str, int]] = {
        "weights_1": 2,
        "biases_1": 1,
        "weights_2": 2,
        "biases_2": 1,
        "weights_3": 2,
        "biases_3": 1,
    }

    @staticmethod
    def export(estimator: Any) -> dict[str, NDArray[Any]]:
        """Return the arrays of a fitted scikit-learn MLPClassifier with two hidden layers of tanh."""
        layers = enumerate(zip(estimator.coefs_, estimator.intercepts_, strict=True), start=1)
        return {
            f"{name}_{k}": array for k, pair in layers for name, array in zip(("weights", "biases"), pair, strict=True)
        }

    def check(self) -> None:
        """Check that each layer has as many inputs as the one before it has outputs."""
        n_inputs = self.n_features
        for layer, n_units in enumerate((len(self.arrays["biases_1"]), len(self.arrays["biases_2"]), self.n_scores), 1):
            self._require(f"weights_{layer}", (n_inputs, n_units))
            self._require(f"biases_{layer}", (n_units,))
            n_inputs = n_units

    @property
    def width(self) -> int:
        """The larger of the layers."""
        return max(len(self.arrays[f"biases_{k}"]) for k in (1, 2))

    def scores(self, standardised: Floats) -> Floats:
        """Return the sums of the last layer, before the softmax."""
        a = self.arrays
        hidden = np.tanh(standardised @ a["weights_1"] + a["biases_1"])
        hidden = np.tanh(hidden @ a["weights_2"] + a["biases_2"])
        scores = hidden @ a["weights_3"] + a["biases_3"]
        return np.asarray(scores[:, 0] if self.n_scores == 1 else scores)


#: By the name that the model file gives.
BY_NAME: Mapping[str, type[Boosting] | type[Linear] | type[Network]] = {
    "boosting": Boosting,
    "linear": Linear,
    "logistic": Logistic,
    "network": Network,
}

"""The classifiers as plain arrays: standardisation, scores, probabilities and novelty, with numpy alone.

Each family is a class with `scores(standardised)`, (n,) or (n, n_classes); its `arrays` are those of the model file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue

Arrays = Mapping[str, NDArray[Any]]
#: Smallest divisor of a model: with all other numbers up to 1e100, quotients and their squares are finite.
MIN_DIVISOR = 1e-30


@dataclass(frozen=True, eq=False, repr=False)
class Standardiser:
    """Take logarithms of always-positive features, then scale to zero mean and unit variance."""

    logarithmic: NDArray[np.bool_]
    floor: Floats  # smallest value of a logarithmic feature
    mean: Floats
    scale: Floats

    #: Names of its arrays, one value per feature, after their prefix.
    NAMES: ClassVar[tuple[str, ...]] = ("logarithmic", "floor", "mean", "scale")

    @classmethod
    def from_arrays(cls, arrays: Arrays, prefix: str) -> Standardiser:
        """Return the standardiser in the arrays of a model; raises `BadData` for a scale or floor near 0."""
        standardiser = cls(*(arrays[prefix + name] for name in cls.NAMES))
        for name, smallest in (("scale", MIN_DIVISOR), ("floor", np.finfo(float).tiny)):
            if (least := getattr(standardiser, name).min()) < smallest:
                raise BadData(f"array {prefix}{name} must be at least {smallest:.3g}, got {least:.3g}")
        return standardiser

    def arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return the arrays of a model."""
        return {prefix + name: getattr(self, name) for name in self.NAMES}

    @classmethod
    def fit(
        cls, features: Floats, linear: Sequence[int] = (), weights: Floats | None = None
    ) -> tuple[Standardiser, Floats]:
        """Return one fitted to rows, of these weights above 0, and the rows standardised.

        The columns in `linear` never get a logarithm.
        """
        logarithmic = np.asarray((features > 0).all(axis=0))
        logarithmic[list(linear)] = False
        # A thousandth of the smallest training value is far outside, but its logarithm is finite.
        floor = np.where(logarithmic, np.maximum(1e-3 * features.min(axis=0), np.finfo(float).tiny), 1.0)
        standardiser = cls(logarithmic, floor, np.zeros(features.shape[1]), np.ones(features.shape[1]))
        plain = standardiser.apply(features)  # of mean 0 and scale 1
        if weights is None:
            mean, spread = plain.mean(axis=0), plain.std(axis=0)
        else:
            mean = np.average(plain, axis=0, weights=weights)
            spread = np.sqrt(np.average((plain - mean) ** 2, axis=0, weights=weights))
        usable = spread > 1e-12 * np.maximum(np.abs(plain).max(axis=0), 1e-300)
        standardiser = replace(standardiser, mean=mean, scale=np.where(usable, spread, 1.0))
        return standardiser, standardiser.apply(features)

    def apply(self, features: Floats) -> Floats:
        """Return the standardised rows."""
        # Columns are picked, since numpy's `where` takes four times as long.
        columns, logs = np.flatnonzero(self.logarithmic), features.copy()
        logs[:, columns] = np.log(np.maximum(features[:, columns], self.floor[columns]))
        with np.errstate(over="ignore"):  # infinite rows are reported later
            return np.asarray((logs - self.mean) / self.scale)

    def at(self, standardised: float) -> Floats:
        """Return the features (n_features,) whose standardised values are all this one."""
        plain = self.mean + standardised * self.scale
        with np.errstate(over="ignore"):  # of a model that knows any size
            return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, plain, 0.0)), plain)


def squares(standardised: Floats) -> Floats:
    """Return all features and their pairwise products, (n, m + m (m + 1) / 2)."""
    rows, columns = np.triu_indices(standardised.shape[1])
    return np.hstack([standardised, standardised[:, rows] * standardised[:, columns]])


def softmax(scores: Floats) -> Floats:
    """Return probabilities from scores (n, n_classes), or from scores (n,) of the second of two classes."""
    if scores.ndim == 1:
        scores = np.stack([np.zeros(len(scores)), scores], axis=1)
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


#: Smallest probability of a classifier of scikit-learn: those of forests and neighbours may be 0 for want of rows.
_LEAST = 1e-4


def log_scores(probabilities: Floats) -> Floats:
    """Return the logarithms of probabilities (n, n_classes), or of the odds (n,) of the second of two classes."""
    logs = np.log(np.maximum(probabilities, _LEAST))
    return np.asarray(logs[:, 1] - logs[:, 0] if logs.shape[1] == 2 else logs)


@dataclass(frozen=True, eq=False, repr=False)
class Neighbourhood:
    """Novelty: Mahalanobis distance to the nearest class, 1 at the 99.9 % quantile of the training."""

    centres: Floats  # (n_classes, n_features)
    whitening: Floats  # (n_classes or 1, n_features, n_features)
    limit: float

    #: Fraction of the training impacts inside the limit.
    INSIDE = 0.999
    #: Added to the variances, so that directions of almost no variation do not dominate.
    RIDGE = 1e-3
    #: Largest condition of a whitening; with the ridge it is some 1e3.
    MAX_CONDITION = 1e8

    @classmethod
    def fit(cls, standardised: Floats, classes: NDArray[np.intp], covariance: Floats | None = None) -> Neighbourhood:
        """Fit to rows and class numbers from 0, with one covariance for each class unless a common one is given."""
        centres, whitening = [], []
        for k in range(int(classes.max()) + 1):
            rows = standardised[classes == k]
            centred = rows - rows.mean(axis=0)
            centres.append(rows.mean(axis=0))
            if covariance is None or k == 0:
                pooled = centred.T @ centred / max(len(rows) - 1, 1) if covariance is None else covariance
                whitening.append(np.linalg.inv(np.linalg.cholesky(pooled + cls.RIDGE * np.eye(rows.shape[1]))))
        neighbourhood = cls(np.array(centres), np.array(whitening), 1.0)
        limit = float(np.quantile(neighbourhood.novelty(standardised), cls.INSIDE))
        return cls(neighbourhood.centres, neighbourhood.whitening, max(limit, 1e-12))

    def check(self) -> None:
        """Raise `BadData` unless the whitening of each class can be inverted."""
        # Vectors without order have a part in every direction; to invert large matrices would take seconds, and to
        # import numpy.random a twentieth of the start of predict.
        probes = np.sin(np.arange(4.0 * self.whitening.shape[1]) ** 2).reshape(-1, 4)
        try:
            with np.errstate(all="ignore"):
                solved = np.linalg.solve(self.whitening, np.broadcast_to(probes, (len(self.whitening), *probes.shape)))
                grown = np.linalg.norm(solved, axis=(1, 2)) / np.linalg.norm(probes)
                condition = grown * np.linalg.norm(self.whitening, axis=(1, 2))
                regular = bool((condition < self.MAX_CONDITION).all() and (grown < 1 / MIN_DIVISOR).all())
        except np.linalg.LinAlgError:
            regular = False
        if not regular:
            raise BadData("array neighbourhood.whitening must be matrices that can be inverted")

    def novelty(self, standardised: Floats) -> Floats:
        """Return distance over limit; above 1 it is outside the training range, infinite beyond all numbers."""
        offsets = standardised[None] - self.centres[:, None]
        white = offsets @ np.swapaxes(self.whitening, 1, 2)
        # Where infinities have cancelled, nan would not exceed 1.
        distance = np.sqrt(np.sum(white**2, axis=2)).min(axis=0) / self.limit
        return np.asarray(np.nan_to_num(distance, nan=np.inf, posinf=np.inf))

    @property
    def covariance(self) -> Floats:
        """Covariance of all classes together, (n_features, n_features), of rows whose mean is 0."""
        # The classes have the weights for which the mean of their centres is 0.
        system = np.vstack([self.centres.T, np.ones(len(self.centres))])
        shares = np.maximum(np.linalg.lstsq(system, np.eye(len(system))[-1], rcond=None)[0], 0)
        inner = np.linalg.inv(np.swapaxes(self.whitening, 1, 2) @ self.whitening)
        outer = self.centres[:, :, None] * self.centres[:, None]
        return np.asarray(np.tensordot(shares / shares.sum(), inner + outer, 1))

    def most_distant(self, standardised: Floats) -> NDArray[np.intp]:
        """Return the index of the feature that contributes most to the squared distance of each row, (n,)."""
        offsets = standardised[None] - self.centres[:, None]
        white = offsets @ np.swapaxes(self.whitening, 1, 2)
        nearest = np.argmin(np.sum(white**2, axis=2), axis=0)
        rows = np.arange(len(standardised))
        return np.asarray(np.argmax((offsets * (white @ self.whitening))[nearest, rows], axis=1))


class Family(ABC):
    """A fitted classifier as arrays."""

    #: Names of the arrays and their numbers of axes.
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
        """Raise `BadData` unless the arrays are safe to use."""

    @abstractmethod
    def scores(self, standardised: Floats) -> Floats:
        """Return the scores of the classes; for two classes only those of the second."""

    @property
    @abstractmethod
    def width(self) -> int:
        """Number of values held in memory per row."""

    @cached_property
    def n_scores(self) -> int:
        """Number of score columns: one for two classes."""
        return 1 if self.n_classes == 2 else self.n_classes

    def _require(self, name: str, shape: tuple[int, ...]) -> None:
        if self.arrays[name].shape != shape:
            raise BadData(f"array {name} must have shape {shape}, got {self.arrays[name].shape}")


class Linear(Family):
    """Linear in the features: Gaussians with a common covariance shrunken to a diagonal (Ledoit & Wolf 2004)."""

    AXES: ClassVar[Mapping[str, int]] = {"coefficients": 2, "intercepts": 1}

    @staticmethod
    def export(estimator: Any) -> dict[str, NDArray[Any]]:
        """Return the arrays of a fitted estimator with `coef_` and `intercept_`."""
        return {"coefficients": np.atleast_2d(estimator.coef_), "intercepts": np.atleast_1d(estimator.intercept_)}

    def check(self) -> None:
        """Check the shapes against the numbers of features and classes."""
        self._require("coefficients", (self.n_scores, self.width))
        self._require("intercepts", (self.n_scores,))

    @property
    def width(self) -> int:
        """Number of features."""
        return self.n_features

    def scores(self, standardised: Floats) -> Floats:
        """Return `x w + b`."""
        scores = self._terms(standardised) @ self.arrays["coefficients"].T + self.arrays["intercepts"]
        return np.asarray(scores[:, 0] if self.n_scores == 1 else scores)

    def _terms(self, standardised: Floats) -> Floats:
        return standardised


class Logistic(Linear):
    """Linear in the features and their pairwise products."""

    @property
    def width(self) -> int:
        """Number of features and products."""
        return self.n_features + self.n_features * (self.n_features + 1) // 2

    def _terms(self, standardised: Floats) -> Floats:
        return squares(standardised)


class Network(Family):
    """Two hidden tanh layers."""

    AXES: ClassVar[Mapping[str, int]] = {
        f"{name}_{layer}": n_axes for layer in (1, 2, 3) for name, n_axes in (("weights", 2), ("biases", 1))
    }

    @staticmethod
    def export(estimator: Any) -> dict[str, NDArray[Any]]:
        """Return the arrays of a fitted MLPClassifier with two hidden tanh layers."""
        layers = enumerate(zip(estimator.coefs_, estimator.intercepts_, strict=True), start=1)
        return {
            f"{name}_{k}": array for k, pair in layers for name, array in zip(("weights", "biases"), pair, strict=True)
        }

    def check(self) -> None:
        """Check that the inputs of each layer match the outputs of the previous one."""
        n_inputs = self.n_features
        for layer, n_units in enumerate((len(self.arrays["biases_1"]), len(self.arrays["biases_2"]), self.n_scores), 1):
            self._require(f"weights_{layer}", (n_inputs, n_units))
            self._require(f"biases_{layer}", (n_units,))
            n_inputs = n_units

    @cached_property
    def width(self) -> int:
        """Size of the larger hidden layer."""
        return max(len(self.arrays[f"biases_{k}"]) for k in (1, 2))

    def scores(self, standardised: Floats) -> Floats:
        """Return the output of the last layer before the softmax."""
        a = self.arrays
        hidden = np.tanh(standardised @ a["weights_1"] + a["biases_1"])
        hidden = np.tanh(hidden @ a["weights_2"] + a["biases_2"])
        scores = hidden @ a["weights_3"] + a["biases_3"]
        return np.asarray(scores[:, 0] if self.n_scores == 1 else scores)


@dataclass(frozen=True, eq=False, repr=False)
class Contrast:
    """Novelty from a network trained against other impacts (ln density ratio), or from a line trained against noise."""

    # The distance to the training alone is too tolerant with many laws, shapes and noises.

    standardiser: Standardiser
    scorer: Network | Linear
    limit: float

    #: Scores above the limit that make the novelty e times as large.
    SCALE: ClassVar[float] = 4.0
    #: Prefix of its arrays in a model.
    PREFIX: ClassVar[str] = "contrast."

    @classmethod
    def from_arrays(cls, arrays: Arrays, n_features: int) -> Contrast | None:
        """Return the contrast in the arrays of a model; None without one. Raise `BadData` if they do not fit."""
        stored = {name.removeprefix(cls.PREFIX): a for name, a in arrays.items() if name.startswith(cls.PREFIX)}
        if not stored:
            return None
        shapes = dict.fromkeys(Standardiser.NAMES, (n_features,)) | {"limit": (1,)}
        for name, shape in shapes.items():
            if name not in stored or stored[name].shape != shape:
                raise BadData(f"array {cls.PREFIX}{name} must have shape {shape}")
        standardiser = Standardiser.from_arrays(arrays, cls.PREFIX)
        kind = Linear if "coefficients" in stored else Network
        scorer = kind({name: a for name, a in stored.items() if name in kind.AXES}, n_features, 2)
        return cls(standardiser, scorer, float(stored["limit"][0]))

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a model."""
        stored = {**self.scorer.arrays, "limit": np.array([self.limit])}
        return self.standardiser.arrays(self.PREFIX) | {self.PREFIX + name: array for name, array in stored.items()}

    def scores(self, features: Floats) -> Floats:
        """Return log odds of being out of distribution, up to a constant, or log power of noise."""
        return self.scorer.scores(self.standardiser.apply(features))

    def novelty(self, features: Floats) -> Floats:
        """Return the novelty of rows of features and guards, 1 at the limit."""
        above = (self.scores(features) - self.limit) / self.SCALE
        return np.asarray(np.nan_to_num(np.exp(np.minimum(above, 100.0)), nan=np.inf))


class Fitted(Family):
    """A fitted classifier of scikit-learn as it is, which no file can hold."""

    AXES: ClassVar[Mapping[str, int]] = {}

    def __init__(self, estimator: Any, n_features: int, n_classes: int) -> None:
        self.estimator = estimator
        super().__init__({}, n_features, n_classes)

    def check(self) -> None:
        """Do nothing: it was fitted to these features and classes."""

    @property
    def width(self) -> int:
        """Number of features."""
        return self.n_features

    def scores(self, standardised: Floats) -> Floats:
        """Return its scores, or the logarithms of its probabilities if it has no scores."""
        if hasattr(self.estimator, "decision_function"):
            return np.asarray(self.estimator.decision_function(standardised), np.float64)
        return log_scores(self.estimator.predict_proba(standardised))


#: The families by their names in model files.
BY_NAME: Mapping[str, type[Linear] | type[Network]] = {
    "linear": Linear,
    "logistic": Logistic,
    "network": Network,
}


def require_family(name: str, known: Iterable[str]) -> None:
    """Raise `InvalidValue` unless the name is that of a known family."""
    if name in ("boosting", "forest"):
        raise InvalidValue(f"family {name} is withdrawn; use logistic, which is as accurate")
    validation.choice("family", name, tuple(known))


def as_numbers(fitted: Fitted) -> tuple[str, dict[str, NDArray[Any]]] | None:
    """Return name and arrays of a linear family that has the scores of a fitted classifier; None of any other."""
    rows = np.random.default_rng(0).normal(scale=2.0, size=(256, fitted.n_features))  # inputs are standardised
    scores = fitted.scores(rows)
    try:
        arrays = Linear.export(fitted.estimator)
        found = Linear(arrays, fitted.n_features, fitted.n_classes).scores(rows)
    except (AttributeError, BadData, TypeError, ValueError):
        return None
    same = found.shape == scores.shape and np.allclose(found, scores, rtol=1e-9, atol=1e-9)
    return ("linear", arrays) if same else None

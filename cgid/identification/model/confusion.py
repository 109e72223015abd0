"""Predictions of a model for rocks of either label, to correct the gangue fraction for errors of the model.

A rock strikes, bounces and strikes again; some impacts are missed, some predictions are unknown. So the unit is the
rock: a rock of label k gives on average `rates[k, b]` predictions with a probability in bin b. Of the predictions at a
fraction q of gangue rocks, bin b contains

    phi_b(q) = ((1 - q) rates[0, b] + q rates[1, b]) / sum over all bins

This is the likelihood of an answer. Its maximum over q is the adjusted count of Forman 2008 with every bin as a
threshold. Bounces, which look like coal, are included. Predictions for one rock are not independent: the
logarithm of the likelihood is divided by `overdispersion` (McCullagh & Nelder 1989, 4.5). This is the variance about
the fraction of the rocks that came, which are themselves a sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.identification.model.families import MIN_DIVISOR, Arrays

#: Probabilities are clipped this far from 0 and 1: otherwise a single wrong prediction could outweigh all others.
SUREST = 1e-3
#: Minimum number of predictions of the rarer label in a bin, and maximum number of bins.
_A_BIN, _MAX_BINS = 25, 24
#: Predictions added to each label, distributed like those of both, so that an empty bin excludes nothing.
_ADDED = 2.0
#: Length of the windows for the scatter of predictions [s].
_WINDOW = 10.0
#: Minimum standard deviation of the fraction from stream to stream (assumed): a mine differs from its simulation.
#: Another seam and location move the fraction by this much (`benchmarks/identification/streams.py`).
MIN_SCATTER = 0.035
#: Minimum number of tested impacts of either label whose answers make a confusion, and limit of its scatter: no wider
#: than that of any fraction.
MIN_TESTED, _MAX_SCATTER = 25, 0.5


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class StreamAnswers:
    """Predictions for a recording with known rocks."""

    logits: Floats  # (n,) of the probability of the second label; nan for unknown impacts
    second: NDArray[np.bool_]  # (n,) whether the rock has the second label
    time: Floats  # (n,) [s]
    n_rocks: tuple[int, int]  # rocks of both labels
    share: float  # of the second label among the rocks that may come


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Confusion:
    """Rates of the predictions of a model for rocks of two labels."""

    edges: Floats  # (n_bins - 1,) of the logit of the probability of the second label, ascending
    rates: Floats  # (2, n_bins) answers in each bin a rock of the first and of the second label
    # variance of the estimate about the share of the rocks that came, over that of independent answers, at least 1
    overdispersion: float = 1.0
    scatter: float = 0.0  # standard deviation of the estimated share from stream to stream, with any number of impacts

    ARRAYS: ClassVar = ("edges", "rates", "spread")
    PREFIX: ClassVar = "share."

    def __post_init__(self) -> None:
        edges, rates = self.edges, self.rates
        if edges.ndim != 1 or rates.shape != (2, edges.size + 1) or not (np.diff(edges) > 0).all():
            raise BadData(f"share.edges must ascend and share.rates be (2, {edges.size + 1}), got {rates.shape}")
        if not (rates >= MIN_DIVISOR).all():
            raise BadData(f"share.rates must be at least {MIN_DIVISOR:g}")
        if not (self.overdispersion >= 1 and 0 <= self.scatter < 1):
            raise BadData(
                f"share.spread must be an overdispersion of at least 1 and a scatter in [0, 1), got "
                f"{self.overdispersion:g} and {self.scatter:g}"
            )

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self | None:
        """Return the confusion in the arrays of a model; None without one. Raise `BadData` if they do not fit."""
        stored = {name: arrays[cls.PREFIX + name] for name in cls.ARRAYS if cls.PREFIX + name in arrays}
        if not stored:
            return None
        if len(stored) < len(cls.ARRAYS) or stored["spread"].shape != (2,):
            raise BadData(f"arrays of a share must be {', '.join(cls.PREFIX + name for name in cls.ARRAYS)}")
        overdispersion, scatter = stored["spread"].tolist()
        return cls(edges=stored["edges"], rates=stored["rates"], overdispersion=overdispersion, scatter=scatter)

    @property
    def arrays(self) -> dict[str, Floats]:
        """The arrays in a model file."""
        stored = {"edges": self.edges, "rates": self.rates, "spread": np.array([self.overdispersion, self.scatter])}
        return {self.PREFIX + name: array for name, array in stored.items()}

    @classmethod
    def counted(cls, logits: Floats, second: NDArray[np.bool_], n_rocks: tuple[float, float]) -> Self | None:
        """Return the confusion estimated from predictions (n,) for rocks; None with too few.

        `second` says which answers are about the second label, and `n_rocks` how many rocks of each there were.
        """
        known = np.isfinite(logits)
        logits, second = logits[known], second[known]
        rarer = min(int(second.sum()), int((~second).sum()))
        n_bins = min(rarer // _A_BIN, _MAX_BINS)
        if n_bins < 2:
            return None
        # Bins contain equally many predictions of both labels together, with equal weights of the labels.
        weights = np.where(second, 1 / second.sum(), 1 / (~second).sum())
        order = np.argsort(logits, kind="stable")
        shares = np.cumsum(weights[order]) / weights.sum()
        quantiles = logits[order][np.searchsorted(shares, np.arange(1, n_bins) / n_bins)]
        edges, _ = np.unique(quantiles, return_counts=True)  # without counts, it would import numpy.ma
        edges = edges[edges > logits.min()]  # if many are at the limit, none is below the first edge
        bins = np.searchsorted(edges, logits, side="right")
        counts = np.stack([np.bincount(bins[second == k], minlength=edges.size + 1) for k in (False, True)])
        pooled = counts.sum(axis=0) / counts.sum()
        spread = (counts + _ADDED * pooled) * (counts.sum(axis=1) / (counts.sum(axis=1) + _ADDED))[:, None]
        return cls(edges=edges, rates=spread / np.asarray(n_rocks)[:, None])

    @classmethod
    def of_test(cls, counts: Floats, n_trials: float) -> Self | None:
        """Return the confusion of tested impacts (2, 2), truth by answer, as good as so many trials; None with too few.

        The fraction of a recording has the error of the rates of the second label; an anchor replaces the first.
        """
        n = counts.sum(axis=1)
        if n.min() < MIN_TESTED:
            return None
        rates = (counts + _ADDED * counts.sum(axis=0) / n.sum()) / (n + _ADDED)[:, None]
        gain = max(float(rates[1, 1] - rates[0, 1]), MIN_DIVISOR)
        error = float(np.sqrt(rates[1, 0] * rates[1, 1] / (max(n_trials, 1.0) * n[1] / n.sum()))) / gain
        return cls(edges=np.zeros(1), rates=rates, scatter=min(float(np.hypot(error, MIN_SCATTER)), _MAX_SCATTER))

    @classmethod
    def of_streams(cls, streams: Sequence[StreamAnswers]) -> Self | None:
        """Return the confusion from streams of known fractions, with overdispersion and scatter; None with too few."""
        plain = cls.counted(
            np.concatenate([one.logits for one in streams]),
            np.concatenate([one.second for one in streams]),
            (sum(one.n_rocks[0] for one in streams), sum(one.n_rocks[1] for one in streams)),
        )
        if plain is None:
            return None
        inside, errors, curvatures = [], [], []
        for one in streams:
            known = np.isfinite(one.logits)
            window = (one.time[known] // _WINDOW).astype(int)
            pull = np.bincount(window, plain.slopes(one.logits[known], one.share))
            counts = np.bincount(window)
            curvature = plain.information(one.share) * counts
            error = pull.sum() / curvature.sum()
            squared_residuals = (pull - curvature * error)[counts > 0] ** 2 / curvature[counts > 0]
            # The part of it that is due to the rocks, whose fraction differs between windows.
            due = curvature.sum() * one.share * (1 - one.share) / sum(one.n_rocks)
            inside.append((squared_residuals.sum(), squared_residuals.size - 1, due * (squared_residuals.size - 1)))
            errors.append(error)
            curvatures.append(curvature.sum())
        sums = np.sum(inside, axis=0)
        squared_residuals, due = sums[[0, 2]] / max(sums[1], 1)
        overdispersion = max(float(squared_residuals - due), 1.0)
        excess = np.average(
            np.square(errors) - max(squared_residuals, 1.0) / np.asarray(curvatures), weights=curvatures
        )
        scatter = max(float(np.sqrt(max(excess, 0.0))), MIN_SCATTER)
        return cls(edges=plain.edges, rates=plain.rates, overdispersion=overdispersion, scatter=scatter)

    @property
    def abundance(self) -> float:
        """Number of predictions per rock of the second label over that of the first."""
        return float(self.rates[1].sum() / self.rates[0].sum())

    def ratios(self, logits: Floats) -> Floats:
        """Return the likelihood ratio of predictions, second over first label, (n,)."""
        return np.asarray((self.rates[1] / self.rates[0])[np.searchsorted(self.edges, logits, side="right")])

    def slopes(self, logits: Floats, share: float) -> Floats:
        """Return the slope of the log-likelihood of each prediction at a fraction of rocks, (n,)."""
        ratios, abundance = self.ratios(logits), self.abundance
        slope = (abundance - 1) / (1 + share * (abundance - 1))
        return np.asarray((ratios - 1) / (1 + share * (ratios - 1)) - slope)

    def information(self, share: float) -> float:
        """Return the Fisher information of one prediction about a fraction of rocks: the variance of its slope."""
        bins = (1 - share) * self.rates[0] + share * self.rates[1]
        centres = np.append(self.edges, np.inf)  # one logit within each bin, counted from below
        slopes = self.slopes(np.nextafter(centres, -np.inf), share)
        return float(bins @ slopes**2 / bins.sum())

    def anchored(self, logits: Floats) -> Self:
        """Return the same with predictions for rocks of the first label that are distributed like these, (n,).

        The error of so few moves a fraction q by (1 - q) of it, on average over q by the root of a third.
        """
        counts = np.bincount(np.searchsorted(self.edges, logits, side="right"), minlength=self.edges.size + 1)
        total = self.rates[0].sum()
        first = total * (counts + _ADDED * self.rates[0] / total) / (logits.size + _ADDED)
        moved = replace(self, rates=np.stack([first, self.rates[1]]))
        error = self.overdispersion / max(3.0 * (logits.size + _ADDED) * moved.information(0.0), MIN_DIVISOR)
        return replace(moved, scatter=min(float(np.hypot(self.scatter, np.sqrt(error))), _MAX_SCATTER))

    def turned(self) -> Self:
        """Return the same with the labels exchanged."""
        return type(self)(
            edges=-self.edges[::-1],
            rates=self.rates[::-1, ::-1],
            overdispersion=self.overdispersion,
            scatter=self.scatter,
        )


def logit(probabilities: Floats) -> Floats:
    """Return the logarithm of the odds; probabilities are kept `SUREST` away from 0 and 1; nan stays nan."""
    confident = np.clip(probabilities, SUREST, 1.0 - SUREST)
    return np.asarray(np.log(confident / (1.0 - confident)))


#: The 97.5 % quantile of the normal distribution.
_Z = 1.959963984540054


def wilson_interval(share: float, total: float) -> tuple[float, float]:
    """Return the 95 % score interval of a fraction of independent trials (Wilson 1927).

    >>> [round(end, 4) for end in wilson_interval(0.9, 100)]
    [0.8256, 0.9448]
    """
    extra = _Z * _Z / total
    middle = (share + extra / 2) / (1 + extra)
    half = _Z * (share * (1 - share) / total + extra / (4 * total)) ** 0.5 / (1 + extra)
    return middle - half, middle + half


def trials_of(share: float, width: float) -> float:
    """Return the number of independent trials whose 95 % score interval of a fraction has this width, below 1.

    >>> round(trials_of(0.9, 0.9448 - 0.8256))
    100
    """
    # width (1 + x) = 2 sqrt(share (1 - share) x + x^2 / 4), for x the square of _Z over the number
    a, b, c = 1 - width**2, 4 * share * (1 - share) - 2 * width**2, width**2
    return float(2 * a * _Z * _Z / ((b * b + 4 * a * c) ** 0.5 - b))

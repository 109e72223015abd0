"""The distribution of the impactor in a recording: unfolded, and corrected for impacts too small to be detected.

Posteriors cannot simply be added up, since each is biased towards the population. The distribution is the one that
makes the fitted pulses of all impacts most likely together, by expectation maximisation (Shepp and Vardi 1982, IEEE
Trans. Med. Imaging 1, 113), smoothed after each step (Silverman et al. 1990, J. R. Stat. Soc. B 52, 271). The
likelihood of an impact is divided by the probability of its detection. Intervals are those of resampled impacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.impactor.measured import MeasuredPulses
from cgid.impactor.posterior import QUANTITIES, ImpactorPopulation

#: Number of size classes, their maximum, steps of the iteration, and resampled sets of impacts.
_CLASSES, _MAX_CLASSES, _STEPS, _RESAMPLED = 16, 200, 60, 200
#: Fraction of a class that moves to each neighbour after a step.
_SMOOTHING = 0.08
#: Impacts of a class with a lower probability of detection cannot be counted.
MIN_DETECTED = 0.1
#: Minimum number of impacts.
_MIN_IMPACTS = 5
#: Steps of a fit of the probability of detection, and the longest.
_NEWTON, _MAX_STEP = 100, 0.5


@dataclass(frozen=True)
class Detection:
    """The probability of detection of an impact: 1/2 at a peak force, rising as a logistic curve of its logarithm.

    Attributes
    ----------
    peak : float [N]
        0: all are detected.
    steepness : float
        By how much ln(odds) rises with ln(peak force); infinite for a threshold.
    """

    peak: float
    steepness: float = np.inf

    def __post_init__(self) -> None:
        validation.not_negative("peak", self.peak, "N")
        if not self.steepness > 0:
            raise InvalidValue(f"steepness must be above 0, got {self.steepness:g}")

    def probability(self, log_peak: Floats) -> Floats:
        """Return the probability of detection of impacts of these ln(peak force [N])."""
        if self.peak == 0:
            return np.ones(np.shape(log_peak))
        with np.errstate(over="ignore", invalid="ignore"):
            steep = self.steepness * (np.asarray(log_peak) - np.log(self.peak))
        return np.asarray(1 / (1 + np.exp(-np.clip(np.nan_to_num(steep, nan=0.0), -700, 700))))

    @classmethod
    def learned(cls, peak: ArrayLike, detected: ArrayLike) -> Detection:
        """Return the fit to peak forces [N] of simulated impacts and to whether they were detected, each (n,)."""
        log_peak = np.log(validation.positive("peak", peak, "N"))
        is_detected = np.asarray(detected, bool)
        if is_detected.all():
            return cls(0.0)
        if not is_detected.any():
            raise BadData("no simulated impact was detected; increase their number or lower the noise")
        middle = log_peak.mean()
        inputs = np.stack([np.ones(is_detected.size), log_peak - middle], axis=1)
        at = np.array([0.0, 1.0])
        for _ in range(_NEWTON):  # with a weak prior: separable data have no maximum
            chance = 1 / (1 + np.exp(-np.clip(inputs @ at, -50, 50)))
            pull = inputs.T @ (is_detected - chance) - 1e-3 * at
            bend = inputs.T @ (inputs * (chance * (1 - chance))[:, None]) + 1e-3 * np.eye(2)
            at = at + np.clip(np.linalg.solve(bend, pull), -_MAX_STEP, _MAX_STEP)  # no farther than a parabola is valid
        steepness = max(float(at[1]), 1e-3)
        return cls(float(np.exp(middle - at[0] / steepness)), steepness)


@dataclass(frozen=True, eq=False)
class SizeDistribution:
    """Number of impacts of a recording in each size class.

    Attributes
    ----------
    quantity : str
        "mass", "radius" or "speed".
    edges : ndarray, (n_classes + 1,)
        In the unit of `QUANTITIES`.
    detected, low_detected, high_detected : ndarray, (n_classes,)
        Detected impacts, and their 90 % interval; those without a size estimate are assumed to be like the others.
    total, low_total, high_total : ndarray, (n_classes,)
        All impacts, detected or not; nan if less than `MIN_DETECTED` of a class is detected.
    probability : ndarray, (n_classes,)
        Probability of detection of each class.
    n_impacts, n_unknown : int
        Number of impacts with and without a size estimate.
    """

    quantity: str
    edges: Floats
    detected: Floats
    low_detected: Floats
    high_detected: Floats
    total: Floats
    low_total: Floats
    high_total: Floats
    probability: Floats
    n_impacts: int
    n_unknown: int


def size_distribution(
    pulses: MeasuredPulses,
    population: ImpactorPopulation,
    *,
    quantity: str = "mass",
    detection: Detection | None = None,
    edges: ArrayLike | None = None,
) -> SizeDistribution:
    """Return the distribution of the impactor in a recording.

    Parameters
    ----------
    pulses : MeasuredPulses
        Of all detected impacts.
    population : ImpactorPopulation
        Possible impactors; only what is unknown at a given size is taken from it.
    quantity : {"mass", "radius", "speed"}
    detection : Detection, optional
        By default all are detected.
    edges : array_like, (n_classes + 1,), optional
        Of the classes, ascending; by default 16 of equal ratios that contain the population.

    Returns
    -------
    SizeDistribution

    Raises
    ------
    BadData
        Fewer than 5 impacts have an interval.
    InvalidValue
        An argument breaks its rule.
    """
    validation.choice("quantity", quantity, QUANTITIES)
    draws = getattr(population, f"log_{quantity}")
    log_edges = _edges(quantity, draws, edges)
    n_classes = log_edges.size - 1
    draw_class = _class_of(draws, log_edges)
    inside_edges = (draw_class >= 0) & (draw_class < n_classes)
    prior = np.bincount(draw_class[inside_edges], minlength=n_classes) / draws.size
    detector = Detection(0.0) if detection is None else detection
    draw_detection = detector.probability(population.log_peak)
    probability = np.bincount(draw_class[inside_edges], draw_detection[inside_edges], n_classes) / np.maximum(
        prior * draws.size, 1e-300
    )
    counted = prior > 0
    likelihood = _likelihood(pulses, population, quantity, log_edges) / np.maximum(prior, 1e-300)
    likelihood = np.where(counted & (probability > 0), likelihood / np.maximum(probability, 1e-300), 0.0)
    is_usable = likelihood.any(axis=1)
    n = int(is_usable.sum())
    if n < _MIN_IMPACTS:
        raise BadData(f"a distribution needs at least {_MIN_IMPACTS} impacts with an interval, got {n}; record longer")
    rng = np.random.default_rng(n)
    resampled = rng.multinomial(n, np.full(n, 1 / n), _RESAMPLED)
    weights = np.concatenate([np.ones((1, n)), resampled.astype(np.float64)])
    fractions = _unfolded(likelihood[is_usable], prior * probability, weights)
    rarely_detected, detection_probability = probability < MIN_DETECTED, np.maximum(probability, MIN_DETECTED)
    counts = len(pulses) * fractions
    # Given the fractions, the class of an impact is still uncertain, and so is the number of undetected ones.
    of_class = np.array([(part * (1 - part)).sum(axis=0) for part in _of_classes(likelihood[is_usable], fractions[1:])])
    missed_noise = (
        np.sqrt(counts[1:] * (1 - detection_probability)) / detection_probability * rng.standard_normal(of_class.shape)
    )
    counts[1:] = np.maximum(counts[1:] + np.sqrt(of_class) * rng.standard_normal(of_class.shape), 0.0)
    total = np.where(rarely_detected, np.nan, counts / detection_probability)
    total[1:] = np.maximum(total[1:] + missed_noise, 0.0)
    low_detected, high_detected = np.quantile(counts[1:], [0.05, 0.95], axis=0)
    low_total, high_total = np.quantile(total[1:], [0.05, 0.95], axis=0)
    return SizeDistribution(
        quantity, np.exp(log_edges), counts[0], low_detected, high_detected, total[0], low_total, high_total,
        probability,
        n, len(pulses) - n,
    )  # fmt: skip


def _edges(quantity: str, draws: Floats, edges: ArrayLike | None) -> Floats:
    """Return ln of the edges."""
    if edges is None:
        return np.linspace(draws.min() - 1e-9, draws.max() + 1e-9, _CLASSES + 1)
    given = validation.ascending("edges", validation.positive("edges", edges, QUANTITIES[quantity]))
    if given.ndim != 1 or not 3 <= given.size <= _MAX_CLASSES + 1:
        raise InvalidValue(f"edges must be 3 to {_MAX_CLASSES + 1} ascending numbers, got shape {given.shape}")
    return np.log(given)


def _class_of(values: Floats, edges: Floats) -> NDArray[np.intp]:
    return np.searchsorted(edges, values, side="right") - 1


def _likelihood(pulses: MeasuredPulses, population: ImpactorPopulation, quantity: str, edges: Floats) -> Floats:
    """Return the likelihood of each class for each impact, (n, n_classes)."""
    n_classes, parts = edges.size - 1, [np.empty((0, edges.size - 1))]
    for values, weight in population.draws(pulses):
        n = len(weight)
        index = np.clip(_class_of(values[quantity], edges), -1, n_classes) + 1 + (n_classes + 2) * np.arange(n)[:, None]
        counts = np.bincount(index.ravel(), weight.ravel(), n * (n_classes + 2)).reshape(n, -1)
        parts.append(np.asarray(counts[:, 1:-1], np.float64))
    return np.concatenate(parts)


def _of_classes(likelihood: Floats, fractions: Floats) -> Iterator[Floats]:
    """Yield the probability of each class for each impact, (n, n_classes), for each set of fractions."""
    for fraction in fractions:
        part = likelihood * fraction
        yield part / np.maximum(part.sum(axis=1, keepdims=True), 1e-300)


def _unfolded(likelihood: Floats, start: Floats, weights: Floats) -> Floats:
    """Return the most likely fractions of the classes for weighted impacts, (n_sets, n_classes)."""
    fractions = np.broadcast_to(start / start.sum(), (len(weights), start.size))
    total = weights.sum(axis=1, keepdims=True)
    for _ in range(_STEPS):
        expected = np.maximum(fractions @ likelihood.T, 1e-300)
        fractions = fractions * ((weights / expected) @ likelihood) / total
        padded = np.pad(fractions, ((0, 0), (1, 1)), mode="edge")
        fractions = (1 - 2 * _SMOOTHING) * fractions + _SMOOTHING * (padded[:, 2:] + padded[:, :-2])
        fractions = np.where(start > 0, fractions, 0.0)
        fractions = fractions / fractions.sum(axis=1, keepdims=True)
    return np.asarray(fractions)

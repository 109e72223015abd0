"""The distribution of the impactor in a recording: unfolded, and corrected for impacts too small to be detected.

Posteriors cannot simply be added up: each leans towards the population. The distribution is the one that makes the
fitted pulses of all impacts most likely together, by expectation maximisation (Shepp and Vardi 1982, IEEE Trans. Med.
Imaging 1, 113), smoothed after each step (Silverman et al. 1990, J. R. Stat. Soc. B 52, 271). The likelihood of an
impact is divided by the probability of its detection. Intervals are those of resampled impacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.deprecated import renamed_attribute
from cgid.errors import BadData, InvalidValue
from cgid.impactor.measured import MeasuredPulses
from cgid.impactor.posterior import QUANTITIES, ImpactorPopulation
from cgid.validation import Floats

#: Classes of size, most of them, steps of the iteration, and resampled sets of impacts.
_CLASSES, _MAX_CLASSES, _STEPS, _RESAMPLED = 16, 200, 60, 200
#: Share of a class that goes to each neighbour after a step.
_SMOOTHING = 0.08
#: Impacts of a class of which a smaller share is found cannot be counted.
MIN_DETECTED = 0.1
#: Minimum number of impacts.
_MIN_IMPACTS = 5
#: Steps of a fit of the probability to be found, and the longest.
_NEWTON, _MAX_STEP = 100, 0.5


@dataclass(frozen=True)
class Detection:
    """The probability that an impact is found: a half at a peak force, rising as a logistic curve of its logarithm.

    Attributes
    ----------
    peak : float [N]
        0: all are found.
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
        """Return the probability that impacts of these ln(peak force [N]) are found."""
        if self.peak == 0:
            return np.ones(np.shape(log_peak))
        with np.errstate(over="ignore", invalid="ignore"):
            steep = self.steepness * (np.asarray(log_peak) - np.log(self.peak))
        return np.asarray(1 / (1 + np.exp(-np.clip(np.nan_to_num(steep, nan=0.0), -700, 700))))

    @classmethod
    def learned(cls, peak: ArrayLike, detected: ArrayLike) -> Detection:
        """Return what simulated impacts teach: their peak forces [N], (n,), and which of them were found, (n,)."""
        log_peak = np.log(validation.positive("peak", peak, "N"))
        is_detected = np.asarray(detected, bool)
        if is_detected.all():
            return cls(0.0)
        if not is_detected.any():
            raise BadData("no simulated impact was found; raise their number or lower the noise")
        middle = log_peak.mean()
        inputs = np.stack([np.ones(is_detected.size), log_peak - middle], axis=1)
        at = np.array([0.0, 1.0])
        for _ in range(_NEWTON):  # with a weak prior: separable data have no maximum
            chance = 1 / (1 + np.exp(-np.clip(inputs @ at, -50, 50)))
            pull = inputs.T @ (is_detected - chance) - 1e-3 * at
            bend = inputs.T @ (inputs * (chance * (1 - chance))[:, None]) + 1e-3 * np.eye(2)
            at = at + np.clip(np.linalg.solve(bend, pull), -_MAX_STEP, _MAX_STEP)  # no farther than a parabola holds
        steepness = max(float(at[1]), 1e-3)
        return cls(float(np.exp(middle - at[0] / steepness)), steepness)


@dataclass(frozen=True, eq=False)
class SizeDistribution:
    """How many of the impacts of a recording were of each class of size.

    Attributes
    ----------
    quantity : str
        "mass", "radius" or "speed".
    edges : ndarray, (n_classes + 1,)
        In the unit of `QUANTITIES`.
    detected, low_detected, high_detected : ndarray, (n_classes,)
        Impacts found, and their 90 % interval; those without an interval of their own count as being like the others.
    total, low_total, high_total : ndarray, (n_classes,)
        Impacts, found or not; nan where less than `MIN_DETECTED` of a class is found.
    probability : ndarray, (n_classes,)
        Share of a class that is found.
    n_impacts, n_unknown : int
        Impacts that count, and those without an interval.
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

    found = renamed_attribute("found", "detected")
    low_found = renamed_attribute("low_found", "low_detected")
    high_found = renamed_attribute("high_found", "high_detected")


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
        Of all impacts found.
    population : StrikerPopulation
        What can have struck; only what it leaves open at a given size is taken from it.
    quantity : {"mass", "radius", "speed"}
    detection : Detection, optional
        By default all are found.
    edges : array_like, (n_classes + 1,), optional
        Of the classes, ascending; by default 16 of equal ratios that hold the population.

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
    drawn = getattr(population, f"log_{quantity}")
    log_edges = _edges(quantity, drawn, edges)
    n_classes = log_edges.size - 1
    draw_class = _class_of(drawn, log_edges)
    inside_edges = (draw_class >= 0) & (draw_class < n_classes)
    prior = np.bincount(draw_class[inside_edges], minlength=n_classes) / drawn.size
    detector = Detection(0.0) if detection is None else detection
    draw_detection = detector.probability(population.log_peak)
    probability = np.bincount(draw_class[inside_edges], draw_detection[inside_edges], n_classes) / np.maximum(
        prior * drawn.size, 1e-300
    )
    counted = prior > 0
    likelihood = _likelihood(pulses, population, quantity, log_edges) / np.maximum(prior, 1e-300)
    likelihood = np.where(counted & (probability > 0), likelihood / np.maximum(probability, 1e-300), 0.0)
    known = likelihood.any(axis=1)
    n = int(known.sum())
    if n < _MIN_IMPACTS:
        raise BadData(f"a distribution needs at least {_MIN_IMPACTS} impacts with an interval, got {n}; record longer")
    rng = np.random.default_rng(n)
    drawn_again = rng.multinomial(n, np.full(n, 1 / n), _RESAMPLED)
    weights = np.concatenate([np.ones((1, n)), drawn_again.astype(np.float64)])
    shares = _unfolded(likelihood[known], prior * probability, weights)
    rarely_found, detection_probability = probability < MIN_DETECTED, np.maximum(probability, MIN_DETECTED)
    counts = len(pulses) * shares
    # Given the shares, the class of an impact is still open, and how many were not found.
    of_class = np.array([(part * (1 - part)).sum(axis=0) for part in _of_classes(likelihood[known], shares[1:])])
    missed_noise = (
        np.sqrt(counts[1:] * (1 - detection_probability)) / detection_probability * rng.standard_normal(of_class.shape)
    )
    counts[1:] = np.maximum(counts[1:] + np.sqrt(of_class) * rng.standard_normal(of_class.shape), 0.0)
    total = np.where(rarely_found, np.nan, counts / detection_probability)
    total[1:] = np.maximum(total[1:] + missed_noise, 0.0)
    low_detected, high_detected = np.quantile(counts[1:], [0.05, 0.95], axis=0)
    low_total, high_total = np.quantile(total[1:], [0.05, 0.95], axis=0)
    return SizeDistribution(
        quantity, np.exp(log_edges), counts[0], low_detected, high_detected, total[0], low_total, high_total,
        probability,
        n, len(pulses) - n,
    )  # fmt: skip


def _edges(quantity: str, drawn: Floats, edges: ArrayLike | None) -> Floats:
    """Return ln of the edges."""
    if edges is None:
        return np.linspace(drawn.min() - 1e-9, drawn.max() + 1e-9, _CLASSES + 1)
    given = validation.ascending("edges", validation.positive("edges", edges, QUANTITIES[quantity]))
    if given.ndim != 1 or not 3 <= given.size <= _MAX_CLASSES + 1:
        raise InvalidValue(f"edges must be 3 to {_MAX_CLASSES + 1} ascending numbers, got shape {given.shape}")
    return np.log(given)


def _class_of(values: Floats, edges: Floats) -> NDArray[np.intp]:
    return np.searchsorted(edges, values, side="right") - 1


def _likelihood(pulses: MeasuredPulses, population: ImpactorPopulation, quantity: str, edges: Floats) -> Floats:
    """Return the posterior probability of each class for each impact, (n, n_classes)."""
    n_classes, parts = edges.size - 1, [np.empty((0, edges.size - 1))]
    for values, weight in population.draws(pulses):
        n = len(weight)
        index = np.clip(_class_of(values[quantity], edges), -1, n_classes) + 1 + (n_classes + 2) * np.arange(n)[:, None]
        counts = np.bincount(index.ravel(), weight.ravel(), n * (n_classes + 2)).reshape(n, -1)
        parts.append(np.asarray(counts[:, 1:-1], np.float64))
    return np.concatenate(parts)


def _of_classes(likelihood: Floats, shares: Floats) -> Iterator[Floats]:
    """Yield the probability of each class for each impact, (n, n_classes), for each set of shares."""
    for share in shares:
        part = likelihood * share
        yield part / np.maximum(part.sum(axis=1, keepdims=True), 1e-300)


def _unfolded(likelihood: Floats, start: Floats, weights: Floats) -> Floats:
    """Return the most likely shares of the classes for weighted impacts, (n_sets, n_classes)."""
    shares = np.broadcast_to(start / start.sum(), (len(weights), start.size))
    total = weights.sum(axis=1, keepdims=True)
    for _ in range(_STEPS):
        expected = np.maximum(shares @ likelihood.T, 1e-300)
        shares = shares * ((weights / expected) @ likelihood) / total
        padded = np.pad(shares, ((0, 0), (1, 1)), mode="edge")
        shares = (1 - 2 * _SMOOTHING) * shares + _SMOOTHING * (padded[:, 2:] + padded[:, :-2])
        shares = np.where(start > 0, shares, 0.0)
        shares = shares / shares.sum(axis=1, keepdims=True)
    return np.asarray(shares)

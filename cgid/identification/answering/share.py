"""How much of what falls is gangue: its share over a sliding window of impacts, with an interval.

The mean of the probabilities is not it: a model that was trained on as much gangue as coal says .3 of a coal that might
well be gangue, and among nothing but such coal the mean stays at .3. So the share is estimated by likelihood (Saerens,
Latinne & Decaestecker 2002): an impact with probability p, from a model trained at a share s, is
r = p / (1 - p) * (1 - s) / s times as likely a gangue as a coal, and where a share q of all is gangue, as likely as

    1 - q + q r

The product over the window, times an even density of q before anything fell, is the density of q. It takes the impacts
for independent, each as good as those that the model was judged on: where a rock bounces, or the rig is another one,
the interval is too narrow.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.identification.model import Model
from cgid.validation import Floats

#: No impact is surer than this, whatever its model says: one that is wrong and quite sure would outweigh all others.
SUREST = 1e-3
#: How much of the density an interval holds.
LEVEL = 0.95
#: Shares at which the density is computed: evenly in the angle of share = sin^2(angle), so finer towards 0 and 1.
_NODES = 401


@dataclass(frozen=True, kw_only=True)
class Share:
    """The share of gangue among the impacts of a window.

    Attributes
    ----------
    time : float
        End of the window [s].
    start : float
        Its begin [s]; impacts of the time after it and up to `time` count.
    share : float
        Mean of its density; nan when no impact tells.
    low, high : float
        Shortest interval that holds the share with a probability of `LEVEL`; 0 and 1 when no impact tells.
    n_impacts : int
        That tell something.
    n_unknown : int
        That could not be measured or lie outside of the training, and are left out.
    channel : str
    """

    time: float
    start: float
    share: float
    low: float
    high: float
    n_impacts: int
    n_unknown: int = 0
    channel: str = "1"


class ShareWindow:
    """The impacts of the last seconds, and the share of gangue among them.

    Parameters
    ----------
    length : float
        [s], above 0.
    trained_share : float
        Of gangue in the training of the model, in (0, 1): `trained_share`.
    weight : float
        What one answer counts, in (0, 1]. Answers that say the same thing again (windows that overlap) are no
        independent impacts: those of one length after another count 1, at half of it one half.
    channel : str

    Raises
    ------
    InvalidValue
        A number breaks its rule.

    Examples
    --------
    Four impacts of which nothing is doubtful: the mean of Beta(1 + 1, 3 + 1).

    >>> window = ShareWindow(10.0)
    >>> for time, probability in enumerate([0.0, 0.0, 1.0, 0.0]):
    ...     window.add(float(time), probability)
    >>> round(window.at(3.0).share, 3)
    0.333
    """

    def __init__(self, length: float, *, trained_share: float = 0.5, weight: float = 1.0, channel: str = "1") -> None:
        self.length = validation.number("window", length, "s", validation.positive)
        self.channel = channel
        if not 0 < trained_share < 1:
            raise InvalidValue(f"trained_share must lie between 0 and 1 (exclusive), got {trained_share:g}")
        if not 0 < weight <= 1:
            raise InvalidValue(f"weight must lie above 0 and up to 1, got {weight:g}")
        self._odds, self._weight = trained_share / (1.0 - trained_share), weight
        self._impacts: deque[tuple[float, float]] = deque()

    def add(self, time: float, probability: float) -> None:
        """Take the answer for an impact at a time [s], in order of time: its probability of gangue, nan if unknown."""
        self._impacts.append((time, probability))

    def at(self, time: float) -> Share:
        """Return the share in the window that ends at a time [s], and forget all before that window."""
        start = time - self.length
        while self._impacts and self._impacts[0][0] <= start:
            self._impacts.popleft()
        inside = np.array([probability for when, probability in self._impacts if when <= time])
        told = inside[np.isfinite(inside)]
        mean, low, high = _estimate(told, self._odds, self._weight)
        return Share(
            time=time,
            start=max(start, 0.0),
            share=mean,
            low=low,
            high=high,
            n_impacts=told.size,
            n_unknown=inside.size - told.size,
            channel=self.channel,
        )


def trained_share(model: Model, gangue: Collection[str]) -> float:
    """Return the share of some labels in the training of a model, as far as its card knows.

    The impacts that judge are drawn as those that train, label by label; a model without them counts as trained on as
    much of each label. Class weights make a label as frequent as its impacts count.
    """
    confusion = model.training.get("metrics", {}).get("confusion")
    weights = model.training.get("class_weights") or model.training.get("recorded", {}).get("class_weights")
    counts = np.ones(len(model.labels))
    if confusion is not None and weights != "balanced":
        counts *= np.sum(confusion, axis=1)
    if isinstance(weights, Mapping):
        counts *= [weights.get(label, 1.0) for label in model.labels]
    own = sum(count for label, count in zip(model.labels, counts.tolist(), strict=True) if label in gangue)
    return float(np.clip(own / counts.sum(), SUREST, 1.0 - SUREST))


@cache
def _nodes() -> tuple[Floats, Floats]:
    """Return shares from 0 to 1, and the breadth that each stands for."""
    shares = np.sin(np.linspace(0.0, np.pi / 2, _NODES)) ** 2
    edges = np.concatenate([[0.0], (shares[1:] + shares[:-1]) / 2, [1.0]])
    return shares, np.diff(edges)


def _estimate(probabilities: Floats, trained_odds: float, weight: float) -> tuple[float, float, float]:
    """Return the mean of the share and its shortest interval."""
    if not probabilities.size:
        return float("nan"), 0.0, 1.0
    shares, breadths = _nodes()
    sure = np.clip(probabilities, SUREST, 1.0 - SUREST)
    ratios = sure / (1.0 - sure) / trained_odds
    logarithm = weight * np.log1p(np.multiply.outer(ratios - 1.0, shares)).sum(axis=0)
    masses = np.exp(logarithm - logarithm.max())
    densest = np.argsort(-masses, kind="stable")
    masses *= breadths
    masses /= masses.sum()
    # The density has a single top (its logarithm is concave), so the densest shares are neighbours.
    held = densest[: int(np.searchsorted(np.cumsum(masses[densest]), LEVEL)) + 1]
    return float(masses @ shares), float(shares[held.min()]), float(shares[held.max()])

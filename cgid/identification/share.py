"""The gangue share over a sliding window of impacts, and when to shut the window.

The mean of the probabilities does not estimate the share. A model trained on as much gangue as coal gives .3 to a coal
that might well be gangue; among such coal alone, the mean stays at .3. The estimate is therefore by likelihood
(Saerens, Latinne & Decaestecker 2002). With probability p from a model trained at a share s, an impact is r times as
likely a gangue as a coal. Its likelihood at a share q is L:

    r = p / (1 - p) * (1 - s) / s
    L = 1 - q + q r

The product of L over the window, times a uniform prior, is the posterior density of q. It assumes independent impacts
that the model answers as well as those of its test. If rocks bounce, or on another rig, the interval is too narrow.

Going on takes the next impact, whatever it is. A gangue costs `dilution_cost`, because it must be carried, washed and
dumped. Shutting leaves it; a coal left behind costs 1, the unit. Per impact, going on costs

    dilution_cost * q - (1 - q)

more than shutting. This is linear in q, so its expectation needs only the mean of q. Its sign changes at
q = 1 / (1 + dilution_cost). If the share is known and only rises, waiting beyond that never pays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.identification.answers import Answer
from cgid.identification.model import Model
from cgid.identification.question import Question
from cgid.validation import Floats

#: Probabilities are kept this far from 0 and 1: a single wrong certain answer would outweigh all others.
SUREST = 1e-3
#: Probability of the share to lie in its interval.
LEVEL = 0.95
#: Nodes of the density, evenly spaced in the angle of share = sin^2(angle): finer towards 0 and 1.
_NODES = 401


@dataclass(frozen=True, kw_only=True)
class Share:
    """The share of gangue among the impacts of a window.

    Attributes
    ----------
    time : float [s]
        End of the window.
    start : float [s]
        Begin of the window; impacts after it and up to `time` count.
    share : float
        Posterior mean; nan without any impact.
    low, high : float
        Shortest interval of probability `LEVEL`; 0 and 1 without any impact.
    n_impacts : int
        Impacts that were identified.
    n_unknown : int
        Unmeasurable impacts or those outside of the training range, which do not count.
    channel : str
        Name of the channel.
    """

    time: float
    start: float
    share: float
    low: float
    high: float
    n_impacts: int
    n_unknown: int = 0
    channel: str = "1"

    def __repr__(self) -> str:
        where = "" if self.channel == "1" else f" of channel {self.channel}"
        share = f"{self.share:.3f} ({self.low:.3f} to {self.high:.3f})"
        counts = f"{self.n_impacts} identified, {self.n_unknown} unknown"
        return f"Share({share} from {self.start:g} to {self.time:g} s{where}: {counts})"


class ShareWindow:
    """The impacts of the last seconds, and their gangue share.

    Parameters
    ----------
    length : float [s]
        Of the window.
    trained_share : float, in (0, 1)
        Share of gangue in the training of the model.
    weight : float, in (0, 1]
        Weight of one answer, because overlapping windows repeat each other: 1 end to end, 0.5 for half overlap.
    channel : str

    Raises
    ------
    InvalidValue
        A number is outside of its range.

    Examples
    --------
    Four certain impacts give the mean of Beta(1 + 1, 3 + 1).

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
        """Take the gangue probability of an impact at a time [s], nan if unknown; calls come in order of time.

        Parameters
        ----------
        time : float [s]
            Time of the impact.
        probability : float
            Of gangue.
        """
        self._impacts.append((time, probability))

    def at(self, time: float) -> Share:
        """Return the share in the window that ends at a time [s], and forget all earlier impacts.

        Parameters
        ----------
        time : float [s]
            End of the window.

        Returns
        -------
        Share
        """
        start = time - self.length
        while self._impacts and self._impacts[0][0] <= start:
            self._impacts.popleft()
        inside = np.array([probability for when, probability in self._impacts if when <= time])
        known = inside[np.isfinite(inside)]
        mean, low, high = _estimate(known, self._odds, self._weight)
        return Share(
            time=time,
            start=max(start, 0.0),
            share=mean,
            low=low,
            high=high,
            n_impacts=known.size,
            n_unknown=inside.size - known.size,
            channel=self.channel,
        )


def trained_share(model: Model, gangue: Collection[str]) -> float:
    """Return the share of some labels in the training of a model, as far as its card knows.

    The share is that of the test impacts, which are drawn label by label like the training impacts. Without them, all
    labels count as equally frequent. Class weights multiply the frequencies; balanced weights make them equal.
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
    """Return shares from 0 to 1, and the width that each represents."""
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
    # The density has a single maximum (its logarithm is concave), so the densest shares are neighbours.
    held = densest[: int(np.searchsorted(np.cumsum(masses[densest]), LEVEL)) + 1]
    return float(masses @ shares), float(shares[held.min()]), float(shares[held.max()])


#: Fewest impacts for a decision; with fewer, the uniform prior would decide.
FEWEST_IMPACTS = 10


@dataclass(frozen=True, kw_only=True)
class Turn:
    """Going on begins to cost more than shutting, or less again.

    Attributes
    ----------
    time : end of the first window that shows it [s]
    shut : True: shut the window; False: going on pays again
    cost : of going on minus shutting [lost coal impacts per impact]
    """

    time: float
    shut: bool
    cost: float
    share: Share


class Shutting:
    """Watch the share of one channel and report when the expected cost of going on changes sign.

    Each window of impacts counts by itself. Initially, going on pays. Above the share `threshold`, going on costs more
    than shutting. Raises `InvalidValue` unless `dilution_cost` [lost coal impacts per drawn gangue] is above 0.

    >>> round(Shutting(3.0).threshold, 3)
    0.25
    """

    def __init__(self, dilution_cost: float = 1.0) -> None:
        self.dilution_cost = validation.number("dilution_cost", dilution_cost, "", validation.positive)
        self.threshold = 1.0 / (1.0 + self.dilution_cost)
        self._shut = False

    def cost(self, share: Share) -> float:
        """Return the cost of going on minus shutting [lost coal impacts per impact]; nan without any impact."""
        return self.dilution_cost * share.share - (1.0 - share.share)

    def watch(self, share: Share) -> Turn | None:
        """Return the turn at this window; None without a change, or with too few impacts."""
        if share.n_impacts < FEWEST_IMPACTS:
            return None
        cost = self.cost(share)
        if (cost > 0) == self._shut:
            return None
        self._shut = not self._shut
        return Turn(time=share.time, shut=self._shut, cost=cost, share=share)


class CavingWatch:
    """Follow the answers of a recording, each channel by itself: a channel is a support with its own window.

    Parameters
    ----------
    model : Model
    channels : sequence of str
        Names of the channels.
    question : Question
        Holds the share window, its step, the labels and the cost of gangue.
    weight : float
        As in `ShareWindow`.
    """

    def __init__(self, model: Model, channels: Sequence[str], question: Question, weight: float = 1.0) -> None:
        question.require_gangue(model)
        share = trained_share(model, question.gangue_labels)
        self._gangue, self._step = question.gangue_labels, question.step
        self._windows = {
            name: ShareWindow(question.share_length, trained_share=share, weight=weight, channel=name)
            for name in channels
        }
        self._rules = {name: Shutting(question.cost_of_dilution) for name in channels}
        #: Share above which going on costs more than shutting.
        self.threshold = Shutting(question.cost_of_dilution).threshold
        self._waiting: deque[Answer] = deque()
        self._steps = 0
        # Channels whose last window was empty and has been returned.
        self._silent: set[str] = set()

    def feed(self, answers: Iterable[Answer], until: float) -> list[Share | Turn]:
        """Take the next answers, in order of time, and return the shares of completed windows and their turns.

        All answers before `until` [s] have arrived. Only the first of several empty windows is returned, so a pause of
        any length costs nothing.
        """
        self._waiting.extend(answers)
        found: list[Share | Turn] = []
        self._pass_silence(until)
        while (end := (self._steps + 1) * self._step) <= until:
            self._steps += 1
            found += self._at(end)
            self._pass_silence(until)
        return found

    def finish(self, duration: float) -> list[Share | Turn]:
        """Return the rest at the end of a recording of this duration [s]."""
        found = self.feed((), duration)
        return found + list(self._at(duration)) if self._waiting or not self._steps else found

    def _pass_silence(self, until: float) -> None:
        """If all channels are silent, skip to the window of the next impact, or to the last completed one."""
        if len(self._silent) == len(self._windows):
            due = min(until, self._waiting[0].time) if self._waiting else until
            self._steps = max(self._steps, int(due / self._step) - 1)

    def _at(self, end: float) -> Iterator[Share | Turn]:
        while self._waiting and self._waiting[0].time <= end:
            answer = self._waiting.popleft()
            self._windows[answer.channel].add(answer.time, self._probability(answer))
        for name, window in self._windows.items():
            share = window.at(end)
            if share.n_impacts + share.n_unknown:
                self._silent.discard(name)
            elif name in self._silent:
                continue
            else:
                self._silent.add(name)
            yield share
            turn = self._rules[name].watch(share)
            if turn is not None:
                yield turn

    def _probability(self, answer: Answer) -> float:
        """Return the probability of gangue; nan outside of the training range."""
        if not answer.novelty <= 1:
            return float("nan")
        return sum(answer.probabilities[label] for label in self._gangue)


#: The 97.5 % quantile of the normal distribution.
_Z = 1.959963984540054


def wilson_interval(share: float, total: float) -> tuple[float, float]:
    """Return the 95 % score interval of a share of independent trials (Wilson 1927).

    Parameters
    ----------
    share : float, in [0, 1]
    total : float
        Number of trials.

    Returns
    -------
    tuple of two floats
        Lower and upper end.

    Examples
    --------
    >>> [round(end, 4) for end in wilson_interval(0.9, 100)]
    [0.8256, 0.9448]
    """
    extra = _Z * _Z / total
    middle = (share + extra / 2) / (1 + extra)
    half = _Z * (share * (1 - share) / total + extra / (4 * total)) ** 0.5 / (1 + extra)
    return middle - half, middle + half

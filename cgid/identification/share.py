"""How much of what falls is gangue: its share over a sliding window of impacts, and when to shut the window.

The mean of the probabilities is no estimate of the share: a model that was trained on as much gangue as coal gives .3
to a coal that might well be gangue, and among nothing but such coal the mean stays at .3. So the share is estimated by
likelihood (Saerens, Latinne & Decaestecker 2002). An impact with probability p, from a model trained at a share s, is
r = p / (1 - p) * (1 - s) / s times as likely a gangue as a coal; where a share q of all is gangue, its likelihood is

    1 - q + q r

The product over the window, times an even prior density, is the density of q. It takes the impacts as independent, each
as good as those that the model was tested on: where a rock bounces, or the rig is another one, the interval is too
narrow.

Going on takes the next impact whatever it is: a gangue costs `gangue_cost`, because it must be carried, washed and
dumped. Shutting leaves it: a coal that stays behind costs 1, which is the unit. Going on costs

    gangue_cost * q - (1 - q)

more than shutting, an impact. It is linear in q, so its expectation needs the mean of q alone, and its sign changes at
q = 1 / (1 + gangue_cost). Where the share is known and only rises, waiting beyond that never pays.
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

#: No impact is more certain than this, whatever its model says: a wrong one would outweigh all others.
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
        Its begin [s]; impacts after it and up to `time` count.
    share : float
        Mean of its density; nan without any impact.
    low, high : float
        Shortest interval that holds the share with a probability of `LEVEL`; 0 and 1 without any impact.
    n_impacts : int
        That were identified.
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
        Of one answer, in (0, 1]. Windows that overlap repeat each other: end to end they count 1, overlapping by
        half one half.
    channel : str

    Raises
    ------
    InvalidValue
        A number breaks its rule.

    Examples
    --------
    Four impacts without any doubt: the mean of Beta(1 + 1, 3 + 1).

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


#: Fewer impacts than these decide nothing: the even prior density would.
FEWEST_IMPACTS = 10


@dataclass(frozen=True, kw_only=True)
class Turn:
    """Going on has begun to cost more than it brings, or less again.

    Attributes
    ----------
    time : float
        End of the first window that says so [s].
    shut : bool
        True: shut the window; False: going on pays again.
    cost : float
        Of going on, less that of shutting [lost coal impacts an impact].
    share : Share
    """

    time: float
    shut: bool
    cost: float
    share: Share


class Shutting:
    """Watches the share of one channel and says when the expected cost of going on turns.

    Each window of impacts is judged by itself; only a change is reported. At first, going on pays.

    Parameters
    ----------
    gangue_cost : float
        Of one drawn gangue impact, in lost coal impacts; above 0.

    Attributes
    ----------
    threshold : float
        The share above which going on costs more than it brings.

    Raises
    ------
    InvalidValue
        The cost is not above 0.

    Examples
    --------
    >>> round(Shutting(3.0).threshold, 3)
    0.25
    """

    def __init__(self, gangue_cost: float = 1.0) -> None:
        self.gangue_cost = validation.number("gangue_cost", gangue_cost, "", validation.positive)
        self.threshold = 1.0 / (1.0 + self.gangue_cost)
        self._shut = False

    def cost(self, share: Share) -> float:
        """Return what going on costs more than shutting [lost coal impacts an impact]; nan without any impact."""
        return self.gangue_cost * share.share - (1.0 - share.share)

    def watch(self, share: Share) -> Turn | None:
        """Return the turn that this window brings; None without a change, or with too few impacts."""
        if share.n_impacts < FEWEST_IMPACTS:
            return None
        cost = self.cost(share)
        if (cost > 0) == self._shut:
            return None
        self._shut = not self._shut
        return Turn(time=share.time, shut=self._shut, cost=cost, share=share)


class CavingWatch:
    """Follows the answers of a recording, each channel for itself: a channel is a support with a window of its own.

    Parameters
    ----------
    model : Model
    channels : sequence of str
        Their names.
    question : Question
        Its share, step, labels and cost of gangue.
    weight : float
        See `ShareWindow`.

    Examples
    --------
    See `cgid.cli.answer_rows`, which prints what `feed` and `finish` return.
    """

    def __init__(self, model: Model, channels: Sequence[str], question: Question, weight: float = 1.0) -> None:
        question.require_gangue(model)
        share = trained_share(model, question.gangue_labels)
        self._gangue, self._step = question.gangue_labels, question.step
        self._windows = {
            name: ShareWindow(question.share_length, trained_share=share, weight=weight, channel=name)
            for name in channels
        }
        self._rules = {name: Shutting(question.cost_of_gangue) for name in channels}
        #: The share above which going on costs more than it brings.
        self.threshold = Shutting(question.cost_of_gangue).threshold
        self._waiting: deque[Answer] = deque()
        self._steps = 0
        # Channels whose last window was empty, and has been returned.
        self._silent: set[str] = set()

    def feed(self, answers: Iterable[Answer], until: float) -> list[Share | Turn]:
        """Return the shares of the windows that end by now, and the turns that they bring.

        Of windows without impacts only the first is returned, so a pause costs nothing, however long it is.

        Parameters
        ----------
        answers : iterable of Answer
            The next ones, in order of time.
        until : float
            All answers for what happened before this have come [s].
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
        """Return the rest at the end of a recording of a duration [s]."""
        found = self.feed((), duration)
        return found + list(self._at(duration)) if self._waiting or not self._steps else found

    def _pass_silence(self, until: float) -> None:
        """Go on to the window of the next impact where all channels are silent, at most to the last one by now."""
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
        """Return how probably an impact is gangue; nan outside of its training."""
        if not answer.novelty <= 1:
            return float("nan")
        return sum(answer.probabilities[label] for label in self._gangue)


#: The 97.5 % point of the normal distribution.
_Z = 1.959963984540054


def wilson_interval(share: float, total: float) -> tuple[float, float]:
    """Return the 95 % score interval of a share of `total` independent trials (Wilson 1927).

    Examples
    --------
    >>> [round(end, 4) for end in wilson_interval(0.9, 100)]
    [0.8256, 0.9448]
    """
    extra = _Z * _Z / total
    middle = (share + extra / 2) / (1 + extra)
    half = _Z * (share * (1 - share) / total + extra / (4 * total)) ** 0.5 / (1 + extra)
    return middle - half, middle + half

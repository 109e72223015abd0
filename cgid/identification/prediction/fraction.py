"""The gangue fraction over a sliding window of impacts, and when to shut the window.

The mean of the probabilities is a biased estimate. A model trained on equal amounts of coal and gangue gives .3 to
ambiguous coal; for such coal alone, the mean stays at .3. So the fraction q is estimated by maximum likelihood. A model
finished on streams contains the rates of its predictions for rocks of either label
(`cgid.identification.model.confusion`), so errors, bounces and unknown impacts are included. For others the
probabilities are taken as correct (Saerens, Latinne & Decaestecker 2002). If rocks of gangue give a prediction r times
as often as those of coal, and M times as many predictions in total, its likelihood is

    L = (1 - q + q r) / (1 - q + q M)

The product of L over the window, to the power of 1 / overdispersion and with a uniform prior, is the posterior density
of q. It is then spread by the scatter of the estimate from stream to stream. The share is the one of largest density,
because a mean is pulled to the middle where little is known.

Going on takes the next rock, whatever it is. A gangue costs `dilution_cost`, because it must be carried, washed and
dumped. Per rock, continuing costs

    dilution_cost * q - (1 - q)

more than shutting. Its sign changes at q = 1 / (1 + dilution_cost), the threshold. Each second of going on above it
loses 1 for each unit of fraction above it, and each second shut below it `cost_early` for each unit below.
SHUT is issued when the expected loss of going on is the greater one, and the interval lies above the limit or it has
been so at each look for a fifth of a window: who looks each second finds by chance what no later look confirms. Going
on, and OPEN after a SHUT, need the opposite and an interval below the limit: until then going on is not yet sure.
After a switch nothing changes for a least time (`hold`). By default a second too early costs more: all the coal that
would have followed is lost with it, while a second too late is lost alone. Nothing is decided unless at least five
impacts of a window, and half of them, are identified; in the first 25 s, sixty. Going on ends with the last impact of
its window; SHUT is withdrawn after two minutes without enough of them, since nothing falls through a window that is
shut.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.model.anchor import (
    MIN_WINDOW,
    Anchor,
    Basis,
    Impacts,
    SeamNetworks,
    class_edges,
    impacts_of,
)
from cgid.identification.model.confusion import (
    MIN_TESTED,
    SUREST,
    Confusion,
    logit,
    trials_of,
    wilson_interval,
)
from cgid.identification.prediction.settings import COST_EARLY, RULES

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import CONTROL

__all__ = ["Share"]

#: Coverage of the interval of the fraction.
LEVEL = 0.95
#: SHUT is withdrawn after this time without a window of enough identified impacts [s].
LAPSE = 120.0
#: So long after the first impact [s], a window must hold so many identified ones: without this, 4 of 20 streams of the
#: benchmark of seams were shut by chance, most of them in their first seconds.
FIRST, OF_FIRST = 25.0, 60
#: Going on must lose more at each look for this part of a window, where the interval holds the limit: in streams of ten
#: minutes below the limit (benchmarks/beam/anchor.py --streams) half of the false SHUTs do not last so long. A whole
#: window leaves fewer still, but costs more in late SHUTs than it saves (benchmarks/identification/caving_cycle.py).
LASTS = 0.2
#: The end of a window in which impacts are expected as before: this part of it, at most so long [s].
_END = 0.2
_LONGEST_END = 2.0
#: Standard deviations of a count of rocks below which they have stopped coming: one look in 200 of steady ones.
_STOPPED = 2.6
#: Width of the narrowest interval of an accuracy.
_NARROWEST = 1e-6
#: Nodes of the density, evenly spaced in the angle of share = sin^2(angle): finer towards 0 and 1.
_NODES = 401


@dataclass(frozen=True, kw_only=True)
class Share:
    """The gangue fraction among the impacts of a window.

    Attributes
    ----------
    time : float [s]
        End of the window.
    start : float [s]
        Begin of the window; impacts after it and up to `time` count.
    share : float
        The most probable one, by networks of seams the mean; nan without any impact, and of a model whose test
        chance explains.
    low, high : float
        Shortest interval of probability `LEVEL`; 0 and 1 where `share` is nan.
    mean : float
        The expected one, for expected costs; nan where `share` is.
    above : float
        Probability that the share is above the threshold of the window; nan where it is.
    excess : float
        Expected amount by which it is above the threshold, where below counts as 0; nan where it is.
    basis : Basis
        What it rests on: the seam of the training, the coal with which the window began, or any seam.
    n_impacts : int
        Number of identified impacts.
    n_unknown : int
        Number of impacts unmeasurable or outside the training range, which are excluded.
    channel : str
        Name of the channel.
    is_current : bool
        Whether its end has as many identified impacts as their rate lets expect; no switch rests on one that only gets
        older.
    """

    time: float
    start: float
    share: float
    low: float
    high: float
    n_impacts: int
    n_unknown: int = 0
    channel: str = "1"
    mean: float = float("nan")
    above: float = float("nan")
    excess: float = float("nan")
    basis: Basis = Basis.TRAINED
    is_current: bool = True

    @property
    def is_known(self) -> bool:
        """Whether impacts say anything about the fraction."""
        return not np.isnan(self.share)

    def __repr__(self) -> str:
        where = "" if self.channel == "1" else f" of channel {self.channel}"
        share = f"{self.share:.3f} ({self.low:.3f} to {self.high:.3f})"
        counts = f"{self.n_impacts} identified, {self.n_unknown} unknown"
        return f"Share({share} from {self.start:g} to {self.time:g} s{where}: {counts})"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class NoConfusion:
    """Probabilities taken as correct, for a gangue fraction in the training; used like a `Confusion`."""

    trained_share: float = 0.5
    abundance: ClassVar = 1.0
    overdispersion: ClassVar = 1.0
    scatter: ClassVar = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.trained_share < 1:
            raise InvalidValue(f"trained_share must be between 0 and 1 (exclusive), got {self.trained_share:g}")

    def ratios(self, logits: Floats) -> Floats:
        """Return the likelihood ratio of predictions, gangue over coal, (n,)."""
        return np.exp(logits) * (1.0 - self.trained_share) / self.trained_share


def answers_of(model: StoredModel, gangue: Collection[str]) -> Confusion | NoConfusion:
    """Return the confusion of a model for coal and gangue: from streams, calibration or its probabilities."""
    if len(model.labels) == 2:
        first = model.labels[0] in gangue
        confusion = model.confusion
        if confusion is None and model.conformal is not None:
            scores, second = model.conformal.scores, model.conformal.labels == 1
            logits = logit(np.where(second, 1.0 - scores, scores))
            confusion = Confusion.counted(logits, second, (int(np.sum(~second)), int(np.sum(second))))
        if confusion is not None:
            return confusion.turned() if first else confusion
    return NoConfusion(trained_share=trained_share(model, gangue))


def tested_answers(model: StoredModel, gangue: Collection[str]) -> Confusion:
    """Return the confusion in the test of a model of two labels, for use with stated coal; `InvalidValue` without one.

    It only knows which label each answer was; an anchor takes the place of its coal.
    """
    metrics, confusion = model.training.get("metrics", {}), None
    held_out, got = HeldOut.of(metrics, np.isin(model.labels, tuple(gangue))), f"{len(model.labels)} labels"
    if len(model.labels) == 2 and held_out is not None:
        counts = np.asarray(metrics["confusion"], float)
        confusion = Confusion.of_test(counts, held_out.n_trials)
        got = " and ".join(f"{n:.0f} of {label}" for n, label in zip(counts.sum(axis=1), model.labels, strict=True))
    if confusion is None:
        raise InvalidValue(
            "coal_until must be left out, this model does not know how often it errs for either label: that needs two "
            f"labels and {MIN_TESTED} tested impacts of each, got {got}; label more impacts, or train one on streams "
            "of a scene"
        )
    return confusion.turned() if model.labels[0] in gangue else confusion


class ShareWindow:
    """The impacts of the last seconds, and their gangue fraction.

    Four certain impacts give the mode and the interval of Beta(1 + 1, 3 + 1).

    >>> window = ShareWindow(10.0)
    >>> for time, probability in enumerate([0.0, 0.0, 1.0, 0.0]):
    ...     window.add(float(time), probability)
    >>> round(window.at(3.0).share, 2)
    0.25
    """

    def __init__(
        self,
        length: float,
        *,
        answers: Confusion | NoConfusion | None = None,
        weight: float = 1.0,
        channel: str = "1",
        threshold: float = 0.5,
        seams: SeamNetworks | None = None,
        anchor: Anchor | None = None,
        lumps: Anchor | None = None,
        by_chance: bool = False,
    ) -> None:
        # The weight of one answer is below 1 where windows overlap: 1 end to end, .5 for half overlap; the threshold is
        # for `Share.above`.
        self.length = validation.number("window", length, "s", validation.positive)
        self.channel = channel
        if not 0 < weight <= 1:
            raise InvalidValue(f"weight must be above 0 and up to 1, got {weight:g}")
        self._answers, self._threshold = answers or NoConfusion(), threshold
        self._weight = weight / self._answers.overdispersion
        self._seams, self.anchor, self._lumps = seams, anchor, lumps
        self._is_by_chance = by_chance
        self._impacts: deque[tuple[float, float, tuple[float, ...] | None]] = deque()

    def add(self, time: float, probability: float, pulse: tuple[float, ...] | None = None) -> None:
        """Add the gangue probability of an impact at a time [s], nan if unknown, and its pulse, if measured.

        Calls must be in order of time.
        """
        self._impacts.append((time, probability, pulse))
        for labelled in filter(None, (self.anchor, self._lumps)):
            labelled.add(time, probability, pulse)

    def forget(self, start: float, end: float) -> None:
        """Drop the impacts after a time and up to another [s], of an anchor, too."""
        self._impacts = deque(one for one in self._impacts if not start < one[0] <= end)
        for labelled in filter(None, (self.anchor, self._lumps)):
            labelled.forget(start, end)

    def restart(self, time: float) -> Share:
        """Drop all impacts up to a time [s], and return the fraction of the window without them."""
        self._impacts.clear()
        return self.at(time)

    def at(self, time: float) -> Share:
        """Return the fraction in the window that ends at a time [s], and drop all earlier impacts."""
        start = time - self.length
        while self._impacts and self._impacts[0][0] <= start:
            self._impacts.popleft()
        inside = impacts_of([one[1:] for one in self._impacts if one[0] <= time])
        estimate: dict[str, Any] = {"share": float("nan"), "low": 0.0, "high": 1.0}
        basis = Basis.TRAINED if self._seams is None else Basis.ANY_SEAM
        if self.anchor is not None:
            basis = self.anchor.basis(time)
        if inside.logits.size and not self._is_by_chance:
            if self._seams is None:
                estimate = self._estimate(inside.logits, self._confusion(basis))
            else:
                estimate, basis = self._by_seams(inside, basis, time)
        return Share(
            time=time,
            start=max(start, 0.0),
            n_impacts=inside.logits.size,
            n_unknown=inside.n_unknown,
            channel=self.channel,
            basis=basis,
            is_current=self._is_current(time),
            **estimate,
        )

    def _is_current(self, time: float) -> bool:
        """Return whether identified impacts come until a time [s] as they came before."""
        known = [at for at, probability, _ in self._impacts if at <= time and np.isfinite(probability)]
        end = min(_END * self.length, _LONGEST_END)
        n_latest = sum(at > time - end for at in known)
        if n_latest == len(known) or time < 2 * end or known[-1] == known[0]:
            return n_latest == len(known)
        expected = (len(known) - 1) / (known[-1] - known[0]) * end  # by the rate while they came
        return bool(n_latest >= expected - _STOPPED * np.sqrt(expected))

    def _by_seams(self, inside: Impacts, basis: Basis, time: float) -> tuple[dict[str, float], Basis]:
        """Return the fields of a `Share` for the impacts of a window by the networks, and its basis."""
        assert self._seams is not None
        window, anchor, lumps = self._seams.summary(inside), None, None
        is_enough = inside.logits.size >= MIN_WINDOW
        if basis == Basis.ANCHOR and is_enough:
            assert self.anchor is not None
            anchor = self.anchor.summarised(self._seams)
            if self._seams.foreignness(window, anchor)[0] > 0:
                self.anchor.is_foreign, anchor, basis = True, None, Basis.FOREIGN
            elif self._lumps is not None:
                basis, lumps = self._lumps_beside(anchor, self._lumps.basis(time))
        density = self._seams.density(window, anchor, lumps)[0] if is_enough else np.diff(class_edges())
        return estimate_of(density, self._threshold), basis

    def _lumps_beside(self, anchor: Floats, basis: Basis) -> tuple[Basis, Floats | None]:
        """Return the basis beside an anchor and the summary of the lumps, if they are gangue."""
        assert self._seams is not None and self._lumps is not None
        if basis != Basis.ANCHOR:
            return Basis.FEW_LUMPS if basis == Basis.TOO_FEW else Basis.ANCHOR, None
        summary = self._lumps.summarised(self._seams)
        if self._seams.gangue_of(summary, anchor)[0] < self._seams.lumps_limit:
            return Basis.WRONG_LUMPS, None
        return Basis.LUMPS, summary

    def _confusion(self, basis: Basis) -> Confusion | NoConfusion:
        """Return the confusion, with the predictions for the coal of the anchor in place of those of the training."""
        if basis != Basis.ANCHOR or isinstance(self._answers, NoConfusion):
            return self._answers
        assert self.anchor is not None
        return self._answers.anchored(self.anchor.impacts.logits)

    def _estimate(self, logits: Floats, answers: Confusion | NoConfusion) -> dict[str, float]:
        """Return the fields of a `Share` for the rocks of some predictions."""
        shares, edges = _nodes()
        breadths = np.diff(edges)
        # Equal predictions are one row: a window of thousands takes no longer than the bins of a confusion.
        ratios, counts = np.unique(answers.ratios(logits), return_counts=True)
        log_likelihood = counts.astype(np.float64) @ np.log1p(np.multiply.outer(ratios - 1.0, shares))
        among = logits.size * np.log1p((answers.abundance - 1.0) * shares)
        logarithm = self._weight * (log_likelihood - among)
        masses = np.exp(logarithm - logarithm.max()) * breadths
        masses /= masses.sum()
        likely = float(shares[np.argmax(logarithm)])
        if (blur := _blur(answers.scatter)) is not None:
            masses = blur @ masses
        # The density has a single maximum (its logarithm is concave in the share of answers, which grows with that of
        # rocks), so the densest shares are neighbours.
        densest = np.argsort(-masses / breadths, kind="stable")
        densest_nodes = densest[: int(np.searchsorted(np.cumsum(masses[densest]), LEVEL)) + 1]
        below = np.interp(self._threshold, edges, np.append(0.0, np.cumsum(masses)))
        return {
            "share": likely,
            "low": float(shares[densest_nodes.min()]),
            "high": float(shares[densest_nodes.max()]),
            "mean": float(masses @ shares),
            "above": float(np.clip(1.0 - below, 0.0, 1.0)),
            "excess": float(masses @ np.maximum(shares - self._threshold, 0.0)),
        }


def estimate_of(density: Floats, threshold: float) -> dict[str, float]:
    """Return the fields of a `Share` for the probabilities of the classes of the fraction, (N_CLASSES,)."""
    cumulative = np.append(0.0, np.cumsum(density))
    # Within a class the density is constant in the angle of fraction = sin^2(angle).
    shares, edges = _nodes()
    angles = np.arcsin(np.sqrt(edges)) / (np.pi / 2)
    below = np.interp(angles, np.linspace(0.0, 1.0, cumulative.size), cumulative / cumulative[-1])
    starts = np.flatnonzero(below <= 1.0 - LEVEL)
    ends = np.searchsorted(below, below[starts] + LEVEL - 1e-12)
    shortest = int(np.argmin(edges[ends] - edges[starts]))
    mean = float(np.diff(below) @ shares)
    return {
        "share": mean,
        "low": float(edges[starts[shortest]]),
        "high": float(edges[ends[shortest]]),
        "mean": mean,
        "above": float(1.0 - np.interp(threshold, edges, below)),
        "excess": float(np.diff(below) @ np.maximum(shares - threshold, 0.0)),
    }


def trained_share(model: StoredModel, gangue: Collection[str]) -> float:
    """Return the fraction of some labels in the training of a model, if its card states it."""
    # The test impacts have the frequencies of labels of the training. Class weights multiply the frequencies.
    confusion = model.training.get("metrics", {}).get("confusion")
    weights = model.training.get("class_weights") or model.training.get("recorded", {}).get("class_weights")
    counts = np.ones(len(model.labels))
    if confusion is not None and weights != "balanced":
        counts *= np.sum(confusion, axis=1)
    if isinstance(weights, Mapping):
        counts *= [weights.get(label, 1.0) for label in model.labels]
    n_gangue = sum(count for label, count in zip(model.labels, counts.tolist(), strict=True) if label in gangue)
    return float(np.clip(n_gangue / counts.sum(), SUREST, 1.0 - SUREST))


@cache
def _nodes() -> tuple[Floats, Floats]:
    """Return shares from 0 to 1, and the edges of the intervals that they represent."""
    shares = np.sin(np.linspace(0.0, np.pi / 2, _NODES)) ** 2
    return shares, np.concatenate([[0.0], (shares[1:] + shares[:-1]) / 2, [1.0]])


@lru_cache(maxsize=16)  # one for each support with an anchor of its own
def _blur(scatter: float) -> Floats | None:
    """Return the matrix that spreads a density by a standard deviation, within 0 and 1; None for 0."""
    if scatter <= 0:
        return None
    shares, edges = _nodes()
    distance = np.subtract.outer(shares, shares) / max(scatter, 1.0 / _NODES)
    matrix = np.exp(-0.5 * distance**2) * np.diff(edges)[:, None]
    return np.asarray(matrix / matrix.sum(axis=0))


#: Minimum number of identified impacts for a decision.
MIN_IMPACTS = 5


@dataclass(frozen=True, kw_only=True)
class Switch:
    """A switch: continuing is expected to lose more than shutting, or less again."""

    time: float  # end of the first window with it [s]
    shut: bool  # True: shut the window; False: continuing pays again
    cost: float  # expected loss of continuing minus that of shutting [lost coal rocks per rock, weighed by the costs]
    evidence: float  # probability that the fraction is above the threshold, or below
    share: Share


class ShutDecision:
    """Decide for shutting the window or for continuing to draw, whichever is expected to lose less.

    >>> round(ShutDecision(3.0).threshold, 3)
    0.25
    """

    def __init__(
        self,
        dilution_cost: float = 1.0,
        *,
        cost_early: float = COST_EARLY,
        hold: float = 0.0,
    ) -> None:
        given = {"dilution_cost": dilution_cost, "cost_early": cost_early, "hold": hold}
        checked = {name: validation.number(name, value, rule=RULES[name]) for name, value in given.items()}
        self.dilution_cost, self.cost_early, self.hold = checked.values()
        self.threshold = 1.0 / (1.0 + self.dilution_cost)
        #: Whether to shut; None where nothing is decided.
        self.shut: bool | None = None
        #: Whether going on is sure: the costs speak for it, and the interval does not hold the limit.
        self.is_sure = False
        self._since = self._supported = -np.inf
        self._losing = np.inf  # since when going on was expected to lose more at each look [s]
        self._begun = np.inf  # since when windows have impacts [s]
        self._said_shut = False

    def cost(self, share: Share) -> float:
        """Return the expected loss of continuing minus that of shutting; nan without any impact.

        It is in lost coal rocks per rock, those of shutting times `cost_early`. The share's `excess` must be over
        `threshold`.
        """
        below = share.excess - (share.mean - self.threshold)
        return (1.0 + self.dilution_cost) * (share.excess - self.cost_early * below)

    def watch(self, share: Share) -> Switch | None:
        """Return the switch at this window; None without one. The share must be of a window with `threshold`.

        The first decision to draw is no switch, since nothing was shut.
        """
        self.note(share)
        least = OF_FIRST if share.time < self._begun + FIRST and self.shut is None else MIN_IMPACTS
        if share.n_impacts < max(least, share.n_unknown):
            self.is_sure, self._losing = False, np.inf
            if share.time > self._supported + LAPSE or not (self.shut or share.n_impacts):
                self.withdraw()
            return None
        self._supported = share.time
        cost = self.cost(share)
        self._losing = min(self._losing, share.time) if cost > 0 else np.inf
        lasts = share.time - self._losing >= LASTS * (share.time - share.start) - 1e-9
        shut = cost > 0 and bool(share.low > self.threshold or lasts)
        self.is_sure = cost <= 0 and share.high < self.threshold
        is_kept = self.shut and not self.is_sure  # costs alone would open at fractions above the limit
        if is_kept or share.time < self._since + self.hold or not share.is_current:
            return None
        self.shut = shut
        if not shut and not (self._said_shut and self.is_sure):
            return None
        self._said_shut, self._since = shut, share.time
        evidence = share.above if shut else 1.0 - share.above
        return Switch(time=share.time, shut=shut, cost=cost, evidence=evidence, share=share)

    def note(self, share: Share) -> None:
        """Note since when impacts come; also of a window on which nothing may be decided."""
        self._begun = min(self._begun, share.time) if share.n_impacts else np.inf

    def withdraw(self) -> None:
        """Decide nothing, because the ground of the decision is gone."""
        self.shut, self.is_sure, self._since, self._losing = None, False, -np.inf, np.inf


_BY_CHANCE = "the model is not shown to be better than chance"


class HeldOut(NamedTuple):
    """How often a model called gangue of its test gangue, and other labels, and the interval of the difference."""

    gangue: float
    others: float
    low: float
    high: float
    n_trials: float  # as many as the interval rests on
    by_chance: bool  # whether chance explains the difference even if all impacts were independent trials
    of_one: bool = False  # whether all labelled impacts are from a single recording
    told: str = ""  # what the answers follow instead of the rocks

    @classmethod
    def of(cls, metrics: Mapping[str, Any], is_gangue: NDArray[np.bool_]) -> HeldOut | None:
        """Return it from the metrics of a test and a mask of the labels; None if they do not state it."""
        if not metrics.keys() >= {"accuracy", "accuracy_interval_95", "confusion"}:
            return None
        sides = np.stack([is_gangue, ~is_gangue]).astype(float)
        counts = sides @ np.asarray(metrics["confusion"], float) @ sides.T
        n = counts.sum(axis=1)
        first, second = (counts[:, 0] / np.maximum(n, 1.0)).tolist()
        # As many independent trials, such as recordings, as the interval of the accuracy rests on.
        accuracy, low, high = np.clip([metrics["accuracy"], *metrics["accuracy_interval_95"]], 0.0, 1.0).tolist()
        n_trials = trials_of(accuracy, max(high - low, _NARROWEST)) if high - low < 1 else 0.0

        def interval(of_gangue: float, of_others: float) -> tuple[float, float]:
            """Return that of the difference from so many trials (Newcombe 1998, method 10)."""
            if not of_gangue * of_others:
                return -1.0, 1.0
            (low, high), (least, most) = wilson_interval(first, of_gangue), wilson_interval(second, of_others)
            below, above = np.hypot(first - low, most - second), np.hypot(high - first, second - least)
            return float(first - second - below), float(first - second + above)

        of_trials = interval(*(n_trials * n / max(n.sum(), 1.0)).tolist())
        return cls(first, second, *of_trials, n_trials, interval(*n.tolist())[0] <= 0)

    def __str__(self) -> str:
        """Return why it proves nothing."""
        return (
            f"it took {self.gangue:.2f} of the gangue of its test for gangue, and {self.others:.2f} of the rest "
            f"(difference {self.low:.2f} to {self.high:.2f})"
        )

    @property
    def unproven(self) -> str:
        """Why the model is not shown to tell gangue from the rest, or not better than chance; empty if it is."""
        if self.told:
            return self.told
        # A decision concerns recordings to come, of which a single one says nothing.
        if self.of_one:
            return (
                f"{_BY_CHANCE}: its labelled impacts are all from one recording, which shows nothing of others; {self}"
            )
        return "" if self.low > 0 else f"{_BY_CHANCE}: {self}"


def followed(training: Mapping[str, Any]) -> str:
    """Return what the answers of a model follow by its training record, instead of the rocks, in one line; else empty.

    >>> followed({"control": {"told": "background", "same": 0.92, "other": 0.51}})[-71:]
    '0.92 right with silence of their own label, 0.51 with that of the other'
    """
    own, here = (part.get(CONTROL, {}) for part in (training, training.get("correction", {})))
    control = here if "same" in here else own
    told = control.get("told", "")
    if told == "path":
        same, other = control["path"]
        return (
            "the labels differ in gain or filter by what sounds between the rocks, and the answers follow it: "
            f"{same:.2f} right by the recorder of their own label, {other:.2f} by that of the other"
        )
    if not told:
        return ""
    return (
        "the labels differ in what sounds between the rocks, and the answers follow it: "
        f"{control['same']:.2f} right with silence of their own label, {control['other']:.2f} with that of the other"
    )


def unproven(model: StoredModel, gangue: Collection[str]) -> str:
    """Return `HeldOut.unproven` of a model; empty without a test."""
    own = held_out(model, gangue)
    return "" if own is None else own.unproven


def held_out(model: StoredModel, gangue: Collection[str]) -> HeldOut | None:
    """Return the test of a model, None if there is none.

    By chance, gangue is called gangue as often as the rest is. The interval of the difference counts what that of the
    accuracy does: recordings, where their impacts resemble each other. A corrected model was tested on thousands of
    impacts elsewhere: those of its new beam disprove it if chance explains them and that test does not.
    """
    if not separates(gangue, model):
        return None
    is_gangue = np.isin(model.labels, as_in(model, gangue))
    own, here = (HeldOut.of(model.training.get(name, {}), is_gangue) for name in ("metrics", "correction"))
    by_sources = "recorded" in model.training and len(set(model.training.get("sources", ()))) == 1  # of older files
    told = followed(model.training)
    if here is not None and (told or own is None or here.low > 0 or here.high < own.gangue - own.others):
        return here._replace(told=told)
    of_one = bool(model.training.get("one_recording", by_sources))
    return None if own is None else own._replace(of_one=of_one, told=told)


def separates(gangue: Collection[str], model: StoredModel) -> bool:
    """Return whether a model separates these labels from others."""
    return 0 < len(set(as_in(model, gangue)) & set(model.labels)) < len(model.labels)


def as_in(model: StoredModel, labels: Collection[str]) -> tuple[str, ...]:
    """Return labels in any case as a model spells them."""
    return tuple(validation.as_spelled(label, model.labels) for label in labels)

"""The gangue share and its interval, against closed forms and simulation; the decision, against brute force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.integrate import quad

from cgid.errors import InvalidValue
from cgid.identification.model.anchor import N_CLASSES, Anchor, Basis, class_edges
from cgid.identification.model.confusion import Confusion, StreamAnswers, wilson_interval
from cgid.identification.model.families import Network
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.fraction import (
    FIRST,
    LAPSE,
    MIN_IMPACTS,
    OF_FIRST,
    HeldOut,
    NoConfusion,
    Share,
    ShareWindow,
    ShutDecision,
    Switch,
    as_in,
    estimate_of,
    separates,
    trained_share,
    unproven,
)
from cgid.identification.prediction.prediction import Answer, PredictionSettings
from cgid.identification.prediction.support import CavingWatch, Decision, Ground, SupportReport
from cgid.recordings.lines import HEARD_AFTER
from cgid.recordings.soundness import SensorWatch
from tests.test_anchor import PULSE, networks

#: How far the scores of coal and gangue lie apart, in their deviations: right in 77 % of the impacts.
SEPARATION = 1.5


def share_of(probabilities, trained_share=0.5, confusion=None, **settings) -> Share:
    window = ShareWindow(1e6, answers=confusion or NoConfusion(trained_share=trained_share), **settings)
    for time, probability in enumerate(probabilities):
        window.add(float(time), probability)
    return window.at(float(len(probabilities)))


def drawn(rng, share, n_impacts, trained_share=0.5):
    """Return which impacts are gangue, and what a perfect model trained at a share says of each."""
    gangue = rng.random(n_impacts) < share
    score = rng.normal(np.where(gangue, SEPARATION / 2, -SEPARATION / 2))
    odds = np.exp(SEPARATION * score) * trained_share / (1 - trained_share)
    return gangue, odds / (1 + odds)


@pytest.mark.parametrize(("gangue", "coal"), [(3, 9), (0, 6), (40, 2), (200, 300)])
def test_impacts_without_doubt_give_a_beta_density(gangue: int, coal: int) -> None:
    found = share_of([1.0] * gangue + [0.0] * coal)
    density = stats.beta(gangue + 1, coal + 1)
    starts = np.linspace(0, 0.05, 2001)
    ends = density.ppf(np.minimum(starts + 0.95, 1))
    shortest = np.argmin(ends - density.ppf(starts))
    assert found.mean == pytest.approx(density.mean(), abs=1e-3)
    assert found.share == pytest.approx(gangue / (gangue + coal), abs=4e-3)
    assert ShareWindow(1.0).at(0.0).above != found.above == pytest.approx(density.sf(0.5), abs=2e-3)
    assert found.low == pytest.approx(density.ppf(starts[shortest]), abs=8e-3)
    assert found.high == pytest.approx(ends[shortest], abs=8e-3)
    assert found.n_impacts == gangue + coal


def test_mean_is_that_of_the_likelihood_integrated() -> None:
    probabilities = np.array([0.2, 0.9, 0.6, 0.05, 0.3, 0.4])
    trained = 0.3
    ratio = probabilities / (1 - probabilities) * (1 - trained) / trained

    def likelihood(q: float) -> float:
        return float(np.prod(1 - q + q * ratio))

    exact = quad(lambda q: q * likelihood(q), 0, 1)[0] / quad(likelihood, 0, 1)[0]
    assert share_of(probabilities, trained_share=trained).mean == pytest.approx(exact, abs=1e-5)


@pytest.mark.parametrize(
    ("training", "share"),
    [
        ({}, 0.1),
        ({"class_weights": "balanced"}, 0.5),
        ({"class_weights": {"gangue": 3.0}}, 0.25),
        ({"recorded": {"class_weights": "balanced"}}, 0.5),
        ({"recorded": {"class_weights": {"coal": 0.5, "gangue": 9.0}}}, 2 / 3),
        ({"recorded": {"class_weights": None}}, 0.1),
    ],
)
def test_class_weights_are_a_part_of_what_was_trained_on(training: dict[str, Any], share: float) -> None:
    metrics = {"metrics": {"confusion": [[880, 20], [40, 60]]}}
    model = SimpleNamespace(labels=("coal", "gangue"), training=metrics | training)
    assert trained_share(model, ("gangue",)) == pytest.approx(share)  # type: ignore[arg-type]


def test_interval_holds_the_share_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    shares = rng.random(2000)
    held = 0
    for share in shares:
        _, probabilities = drawn(rng, share, 50, trained_share=0.3)
        found = share_of(probabilities, trained_share=0.3)
        held += found.low <= share <= found.high
    # Three deviations of the count of 2000; the nodes can only make it wider.
    assert 0.935 < held / 2000 < 0.972


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_interval_holds_any_one_share(share: float) -> None:
    rng = np.random.default_rng(int(share * 10))
    held, means, plain = 0, [], []
    for _ in range(400):
        _, probabilities = drawn(rng, share, 80)
        found = share_of(probabilities)
        held += found.low <= share <= found.high
        means.append(found.share)
        plain.append(probabilities.mean())
    assert held / 400 > 0.915
    assert np.mean(means) == pytest.approx(share, abs=0.06)
    if share != 0.5:  # what the mean of the probabilities would have said
        assert abs(np.mean(plain) - share) > 2 * abs(np.mean(means) - share)
        assert abs(np.mean(plain) - share) > 0.09


def test_share_does_not_depend_on_the_mix_of_the_training() -> None:
    rng = np.random.default_rng(1)
    score = rng.normal(0.3, 1.0, 70)
    found = []
    for trained in (0.2, 0.5, 0.7):
        odds = np.exp(SEPARATION * score) * trained / (1 - trained)
        found.append(share_of(odds / (1 + odds), trained_share=trained))
    assert [one.share for one in found] == pytest.approx([found[0].share] * 3, abs=2e-3)
    assert found[0].low < found[0].share < found[0].high


def test_window_slides() -> None:
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0, 60, 300))
    _, probabilities = drawn(rng, 0.5, 300)
    probabilities[::7] = np.nan
    window, place = ShareWindow(10.0, channel="left"), 0
    for end in np.arange(5.0, 61.0, 5.0):
        while place < 300 and times[place] <= end + 1.0:  # answers may be ahead of the window that is asked for
            window.add(times[place], probabilities[place])
            place += 1
        inside = (times > end - 10.0) & (times <= end)
        alone = share_of(probabilities[inside])
        found = window.at(end)
        assert (found.share, found.low, found.high) == (alone.share, alone.low, alone.high)
        assert (found.start, found.time, found.channel) == (max(end - 10.0, 0.0), end, "left")
        assert found.n_unknown == np.isnan(probabilities[inside]).sum()
        assert found.n_impacts + found.n_unknown == inside.sum()


@pytest.fixture(scope="module")
def futures() -> Callable[[float], tuple[list[Share], np.ndarray]]:
    """Many windows with a threshold, and the fraction of gangue in each: what comes after it."""

    @cache
    def made(threshold: float) -> tuple[list[Share], np.ndarray]:
        rng = np.random.default_rng(11)
        coming = rng.random(2500)
        return [share_of(drawn(rng, one, 25)[1], threshold=threshold) for one in coming], coming

    return made


@pytest.mark.parametrize("dilution_cost", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("early", [1.0, 6.0, 0.125])
def test_expected_cost_is_what_going_on_does_lose(futures, dilution_cost: float, early: float) -> None:
    rule = ShutDecision(dilution_cost, cost_early=early)
    found, coming = futures(rule.threshold)
    said = np.array([rule.cost(share) for share in found])
    # Per rock, as a mine counts: a gangue costs `dilution_cost` coal, a coal brings one.
    going = dilution_cost * coming - (1 - coming)
    cost = np.where(going > 0, 1.0, early) * going
    for part in np.array_split(np.argsort(said), 8):
        error = cost[part].std() / np.sqrt(part.size)
        assert said[part].mean() == pytest.approx(cost[part].mean(), abs=4 * error)
    own = np.where(said > 0, 0.0, cost).mean()
    others = [np.where([one.above >= p for one in found], 0.0, cost).mean() for p in np.linspace(0.05, 0.95, 19)]
    assert own < min(cost.mean(), 0.0) - 0.02 * min(early, 1.0)  # better than to draw all, or nothing
    assert own < min(others) + 2e-3  # no evidence is cheaper, whatever it is


def state(share: float, n_impacts: int = 60, time: float = 1.0, spread: float = 0.0) -> Share:
    """Return a share that is as likely this much above its mean as below, with a threshold of one half."""
    ends = np.array([share - spread, share + spread])
    own = {"mean": share, "above": float((ends > 0.5).mean()), "excess": float(np.maximum(ends - 0.5, 0.0).mean())}
    return Share(time=time, start=0.0, share=share, low=ends[0], high=ends[1], n_impacts=n_impacts, **own)


def test_turns_are_said_when_they_lose_less_and_the_last_one_was_held() -> None:
    rule = ShutDecision(1.0, cost_early=3.0, hold=2.0)
    # At .6 +- .3 the losses are .2 and .3, at .65 +- .3 they are .225 and .225, at .7 +- .3 .25 and .15. At .6 and .4
    # staying shut loses more, but their intervals hold the limit; that of .1 does not. These windows have no length.
    means = [0.1, 0.6, 0.7, 0.1, 0.6, 0.4, 0.1, 0.7, 0.7, 0.7, 0.1]
    turns, sure = [], []
    for k, one in enumerate(means):
        turns.append(rule.watch(replace(state(one, time=float(k), spread=0.3), start=float(k))))
        sure.append(rule.is_sure)
    assert [(t.time, t.shut) for t in turns if t] == [(2.0, True), (6.0, False), (8.0, True), (10.0, False)]
    assert [t.evidence for t in turns if t] == [0.5, 1.0, 0.5, 1.0]
    assert sure == [one == 0.1 for one in means]
    assert turns[2] is not None and turns[2].cost == pytest.approx(2 * (0.25 - 0.15))
    neither = state(0.65, spread=0.3)
    assert rule.cost(neither) == pytest.approx(0.0, abs=1e-12)
    assert ShutDecision(1.0, cost_early=1.0).cost(neither) == pytest.approx(2 * (0.65 - 0.5))


def test_a_wide_fraction_above_the_limit_opens_nothing_and_hold_keeps_shut() -> None:
    """Five of eight rocks are gangue: Beta(6, 4), below .5 with a probability of a quarter, which counts six times."""

    def watched_from(n_coal: int, hold: float) -> tuple[list[Switch], float]:
        window, rule = ShareWindow(10.0), ShutDecision(cost_early=6.0, hold=hold)
        turned = [rule.watch(state(0.9, time=0.0))]
        for number in range(8):
            window.add(20.0 + number, float(number >= n_coal))
        turned.append(rule.watch(share := window.at(28.0)))
        return [one for one in turned if one is not None], rule.cost(share)

    density = stats.beta(6, 4).pdf
    late = quad(lambda x: (x - 0.5) * density(x), 0.5, 1.0)[0]
    early = quad(lambda x: (0.5 - x) * density(x), 0.0, 0.5)[0]
    turns, cost = watched_from(3, 10.0)
    assert cost == pytest.approx(2.0 * (late - 6.0 * early), abs=2e-3) and cost < 0
    assert [one.shut for one in turns] == [True]
    turns, _ = watched_from(8, 10.0)
    assert [one.shut for one in turns] == [True, False]
    assert turns[1].evidence == pytest.approx(stats.beta(1, 9).cdf(0.5), abs=2e-3)
    assert [one.shut for one in watched_from(8, 60.0)[0]] == [True]


@pytest.mark.parametrize("cost", [-1e-9, float("nan"), float("inf")])
def test_a_cost_is_finite_and_not_negative(cost: float) -> None:
    for make in (ShutDecision, PredictionSettings):
        with pytest.raises(InvalidValue, match="cost_early"):
            make(cost_early=cost)


def test_a_wider_density_shuts_later_and_without_a_cost_of_shutting_nothing_goes_on() -> None:
    narrow, wide = state(0.7, spread=0.1), state(0.7, spread=0.3)
    rule = ShutDecision(1.0, cost_early=6.0)
    assert rule.cost(narrow) > 0 > rule.cost(wide)
    turn = ShutDecision(cost_early=0.0).watch(replace(state(0.3, spread=0.25), start=1.0))
    assert turn is not None and turn.shut


def test_few_or_unknown_impacts_decide_nothing() -> None:
    rule = ShutDecision()
    late = 1.0 + FIRST
    assert rule.watch(state(0.9, MIN_IMPACTS, 1.0)) is None
    assert rule.watch(state(0.9, MIN_IMPACTS - 1, late)) is None
    assert rule.watch(replace(state(0.9, 20, late), n_unknown=21)) is None
    assert rule.shut is None
    switch = rule.watch(replace(state(0.9, MIN_IMPACTS, late), n_unknown=MIN_IMPACTS))
    assert switch is not None and switch.shut


def test_the_first_seconds_with_impacts_need_sixty() -> None:
    rule = ShutDecision()
    for begin in (100.0, 300.0):  # a pause begins them again, and so does the first impact of a stream
        assert rule.watch(state(float("nan"), 0, begin - 1)) is None and rule.shut is None
        for time in np.arange(begin, begin + FIRST):
            assert rule.watch(state(0.1, OF_FIRST - 1, time)) is None and rule.shut is None
        assert rule.watch(state(0.1, OF_FIRST - 1, begin + FIRST)) is None and rule.shut is False
    first = ShutDecision().watch(state(0.9, OF_FIRST, 0.0))
    assert first is not None and first.shut


def test_a_wide_fraction_above_the_limit_shuts_after_a_fifth_of_a_window() -> None:
    rule, wide, narrow = ShutDecision(), state(0.8, spread=0.35), state(0.8, spread=0.2)
    assert rule.cost(wide) > 0 and wide.low < 0.5 < narrow.low

    def looked(share: Share, *times: float) -> list[bool | None]:
        turns = [rule.watch(replace(share, time=one, start=one - 10.0)) for one in times]
        return [turn and turn.shut for turn in turns]

    # One look in between with the opposite, or with too few impacts, begins it again.
    assert looked(wide, 20.0, 21.0) == [None, None] and (rule.shut, rule.is_sure) == (False, False)
    assert looked(state(0.4, spread=0.3), 22.0) == looked(wide, 31.0) == looked(wide, 32.0) == [None]
    assert looked(replace(wide, n_impacts=4), 33.0) == [None]
    assert looked(wide, 34.0, 35.0, 36.0) == [None, None, True]
    # Withdrawn, it opens when the interval is below the limit, not before.
    rule.withdraw()
    assert looked(state(0.3, spread=0.3), 57.0) == [None] and (rule.shut, rule.is_sure) == (False, False)
    assert looked(state(0.2, spread=0.2), 58.0) == [False] and rule.is_sure
    assert looked(narrow, 59.0) == [True]


def test_going_on_ends_with_the_last_impact_of_its_window_and_shut_is_kept_for_longer() -> None:
    rule = ShutDecision()
    for n, is_sure, shut in ((60, True, False), (MIN_IMPACTS - 1, False, False), (0, False, None)):
        assert rule.watch(state(0.1, n, float(60 - n))) is None
        assert (rule.is_sure, rule.shut) == (is_sure, shut)
    rule.watch(state(0.9, time=100.0))
    for time, shut in ((101.0, True), (100.0 + LAPSE, True), (101.0 + LAPSE, None)):
        assert rule.watch(state(float("nan"), 0, time)) is None and rule.shut is shut


def test_a_decision_begins_without_a_switch_and_ends_with_its_ground() -> None:
    rule = ShutDecision(1.0, hold=2.0)
    # The first decision to draw opens nothing; after a SHUT, also a withdrawn one, drawing is a switch.
    assert rule.watch(state(0.1, time=1.0)) is None and rule.shut is False
    assert rule.watch(state(0.4, time=2.0)) is None and rule.shut is False
    assert rule.watch(state(0.9, time=3.0)) is not None and rule.shut is True
    rule.withdraw()
    assert rule.shut is None
    switch = rule.watch(state(0.1, time=3.5))
    assert switch is not None and not switch.shut
    assert rule.watch(state(0.5, 3, time=3.5 + LAPSE)) is None and rule.shut is False
    assert rule.watch(state(0.5, 3, time=3.6 + LAPSE)) is None and rule.shut is None
    rule.watch(state(float("nan"), 0, time=4.0 + LAPSE))
    again = rule.watch(state(0.9, time=200.0))
    assert again is not None and again.shut


def test_caving_window_is_shut_close_to_the_best_time() -> None:
    """The share rises over a minute; against every fixed time, and against the best one with hindsight."""
    rng = np.random.default_rng(5)
    dilution_cost, rate, regret, spans = 2.0, 14.0, [], []
    fixed = np.zeros(61)
    for _ in range(40):
        middle = rng.uniform(15, 45)
        times = np.sort(rng.uniform(0, 60, int(rate * 60)))
        share = 1 / (1 + np.exp(-(times - middle) / 4))
        gangue, probabilities = drawn(rng, share, times.size)
        rule, shut_at = ShutDecision(dilution_cost, cost_early=1.0), 60.0
        window = ShareWindow(5.0, threshold=rule.threshold)
        place = 0
        for end in np.arange(1.0, 61.0):
            while place < times.size and times[place] <= end:
                window.add(times[place], probabilities[place])
                place += 1
            turn = rule.watch(window.at(end))
            if turn:
                shut_at = turn.time
                break
        cost = np.where(gangue, dilution_cost, -1.0)
        paid = np.array([cost[times <= end].sum() for end in np.arange(61.0)])
        fixed += paid
        regret.append(paid[int(shut_at)] - paid.min())
        spans.append(-paid.min())
    lost = np.mean(regret) / np.mean(spans)
    best_fixed = (fixed.min() / 40 + np.mean(spans)) / np.mean(spans)
    assert lost < 0.13
    assert lost < 0.7 * best_fixed


# -- a model that makes mistakes, and says which ----------------------------------------------------------


def answered(rng, gangue, quality=1.0, bounces=True):
    """Return logits and labels of answers to rocks: gangue bounces less, and a bounce looks like coal."""
    n = 1 + (rng.poisson(np.where(gangue, 0.3, 0.9)) if bounces else np.zeros(gangue.size, int))
    rock = np.repeat(np.arange(gangue.size), n)
    first = np.append(True, np.diff(rock) > 0)
    middle = np.where(gangue[rock] & first, quality, np.where(first, -quality, -1.2))
    return rng.normal(middle, 0.9), gangue[rock], rock


def confusion_of(rng, n_streams=60, n_rocks=300, **settings) -> Confusion:
    streams = []
    for share in (np.arange(n_streams) + 0.5) / n_streams:
        gangue = rng.random(n_rocks) < share
        logits, second, rock = answered(rng, gangue, **settings)
        counts = int(np.sum(~gangue)), int(np.sum(gangue))
        streams.append(StreamAnswers(logits=logits, second=second, time=rock * 0.2, n_rocks=counts, share=share))
    found = Confusion.of_streams(streams)
    assert found is not None
    return found


def test_share_is_that_of_rocks_whatever_bounces() -> None:
    rng = np.random.default_rng(21)
    confusion = confusion_of(rng)
    assert confusion.abundance == pytest.approx(1.3 / 1.9, abs=0.03)
    errors, held = [], []
    for share in np.tile(np.arange(0, 1.01, 0.1), 25):
        gangue = rng.random(80) < share
        logits, _, _ = answered(rng, gangue)
        found = share_of(1 / (1 + np.exp(-logits)), confusion=confusion)
        errors.append(found.share - share)
        held.append(found.low <= gangue.mean() <= found.high)
    assert abs(np.mean(errors)) < 0.02
    assert 0.92 < np.mean(held) <= 1.0
    believed = [share_of(1 / (1 + np.exp(-answered(rng, rng.random(80) < 0.8)[0]))).share - 0.8 for _ in range(20)]
    assert np.mean(believed) < -0.1  # bounces would have been taken for coal


def test_streams_that_differ_widen_the_interval() -> None:
    rng = np.random.default_rng(22)
    streams = []
    for number in range(40):
        share = (number + 0.5) / 40
        gangue = rng.random(500) < share
        logits, second, rock = answered(rng, gangue)
        counts = int(np.sum(~gangue)), int(np.sum(gangue))
        logits += rng.normal(0, 0.4)  # a day of its own
        streams.append(StreamAnswers(logits=logits, second=second, time=rock * 0.2, n_rocks=counts, share=share))
    found = Confusion.of_streams(streams)
    assert found is not None
    assert found.scatter > 3 * confusion_of(rng).scatter
    logits, _, _ = answered(rng, rng.random(2000) < 0.4)
    probabilities = 1 / (1 + np.exp(-logits))
    share = share_of(probabilities, confusion=found)
    alone = share_of(probabilities, confusion=replace(found, scatter=0.0))
    expected = np.hypot((alone.high - alone.low) / 3.92, found.scatter)
    assert (share.high - share.low) / 3.92 == pytest.approx(expected, rel=0.08)


def test_every_rock_twice_is_known_from_the_scatter() -> None:
    rng = np.random.default_rng(23)

    def repeated(times: int) -> Confusion:
        streams = []
        for share in np.linspace(0.1, 0.9, 50):
            gangue = rng.random(400) < share
            logits, second, rock = answered(rng, gangue, bounces=False)
            own = {"logits": np.repeat(logits, times), "second": np.repeat(second, times)}
            counts = int(np.sum(~gangue)), int(np.sum(gangue))
            streams.append(StreamAnswers(**own, time=np.repeat(rock, times) * 0.2, n_rocks=counts, share=share))
        found = Confusion.of_streams(streams)
        assert found is not None
        return found

    assert repeated(1).overdispersion == 1.0
    found = repeated(3)
    # Three times the variance of one answer a rock, without that of the rocks that came.
    shares = np.linspace(0.1, 0.9, 50)
    known = np.mean([found.information(share) * share * (1 - share) for share in shares])
    assert 0.1 < known < 0.9
    assert found.overdispersion == pytest.approx(3.0 * (1.0 - known), rel=0.15)


# -- a recording's shares ---------------------------------------------------------------------------------

MODEL: Any = SimpleNamespace(
    labels=("coal", "gangue"),
    training={},
    confusion=None,
    conformal=None,
    seams=None,
    kind="pulse",
    subject="impact",
    quantity="force",
    together=1,
    beam=None,
    unexplained=0.0,
    level_deviation=0.0,
    level_range={},
    explanations=None,
    changes=None,
)


def answer(time: float, channel: str = "1", gangue: float = 0.3, novelty: float = 0.5) -> Answer:
    probabilities = {"coal": 1 - gangue, "gangue": gangue}
    label = "unknown" if novelty > 1 else max(probabilities, key=lambda name: probabilities[name])
    return Answer(time=time, channel=channel, novelty=novelty, probabilities=probabilities, label=label)


def reported(
    answers: list[Answer], untils: list[float], *, model: Any = MODEL, **settings: float
) -> list[SupportReport]:
    watch = CavingWatch(model, ["1", "2"], PredictionSettings(**settings))
    told: list[SupportReport] = []
    for last, until in zip([-1.0, *untils], untils, strict=False):
        told += watch.feed([one for one in answers if last < one.time <= until], until)
    return told + watch.finish(untils[-1])


def watched(answers: list[Answer], untils: list[float], **settings: float) -> list[Share]:
    return [one.state.share for one in reported(answers, untils, **settings) if one.kind == "share"]


def test_a_pause_is_told_once_and_all_windows_of_impacts_are() -> None:
    rng = np.random.default_rng(8)
    times = np.sort(np.concatenate([rng.uniform(first, first + 5, 20) for first in (3.0, 40.0, 900.0)]))
    answers = [answer(time, str(rng.integers(1, 3))) for time in times]
    settings = {"share_time": 4.0, "share_step": 0.5}
    every = []
    for channel in ("1", "2"):
        window, was_told = ShareWindow(4.0, channel=channel), False
        own = [one for one in answers if one.channel == channel]
        for end in np.arange(1, 2001) * 0.5:
            while own and own[0].time <= end:
                window.add(own.pop(0).time, 0.3)
            share = window.at(end)
            if share.n_impacts or not was_told:
                every.append((end, channel, share.n_impacts))
            was_told = not share.n_impacts
    for untils in ([1000.0], [*np.sort(rng.uniform(0, 1000, 300)), 1000.0]):
        told = watched(answers, untils, **settings)
        assert [(one.time, one.channel, one.n_impacts) for one in told] == sorted(every)


# -- the record of a support --------------------------------------------------------------------------------


def flow(
    rng, first: float, last: float, gangue: float, channel: str = "1", novelty: float = 0.5, rate: float = 10.0
) -> list[Answer]:
    """Answers at so many a second that are sure, with this share of gangue."""
    times = np.arange(first, last, 1 / rate)
    return [answer(t, channel, 0.99 if rng.random() < gangue else 0.01, novelty) for t in times.tolist()]


def test_nothing_is_decided_before_the_evidence_and_no_decision_outlives_its_ground() -> None:
    rng = np.random.default_rng(4)
    answers = flow(rng, 0, 20, 0.05) + flow(rng, 20, 40, 0.95) + flow(rng, 40, 80, 0.95, novelty=2.0)
    reports = [one for one in reported(answers, [300.0], share_step=1.0) if one.state.share.channel == "1"]
    record = {one.state.time: one.state for one in reports}
    assert record[1.0].share.n_impacts >= MIN_IMPACTS
    assert [one.state.decision for one in reports if one.kind == "shut"] == [Decision.SHUT]
    assert {one.decision for time, one in record.items() if 5 < time < 20} == {Decision.DRAW}
    assert record[35.0].decision == Decision.SHUT
    # Sixty unknown ones are most of the latest at 45 s; the last minutes are forgotten after the pause.
    unknown = [one for one in record.values() if one.ground == Ground.MOSTLY_UNKNOWN]
    assert 44 <= unknown[0].time <= 47
    assert {one.decision for one in unknown} == {Decision.NONE}
    assert all(one.last_identified == pytest.approx(39.9) for one in unknown)


def test_what_came_before_a_machine_was_heard_is_no_evidence() -> None:
    rng, looking = np.random.default_rng(6), SimpleNamespace(**{**vars(MODEL), "beam": object()})
    tones = flow(rng, 0, HEARD_AFTER, 1.0, rate=100.0)
    answers = tones + flow(rng, HEARD_AFTER + 0.05, 30, 0.05) + flow(rng, 30, 32, 1.0) + flow(rng, 32.05, 60, 0.05)

    def said(model: Any, heard: dict[float, float], **fields: Any) -> dict[float, SupportReport]:
        watch, found = CavingWatch(model, ["1"], PredictionSettings(share_step=0.25, hold=20.0, **fields)), {}
        for last, until in pairwise([-1.0, *sorted({*heard, 60.0})]):
            due = {"1": heard[until]} if until in heard else None
            for one in watch.feed([one for one in answers if last < one.time <= until], until, due):
                found[one.state.time] = one
        return found

    # Nothing is decided before a machine could be heard, unless nobody listens.
    assert next(t for t, one in said(MODEL, {}).items() if one.kind == "shut") < HEARD_AFTER
    assert next(t for t, one in said(looking, {}, lines=False).items() if one.kind == "shut") < HEARD_AFTER
    for lines in (None, True):
        unheard = said(looking, {}, lines=lines)
        assert all(one.state.decision == Decision.NONE for t, one in unheard.items() if t < HEARD_AFTER)
        assert any(one.kind == "shut" for one in unheard.values())
    heard = said(looking, {HEARD_AFTER: HEARD_AFTER, 32.0: 32.0})
    assert not any(one.kind == "shut" for one in heard.values())
    first = heard[5.0].state.share
    assert first.n_impacts == sum(HEARD_AFTER < one.time <= 5 for one in answers)
    # Of the ten seconds before, half are kept.
    assert heard[32.25].state.share.n_impacts == sum(
        22.25 < one.time <= 27 or 32 < one.time <= 32.25 for one in answers
    )


def test_a_recording_read_at_once_is_told_as_a_stream_of_short_blocks() -> None:
    # A machine is heard at 12.2 s, in the block that ends then or in a later one.
    rng, settings = np.random.default_rng(8), PredictionSettings(share_step=0.5, hold=1.0, share_time=5.0)
    parts = ((0.03, 8, 0.05), (8.03, 12, 0.9), (12.03, 30, 0.05))
    answers = [one for part in parts for one in flow(rng, *part, rate=20.0)]
    told = {}
    for n_blocks in (1, 3, 60):
        watch, reports = CavingWatch(MODEL, ["1"], settings), []
        edges = np.linspace(0, 30, n_blocks + 1)
        for last, until in pairwise(edges.tolist()):
            due = {"1": 12.2} if last < 12.2 <= until else None
            reports += watch.feed([one for one in answers if last < one.time <= until], until, due)
        told[n_blocks] = [(one.kind, one.state.share, one.state.decision) for one in reports]
        (whole,) = watch.whole(answers, 30.0)
        assert whole.n_impacts == sum(not 7.2 < one.time <= 12.2 for one in answers)
        assert whole.share < 0.1
    assert "shut" in {kind for kind, *_ in told[60]}
    assert told[1] == told[3] == told[60]


@pytest.mark.parametrize("is_asked", [True, False])
def test_no_switch_rests_on_impacts_that_only_get_older(is_asked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rocks stop coming with a few of gangue: the window empties from its old end, and these are left."""
    if not is_asked:
        monkeypatch.setattr(ShareWindow, "_is_current", lambda *_: True)
    shut, shut_at = 0, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        # Of the last rocks alone, those that remain when the older ones have left the window, most are gangue.
        answers = flow(rng, 0, 15, 0.05) + flow(rng, 15, 31, 0.8)
        stopped = flow(rng, 0, 28, 0.05) + flow(rng, 28, 31, 0.95)
        settings = PredictionSettings(share_step=0.5, hold=2.0)
        reports = CavingWatch(MODEL, ["1"], settings).feed(answers, 31.0)
        shut_at.append(next((one.state.time for one in reports if one.kind == "shut"), 99.0))
        shut += any(one.kind == "shut" for one in CavingWatch(MODEL, ["1"], settings).feed(stopped, 60.0))
    assert (shut == 0) if is_asked else (shut > 6)
    assert np.median(shut_at) < 30  # steady rocks switch as before


def test_tones_that_are_heard_do_not_release_the_hold() -> None:
    rng = np.random.default_rng(7)
    answers = [one for part in ((0, 20, 0.05), (20, 31, 1.0), (31.03, 60, 0.05)) for one in flow(rng, *part, rate=20.0)]
    turns = {}
    for name, heard in (("held", None), ("heard", {"1": 31.0})):
        watch = CavingWatch(MODEL, ["1"], PredictionSettings(share_step=0.5, hold=25.0, share_time=5.0))
        reports = watch.feed([one for one in answers if one.time <= 31], 31.0)
        reports += watch.feed([one for one in answers if one.time > 31], 60.0, heard)
        turns[name] = {one.kind: one.state.time for one in reports if one.switch is not None}
    assert turns["held"]["shut"] == turns["heard"]["shut"] < 25
    assert turns["held"]["open"] >= turns["held"]["shut"] + 25
    assert turns["heard"]["open"] >= turns["heard"]["shut"] + 25


def of_a_test(confusion: list[list[int]], n_trials: float | None = None) -> dict[str, Any]:
    """The metrics of a test with this confusion, of so many independent trials, by default its impacts."""
    counts = np.array(confusion)
    share = float(np.trace(counts) / counts.sum())
    interval = list(wilson_interval(share, n_trials or float(counts.sum())))
    return {"accuracy": share, "accuracy_interval_95": interval, "confusion": confusion}


def with_record(**training: Any) -> Any:
    labels = ("coal", "gangue", "steel")[: len(training["metrics"].get("confusion", MODEL.labels))]
    return SimpleNamespace(**{**vars(MODEL), "labels": labels, "training": training})


def test_interval_of_a_difference_is_the_published_one() -> None:
    """Newcombe 1998, table II (a): 56 of 70 less 48 of 80, method 10."""
    found = HeldOut.of(of_a_test([[32, 48], [14, 56]]), np.array([False, True]))
    assert found is not None
    assert (found.gangue, found.others) == (0.8, 0.6)
    assert (found.low, found.high) == pytest.approx((0.0524, 0.3339), abs=5e-5)


@pytest.mark.parametrize("gangue", [0.5, 0.15])
def test_chance_is_no_proof_and_a_good_model_is_proven_by_few_impacts(gangue: float) -> None:
    rng, n_models, n = np.random.default_rng(57), 400, 60
    truth = (rng.random((n_models, n)) < gangue).astype(int)
    right = np.where(rng.random(truth.shape) < 0.85, truth, 1 - truth)
    chance = (rng.random(truth.shape) < rng.random((n_models, 1))).astype(int)

    def proven(called: NDArray[Any]) -> float:
        tables = np.zeros((n_models, 2, 2), int)
        np.add.at(tables, (np.arange(n_models)[:, None], truth, called), 1)
        records = (with_record(metrics=of_a_test(table.tolist())) for table in tables)
        return float(np.mean([not unproven(one, ("gangue",)) for one in records]))

    assert proven(chance) <= 0.025 + 3 * (0.025 / n_models) ** 0.5  # one end of an interval of 95 %
    assert proven(right) >= 0.9


@pytest.mark.parametrize(
    ("training", "is_proven", "by_chance"),
    [
        ({"metrics": of_a_test([[15, 15], [12, 18]])}, False, True),
        ({"metrics": of_a_test([[95, 0], [5, 0]])}, False, True),  # right in .95, and never says gangue
        ({"metrics": of_a_test([[90, 5], [2, 3]])}, True, False),
        ({"metrics": of_a_test([[40, 0], [1, 39]], n_trials=2)}, False, False),  # two recordings, however many impacts
        ({"metrics": of_a_test([[40, 0], [1, 39]], n_trials=5)}, True, False),
        # Coal for steel, never for gangue.
        ({"metrics": of_a_test([[30, 0, 30], [0, 60, 0], [30, 0, 30]])}, True, False),
        ({"metrics": {}}, True, False),  # of a file that states nothing
        ({"metrics": of_a_test([[40, 0], [1, 39]]), "one_recording": True}, False, False),
        # Of an older file.
        ({"metrics": of_a_test([[40, 0], [1, 39]]), "recorded": {}, "sources": ["a"]}, False, False),
        ({"metrics": of_a_test([[40, 0], [1, 39]]), "recorded": {}, "sources": ["a", "b"]}, True, False),
        (
            {"metrics": of_a_test([[900, 100], [150, 850]]), "correction": of_a_test([[20, 0], [1, 19]], n_trials=2)},
            True,
            False,
        ),
        ({"metrics": of_a_test([[900, 100], [150, 850]]), "correction": of_a_test([[8, 7], [7, 8]])}, False, True),
        ({"metrics": of_a_test([[55, 45], [45, 55]]), "correction": of_a_test([[28, 2], [3, 27]])}, True, False),
    ],
)
def test_model_that_is_not_better_than_chance_decides_nothing(
    training: dict[str, Any], is_proven: bool, by_chance: bool
) -> None:
    model = with_record(**training)
    assert (not unproven(model, ("gangue",))) is is_proven
    answers = flow(np.random.default_rng(3), 0, 30, 0.95)
    reports = [one for one in reported(answers, [30.0], model=model) if one.state.share.channel == "1"]
    last = reports[-1].state.share
    assert last.n_impacts > 90
    if by_chance:
        assert (last.is_known, last.low, last.high) == (False, 0.0, 1.0)
    else:
        assert last.share > 0.7
    if is_proven:
        assert "shut" in {one.kind for one in reports}
        return
    assert {one.state.ground for one in reports} == {Ground.UNPROVEN}
    assert {one.state.decision for one in reports} == {Decision.NONE}
    assert {one.kind for one in reports} == {"share", "state"}
    assert "better than chance" in reports[0].state.reason


def test_a_pause_withdraws_the_decision_after_a_stated_time() -> None:
    reports = reported(flow(np.random.default_rng(1), 0, 20, 0.95), [400.0], share_step=1.0)
    states = [one.state for one in reports if one.kind in ("state", "shut") and one.state.share.channel == "1"]
    assert [one.decision for one in states] == [Decision.SHUT, Decision.NONE]
    assert states[1].time == pytest.approx(20 + 10 + LAPSE, abs=2)
    assert states[1].ground == Ground.SEEN


@pytest.mark.parametrize("lost", ["missing", "second", "zeros", "stuck", "cable"])
@pytest.mark.parametrize("length", [100, 999, 60_000])
def test_a_dead_sensor_is_blind_after_five_seconds_until_its_samples_are_sound(lost: str, length: int) -> None:
    rate, rng = 1000.0, np.random.default_rng(7)
    samples = rng.normal(3, 1, (2, 60_000))
    gone = slice(20_000, 40_000)
    own = samples[0, gone]
    if lost == "second":
        own[::2] = np.nan
    else:
        own[:] = {"missing": np.nan, "zeros": 0.0, "stuck": 500.0, "cable": rng.normal(0, 0.01, own.size)}[lost]
    sensors = SensorWatch(2, rate)
    watch = CavingWatch(MODEL, ["1", "2"], PredictionSettings(share_step=0.5), sensors=sensors)
    waiting = sorted(
        flow(rng, 0, 20, 0.95) + flow(rng, 41, 60, 0.95) + flow(rng, 0, 60, 0.05, "2"), key=lambda one: one.time
    )
    reports: list[SupportReport] = []
    for first in range(0, 60_000, length):
        sensors.feed(samples[:, first : first + length])
        until = min(first + length, 60_000) / rate
        reports += watch.feed([one for one in waiting if one.time <= until], until)
        waiting = [one for one in waiting if one.time > until]
    changes = [one for one in reports if one.kind != "share" and one.state.share.channel == "1"]
    changes = [one for one in changes if one.state.decision != Decision.UNSURE]
    assert [(one.kind, one.state.ground, one.state.decision) for one in changes] == [
        ("shut", Ground.SEEN, Decision.SHUT),
        ("state", Ground.BLIND, Decision.NONE),
        ("state", Ground.SEEN, Decision.NONE),
        ("shut", Ground.SEEN, Decision.SHUT),
    ]
    blind, seen, again = (one.state for one in changes[1:])
    assert (blind.time, blind.since, blind.last_sound) == (25.0, 20.0, 20.0)
    assert seen.time == pytest.approx(45.0, abs=0.5)  # sound for as long as it was dead before it was blind
    assert again.time <= 52
    assert {one.state.decision for one in reports if one.state.share.channel == "2" and one.state.time > 8} == {
        Decision.DRAW
    }


def test_what_came_on_another_ground_is_no_evidence() -> None:
    """Sixty unknown impacts among gangue end with five that are coal: these alone count."""
    rng = np.random.default_rng(2)
    gangue = [
        answer(t, gangue=0.99, novelty=2.0 if k % 6 else 0.5) for k, t in enumerate(np.arange(0, 10, 0.1).tolist())
    ]
    coal = flow(rng, 10, 20, 0.0)
    reports = [one for one in reported(gangue + coal, [20.0], share_step=0.5) if one.state.share.channel == "1"]
    unknown = [one.state.time for one in reports if one.state.ground == Ground.MOSTLY_UNKNOWN]
    assert unknown
    after = [one for one in reports if one.state.time > max(unknown)]
    assert after[0].state.share.n_impacts == 0
    assert "shut" not in {one.kind for one in after}
    assert after[-1].state.decision == Decision.DRAW


@pytest.mark.parametrize(
    ("lost", "period", "is_blind"), [(1.5, 2.0, True), (3.0, 4.0, True), (1.0, 2.0, False), (0.5, 2.0, False)]
)
def test_a_sensor_that_is_dead_most_of_the_time_is_blind(lost: float, period: float, is_blind: bool) -> None:
    rng, times = np.random.default_rng(3), np.arange(60_000) / 1000
    sensors = SensorWatch(1, 1000.0)
    watch = CavingWatch(MODEL, ["1"], PredictionSettings(share_step=0.5), sensors=sensors)
    is_lost = (times >= 20) & (times % period < lost)
    sensors.feed(np.where(is_lost, 0.0, rng.normal(0, 1, times.size))[None])
    heard = [one for one in flow(rng, 0, 60, 0.95) if not is_lost[int(one.time * 1000)]]
    states = [one.state for one in watch.feed(heard, 60.0)]
    blind = [one.time for one in states if one.ground == Ground.BLIND]
    assert bool(blind) is is_blind
    if blind:
        assert blind[0] <= 20 + period * (1 + 5 / (2 * lost - period))
        assert {one.decision for one in states if one.time >= blind[0]} == {Decision.NONE}


@pytest.mark.parametrize(("noise", "rate", "is_blind"), [(100.0, 0.0, True), (100.0, 1.0, False), (10.0, 0.0, False)])
def test_noise_far_above_its_own_without_an_impact_is_blind(noise: float, rate: float, is_blind: bool) -> None:
    rng = np.random.default_rng(5)
    samples = rng.normal(0, 1, (1, 40_000))
    samples[0, 20_000:30_000] *= noise
    sensors = SensorWatch(1, 1000.0)
    watch = CavingWatch(MODEL, ["1"], PredictionSettings(share_step=0.5), sensors=sensors)
    sensors.feed(samples)
    during = flow(rng, 20, 30, 0.95, rate=rate) if rate else []
    reports = watch.feed(flow(rng, 0, 20, 0.95) + during + flow(rng, 30, 40, 0.95), 40.0)
    blind = [one.state.time for one in reports if one.state.ground == Ground.BLIND]
    assert (blind[0], blind[-1]) == (25.0, 29.5) if is_blind else not blind


def test_a_finding_that_moves_answers_takes_the_ground() -> None:
    rng = np.random.default_rng(1)
    watch = CavingWatch(MODEL, ["1"], PredictionSettings(share_step=0.5))
    standing: list[Finding] = []
    watch.diagnosis.standing = lambda channel: tuple(standing)  # type: ignore[method-assign]
    answers, seen = flow(rng, 0, 60, 0.95), []
    for begin, until, kinds in ((0, 20, ()), (20, 30, ("upside_down",)), (30, 60, ("tones",))):
        standing[:] = [one for one in (Finding(kind=kind, channels=("1",)) for kind in kinds) if one.moves]
        reports = watch.feed([one for one in answers if begin <= one.time < until], until)
        seen.append({(one.state.ground, one.state.decision) for one in reports if one.state.time > until - 2})
    assert seen == [{(Ground.SEEN, Decision.SHUT)}, {(Ground.FAULT, Decision.NONE)}, {(Ground.SEEN, Decision.SHUT)}]


def test_nothing_is_decided_anew_while_something_may_be_wrong() -> None:
    rng, doubts = np.random.default_rng(1), [True]
    watch = CavingWatch(MODEL, ["1"], PredictionSettings(share_step=0.5))
    watch.diagnosis.is_doubtful = lambda channel: doubts[-1]  # type: ignore[method-assign]
    seen = []
    for begin, until, gangue, doubt in ((0, 15, 0.95, True), (15, 20, 0.95, False), (20, 50, 0.0, True)):
        doubts.append(doubt)
        reports = watch.feed(flow(rng, begin, until, gangue), until)
        seen.append([one.state.decision for one in reports][-1])
    assert seen == [Decision.NONE, Decision.SHUT, Decision.SHUT]


def test_a_quiet_pause_is_not_blind_and_a_sensor_that_never_gave_a_sample_is() -> None:
    rng = np.random.default_rng(0)
    samples = np.stack([rng.normal(0, 1, 40_000), np.zeros(40_000), rng.normal(0, 1, 40_000)])
    # Flow is thirty times as loud as the pause after it; one of ten stretches is quiet.
    samples[0, :20_000] *= np.where(np.arange(20_000) % 1000 < 900, 30.0, 1.0)
    samples[2, 20_000:] *= 0.01
    samples[2, 20_000::1500] = 5.0  # quiet, but hit: it is alive
    for step in (0.5, 300.0):  # also where windows are long
        sensors = SensorWatch(3, 1000.0)
        watch = CavingWatch(MODEL, ["1", "2", "3"], PredictionSettings(share_step=step), sensors=sensors)
        sensors.feed(samples)
        told = [one.state for one in watch.feed([], 40.0) if one.kind == "state"]
        assert [(one.share.channel, one.time, one.since) for one in told] == [("2", 5.0, 0.0)]


def test_gangue_may_be_written_in_other_letters() -> None:
    model = SimpleNamespace(labels=("Coal", "Gangue"))
    assert as_in(model, ("gangue", " COAL", "shale")) == ("Gangue", "Coal", "shale")  # type: ignore[arg-type]
    assert separates(("gangue",), model) and not separates(("shale",), model)  # type: ignore[arg-type]


# -- by networks of seams ---------------------------------------------------------------------------------


def test_the_estimate_of_a_density_is_its_mean_and_shortest_interval() -> None:
    edges, rng = class_edges(), np.random.default_rng(3)
    angles = np.linspace(0, 1, 4001)
    for density in rng.dirichlet(np.full(N_CLASSES, 0.3), 20):
        found = estimate_of(density, 0.3)
        below = np.interp(angles, np.linspace(0, 1, N_CLASSES + 1), np.append(0, np.cumsum(density)))
        fractions = np.sin(angles * np.pi / 2) ** 2
        assert found["share"] == pytest.approx(np.diff(below) @ (fractions[1:] + fractions[:-1]) / 2, abs=1e-3)
        held = np.diff(np.interp([found["low"], found["high"]], fractions, below))
        assert held >= 0.95 - 1e-3
        naive = min(
            fractions[np.searchsorted(below, below[k] + 0.95 - 1e-9)] - fractions[k]
            for k in np.flatnonzero(below <= 0.05)
        )
        assert found["high"] - found["low"] == pytest.approx(naive, abs=0.015)
        assert found["above"] == pytest.approx(1 - np.interp(0.3, fractions, below), abs=3e-3)
        middle = (fractions[1:] + fractions[:-1]) / 2
        assert found["mean"] == pytest.approx(np.diff(below) @ middle, abs=2e-3)
        assert found["excess"] == pytest.approx(np.diff(below) @ np.maximum(middle - 0.3, 0), abs=2e-3)
    certain = estimate_of(np.eye(N_CLASSES)[5], 0.5)
    assert edges[5] <= certain["low"] < certain["share"] < certain["high"] <= edges[6] + 0.01


def networked(foreign: float, **settings: float) -> ShareWindow:
    """Return a window with networks of random numbers, of which the last one gives this score."""
    own = networks()
    last = {"weights_3": np.zeros((4, 1)), "biases_3": np.array([foreign])}
    test = Network({**own.foreign.arrays, **last}, own.foreign.n_features, 2)
    anchor = Anchor(**settings) if settings else None
    return ShareWindow(5.0, seams=replace(own, limit=0.0, foreign=test), anchor=anchor)


def test_a_fraction_says_what_it_rests_on() -> None:
    rng = np.random.default_rng(1)
    told: dict[str, list[Share]] = {}
    for name, window in {
        "none": networked(-1.0),
        "sound": networked(-1.0, coal_until=5.0),
        "foreign": networked(1.0, coal_until=5.0),
        "few": networked(-1.0, coal_until=0.4),
    }.items():
        for time in np.arange(0.05, 15.0, 0.1):
            window.add(time, rng.random(), (1e3 * rng.random(), 3e-4, 0.4))
        told[name] = [window.at(end) for end in (4.9, 10.0)]
    assert [[one.basis for one in own] for own in told.values()] == [
        [Basis.ANY_SEAM, Basis.ANY_SEAM],
        [Basis.PENDING, Basis.ANCHOR],
        [Basis.PENDING, Basis.FOREIGN],
        [Basis.TOO_FEW, Basis.TOO_FEW],
    ]


def test_a_foreign_anchor_is_not_used_and_stays_foreign_in_its_cycle() -> None:
    found = []
    for window in (networked(-1.0), networked(1.0, coal_until=5.0), networked(-1.0, coal_until=5.0)):
        for time in np.arange(0.05, 10.0, 0.1):
            window.add(time, (time * 0.7) % 1, (1e3 + time, 3e-4, 0.4))
        found.append(window.at(10.0))
    assert replace(found[1], basis=Basis.ANY_SEAM) == found[0]
    assert (found[2].low, found[2].high) != (found[0].low, found[0].high)
    window = networked(1.0, coal_until=5.0)
    for time in np.arange(0.05, 10.0, 0.1):
        window.add(time, 0.5, PULSE)
    window.at(10.0)
    assert window._seams is not None
    window._seams = replace(window._seams, limit=2.0)  # nothing is foreign any more
    assert window.at(10.0).basis == Basis.FOREIGN


def test_fewer_than_three_impacts_say_nothing_about_a_seam() -> None:
    window = networked(-1.0)
    window.add(1.0, 0.99, PULSE)
    window.add(1.1, 0.99, PULSE)
    share = window.at(2.0)
    assert share.share == pytest.approx(0.5, abs=0.01)
    assert share.high - share.low == pytest.approx(0.95, abs=0.01)


def test_an_anchor_takes_the_place_of_the_coal_of_a_confusion() -> None:
    rng = np.random.default_rng(4)
    rates = np.array([[0.8, 0.3, 0.1], [0.1, 0.3, 0.8]])
    confusion = Confusion(edges=np.array([-1.0, 1.0]), rates=rates)
    logits = rng.normal(0.0, 1.5, 4000)  # a coal that looks like gangue more often
    moved = confusion.anchored(logits)
    assert moved.rates[1].tolist() == rates[1].tolist()
    assert moved.rates[0].sum() == pytest.approx(1.2)
    assert moved.rates[0] / 1.2 == pytest.approx(np.histogram(logits, [-99, -1, 1, 99])[0] / 4000, abs=1e-3)
    assert confusion.anchored(np.zeros(0)).rates == pytest.approx(rates)
    # Of two bins the error of the rate of gangue among n impacts is that of the fraction, times the gain.
    pair = Confusion(edges=np.zeros(1), rates=np.array([[0.8, 0.2], [0.1, 0.9]]), scatter=0.04, overdispersion=1.5)
    few = pair.anchored(np.array([-1.0] * 9 + [1.0] * 3))
    coal = (3 + 2 * 0.2) / 14
    error = np.sqrt(1.5 * coal * (1 - coal) / 14 / 3) / (0.9 - coal)
    assert few.scatter == pytest.approx(np.hypot(0.04, error))
    assert pair.anchored(np.full(10**6, -1.0)).scatter == pytest.approx(0.04, abs=1e-4)
    assert replace(pair, rates=np.full((2, 2), 0.5)).anchored(np.array([-1.0, 1.0])).scatter == 0.5
    anchored = ShareWindow(1e3, answers=confusion, anchor=Anchor(100.0))
    plain = ShareWindow(1e3, answers=confusion)
    for time, one in enumerate(logits[:100]):
        anchored.add(float(time), 1 / (1 + np.exp(-one)), None)
    for time, one in enumerate(rng.choice(logits, 300)):
        for window in (anchored, plain):
            window.add(200.0 + time, 1 / (1 + np.exp(-one)), None)
    assert anchored.at(600.0).share < 0.2 < plain.at(600.0).share


@pytest.mark.parametrize(
    ("confusion", "n_coal", "widest"),
    [([[360, 40], [80, 320]], 60, 0.5), ([[23, 2], [5, 20]], 60, 0.7), ([[360, 40], [80, 320]], 12, 0.65)],
)
def test_a_tested_model_gives_the_share_beside_coal_that_it_often_takes_for_gangue(
    confusion: Any, n_coal: int, widest: float
) -> None:
    """A model of recordings calls .1 of its coal gangue, .3 of the coal of this seam, and .8 of the gangue of both."""
    model = with_record(metrics=of_a_test(confusion))
    rng, found = np.random.default_rng(5), []
    for share in np.repeat([0.1, 0.5, 0.9], 20).tolist():
        is_gangue = np.append(np.zeros(n_coal, bool), rng.random(60) < share)
        called = rng.random(is_gangue.size) < np.where(is_gangue, 0.8, 0.3)
        answers = [answer(time + 0.5, gangue=0.7 if one else 0.2) for time, one in enumerate(called.tolist())]
        settings = PredictionSettings(coal_until=n_coal, share_time=60.0, share_step=n_coal + 60.0)
        last = CavingWatch(model, ["1"], settings).feed(answers, n_coal + 60.0)[-1].state.share
        assert last.basis == Basis.ANCHOR
        found.append((last.share - share, last.low <= share <= last.high, last.high - last.low))
    error, holds, width = np.transpose(found)
    assert abs(error.mean()) < 0.06
    assert holds.mean() >= 0.9
    assert width.mean() < widest


def test_nothing_is_decided_where_coal_is_stated() -> None:
    confusion = Confusion(edges=np.array([0.0]), rates=np.array([[0.9, 0.1], [0.1, 0.9]]))
    model: Any = SimpleNamespace(**(vars(MODEL) | {"confusion": confusion}))
    answers = [answer(time, gangue=0.99) for time in np.arange(0.03, 60.0, 0.03)]
    for coal_until, expected in ((None, [2.5]), (30.0, [])):
        settings = PredictionSettings(share_time=5.0, coal_until=coal_until)
        told = CavingWatch(model, ["1"], settings).feed(answers, 29.0)
        assert [one.state.time for one in told if one.kind == "shut"] == expected


def test_a_model_without_rates_cannot_use_an_anchor() -> None:
    few = with_record(metrics=of_a_test([[90, 10], [5, 19]]))
    for model, got in ((MODEL, "got 2 labels"), (few, "25 tested .* 100 of coal and 24 of gangue")):
        with pytest.raises(InvalidValue, match=f"coal_until must be left out.*{got}"):
            CavingWatch(model, ["1"], PredictionSettings(coal_until=30.0))
    with pytest.raises(InvalidValue, match="cycle_pause must come with coal_until"):
        PredictionSettings(cycle_pause=30.0)


# -- levels beside the coal of a cycle --------------------------------------------------------------------


def levels_watched(coal: float, factor: float, gangue: float = 0.0, **settings: Any) -> list[Ground]:
    """Return the grounds of a stream whose coal has this level, before and after its scale changes by a factor at 60 s.

    The training has levels of mean 0 and deviation 1; gangue comes from 40 s on, with a level higher by `gangue`.
    """
    rng = np.random.default_rng(12)
    own = networks()
    sound = replace(own, limit=1e3)
    model: Any = SimpleNamespace(
        **(vars(MODEL) | {"level_deviation": 1.0, "seams": sound, "level_range": {}, "training": {"n_train": 10_000}})
    )
    answers = [
        replace(
            answer(time, gangue=0.9 if time > 40 else 0.1),
            level=coal + rng.normal(0, 0.8) + gangue * (time > 40) + np.log(factor) * (time > 60),
            pulse=PULSE,
        )
        for time in np.arange(0.1, 90.0, 0.1).tolist()
    ]
    watch = CavingWatch(model, ["1"], PredictionSettings(share_step=1.0, **settings))
    states = [one.state for one in watch.feed(answers, 89.0) if one.kind == "share"]
    return [one.ground for one in states]


def test_a_seam_harder_than_the_training_is_no_wrong_scale_beside_its_coal() -> None:
    hard = {"coal": 0.1, "factor": 1.0, "gangue": 0.8}
    assert Ground.WRONG_SCALE in levels_watched(**hard, trained_seam=True)
    for settings in ({}, {"coal_until": 30.0}):  # any seam, or this one
        assert set(levels_watched(**hard, **settings)) == {Ground.SEEN}
    soft = {"coal": -1.2, "factor": 1.0, "gangue": 0.2}
    assert set(levels_watched(**soft, trained_seam=True)[10:]) == {Ground.WRONG_SCALE}
    for settings in ({}, {"coal_until": 30.0}):
        assert set(levels_watched(**soft, **settings)) == {Ground.SEEN}
    # Six times is no seam.
    assert set(levels_watched(-1.0, 1 / 6)[75:]) == set(levels_watched(0.0, 10.0)[75:]) == {Ground.WRONG_SCALE}


@pytest.mark.parametrize(("coal", "factor"), [(0.0, 0.3), (-1.0, 0.4), (0.0, 9.81), (0.5, 6.0)])
def test_a_scale_that_changes_after_the_coal_is_told(coal: float, factor: float) -> None:
    found = levels_watched(coal, factor, coal_until=30.0)
    assert set(found[:60]) == {Ground.SEEN}
    assert set(found[70:]) == {Ground.WRONG_SCALE}


def test_coal_of_a_wrong_scale_or_too_little_of_it_is_judged_by_the_training() -> None:
    assert set(levels_watched(np.log(9.81), 1.0, coal_until=30.0)[10:]) == {Ground.WRONG_SCALE}
    assert set(levels_watched(-2.5, 1.0, coal_until=0.5)[10:]) == {Ground.WRONG_SCALE}


def test_another_cycle_has_levels_of_its_own() -> None:
    anchor = Anchor(10.0, cycle_pause=60.0)
    anchor.add(1.0, 0.1, PULSE)
    anchor.levels.append(0.5)
    anchor.add(100.0, 0.1, PULSE)
    assert anchor.levels == []

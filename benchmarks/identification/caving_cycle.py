"""What a rule for shutting the window brings: recovery, dilution and loss of simulated caving cycles.

    python benchmarks/identification/caving_cycle.py [MODEL] [--cycles 20] [--cache FOLDER] [--seams shipped wet ...]
    python benchmarks/identification/caving_cycle.py --settle     # the table by which the default costs were chosen
    python benchmarks/identification/caving_cycle.py --crossings  # seconds to SHUT where the fraction steps up

A cycle begins with 25 s of coal. Then the fraction of gangue rises from 0 to 1 in 30 to 90 s, in a course drawn at
random (a beta distribution's), at 8 rocks a second. The rocks and what the model says of them are those of
`benchmarks/beam/anchor.py`, which shares no code with `cgid`. A rule sees a window of 10 s each second and shuts once.
Recovery is coal drawn over coal there, dilution is gangue over all that was drawn, and the loss is coal left plus
gangue drawn over coal there. `--crossings`: after the coal the fraction is .1 for 30 s, then .9 or .7. `--settle` uses
other streams, other random seams and other courses than the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from benchmarks.beam.anchor import ARRIVALS, SEAMS, SEAMS_OF_TABLES, SEED, SPAN, WINDOW, Site, random_seam
from cgid import load_model
from cgid.identification.model.anchor import Anchor
from cgid.identification.model.model import Model
from cgid.identification.prediction.fraction import MIN_IMPACTS, Share, ShareWindow, ShutDecision, answers_of

Floats = NDArray[np.float64]
#: Seed of the streams by which the costs are chosen; range of the rise [s] and of both parameters of its course.
SETTLING, RISE, SHAPE = SEED - 1, (30.0, 90.0), (0.7, 3.0)
#: Ratios of the costs that are tried, and evidence of the rule that the costs replace.
RATIOS, EVIDENCE = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0), 0.95
STATED = ("25 s of coal", "nothing", "trained seam")
#: Fraction before a crossing and how long it lasts [s], those after it and how long.
LOW, BEFORE, HIGHS, AFTER = 0.1, 30.0, (0.9, 0.7), 40.0


@dataclass(frozen=True)
class Cycle:
    """The rocks of a cycle, and what was said each second."""

    time: Floats  # of each rock [s]
    is_gangue: NDArray[np.bool_]
    crossing: float  # time at which the fraction is one half [s]
    shares: dict[str, list[Share]]  # by what is stated

    def paid(self, shut: float) -> tuple[float, float, float]:
        """Return recovery, dilution and loss of a cycle that is shut at a time [s]."""
        own, coal = self.time <= shut, np.sum(~self.is_gangue)
        drawn, gangue = np.sum(own & ~self.is_gangue), np.sum(own & self.is_gangue)
        return float(drawn / coal), float(gangue / max(drawn + gangue, 1)), float((coal - drawn + gangue) / coal)


def cycle(model: Model, site: Site, rng: np.random.Generator) -> Cycle:
    """Draw a cycle of a site."""
    rise, shape = rng.uniform(*RISE), np.exp(rng.uniform(*np.log(SHAPE), 2))
    crossing = SPAN + rise * float(beta.ppf(0.5, *shape))
    return followed(model, site, SPAN + rise, lambda time: beta.cdf((time - SPAN) / rise, *shape), crossing, rng)


def step(model: Model, site: Site, high: float, rng: np.random.Generator) -> Cycle:
    """Draw a cycle of a site whose fraction steps up."""
    crossing = SPAN + BEFORE
    return followed(
        model,
        site,
        crossing + AFTER,
        lambda time: np.where(time <= SPAN, 0.0, np.where(time <= crossing, LOW, high)),
        crossing,
        rng,
        STATED[:1],
    )


def followed(
    model: Model,
    site: Site,
    duration: float,
    fraction: Callable[[Floats], Floats],
    crossing: float,
    rng: np.random.Generator,
    by: Sequence[str] = STATED,
) -> Cycle:
    """Draw the rocks of a cycle with a fraction by time, and follow them by what is stated."""
    time = np.sort(rng.uniform(0.0, duration, rng.poisson(ARRIVALS * duration)))
    is_gangue = rng.random(time.size) < fraction(time)
    rocks = np.empty(time.size, object)
    for some, own in (
        (time <= SPAN, site.anchor),
        ((time > SPAN) & ~is_gangue, site.coal),
        (is_gangue, site.gangue),
    ):
        rocks[some] = [own[k] for k in np.resize(rng.permutation(len(own)), np.sum(some))]
    watches = {
        stated: ShareWindow(
            WINDOW,
            answers=answers_of(model, ("gangue",)),
            seams=None if stated == "trained seam" else model.seams,
            anchor=Anchor(SPAN) if stated == "25 s of coal" else None,
        )
        for stated in by
    }
    shares: dict[str, list[Share]] = {stated: [] for stated in by}
    first = np.searchsorted(time, np.arange(duration + 1.0), side="right")
    for second, (begin, end) in enumerate(zip(np.append(0, first), first, strict=False)):
        for stated, watch in watches.items():
            for one in range(begin, end):
                for probability, *pulse in rocks[one].tolist():
                    watch.add(float(time[one]), probability, tuple(pulse) if np.isfinite(pulse).all() else None)
            if second > SPAN:  # nothing is decided before
                shares[stated].append(watch.at(float(second)))
    return Cycle(time, is_gangue, crossing, shares)


def by_cost(stated: str, ratio: float | None = None) -> Callable[[Cycle], float]:
    """Return the rule of the least expected loss, with the default costs or another early one."""

    def rule(one: Cycle) -> float:
        decision = ShutDecision() if ratio is None else ShutDecision(cost_early=ratio)
        turns = (decision.watch(share) for share in one.shares[stated])
        return next((turn.time for turn in turns if turn is not None and turn.shut), np.inf)

    return rule


def by_evidence(stated: str) -> Callable[[Cycle], float]:
    """Return the former rule: the fraction is above one half with a probability of .95."""

    def rule(one: Cycle) -> float:
        known = (share for share in one.shares[stated] if share.n_impacts >= max(MIN_IMPACTS, share.n_unknown))
        return next((share.time for share in known if share.above >= EVIDENCE), np.inf)

    return rule


def by_clock(cycles: list[Cycle]) -> Callable[[Cycle], float]:
    """Return the rule that shuts at the best fixed time for these cycles, known with hindsight."""
    times = np.arange(SPAN, SPAN + RISE[1])
    best = float(times[np.argmin([np.mean([one.paid(at)[2] for one in cycles]) for at in times])])
    return lambda one: best


def figures(cycles: list[Cycle], rule: Callable[[Cycle], float]) -> str:
    """Return the mean figures of a rule."""
    shut = np.array([min(rule(one), one.time[-1]) for one in cycles])
    recovery, dilution, loss = np.mean([one.paid(at) for one, at in zip(cycles, shut, strict=True)], axis=0)
    late = shut - [one.crossing for one in cycles]
    return (
        f"{recovery:.1%} | {dilution:.1%} | {loss:.1%} | {np.median(late):+.0f} "
        f"({np.quantile(late, 0.05):+.0f} to {np.quantile(late, 0.95):+.0f}) | {np.sum(late < -WINDOW)} of {len(late)}"
    )


TITLES = "recovery | dilution | loss | SHUT after the crossing, median (5 to 95 %) [s] | 10 s too early"


def settled(cycles: list[Cycle]) -> Iterator[str]:
    """Yield the table of the costs that were tried."""
    yield f"| stated | early over late | {TITLES} |\n|---|---|---|---|---|---|---|"
    for stated in STATED:
        for ratio in RATIOS:
            yield f"| {stated} | {ratio:g} | {figures(cycles, by_cost(stated, ratio))} |"
        yield f"| {stated} | evidence {EVIDENCE:g} | {figures(cycles, by_evidence(stated))} |"


def compared(cycles: dict[str, list[Cycle]]) -> Iterator[str]:
    """Yield the table of the rules, by seam."""
    every = [one for own in cycles.values() for one in own]
    drawn = [one for name, own in cycles.items() if name.startswith("random") for one in own]
    named = {name: own for name, own in cycles.items() if not name.startswith("random")}
    rules = {
        "knows the truth": lambda one: one.crossing,
        "by cost, 25 s of coal": by_cost("25 s of coal"),
        "by cost, nothing stated": by_cost("nothing"),
        "by cost, trained seam": by_cost("trained seam"),
        "evidence .95, 25 s of coal": by_evidence("25 s of coal"),
        "evidence .95, nothing stated": by_evidence("nothing"),
        "evidence .95, trained seam": by_evidence("trained seam"),
        "by the clock": by_clock(every),
    }
    yield f"| seam | rule | {TITLES} |\n|---|---|---|---|---|---|---|"
    for seam, own in (named | {"random seams": drawn, "all seams": every}).items():
        for name, rule in rules.items():
            if own:
                yield f"| {seam} | {name} | {figures(own, rule)} |"


def crossed(cycles: dict[str, dict[float, list[Cycle]]]) -> Iterator[str]:
    """Yield the table of crossings: seconds to SHUT, beside 25 s of coal."""
    titles = (f"to {high:g}: median (most) [s] | too early | none in {AFTER:g} s" for high in HIGHS)
    yield f"| seam | {' | '.join(titles)} |"
    yield "|---" * (1 + 3 * len(HIGHS)) + "|"
    rule = by_cost(STATED[0])
    for seam, own in cycles.items():
        cells = [seam]
        for some in own.values():
            late = np.array([rule(one) - one.crossing for one in some])
            right = late[np.isfinite(late) & (late >= 0)]
            told = f"{np.median(right):.0f} ({right.max():.0f})" if right.size else "-"
            cells += [told, f"{np.sum(late < 0)}", f"{np.sum(~np.isfinite(late))} of {late.size}"]
        yield f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("--cache", type=Path, help="folder that keeps the predictions for streams")
    parser.add_argument("--cycles", type=int, default=20, help="of each seam")
    parser.add_argument("--seams", nargs="+", choices=SEAMS, default=SEAMS_OF_TABLES, metavar="SEAM")
    parser.add_argument("--settle", action="store_true", help="try costs on other streams")
    parser.add_argument("--crossings", action="store_true", help="the fraction steps up")
    given = parser.parse_args()
    model, seed = load_model(given.model), SETTLING if given.settle else SEED
    cycles, steps = {}, {}
    for name in given.seams:
        number = list(SEAMS).index(name)
        one = random_seam(int(name.split()[-1]), seed) if name.startswith("random") else SEAMS[name]
        site = Site.of(one, 1000 * seed + 10 * number, model, given.cache)
        if given.crossings:
            rng = np.random.default_rng([seed, number, 3])
            steps[name] = {high: [step(model, site, high, rng) for _ in range(given.cycles)] for high in HIGHS}
            continue
        rng = np.random.default_rng([seed, number, 2])
        cycles[name] = [cycle(model, site, rng) for _ in range(given.cycles)]
    rows = settled([one for own in cycles.values() for one in own]) if given.settle else compared(cycles)
    rows = crossed(steps) if given.crossings else rows
    for row in rows:
        print(row, flush=True)


if __name__ == "__main__":
    main()

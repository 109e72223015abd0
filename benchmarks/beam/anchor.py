"""The fraction of gangue in seams that nobody described, with and without an anchor, judged without `cgid`.

    python benchmarks/beam/anchor.py [MODEL] [--windows 60] [--cycles 20] [--cache FOLDER] [--seams shipped wet ...]
    python benchmarks/beam/anchor.py --streams 100  # of ten minutes below the limit: false SHUT; then a crossing
    python benchmarks/beam/anchor.py --scales 100   # sound streams of that many random seams, and some at other scales

Rocks of each seam fall on the beam of finite elements of `independent_beam`, roll down it, bounce, overlap, and end on
a recorder with noise. `cgid` looks through the modes that it computes from the scene's dimensions. A seam is one stream
of coal and one of as much gangue; windows of 10 s with 8 rocks a second are drawn from their rocks, each with all its
predictions, and so are anchors, from other rocks of coal, and labelled lumps of gangue. A stream of ten minutes draws
its rocks in the same way, no rock twice before all have come; `CavingWatch`, which `monitor` uses, looks each second.
Nothing was settled with these seeds.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam.independent_beam import NOISE, RATE, Rocks, digitised, generate
from benchmarks.beam.independent_modes import Beam
from cgid import load_model
from cgid.identification.model.anchor import MIN_LUMPS, Anchor, Basis
from cgid.identification.model.model import Model
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.fraction import Share, ShareWindow, ShutDecision, answers_of
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch, Ground, SupportReport

Floats = NDArray[np.float64]
VARIANT = "0.001 mindlin"
#: That of the scene; `second_beam` has another one.
PLATE = Beam()
SEED = 591
#: Noise over that of `independent_beam`, rocks a second, and length of the streams of coal and of both [s].
QUIET, ARRIVALS, COAL, BOTH = 0.3, 8.0, 110.0, 90.0
SPAN = 25.0
#: Labelled lumps fall for so long after the coal [s].
LUMPS = 5.0
WINDOW, FRACTIONS = 10.0, (0.0, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
#: Long streams: fractions below the limit, how long they last [s], then the fraction above it and how long.
BELOW, LONG, ABOVE, AFTER, SOON = (0.1, 0.2, 0.35), 600.0, 0.9, 40.0, 10.0
#: How many streams are watched with findings, too.
OF_FINDINGS = 6
#: Scales: coal and mixture [s], its fraction, factors, and how many seams have each.
FIRST, REST, MIXED, FACTORS, OF_FACTOR = 20.0, 25.0, 0.4, (0.1, 0.2, 1 / 3, 0.5, 2.0, 3.0, 5.0, 10.0), 4
_STEEL = 210e9 / (1 - 0.3**2)
_SLOPE, _GRAVITY = np.radians(20.0), 9.80665


@dataclass(frozen=True)
class Kind:
    """Rocks of a label: median modulus [Pa] and its spread, restitution, radius [m], density."""

    modulus: float
    spread: float
    restitution: float
    deviation: float
    radius: tuple[float, float]
    density: float

    def draw(self, n: int, rng: np.random.Generator, fall: tuple[float, float]) -> dict[str, Floats]:
        """Return n rocks that fall from these heights [m], as `Rocks` needs them."""
        low, high = self.radius
        radius = low * (high / low) ** rng.random(n)
        poisson = rng.uniform(0.22, 0.33, n)
        young = self.modulus * np.exp(self.spread * rng.standard_normal(n))
        return {
            "mass": 4 / 3 * np.pi * radius**3 * self.density * (1 + 0.05 * rng.standard_normal(n)),
            "radius": radius,
            "stiffness": 4 / 3 * np.sqrt(radius) / ((1 - poisson**2) / young + 1 / _STEEL),
            "speed": np.sqrt(2 * _GRAVITY * rng.uniform(*fall, n)) * np.cos(_SLOPE),
            "restitution": np.clip(self.restitution + self.deviation * rng.standard_normal(n), 0.1, 0.85),
        }


@dataclass(frozen=True)
class Seam:
    """Rocks of both labels, and the range of their drop heights [m]."""

    coal: Kind
    gangue: Kind
    fall: tuple[float, float] = (0.5, 3.0)


def seam(coal: float = 3.1, gangue: float = 10.0, radius: tuple[float, float] = (0.01, 0.08), **more: Any) -> Seam:
    """Return a seam of moduli [GPa], like the shipped one in everything else."""
    own = {name: more.pop(name) for name in ("fall",) if name in more}
    larger = more.pop("gangue_radius", radius)
    return Seam(
        Kind(coal * 1e9, 0.35, 0.35, 0.08, radius, 1400.0),
        Kind(gangue * 1e9, 0.55, 0.50, 0.10, larger, 2450.0),
        **own,
    )


def random_seam(number: int, seed: int = SEED) -> Seam:
    """Return a seam drawn from published ranges."""
    rng = np.random.default_rng([seed, number, 77])
    coal = np.exp(rng.uniform(np.log(1.3), np.log(5.5)))
    gangue = np.exp(rng.uniform(np.log(max(4.0, 1.4 * coal)), np.log(32.0)))
    largest = np.exp(rng.uniform(np.log(0.04), np.log(0.15)))
    smallest = largest / rng.uniform(2.5, 8.0)
    factor = rng.uniform(0.7, 1.5) if rng.random() < 0.5 else 1.0
    restitution = rng.uniform(0.25, 0.43)
    low = rng.uniform(0.2, 1.0)
    return Seam(
        Kind(coal * 1e9, rng.uniform(0.25, 0.45), restitution, 0.08, (smallest, largest), rng.uniform(1300, 1480)),
        Kind(
            gangue * 1e9,
            rng.uniform(0.35, 0.65),
            restitution + rng.uniform(0.06, 0.25),
            0.10,
            (factor * smallest, factor * largest),
            rng.uniform(2250, 2700),
        ),
        (low, low + rng.uniform(0.7, 2.8)),
    )


SEAMS = {
    "shipped": seam(),
    "wet": seam(1.8, 5.5),
    "hard": seam(4.5, 22.0),
    "large": seam(radius=(0.05, 0.15)),
    "large, wet": seam(1.8, 5.5, (0.05, 0.15)),
    "large, hard": seam(4.5, 22.0, (0.05, 0.15)),
    "small, low falls": seam(radius=(0.008, 0.04), fall=(0.2, 1.2)),
    "gangue larger": seam(gangue_radius=(0.015, 0.12)),
} | {f"random {k}": random_seam(k) for k in range(10)}
#: Seams of the tables by default: without one beyond what fits into a recorder of 500 g.
SEAMS_OF_TABLES = list(SEAMS)
SEAMS["hard coal from 3 m"] = seam(4.5, 22.0, (0.035, 0.11), fall=(3.0, 3.5))


# -- streams ----------------------------------------------------------------------------------------------


def stream(
    one: Seam, duration: float, gangue: float, seed: int, law: str = "sphere", arrivals: float = ARRIVALS
) -> tuple[Floats, Floats, NDArray[Any], NDArray[Any]]:
    """Return samples, time [s] and rock of the impacts of a stream, and which rocks are gangue."""
    rng = np.random.default_rng([seed, 1])
    n = rng.poisson(arrivals * duration)
    is_gangue = rng.random(n) < gangue
    parts = one.coal.draw(n, rng, one.fall), one.gangue.draw(n, rng, one.fall)
    state = {name: np.where(is_gangue, parts[1][name], parts[0][name]) for name in parts[0]}
    state |= {"x": rng.uniform(0.2, 0.8, n), "y": rng.uniform(0.2, 1.2, n)}
    state |= {"time": np.sort(rng.uniform(0, duration, n)), "slip": np.tan(_SLOPE) * state["speed"]}
    rock = np.arange(n)
    samples = np.zeros(int((duration + 3.0) * RATE))
    times, rocks = [], []
    for _ in range(6):
        if not rock.size:
            break
        given = Rocks(np.where(is_gangue[rock], "gangue", "coal"), *(state[name] for name in Rocks._fields[1:]))
        made = generate(rock.size, seed, VARIANT, noise=0.0, given=given, law=law, beam=PLATE)
        frames = made["acceleration"].astype(float)
        fade = 512  # the lowest modes still ring at the end of a frame
        frames[:, -fade:] *= np.cos(np.linspace(0, np.pi / 2, fade)) ** 2
        first = np.round(state["time"] * RATE).astype(int)
        for at, frame in zip(first.tolist(), frames, strict=True):
            part = samples[at : at + frame.size]
            part += frame[: part.size]
        times.append(first / RATE + made["onset"])
        rocks.append(rock)
        up = made["restitution"] * state["speed"]
        flight = 2 * up / (_GRAVITY * np.cos(_SLOPE))
        pull = _GRAVITY * np.sin(_SLOPE)
        x = state["x"] + state["slip"] * flight + pull * flight**2 / 2
        after = state | {
            "speed": up, "x": x, "slip": state["slip"] + pull * flight, "time": state["time"] + flight,
        }  # fmt: skip
        again = (up > 0.1) & (x < 1.58) & (after["time"] < duration + 2.5)
        state = {name: column[again] for name, column in after.items()}
        rock = rock[again]
    noise = np.random.default_rng([seed, 2]).normal(0, QUIET * NOISE, samples.size)
    time, rock = np.concatenate(times), np.concatenate(rocks)
    order = np.argsort(time)
    return digitised(samples + noise), time[order], rock[order], is_gangue


@dataclass(frozen=True)
class Told:
    """The answers of a model for a stream, the rock of each, and first contact [s] and label of each rock."""

    answers: list[Answer]
    rock: NDArray[np.intp]
    begin: Floats
    is_gangue: NDArray[np.bool_]

    @classmethod
    def of(cls, one: Seam, duration: float, gangue: float, seed: int, model: Model, cache: Path | None) -> Told:
        """Make a stream and return the answers for it, or read them."""
        file = None if cache is None else cache / f"{seed}.pickle"
        if file is not None and file.exists():
            return cls(**pickle.loads(file.read_bytes()))
        samples, time, rock, is_gangue = stream(one, duration, gangue, seed)
        answers = answered(samples, model)
        at = np.array([answer.time for answer in answers])
        after = np.clip(np.searchsorted(time, at), 1, time.size - 1)
        nearest = np.where(at - time[after - 1] < time[after] - at, after - 1, after)
        begin = np.full(is_gangue.size, np.nan)
        begin[rock[::-1]] = time[::-1]
        told = cls(answers, rock[nearest], begin, is_gangue)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(pickle.dumps(vars(told)))
        return told

    def by_rock(self, *, gangue: bool) -> list[list[Answer]]:
        """Return the answers for each rock of a label, at times since its first contact."""
        found: list[list[Answer]] = [[] for _ in self.is_gangue]
        for answer, rock in zip(self.answers, self.rock.tolist(), strict=True):
            found[rock].append(replace(answer, time=answer.time - self.begin[rock]))
        return [own for own, is_gangue in zip(found, self.is_gangue, strict=True) if is_gangue == gangue]


def answered(samples: Floats, model: Model, **stated: Any) -> list[Answer]:
    """Return the answers for samples as `cgid predict` gives them."""
    steps = identify_blocks([samples[None]], RATE, model, ("1",), PredictionSettings(**stated))
    return [answer for step in steps for answer in step.answers]


def table_of(answers: Sequence[Answer]) -> Floats:
    """Return probability of gangue, nan if unknown, and pulse of answers, nan if not measured, (n, 4)."""
    rows = [(a.probabilities["gangue"] if a.novelty <= 1 else np.nan, *(a.pulse or (np.nan,) * 3)) for a in answers]
    return np.array(rows).reshape(-1, 4)


@dataclass(frozen=True)
class Site:
    """The answers for each rock of a seam, of coal for anchors, of coal and gangue for windows, and their numbers."""

    answers: tuple[list[list[Answer]], ...]
    anchor: list[Floats]
    coal: list[Floats]
    gangue: list[Floats]

    @classmethod
    def of(cls, one: Seam, seed: int, model: Model, cache: Path | None) -> Site:
        """Make the streams of a seam, and split the rocks of coal, so that no anchor has a rock of its windows."""
        coal, both = Told.of(one, COAL, 0.0, seed, model, cache), Told.of(one, BOTH, 0.5, seed + 1, model, cache)
        own = coal.by_rock(gangue=False)
        half = len(own) // 2
        parts = own[:half], own[half:] + both.by_rock(gangue=False), both.by_rock(gangue=True)
        return cls(parts, *([table_of(rock) for rock in part] for part in parts))

    def drawn(self, seconds: float, gangue: float, rng: np.random.Generator, *, anchor: bool = False) -> Floats:
        """Return the impacts of rocks that come in some seconds, no rock twice."""
        n = rng.poisson(ARRIVALS * seconds)
        n_gangue = rng.binomial(n, gangue)
        parts = (self.anchor if anchor else self.coal, n - n_gangue), (self.gangue, n_gangue)
        chosen = [some[k] for some, count in parts for k in rng.permutation(len(some))[:count]]
        rows = np.concatenate([np.empty((0, 4)), *chosen])
        return rows[rng.permutation(len(rows))]

    def lumps(self, window: Floats, rng: np.random.Generator, *, gangue: bool) -> Floats:
        """Return the impacts of ten lumps that are not in a window."""
        some = self.gangue if gangue else self.coal
        free = [one for one in some if len(one) and not np.isin(one[:, 1], window[:, 1]).any()]
        return np.concatenate([free[k] for k in rng.permutation(len(free))[:10]])


def shares_of(
    model: Model,
    anchor: Floats | None,
    windows: Sequence[Floats],
    *,
    lumps: Floats | None = None,
    networks: bool = True,
) -> list[Share]:
    """Return the share of each of some windows that follow a coal of `SPAN` s, and lumps."""
    begin = SPAN if lumps is None else SPAN + LUMPS
    watch = ShareWindow(
        WINDOW,
        answers=answers_of(model, ("gangue",)),
        seams=model.seams if networks else None,
        anchor=None if anchor is None else Anchor(SPAN),
        lumps=None if lumps is None else Anchor(0.0, spans=[(SPAN, begin)], least=MIN_LUMPS),
    )

    def add(rows: Floats, start: float, stop: float) -> None:
        times = start + (stop - start) * (np.arange(len(rows)) + 0.5) / max(len(rows), 1)
        for time, (probability, *pulse) in zip(times.tolist(), rows.tolist(), strict=True):
            watch.add(time, probability, tuple(pulse) if np.isfinite(pulse).all() else None)

    if anchor is not None:
        add(anchor, 0.0, SPAN)
    if lumps is not None:
        add(lumps, SPAN, begin)
    found = []
    for start, rows in zip(begin + WINDOW * np.arange(len(windows)), windows, strict=True):
        add(rows, start, start + WINDOW)
        found.append(watch.at(start + WINDOW))
    return found


TITLES = "RMS | bias | hold | width | false SHUT | SHUT above .6 | told foreign"


def figures(pairs: Sequence[tuple[Share, float]]) -> str:
    """Return the figures of shares beside the true fractions, with SHUT by the costs alone."""
    error = np.array([share.share - truth for share, truth in pairs])
    holds = np.mean([share.low <= truth <= share.high for share, truth in pairs])
    width = np.mean([share.high - share.low for share, _ in pairs])
    cost = ShutDecision().cost
    false = sum(cost(share) > 0 for share, truth in pairs if truth < 0.5)
    right = np.mean([cost(share) > 0 for share, truth in pairs if truth > 0.6])
    told = sum(share.basis in (Basis.FOREIGN, Basis.WRONG_LUMPS) for share, _ in pairs)
    return (
        f"{np.sqrt(np.mean(error**2)):.3f} | {error.mean():+.3f} | {holds:.2f} | {width:.2f} | "
        f"{false} of {sum(truth < 0.5 for _, truth in pairs)} | {right:.2f} | {told} of {len(pairs)}"
    )


def single_windows(model: Model, sites: dict[str, Site], n_windows: int) -> None:
    """Print the table of single windows, each with an anchor of its own."""
    rows: dict[tuple[str, str], list[tuple[Share, float]]] = {}
    names = list(sites)

    def keep(name: str, what: str, share: Share, truth: float) -> None:
        kind = "random seams" if name.startswith("random") else "named seams"
        for group in (name, kind, "all seams"):
            rows.setdefault((group, what), []).append((share, truth))

    for number, (name, site) in enumerate(sites.items()):
        rng, of_lumps = (np.random.default_rng([SEED, number, *more]) for more in ((), (2,)))
        for k in range(n_windows):
            truth = FRACTIONS[k % len(FRACTIONS)]
            window = site.drawn(WINDOW, truth, rng)
            anchors = {f"{seconds:g} s of coal": site.drawn(seconds, 0.0, rng, anchor=True) for seconds in (25, 10, 4)}
            anchors |= {f"25 s, {part:.0%} gangue": site.drawn(25, part, rng, anchor=True) for part in (0.1, 0.25)}
            if len(sites) > 1:
                other = sites[names[(number + 1 + k % (len(names) - 1)) % len(names)]]
                anchors |= {"25 s of another site": other.drawn(25, 0.0, rng, anchor=True)}
            for what, anchor in {"trained seam": None, "any seam": None, **anchors}.items():
                (share,) = shares_of(model, anchor, [window], networks=what != "trained seam")
                keep(name, what, share, truth)
            coal = anchors["25 s of coal"]
            for what, gangue in (("25 s of coal, ten lumps", True), ("25 s of coal, ten lumps of coal", False)):
                lumps = site.lumps(window, of_lumps, gangue=gangue)
                (share,) = shares_of(model, coal, [window], lumps=lumps)
                keep(name, what, share, truth)
    print(f"| seam | fraction by | {TITLES} |\n|---|---|---|---|---|---|---|---|---|")
    for (group, what), pairs in sorted(rows.items(), key=lambda row: row[0][0].endswith("seams")):
        if group.endswith("seams") or what in ("trained seam", "any seam", "25 s of coal", "25 s of coal, ten lumps"):
            print(f"| {group} | {what} | {figures(pairs)} |", flush=True)


def cycles(model: Model, sites: dict[str, Site], n_cycles: int) -> None:
    """Print how many anchors are told as foreign within a minute, while the fraction rises from 0 to .5."""
    told: dict[str, list[bool]] = {}
    names = list(sites)
    for number, site in enumerate(sites.values()):
        rng = np.random.default_rng([SEED, number, 1])
        for k in range(n_cycles):
            windows = [site.drawn(WINDOW, truth, rng) for truth in np.linspace(0.0, 0.5, 6)]
            anchors = {
                "sound": site.drawn(25, 0.0, rng, anchor=True),
                "a tenth gangue": site.drawn(25, 0.1, rng, anchor=True),
                "a quarter gangue": site.drawn(25, 0.25, rng, anchor=True),
            }
            if len(sites) > 1:
                other = sites[names[(number + 1 + k % (len(names) - 1)) % len(names)]]
                anchors["another site's"] = other.drawn(25, 0.0, rng, anchor=True)
            for what, anchor in anchors.items():
                found = shares_of(model, anchor, windows)
                told.setdefault(what, []).append(any(share.basis == Basis.FOREIGN for share in found))
    print("\n| anchor of 25 s | told foreign within a minute |\n|---|---|")
    for what, found in told.items():
        print(f"| {what} | {sum(found)} of {len(found)} |")


# -- whole streams ----------------------------------------------------------------------------------------


def long_stream(site: Site, fraction: Callable[[Floats], Floats], duration: float, seed: Sequence[int]) -> list[Answer]:
    """Return the answers of a stream that begins with `SPAN` of coal and has a fraction by time."""
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, duration, rng.poisson(ARRIVALS * duration)))
    is_gangue = (rng.random(time.size) < fraction(time)) & (time > SPAN)
    answers = []
    for own, some in zip(site.answers, (time <= SPAN, (time > SPAN) & ~is_gangue, is_gangue), strict=True):
        turns = [rng.permutation(len(own)) for _ in range(np.sum(some) // len(own) + 1)]
        for at, rock in zip(time[some].tolist(), np.concatenate(turns).tolist(), strict=False):
            answers += [replace(answer, time=at + answer.time, end=np.nan) for answer in own[rock]]
    return sorted(answers, key=lambda answer: answer.time)


class _NoFindings(Diagnosis):
    """Finds nothing, so nothing is withdrawn; most of the time of a watch is that of findings."""

    def add(self, answers: Iterable[Answer]) -> None:
        """Count nothing."""


def watched(
    model: Model, answers: Iterable[Answer], duration: float, *, findings: bool = True, **stated: Any
) -> tuple[list[SupportReport], list[Finding]]:
    """Return the reports and findings of a watch that looks each second."""
    settings = PredictionSettings(share_time=WINDOW, share_step=1.0, **stated)
    watch = CavingWatch(model, ("1",), settings, diagnosis=Diagnosis(model) if findings else _NoFindings(model))
    return watch.feed(answers, duration), watch.take_changes()


STATED: dict[str, dict[str, Any]] = {
    "25 s of coal": {"coal_until": SPAN, "findings": False},
    "nothing": {"findings": False},
    "25 s of coal, with findings": {"coal_until": SPAN},
    "nothing, with findings": {},
}


def long_streams(model: Model, sites: dict[str, Site], n_streams: int) -> None:
    """Print how many streams below the limit are shut, and how soon a crossing is told.

    Findings can only withdraw decisions, so they are made for the first streams alone: most of the time is theirs.
    """
    names, crossing = list(sites), SPAN + LONG
    found: dict[tuple[str, str], list[tuple[str, list[float], float, bool]]] = {}
    for k in range(n_streams):
        name, low = names[k % len(names)], BELOW[(k // len(names)) % len(BELOW)]
        answers = long_stream(
            sites[name], lambda time, low=low: np.where(time < crossing, low, ABOVE), crossing + AFTER, [SEED, k, 4]
        )
        for stated, given in STATED.items():
            if k >= OF_FINDINGS and given.get("findings", True):
                continue
            reports, _ = watched(model, answers, crossing + AFTER, **given)
            turns = [(one.kind, one.state.time) for one in reports if one.kind in ("shut", "open")]
            early = [time for kind, time in turns if kind == "shut" and time < crossing]
            is_shut = next((kind == "shut" for kind, time in reversed(turns) if time < crossing), False)
            late = next((time - crossing for kind, time in turns if kind == "shut" and time >= crossing), np.inf)
            withdrawn = any(one.state.ground != Ground.SEEN for one in reports)
            found.setdefault((stated, f"{low:g}"), []).append((name, early, np.nan if is_shut else late, withdrawn))
            for group in ("all", name):
                found.setdefault((stated, group), []).append(found[stated, f"{low:g}"][-1])
    titles = "shut below the limit | of these at [s] | crossings told in 10 s | in 40 s | withdrawn"
    print(f"| stated | streams | {titles} |\n|---|---|---|---|---|---|---|")
    for (stated, group), rows in found.items():
        shut, late = [early[0] for _, early, _, _ in rows if early], np.array([one[2] for one in rows])
        late = late[~np.isnan(late)]
        cells = (
            f"{len(shut)} of {len(rows)}", " ".join(f"{one:.0f}" for one in sorted(shut)),
            f"{np.sum(late <= SOON)} of {late.size}", f"{np.sum(late <= AFTER)} of {late.size}",
            f"{sum(one[3] for one in rows)} of {len(rows)}",
        )  # fmt: skip
        print(f"| {stated} | {group} | {' | '.join(cells)} |", flush=True)


def scales(model: Model, n_seams: int) -> None:
    """Print what sound streams of random seams are told, and streams whose scale is wrong by a factor, or their coal's.

    A stream is `FIRST` of coal and then a mixture.
    """
    rows: dict[tuple[str, str], list[tuple[float, set[str], set[Ground]]]] = {}
    for number in range(n_seams):
        one, seed = random_seam(100 + number), 1000 * SEED + 20_000 + 10 * number
        coal, mixed = stream(one, FIRST, 0.0, seed)[0], stream(one, REST, MIXED, seed + 1)[0]
        samples = np.concatenate([coal[: round(FIRST * RATE)], mixed[: round(REST * RATE)]])
        factors = {"1": 1.0}
        if number < OF_FACTOR:
            factors |= {f"{factor:.2g}": factor for factor in FACTORS}
            factors |= {"3 in the coal": np.where(np.arange(samples.size) < FIRST * RATE, 3.0, 1.0)}
        for name, factor in factors.items():
            answers = answered(digitised(factor * samples), model)
            for stated, given in {"20 s of coal": {"coal_until": FIRST}, "nothing": {}}.items():
                reports, changes = watched(model, answers, FIRST + REST, **given)
                grounds = {one.state.ground for one in reports} - {Ground.SEEN}
                times = [change.begin for change in changes if np.isfinite(change.begin)]
                times += [one.state.time for one in reports if one.state.ground != Ground.SEEN]
                first = min(times, default=np.inf)
                heard = np.searchsorted([answer.time for answer in answers], first) if np.isfinite(first) else np.inf
                kinds = {change.kind for change in changes}
                kinds |= {"foreign coal" for one in reports if one.state.share.basis == Basis.FOREIGN}
                if Ground.WRONG_SCALE in grounds and "scale" not in kinds:
                    kinds.add("levels beside the coal")
                rows.setdefault((name, stated), []).append((float(heard), kinds, grounds))
    print("| factor | stated | told | as the scale | of these, impacts, median (most) | withdrawn | told as |")
    print("|---|---|---|---|---|---|---|")
    for (name, stated), own in rows.items():
        n = len(own)
        told = [one[0] for one in own if np.isfinite(one[0])]
        scale = sum("scale" in kinds or Ground.WRONG_SCALE in grounds for _, kinds, grounds in own)
        names = sorted({kind for _, kinds, _ in own for kind in kinds} | {str(g) for *_, gs in own for g in gs})
        counted = ", ".join(f"{one} {sum(one in k or one in map(str, g) for _, k, g in own)}" for one in names)
        after = f"{np.median(told):.0f} ({max(told):.0f})" if told else "-"
        withdrawn = sum(bool(grounds) for *_, grounds in own)
        cells = f"{len(told)} of {n} | {scale} | {after} | {withdrawn} of {n} | {counted}"
        print(f"| {name} | {stated} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("--cache", type=Path, help="folder that keeps the predictions for streams")
    parser.add_argument("--windows", type=int, default=60, help="of each seam")
    parser.add_argument("--cycles", type=int, default=20, help="of each seam")
    parser.add_argument("--seams", nargs="+", choices=SEAMS, default=SEAMS_OF_TABLES, metavar="SEAM")
    parser.add_argument("--streams", type=int, default=0, metavar="N", help="N streams of ten minutes instead")
    parser.add_argument("--scales", type=int, default=0, metavar="N", help="streams of N random seams instead")
    given = parser.parse_args()
    model, sites = load_model(given.model), {}
    if given.scales:
        scales(model, given.scales)
        return
    for name in given.seams:
        seed = 1000 * SEED + 10 * list(SEAMS).index(name)
        sites[name] = Site.of(SEAMS[name], seed, model, given.cache)
    if given.streams:
        long_streams(model, sites, given.streams)
        return
    single_windows(model, sites, given.windows)
    cycles(model, sites, given.cycles)


if __name__ == "__main__":
    main()

"""The fraction of gangue in seams that nobody described, with and without an anchor, judged without `cgid`.

    python benchmarks/beam/anchor.py [MODEL] [--windows 60] [--cycles 20] [--cache FOLDER] [--seams shipped wet ...]

Rocks of each seam fall on the beam of finite elements of `independent_beam`, roll down it, bounce, overlap, and end on
a recorder with noise. `cgid` looks through the modes that it computes from the scene's dimensions. A seam is one stream
of coal and one of as much gangue; windows of 10 s with 8 rocks a second are drawn from their rocks, each with all its
predictions, and so are anchors, from other rocks of coal, and labelled lumps of gangue. Nothing was settled with these
seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam.independent_beam import NOISE, RATE, Rocks, digitised, generate
from cgid import load_model
from cgid.identification.model.anchor import MIN_LUMPS, Anchor, Basis
from cgid.identification.model.model import Model
from cgid.identification.prediction.fraction import Share, ShareWindow, ShutDecision, answers_of
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks

Floats = NDArray[np.float64]
VARIANT = "0.001 mindlin"
SEED = 591
#: Noise over that of `independent_beam`, rocks a second, and length of the streams of coal and of both [s].
QUIET, ARRIVALS, COAL, BOTH = 0.3, 8.0, 110.0, 90.0
SPAN = 25.0
#: Labelled lumps fall for so long after the coal [s].
LUMPS = 5.0
WINDOW, FRACTIONS = 10.0, (0.0, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
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


# -- streams ----------------------------------------------------------------------------------------------


def stream(
    one: Seam, duration: float, gangue: float, seed: int, law: str = "sphere"
) -> tuple[Floats, Floats, NDArray[Any], NDArray[Any]]:
    """Return samples, time [s] and rock of the impacts of a stream, and which rocks are gangue."""
    rng = np.random.default_rng([seed, 1])
    n = rng.poisson(ARRIVALS * duration)
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
        made = generate(rock.size, seed, VARIANT, noise=0.0, given=given, law=law)
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
    """The predictions of a model for a stream, and the rock of each."""

    probability: Floats  # nan if unknown
    pulse: Floats  # (n, 3), nan if not measured
    rock: NDArray[np.intp]
    is_gangue: NDArray[np.bool_]  # of each rock

    @classmethod
    def of(cls, one: Seam, duration: float, gangue: float, seed: int, model: Model, cache: Path | None) -> Told:
        """Make a stream and return the predictions for it, or read them."""
        file = None if cache is None else cache / f"{seed}.npz"
        if file is not None and file.exists():
            return cls(**np.load(file))
        samples, time, rock, is_gangue = stream(one, duration, gangue, seed)
        steps = identify_blocks([samples[None]], RATE, model, ("1",), PredictionSettings())
        answers = [answer for step in steps for answer in step.answers]
        at = np.array([answer.time for answer in answers])
        after = np.clip(np.searchsorted(time, at), 1, time.size - 1)
        nearest = np.where(at - time[after - 1] < time[after] - at, after - 1, after)
        told = cls(
            np.array([a.probabilities["gangue"] if a.novelty <= 1 else np.nan for a in answers]),
            np.array([a.pulse or (np.nan,) * 3 for a in answers]),
            rock[nearest],
            is_gangue,
        )
        if file is not None:
            np.savez(file, **vars(told))
        return told


def by_rock(told: Told, *, gangue: bool) -> list[Floats]:
    """Return probability and pulse of the impacts of each rock of a label, (n, 4)."""
    rows = np.column_stack([told.probability, told.pulse])
    return [rows[told.rock == rock] for rock in np.flatnonzero(told.is_gangue == gangue)]


@dataclass(frozen=True)
class Site:
    """The impacts of each rock of a seam: of coal for anchors, of coal and gangue for windows."""

    anchor: list[Floats]
    coal: list[Floats]
    gangue: list[Floats]

    @classmethod
    def of(cls, one: Seam, seed: int, model: Model, cache: Path | None) -> Site:
        """Make the streams of a seam, and split the rocks of coal, so that no anchor has a rock of its windows."""
        coal, both = Told.of(one, COAL, 0.0, seed, model, cache), Told.of(one, BOTH, 0.5, seed + 1, model, cache)
        own = by_rock(coal, gangue=False)
        half = len(own) // 2
        return cls(own[:half], own[half:] + by_rock(both, gangue=False), by_rock(both, gangue=True))

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
    """Return the figures of shares beside the true fractions, with SHUT at the default costs."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("--cache", type=Path, help="folder that keeps the predictions for streams")
    parser.add_argument("--windows", type=int, default=60, help="of each seam")
    parser.add_argument("--cycles", type=int, default=20, help="of each seam")
    parser.add_argument("--seams", nargs="+", choices=SEAMS, default=list(SEAMS), metavar="SEAM")
    given = parser.parse_args()
    model, sites = load_model(given.model), {}
    for name in given.seams:
        seed = 1000 * SEED + 10 * list(SEAMS).index(name)
        sites[name] = Site.of(SEAMS[name], seed, model, given.cache)
    single_windows(model, sites, given.windows)
    cycles(model, sites, given.cycles)


if __name__ == "__main__":
    main()

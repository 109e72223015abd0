"""The gangue share of streams and the decision to shut, against the truth.

    python benchmarks/identification/streams.py [MODEL] [-n 10] [--rising 6] [--first 0] [--picture FILE]

Minutes of `caving` with constant shares from 0 to .5, the same of a changed scene (blows elsewhere on the beam, 10
rocks a second, another seam), and `caving` itself, whose share rises. No training uses their seeds. The watch is that
of `cgid monitor`: windows of 10 s, each second, and a drawn gangue costs as much as a lost coal. The picture is the
operators' curve of the first stream whose share rises, by its answers as in `cgid predict --report`, and in truth.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer, PredictionSettings
from cgid.identification.prediction.fraction import Share, Switch
from cgid.identification.prediction.settings import COST_EARLY
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch, SupportReport
from cgid.plots.answers import draw_drawn, finish_drawn, gangue_at
from cgid.plots.figure import COLOURS, png, require_matplotlib
from cgid.scene import Scene, load_scene, parse_scene, record

#: First seeds of constant shares, and of those of another seam; the seed of the rising share.
SEEDS = 900, 950, 910_000
#: Highest of the constant shares; up to this one SHUT is false, as the limit is .5.
HIGHEST, FALSE_UP_TO = 0.5, 0.3
DURATION = 60.0
#: Costs of drawn gangue for the operators' curve, in lost coal, and of a second too early over one too late.
COSTS, EARLY = (0.5, 1.0, 2.0, 4.0), (1.0, 3.0, 6.0, 12.0, 24.0)


@dataclass(frozen=True)
class Stream:
    """Answers for a stream, the truth of its rocks, and the processor time an impact [s]."""

    answers: list[Answer]
    time: np.ndarray
    gangue: np.ndarray
    cost: float

    @classmethod
    def of(cls, scene: Scene, seed: int, number: int, model: StoredModel) -> Stream:
        """Make a stream and answer for it."""
        signal, truth = record(scene, seed, number)
        first = truth["bounce"] == 0
        begun = time.process_time()
        steps = identify_blocks([signal.samples[None]], signal.sampling_rate, model, ("1",), PredictionSettings())
        answers = [answer for step in steps for answer in step.answers]
        cost = (time.process_time() - begun) / len(answers)
        return cls(answers, truth["time"][first], truth["label"][first] == "gangue", cost)

    def watched(self, model: StoredModel, **settings: Any) -> list[SupportReport]:
        """Return the reports of the support, as `cgid monitor` makes them."""
        watch = CavingWatch(model, ("1",), PredictionSettings(trained_seam=True, **settings))
        return watch.feed(self.answers, DURATION) + watch.finish(DURATION)

    def shares(self, model: StoredModel, length: float) -> Iterator[tuple[Share, float]]:
        """Yield the shares of windows end to end, and the true shares of the rocks that came in them."""
        for report in self.watched(model, share_time=length, share_step=length):
            share = report.state.share
            if report.kind == "share" and share.n_impacts:
                own = self.gangue[(self.time > share.start) & (self.time <= share.time)]
                yield share, float(own.mean())

    def turns(self, model: StoredModel, **settings: Any) -> list[Switch]:
        """Return the turns with windows of 10 s, each second."""
        return [one.switch for one in self.watched(model, share_step=1.0, **settings) if one.switch is not None]

    def drawn(self, until: float) -> tuple[float, float]:
        """Return the recovery of coal and the share of gangue among all rocks drawn until a time [s]."""
        own = self.time <= until
        return float(np.sum(own & ~self.gangue) / np.sum(~self.gangue)), float(self.gangue[own].mean())


def constant(share: float) -> Scene:
    content = json.loads(load_scene(shipped.scene_path("caving")).text)
    content["stream"]["mixture"] = {"times": [0.0], "gangue": [share]}
    return parse_scene(content | {"name": f"caving, {share:.0%} gangue"})


def changed(share: float) -> Scene:
    """Return the same of other places, more rocks of other sizes, and a softer coal with a harder gangue."""
    content = json.loads(constant(share).text)
    content["tail_beam"]["impact_point"] = {
        "x": {"distribution": "uniform", "lowest": "0.8 m", "highest": "1.5 m"},
        "y": {"distribution": "uniform", "lowest": "0.2 m", "highest": "1.2 m"},
    }
    content["stream"]["arrivals"] = {"rate": "10 Hz"}
    for population in content["populations"]:
        gangue = population["label"] == "gangue"
        population["youngs_modulus"]["median"] = "14 GPa" if gangue else "2.5 GPa"
        population["radius"] |= {"lowest": "15 mm", "highest": "60 mm"}
        if not gangue:
            population["restitution"]["mean"] = 0.30
    return parse_scene(content | {"name": f"another seam, {share:.0%} gangue"})


def row(name: str, streams: list[Stream], shares: np.ndarray, model: StoredModel) -> str:
    errors = [share.share - truth for stream in streams for share, truth in stream.shares(model, DURATION)]
    windows = [pair for stream in streams for pair in stream.shares(model, 10.0)]
    held = np.mean([share.low <= truth <= share.high for share, truth in windows])
    steady = np.mean(
        [
            found.low <= share <= found.high
            for stream, share in zip(streams, shares.tolist(), strict=True)
            for found, _ in stream.shares(model, 10.0)
        ]
    )
    width = np.mean([share.high - share.low for share, _ in windows])
    unknown = np.mean([answer.label == "unknown" for stream in streams for answer in stream.answers])
    false = sum(
        any(turn.shut for turn in stream.turns(model))
        for stream, share in zip(streams, shares, strict=True)
        if share <= FALSE_UP_TO + 1e-9
    )
    quiet = int(np.sum(shares <= FALSE_UP_TO + 1e-9))
    alarms = f"{false} of {quiet} ({3600 * false / quiet / DURATION:.0f} an hour)"
    return (
        f"| {name} | {len(streams)} | {np.sqrt(np.mean(np.square(errors))):.3f} | {np.mean(errors):+.3f} | "
        f"{steady:.1%} / {held:.1%} of {len(windows)} | {width:.2f} | {unknown:.1%} | {alarms} | "
        f"{1e3 * np.mean([stream.cost for stream in streams]):.1f} |"
    )


def alarms(streams: list[Stream], shares: np.ndarray, model: StoredModel) -> Iterator[str]:
    low, near = shares <= FALSE_UP_TO + 1e-9, (shares > FALSE_UP_TO + 1e-9) & (shares < 0.49)
    yield f"| early over late | SHUT an hour, shares up to {FALSE_UP_TO:g} | shares of .33 to .44 |"
    yield "|---|---|---|"
    for early in EARLY:
        count = np.array([sum(turn.shut for turn in one.turns(model, cost_early=early)) for one in streams])
        rates = [f"{3600 / DURATION * count[some].mean():.0f}" if some.any() else "-" for some in (low, near)]
        yield f"| {early:g} | {' | '.join(rates)} |"


def rising(model: StoredModel, n: int, seed: int, picture: Path | None) -> Iterator[str]:
    """Yield the table of the decision on `caving`."""
    scene = load_scene(shipped.scene_path("caving"))
    streams = [Stream.of(scene, seed, number, model) for number in range(n)]
    if picture is not None:
        picture.write_bytes(picture_of(streams[0], model))
    assert scene.stream is not None and scene.stream.mixture is not None
    times, rises = scene.stream.mixture.times, scene.stream.mixture.shares["gangue"]
    yield (
        "| a drawn gangue costs | limit | early over late | true crossing [s] | SHUT, median [s] "
        "| delay, median (range) [s] | SHUT too early | turns, mean |\n|---|---|---|---|---|---|---|---|"
    )
    shut: dict[float, np.ndarray] = {}
    crossings = {}
    for cost, early in [(1.0, early) for early in EARLY] + [(cost, COST_EARLY) for cost in COSTS]:
        limit = 1 / (1 + cost)
        crossing = crossings[cost] = float(np.interp(limit, rises, times))
        turns = [stream.turns(model, dilution_cost=cost, cost_early=early) for stream in streams]
        first = shut[cost] = np.array([min([t.time for t in own if t.shut], default=DURATION) for own in turns])
        late = first - crossing
        yield (
            f"| {cost:g} | {limit:.2f} | {early:g} | {crossing:.1f} | {np.median(first):.1f} | "
            f"{np.median(late):+.1f} ({late.min():+.1f} to {late.max():+.1f}) | {int(np.sum(late < 0))} of {n} | "
            f"{np.mean([len(own) for own in turns]):.1f} |"
        )
    yield ""
    yield "| shut | recovery of coal | cumulative share of gangue |"
    yield "|---|---|---|"
    for at in range(10, 61, 10):
        yield drawn_row(f"after {at} s", streams, np.full(n, float(at)))
    for cost in COSTS:
        yield drawn_row(f"at SHUT, a gangue costs {cost:g}", streams, shut[cost])
        yield drawn_row(f"at the true crossing of {1 / (1 + cost):.2f}", streams, np.full(n, crossings[cost]))


def picture_of(stream: Stream, model: StoredModel) -> bytes:
    figure = require_matplotlib()(figsize=(9, 4.2), layout="constrained")
    axes, times = figure.subplots(), np.array([answer.time for answer in stream.answers])
    blue, red, *_ = COLOURS
    order = np.argsort(stream.time)
    truth = stream.time[order], stream.gangue[order].astype(float)
    draw_drawn(axes, *truth, colour=red, title="in truth", width=1.2, says_times=False)
    shares = [one.state.share for one in stream.watched(model, share_step=1.0) if one.kind == "share"]
    shut = [turn.time for turn in stream.turns(model) if turn.shut]
    draw_drawn(axes, times, gangue_at(times, shares), shut, colour=blue, title="predicted")
    finish_drawn(axes)
    return png(figure)


def drawn_row(name: str, streams: list[Stream], until: np.ndarray) -> str:
    recovery, share = np.mean([s.drawn(t) for s, t in zip(streams, until.tolist(), strict=True)], axis=0)
    return f"| {name} | {recovery:.1%} | {share:.1%} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=shipped.path_of("models", shipped.ACCELERATION_MODEL))
    parser.add_argument("-n", "--streams", type=int, default=10)
    parser.add_argument("--rising", type=int, default=6, help="number of streams with a rising share, 0 for none")
    parser.add_argument("--first", type=int, default=0, help="added to the seeds")
    parser.add_argument("--picture", type=Path, help="PNG file of the operators' curve")
    arguments = parser.parse_args()
    model = StoredModel.load(arguments.model)
    shares = np.round(HIGHEST * (np.arange(arguments.streams) % 10) / 9, 4)
    print(
        "| streams | number | RMS error of 60 s | mean error | 10 s intervals that hold the share / the rocks | "
        "width | unknown | false SHUT | ms an impact |\n|---|---|---|---|---|---|---|---|---|"
    )
    made = []
    for seed, name, make in zip(
        SEEDS, ("caving, constant shares", "another seam and place"), (constant, changed), strict=False
    ):
        made.append(
            [Stream.of(make(share), seed + arguments.first + k, 0, model) for k, share in enumerate(shares.tolist())]
        )
        print(row(name, made[-1], shares, model), flush=True)
    print("\n" + "\n".join(alarms(made[0], shares, model)) + "\n", flush=True)
    if arguments.rising:
        print("\n".join(rising(model, arguments.rising, SEEDS[2] + arguments.first, arguments.picture)))


if __name__ == "__main__":
    main()

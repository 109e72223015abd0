"""Tones of machines beside a window: answers and fraction of gangue with `--set lines=false` and without.

    python benchmarks/beam/lines.py [--streams 4] [--first 0] [--rows none "3 g" ...]
    python benchmarks/beam/lines.py --from-begin         # with --set lines=false and with --set lines=true
    python benchmarks/beam/lines.py --seams wet hard     # beside 25 s of coal, with tones taken out
    python benchmarks/beam/lines.py --heard              # machines, and beams that ring long without any
    python benchmarks/beam/lines.py --seams wet hard --rows "30 times the background" "20 rocks a second"

Streams of one minute are made without `cgid`: rocks fall on a sloping beam of finite elements (`independent_beam`) and
bounce down from it, each contact integrated with the modes; to the samples come the rumble of a conveyor, and tones,
bursts or blasts. The shipped model of acceleration answers as in `cgid predict`, for the seam of its training, which is
that of the streams. Seeds from 0 are those of the figures; what the package uses was settled with others (--first 100).
Each stream has another fraction of gangue, and other tones.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.beam.anchor import SEAMS, SPAN
from benchmarks.beam.anchor import stream as stream_of
from benchmarks.beam.independent_beam import RATE, generate, rocks
from cgid import load_model, shipped
from cgid.identification.model import Model
from cgid.identification.prediction import Answer, PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch, SupportReport
from cgid.learning.streams import variations
from cgid.recordings.lines import Lines
from cgid.scene import load_scene, parse_scene
from cgid.scene.synthesis.stream import record

Floats = NDArray[np.float64]
G = 9.80665
#: Thin plate with smeared ribs, but for a thousandth of shear and rotary inertia: nearly the beam that cgid computes.
VARIANT = "0.001 mindlin"
DURATION, WINDOW = 60.0, 10.0
#: Rocks a second; slope of the beam; part of the beam where rocks fall [m], and its end.
ARRIVALS, SLOPE, FALL, END = 8.0, np.radians(20), ((0.2, 0.8), (0.2, 1.2)), 1.5
#: Speed after an impact over that before, beside the material's own restitution: what the modes take. A rock is
#: followed until it is slower than this [m/s], so often at most.
GIVE, SLOWEST, MOST = 0.8, 0.3, 5
FRACTIONS = (0.05, 0.13, 0.3, 0.6)
#: Rumble: amplitude density [m/s^2 / sqrt(Hz)] at frequencies [Hz].
RUMBLE = ((2.0, 20.0, 200.0, 2000.0), (1e-3 * G, 5e-3 * G, 5e-3 * G, 5e-4 * G))
#: A row is an answer for a rock within this time [s].
NEAR = 4e-3


@dataclass(frozen=True)
class Stream:
    """Samples without any noise [m/s^2], and time [s], label and bounce of each impact."""

    clean: Floats
    time: Floats
    gangue: NDArray[np.bool_]
    bounce: NDArray[np.int64]
    seed: int

    @classmethod
    @cache
    def of(cls, seed: int) -> Stream:
        """Make a stream."""
        rng = np.random.default_rng([seed, 59])
        n = rng.poisson(ARRIVALS * DURATION)
        begun = np.sort(rng.uniform(0, DURATION, n))
        drawn = rocks(8 * n, np.random.default_rng([seed, 0]))
        fraction = FRACTIONS[seed % len(FRACTIONS)]
        wanted, is_gangue = rng.random(n) < fraction, drawn.labels == "gangue"
        pick = np.empty(n, int)
        pick[wanted], pick[~wanted] = (
            np.flatnonzero(is_gangue)[: wanted.sum()],
            np.flatnonzero(~is_gangue)[: (~wanted).sum()],
        )
        rock = type(drawn)(*(part[pick] for part in drawn))
        x, y = (rng.uniform(*span, n) for span in FALL)
        speed, along = rock.speed * np.cos(SLOPE), rock.speed * np.sin(SLOPE)
        parts, when, number = [], begun, np.arange(n)
        for bounce in range(MOST + 1):
            parts.append((number, when, x, y, speed, np.full(len(number), bounce)))
            speed = speed * GIVE * rock.restitution[number]
            flight = 2 * speed / (G * np.cos(SLOPE))
            x = x + along * flight + G * np.sin(SLOPE) * flight**2 / 2
            along, when = along + G * np.sin(SLOPE) * flight, when + flight
            kept = (x < END) & (speed > SLOWEST) & (when < DURATION - 0.1)
            number, when, x, y, speed, along = (part[kept] for part in (number, when, x, y, speed, along))
        number, when, x, y, speed, bounce = (np.concatenate(part) for part in zip(*parts, strict=True))
        own = type(rock)(*(part[number] for part in rock))._replace(x=x, y=y, speed=speed)
        made = generate(len(number), seed, VARIANT, noise=0.0, given=own)
        clean = np.zeros(round((DURATION + 0.2) * RATE))
        first = np.round(when * RATE).astype(int)
        for at, frame in zip(first, made["acceleration"], strict=True):
            clean[at : at + len(frame)] += frame[: len(clean) - at]
        touch = first / RATE + made["onset"]
        order = np.argsort(touch)
        return cls(clean[: round(DURATION * RATE)], touch[order], wanted[number][order], bounce[order], seed)

    def with_another(self) -> Stream:
        """Return this stream and another of the same fraction at once."""
        other = Stream.of(self.seed + 50 * len(FRACTIONS))
        time = np.concatenate([self.time, other.time])
        order = np.argsort(time)
        gangue, bounce = (
            np.concatenate(pair)[order] for pair in ((self.gangue, other.gangue), (self.bounce, other.bounce))
        )
        return Stream(self.clean + other.clean, time[order], gangue, bounce, self.seed)


# -- what machines add ------------------------------------------------------------------------------------


def rumble(n: int, rng: np.random.Generator) -> Floats:
    """Return noise of a conveyor (n,)."""
    spectrum = np.fft.rfft(rng.standard_normal(n))
    frequency = np.maximum(np.fft.rfftfreq(n, 1 / RATE), 1e-3)
    density = np.exp(np.interp(np.log(frequency), np.log(RUMBLE[0]), np.log(RUMBLE[1])))
    return np.fft.irfft(spectrum * density * np.sqrt(RATE / 2), n)


def wave(frequency: Floats, rng: np.random.Generator) -> Floats:
    """Return a sine whose frequency [Hz] is (n,)."""
    return np.sin(2 * np.pi * (np.cumsum(frequency) / RATE + rng.random()))


def tones(
    n: int,
    rng: np.random.Generator,
    *,
    level: float,
    moving: float = 2.0,
    count: int = 6,
    turns: tuple[float, float] = (8.0, 16.0),
) -> Floats:
    """Return tones between 40 Hz and 3 kHz, the strongest of `level` [g], that move by so many Hz in so long [s]."""
    at, out = np.arange(n) / RATE, np.zeros(n)
    for k, frequency in enumerate(np.exp(rng.uniform(np.log(40), np.log(3000), count))):
        turn = 2 * np.pi * (at / rng.uniform(*turns) + rng.random())
        out += level * G * 0.75**k * wave(frequency + moving / 2 * np.sin(turn), rng)
    return out


def shearer(n: int, rng: np.random.Generator, *, level: float) -> Floats:
    """Return tones and noise that the picks of a drum modulate at 11 Hz."""
    modulation = 1 + 0.6 * wave(np.full(n, 11.0), rng)
    return modulation * (tones(n, rng, level=level) + 0.5 * G * rng.standard_normal(n))


def gated(n: int, rng: np.random.Generator, on: tuple[float, float], off: tuple[float, float], edge: float) -> Floats:
    """Return 1 where something is on, for a time of `on` [s], 0 in between, with edges of a time [s]."""
    out, at = np.zeros(n), rng.uniform(*off)
    while at < n / RATE:
        length = rng.uniform(*on)
        out[round(at * RATE) : round((at + length) * RATE)] = 1.0
        at += length + rng.uniform(*off)
    return np.convolve(out, np.full(round(edge * RATE), 1 / round(edge * RATE)), "same")


def coming(n: int, rng: np.random.Generator, *, level: float) -> Floats:
    """Return tones that come and go."""
    return gated(n, rng, (3, 8), (3, 8), 0.1) * tones(n, rng, level=level)


def running_up(n: int, rng: np.random.Generator, *, level: float, top: float = 49.0, rise: float = 4.0) -> Floats:
    """Return a motor with its harmonics that starts every fifteen seconds, reaches its speed and stops after ten."""
    at = np.arange(n) / RATE % 15.0
    speed = np.interp(at, (0.0, rise, 10.0, 12.0, 15.0), (0.0, top, top, 0.0, 0.0))
    loud = (speed / top) ** 2
    return level * G * loud * sum(0.75**k * wave(order * speed, rng) for k, order in enumerate((1, 2, 4, 6, 12, 24)))


def bursts(n: int, rng: np.random.Generator, *, level: float) -> Floats:
    """Return bursts of white noise."""
    return level * G * gated(n, rng, (0.3, 1.0), (2, 6), 0.02) * rng.standard_normal(n)


def blasts(n: int, rng: np.random.Generator, *, level: float) -> Floats:
    """Return blows of the ground: 20 to 60 Hz for half a second."""
    out = np.zeros(n)
    for start in np.arange(rng.uniform(0, 5), n / RATE - 2, 5.0):
        at = np.arange(round(1.5 * RATE)) / RATE
        blow = level * G * np.exp(-at / 0.2) * np.sin(2 * np.pi * rng.uniform(20, 60) * at) * np.minimum(at / 0.01, 1)
        out[round(start * RATE) :][: len(at)] += blow
    return out


ROWS: dict[str, Callable[[int, np.random.Generator], Floats]] = {
    "none": lambda n, rng: np.zeros(n),
    ".3 g": lambda n, rng: tones(n, rng, level=0.3),
    ".9 g": lambda n, rng: tones(n, rng, level=0.9),
    "3 g": lambda n, rng: tones(n, rng, level=3.0),
    "3 g, not moving": lambda n, rng: tones(n, rng, level=3.0, moving=0.0),
    "3 g, moving by 8 Hz": lambda n, rng: tones(n, rng, level=3.0, moving=8.0),
    "3 g, coming and going": lambda n, rng: coming(n, rng, level=3.0),
    "3 g, running up": lambda n, rng: running_up(n, rng, level=3.0),
    "3 g, running up in 1 s": lambda n, rng: running_up(n, rng, level=3.0, rise=1.0),
    "shearer 3 g": lambda n, rng: shearer(n, rng, level=3.0),
    "16 rocks a second": lambda n, rng: np.zeros(n),
    "16 rocks a second, 3 g": lambda n, rng: tones(n, rng, level=3.0),
    "bursts 1 g": lambda n, rng: bursts(n, rng, level=1.0),
    "blasts 10 g": lambda n, rng: blasts(n, rng, level=10.0),
}
#: Rows of the table of seams alone: factors of the background, and rocks a second.
LOUDER = {f"{factor} times the background": float(factor) for factor in (3, 10, 30)}
RATES = {f"{rate} rocks a second": float(rate) for rate in (4, 20)}
#: White noise of the recorder, which grows with the background: 100 ug/sqrt(Hz) [m/s^2].
WHITE = 1e-4 * G * np.sqrt(RATE / 2)


# -- answers ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """What the package said of a stream: answers, reports, warnings, and its processor time [s]."""

    answers: list[Answer]
    reports: list[SupportReport]
    lines: list[str]
    cost: float

    @classmethod
    def of(cls, samples: Floats, model: Model, **fields: object) -> Found:
        """Answer for a recording."""
        settings = PredictionSettings(share_time=WINDOW, share_step=1.0, trained_seam=True, **fields)
        begun = time.process_time()
        steps = list(identify_blocks([samples.astype(np.float32)[None]], RATE, model, ("1",), settings))
        cost = time.process_time() - begun
        answers = [answer for step in steps for answer in step.answers]
        lines = [one.line("stream") for step in steps for one in step.found if not one.is_note]
        watch = CavingWatch(model, ("1",), settings)
        reports = [report for step in steps for report in watch.feed(step.answers, step.until, step.heard)]
        return cls(answers, reports + watch.finish(DURATION), lines, cost)


@dataclass
class Row:
    """Sums over streams."""

    heard: int = 0
    answered: int = 0
    right: int = 0
    impacts: int = 0
    errors: tuple[float, ...] = ()
    held: tuple[bool, ...] = ()
    widths: tuple[float, ...] = ()
    shut: tuple[float, ...] = ()
    told: int = 0
    cost: float = 0.0

    def add(self, found: Found, stream: Stream) -> None:
        """Count the answers for a stream, and its windows against the truth."""
        when = np.array([answer.time for answer in found.answers])
        for touch, gangue in zip(stream.time, stream.gangue, strict=True):
            k = int(np.abs(when - touch).argmin())
            if abs(when[k] - touch) > NEAR:
                continue
            self.heard += 1
            label = found.answers[k].label
            self.answered += label != "unknown"
            self.right += label == ("gangue" if gangue else "coal")
        self.impacts += len(stream.time)
        first = stream.bounce == 0
        for report in found.reports:
            share = report.state.share
            if report.switch is not None and report.switch.shut and FRACTIONS[stream.seed % len(FRACTIONS)] < 0.5:
                self.shut += (report.switch.time,)
            if report.kind != "share" or share.time % WINDOW > 0.01 or share.time - share.start < 0.99 * WINDOW:
                continue
            truth = float(stream.gangue[first & (stream.time > share.start) & (stream.time <= share.time)].mean())
            self.errors += (share.share - truth if share.n_impacts else np.nan,)
            self.held += (bool(share.low <= truth <= share.high),)
            self.widths += (share.high - share.low,)
        self.told += bool(found.lines)
        self.cost += found.cost

    def cells(self) -> list[str]:
        """Return the figures of a line of the table."""
        errors = np.array(self.errors)
        known = errors[np.isfinite(errors)]
        figures = [
            f"{self.heard / self.impacts:.3f}",
            f"{self.answered / max(self.heard, 1):.3f}",
            f"{self.right / max(self.answered, 1):.3f}",
            f"{known.mean():+.3f}",
            f"{np.sqrt(np.mean(known**2)):.3f}",
            f"{np.mean(self.held):.2f}",
            f"{np.mean(self.widths):.2f}",
            f"{len(self.shut)}" + (f" ({min(self.shut):.0f} s)" if self.shut else ""),
            f"{self.told}",
            f"{self.cost:.2f}",
        ]
        return [figure.replace("0.", ".", 1) if figure.lstrip("+-").startswith("0.") else figure for figure in figures]


TITLES = (
    "noise",
    "heard",
    "answered",
    "right of answered",
    "bias",
    "RMS",
    "intervals that hold",
    "width",
    "false SHUT",
    "told",
    "s",
)


# -- in other seams, beside their coal ----------------------------------------------------------------------

#: Fractions of gangue that follow 25 s of coal, for so long [s].
AFTER, AFTER_TIME = (0.2, 0.65), 50.0


@cache
def in_stream(name: str, duration: float, fraction: float, seed: int, arrivals: float) -> Floats:
    """Return the samples of a stream of a seam."""
    return stream_of(SEAMS[name], duration, fraction, seed, arrivals=arrivals)[0][: round(duration * RATE)]


def in_seam(name: str, row: str, model: Model, first: int) -> str:
    """Return a row of the table: windows of 10 s beside 25 s of coal of a seam, under a noise from the start."""
    settings = PredictionSettings(share_time=WINDOW, share_step=1.0, coal_until=SPAN)
    errors, held, widths, turns, bases = [], [], [], [], Counter[str]()
    for number, fraction in enumerate(AFTER):
        seed = 59_000 + first + 10 * list(SEAMS).index(name) + 2 * number
        arrivals = RATES.get(row, ARRIVALS)
        samples = np.concatenate(
            [in_stream(name, SPAN, 0.0, seed, arrivals), in_stream(name, AFTER_TIME, fraction, seed + 1, arrivals)]
        )
        samples = samples + noise_for(row, seed, len(samples))
        steps = identify_blocks([samples.astype(np.float32)[None]], RATE, model, ("1",), settings)
        watch = CavingWatch(model, ("1",), settings)
        reports = [report for step in steps for report in watch.feed(step.answers, step.until, step.heard)]
        for report in reports + watch.finish(SPAN + AFTER_TIME):
            share = report.state.share
            turns += [fraction] * (report.kind == "shut")
            if report.kind == "share" and share.start >= SPAN - 0.01 and (share.time - SPAN) % WINDOW < 0.01:
                errors.append(share.share - fraction)
                held.append(share.low <= fraction <= share.high)
                widths.append(share.high - share.low)
                bases[str(share.basis)] += 1
    error = np.array(errors)
    shut = f"{sum(one < 0.5 for one in turns)}, {sum(one > 0.5 for one in turns)}"
    found = f"{error.mean():+.3f} | {np.sqrt(np.mean(error**2)):.3f} | {np.mean(held):.2f} of {len(held)}"
    return f"| {name} | {row} | {found} | {np.mean(widths):.2f} | {shut} | {dict(bases)} |"


# -- when a machine is heard -------------------------------------------------------------------------------

#: Tones of a machine, by how much they move [Hz], and in what time [s].
MACHINES = {
    "one tone": (1, 0.0, (8.0, 16.0)),
    "one tone that wanders": (1, 4.0, (1.2, 1.8)),
    "two pumps that wander": (2, 4.0, (1.2, 1.8)),
    "six tones": (6, 0.0, (8.0, 16.0)),
    "six tones that wander": (6, 4.0, (1.2, 1.8)),
}
#: Damping ratios of beams without a machine; modes and length [s] of the streams of equally loud ones.
DAMPING, N_MODES, LENGTH = (0.02, 0.005, 0.002, 0.001), 40, 40.0


def on_beam(damping: float, rate: float, number: int) -> Floats:
    """Return a minute of `caving` without hum: a beam of this damping ratio, so many rocks a second."""
    (scene,) = variations(load_scene(shipped.scene_path("caving")), 1, 59_100 + number)
    content = json.loads(scene.text)
    content["tail_beam"]["damping_ratio"] = damping
    content["stream"]["arrivals"]["rate"] = rate
    del content["background"]["hum"]
    return np.asarray(record(parse_scene(content | {"name": "no hum"}), 59_100, number)[0].samples)


def of_modes(damping: float, rate: float, number: int) -> Floats:
    """Return what modes between 60 Hz and 6 kHz that are all as loud answer to impacts at random, and noise."""
    rng, n = np.random.default_rng([59_100 + number, 62]), round(LENGTH * RATE)
    first, out = rng.integers(0, n, rng.poisson(rate * LENGTH)), rng.standard_normal(n)
    strength = 20 * rng.lognormal(0, 0.8, len(first))
    for frequency in np.exp(rng.uniform(np.log(60), np.log(6000), N_MODES)):
        struck = np.zeros(n)
        np.add.at(struck, first, strength * rng.standard_normal(len(first)))
        turn = np.exp((1j - damping) * 2 * np.pi * frequency / RATE)
        out += lfilter([1.0], [1.0, -turn], struck).imag
    return out


def heard(samples: Floats) -> float:
    """Return from when on lines are taken out of samples [s], nan if never."""
    lines, blocks = Lines(1, RATE), samples.astype(np.float32)[None]
    changed = np.flatnonzero(np.concatenate([lines.feed(blocks), lines.finish()], axis=1) != blocks)
    return changed[0] / RATE if changed.size else np.nan


def hearing(n: int, first: int, rates: tuple[float, ...] = (4.0, 8.0, 16.0)) -> None:
    """Print how many machines are heard in streams, and when; and in how many without any."""
    print("| stream | " + " | ".join(f"{rate:g} rocks a second" for rate in rates) + " |\n|---|---|---|---|")

    def row(name: str, stream: Callable[[float, int], Floats]) -> None:
        cells = []
        for rate in rates:
            at = np.array([heard(stream(rate, first + number)) for number in range(n)])
            when = f", {np.nanmedian(at):.1f} s, at most {np.nanmax(at):.1f}" if np.isfinite(at).any() else ""
            cells.append(f"{np.isfinite(at).sum()} of {n}{when}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)

    def with_machine(rate: float, number: int, *, count: int, moving: float, turns: Any, level: float) -> Floats:
        samples, rng = on_beam(0.02, rate, number), np.random.default_rng([59_100 + number, 63])
        return samples + tones(len(samples), rng, level=level, moving=moving, count=count, turns=turns)

    for damping in DAMPING:
        row(f"caving, {100 * damping:g} % damping", partial(on_beam, damping))
    for damping in DAMPING:
        row(f"{N_MODES} modes as loud, {100 * damping:g} %", partial(of_modes, damping))
    for (name, (count, moving, turns)), level in product(MACHINES.items(), (3.0, 0.3)):
        machine = partial(with_machine, count=count, moving=moving, turns=turns, level=level)
        row(f"{name}, {level:g} g", machine)


def noise_for(row: str, seed: int, n: int) -> Floats:
    rng, factor = np.random.default_rng([seed, 60, [*ROWS, *LOUDER, *RATES].index(row)]), LOUDER.get(row, 1.0)
    background = rumble(n, np.random.default_rng([seed, 61]))
    if row in ROWS:
        return background + ROWS[row](n, rng)
    return factor * (background + WHITE * rng.standard_normal(n))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=[*ROWS, *LOUDER, *RATES])
    parser.add_argument("--from-begin", action="store_true", help="with --set lines=true in place of the default")
    parser.add_argument("--seams", nargs="+", choices=SEAMS, metavar="SEAM", help="in these seams, beside their coal")
    parser.add_argument("--heard", action="store_true", help="when machines are heard, and where none runs")
    given = parser.parse_args()
    if given.heard:
        hearing(given.streams, given.first)
        return
    if given.seams:
        model = load_model("default-acceleration")
        print("| seam | noise | bias | RMS | holds | width | SHUT: false, right | by |\n" + "|---" * 8 + "|")
        for name, row in product(given.seams, given.rows):
            print(in_seam(name, row, model, given.first), flush=True)
        return
    model = load_model("default-acceleration")
    streams = [Stream.of(given.first + k) for k in range(given.streams)]
    print("| " + " | ".join(TITLES) + " |\n" + "|---" * len(TITLES) + "|")
    for name in given.rows:
        kept, out = Row(), Row()
        for one in streams:
            stream = one.with_another() if name.startswith("16 rocks") else one
            samples = stream.clean + noise_for(name, stream.seed, len(stream.clean))
            for row, lines in ((kept, False), (out, given.from_begin or None)):
                row.add(Found.of(samples, model, lines=lines), stream)
        cells = (f"{first} -> {second}" for first, second in zip(kept.cells(), out.cells(), strict=True))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

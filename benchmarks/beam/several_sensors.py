"""Several sensors on one beam, and on two: rows, accuracy and gangue fraction, judged without `cgid`.

    python benchmarks/beam/several_sensors.py [-n 600] [--noise 1 5] [--rate 51200]

Rocks of `tail_beam` fall on a beam of finite elements, of which `independent_beam` gives the samples at three places;
here they become a stream: rocks at random times, noise of each sensor of its own, a converter. `cgid` looks through the
modes that it computes from the scene's dimensions, behind each place, and the shipped classifier answers, as in a model
of `cgid train SCENE --sensor X,Y --sensor X,Y --same-beam 1+2`. The filter of a recorder of another rate ends at the
same share of it. Seeds of the streams are those of no training and of no choice in the package.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam import independent_beam as beam
from cgid import load_model
from cgid.identification.model import Model
from cgid.identification.prediction import Answer, PredictionSettings, Share
from cgid.identification.prediction.same_beam import answering_channels, rows_of
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch
from cgid.scene import load_scene
from cgid.scene.synthesis.through_beam import full_beam

Floats = NDArray[np.float64]
Recorder = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]
PLACES = ((0.5, 0.45), (1.1, 1.0), (0.8, 0.3))
#: Thin plate with smeared ribs, but for a thousandth of shear and rotary inertia: nearly the beam that cgid computes.
VARIANT = "0.001 mindlin"
SEED, OTHER_SEED = 571, 572
#: Rocks a second, the least time between two [s], and how far from a rock its row may be [s].
ARRIVALS, APART, NEAR = 3.0, 0.1, 6e-3
#: Fraction of gangue that is kept of the scene's equal parts.
GANGUE = 0.3


@dataclass(frozen=True)
class Stream:
    """Samples without noise, (n_sensors, n_samples), and time [s] and label of each rock."""

    clean: Floats
    time: Floats
    gangue: NDArray[np.bool_]

    @classmethod
    def of(cls, n: int, seed: int, recorder: Recorder) -> Stream:
        """Make a stream of about n rocks."""
        rng = np.random.default_rng([seed, 9])
        made = beam.generate(n, seed, VARIANT, noise=0.0, sensors=PLACES, recorder=recorder)
        gangue = made["labels"] == "gangue"
        kept = ~gangue | (rng.random(n) < GANGUE / (1 - GANGUE))
        start = np.cumsum(APART + rng.exponential(1 / ARRIVALS - APART, n))[: kept.sum()]
        first = np.round(start * beam.RATE).astype(int)
        frames = made["acceleration"][kept]
        clean = np.zeros((len(PLACES), first[-1] + frames.shape[2] + round(0.2 * beam.RATE)))
        for at, frame in zip(first, frames, strict=True):
            clean[:, at : at + frame.shape[1]] += frame
        return cls(clean, first / beam.RATE + made["onset"][kept], gangue[kept])

    def recorded(self, level: float, seed: int) -> Floats:
        """Return what the recorder gives at a multiple of the scene's noise."""
        noise = np.random.default_rng([seed, 10]).normal(0, level * beam.NOISE, self.clean.shape)
        return beam.digitised(self.clean + noise)


def looking(sensors: Sequence[int]) -> Model:
    """Return the shipped model behind some of the places, without its rates of rocks that bounce: here none does."""
    model = load_model("default-acceleration")
    own = full_beam(load_scene("tail_beam"), [PLACES[sensor] for sensor in sensors])
    arrays = {name: one for name, one in model.arrays.items() if not name.startswith(("beam.", "share."))}
    return replace(model, arrays=arrays | own.arrays)


@dataclass(frozen=True)
class Found:
    """Answers for a stream, the fraction of each support, and the lines on stderr."""

    answers: list[Answer]
    shares: list[Share]
    lines: list[str]

    @classmethod
    def of(cls, samples: Floats, model: Model, same_beam: tuple[tuple[str, ...], ...] = ()) -> Found:
        """Answer for a recording, in blocks of a second."""
        duration = samples.shape[1] / beam.RATE
        settings = PredictionSettings(same_beam=same_beam, share_time=duration, share_step=duration)
        channels = [str(number) for number in range(1, len(samples) + 1)]
        blocks = (samples[:, first : first + int(beam.RATE)] for first in range(0, samples.shape[1], int(beam.RATE)))
        answers, lines = [], []
        for step in identify_blocks(blocks, beam.RATE, model, channels, settings):
            answers += step.answers
            lines += [one.line("stream", len(channels)) for one in step.found if not one.is_note]
        supports = answering_channels(rows_of(model, channels, same_beam), channels)
        watch = CavingWatch(model, supports, settings)
        found = watch.feed(answers, duration) + watch.finish(duration)
        return cls(answers, [one.state.share for one in found if one.kind == "share"], lines)


def nearest_to(found: Found, stream: Stream) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the number of the answer nearest to each rock, and whether it is an answer for it."""
    time = np.array([answer.time for answer in found.answers])
    nearest = np.abs(time - stream.time[:, None]).argmin(axis=1)
    return nearest, np.abs(time[nearest] - stream.time) < NEAR


def row(name: str, found: Found, stream: Stream, clear: NDArray[np.bool_]) -> str:
    """Return a line of the table: a rock is right if the most probable label of its first row is its own.

    `clear` are the rocks that each of the three sensors hears alone.
    """
    nearest, heard = nearest_to(found, stream)
    own = [found.answers[k] for k in nearest]
    right = np.array(
        [
            bool(one.probabilities) and (one.probabilities["gangue"] > 0.5) == gangue
            for one, gangue in zip(own, stream.gangue, strict=True)
        ]
    )
    unknown = np.mean([one.label == "unknown" for one in found.answers])
    fractions = "; ".join(f"{share.share:.2f} ({share.low:.2f} to {share.high:.2f})" for share in found.shares)
    return (
        f"| {name} | {len(found.answers)} | {heard.mean():.3f} | {right[heard].mean():.3f} | "
        f"{right[heard & clear].mean():.3f} | {unknown:.3f} | {fractions} | "
        f"{len(found.lines)} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--rocks", type=int, default=600)
    parser.add_argument("--noise", type=float, nargs="+", default=[1.0, 5.0])
    parser.add_argument("--rate", type=float, default=beam.RATE, help="of the recorder [Hz]")
    given = parser.parse_args()
    recorder = beam.record_at(given.rate)
    models = {sensors: looking(sensors) for sensors in ((0,), (1,), (2,), (0, 1), (0, 1, 2))}
    stream, other = (Stream.of(given.rocks, seed, recorder) for seed in (SEED, OTHER_SEED))
    lines: dict[str, Sequence[str]] = {}
    print(f"{len(stream.time)} rocks in {stream.clean.shape[1] / beam.RATE:.0f} s, gangue {stream.gangue.mean():.3f}\n")
    print(
        "| noise | channels | rows | heard | accuracy | of rocks that each sensor hears | unknown | "
        "fraction of gangue (95 %) | lines |"
    )
    print("|---|---|---|---|---|---|---|---|---|")

    def tell(name: str, samples: Floats, sensors: tuple[int, ...], groups: Sequence[str] = ()) -> None:
        found = Found.of(samples, models[sensors], tuple(tuple(group.split("+")) for group in groups))
        print(f"| {level:g} {row(name, found, stream, clear)}", flush=True)
        lines[f"noise {level:g}, {name}"] = found.lines

    for level in given.noise:
        samples = stream.recorded(level, SEED)
        clear = np.ones(len(stream.time), bool)
        for sensor in range(3):
            clear &= nearest_to(Found.of(samples[[sensor]], models[(sensor,)]), stream)[1]
        for sensor in range(3):
            tell(f"{sensor + 1} alone", samples[[sensor]], (sensor,))
        tell("1, 2 joint", samples[:2], (0, 1))
        tell("1, 2, 3 joint", samples, (0, 1, 2))
        tell("1+2", samples[:2], (0, 1), ["1+2"])
        tell("1+2+3", samples, (0, 1, 2), ["1+2+3"])
        if level > min(given.noise):
            continue
        tell("1+2, swapped", samples[[1, 0]], (0, 1), ["1+2"])
        half = samples.shape[1] // 2
        for what, value in (("nan", np.nan), ("zeros", 0.0)):
            dying = samples[:2].copy()
            dying[1, half:] = value
            tell(f"1+2, 2 is {what} from the middle on", dying, (0, 1), ["1+2"])
        back = samples[:2].copy()
        back[1, half : half + half // 2] = np.nan
        tell("1+2, 2 is nan for a quarter", back, (0, 1), ["1+2"])
        gain = samples[:2] * np.array([[1.0], [2.0]])
        tell("1+2, gain of 2 wrong by 2", gain, (0, 1), ["1+2"])
        tell("1 and 1 again with noise of its own", np.stack([samples[0], stream.recorded(level, 1)[0]]), (0,))
        length = min(samples.shape[1], other.clean.shape[1])
        apart = np.stack([samples[0, :length], other.recorded(level, OTHER_SEED)[0, :length]])
        tell("two supports", apart, (0,))
        tell("two supports as 1+2", apart, (0,), ["1+2"])
    for name, said in lines.items():
        for line in said:
            print(f"{name}: {line}")


if __name__ == "__main__":
    main()

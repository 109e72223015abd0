"""What neighbours cost an impact of a stream, and what subtracting their ringing wins back.

    python benchmarks/overlap.py [MODEL] [--rate 8] [-n 3] [--first 0] [--blows 1024]

Minutes of `caving` with a share of gangue of .4 and other rates of arrival. Each impact is answered for three times: in
its stream as `cgid predict` does; alone, where the same rock hits the same place with .3 s of silence around it, which
is the most that any joint fit could reach; and in its stream after the ringing of its neighbours has been subtracted,
as their own inversions foretell it. "earlier" subtracts what came before, where that takes away at least a fifth of the
energy before touch; "both" also what comes after, and looks at the whole window.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from streams import constant
from through_beam import after_another, judged

from cgid import shipped
from cgid.identification.answers import Answer, identify_frames
from cgid.identification.detection import ImpactDetector
from cgid.identification.events import Event
from cgid.identification.inversion import Inverted
from cgid.identification.model import Model
from cgid.identification.question import Question
from cgid.identification.stream import identify_blocks
from cgid.measure.beam import respond
from cgid.measure.vibration import VibrationBatch
from cgid.scene import load_scene, parse_scene, stream, synthesise
from cgid.scene.impacts import recorder_of
from cgid.scene.plan import plan
from cgid.scene.rocks import Rocks
from cgid.signals import Batch

#: First seed, share of gangue, time between impacts that are alone [s], and how far an onset may lie from touch [s].
SEED, SHARE, APART, NEAR = 77_000, 0.4, 0.3, 2.5e-3
#: Ringing is foretold for this long [s]; of the energy before touch less than this share must be left.
RINGS, LEFT = 0.15, 0.8
#: Time from the touch before or to the touch after [s].
GAPS = (0.0, 3.2e-3, 10e-3, 25e-3, 50e-3, 100e-3, np.inf)
WAYS = ("earlier", "both")
#: Time from the touch of one single blow to that of the next [s].
BLOW_GAPS = (0.01, 0.03)


@dataclass(frozen=True)
class Given:
    """Answers for impacts of known truth: whether found, whether unknown, and the probability of gangue."""

    found: NDArray[np.bool_]
    unknown: NDArray[np.bool_]
    gangue: NDArray[np.float64]

    @classmethod
    def of(cls, answers: Sequence[Answer], touch: NDArray[Any], peak: NDArray[Any]) -> Given:
        """Give each answer to the strongest impact near it that has none."""
        found, unknown, gangue = np.zeros(touch.size, bool), np.zeros(touch.size, bool), np.full(touch.size, 0.5)
        for answer in answers:
            near = np.flatnonzero((np.abs(touch - answer.time) < NEAR) & ~found)
            if near.size:
                one = near[np.argmax(peak[near])]
                found[one], unknown[one] = True, answer.label == "unknown"
                gangue[one] = answer.probabilities.get("gangue", 0.5)
        return cls(found, unknown, gangue)


def made(rate: float, seed: int) -> tuple[Any, dict[str, NDArray[Any]], NDArray[Any], NDArray[Any]]:
    """Return a stream and its truth, and the same impacts alone, with their touch [s]."""
    content = json.loads(constant(SHARE).text)
    content["stream"]["arrivals"] = {"rate": f"{rate:g} Hz"}
    parts: list[Rocks] = []
    add = stream.add_impacts

    def kept(asked: Any, axis: Any, rocks: Rocks, recorder: Any) -> Any:
        parts.append(rocks)
        return add(asked, axis, rocks, recorder)

    with mock.patch.object(stream, "add_impacts", kept):
        signal, truth = stream.record(parse_scene(content | {"name": "caving"}), seed)
    rocks = Rocks.joined(parts)
    rocks = rocks.taken(np.lexsort((rocks["rock"], rocks["time"]))[: truth["time"].size])
    assert np.array_equal(rocks["time"], truth["time"])
    touch = APART * np.arange(1, len(rocks) + 1) + rocks["time"] % 1e-3
    content["stream"]["duration"] = f"{APART * (len(rocks) + 2):g} s"
    scene = parse_scene(content | {"name": "alone"})
    asked, axis = plan(scene, "recordings", dtype="float32"), stream.TimeAxis()
    for first in range(0, len(rocks), 200):
        part = rocks.taken(np.arange(first, min(first + 200, len(rocks))))
        part.columns["time"] = touch[first : first + 200].copy()
        add(asked, axis, part, recorder_of(asked))
    alone = axis.until(stream.samples_of(scene)).copy()
    level = float(scene.sensor.noise_level(np.zeros(1), signal.sampling_rate)[0])
    alone += np.random.default_rng(seed).normal(0, level, alone.size)
    scene.sensor.digitise(alone[None], signal.sampling_rate, np.zeros(1), first=0)
    return signal, truth, alone.astype(np.float32), touch


def answers_for(samples: NDArray[Any], rate: float, model: Model) -> list[Answer]:
    """Return the answers of `cgid predict`."""
    steps = identify_blocks([samples[None]], rate, model, ("1",), Question())
    return [answer for step in steps for answer in step.answers]


class Neighbours:
    """The impacts that a detector finds in a recording, and what each makes the beam ring."""

    def __init__(self, samples: NDArray[Any], rate: float, model: Model) -> None:
        assert model.beam is not None and abs(model.beam.beam.sampling_rate / rate - 1) < 1e-6
        self.samples, self.rate, self.model, self.beam = samples.astype(float), rate, model, model.beam.beam
        self.samples -= np.median(self.samples)
        detector = ImpactDetector(rate, kind="vibration")
        found = detector.feed(samples[None]) + detector.finish()
        self.events: list[Event] = [event for event in found if not event.problem]
        self.onset = np.array([event.onset for event in self.events])
        self.quiet, self.lead = detector.n_quiet, detector.n_quiet - (detector.pre_trigger or 0)
        self.frames = np.stack([event.samples for event in self.events]).astype(float)
        self.length = round(RINGS * rate)
        forces = model.beam.inversion.forces
        self.table = respond(self.beam, forces, self.length).astype(np.float32).reshape(len(self.beam.poles), -1)
        batch = VibrationBatch(self.frames, rate, pre_trigger=detector.pre_trigger)
        self.inverted: Inverted = model.beam.look(batch)[0]

    def response(self, number: int) -> NDArray[Any]:
        """Return what an impact makes the sensor record from `Inverted.start` on."""
        one = self.inverted.rows(np.array([number]))
        at = (self.beam.weights(one.x, one.y)[0] @ self.table).reshape(-1, self.length)
        return np.asarray((one.coefficients[0] * one.noise[0]) @ at)

    def answers(self, way: str) -> tuple[list[Answer], int]:
        """Return the answers after what neighbours ring is subtracted, and how many frames this changed."""
        start = self.onset - self.quiet + self.inverted.start
        rings = [self.response(number) for number in range(len(self.events))]
        window = self.beam.n_samples + 16
        frames, changed = self.frames.copy(), 0
        for number, onset in enumerate(self.onset.tolist()):
            before = [k for k in range(max(number - 12, 0), number) if onset - self.onset[k] < self.length]
            after = [k for k in range(number + 1, min(number + 8, len(rings))) if start[k] < onset + window]
            others = before + (after if way == "both" else [])
            low = max(onset - self.quiet, 0, int(self.onset[before[-1]]) + 1 if before else 0)
            part = self.samples[low : onset - self.quiet + frames.shape[1]].copy()
            for k in others:
                first, last = max(start[k], low), min(start[k] + self.length, low + part.size)
                part[first - low : last - low] -= rings[k][first - start[k] : max(last - start[k], 0)]
            calm = slice(0, max(onset - self.lead - low, 1))
            was, left = (float(np.sum(np.square(s[calm]))) for s in (self.samples[low : low + part.size], part))
            if not others or (way == "earlier" and left > LEFT * was):
                continue
            missing = low - onset + self.quiet
            frame = np.zeros(frames.shape[1])
            frame[missing : missing + part.size] = part
            frame[:missing] = np.pad(part[calm], (missing, 0), mode="symmetric")[:missing]
            if number + 1 < len(rings):
                end = max(int(self.onset[number + 1]) - round(0.5e-3 * self.rate), onset + 1)
                frame[(end if way == "earlier" else max(end, onset + window)) - onset + self.quiet :] = 0.0
            frames[number], changed = frame, changed + 1
        pre_trigger = self.events[0].pre_trigger
        found = identify_frames(frames, self.rate, self.model, Question(), pre_trigger=pre_trigger)
        named = zip(self.events, found, strict=True)
        return [replace(answer, time=event.time) for event, answer in named], changed


def blows(model: Model, n: int) -> Iterator[str]:
    """Yield the table of single blows of `tail_beam` into the ringing of another, which was recorded from its touch."""
    assert model.beam is not None
    batches = list(synthesise(load_scene(shipped.scene_path("tail_beam")), n, SEED))
    inversion = model.beam.inversion
    length = batches[0].signals.shape[1]
    modes = respond(model.beam.beam, inversion.forces, length).astype(np.float32).reshape(len(inversion.beam.poles), -1)

    def subtracted(gap: float) -> Iterator[Batch]:
        for before, batch in zip(batches, after_another(iter(batches), gap), strict=False):
            later, touch = round(gap * batch.sampling_rate), batch.pre_trigger
            frames = before.signals.astype(float)
            frames -= frames[:, :touch].mean(axis=1, keepdims=True)
            frames[:, touch + later - 8 :] = 0.0
            found = model.beam.look(VibrationBatch(frames, batch.sampling_rate, pre_trigger=touch))[0]
            at = inversion.beam.weights(found.x, found.y)[0]
            signals = batch.signals.astype(float)
            for row, start in enumerate((found.start - later).tolist()):
                force = found.coefficients[row] * found.noise[row]
                rings = force @ (at[row] @ modes).reshape(-1, length)
                first, lost = max(start, 0), max(-start, 0)
                signals[row, first : length - lost] -= rings[lost : length - first]
            yield replace(batch, signals=signals)

    yield "| gap | number | accuracy: as now, earlier subtracted | answered | unknown | calibration error |"
    yield "|---|---|---|---|---|---|"
    for gap in BLOW_GAPS:
        rows = judged(model, after_another(iter(batches), gap)), judged(model, subtracted(gap))
        told = [f"{rows[0][key]:.3f}, {rows[1][key]:.3f}" for key in ("accuracy", "answered", "unknown", "calibration")]
        yield f"| {1e3 * gap:g} ms | {rows[0]['n']} | {' | '.join(told)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default=shipped.path_of("models", shipped.ACCELERATION_MODEL))
    parser.add_argument("--rate", type=float, default=8.0, help="rocks a second")
    parser.add_argument("-n", "--streams", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="added to the seeds")
    parser.add_argument("--blows", type=int, help="that many single blows after another in place of streams")
    arguments = parser.parse_args()
    model = Model.load(arguments.model)
    if arguments.blows:
        for line in blows(model, arguments.blows):
            print(line, flush=True)
        return
    given: dict[str, list[Given]] = {name: [] for name in ("stream", "alone", *WAYS)}
    truths, changed = [], dict.fromkeys(WAYS, 0)
    for seed in range(SEED + arguments.first, SEED + arguments.first + arguments.streams):
        signal, truth, alone, touch = made(arguments.rate, seed)
        truths.append(truth)
        peak, rate = truth["peak_force"], signal.sampling_rate
        given["stream"].append(Given.of(answers_for(signal.samples, rate, model), truth["time"], peak))
        given["alone"].append(Given.of(answers_for(alone, rate, model), touch, peak))
        neighbours = Neighbours(signal.samples, rate, model)
        for way in WAYS:
            answers, n = neighbours.answers(way)
            changed[way] += n
            given[way].append(Given.of(answers, truth["time"], peak))
    gangue = np.concatenate([truth["label"] == "gangue" for truth in truths])
    since = np.concatenate([np.append(np.inf, np.diff(truth["time"])) for truth in truths])
    until = np.concatenate([np.append(np.diff(truth["time"]), np.inf) for truth in truths])
    every = {
        name: Given(*(np.concatenate([getattr(g, field) for g in own]) for field in Given.__dataclass_fields__))
        for name, own in given.items()
    }
    both = np.logical_and.reduce([own.found for own in every.values()])
    right = {name: (own.gangue > 0.5) == gangue for name, own in every.items()}
    names = (*every, *every)
    names = tuple(
        f"{told}{name}" for told, name in zip(("right: ", *[""] * 3, "unknown: ", *[""] * 3), names, strict=True)
    )
    print(f"| impacts | number | found | {' | '.join(names)} |")
    print("|" + "---|" * 11)

    def row(name: str, some: NDArray[np.bool_]) -> None:
        own = some & both
        parts = [f"{right[way][own].mean():.3f}" for way in every] + [
            f"{g.unknown[own].mean():.1%}" for g in every.values()
        ]
        print(f"| {name} | {some.sum()} | {every['stream'].found[some].mean():.0%} | {' | '.join(parts)} |")

    row("all", np.ones(gangue.size, bool))
    row("first hits", np.concatenate([truth["bounce"] == 0 for truth in truths]))
    for name, gap in (("after another", since), ("before another", until)):
        for low, high in itertools.pairwise(GAPS):
            if ((gap > low) & (gap <= high) & both).any():
                row(
                    f"{1e3 * low:g} {f'to {1e3 * high:g}' if high < np.inf else 'or more'} ms {name}",
                    (gap > low) & (gap <= high),
                )
    for way in WAYS:
        mended, spoilt = (
            int(np.sum(both & one & ~other))
            for one, other in ((right[way], right["stream"]), (right["stream"], right[way]))
        )
        print(f"\n{way}: {changed[way]} frames changed, {mended} answers mended, {spoilt} spoilt")


if __name__ == "__main__":
    main()

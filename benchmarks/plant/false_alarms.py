"""How often something is told of sound recordings: of forces, of a beam in any seam, and of streams of other code.

    python benchmarks/plant/false_alarms.py                             # some twenty minutes on one quiet core
    python benchmarks/plant/false_alarms.py --forces 20 --beams 10 --others 4 --seed 500000

A recording of forces has 60 impacts in its scene, or on a rig of its own; one of a beam has 220 rocks of a seam that is
drawn as those of the fraction; a stream of other code (benchmarks/beam/anchor.py) has 40 s. Counted are recordings of
which the whole tells a fault, and those of which a live watch tells one at any look. With `--looks N`, so many looks
follow at impacts of the recording that come again and again, and what begins in them is counted.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.beam import anchor
from cgid import shipped
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.explanation import ChannelWatch, explain
from cgid.learning.faults import answers_of, any_seam
from cgid.scene import load_scene, synthesise
from cgid.scene.synthesis.stream import record

sys.path.insert(0, str(Path(__file__).parents[2] / "models"))
from train import ORDER_SPOILT, on_rigs, shipped_scene

Recording = tuple[str, np.ndarray, float]


def forces(n: int, seed: int) -> Iterator[Recording]:
    scenes = []
    for scene in map(shipped_scene, ("reference", "rock", "corners")):
        scenes += [scene, *(rig for rig, _ in on_rigs(scene, 3))]
    for number in range(n):
        (batch,) = synthesise(scenes[ORDER_SPOILT[number % len(ORDER_SPOILT)]], 60, seed + number)
        frames, rng = np.asarray(batch.signals, float), np.random.default_rng([seed, number])
        noise = frames[:, : max(int(batch.pre_trigger or 0), 2)].std()
        gaps = noise * rng.standard_normal((len(frames), round(10e-3 * batch.sampling_rate)))
        yield batch.source, np.hstack([gaps, frames]).ravel(), batch.sampling_rate


def beams(n: int, seed: int) -> Iterator[Recording]:
    for number in range(n):
        signal, _ = record(any_seam(load_scene(shipped.scene_path("caving")), seed, number), seed, number)
        yield f"seam {number}", signal.samples.ravel(), signal.sampling_rate


def others(n: int, seed: int) -> Iterator[Recording]:
    names = list(anchor.SEAMS)
    for number in range(n):
        gangue = (0.05, 0.3, 0.7)[number % 3]
        name = names[number % len(names)]
        yield name, anchor.stream(anchor.SEAMS[name], 40.0, gangue, seed + number)[0], anchor.RATE


def begun(answers: list[Answer], model: StoredModel, n_looks: int, seed: int) -> list[str]:
    """Return what begins in so many looks at the impacts of a recording, each half of them shuffled in turn.

    So no impact is twice in one look, where two largest samples would be those of a recorder's limit.
    """
    rng, watch, found = np.random.default_rng(seed), ChannelWatch(model), list[str]()
    halves = np.array_split(np.arange(len(answers)), 2)
    rounds = 40 * n_looks // len(halves[0]) + 1
    for number in np.concatenate([rng.permutation(halves[k % 2]) for k in range(rounds)]).tolist():
        before = watch.explained.faults
        watch.add(answers[number])
        if watch.explained.faults and not before:
            found += [str(one) for one in watch.explained.faults[:1]]
    return found


def judge(kind: str, recordings: Iterator[Recording], model: StoredModel, n_looks: int) -> None:
    whole, live, n, looks = 0, 0, 0, 0
    later, all_later = [], 0
    for name, samples, rate in recordings:
        answers = answers_of(samples, rate, model)
        told = [str(one) for one in explain(answers, model).faults]
        watch, at_looks = ChannelWatch(model), list[str]()
        for answer in answers:
            before = watch.explained.faults
            watch.add(answer)
            if watch.explained.faults and watch.explained.faults != before:
                at_looks += [str(one) for one in watch.explained.faults]
        if n_looks and len(answers) > 240:
            later += [f"{name}: {one}" for one in begun(answers, model, n_looks, n)]
            all_later += n_looks
        n, whole, live, looks = n + 1, whole + bool(told), live + bool(at_looks), looks + len(answers) // 40
        if told or at_looks:
            n_ends = int(np.isin(samples, [samples.min(), samples.max()]).sum())
            what = f"{len(answers)} impacts, {n_ends} samples at the ends"
            print(f"  {kind} {n} ({name[:20]}), {what}: {told}, live {at_looks}", flush=True)
        if n % 10 == 0:
            print(f"  {kind} {n}: {whole} whole, {live} live", flush=True)
    for way, count in (("whole", whole), (f"at any of {looks} looks", live)) if n else ():
        low, high = wilson_interval(count / n, n)
        print(f"{kind}, {way}: {count} of {n} ({low:.3f} to {high:.3f})", flush=True)

    if all_later:
        print(f"{kind}, in {all_later} more looks: {len(later)} begin {later}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for kind, count in (("forces", 400), ("beams", 400), ("others", 31)):
        parser.add_argument(f"--{kind}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=740_000, help="one that no training used")
    parser.add_argument("--looks", type=int, default=0, help="more looks at each recording")
    given = parser.parse_args()
    force, beam = (
        StoredModel.load(shipped.path_of("models", name))
        for name in (shipped.DEFAULT_MODEL, shipped.ACCELERATION_MODEL)
    )
    judge("forces", forces(given.forces, given.seed), force, given.looks)
    judge("beams", beams(given.beams, given.seed), beam, given.looks)
    judge("others", others(given.others, given.seed), beam, given.looks)


if __name__ == "__main__":
    main()

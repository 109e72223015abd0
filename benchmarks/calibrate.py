"""Modes of a beam learned from unlabelled impacts, and what a model trained through the learned beam is worth.

The beam of `tail_beam` with every natural frequency and damping ratio off by independent normal errors of their
logarithms strikes; the scene with the nominal beam learns from its blows, without labels. A model is then trained on
simulations through the learned beam alone, and asked about other blows of the true one. With --shapes the true beam is
that of other drawings instead: all its measures are off.

    python benchmarks/calibrate.py --start 1 3 5 --seeds 5 --impacts 300 --signals 8000
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from threadpoolctl import threadpool_limits

from cgid.errors import BadData
from cgid.identification.model import Model
from cgid.identification.rows import measure
from cgid.identification.training import train
from cgid.physics.modes import LEARNED_COLUMNS, LearnedModes
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.impacts import beam_modes
from cgid.scene.sections import rows_of
from cgid.scene.through_beam import beam_of
from cgid.site import calibrate

#: Modes that a 10 kHz anti-alias filter passes [Hz].
HEARD = 10e3


def with_errors(scene: Scene, error: float, seed: int) -> Scene:
    """Return the scene with modes off by an error, dampings by 10 times as much, at most 30 %."""
    own, rng = beam_modes(scene), np.random.default_rng(seed)
    none = np.zeros(own.frequency.size)
    modes = LearnedModes(
        frequency=own.frequency * np.exp(rng.normal(0, error, none.size)),
        damping_ratio=np.clip(own.damping_ratio * np.exp(rng.normal(0, min(10 * error, 0.3), none.size)), 1e-4, 0.5),
        participation=none + 1,
        **dict.fromkeys(list(LEARNED_COLUMNS)[3:], none),
    )
    content = json.loads(scene.text)
    content["tail_beam"]["learned"] = rows_of(modes, LEARNED_COLUMNS)
    return parse_scene(content)


def with_drawings(scene: Scene, error: float, seed: int) -> Scene:
    """Return the scene with other measures of the beam and other places of rib and sensor."""
    content, rng = json.loads(scene.text), np.random.default_rng(seed)
    beam = content["tail_beam"]
    for part, name in ((beam, "length"), (beam, "width"), (beam, "thickness"), (beam["ribs"], "depth")):
        part[name] *= float(np.exp(rng.normal(0, error)))
    return parse_scene(content)


def accuracy(site: Scene, truth: Scene, n_train: int, n_test: int, seed: int) -> float:
    """Return the share of right answers on blows of the true beam, trained on the site alone."""
    model: Model = train(synthesise(site, n_train, 1000 + seed), beam=beam_of(site)).model
    rows = measure(synthesise(truth, n_test, 2000 + seed), model.measured, beam=model.beam.beam)
    probabilities = model.probabilities(rows.features[:, : len(model.features)])
    return float(np.mean(model.decide(probabilities) == rows.labels))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--start", type=float, nargs="+", default=[1.0, 3.0, 5.0], help="error of the frequencies [%%]")
    parser.add_argument("--shapes", type=float, default=0.0, help="error of the drawings instead [%%]")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--impacts", type=int, default=300)
    parser.add_argument("--signals", type=int, default=8000, help="to train on; 0 for none")
    parser.add_argument("--test", type=int, default=3072)
    options = parser.parse_args()
    scene = load_scene("tail_beam")
    nominal = beam_modes(scene).frequency
    heard = nominal < HEARD
    print("start  seed  freq. error below 10 kHz [%]   damping   covered      evidence a sample          s  accuracy")
    print("             median  90 %    largest       median    f.    d.   before   after  expected")
    for start in options.start:
        for seed in range(options.first, options.first + options.seeds):
            if options.shapes:
                truth = with_drawings(scene, options.shapes / 100, seed)
            else:
                truth = with_errors(scene, start / 100, seed)
            blows = np.concatenate([batch.signals for batch in synthesise(truth, options.impacts, 100 + seed)])
            begin = time.process_time()
            with threadpool_limits(1):
                try:
                    found = calibrate(
                        scene,
                        blows,
                        truth.sampling.sampling_rate,
                        truth.sampling.pre_trigger,
                        start_error=start / 100,
                        participation_error=0.2 * bool(options.shapes),
                        most_blows=options.impacts,
                    )
                except BadData as error:
                    print(f"{start:4g} %  {seed:>3}  refused: {error}", flush=True)
                    continue
                seconds = time.process_time() - begin
                own = found.learned
                text = " " * 52
                if not options.shapes:
                    true = truth.tail_beam.learned_modes
                    change = np.log(own.frequency / true.frequency)[heard]
                    damping = np.log(own.damping_ratio / true.damping_ratio)[heard]
                    covered = [
                        np.mean(np.abs(error) < 1.96 * bars[heard])
                        for error, bars in ((change, own.frequency_deviation), (damping, own.damping_ratio_deviation))
                    ]
                    size = 100 * np.abs(change)
                    text = (
                        f"{np.median(size):.4f}  {np.quantile(size, 0.9):.4f}  {size.max():7.3f}       "
                        f"{np.median(np.abs(damping)):.4f}  {covered[0]:.3f} {covered[1]:.3f}"
                    )
                right = accuracy(found.scene, truth, options.signals, options.test, seed) if options.signals else np.nan
            print(
                f"{start:4g} %  {seed:>3}  {text}  {found.before:7.3g} {found.after:7.4f} {found.expected:7.4f}   "
                f"{seconds:5.0f}  {right:.4f}",
                flush=True,
            )


if __name__ == "__main__":
    main()

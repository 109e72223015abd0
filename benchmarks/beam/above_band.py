"""Modes above the band: what one mode for all of them is worth where a beam is calibrated from its impacts.

    python benchmarks/beam/above_band.py [--seeds 600101] [--off 0] [--test 1536]

Rocks fall on a plate of finite elements (`independent_beam`) with modes up to 17 or up to 30 kHz, off by a relative
error. The shipped model looks through the stated beam and through what `calibrate` makes of 300 impacts, with and
without one mode at 20 kHz that has the static compliance of all modes of the scene above its band.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.beam import independent_beam as other
from benchmarks.beam.chain import VARIANT, asked
from benchmarks.beam.independent_modes import Beam as Plate
from benchmarks.beam.independent_modes import modes_of
from cgid.calibration import calibrate
from cgid.identification.prediction import load_model
from cgid.measure.modal.beam import Beam
from cgid.measure.modal.modes import Modes, NodeShapes, nodes
from cgid.scene import Scene, load_scene
from cgid.scene.synthesis.plan import highest_frequency
from cgid.scene.synthesis.through_beam import beam_of

#: The one mode [Hz], and how far the modes go that it stands for [Hz].
ONE, HIGHEST = 20e3, 59e3
#: Impacts that are learned from.
LEARNED = 300


def with_one(scene: Scene, beam: Beam) -> Beam:
    """Return a beam with one mode more for all modes of its scene above the band."""
    assert scene.panel is not None and scene.tail_beam is not None and scene.tail_beam.sensor_point is not None
    point = scene.tail_beam.sensor_point
    above = scene.panel.modes(HIGHEST).measured_at(point.x, point.y)
    part = above.frequency > highest_frequency(scene)
    _, n_x, n_y = beam.participation.shape
    sides = nodes(n_x, *beam.region[:2].tolist()), nodes(n_y, *beam.region[2:].tolist())
    x, y = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
    shape = above.participation(x, y)[:, part] @ np.square(ONE / above.frequency[part])
    own = beam.modes
    modes = Modes(
        frequency=np.append(own.frequency, ONE),
        damping_ratio=np.append(own.damping_ratio, np.median(own.damping_ratio)),
        at_impact=NodeShapes(np.concatenate([beam.participation, shape.reshape(1, n_x, n_y)]), beam.region),
        at_sensor=np.ones((1, own.frequency.size + 1)),
    )
    return replace(beam, modes=modes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[600_101])
    parser.add_argument("--off", type=float, default=0.0, help="error of the plate's frequencies")
    parser.add_argument("--test", type=int, default=1536, help="impacts to judge by")
    given = parser.parse_args()
    variant, model, scene = other.VARIANTS[VARIANT], load_model("default-acceleration"), load_scene("tail_beam")
    assert model.beam is not None
    print("| modes up to | seed | through | right | unknown | place | peak |\n|---|---|---|---|---|---|---|")
    for seed in given.seeds:
        for highest in (17e3, 30e3):
            modes = modes_of(replace(Plate(), ribs=variant.ribs, mindlin=variant.mindlin), highest)
            off = np.exp(np.random.default_rng(seed).normal(0, given.off, modes.frequency.size))
            made = other.generate(
                LEARNED + given.test, seed, VARIANT, modes=replace(modes, frequency=modes.frequency * off)
            )
            tests = {key: part[LEARNED:] if np.ndim(part) else part for key, part in made.items()}
            with threadpool_limits(1):
                found = calibrate(scene, made["acceleration"][:LEARNED], other.RATE, other.PRE_TRIGGER)
            learned = beam_of(found.scene)
            learned = replace(learned, modes=replace(learned.modes, deviation=None))
            for name, own, beam in (("stated", scene, model.beam.beam), ("calibrated", found.scene, learned)):
                for what, look in ((name, beam), (f"{name} and one", with_one(own, beam))):
                    told = asked(model, look, tests)
                    figures = f"{told['accuracy']:.3f} | {told['unknown']:.3f} | {1e3 * told['place']:.2f} mm"
                    row = f"| {highest / 1e3:g} kHz | {seed} | {what} | {figures} | {100 * told['peak']:.2f} % |"
                    print(row, flush=True)


if __name__ == "__main__":
    main()

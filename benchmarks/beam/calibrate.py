"""Modes of a beam learned from unlabelled impacts, and what a model trained through the learned beam is worth.

The beam of `tail_beam` with every natural frequency and damping ratio off by independent normal errors of their
logarithms strikes; the scene with the nominal beam learns from its blows, without labels. A model is then trained on
simulations through the learned beam alone, and asked about other blows of the true one. With --shapes the true beam
is that of other drawings instead, and its dimensions are learned first. With --unlearned nothing is learned: the
model trains on beams whose modes are drawn, and looks with and without their errors as noise. With --plates the true
beam is one of finite elements, not made by the package (`independent_beam`), and the shipped model looks through it:
from the plate's own modes with errors, as taps would tell them, and from the drawings, the scene itself.

    python benchmarks/beam/calibrate.py --start 1 3 5 --seeds 5 --impacts 300 --signals 8000
    python benchmarks/beam/calibrate.py --start 0.3 1 3 --seeds 5 --unlearned
    python benchmarks/beam/calibrate.py --start 1 --impacts 200 --plates "0.01 mindlin" "0.1 mindlin" plain
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from threadpoolctl import threadpool_limits

from cgid.calibration import calibrate
from cgid.calibration.learning import Heard, Learned
from cgid.calibration.modes import mean_evidence, prepare_impacts, uncertain
from cgid.errors import BadData
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model import Model
from cgid.identification.prediction import load_model
from cgid.identification.training import measure, train_on_specimens
from cgid.measure.modal.beam import Beam, corrected, gain
from cgid.measure.modal.modes import Modes, NodeShapes, nodes
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.file.sections import rows_of
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.through_beam import beam_of

#: Modes that a 10 kHz anti-alias filter passes [Hz].
HEARD = 10e3
#: Titles of what is known of them where the beam has the nominal one's dimensions.
ERRORS = [
    "frequency error, median / 90 % / largest",
    "damping error, median",
    "covered by own deviations (95 %): frequency, damping",
]


def with_errors(scene: Scene, error: float, seed: int) -> Scene:
    own, rng = beam_modes(scene), np.random.default_rng(seed)
    n = own.frequency.size
    frequency = own.frequency * np.exp(rng.normal(0, error, n))
    damping_ratio = np.clip(own.damping_ratio * np.exp(rng.normal(0, min(10 * error, 0.3), n)), 1e-4, 0.5)
    modes = Modes.relative(frequency, damping_ratio, np.ones(n))
    content = json.loads(scene.text)
    content["tail_beam"]["learned"] = rows_of(modes)
    return parse_scene(content)


def with_drawings(scene: Scene, error: float, seed: int) -> Scene:
    content, rng = json.loads(scene.text), np.random.default_rng(seed)
    beam = content["tail_beam"]
    for part, name in ((beam, "length"), (beam, "width"), (beam, "thickness"), (beam["ribs"], "depth")):
        part[name] *= float(np.exp(rng.normal(0, error)))
    return parse_scene(content)


def accuracy(site: Scene, truth: Scene, n_train: int, n_test: int, seed: int) -> float:
    model: Model = train_on_specimens(synthesise(site, n_train, 1000 + seed), beam=beam_of(site)).model
    rows = measure(synthesise(truth, n_test, 2000 + seed), model.measured, beam=model.beam.beam)
    probabilities = model.probabilities(rows.features[:, : len(model.features)])
    return float(np.mean(model.decide(probabilities) == rows.labels))


def unlearned(scene: Scene, error: float, options: argparse.Namespace) -> str:
    """Return a row: how often models that know only how far modes may be off are right on beams that are."""
    stated, cells = uncertain(scene, error), []
    own = beam_of(stated)
    for beam in (own, replace(own, modes=replace(own.modes, deviation=None))):
        model: Model = train_on_specimens(synthesise(stated, options.signals, 1000), beam=beam).model
        right, sure = [], []
        for seed in range(options.first, options.first + options.seeds):
            blows = synthesise(with_errors(scene, error, seed), options.test, 2000 + seed)
            rows = measure(blows, model.measured, beam=beam)
            likely = model.probabilities(rows.features[:, : len(model.features)])
            right.append(float(np.mean(model.decide(likely) == rows.labels)))
            sure.append(float(likely.max(axis=1).mean()))
        each = ", ".join(f"{one:.3f}" for one in right)
        cells.append(f"{np.mean(right):.3f} ({each}) | {np.mean(sure):.3f}")
    return f"| {100 * error:g} % | " + " | ".join(cells) + " |"


def plate_of(beam: Beam, variant: Any, most: int, apart: float, rng: np.random.Generator) -> tuple[Beam, Beam]:
    """Return a beam whose modes are the loudest of a plate, and one whose shapes are those of taps.

    Taps are so far apart [m], each off by 5 % of the shape's root mean square, with cubic splines between; with 0 the
    shapes are exact.
    """
    from benchmarks.beam import independent_beam as other

    modes = other.modes_for(variant)
    damping = other.damping_ratios(modes.frequency, variant.damping)
    sides = [nodes(n, *ends) for n, ends in zip(beam.participation.shape[1:], beam.region.reshape(2, 2), strict=True)]

    def shapes(x: Any, y: Any) -> Any:
        both = np.meshgrid(x, y, indexing="ij")
        return modes.shape(*(side.ravel() for side in both)).T.reshape(-1, x.size, y.size)

    at_sensor = modes.shape(*(np.array([place]) for place in other.SENSOR))[0]
    exact = shapes(*sides)
    loud = np.sqrt(np.mean(exact**2, axis=(1, 2))) * np.abs(at_sensor * gain(beam.filters, modes.frequency))
    kept = np.sort(np.argsort(-loud * modes.frequency)[:most])
    told = exact
    if apart:
        taps = [
            np.linspace(low, high, round((high - low) / apart) + 1) for low, high in beam.region.reshape(2, 2).tolist()
        ]
        seen = shapes(*taps)
        seen += 0.05 * np.sqrt(np.mean(seen**2, axis=(1, 2), keepdims=True)) * rng.standard_normal(seen.shape)
        told = np.array([RectBivariateSpline(*taps, own)(*sides) for own in seen])
    whole = [np.ascontiguousarray((at_sensor[:, None, None] * own)[kept]) for own in (exact, told)]
    first, second = (
        replace(
            beam,
            modes=Modes(
                frequency=modes.frequency[kept],
                damping_ratio=np.broadcast_to(damping, modes.frequency.shape)[kept],
                at_impact=NodeShapes(own, beam.region),
                at_sensor=np.ones((1, len(own))),
            ),
        )
        for own in whole
    )
    return first, second


def on_plates(options: argparse.Namespace) -> None:
    """Print a table of plates of finite elements, before and after calibration."""
    from benchmarks.beam import independent_beam as other
    from benchmarks.beam import through_beam

    model = load_model("default-acceleration")
    assert model.beam is not None
    beam, scene = model.beam.beam, load_scene("tail_beam")
    print(
        "| plate | start | frequency error below 10 kHz, median / 90 % | covered | evidence before / after / own modes "
        "| accuracy, place before | after | own modes | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in options.plates:
        made = other.generate(options.impacts + options.test, 555_000_001, name)
        blows = made["acceleration"][: options.impacts], other.RATE, other.PRE_TRIGGER
        tests = {key: part[options.impacts :] if np.ndim(part) else part for key, part in made.items()}

        def asked(own: Beam, tests: dict[str, Any] = tests) -> str:
            through = replace(model)
            through.__dict__["beam"] = ThroughBeam(own)
            found = through_beam.judged(through, through_beam.batches_of(tests))
            return f"{found['accuracy']:.3f}, {1e3 * found['place']:.1f} mm"

        exact, _ = plate_of(beam, other.VARIANTS[name], options.modes, 0.0, np.random.default_rng(0))
        best = asked(exact)
        for start in options.start:
            for apart in options.apart:
                told = f"its modes, {start:g} % off" + (f", taps {1e3 * apart:g} mm apart" if apart else "")
                row = from_its_modes(beam, name, start / 100, apart, blows, asked, options)
                print(f"| {name} | {told} | {row[0]} | {best} | {row[1]} |", flush=True)
        if options.drawings:
            row = from_drawings(scene, beam, options.drawings / 100, blows, asked)
            print(f"| {name} | drawings, {options.drawings:g} % | {row[0]} | {best} | {row[1]} |", flush=True)


def from_its_modes(
    beam: Beam,
    name: str,
    error: float,
    apart: float,
    recorded: Any,
    asked: Callable[[Beam], str],
    options: argparse.Namespace,
) -> tuple[str, str]:
    """Return the cells of a row: the plate's own modes with errors, and what blows make of them."""
    from benchmarks.beam import independent_beam as other

    rng = np.random.default_rng(options.first)
    exact, told = plate_of(beam, other.VARIANTS[name], options.modes, apart, rng)
    n = len(exact.poles)
    deviation = np.array([error, min(10 * error, 0.3), 0.2 if apart else 0.0])
    off = rng.normal(size=(3, n)) * deviation[:, None]
    off[2] = 0
    begun, blows = corrected(told, off), prepare_impacts(*recorded)
    clock = time.process_time()
    with threadpool_limits(1):
        found = Learned([Heard(begun, blows)], np.broadcast_to(deviation[:, None], (3, n)).copy())
        found.approach()
        found.settle()
    clock = time.process_time() - clock
    own = corrected(begun, found.correction)
    heard = np.abs(exact.poles) < 2 * np.pi * HEARD
    change = np.log(np.abs(own.poles) / np.abs(exact.poles))[heard]
    covered = np.mean(np.abs(change) < 1.96 * found.deviation[0, heard])
    middle, most = 100 * np.quantile(np.abs(change), [0.5, 0.9])
    evidence = " / ".join(f"{mean_evidence(one, blows, 0.2):.3g}" for one in (begun, own, exact))
    head = f"{middle:.3f} / {most:.3f} % | {covered:.2f} | {evidence} | {asked(begun)} | {asked(own)}"
    return head, f"{clock:.0f}"


def from_drawings(
    scene: Scene, beam: Beam, error: float, recorded: Any, asked: Callable[[Beam], str]
) -> tuple[str, str]:
    """Return the cells of a row: the scene itself calibrated with blows on the plate."""
    before, clock = asked(beam), time.process_time()
    try:
        # A tape tells the sides; stiffness follows from the rest.
        stiff = dict.fromkeys(("thickness", "ribs.depth", "ribs.thickness"), error)
        found = calibrate(scene, *recorded, participation_error=0.2, dimension_error=stiff)
    except BadData:
        return f"- | - | - | {before} | refused", "-"
    clock = time.process_time() - clock
    site = beam_of(found.scene)
    evidence = f"{found.before:.3g} / {found.after:.3g} / {found.expected:.3g}"
    after = asked(replace(beam, modes=replace(site.modes, deviation=beam.errors)))
    return f"- | - | {evidence} | {before} | {after}", f"{clock:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--start", type=float, nargs="+", default=[1.0, 3.0, 5.0], help="error of the frequencies [%%]")
    parser.add_argument("--shapes", type=float, default=0.0, help="error of the drawings instead [%%]")
    parser.add_argument("--alone", action="store_true", help="learn no dimensions, but modes and their participations")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--impacts", type=int, default=300)
    parser.add_argument("--signals", type=int, default=8000, help="to train on; 0 for none")
    parser.add_argument("--test", type=int, default=3072)
    parser.add_argument("--plates", nargs="+", default=[], help="variants of independent_beam")
    parser.add_argument("--modes", type=int, default=400, help="the loudest modes of a plate that are learned")
    parser.add_argument("--apart", type=float, nargs="+", default=[0.0], help="distance of taps on a plate [m]")
    parser.add_argument(
        "--drawings", type=float, default=2.0, help="start from drawings, too, this far off [%%]; 0: no"
    )
    parser.add_argument("--unlearned", action="store_true", help="learn nothing, say how far modes may be off")
    options = parser.parse_args()
    if options.plates:
        on_plates(options)
        return
    scene = load_scene("tail_beam")
    if options.unlearned:
        print("| modes off | errors as noise: accuracy (each beam) | confidence ", end="")
        print("| nominal modes as exact: accuracy (each beam) | confidence |\n|---|---|---|---|---|")
        for start in options.start:
            print(unlearned(scene, start / 100, options), flush=True)
        return
    head = ["drawing off by" if options.shapes else "start error", "seed"]
    head += [] if options.shapes else ERRORS
    head += ["evidence before / after / expected", "processor time", "accuracy", "exact"]
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for start in options.start:
        for seed in range(options.first, options.first + options.seeds):
            cells = learned(scene, start / 100, seed, options)
            cells += [""] * (len(head) - 2 - len(cells))
            print(f"| {options.shapes or start:g} % | {seed} | {' | '.join(cells)} |", flush=True)


def learned(scene: Scene, start: float, seed: int, options: argparse.Namespace) -> list[str]:
    """Return the cells of a row: a beam off the nominal one, and what its blows teach."""
    truth = with_drawings(scene, options.shapes / 100, seed) if options.shapes else with_errors(scene, start, seed)
    blows = np.concatenate([batch.signals for batch in synthesise(truth, options.impacts, 100 + seed)])
    begin = time.process_time()
    with threadpool_limits(1):
        try:
            found = calibrate(
                scene,
                blows,
                truth.sampling.sampling_rate,
                truth.sampling.pre_trigger,
                start_error=start,
                participation_error=0.2 * options.alone,
                dimension_error=0.0 if options.alone else options.shapes / 100,
                max_impacts=options.impacts,
            )
        except BadData as error:
            return [f"refused: {error}"]
        seconds = time.process_time() - begin
        cells = []
        if not options.shapes:
            own, true, heard = found.learned, truth.tail_beam.learned_modes, beam_modes(scene).frequency < HEARD
            frequency, damping = (
                np.log(getattr(own, name) / getattr(true, name))[heard] for name in ("frequency", "damping_ratio")
            )
            size = [100 * one for one in (*np.quantile(np.abs(frequency), [0.5, 0.9]), np.abs(frequency).max())]
            covered = [
                np.mean(np.abs(error) < 1.96 * bars[heard])
                for error, bars in zip((frequency, damping), own.deviation[:2], strict=True)
            ]
            cells += [f"{size[0]:.3f} / {size[1]:.3f} / {size[2]:.1f} %", f"{100 * np.median(np.abs(damping)):.1f} %"]
            cells.append(f"{covered[0]:.3f}, {covered[1]:.3f}")
        evidence = f"{found.before:.1f} / {found.after:.3f} / {found.expected:.3f}"
        right = (
            [accuracy(site, truth, options.signals, options.test, seed) for site in (found.scene, truth)]
            if options.signals
            else [np.nan, np.nan]
        )
    return [*cells, evidence, f"{seconds:.0f} s", *(f"{one:.3f}" for one in right)]


if __name__ == "__main__":
    main()

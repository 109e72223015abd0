"""Recorders, mountings and sensors that are not as stated: right answers, calibrated or not, and the warning.

Rocks fall on the beam of `independent_beam` (finite elements; skin and ribs as the package has them), whose recorder
has another filter, mounting or place than the scene says; its modes may be off as well. The shipped model looks through
the stated beam, through what `calibrate` makes of 300 unlabelled impacts, and through the true one. Nothing of the
package makes the signals.

    python benchmarks/beam/chain.py                      # every row
    python benchmarks/beam/chain.py --rows 3 --seed 7    # random chains alone, as many as that
    python benchmarks/beam/chain.py --sound 40           # sound calibrations, modes 1 % off: refused or moved
    python benchmarks/beam/chain.py --several            # two sensors together: one is moved, one has another filter
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import signal
from threadpoolctl import threadpool_limits

from benchmarks.beam import independent_beam as other
from benchmarks.beam.through_beam import batches_of, judged
from cgid.calibration import SiteCalibration, calibrate
from cgid.errors import BadData
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import load_model
from cgid.measure.features.vibration import VibrationBatch
from cgid.scene import load_scene, parse_scene
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.through_beam import beam_of, moved

#: The beam as the package has it, but for a thousandth of shear.
VARIANT = "0.001 mindlin"
#: Taps of the linear-phase filter, at so many times the sampling rate, and its edge in sampling rates.
_TAPS, _OVER, _FIR_EDGE = 257, 4, 0.4
#: Bands in which deviations of modes are compared with their errors [Hz].
_BANDS = (100.0, 2e3, 4e3, 7e3, 10e3)


@dataclass(frozen=True)
class Case:
    """What is true and not stated: filter, mounting, sensor, and the error of the modes."""

    name: str
    edge: float = 10e3
    order: int = 8
    mounting: float = 25e3
    sensor: tuple[float, float] = other.SENSOR
    modes: float = 0.0
    kind: str = "butterworth"


def cases(n_random: int, seed: int) -> Iterator[Case]:
    x, y = other.SENSOR
    yield Case("as stated")
    for millimetres in (10, 30):
        yield Case(f"sensor {millimetres} mm off", sensor=(x + 1e-3 * millimetres, y))
    for edge in (6e3, 8e3, 9e3, 11e3, 12e3):
        yield Case(f"edge {edge / 1e3:g} kHz", edge=edge)
    for mounting in (9e3, 12e3, 16e3, 40e3):
        yield Case(f"mounting {mounting / 1e3:g} kHz", mounting=mounting)
    for order in (4, 6):
        yield Case(f"order {order}", order=order)
    for share in (0.01, 0.03):
        yield Case(f"modes {100 * share:g} % off", modes=share)
    yield Case("edge 8 kHz, sensor 30 mm off", edge=8e3, sensor=(x, y + 0.03))
    yield Case("edge 8 kHz, modes 1 % off", edge=8e3, modes=0.01)
    yield Case("edge 12 kHz, mounting 14 kHz, sensor 20 mm off, modes 3 % off", 12e3, 8, 14e3, (x - 0.02, y), 0.03)
    yield Case("Bessel, 10 kHz", kind="bessel")
    yield Case("linear phase", kind="fir")
    random = np.random.default_rng(seed)
    for _ in range(n_random):
        edge, order = random.uniform(6e3, 12e3), int(random.integers(4, 9))
        mounting = float(np.exp(random.uniform(np.log(9e3), np.log(40e3))))
        yield Case(
            f"edge {edge / 1e3:.1f} kHz, order {order}, mounting {mounting / 1e3:.1f} kHz", edge, order, mounting
        )


def recorder_of(case: Case) -> Callable[[Any], Any]:
    """Return the gain of a recorder at points of the Laplace plane."""
    if case.kind == "butterworth":
        return partial(other.chain, mounting=(case.mounting, 0.05), edge=case.edge, order=case.order)
    if case.kind == "bessel":
        _, poles, gain = signal.bessel(case.order, 2 * np.pi * case.edge, analog=True, output="zpk", norm="mag")
    step = 1 / (_OVER * other.RATE)
    taps = signal.firwin(_TAPS, _FIR_EDGE * other.RATE, fs=_OVER * other.RATE, window=("kaiser", 10.0))

    def filtered(s: Any) -> Any:
        stiff = other.chain(s, mounting=(case.mounting, 0.05), edge=1e9, order=1)
        if case.kind == "bessel":
            return stiff * gain / np.prod(s[:, None] - poles, axis=1)
        # Its delay is cut off, as recorders do.
        late = (np.arange(_TAPS) - _TAPS // 2) * step
        return stiff * (np.exp(-s[:, None] * late) @ taps)

    return filtered


def modes_of_case(case: Case, seed: int) -> Any:
    modes = other.modes_for(other.VARIANTS[VARIANT])
    off = np.random.default_rng(seed).normal(0, case.modes, modes.frequency.size)
    return replace(modes, frequency=modes.frequency * np.exp(off)) if case.modes else modes


def made(case: Case, n: int, seed: int) -> dict[str, Any]:
    modes = modes_of_case(case, seed)
    return other.generate(n, seed, VARIANT, sensors=(case.sensor,), recorder=recorder_of(case), modes=modes)


def asked(model: StoredModel, beam: Any, tests: dict[str, Any]) -> dict[str, Any]:
    through = replace(model)
    through.__dict__["beam"] = ThroughBeam(beam)
    return judged(through, batches_of(tests))


def warned(model: StoredModel, signals: Any) -> float:
    """Return the median share of the forces outside of contacts [%]."""
    assert model.beam is not None
    _, contact = model.beam.look(VibrationBatch(signals.astype(float), other.RATE, other.PRE_TRIGGER))
    return 100 * float(np.nanmedian(contact.outside))


def row(case: Case, model: StoredModel, n: int, n_test: int, seed: int) -> str:
    """Return a row: right through the stated, the learned and the true beam."""
    assert model.beam is not None
    whole = made(case, n + n_test, seed)
    tests = {key: part[n:] if np.ndim(part) else part for key, part in whole.items()}
    scene, impacts = load_scene("tail_beam"), whole["acceleration"][:n]
    share = warned(model, impacts[:100])
    content = json.loads(scene.text)
    content["tail_beam"]["sensor_point"] = dict(zip("xy", case.sensor, strict=True))
    content["sensor"]["anti_alias"] = {"frequency": case.edge, "order": case.order}
    content["sensor"]["mounting"] = {"frequency": case.mounting, "damping_ratio": 0.05}
    best = "-"
    if case.kind == "butterworth" and not case.modes:
        best = f"{asked(model, replace(beam_of(parse_scene(content))), tests)['accuracy']:.3f}"
    clock, said = time.process_time(), ""
    with threadpool_limits(1):
        try:
            found = calibrate(
                scene, impacts, other.RATE, other.PRE_TRIGGER, start_error=max(case.modes, 0.01), max_impacts=n
            )
        except BadData as error:
            after, said = "refused", str(error).partition(":")[0][-40:]
        else:
            learned = beam_of(found.scene)
            told = asked(model, replace(learned, modes=replace(learned.modes, deviation=None)), tests)
            after = f"{told['accuracy']:.3f}"
            said = learned_of(found)
    clock = time.process_time() - clock
    before = asked(model, model.beam.beam, tests)
    cells = (
        case.name,
        f"{share:.1f} %",
        f"{before['accuracy']:.3f} ({before['unknown']:.2f})",
        *(after, best, said),
        f"{clock:.0f}",
    )
    return f"| {' | '.join(cells)} |"


def several(model: StoredModel, n: int, n_test: int, seed: int) -> list[str]:
    """Return rows of two sensors of one beam, calibrated together, modes 1 % off: one by one through their scenes."""
    x, y = other.SENSOR
    stated = (other.SENSOR, (0.7, 0.8))
    true = (Case("10 mm off", sensor=(x + 0.01, y)), Case("edge 8 kHz", edge=8e3, sensor=stated[1]))
    modes = modes_of_case(Case("modes", modes=0.01), seed)
    made_by = [
        other.generate(n + n_test, seed, VARIANT, sensors=[one.sensor for one in true], recorder=recorder, modes=modes)
        for recorder in map(recorder_of, true)
    ]
    heard = np.stack([made_by[number]["acceleration"][:, number] for number in range(2)], axis=1)
    scene, clock = load_scene("tail_beam"), time.process_time()
    with threadpool_limits(1):
        found = calibrate(scene, heard[:n], other.RATE, other.PRE_TRIGGER, sensors=stated, max_impacts=n)
    clock = time.process_time() - clock
    rows = []
    for number, one in enumerate((found, *found.others)):
        tests = {key: part[n:] if np.ndim(part) else part for key, part in made_by[number].items()}
        tests["acceleration"] = heard[n:, number]
        learned = beam_of(one.scene)
        beams = beam_of(moved(scene, stated[number])), replace(learned, modes=replace(learned.modes, deviation=None))
        before, after = (asked(model, beam, tests)["accuracy"] for beam in beams)
        rows.append(f"| {true[number].name} | {before:.3f} | {after:.3f} | {learned_of(one)} | {clock:.0f} |")
    return rows


def learned_of(found: SiteCalibration) -> str:
    """Return what a calibration has moved: location [mm], mounting and filter."""
    moves = [f"{one.name[-1]} {1e3 * (one.after - one.before):+.1f} mm" for one in found.dimensions]
    chain = [(name.rpartition(".")[0][:4], new) for name, (_, new) in found.chain.items()]
    return ", ".join(moves + [f"{name} {new:.4g}" for name, new in chain if isinstance(new, float | int)])


def sound(n: int, seed: int) -> str:
    """Return a row of a sound calibration: what was moved or refused, and how the modes hold, by band."""
    case = Case("as stated", modes=0.01)
    clock, scene, truth = time.process_time(), load_scene("tail_beam"), modes_of_case(case, seed)
    impacts = made(case, n, seed)["acceleration"]
    with threadpool_limits(1):
        try:
            found = calibrate(scene, impacts, other.RATE, other.PRE_TRIGGER, max_impacts=n)
        except BadData as error:
            return f"| {seed} | refused: {str(error)[:60]} | | | {time.process_time() - clock:.0f} |"
    changed = [one.name for one in found.dimensions] + list(found.chain)
    own = found.scene.tail_beam
    assert own is not None and own.learned_modes is not None
    frequency = beam_modes(found.scene).frequency
    # The same modes by their shapes: neighbours swap between the two computations.
    x, y, at = beam_of(scene).grid(0.05)
    shape = truth.shape(x, y)
    alike = (at / np.linalg.norm(at, axis=0)).T @ (shape / np.linalg.norm(shape, axis=0))
    change = np.log(frequency / truth.frequency[np.abs(alike).argmax(axis=1)])
    held = np.abs(change) < 1.96 * own.learned_modes.deviation[0]
    cells = [f"{np.mean(held[(frequency >= low) & (frequency < high)]):.2f}" for low, high in pairwise(_BANDS)]
    said = ", ".join(changed) or "kept"
    return f"| {seed} | {said} | {100 * found.outside:.1f} % | {', '.join(cells)} | {time.process_time() - clock:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=4, help="random chains")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--sound", type=int, default=0, help="so many sound calibrations instead")
    parser.add_argument("--several", action="store_true", help="two sensors calibrated together instead")
    parser.add_argument("--seed", type=int, default=600_001)
    parser.add_argument("--impacts", type=int, default=300)
    parser.add_argument("--test", type=int, default=768)
    options = parser.parse_args()
    if options.sound:
        print("| seed | moved | outside of contacts | deviations hold (0.1, 2, 4, 7, 10 kHz) | s |")
        print("|---|---|---|---|---|")
        for number in range(options.sound):
            print(sound(options.impacts, options.seed + number), flush=True)
        return
    model = load_model("default-acceleration")
    if options.several:
        print("| true | right, stated | after | learned | s |\n|---|---|---|---|---|")
        print("\n".join(several(model, options.impacts, options.test, options.seed)))
        return
    print("| true | force outside of contacts | right, stated (unknown) | after | true beam | learned | s |")
    print("|---|---|---|---|---|---|---|")
    chosen = [case for case in cases(options.rows, options.seed) if options.only in case.name]
    for number, case in enumerate(chosen):
        print(row(case, model, options.impacts, options.test, options.seed + number), flush=True)


if __name__ == "__main__":
    main()

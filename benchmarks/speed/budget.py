"""The run-time budget of a signal [us], from parameters to the disk and to the answer.

    python benchmarks/speed/budget.py [SCENE] [--signals N]
    python benchmarks/speed/budget.py --skipping 100000       # that work which a scene does not need is skipped

Every stage is timed alone on the same blocks of 256 signals of the scene, of which four are drawn at once as in
`synthesise`: one thread, best of several rounds. The last column is its share of the time to make a signal. Prints
Markdown.

`--skipping` prints the times of parameters, closed forms, features and frames of the same N impacts of the reference
scene (nothing is written to the disk). Times are processor times, which depend less on the load of the machine.
"""

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.training.rows import DEFAULT_FEATURES
from cgid.measure.features.extraction import FEATURES, choose, extract_array
from cgid.measure.filters import fft_filter
from cgid.physics import HertzRangeWarning
from cgid.scene import generate, load_scene, plan
from cgid.scene.synthesis.draws import BLOCK, at_once
from cgid.scene.synthesis.impacts import pulses_of_block
from cgid.scene.synthesis.noise import add_noise
from cgid.scene.synthesis.synthesis import TOGETHER, columns_of, make_frames, synthesise

ROUNDS = 7


def microseconds(work: Callable[[], object], n_signals: int, rounds: int = ROUNDS) -> float:
    """Return the best time of several rounds, for one signal [us]."""
    work()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times) / n_signals * 1e6


def print_times(n_signals: int) -> None:
    scene = load_scene(shipped.scene_path("reference"))
    questions: dict[str, Callable[[], object]] = {
        "parameters": lambda: _exhaust(columns_of(plan(scene, "parameters"), n_signals)),
        "closed forms": lambda: _exhaust(columns_of(plan(scene, "closed-form"), n_signals)),
        "true pulses": lambda: _exhaust(synthesise(scene, n_signals, output="pulses")),
        "frames": lambda: _exhaust(synthesise(scene, n_signals)),
        "features: peak_force, no frames kept": lambda: _exhaust(
            columns_of(plan(scene, "features", features=["peak_force"]), n_signals)
        ),
        "features: of the model, no frames kept": lambda: _exhaust(
            columns_of(plan(scene, "features", features=DEFAULT_FEATURES), n_signals)
        ),
        "features of the model, from frames": lambda: [
            extract_array(batch.signals, batch.sampling_rate, DEFAULT_FEATURES, pre_trigger=batch.pre_trigger)
            for batch in synthesise(scene, n_signals)
        ],
    }
    print(f"| asked of {n_signals} impacts | s | us per impact |\n|---|---|---|")
    _exhaust(columns_of(plan(scene, "features"), BLOCK))  # imports and compiles
    for name, ask in questions.items():
        start = time.process_time()
        ask()
        seconds = time.process_time() - start
        print(f"| {name} | {seconds:.2f} | {seconds / n_signals * 1e6:.2f} |")


def _exhaust(batches: object) -> None:
    for _ in batches:  # type: ignore[attr-defined]
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="reference")
    parser.add_argument("--signals", type=int, default=16384, help="for the whole way to the disk")
    parser.add_argument("--skipping", type=int, metavar="N", help="what N impacts cost by what is asked of them")
    arguments = parser.parse_args()
    if arguments.skipping:
        print_times(arguments.skipping)
        return
    warnings.simplefilter("ignore", HertzRangeWarning)
    scene = load_scene(shipped.scene_path(arguments.scene))
    rate, pre_trigger = scene.sampling.sampling_rate, scene.sampling.pre_trigger
    asked, together = plan(scene), at_once(scene, TOGETHER)
    drawn = pulses_of_block(asked, 0, 0)
    frames = make_frames(drawn, 0, 0, np.float32)
    peak = drawn.parameters["peak_force"]
    silence, level = np.zeros_like(frames), scene.sensor.noise_level(peak, rate)
    model = StoredModel.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    table = extract_array(frames, rate, model.measured, pre_trigger=pre_trigger, invalid="nan")
    table = table[np.isfinite(table).all(axis=1)]
    features, guards = np.split(table, [len(model.features)], axis=1)

    def measured(*names: str) -> Callable[[], object]:
        return lambda: extract_array(frames, rate, names or None, pre_trigger=pre_trigger, invalid="nan")

    making = {
        "parameters": lambda: pulses_of_block(asked, 0, 0, together),
        "pulse": lambda: drawn.add_to_frames(frames),
        "noise": lambda: add_noise(silence, level, 0, 0),
        "sensor (range, bits; nothing when off)": lambda: scene.sensor.digitise(frames, rate, peak),
    }
    using = {
        "FFT filter": lambda: fft_filter(frames, rate, high=rate / 10),
        "feature: peak_force alone": measured("peak_force"),
        "features read off the samples, in time (13)": measured(*tuple(FEATURES)[:13]),
        "features of the model: the fitted pulse": measured(*model.measured),
        f"all features of a pulse ({len(choose(None))})": measured(),
        "probabilities and novelty": lambda: (model.probabilities(features), model.novelty(features, guards)),
    }
    cost = {name: microseconds(work, BLOCK) for name, work in (making | using).items()}
    cost["parameters"] /= together
    # The signals of a batch share the overhead of the fit.
    many = np.concatenate([batch.signals for batch in synthesise(scene, 2048)])
    fitted = partial(extract_array, many, rate, model.measured, pre_trigger=pre_trigger, invalid="nan")
    cost["features of the model, 2048 signals at once"] = microseconds(fitted, len(many))
    with tempfile.TemporaryDirectory() as folder:
        whole = microseconds(
            lambda: generate(scene, Path(folder) / "data", arguments.signals, overwrite=True), arguments.signals, 3
        )
    cost["HDF5, checksums, SHA-256, disk"] = whole - sum(cost[name] for name in making)
    print(f"Scene `{scene.name}`, {scene.sampling.samples} float32 samples a signal, one thread.\n")
    print("| making a signal | us | share |\n|---|---|---|")
    for name in (*making, "HDF5, checksums, SHA-256, disk"):
        print(f"| {name} | {cost[name]:.1f} | {cost[name] / whole:.0%} |")
    print(f"| **whole** ({1e6 / whole:.0f} signals/s) | {whole:.1f} | |")
    print("\n| using a signal | us |\n|---|---|")
    for name in (*using, "features of the model, 2048 signals at once"):
        print(f"| {name} | {cost[name]:.1f} |")


if __name__ == "__main__":
    main()

"""What a scene does not need is not done: counters of some scenes, and the time that it saves.

    python benchmarks/skipping.py [--signals N]
    python benchmarks/skipping.py --unit-costs

Prints Markdown. The first form counts, for some signals of each scene, what ran for what was asked beside what
making and measuring everything takes, and times parameters, closed forms, features and frames of the same N impacts of
the reference scene (nothing is written to the disk). The second measures `cgid.scene.costs.UNIT_COSTS`. Times are
those of the processor, which a busy machine lengthens less.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cgid import shipped
from cgid.counting import counted
from cgid.identification.rows import DEFAULT_FEATURES
from cgid.measure.features import FEATURES, extract_array
from cgid.measure.filters import fft_filter
from cgid.physics.driving import windows_of
from cgid.scene import generate, load_scene, synthesise
from cgid.scene.background import BackgroundSection
from cgid.scene.background_noise import Background
from cgid.scene.generation import tabulate
from cgid.scene.noise import add_noise
from cgid.scene.plan import plan
from cgid.scene.population import draw, given
from cgid.scene.randomness import BLOCK
from cgid.scene.response import TOLERANCE, Hearing, beam_modes, hearing
from cgid.scene.sensor import Sensor, clip
from cgid.scene.stream.arrivals import arrivals_of
from cgid.scene.stream.rocks import arriving, thrown_back
from cgid.scene.synthesis import add_pulses
from cgid.scene.tables import columns_of

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.plan_scenes import CASES, COUNTED, PANEL, TAP, beam_of, named, scene_of

ROUNDS = 7


def print_counts() -> None:
    """Print what ran for each scene, and of how much."""
    print(f"| scene and what is asked ({COUNTED} signals) | what ran / what everything takes |\n|---|---|")
    for case in CASES:
        asked, everything = case.ask(), case.ask_everything()
        parts = [f"{name.replace('_', ' ')} {asked[name]} / {number}" for name, number in sorted(everything.items())]
        print(f"| {case.name} | {', '.join(parts)} |")


def print_times(n_signals: int) -> None:
    """Print how long different questions about the same impacts take."""
    scene = load_scene(shipped.scene_path("reference"))
    questions: dict[str, Callable[[], object]] = {
        "parameters": lambda: _exhaust(columns_of(plan(scene, ["parameters"]), n_signals)),
        "closed forms": lambda: _exhaust(columns_of(plan(scene, ["closed-form"]), n_signals)),
        "true pulses": lambda: _exhaust(synthesise(scene, n_signals, outputs=["pulses"])),
        "frames": lambda: _exhaust(synthesise(scene, n_signals)),
        "features: peak_force, no frames kept": lambda: _exhaust(
            columns_of(plan(scene, ["features"], features=["peak_force"]), n_signals)
        ),
        "features: of the model, no frames kept": lambda: _exhaust(
            columns_of(plan(scene, ["features"], features=DEFAULT_FEATURES), n_signals)
        ),
        "features of the model, from frames": lambda: [
            extract_array(batch.signals, batch.sampling_rate, DEFAULT_FEATURES, pre_trigger=batch.pre_trigger)
            for batch in synthesise(scene, n_signals)
        ],
    }
    print(f"\n| asked of {n_signals} impacts | s | us per impact |\n|---|---|---|")
    _exhaust(columns_of(plan(scene, ["features"]), BLOCK))  # loads and compiles
    for name, ask in questions.items():
        start = time.process_time()
        ask()
        seconds = time.process_time() - start
        print(f"| {name} | {seconds:.2f} | {seconds / n_signals * 1e6:.2f} |")


def _exhaust(batches: object) -> None:
    for _ in batches:  # type: ignore[attr-defined]
        pass


def best(work: Callable[[], object], number: float) -> float:
    """Return the best time of several rounds over a number of units [us]."""
    work()
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times) / number * 1e6


def print_unit_costs() -> None:
    """Print the table of unit costs."""
    scene, frames = scene_of(), np.zeros((BLOCK, 2048), np.float32)
    plate = named("gravity and a thin plate").scene
    taps = scene_of(populations=[], taps=[TAP])
    drawn, on_plate, tapped = draw(scene, 0, 0), draw(plate, 0, 0), draw(taps, 0, 0)
    falls = given(scene, 0, 0)
    level = np.ones(BLOCK)
    rate = scene.sampling.sampling_rate
    n_contact = float(np.sum(drawn.parameters["contact_duration"]) * rate)
    dense = scene_of(sampling={"sampling_rate": 800e3, "samples": 8192, "pre_trigger": 128})
    drawn_dense, dense_frames = draw(dense, 0, 0), np.zeros((BLOCK, 8192), np.float32)
    n_dense = float(np.sum(drawn_dense.parameters["contact_duration"]) * 800e3)

    def derived(*names: str, of: object = falls) -> Callable[[], object]:
        def work() -> None:
            impact = of.impact  # type: ignore[attr-defined]
            for name in names:
                getattr(impact, name)

        return work

    costs = {"parameters": best(lambda: given(scene, 0, 0), BLOCK)}
    alone = best(derived("impulse"), BLOCK)
    costs["closed form"] = (best(derived("impulse", "contact_duration"), BLOCK) - alone) / 1
    damped = best(lambda: drawn.impact.curves.taken(np.arange(BLOCK)).damping, BLOCK)
    costs["damping solve"] = damped
    costs["impact"] = alone
    costs["integrated impact"] = best(derived("restitution", of=given(plate, 0, 0)), BLOCK)
    few, many = best(lambda: add_pulses(frames, plan(scene), drawn), BLOCK), 0.0
    many = best(lambda: add_pulses(dense_frames, plan(dense), drawn_dense), BLOCK)
    costs["pulse sample"] = (many - few) / ((n_dense - n_contact) / BLOCK)
    costs["pulse"] = few - costs["pulse sample"] * n_contact / BLOCK
    costs["integrated pulse"] = best(lambda: add_pulses(frames, plan(plate), on_plate), BLOCK)
    costs["tap"] = best(lambda: add_pulses(frames, plan(taps), tapped), BLOCK)
    costs |= beam_costs() | stream_costs() | background_costs()
    costs["frame sample"] = best(lambda: np.zeros(frames.shape, np.float32).fill(0), frames.size)
    costs["noise sample"] = best(lambda: add_noise(frames, level, 0, 0), frames.size)
    costs["filtered sample"] = best(lambda: fft_filter(frames, rate, high=40e3, taper=0.5), frames.size)
    costs["clipped sample"] = best(lambda: clip(frames, level), frames.size)
    sensor = Sensor(range=1e5, bits=16)
    costs["digitised sample"] = best(lambda: sensor.digitise(frames, rate), frames.size)
    signals = np.concatenate([batch.signals for batch in synthesise(scene, 1024)])[:, :700]
    kinds = {"features in time": tuple(FEATURES)[:13], "fit": DEFAULT_FEATURES}
    for name, features in kinds.items():
        costs[name] = best(
            lambda features=features: extract_array(signals, rate, features, pre_trigger=128), len(signals)
        )
    one = best(lambda: extract_array(signals, rate, ["contact_duration"], pre_trigger=128), len(signals))
    spectral = [name for name, feature in FEATURES.items() if feature.spectral]
    costs["spectrum"] = best(lambda: extract_array(signals, rate, spectral, pre_trigger=128), len(signals)) - one
    vibrations = named("features of measured modes, one silent").scene
    (felt,), measured = synthesise(vibrations, BLOCK), plan(vibrations, ["features"]).request.features
    costs["vibrations"] = best(lambda: extract_array(felt.signals, felt.sampling_rate, measured, pre_trigger=64), BLOCK)
    with tempfile.TemporaryDirectory() as folder:
        n = 8192
        whole = best(lambda: generate(scene, Path(folder) / "data", n, overwrite=True), n)
        made = best(lambda: _exhaust(synthesise(scene, n)), n)
        costs["stored byte"] = (whole - made) / 8192
        asked = plan(scene, ["parameters"])
        written = best(lambda: tabulate(asked, Path(folder) / "table.h5", n, overwrite=True), n)
        kept = best(lambda: _exhaust(columns_of(asked, n)), n)
        costs["column"] = (written - kept) / len(asked.request.column_units)
    for name, cost in costs.items():
        print(f'    "{name}": {cost:.2g},')


def beam_costs() -> dict[str, float]:
    """Return what the modes of a beam cost: in the contact itself, when they are struck, and as they ring."""
    # So little damped that all modes ring until the end of the longer frames.
    panel = {**PANEL, "damping_ratio": 0.001, "coupling": "impedance"}
    scenes = [beam_of(panel, samples=samples) for samples in (1024, 4096)]
    drawn = draw(scenes[0], 0, 0)
    n_modes = beam_modes(scenes[0]).frequency.size
    times, rung = [], []
    for scene in scenes:
        heard = hearing(scene)
        frames = np.zeros((BLOCK, scene.sampling.samples), np.float32)

        def respond(heard: Hearing = heard, frames: NDArray[np.float32] = frames) -> None:
            for strike in drawn.strikes:
                strike.add_response(frames, heard, drawn.parameters)

        times.append(best(respond, BLOCK))
        with counted() as counts:
            respond()
        rung.append(counts["mode_samples"] / BLOCK)
    sample = (times[1] - times[0]) / (rung[1] - rung[0])
    rate = scenes[0].sampling.sampling_rate
    force = best(lambda: [windows_of(strike.pulses, strike.onset, rate, TOLERANCE) for strike in drawn.strikes], BLOCK)
    coupled = beam_of({**PANEL, "coupling": "modes"})
    solved = best(lambda: draw(coupled, 0, 0), BLOCK)
    return {
        "coupled mode": solved / n_modes,
        "struck mode": (times[0] - sample * rung[0] - force) / n_modes,
        "mode sample": sample,
    }


def stream_costs() -> dict[str, float]:
    """Return what it costs to draw a rock of a stream beyond its numbers, and to throw it back."""
    scene = load_scene(shipped.scene_path("caving"))
    stretch = next(arrivals_of(scene.stream).stretches(scene.stream.duration, 0, 0))
    rocks = arriving(scene, stretch, 0, 0, 0)
    everyone, half = np.ones(len(rocks), bool), np.full(len(rocks), 0.5)
    return {
        "arrival": best(lambda: arriving(scene, stretch, 0, 0, 0), len(rocks)),
        "flight": best(lambda: thrown_back(scene, rocks, half, 0 * half, everyone), len(rocks)),
    }


def background_costs() -> dict[str, float]:
    """Return what a sample of each kind of background costs."""
    hum = BackgroundSection.model_validate({"hum": [{"frequency": 50, "amplitude": 1}]})
    noise = {"frequencies": [2, 2000], "density": [1, 1]}
    coloured = BackgroundSection.model_validate({"coloured": noise})
    recorded = np.ones(1 << 20)
    kinds = {
        "hum sample": Background(hum, "force", 25600.0, None),
        "coloured sample": Background(coloured, "force", 25600.0, None),
        "recorded sample": Background(hum, "force", 25600.0, recorded, 1.0),
    }
    costs = {name: best(lambda one=one: one.in_frames(0, 0, 2048), BLOCK * 2048) for name, one in kinds.items()}
    return costs | {"recorded sample": costs["recorded sample"] - costs["hum sample"]}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=100_000)
    parser.add_argument("--unit-costs", action="store_true")
    arguments = parser.parse_args()
    if arguments.unit_costs:
        print_unit_costs()
        return
    print_counts()
    print_times(arguments.signals)


if __name__ == "__main__":
    main()

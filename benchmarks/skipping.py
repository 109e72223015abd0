"""Work that a scene does not need is skipped: counters of some scenes, and the saved time.

    python benchmarks/skipping.py [--signals N]

Prints Markdown: for some signals of each scene, the work done for the requested outputs against that for all outputs;
and the times of parameters, closed forms, features and frames of the same N impacts of the reference scene (nothing is
written to the disk). Times are processor times, which depend less on the load of the machine.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from cgid import shipped
from cgid.identification.rows import DEFAULT_FEATURES
from cgid.measure.features import extract_array
from cgid.scene import load_scene, synthesise
from cgid.scene.draws import BLOCK
from cgid.scene.plan import plan
from cgid.scene.synthesis import columns_of

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.plan_scenes import CASES, COUNTED


def print_counts() -> None:
    """Print the work done for each scene, and the work for everything."""
    print(f"| scene and what is asked ({COUNTED} signals) | what ran / what everything takes |\n|---|---|")
    for case in CASES:
        asked, everything = case.ask(), case.ask_everything()
        parts = [f"{name.replace('_', ' ')} {asked[name]} / {number}" for name, number in sorted(everything.items())]
        print(f"| {case.name} | {', '.join(parts)} |")


def print_times(n_signals: int) -> None:
    """Print the times of different requests for the same impacts."""
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
    print(f"\n| asked of {n_signals} impacts | s | us per impact |\n|---|---|---|")
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
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--signals", type=int, default=100_000)
    arguments = parser.parse_args()
    print_counts()
    print_times(arguments.signals)


if __name__ == "__main__":
    main()

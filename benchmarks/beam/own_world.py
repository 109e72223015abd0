"""When a recording that is not of a model's world is told: false alarms of its own world, seconds to the alarm else.

    python benchmarks/beam/own_world.py [--own 200] [--streams 6] [--rows wet "gain 2" ...]

Recordings of 60 s of streams like `caving`, with fractions of gangue of 0 to 1, other rates, points, noise; of the own
world as they are, else of another seam, gain, point of the sensor or beam. The streams of "finite elements" are those
of `benchmarks/beam/anchor.py`, which shares no code with `cgid`: another beam, with the shipped seam
and the wet one. With seeds that made no model.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam.anchor import SEAMS, stream
from benchmarks.beam.independent_beam import RATE
from cgid import load_model, shipped
from cgid.identification.model.model import Model
from cgid.identification.model.world import Misfit
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.learning.streams import variations
from cgid.scene import load_scene, parse_scene
from cgid.scene.synthesis.stream import record

Floats = NDArray[np.float64]
SEED, DURATION = 8102, 60.0
Change = Callable[[dict[str, Any]], object]


def seam(
    coal: float = 3.1,
    gangue: float = 10.0,
    radius: tuple[float, float] = (0.01, 0.08),
    fall: tuple[float, float] = (0.5, 3.0),
    gangue_radius: tuple[float, float] | None = None,
) -> Change:
    """Return the change to a seam of moduli [GPa], radii and falls [m]."""

    def change(content: dict[str, Any]) -> None:
        for population, modulus, own in zip(
            content["populations"], (coal, gangue), (radius, gangue_radius or radius), strict=True
        ):
            population["youngs_modulus"]["median"] = f"{modulus} GPa"
            for name, (low, high) in {"radius": own, "drop_height": fall}.items():
                population[name].update(lowest=f"{low} m", highest=f"{high} m")

    return change


def beam(**changed: Any) -> Change:
    """Return the change of keys of the beam."""
    return lambda content: content["tail_beam"].update(changed)


ROWS: dict[str, tuple[Change, float]] = {  # change of the scene, gain
    "own": (lambda content: None, 1.0),
    "wet": (seam(1.8, 5.5), 1.0),
    "hard": (seam(4.5, 22.0), 1.0),
    "large": (seam(radius=(0.05, 0.15)), 1.0),
    "large, wet": (seam(1.8, 5.5, (0.05, 0.15)), 1.0),
    "large, hard": (seam(4.5, 22.0, (0.05, 0.15)), 1.0),
    "small, low falls": (seam(radius=(0.008, 0.04), fall=(0.2, 1.2)), 1.0),
    "gangue larger": (seam(gangue_radius=(0.015, 0.12)), 1.0),
    "gain 2": (lambda content: None, 2.0),
    "gain 5": (lambda content: None, 5.0),
    "gain 9.81": (lambda content: None, 9.81),
    "sensor 30 mm off": (beam(sensor_point={"x": "0.53 m", "y": "0.45 m"}), 1.0),
    "beam 20 mm longer": (beam(length="1.62 m"), 1.0),
    "beam 25 mm thick": (beam(thickness="25 mm"), 1.0),
}
#: Seams of finite elements.
OTHERS = {"finite elements": SEAMS["shipped"], "finite elements, wet": SEAMS["wet"]}


def recordings(row: str, n: int) -> Iterator[tuple[Floats, float]]:
    """Yield samples [m/s^2] and sampling rates of a row."""
    if row in OTHERS:
        for k in range(n):
            yield stream(OTHERS[row], DURATION, (k + 0.5) / n, 1000 * SEED + k)[0], RATE
        return
    change, gain = ROWS[row]
    for k, scene in enumerate(variations(load_scene(shipped.scene_path("caving")), n, SEED + list(ROWS).index(row))):
        content = json.loads(scene.text)
        change(content)
        signal, _ = record(parse_scene(content | {"name": row}), SEED, k)
        yield gain * signal.samples, signal.sampling_rate


def told(samples: Floats, rate: float, model: Model) -> tuple[float, Misfit | None]:
    """Return when a recording is told [s], and what of it."""
    diagnosis = Diagnosis(model)
    for step in identify_blocks([samples[None]], rate, model, ("1",), PredictionSettings()):
        for answer in step.answers:
            diagnosis.add((answer,))
            if diagnosis.misfits:
                return answer.time, diagnosis.misfits["1"]
    return np.inf, None


def line(row: str, found: list[tuple[float, Misfit | None]]) -> str:
    """Return a row of the table."""
    times = np.array([time for time, _ in found])
    parts = Counter(
        " or ".join(str(one.part) for one in (misfit, *misfit.others)) for _, misfit in found if misfit is not None
    )
    factors = [misfit.factor for _, misfit in found if misfit is not None and np.isfinite(misfit.factor)]
    alarms = times[np.isfinite(times)]
    cells = [
        row,
        f"{alarms.size} of {times.size}",
        f"{np.median(alarms):.0f} ({alarms.min():.0f} to {alarms.max():.0f})" if alarms.size else "-",
        ", ".join(f"{part} {count}" for part, count in parts.most_common()) or "-",
        f"{np.median(factors):.2f}" if factors else "-",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("--own", type=int, default=200, help="recordings of the own world")
    parser.add_argument("--streams", type=int, default=6, help="recordings of each other row")
    parser.add_argument("--rows", nargs="+", choices=[*ROWS, *OTHERS], default=[*ROWS, *OTHERS], metavar="ROW")
    given = parser.parse_args()
    model = load_model(given.model)
    print("| recordings of 60 s | told | after, median (range) [s] | what | factor |\n|---|---|---|---|---|")
    for row in given.rows:
        n = given.own if row == "own" else given.streams
        print(line(row, [told(samples, rate, model) for samples, rate in recordings(row, n)]), flush=True)


if __name__ == "__main__":
    main()

"""Make sample.csv again: six impacts of the reference scene in one recording of 120 ms.

    python datasets/make_sample.py

The impacts are drawn from the reference scene (a seed that no shipped model was trained with), three of each
label, with peaks that one sensor of 50 kN can hold. The truth is printed, and stands in datasets/README.md.
"""

from pathlib import Path

import numpy as np

from cgid.physics import Impact
from cgid.scene import load_scene
from cgid.scene.impacts import draw

SEED, SAMPLING_RATE, SPACING = 20180917, 200e3, 0.020
NOISE = 25.0  # N, the sensor's own
HERE = Path(__file__).parent


def force_of(impact: Impact, row: int, times: np.ndarray) -> np.ndarray:
    """Return the force of one of many impacts over time [N]."""
    return impact.force(np.broadcast_to(times, (len(impact.peak_force), times.size)))[row]


def main() -> None:
    """Write sample.csv beside this file and print the truth."""
    drawn = draw(load_scene(HERE / "reference.toml"), SEED, 0)
    peak = drawn.parameters["peak_force"]
    fitting = np.flatnonzero((peak > 4e3) & (peak < 40e3))
    coal = [row for row in fitting if drawn.labels[row] == "coal"][:3]
    gangue = [row for row in fitting if drawn.labels[row] == "gangue"][:3]
    order = [row for pair in zip(coal, gangue, strict=True) for row in pair]
    times = np.arange(round(len(order) * SPACING * SAMPLING_RATE)) / SAMPLING_RATE
    force = np.random.default_rng(SEED).normal(0, NOISE, times.size)
    for number, row in enumerate(order):
        onset = (number + 0.25) * SPACING
        force += force_of(drawn.impact, row, times - onset)
        radius, e = drawn.parameters["radius"][row], drawn.parameters["restitution"][row]
        print(f"{onset * 1e3:5.1f} ms  {drawn.labels[row]:<7} R {radius * 1e3:4.1f} mm  e {e:.2f}  {peak[row]:6.0f} N")
    lines = [f"# sampling_rate: {SAMPLING_RATE:g} Hz", "force (N)", *(f"{value:.0f}" for value in force)]
    (HERE / "sample.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

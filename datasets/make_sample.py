"""Make sample.csv and sample_acceleration.csv again: six impacts each, in recordings of 120 and 480 ms.

    python datasets/make_sample.py

The second holds six impacts of the scene tail_beam one after the other, 80 ms each, as its accelerometer records them.
The impacts of the first are drawn from the reference scene (a seed that no shipped model was trained with), three of
each label, with peaks that one sensor of 50 kN can hold. The truth is printed, and stands in datasets/README.md.
"""

from pathlib import Path

import numpy as np

from cgid.physics import Impact
from cgid.scene import load_scene, synthesise
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.impacts import draw

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
    acceleration()


def acceleration() -> None:
    """Write sample_acceleration.csv and print the truth."""
    scene = load_scene(HERE / "tail_beam.toml")
    (batch,) = synthesise(scene, BLOCK, SEED)
    strong = np.flatnonzero(np.abs(batch.signals).max(axis=1) > 60)
    coal, gangue = ([row for row in strong if batch.labels[row] == label][:3] for label in ("coal", "gangue"))
    order = [row for pair in zip(coal, gangue, strict=True) for row in pair]
    told = batch.parameters
    for number, row in enumerate(order):
        onset = told["onset"][row] + number * batch.signals.shape[1] / batch.sampling_rate
        place = f"at {told['impact_x'][row]:.2f}, {told['impact_y'][row]:.2f} m"
        print(f"{onset * 1e3:5.1f} ms  {batch.labels[row]:<7} {told['peak_force'][row]:6.0f} N {place}")
    samples = np.concatenate([batch.signals[row] for row in order])
    lines = [f"# sampling_rate: {batch.sampling_rate:g} Hz", "acceleration (m/s^2)", *(f"{v:.2f}" for v in samples)]
    (HERE / "sample_acceleration.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

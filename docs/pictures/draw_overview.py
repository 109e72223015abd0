"""Draw overview.png, and overview-phone.png in a column: a rock falls on a beam, the sensor hears it, cgid answers.

python docs/pictures/draw_overview.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrow, Polygon, Rectangle

import cgid
from cgid.plots.figure import colours_of, png

HERE = Path(__file__).parent
#: Seed of the two impacts, which no training of a shipped model saw.
SEED = 20261127
_GREY, _STEEL = "#555555", "#b8c0c8"


def main() -> None:
    """Draw the first impact of each label whose answer is sure and right."""
    batch = next(cgid.synthesise("tail_beam", 64, SEED))
    answers = cgid.predict(batch)
    colours = colours_of(["coal", "gangue"])
    chosen = {}
    for label in colours:
        sure = answers[(answers["truth"] == label) & (answers["label"] == label) & (answers[f"p_{label}"] > 0.8)]
        peaks = np.abs(batch.signals[sure["index"]]).max(axis=1)
        chosen[label] = sure.iloc[int(np.argmin(np.abs(np.log(peaks / 200.0))))]
    wide = Figure(figsize=(10, 3.1), layout="constrained")
    draw(wide.subplots(1, 3, width_ratios=[1.0, 1.5, 1.0]), batch, chosen, colours)
    (HERE / "overview.png").write_bytes(png(wide))
    tall = Figure(figsize=(4.2, 8.4), layout="constrained")
    draw(tall.subplots(3, 1, height_ratios=[1.0, 1.1, 0.8]), batch, chosen, colours)
    (HERE / "overview-phone.png").write_bytes(png(tall))


def draw(panels: Any, batch: cgid.Batch, chosen: dict[str, Any], colours: dict[str, str]) -> None:
    """Draw the beam, what its sensor records of two impacts, and the answers."""
    beam, sensor, answer = panels
    draw_beam(beam)
    time = (np.arange(batch.signals.shape[1]) - batch.pre_trigger) / batch.sampling_rate * 1e3
    for label, one in chosen.items():
        sensor.plot(time, batch.signals[one["index"]], color=colours[label], lw=1.0, label=label)
    sensor.set(xlim=(-1, 12), xlabel="time [ms]", ylabel="acceleration [m/s²]", title="2  The sensor records vibration")
    sensor.legend(frameon=False)
    for row, (label, one) in enumerate(reversed(chosen.items())):
        answer.barh(row, one[f"p_{label}"], color=colours[label], height=0.5)
        answer.text(0.03, row, f"{label}: {one[f'p_{label}']:.0%} sure", va="center", color="white", weight="bold")
    answer.set(xlim=(0, 1), ylim=(-0.6, 1.6), yticks=[], xlabel="probability", title="3  cgid names the material")
    for axes in (sensor, answer):
        axes.spines[["top", "right"]].set_visible(False)


def draw_beam(axes: Any) -> None:
    """Draw a sloping tail beam, a falling rock and the accelerometer below the plate."""
    axes.set(xlim=(0, 10), ylim=(0, 8), aspect="equal", title="1  A rock falls on the tail beam")
    axes.axis("off")
    axes.add_patch(Polygon([(0.5, 3.6), (9.3, 1.2), (9.1, 0.6), (0.3, 3.0)], fc=_STEEL, ec=_GREY))
    axes.add_patch(Rectangle((0.1, 2.2), 0.5, 2.2, fc=_GREY, ec=_GREY))
    axes.add_patch(Circle((5.0, 5.4), 0.75, fc="#8a6d3b", ec=_GREY))
    axes.add_patch(FancyArrow(5.0, 4.5, 0, -1.2, width=0.08, head_width=0.4, fc=_GREY, ec=_GREY))
    axes.add_patch(Rectangle((2.6, 1.75), 0.7, 0.6, angle=-15, fc="black"))
    axes.annotate("accelerometer", (3.0, 1.7), (1.0, 0.4), color=_GREY, arrowprops={"arrowstyle": "-", "color": _GREY})
    axes.text(6.0, 5.3, "coal or gangue?", color=_GREY)


if __name__ == "__main__":
    main()

"""Simulated courses beside the theories: rows of data, and panels of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from cgid.physics.materials import YANG2018_RADIUS, YANG2018_SPHERES
from cgid.reproduction import paper
from cgid.reproduction.drawing import Lines
from cgid.reproduction.finite_element.study import Run
from cgid.reproduction.impacts import THEORY_NAMES, paper_impact
from cgid.reproduction.paper_figure import frame

#: What `kind` says of the rows that are no theory's.
SIMULATED = "simulation"
#: How the lines of the theories are drawn, and which of them: K2 lies beyond K1, on the other side of the simulation.
THEORY_STYLES = {"hertz": (THEORY_NAMES["hertz"], "-"), "series": (THEORY_NAMES["series"], "--")}
#: Points of a theory's line.
_POINTS = 101


def courses(run: Run, *names: str, until: Literal["deepest", "parted", "end"] = "parted") -> Any:
    """Return rows of one simulated impact over time, from touch to the largest DCS, the end of contact or of all."""
    last = (
        1
        + {
            "deepest": int(np.argmax(run.courses["displacement"])),
            "parted": int(np.searchsorted(run.times, run.numbers["contact_duration"])),
            "end": run.times.size,
        }[until]
    )
    case = run.case
    columns: dict[str, Any] = {"kind": SIMULATED, "group": case.group, "sphere": case.sphere, "velocity": case.velocity}
    return frame({**columns, "time": run.times[:last], **{name: run.courses[name][:last] for name in names}})


def compression() -> list[Any]:
    """Return rows of force over DCS of the theories while the sphere is pressed in, up to the highest speed."""
    frames = []
    for theory in THEORY_STYLES:
        for sphere in YANG2018_SPHERES:
            impact = paper_impact(sphere, max(paper.VELOCITIES), theory)
            displacement = impact.peak_displacement * np.linspace(0, 1, _POINTS)
            force = impact.contact_stiffness * displacement**1.5
            frames.append(frame({"kind": theory, "sphere": sphere, "displacement": displacement, "force": force}))
    return frames


def each_sphere(x: str, y: str, marker: str = "", more: str = "", **where: object) -> list[Lines]:
    """Return a panel for each sphere: the five speeds as simulated, and the theories over them."""
    return [
        Lines(
            x=x, y=y, by="velocity", where={"kind": SIMULATED, "sphere": sphere, **where},
            title=f"sphere {sphere}{more}",
            over=tuple(
                Lines(x=x, y=y, where={"kind": theory, "sphere": sphere}, colour="black", style=style, label=label,
                      marker=marker)
                for theory, (label, style) in THEORY_STYLES.items()
            ),
        )
        for sphere in YANG2018_SPHERES
    ]  # fmt: skip


def strain_of(runs: Iterable[Run]) -> float:
    """Return the largest displacement over radius of these impacts."""
    return max(run.numbers["peak_displacement"] for run in runs) / YANG2018_RADIUS

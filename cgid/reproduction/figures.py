"""The theoretical figures of the paper: the data of each, and how it is drawn.

Figures 12 to 15: what each parameter does, as curves and as response surfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cgid.physics import Impact, free_fall_velocity
from cgid.physics.materials import YANG2018_SPHERES
from cgid.physics.sensitivity import parameters_of, response_grid
from cgid.reproduction import paper
from cgid.reproduction.drawing import Lines, PaperFigure, Surface, frame, highest_strain, joined
from cgid.reproduction.paper import (
    RESTITUTIONS,
    SECTION_5_RESTITUTION,
    SECTION_5_VELOCITY,
    THEORY_LABELS,
    paper_impact,
    table_4_impact,
    table_5_impact,
)
from cgid.validation import Floats

#: Stands in every picture that is drawn with the paper's own contact stiffness alone.
REJECTED = "Paper's series stiffness: rejected by the finite-element reference"
_POINTS = 201
_VELOCITIES = np.asarray(paper.VELOCITIES)
#: Axes of Figures 4 to 7, chosen here: the text of the paper does not give them.
_SPEEDS = np.linspace(0.1, 10, 100)
_HEIGHTS = np.linspace(0.05, 5, 100)


def _theories(*wanted: str) -> tuple[Any, float]:
    """Return peak responses over the impact speed for the three theories, and the largest strain."""
    made = {theory: paper_impact(1, _SPEEDS, theory) for theory in THEORY_LABELS}
    frames = []
    for theory, impact in made.items():
        peaks = {"peak_displacement": impact.peak_displacement, "peak_force": impact.peak_force}
        frames.append(frame({"theory": theory, "velocity": _SPEEDS, **{name: peaks[name] for name in wanted}}))
    return joined(frames), highest_strain(*made.values())


def figure_4_to_6(number: int) -> PaperFigure:
    """Return Figure 4 (DCS over speed), 5 (maximum force over speed) or 6 (maximum force over DCS)."""
    x, y, title = {
        4: ("velocity", "peak_displacement", "Displacement of centre of sphere"),
        5: ("velocity", "peak_force", "Maximum contact force"),
        6: ("peak_displacement", "peak_force", "Maximum contact force over contact displacement"),
    }[number]
    data, strain = _theories(*(name for name in (x, y) if name != "velocity"))
    lines = Lines(x=x, y=y, by="theory", labels=THEORY_LABELS)
    note = "Sphere 1 of Table 1. The range of speeds, 0.1 to 10 m/s, is chosen here."
    return PaperFigure(
        name=f"figure_{number:02d}", title=title, note=note, data=data, panels=(lines,), highest_strain=strain
    )


def figure_7() -> PaperFigure:
    """Return Figure 7: maximum contact force and displacement over the drop height."""
    impact = paper_impact(1, free_fall_velocity(_HEIGHTS, paper.GRAVITY))
    data = frame({
        "drop_height": _HEIGHTS, "velocity": impact.velocity,
        "peak_force": impact.peak_force, "peak_displacement": impact.peak_displacement,
    })  # fmt: skip
    return PaperFigure(
        name="figure_07",
        title="Maximum contact force and DCS over drop height",
        note="Sphere 1, series theory, g = 9.8 m/s^2. The range of heights, 0.05 to 5 m, is chosen here.",
        caption=REJECTED,
        data=data,
        panels=tuple(Lines(x="drop_height", y=y) for y in ("peak_force", "peak_displacement")),
        columns=2,
        highest_strain=highest_strain(impact),
    )


def _courses(velocities: ArrayLike, restitution: float | None = None) -> tuple[Any, float]:
    """Return force and displacement over time of the four spheres, and the largest strain."""
    frames, strain = [], 0.0
    # Dense at both ends of the contact, where the force starts like t^(3/2).
    share = np.sin(np.linspace(0, np.pi / 2, _POINTS)) ** 2
    for number in YANG2018_SPHERES:
        impact = paper_impact(number, velocities, restitution=restitution)
        times = np.asarray(impact.contact_duration)[..., None] * share
        frames.append(
            frame({
                "sphere": number, "restitution": 1.0 if restitution is None else restitution,
                "velocity": np.asarray(velocities)[..., None], "time": times,
                "force": impact.force(times), "displacement": impact.displacement(times),
            })
        )  # fmt: skip
        strain = max(strain, highest_strain(impact))
    return joined(frames), strain


def _each_sphere(x: str, y: str, marker: str = "", **where: object) -> list[Lines]:
    """Return a panel of the speeds for each sphere."""
    kind = ", ".join(f"{name} {value}" for name, value in where.items())
    return [
        Lines(
            x=x, y=y, by="velocity", where={"sphere": number, **where}, marker=marker,
            title=f"sphere {number}" + (f", {kind}" if kind else ""),
        )
        for number in YANG2018_SPHERES
    ]  # fmt: skip


def figure_10_pulses() -> PaperFigure:
    """Return Figure 10 over time: force and DCS of elastic impacts of the four spheres at five speeds."""
    data, strain = _courses(_VELOCITIES)
    return PaperFigure(
        name="figure_10_pulses",
        title="Force-time and DCS-time",
        note="Elastic, series theory. The paper's simulated curves are not here: it prints no numbers of them.",
        caption=REJECTED,
        data=data,
        panels=(*_each_sphere("time", "force"), *_each_sphere("time", "displacement")),
        columns=4,
        highest_strain=strain,
    )


def figure_10_peaks() -> PaperFigure:
    """Return the theoretical maxima of Figure 10 over the speed."""
    made = {number: paper_impact(number, _VELOCITIES) for number in YANG2018_SPHERES}
    frames = [
        frame({
            "sphere": number, "velocity": _VELOCITIES,
            "peak_force": impact.peak_force, "peak_displacement": impact.peak_displacement,
        })
        for number, impact in made.items()
    ]  # fmt: skip
    panels = (Lines(x="velocity", y=y, by="sphere", marker="o") for y in ("peak_force", "peak_displacement"))
    return PaperFigure(
        name="figure_10_peaks",
        title="Theoretical maxima of force and DCS",
        note="Series theory.",
        caption=REJECTED,
        data=joined(frames),
        panels=tuple(panels),
        columns=2,
        highest_strain=highest_strain(*made.values()),
    )


def figure_11_compression() -> PaperFigure:
    """Return the theoretical lines of Figure 11: force over DCS while the sphere is pressed in."""
    frames, strain = [], 0.0
    for number in YANG2018_SPHERES:
        impact = paper_impact(number, _VELOCITIES)
        displacement = impact.peak_displacement[:, None] * np.linspace(0, 1, _POINTS)
        force = impact.contact_stiffness[:, None] * displacement**1.5
        frames.append(
            frame({"sphere": number, "velocity": _VELOCITIES[:, None], "displacement": displacement, "force": force})
        )
        strain = max(strain, highest_strain(impact))
    return PaperFigure(
        name="figure_11_compression",
        title="Force-displacement, theory of the compression stage",
        note="Elastic, series theory. The five speeds share one curve and differ in where it ends.",
        caption=REJECTED,
        data=joined(frames),
        panels=tuple(_each_sphere("displacement", "force", marker="end")),
        columns=4,
        highest_strain=strain,
    )


def figure_11_loops() -> PaperFigure:
    """Return hysteresis loops in the manner of Figure 11, of damped impacts."""
    made = [_courses(_VELOCITIES, restitution) for restitution in RESTITUTIONS]
    panels = [
        panel
        for restitution in RESTITUTIONS
        for panel in _each_sphere("displacement", "force", restitution=restitution)
    ]
    return PaperFigure(
        name="figure_11_loops",
        title="Force-displacement, hysteresis loops",
        note="Hunt-Crossley with the exact damping for the restitution, series theory. Restitutions 0.8 and 0.5 are "
        "chosen here: the paper gives no number for its damping.",
        caption=REJECTED,
        data=joined([data for data, _ in made]),
        panels=tuple(panels),
        columns=4,
        highest_strain=max(strain for _, strain in made),
    )


def figure_16_17(number: int) -> PaperFigure:
    """Return Figure 16 (force over time) or 17 (force over DCS): damped impacts of the four spheres at 10 m/s."""
    x, title = {16: ("time", "Contact force-time at 10 m/s"), 17: ("displacement", "Contact force-DCS at 10 m/s")}[
        number
    ]
    data, strain = _courses([SECTION_5_VELOCITY], SECTION_5_RESTITUTION)
    return PaperFigure(
        name=f"figure_{number}",
        title=title,
        note=f"Hunt-Crossley, series theory, restitution {SECTION_5_RESTITUTION:g} chosen here; the paper "
        "shows its simulation.",
        caption=REJECTED,
        data=data,
        panels=(Lines(x=x, y="force", by="sphere"),),
        highest_strain=strain,
    )


def _responses(impact: Impact, ranges: Mapping[str, Floats]) -> tuple[Any, float]:
    """Return the peak responses over a grid, each row with all six parameters, and the largest strain."""
    grid = response_grid(impact, ranges)
    columns: dict[str, ArrayLike] = {"varied": " and ".join(ranges), **parameters_of(grid)}
    data = frame({**columns, "peak_displacement": grid.peak_displacement, "peak_force": grid.peak_force})
    return data, highest_strain(grid)


def _curves(number: int, title: str, names: tuple[str, ...]) -> PaperFigure:
    made = [_responses(table_4_impact(), {name: paper.TABLE_4[name].values}) for name in names]
    responses = ("peak_displacement", "peak_force")
    return PaperFigure(
        name=f"figure_{number}",
        title=title,
        note="Ranges of Table 4, series theory, 2 m/s (not said by the paper; it follows from its constants).",
        caption=REJECTED,
        data=joined([data for data, _ in made]),
        panels=tuple(Lines(x=name, y=y, where={"varied": name}, marker=".") for y in responses for name in names),
        columns=len(names),
        highest_strain=max(strain for _, strain in made),
    )


def figure_12() -> PaperFigure:
    """Return Figure 12: effect of the sphere's density, Young's modulus and Poisson's ratio."""
    return _curves(
        12, "Effect of sphere parameters on DCS and contact force", ("density", "youngs_modulus", "poisson_ratio")
    )


def figure_13() -> PaperFigure:
    """Return Figure 13: effect of the plate's Young's modulus and Poisson's ratio."""
    return _curves(
        13,
        "Effect of metal plate parameters on DCS and contact force",
        ("target_youngs_modulus", "target_poisson_ratio"),
    )


def figure_14() -> PaperFigure:
    """Return Figure 14: response surfaces of both moduli and of both Poisson's ratios, equal materials (Table 5)."""
    pairs = (("youngs_modulus", "target_youngs_modulus"), ("poisson_ratio", "target_poisson_ratio"))
    made = [
        _responses(table_5_impact(), {name: paper.TABLE_5[name].values for name in (first, second)})
        for first, second in pairs
    ]
    return PaperFigure(
        name="figure_14",
        title="Response surfaces of two bodies with the same properties",
        note="Ranges of Table 5, series theory, 2 m/s. Which parameters span each surface is our reading of the text.",
        caption=REJECTED,
        data=joined([data for data, _ in made]),
        panels=tuple(
            Surface(x=first, y=second, z=z, where={"varied": f"{first} and {second}"})
            for first, second in pairs
            for z in ("peak_displacement", "peak_force")
        ),
        columns=2,
        highest_strain=max(strain for _, strain in made),
    )


def figure_15() -> PaperFigure:
    """Return Figure 15: response surfaces of both moduli for a rock-like sphere on the metal plate (Table 4)."""
    first, second = "youngs_modulus", "target_youngs_modulus"
    ranges = {name: paper.TABLE_4[name].values for name in (first, second)}
    data, strain = _responses(table_4_impact(), ranges)
    return PaperFigure(
        name="figure_15",
        title="Response surfaces of both moduli, rock-like sphere on the metal plate",
        note="Ranges of Table 4, series theory, 2 m/s.",
        caption=REJECTED,
        data=data,
        panels=tuple(Surface(x=first, y=second, z=z) for z in ("peak_displacement", "peak_force")),
        columns=2,
        highest_strain=strain,
    )


#: How to make each figure, by the name of its files.
FIGURES: dict[str, Callable[[], PaperFigure]] = {
    "figure_04": lambda: figure_4_to_6(4),
    "figure_05": lambda: figure_4_to_6(5),
    "figure_06": lambda: figure_4_to_6(6),
    "figure_07": figure_7,
    "figure_10_pulses": figure_10_pulses,
    "figure_10_peaks": figure_10_peaks,
    "figure_11_compression": figure_11_compression,
    "figure_11_loops": figure_11_loops,
    "figure_12": figure_12,
    "figure_13": figure_13,
    "figure_14": figure_14,
    "figure_15": figure_15,
    "figure_16": lambda: figure_16_17(16),
    "figure_17": lambda: figure_16_17(17),
}

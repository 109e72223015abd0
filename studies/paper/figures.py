"""The theoretical figures of the paper: data and panels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib.validation import Floats
from cgid.physics import YANG2018_SPHERES, Impact, free_fall_velocity
from studies.paper import printed
from studies.paper.drawing import Drawn, Figures, Lines, Surface, frame, joined
from studies.paper.printed import (
    RESTITUTIONS,
    SECTION_5_RESTITUTION,
    SECTION_5_VELOCITY,
    THEORY_LABELS,
    paper_impact,
    table_4_impact,
    table_5_impact,
)
from studies.paper.sensitivity import parameters_of, response_grid

#: The functions that make the figures, by file name.
FIGURES = Figures()

#: Caption of every picture that uses only the paper's own contact stiffness.
REJECTED = "Paper's series stiffness: rejected by the finite-element reference"
_POINTS = 201
_VELOCITIES = np.asarray(printed.VELOCITIES)
#: Axes of Figures 4 to 7, chosen here because the paper does not state them.
_SPEEDS = np.linspace(0.1, 10, 100)
_HEIGHTS = np.linspace(0.05, 5, 100)
_PEAKS = ("peak_force", "peak_displacement")

_NOTE_4_TO_6 = "Sphere 1 of Table 1. The range of speeds, 0.1 to 10 m/s, is chosen here."


@FIGURES.add("figure_04", "Displacement of centre of sphere", _NOTE_4_TO_6, x="velocity", y="peak_displacement")
@FIGURES.add("figure_05", "Maximum contact force", _NOTE_4_TO_6, x="velocity", y="peak_force")
@FIGURES.add(
    "figure_06",
    "Maximum contact force over contact displacement",
    _NOTE_4_TO_6,
    x="peak_displacement",
    y="peak_force",
)
def figure_4_to_6(x: str, y: str) -> Drawn:
    """Return peak responses of the three theories over the impact speed, or over each other."""
    made = {theory: paper_impact(1, _SPEEDS, theory) for theory in THEORY_LABELS}
    frames = [
        frame({"theory": theory, "velocity": _SPEEDS, x: getattr(impact, x), y: getattr(impact, y)})
        for theory, impact in made.items()
    ]
    return joined(frames), [Lines(x=x, y=y, by="theory", labels=THEORY_LABELS)]


@FIGURES.add(
    "figure_07",
    "Maximum contact force and DCS over drop height",
    "Sphere 1, series theory, g = 9.8 m/s^2. The range of heights, 0.05 to 5 m, is chosen here.",
    REJECTED,
    columns=2,
)
def figure_7() -> Drawn:
    """Return maximum contact force and DCS over the drop height."""
    impact = paper_impact(1, free_fall_velocity(_HEIGHTS, printed.GRAVITY))
    peaks = {name: getattr(impact, name) for name in _PEAKS}
    data = frame({"drop_height": _HEIGHTS, "velocity": impact.velocity, **peaks})
    return data, [Lines(x="drop_height", y=y) for y in _PEAKS]


def _courses(velocities: ArrayLike, restitution: float | None = None) -> Any:
    """Return force and displacement of the four spheres over time."""
    frames = []
    # Points are dense at both ends of the contact, where the force is proportional to t^(3/2).
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
    return joined(frames)


def _each_sphere(x: str, y: str, marker: str = "", **where: object) -> list[Lines]:
    """Return a panel for each sphere, with a line for each speed."""
    kind = "".join(f", {name} {value}" for name, value in where.items())
    return [
        Lines(x=x, y=y, by="velocity", where={"sphere": number, **where}, marker=marker, title=f"sphere {number}{kind}")
        for number in YANG2018_SPHERES
    ]


@FIGURES.add(
    "figure_10_pulses",
    "Force-time and DCS-time",
    "Elastic, series theory. The paper's simulated curves are not here: it prints no numbers of them.",
    REJECTED,
    columns=4,
)
def figure_10_pulses() -> Drawn:
    """Return force and DCS over time for elastic impacts of the four spheres at five speeds."""
    return _courses(_VELOCITIES), [*_each_sphere("time", "force"), *_each_sphere("time", "displacement")]


@FIGURES.add("figure_10_peaks", "Theoretical maxima of force and DCS", "Series theory.", REJECTED, columns=2)
def figure_10_peaks() -> Drawn:
    """Return the theoretical maxima of Figure 10 over the speed."""
    made = {number: paper_impact(number, _VELOCITIES) for number in YANG2018_SPHERES}
    frames = [
        frame({"sphere": number, "velocity": _VELOCITIES, **{name: getattr(impact, name) for name in _PEAKS}})
        for number, impact in made.items()
    ]
    panels = [Lines(x="velocity", y=y, by="sphere", marker="o") for y in _PEAKS]
    return joined(frames), panels


@FIGURES.add(
    "figure_11_compression",
    "Force-displacement, theory of the compression stage",
    "Elastic, series theory. The five speeds share one curve and differ in where it ends.",
    REJECTED,
    columns=4,
)
def figure_11_compression() -> Drawn:
    """Return the theoretical lines of Figure 11: force over DCS during compression."""
    made = {number: paper_impact(number, _VELOCITIES) for number in YANG2018_SPHERES}
    frames = []
    for number, impact in made.items():
        displacement = impact.peak_displacement[:, None] * np.linspace(0, 1, _POINTS)
        force = impact.contact_stiffness[:, None] * displacement**1.5
        frames.append(
            frame({"sphere": number, "velocity": _VELOCITIES[:, None], "displacement": displacement, "force": force})
        )
    return joined(frames), _each_sphere("displacement", "force", marker="end")


@FIGURES.add(
    "figure_11_loops",
    "Force-displacement, hysteresis loops",
    "Hunt-Crossley with the exact damping for the restitution, series theory. Restitutions 0.8 and 0.5 are "
    "chosen here: the paper gives no number for its damping.",
    REJECTED,
    columns=4,
)
def figure_11_loops() -> Drawn:
    """Return hysteresis loops of damped impacts, as in Figure 11."""
    data = [_courses(_VELOCITIES, restitution) for restitution in RESTITUTIONS]
    panels = [panel for e in RESTITUTIONS for panel in _each_sphere("displacement", "force", restitution=e)]
    return joined(data), panels


def _responses(impact: Impact, ranges: Mapping[str, Floats]) -> Any:
    """Return the peak responses over a grid, each row with all six parameters."""
    grid = response_grid(impact, ranges)
    columns: dict[str, ArrayLike] = {"varied": " and ".join(ranges), **parameters_of(grid)}
    return frame({**columns, "peak_displacement": grid.peak_displacement, "peak_force": grid.peak_force})


_NOTE_12_13 = "Ranges of Table 4, series theory, 2 m/s (not said by the paper; it follows from its constants)."


@FIGURES.add(
    "figure_12", "Effect of sphere parameters on DCS and contact force", _NOTE_12_13, REJECTED, columns=3,
    names=("density", "youngs_modulus", "poisson_ratio"),
)  # fmt: skip
@FIGURES.add(
    "figure_13", "Effect of metal plate parameters on DCS and contact force", _NOTE_12_13, REJECTED, columns=2,
    names=("target_youngs_modulus", "target_poisson_ratio"),
)  # fmt: skip
def figure_12_13(names: tuple[str, ...]) -> Drawn:
    """Return curves of both responses over each parameter."""
    data = [_responses(table_4_impact(), {name: printed.TABLE_4[name].values}) for name in names]
    panels = [Lines(x=name, y=y, where={"varied": name}, marker=".") for y in reversed(_PEAKS) for name in names]
    return joined(data), panels


_MODULI, _RATIOS = ("youngs_modulus", "target_youngs_modulus"), ("poisson_ratio", "target_poisson_ratio")


@FIGURES.add(
    "figure_14",
    "Response surfaces of two bodies with the same properties",
    "Ranges of Table 5, series theory, 2 m/s. Which parameters span each surface is our reading of the text.",
    REJECTED,
    columns=2,
    table=5,
    pairs=(_MODULI, _RATIOS),
)
@FIGURES.add(
    "figure_15",
    "Response surfaces of both moduli, rock-like sphere on the metal plate",
    "Ranges of Table 4, series theory, 2 m/s.",
    REJECTED,
    columns=2,
    table=4,
    pairs=(_MODULI,),
)
def figure_14_15(table: int, pairs: tuple[tuple[str, str], ...]) -> Drawn:
    """Return response surfaces over pairs of parameters."""
    impact, ranges = {4: (table_4_impact(), printed.TABLE_4), 5: (table_5_impact(), printed.TABLE_5)}[table]
    data = [_responses(impact, {name: ranges[name].values for name in pair}) for pair in pairs]
    panels = [
        Surface(x=first, y=second, z=z, where={"varied": f"{first} and {second}"})
        for first, second in pairs
        for z in reversed(_PEAKS)
    ]
    return joined(data), panels


_NOTE_16_17 = (
    f"Hunt-Crossley, series theory, restitution {SECTION_5_RESTITUTION:g} chosen here; the paper shows its simulation."
)


@FIGURES.add("figure_16", "Contact force-time at 10 m/s", _NOTE_16_17, REJECTED, x="time")
@FIGURES.add("figure_17", "Contact force-DCS at 10 m/s", _NOTE_16_17, REJECTED, x="displacement")
def figure_16_17(x: str) -> Drawn:
    """Return the contact force of damped impacts of the four spheres at 10 m/s."""
    return _courses([SECTION_5_VELOCITY], SECTION_5_RESTITUTION), [Lines(x=x, y="force", by="sphere")]

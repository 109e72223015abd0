"""Figures 9 to 11, 16 and 17 from the finite-element study, and the effect of a soft contact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from cgid.physics import YANG2018_SPHERES
from studies.paper import printed
from studies.paper.drawing import Drawn, Figures, Lines, frame, joined
from studies.paper.printed import SECTION_5_VELOCITY, THEORY_NAMES, paper_impact
from studies.paper.study import (
    DAMPED,
    ELEMENT_SIZES,
    ELEMENTS,
    FACTOR_SPHERES,
    FACTOR_VELOCITY,
    FACTORS,
    PENALTY_FACTOR,
    RESTITUTION,
    SOFT_BY_FACTOR,
    UNDAMPED,
    Run,
    Study,
)
from studies.paper.theories import QUANTITIES_COMPARED, READINGS, SHARED, predicted

#: The functions that make the figures of a study, by file name.
SIMULATED_FIGURES = Figures()

#: `kind` of simulated rows; other rows hold the theory.
SIMULATED = "simulation"
#: Label and style of the drawn theories. K2 is omitted: it is farther from the simulation than K1, on the other side.
THEORY_STYLES = {"hertz": (THEORY_NAMES["hertz"], "-"), "series": (THEORY_NAMES["series"], "--")}
#: Note of the damped figures.
_DAMPING = (
    "The damped sphere is a Kelvin-Voigt body; its retardation time is chosen for each impact so that "
    f"Kuwabara-Kono's restitution is {RESTITUTION:g}. (The paper has damping during the contact, which is "
    "another one, and gives no number.)"
)
#: The columns of a hysteresis loop.
_LOOP = ("force", "displacement")
#: Points on the line of a theory.
_POINTS = 101


def courses(run: Run, *names: str, until: Literal["deepest", "parted", "end"] = "parted") -> Any:
    """Return one simulated impact over time, from first touch to the largest DCS, to separation or to the end."""
    last = {
        "deepest": int(np.argmax(run.courses["displacement"])),
        "parted": int(np.searchsorted(run.times, run.numbers["contact_duration"])),
        "end": run.times.size,
    }[until]
    case, rows = run.case, slice(last + 1)
    columns: dict[str, Any] = {"kind": SIMULATED, "group": case.group, "sphere": case.sphere, "velocity": case.velocity}
    return frame({**columns, "time": run.times[rows], **{name: run.courses[name][rows] for name in names}})


def compression() -> list[Any]:
    """Return rows of force over DCS of the theories during compression, up to the highest speed."""
    frames = []
    for theory in THEORY_STYLES:
        for sphere in YANG2018_SPHERES:
            impact = paper_impact(sphere, max(printed.VELOCITIES), theory)
            displacement = impact.peak_displacement * np.linspace(0, 1, _POINTS)
            force = impact.contact_stiffness * displacement**1.5
            frames.append(frame({"kind": theory, "sphere": sphere, "displacement": displacement, "force": force}))
    return frames


def each_sphere(x: str, y: str, marker: str = "", more: str = "", **where: object) -> list[Lines]:
    """Return a panel for each sphere: the simulated impacts at five speeds, with the theories on top."""
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


@SIMULATED_FIGURES.add(
    "figure_09",
    "Simulated over theoretical maxima",
    "Sphere 1, undamped, 2 to 10 m/s (the data hold all four spheres). Where theory and simulation are equal "
    "stands the grey line: a theory that is wrong by a factor lies on another straight line.",
    columns=3,
)
def figure_9(study: Study) -> Drawn:
    """Return simulated over theoretical maxima."""
    frames = []
    for reading in READINGS:
        for sphere in YANG2018_SPHERES:
            runs = [run for run in study.of(UNDAMPED) if run.case.sphere == sphere]
            velocities = tuple(run.case.velocity for run in runs)
            columns: dict[str, Any] = {"sphere": sphere, "theory": reading, "velocity": velocities}
            found = predicted(reading, sphere, velocities)
            for name in QUANTITIES_COMPARED:
                # The other reading of K1 differs only in energy; its other points would hide those of K1.
                differs = reading != SHARED or name.endswith("energy")
                columns[f"theoretical_{name}"] = found[name] if differs else np.nan
                columns[f"simulated_{name}"] = [run.numbers[name] for run in runs]
            frames.append(frame(columns))
    panels = [
        Lines(
            x=f"theoretical_{name}", y=f"simulated_{name}", by="theory", where={"sphere": 1}, labels=READINGS,
            marker="o", diagonal=True,
        )
        for name in QUANTITIES_COMPARED
    ]  # fmt: skip
    return joined(frames), panels


@SIMULATED_FIGURES.add(
    "figure_10_simulated",
    "Force-time and DCS-time, simulated",
    "Undamped finite elements at the five speeds. Black: the maxima of the theories at these speeds.",
    columns=4,
)
def figure_10_simulated(study: Study) -> Drawn:
    """Return contact force and DCS over time, with the maxima of the theories."""
    runs = study.of(UNDAMPED)
    frames = [courses(run, *_LOOP) for run in runs]
    for theory in THEORY_STYLES:
        for sphere in YANG2018_SPHERES:
            found = predicted(theory, sphere, printed.VELOCITIES)
            frames.append(
                frame({
                    "kind": theory, "sphere": sphere, "velocity": printed.VELOCITIES,
                    "time": found["contact_duration"] / 2, "force": found["peak_force"],
                    "displacement": found["peak_displacement"],
                })
            )  # fmt: skip
    panels = [panel for name in _LOOP for panel in each_sphere("time", name, ".")]
    return joined(frames), panels


@SIMULATED_FIGURES.add(
    "figure_10_waves",
    "Mass x acceleration of the sphere's centre, raw and behind the FFT filter",
    "Undamped. Above: the sphere's mass x acceleration of the node at its centre, at 10 m/s (200 points: the "
    "quickest waves are not resolved). Below: the same behind a low-pass at 4/T, all speeds. Black: the contact "
    "force, which needs no filter.",
    columns=4,
)
def figure_10_waves(study: Study) -> Drawn:
    """Return mass x acceleration of the centre node, raw and filtered, and the contact force."""
    runs = study.of(UNDAMPED)
    highest = max(printed.VELOCITIES)
    raw = [
        Lines(
            x="time", y="centre_node_force", where={"sphere": sphere, "velocity": highest},
            title=f"sphere {sphere}, {highest:g} m/s", label="unfiltered", colour="0.6", width=0.9,
            over=(_contact_force(sphere, highest),),
        )
        for sphere in YANG2018_SPHERES
    ]  # fmt: skip
    filtered = [
        Lines(
            x="time", y="filtered_force", by="velocity", where={"sphere": sphere}, title=f"sphere {sphere}",
            over=tuple(_contact_force(sphere, velocity) for velocity in printed.VELOCITIES),
        )
        for sphere in YANG2018_SPHERES
    ]  # fmt: skip
    frames = [courses(run, "centre_node_force", "filtered_force", "force", until="end") for run in runs]
    return joined(frames), [*raw, *filtered]


def _contact_force(sphere: int, velocity: float) -> Lines:
    return Lines(
        x="time", y="force", where={"sphere": sphere, "velocity": velocity}, label="contact force", colour="black",
        style="--", width=1.0,
    )  # fmt: skip


@SIMULATED_FIGURES.add(
    "figure_11_simulated",
    "Force-displacement, simulated hysteresis loops, and the theories of the compression stage",
    f"Finite elements. {_DAMPING} Black: the elastic theories up to 10 m/s.",
    columns=4,
)
def figure_11_simulated(study: Study) -> Drawn:
    """Return hysteresis loops, with the lines of the theories."""
    runs = study.of(DAMPED)
    frames = [*(courses(run, "displacement", "force") for run in runs), *compression()]
    return joined(frames), each_sphere("displacement", "force")


@SIMULATED_FIGURES.add(
    "figure_16_simulated", "Simulated contact force-time at 10 m/s", f"Finite elements. {_DAMPING}", columns=2,
    x="time",
)  # fmt: skip
@SIMULATED_FIGURES.add(
    "figure_17_simulated", "Simulated contact force-DCS at 10 m/s", f"Finite elements. {_DAMPING}", columns=2,
    x="displacement",
)  # fmt: skip
def figure_16_17_simulated(study: Study, x: str) -> Drawn:
    """Return the contact force of the four spheres at 10 m/s."""
    runs = [run for group in (DAMPED, UNDAMPED) for run in study.of(group) if run.case.velocity == SECTION_5_VELOCITY]
    titles = {DAMPED: f"damped, restitution {RESTITUTION:g}", UNDAMPED: "undamped"}
    panels = [Lines(x=x, y="force", by="sphere", where={"group": group}, title=text) for group, text in titles.items()]
    return joined([courses(run, "displacement", "force") for run in runs]), panels


@SIMULATED_FIGURES.add(
    "penalty_loops",
    "Force-displacement with a soft contact",
    "Undamped finite elements whose surfaces may enter each other: pressure = "
    f"{PENALTY_FACTOR:g} x bulk modulus / element size x depth, up to the largest DCS. The mesh is ours; "
    "the contact is as soft as that of elements of the size above the panel. The five speeds share "
    "one curve and differ in where it ends. Black: the elastic theories up to 10 m/s.",
    columns=4,
)
def penalty_loops(study: Study) -> Drawn:
    """Return force over DCS with a soft contact, with the lines of the theories."""
    runs = [run for group in ELEMENT_SIZES for run in study.of(group)]
    frames = [*(courses(run, "displacement", "force", until="deepest") for run in runs), *compression()]
    panels = [
        replace(panel, marker="end")
        for group, size in ELEMENT_SIZES.items()
        for panel in each_sphere("displacement", "force", more=f", as soft as {size * 1e3:g} mm", group=group)
    ]
    return joined(frames), panels


@SIMULATED_FIGURES.add(
    "penalty_factor",
    "Force and DCS by the stiffness of a soft contact",
    f"Spheres 1 and 3 at {FACTOR_VELOCITY:g} m/s, undamped, {ELEMENTS} elements over the contact "
    "radius. Black: the theories for sphere 1.",
    columns=2,
)
def penalty_factor(study: Study) -> Drawn:
    """Return force and DCS relative to a hard contact, over the stiffness of a soft contact."""
    hard = {(run.case.sphere, run.case.velocity): run.numbers for run in study.of(UNDAMPED)}
    frames, runs = [], study.of(SOFT_BY_FACTOR)

    def add(kind: str, sphere: int, factor: Any, found: Mapping[str, Any]) -> None:
        of_hard = hard[sphere, FACTOR_VELOCITY]
        over = {f"{name}_over_hard": found[f"peak_{name}"] / of_hard[f"peak_{name}"] for name in _LOOP}
        frames.append(
            frame({"kind": kind, "sphere": sphere, "velocity": FACTOR_VELOCITY, "penalty_factor": factor, **over})
        )

    for run in runs:
        add(SIMULATED, run.case.sphere, run.case.penalty_factor, run.numbers)
    for theory in THEORY_STYLES:
        for sphere in FACTOR_SPHERES:
            add(
                f"{theory} {sphere}",
                sphere,
                [min(FACTORS), max(FACTORS)],
                predicted(theory, sphere, (FACTOR_VELOCITY,)),
            )
    panels = [
        Lines(
            x="penalty_factor", y=y, by="sphere", where={"kind": SIMULATED}, marker="o", logarithmic=True,
            over=tuple(
                Lines(x="penalty_factor", y=y, where={"kind": f"{theory} {FACTOR_SPHERES[0]}"}, colour="black",
                      style=style, label=label, width=1.0)
                for theory, (label, style) in THEORY_STYLES.items()
            ),
        )
        for y in (f"{name}_over_hard" for name in _LOOP)
    ]  # fmt: skip
    return joined(frames), panels

"""Figures 9 to 11, 16 and 17 as the finite elements have them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from cgid.materials import YANG2018_RADIUS, YANG2018_SPHERES
from cgid.reproduction import impacts, paper
from cgid.reproduction.drawing import Lines
from cgid.reproduction.finite_element import cases
from cgid.reproduction.finite_element.study import Run, Study
from cgid.reproduction.finite_element.theories import QUANTITIES_COMPARED, READINGS, SHARED, predicted
from cgid.reproduction.impacts import paper_impact
from cgid.reproduction.paper_figure import PaperFigure, frame, joined

#: What `kind` says of the rows that are no theory's.
_SIMULATED = "simulation"
#: How the lines of the theories are drawn, and which of them: K2 lies beyond K1, on the other side of the simulation.
_THEORY_STYLES = {"hertz": ("K1 (Hertz)", "-"), "series": ("series (the paper's own)", "--")}
#: Points of a theory's line.
_POINTS = 101


def figure_9(study: Study) -> PaperFigure:
    """Return Figure 9: simulated over theoretical maxima."""
    frames = []
    for reading in READINGS:
        for sphere in YANG2018_SPHERES:
            runs = [run for run in study.of(cases.UNDAMPED) if run.case.sphere == sphere]
            velocities = [run.case.velocity for run in runs]
            columns: dict[str, Any] = {"sphere": sphere, "theory": reading, "velocity": velocities}
            found = predicted(reading, sphere, velocities)
            for name in QUANTITIES_COMPARED:
                # The other reading of K1 differs in energy alone, and would hide K1 elsewhere.
                differs = reading != SHARED or name.endswith("energy")
                columns[f"theoretical_{name}"] = found[name] if differs else np.nan
                columns[f"simulated_{name}"] = [run.numbers[name] for run in runs]
            frames.append(frame(columns))
    panels = tuple(
        Lines(
            x=f"theoretical_{name}", y=f"simulated_{name}", by="theory", where={"sphere": 1}, labels=READINGS,
            marker="o", diagonal=True,
        )
        for name in QUANTITIES_COMPARED
    )  # fmt: skip
    return PaperFigure(
        name="figure_09",
        title="Simulated over theoretical maxima",
        note="Sphere 1, undamped, 2 to 10 m/s (the data hold all four spheres). Where theory and simulation are equal "
        "stands the grey line: a theory that is wrong by a factor lies on another straight line.",
        data=joined(frames),
        panels=panels,
        columns=3,
        highest_strain=_highest_strain(study.of(cases.UNDAMPED)),
    )


def figure_10_simulated(study: Study) -> PaperFigure:
    """Return Figure 10: contact force and DCS over time, with the theories' maxima."""
    runs = study.of(cases.UNDAMPED)
    frames = [_courses(run, "force", "displacement") for run in runs]
    for theory in _THEORY_STYLES:
        for sphere in YANG2018_SPHERES:
            found = predicted(theory, sphere, paper.VELOCITIES)
            frames.append(
                frame({
                    "kind": theory, "sphere": sphere, "velocity": paper.VELOCITIES,
                    "time": found["contact_duration"] / 2, "force": found["peak_force"],
                    "displacement": found["peak_displacement"],
                })
            )  # fmt: skip
    return PaperFigure(
        name="figure_10_simulated",
        title="Force-time and DCS-time, simulated",
        note="Undamped finite elements at the five speeds. Black: the maxima of the theories at these speeds.",
        data=joined(frames),
        panels=(*_each_sphere("time", "force", "."), *_each_sphere("time", "displacement", ".")),
        columns=4,
        highest_strain=_highest_strain(runs),
    )


def figure_10_waves(study: Study) -> PaperFigure:
    """Return the waves of Figure 10: mass x acceleration of the centre node, raw and filtered, and contact force."""
    runs = study.of(cases.UNDAMPED)
    return PaperFigure(
        name="figure_10_waves",
        title="Mass x acceleration of the sphere's centre, raw and behind the FFT filter",
        note="Undamped. Above: sphere's mass x acceleration of the node at its centre. Below: the same behind a "
        "low-pass at 4/T, and dashed the contact force, which needs no filter.",
        data=joined([_courses(run, "centre_node_force", "filtered_force", "force") for run in runs]),
        panels=(
            *(
                Lines(x="time", y="centre_node_force", by="velocity", where={"sphere": sphere}, width=0.9,
                      title=f"sphere {sphere}")
                for sphere in YANG2018_SPHERES
            ),
            *(
                Lines(
                    x="time", y="filtered_force", by="velocity", where={"sphere": sphere}, title=f"sphere {sphere}",
                    over=tuple(
                        Lines(x="time", y="force", where={"sphere": sphere, "velocity": velocity},
                              label="contact force", colour="black", style="--", width=1.0)
                        for velocity in paper.VELOCITIES
                    ),
                )
                for sphere in YANG2018_SPHERES
            ),
        ),
        columns=4,
        highest_strain=_highest_strain(runs),
    )  # fmt: skip


def figure_11_simulated(study: Study) -> PaperFigure:
    """Return Figure 11: lines of the theories over hysteresis loops."""
    runs = study.of(cases.DAMPED)
    return PaperFigure(
        name="figure_11_simulated",
        title="Force-displacement, simulated hysteresis loops, and the theories of the compression stage",
        note=f"Finite elements with a Kelvin-Voigt sphere. {_damping()} Black: the elastic theories up to 10 m/s.",
        data=joined([*(_courses(run, "displacement", "force") for run in runs), *_compression()]),
        panels=tuple(_each_sphere("displacement", "force")),
        columns=4,
        highest_strain=_highest_strain(runs),
    )


def figure_16_17_simulated(study: Study, number: int) -> PaperFigure:
    """Return Figure 16 (force over time) or 17 (force over DCS): the four spheres at 10 m/s, simulated."""
    x, title = {
        16: ("time", "Simulated contact force-time at 10 m/s"),
        17: ("displacement", "Simulated contact force-DCS at 10 m/s"),
    }[number]
    runs = [
        run
        for group in (cases.DAMPED, cases.UNDAMPED)
        for run in study.of(group)
        if run.case.velocity == impacts.SECTION_5_VELOCITY
    ]
    titles = {cases.DAMPED: f"damped, restitution {cases.RESTITUTION:g}", cases.UNDAMPED: "undamped"}
    return PaperFigure(
        name=f"figure_{number}_simulated",
        title=title,
        note=f"Finite elements. {_damping()}",
        data=joined([_courses(run, "displacement", "force") for run in runs]),
        panels=tuple(
            Lines(x=x, y="force", by="sphere", where={"group": group}, title=text) for group, text in titles.items()
        ),
        columns=2,
        highest_strain=_highest_strain(runs),
    )


def penalty_loops(study: Study) -> PaperFigure:
    """Return force over DCS with a soft contact, beside the theories."""
    runs = study.of(cases.SOFT)
    return PaperFigure(
        name="penalty_loops",
        title="Force-displacement with a soft contact",
        note="Undamped finite elements whose surfaces may enter each other: pressure = "
        f"{cases.PENALTY_FACTOR:g} x bulk modulus / element size x depth. Black: the elastic theories up to 10 m/s.",
        data=joined([*(_courses(run, "displacement", "force") for run in runs), *_compression()]),
        panels=tuple(_each_sphere("displacement", "force")),
        columns=4,
        highest_strain=_highest_strain(runs),
    )


def penalty_factor(study: Study) -> PaperFigure:
    """Return what the stiffness of a soft contact does to force and DCS."""
    hard = {(run.case.sphere, run.case.velocity): run.numbers for run in study.of(cases.UNDAMPED)}
    frames, runs = [], study.of(cases.SOFT_BY_FACTOR)
    for run in runs:
        beside = hard[run.case.sphere, run.case.velocity]
        frames.append(
            frame({
                "kind": _SIMULATED, "sphere": run.case.sphere, "velocity": run.case.velocity,
                "penalty_factor": run.case.penalty_factor,
                "force_over_hard": run.numbers["peak_force"] / beside["peak_force"],
                "displacement_over_hard": run.numbers["peak_displacement"] / beside["peak_displacement"],
            })
        )  # fmt: skip
    for theory in _THEORY_STYLES:
        for sphere in cases.FACTOR_SPHERES:
            found, beside = predicted(theory, sphere, (cases.FACTOR_VELOCITY,)), hard[sphere, cases.FACTOR_VELOCITY]
            frames.append(
                frame({
                    "kind": f"{theory} {sphere}", "sphere": sphere, "velocity": cases.FACTOR_VELOCITY,
                    "penalty_factor": [min(cases.FACTORS), max(cases.FACTORS)],
                    "force_over_hard": found["peak_force"] / beside["peak_force"],
                    "displacement_over_hard": found["peak_displacement"] / beside["peak_displacement"],
                })
            )  # fmt: skip
    panels = tuple(
        Lines(
            x="penalty_factor", y=y, by="sphere", where={"kind": _SIMULATED}, marker="o", logarithmic=True,
            over=tuple(
                Lines(x="penalty_factor", y=y, where={"kind": f"{theory} {cases.FACTOR_SPHERES[0]}"}, colour="black",
                      style=style, label=label, width=1.0)
                for theory, (label, style) in _THEORY_STYLES.items()
            ),
        )
        for y in ("force_over_hard", "displacement_over_hard")
    )  # fmt: skip
    return PaperFigure(
        name="penalty_factor",
        title="Force and DCS by the stiffness of a soft contact",
        note=f"Spheres 1 and 3 at {cases.FACTOR_VELOCITY:g} m/s, undamped, {cases.ELEMENTS} elements over the contact "
        "radius. Black: the theories for sphere 1.",
        data=joined(frames),
        panels=panels,
        columns=2,
        highest_strain=_highest_strain(runs),
    )


def _damping() -> str:
    return (
        f"The retardation time is chosen for each impact so that Kuwabara-Kono's restitution is {cases.RESTITUTION:g}: "
        "the paper gives no number for its damping."
    )


def _courses(run: Run, *names: str) -> Any:
    """Return rows of one simulated impact over time."""
    columns: dict[str, Any] = {name: run.courses[name] for name in names}
    case = run.case
    columns |= {"kind": _SIMULATED, "group": case.group, "sphere": case.sphere, "velocity": case.velocity}
    return frame({**columns, "time": run.times})


def _compression() -> list[Any]:
    """Return rows of force over DCS of the theories while the sphere is pressed in, up to the highest speed."""
    frames = []
    for theory in _THEORY_STYLES:
        for sphere in YANG2018_SPHERES:
            impact = paper_impact(sphere, max(paper.VELOCITIES), theory)
            displacement = impact.peak_displacement * np.linspace(0, 1, _POINTS)
            force = impact.contact_stiffness * displacement**1.5
            frames.append(frame({"kind": theory, "sphere": sphere, "displacement": displacement, "force": force}))
    return frames


def _each_sphere(x: str, y: str, marker: str = "") -> list[Lines]:
    """Return a panel for each sphere: the five speeds as simulated, and the theories over them."""
    return [
        Lines(
            x=x, y=y, by="velocity", where={"kind": _SIMULATED, "sphere": sphere}, title=f"sphere {sphere}",
            over=tuple(
                Lines(x=x, y=y, where={"kind": theory, "sphere": sphere}, colour="black", style=style, label=label,
                      marker=marker)
                for theory, (label, style) in _THEORY_STYLES.items()
            ),
        )
        for sphere in YANG2018_SPHERES
    ]  # fmt: skip


def _highest_strain(runs: Iterable[Run]) -> float:
    return max(run.numbers["peak_displacement"] for run in runs) / YANG2018_RADIUS


#: How to make each figure of a study, by the name of its files.
SIMULATED_FIGURES: dict[str, Callable[[Study], PaperFigure]] = {
    "figure_09": figure_9,
    "figure_10_simulated": figure_10_simulated,
    "figure_10_waves": figure_10_waves,
    "figure_11_simulated": figure_11_simulated,
    "figure_16_simulated": lambda study: figure_16_17_simulated(study, 16),
    "figure_17_simulated": lambda study: figure_16_17_simulated(study, 17),
    "penalty_loops": penalty_loops,
    "penalty_factor": penalty_factor,
}

"""Figures 9 to 11, 16 and 17 as the finite elements have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cgid.physics.materials import YANG2018_SPHERES
from cgid.reproduction import impacts, paper
from cgid.reproduction.drawing import Lines
from cgid.reproduction.finite_element import cases
from cgid.reproduction.finite_element.courses import THEORY_STYLES, compression, courses, each_sphere, strain_of
from cgid.reproduction.finite_element.penalty_figures import penalty_factor, penalty_loops
from cgid.reproduction.finite_element.study import Study
from cgid.reproduction.finite_element.theories import QUANTITIES_COMPARED, READINGS, SHARED, predicted
from cgid.reproduction.paper_figure import PaperFigure, frame, joined


def figure_9(study: Study) -> PaperFigure:
    """Return Figure 9: simulated over theoretical maxima."""
    frames = []
    for reading in READINGS:
        for sphere in YANG2018_SPHERES:
            runs = [run for run in study.of(cases.UNDAMPED) if run.case.sphere == sphere]
            velocities = tuple(run.case.velocity for run in runs)
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
        highest_strain=strain_of(study.of(cases.UNDAMPED)),
    )


def figure_10_simulated(study: Study) -> PaperFigure:
    """Return Figure 10: contact force and DCS over time, with the theories' maxima."""
    runs = study.of(cases.UNDAMPED)
    frames = [courses(run, "force", "displacement") for run in runs]
    for theory in THEORY_STYLES:
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
        panels=(*each_sphere("time", "force", "."), *each_sphere("time", "displacement", ".")),
        columns=4,
        highest_strain=strain_of(runs),
    )


def figure_10_waves(study: Study) -> PaperFigure:
    """Return the waves of Figure 10: mass x acceleration of the centre node, raw and filtered, and contact force."""
    runs = study.of(cases.UNDAMPED)
    highest = max(paper.VELOCITIES)
    raw = (
        Lines(
            x="time", y="centre_node_force", where={"sphere": sphere, "velocity": highest},
            title=f"sphere {sphere}, {highest:g} m/s", label="unfiltered", colour="0.6", width=0.9,
            over=(_contact_force(sphere, highest),),
        )
        for sphere in YANG2018_SPHERES
    )  # fmt: skip
    filtered = (
        Lines(
            x="time", y="filtered_force", by="velocity", where={"sphere": sphere}, title=f"sphere {sphere}",
            over=tuple(_contact_force(sphere, velocity) for velocity in paper.VELOCITIES),
        )
        for sphere in YANG2018_SPHERES
    )  # fmt: skip
    return PaperFigure(
        name="figure_10_waves",
        title="Mass x acceleration of the sphere's centre, raw and behind the FFT filter",
        note="Undamped. Above: the sphere's mass x acceleration of the node at its centre, at 10 m/s (200 points: the "
        "quickest waves are not resolved). Below: the same behind a low-pass at 4/T, all speeds. Black: the contact "
        "force, which needs no filter.",
        data=joined([courses(run, "centre_node_force", "filtered_force", "force", until="end") for run in runs]),
        panels=(*raw, *filtered),
        columns=4,
        highest_strain=strain_of(runs),
    )


def _contact_force(sphere: int, velocity: float) -> Lines:
    return Lines(
        x="time", y="force", where={"sphere": sphere, "velocity": velocity}, label="contact force", colour="black",
        style="--", width=1.0,
    )  # fmt: skip


def figure_11_simulated(study: Study) -> PaperFigure:
    """Return Figure 11: lines of the theories over hysteresis loops."""
    runs = study.of(cases.DAMPED)
    return PaperFigure(
        name="figure_11_simulated",
        title="Force-displacement, simulated hysteresis loops, and the theories of the compression stage",
        note=f"Finite elements. {_damping()} Black: the elastic theories up to 10 m/s.",
        data=joined([*(courses(run, "displacement", "force") for run in runs), *compression()]),
        panels=tuple(each_sphere("displacement", "force")),
        columns=4,
        highest_strain=strain_of(runs),
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
        data=joined([courses(run, "displacement", "force") for run in runs]),
        panels=tuple(
            Lines(x=x, y="force", by="sphere", where={"group": group}, title=text) for group, text in titles.items()
        ),
        columns=2,
        highest_strain=strain_of(runs),
    )


def _damping() -> str:
    return (
        "The damped sphere is a Kelvin-Voigt body; its retardation time is chosen for each impact so that "
        f"Kuwabara-Kono's restitution is {cases.RESTITUTION:g}. (The paper has damping during the contact, which is "
        "another one, and gives no number.)"
    )


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

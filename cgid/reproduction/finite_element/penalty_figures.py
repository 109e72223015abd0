"""The penalty experiment: what a contact that gives way does to the finite elements."""

from __future__ import annotations

from dataclasses import replace

from cgid.reproduction.drawing import Lines
from cgid.reproduction.finite_element import cases
from cgid.reproduction.finite_element.courses import (
    SIMULATED,
    THEORY_STYLES,
    compression,
    courses,
    each_sphere,
    strain_of,
)
from cgid.reproduction.finite_element.study import Study
from cgid.reproduction.finite_element.theories import predicted
from cgid.reproduction.paper_figure import PaperFigure, frame, joined


def penalty_loops(study: Study) -> PaperFigure:
    """Return force over DCS with a soft contact, beside the theories."""
    runs = [run for group in cases.ELEMENT_SIZES for run in study.of(group)]
    return PaperFigure(
        name="penalty_loops",
        title="Force-displacement with a soft contact",
        note="Undamped finite elements whose surfaces may enter each other: pressure = "
        f"{cases.PENALTY_FACTOR:g} x bulk modulus / element size x depth, up to the largest DCS. The mesh is ours; "
        "the contact is as soft as that of elements of the size above the panel. The five speeds share "
        "one curve and differ in where it ends. Black: the elastic theories up to 10 m/s.",
        data=joined([*(courses(run, "displacement", "force", until="deepest") for run in runs), *compression()]),
        panels=tuple(
            replace(panel, marker="end")
            for group, size in cases.ELEMENT_SIZES.items()
            for panel in each_sphere("displacement", "force", more=f", as soft as {size * 1e3:g} mm", group=group)
        ),
        columns=4,
        highest_strain=strain_of(runs),
    )


def penalty_factor(study: Study) -> PaperFigure:
    """Return what the stiffness of a soft contact does to force and DCS."""
    hard = {(run.case.sphere, run.case.velocity): run.numbers for run in study.of(cases.UNDAMPED)}
    frames, runs = [], study.of(cases.SOFT_BY_FACTOR)
    for run in runs:
        beside = hard[run.case.sphere, run.case.velocity]
        frames.append(
            frame({
                "kind": SIMULATED, "sphere": run.case.sphere, "velocity": run.case.velocity,
                "penalty_factor": run.case.penalty_factor,
                "force_over_hard": run.numbers["peak_force"] / beside["peak_force"],
                "displacement_over_hard": run.numbers["peak_displacement"] / beside["peak_displacement"],
            })
        )  # fmt: skip
    for theory in THEORY_STYLES:
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
            x="penalty_factor", y=y, by="sphere", where={"kind": SIMULATED}, marker="o", logarithmic=True,
            over=tuple(
                Lines(x="penalty_factor", y=y, where={"kind": f"{theory} {cases.FACTOR_SPHERES[0]}"}, colour="black",
                      style=style, label=label, width=1.0)
                for theory, (label, style) in THEORY_STYLES.items()
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
        highest_strain=strain_of(runs),
    )

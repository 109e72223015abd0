"""Runs the finite-element study, on all cores."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np

from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES
from cgid.reproduction import paper
from cgid.reproduction.finite_element.cases import (
    DAMPED,
    ELEMENTS,
    PLATE_RADIUS,
    SOFT_1_MM,
    SOFT_2_MM,
    UNDAMPED,
    Case,
    all_cases,
)
from cgid.reproduction.finite_element.study import COURSES, Run, Study
from cgid.reproduction.finite_element.waves import low_passed
from cgid.workers import workers

if TYPE_CHECKING:
    from cgid.finite_element import History

#: Points of time that are kept of a course.
N_POINTS = 200
_LOOP = ("force", "displacement")
#: Courses that are kept, by group; those of a group that is not here are not.
_KEPT = {UNDAMPED: COURSES, DAMPED: COURSES, SOFT_1_MM: _LOOP, SOFT_2_MM: _LOOP}
#: Names of `History` where they are not the same.
_HISTORY = {"force": "contact_force", "displacement": "centre_displacement", "pressure": "contact_pressure"}
#: Edges of the low-pass for the centre node's force, times the contact's duration.
_EDGES = (4, 5)


def run_study(jobs: int | None = None, progress: Callable[[int], object] | None = None) -> Study:
    """Compute every impact of the study.

    Parameters
    ----------
    jobs : int, optional
        Processes; as many as there are cores if not given.
    progress : callable, optional
        Called with 1 after each impact.
    """
    if jobs is None:
        import joblib

        jobs = int(joblib.cpu_count())
    runs = []
    with workers(jobs) as crew, closing(crew.each(computed, N_POINTS, all_cases())) as found:
        for run in found:
            runs.append(run)
            if progress is not None:
                progress(1)
    return Study(runs=tuple(runs), made=made())


def made() -> str:
    """Return how the study was made, in words."""
    return (
        "axisymmetric linear elasticity (small strains), sphere and plate meshed, "
        f"{ELEMENTS} elements over Hertz's contact radius, contact of nodes that cannot pass through each other; "
        f"round plate {paper.PLATE_SIZE[2] * 1e3:g} mm thick with a radius of {PLATE_RADIUS * 1e3:g} mm, its lower "
        "face fixed as in the paper, its edge free; no gravity"
    )


def computed(n_points: int, case: Case) -> Run:
    """Return the run of a case, with so many points a course."""
    # Loaded here: who only reads the shipped results needs neither the solver nor its compiler.
    from cgid.finite_element import ElasticPlate, FiniteElementImpact, PenaltyContact
    from cgid.physics import Sphere

    soft = PenaltyContact(factor=case.penalty_factor) if case.penalty_factor else None
    history = FiniteElementImpact(
        sphere=Sphere(material=YANG2018_SPHERES[case.sphere], radius=YANG2018_RADIUS),
        plate=ElasticPlate(material=STEEL, thickness=paper.PLATE_SIZE[2], radius=PLATE_RADIUS, lower_face="fixed"),
        velocity=case.velocity,
        retardation_time=case.retardation_time,
        elements=ELEMENTS,
        penalty=soft,
        method="auto",
    ).run()
    return shortened(case, history, n_points)


def shortened(case: Case, history: History, n_points: int) -> Run:
    """Return what of a history is kept."""
    waving = history.centre_node_force
    filtered = [low_passed(waving.samples, waving.sampling_rate, edge / history.contact_duration) for edge in _EDGES]
    numbers = {
        name: float(getattr(history, name))
        for name in (
            "peak_force",
            "peak_displacement",
            "contact_duration",
            "peak_pressure",
            "peak_sphere_energy",
            "peak_plate_energy",
            "restitution",
            "momentum_error",
        )
    }
    numbers["energy_error"] = np.nan if history.energy_error is None else history.energy_error
    numbers |= {f"filtered_at_{edge}": float(course.max()) for edge, course in zip(_EDGES, filtered, strict=True)}
    times = history.times
    wanted = np.linspace(0, times[-1], n_points)
    courses = {
        name: np.interp(
            wanted,
            times,
            filtered[0] if name == "filtered_force" else getattr(history, _HISTORY.get(name, name)).samples,
        )
        for name in _KEPT.get(case.group, ())
    }
    return Run(case=case, numbers=numbers, duration=float(times[-1]), courses=courses)

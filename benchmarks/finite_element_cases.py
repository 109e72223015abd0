"""The impacts of `finite_element.py`, each computed at most once, and the theories for them."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np

from cgid.physics import Elastic, HalfSpace, Impact, Sphere
from cgid.physics.materials import STEEL, YANG2018_SPHERES
from cgid.validation import Floats
from studies.finite_element import ElasticPlate, FiniteElementImpact, History

RADIUS, THICKNESS, PLATE_RADIUS = 0.025, 0.008, 0.229
ELEMENTS = 14
SPEEDS = (2.0, 4.0, 6.0, 8.0, 10.0)
#: The extremes of the paper's study: sphere and speed [m/s].
CORNERS = ((1, 2.0), (1, 10.0), (3, 2.0), (3, 10.0))


def impact(
    sphere: int,
    velocity: float,
    *,
    radius: float = RADIUS,
    thickness: float = THICKNESS,
    plate_radius: float = PLATE_RADIUS,
    lower_face: Any = "fixed",
    elements: int = ELEMENTS,
    **options: Any,
) -> FiniteElementImpact:
    """Return an impact of a sphere of Table 2."""
    plate = ElasticPlate(material=STEEL, thickness=thickness, radius=plate_radius, lower_face=lower_face)
    return FiniteElementImpact(
        sphere=Sphere(material=YANG2018_SPHERES[sphere], radius=radius),
        plate=plate,
        velocity=velocity,
        elements=elements,
        **options,
    )


@functools.cache
def solved(sphere: int, velocity: float, **options: Any) -> tuple[History, float]:
    """Return the history of an impact, and the seconds that it took, including the mesh."""
    start = time.process_time()
    history = impact(sphere, velocity, **options).run()
    return history, time.process_time() - start


def theory(sphere: int, velocity: float, radius: float = RADIUS) -> Impact:
    """Return the elastic impact by Hertz's theory, on a half space."""
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[sphere], radius=radius),
        target=HalfSpace(material=STEEL),
        velocity=velocity,
        stiffness="hertz",
        dissipation=Elastic(),
    )


def peaks(of: History | Impact) -> Floats:
    """Return peak force [N], peak displacement [m], contact duration [s]."""
    return np.array([float(of.peak_force), float(of.peak_displacement), float(of.contact_duration)])


def table(*columns: str) -> None:
    """Print the head of a table."""
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}", flush=True)


def row(*cells: object) -> None:
    """Print a line of a table."""
    print(f"| {' | '.join(str(cell) for cell in cells)} |", flush=True)


def percent(value: float, digits: int = 2) -> str:
    """Return a part of 1 as a signed percentage."""
    return f"{100 * value:+.{digits}f} %"

"""The results of the finite-element study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cgid.reproduction.finite_element.cases import Case
from cgid.validation import Floats

#: Numbers of each impact [SI units].
NUMBERS = (
    "peak_force",
    "peak_displacement",
    "contact_duration",
    "peak_pressure",
    "peak_sphere_energy",
    "peak_plate_energy",
    "restitution",
    "energy_error",
    "momentum_error",
    "filtered_at_4",
    "filtered_at_5",
)
#: Courses over time of which an impact may have some.
COURSES = (
    "force",
    "displacement",
    "pressure",
    "sphere_energy",
    "plate_energy",
    "centre_node_force",
    "filtered_force",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One computed impact.

    Parameters
    ----------
    case : Case
    numbers : mapping of str to float
        Each of `NUMBERS`. `filtered_at_4` and `filtered_at_5` are the peaks of the centre node's mass x acceleration
        behind a low-pass at 4/T and 5/T [N]; `energy_error` is nan where damping takes energy away.
    duration : float
        How long the courses are [s]; they go on a while after the contact.
    courses : mapping of str to ndarray, (n_points,)
        Some of `COURSES`, or none, at even intervals from first touch on.
    """

    case: Case
    numbers: Mapping[str, float]
    duration: float
    courses: Mapping[str, Floats]

    @property
    def times(self) -> Floats:
        """Time of each point of the courses since first touch [s]; none without courses."""
        n_points = next((course.size for course in self.courses.values()), 0)
        return np.linspace(0, self.duration, n_points)


@dataclass(frozen=True, kw_only=True, eq=False)
class Study:
    """Every impact of the study.

    Parameters
    ----------
    runs : tuple of Run
    made : str
        How, in words.
    """

    runs: tuple[Run, ...]
    made: str

    def of(self, group: str) -> tuple[Run, ...]:
        """Return the impacts of a group."""
        return tuple(run for run in self.runs if run.case.group == group)

    def values(self, group: str, name: str) -> Floats:
        """Return one of `NUMBERS` of each impact of a group."""
        return np.array([run.numbers[name] for run in self.of(group)])

"""The results of the finite-element study, and the data file that holds them.

The file in the package is made anew by `cgid reproduce --finite-element -o paper` and copied from there:
`cp paper/finite_element.npz cgid/reproduction/`.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, NoInput
from cgid.reproduction.finite_element.cases import Case
from cgid.validation import Floats

#: The file that comes with the package; `cgid reproduce --finite-element` makes it anew.
STUDY_FILE = "finite_element.npz"
_SHIPPED = Path(__file__).parents[1] / STUDY_FILE
#: Columns that say what was computed, and their kinds.
_CASE = {"group": "U", "sphere": "i", "velocity": "f", "retardation_time": "f", "penalty_factor": "f"}
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
        Some of `COURSES`, at even intervals from first touch on.
    """

    case: Case
    numbers: Mapping[str, float]
    duration: float
    courses: Mapping[str, Floats]

    @property
    def times(self) -> Floats:
        """Time of each point of the courses since first touch [s]."""
        (n_points,) = {course.size for course in self.courses.values()}
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


def packed(study: Study) -> bytes:
    """Return the content of the data file: numbers in float64, courses in float32."""
    arrays: dict[str, Any] = {"made": np.array(study.made)}
    arrays |= {name: np.array([getattr(run.case, name) for run in study.runs]) for name in _CASE}
    arrays |= {name: np.array([run.numbers[name] for run in study.runs]) for name in NUMBERS}
    arrays["duration"] = np.array([run.duration for run in study.runs])
    for name, runs in _with_course(study.runs).items():
        arrays[f"course_{name}"] = np.array([run.courses[name] for run in runs], np.float32)
        arrays[f"runs_{name}"] = np.array([study.runs.index(run) for run in runs])
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _with_course(runs: Iterable[Run]) -> dict[str, list[Run]]:
    runs = list(runs)
    return {name: [run for run in runs if name in run.courses] for name in COURSES}


def read_study(path: Path) -> Study:
    """Return the study that a data file holds.

    Raises
    ------
    NoInput
        There is no such file.
    BadData
        It is no file of a study, or damaged.
    """
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
            return _study({name: stored[name] for name in stored.files})
    except FileNotFoundError:
        raise NoInput(f"{path}: must be there and is missing; make it with cgid reproduce --finite-element") from None
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise BadData(
            f"{path}: must hold a finite-element study, and cannot be read ({error}); make it anew with cgid reproduce "
            "--finite-element"
        ) from None


def _study(arrays: Mapping[str, Any]) -> Study:
    rows = zip(*(arrays[name].tolist() for name in _CASE), strict=True)
    cases = [Case(**dict(zip(_CASE, row, strict=True))) for row in rows]
    courses: list[dict[str, Floats]] = [{} for _ in cases]
    for name in COURSES:
        for index, course in zip(arrays[f"runs_{name}"].tolist(), arrays[f"course_{name}"], strict=True):
            courses[index][name] = course.astype(np.float64)
    numbers = np.column_stack([arrays[name] for name in NUMBERS]).tolist()
    runs = (
        Run(case=case, numbers=dict(zip(NUMBERS, row, strict=True)), duration=duration, courses=found)
        for case, row, duration, found in zip(cases, numbers, arrays["duration"].tolist(), courses, strict=True)
    )
    return Study(runs=tuple(runs), made=str(arrays["made"]))


@cache
def shipped_study() -> Study:
    """Return the study that comes with the package (read once)."""
    return read_study(_SHIPPED)

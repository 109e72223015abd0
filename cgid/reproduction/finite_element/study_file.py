"""The data file of the finite-element study: written, and read again after a look at all that it holds.

The file in the package is made anew by `cgid reproduce --finite-element -o paper` and copied from there:
`cp paper/finite_element.npz cgid/reproduction/`.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, NoInput
from cgid.physics.materials import YANG2018_SPHERES
from cgid.reproduction.finite_element.cases import GROUPS, Case
from cgid.reproduction.finite_element.study import COURSES, NUMBERS, Run, Study
from cgid.validation import Floats

#: The file that comes with the package; `cgid reproduce --finite-element` makes it anew.
STUDY_FILE = "finite_element.npz"
_SHIPPED = Path(__file__).parents[1] / STUDY_FILE
#: Columns that say what was computed, and NumPy's kinds of their numbers.
_CASE = {"group": "U", "sphere": "i", "velocity": "f", "retardation_time": "f", "penalty_factor": "f"}
#: The same of every column that has one value for each impact.
_COLUMNS = {**_CASE, **dict.fromkeys((*NUMBERS, "duration"), "f")}
#: The only column in which a value may be missing (nan).
_MAY_LACK = "energy_error"
_KINDS = {"U": "text", "i": "whole numbers", "f": "numbers in floating point"}


def packed(study: Study) -> bytes:
    """Return the content of the data file: numbers in float64, courses in float32."""
    arrays: dict[str, Any] = {"made": np.array(study.made)}
    arrays |= {name: np.array([getattr(run.case, name) for run in study.runs]) for name in _CASE}
    arrays |= {name: np.array([run.numbers[name] for run in study.runs]) for name in NUMBERS}
    arrays["duration"] = np.array([run.duration for run in study.runs])
    for name, runs in _with_course(study.runs).items():
        n_points = runs[0].times.size if runs else 0
        courses = np.array([run.courses[name] for run in runs], np.float32)
        arrays[f"course_{name}"] = courses.reshape(len(runs), n_points)
        arrays[f"runs_{name}"] = np.array([study.runs.index(run) for run in runs], np.int64)
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
        content = path.read_bytes()
    except FileNotFoundError:
        raise NoInput(f"{path}: must be there and is missing; make it with cgid reproduce --finite-element") from None
    except OSError as error:
        raise _bad(str(path), error.strerror or "it cannot be opened") from None
    return unpacked(content, str(path))


def unpacked(content: bytes, source: str = STUDY_FILE) -> Study:
    """Return the study that is the content of a data file.

    Raises
    ------
    BadData
        It is none, or damaged; `source` is its name in the message.
    """
    try:
        with _archive(content) as stored:
            arrays = {name: stored[name] for name in stored.files}
    # Archives, packed members and headers (through Python's own parser) fail in more ways than can be counted.
    except Exception as error:
        raise _bad(source, " ".join(str(error).split())[:120] or "it ends too early") from None
    if fault := _fault(arrays):
        raise _bad(source, fault)
    return _study(arrays)


def _archive(content: bytes) -> np.lib.npyio.NpzFile:
    stored = np.load(io.BytesIO(content), allow_pickle=False)
    if not isinstance(stored, np.lib.npyio.NpzFile):
        raise ValueError("it is a single array")
    return stored


def _bad(source: str, fault: str) -> BadData:
    return BadData(
        f"{source}: must hold a finite-element study, and cannot be read ({fault}); make it anew with cgid reproduce "
        "--finite-element"
    )


def _fault(arrays: Mapping[str, Any]) -> str:
    """Say what is wrong with the arrays of a file; nothing if they are a study."""
    wanted = ("made", *_COLUMNS, *(f"{part}_{name}" for name in COURSES for part in ("course", "runs")))
    if missing := [name for name in wanted if name not in arrays]:
        return f"{missing[0]} is missing"
    if arrays["made"].dtype.kind != "U" or arrays["made"].ndim:
        return "made must be one text"
    n_runs = arrays["group"].size
    faults = [_column_fault(name, arrays[name], kind, n_runs) for name, kind in _COLUMNS.items()]
    faults += [_course_fault(name, arrays[f"course_{name}"], arrays[f"runs_{name}"], n_runs) for name in COURSES]
    if found := [fault for fault in faults if fault]:
        return found[0]
    if unknown := sorted(set(arrays["group"].tolist()) - set(GROUPS)):
        return f"group must be one of {', '.join(GROUPS)}, got {unknown[0][:40]}"
    if strange := sorted(set(arrays["sphere"].tolist()) - set(YANG2018_SPHERES)):
        return f"sphere must be a number of Table 2, got {strange[0]}"
    lengths = {arrays[f"course_{name}"].shape[1] for name in COURSES if arrays[f"runs_{name}"].size}
    return f"courses must have one number of points, got {sorted(lengths)}" if len(lengths) > 1 else ""


def _column_fault(name: str, column: Any, kind: str, n_runs: int) -> str:
    if column.shape != (n_runs,) or column.dtype.kind != kind:
        return f"{name} must be {n_runs} {_KINDS[kind]}, got {column.dtype} {column.shape}"
    finite = kind != "f" or name == _MAY_LACK or np.isfinite(column).all()
    return "" if finite else f"{name} must be finite everywhere"


def _course_fault(name: str, courses: Any, runs: Any, n_runs: int) -> str:
    if runs.ndim != 1 or runs.dtype.kind != "i" or len(set(runs.tolist()) & set(range(n_runs))) != runs.size:
        return f"runs_{name} must be places among {n_runs} impacts, each once, got {runs.dtype} {runs.shape}"
    if courses.ndim != 2 or courses.dtype.kind != "f" or len(courses) != runs.size:
        return f"course_{name} must be {runs.size} courses, got {courses.dtype} {courses.shape}"
    return "" if np.isfinite(courses).all() else f"course_{name} must be finite everywhere"


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

"""The impacts of the finite-element study: which are computed, and what was chosen for them.

The results of the finite-element study.

Runs the finite-element study, on all cores.

The data file of the finite-element study: written, and read again after a look at all that it holds.

The file in the package is made anew by `cgid reproduce --finite-element -o paper` and copied from there:
`cp paper/finite_element.npz cgid/reproduction/`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid.errors import BadData, NoInput
from cgid.measure.filters import fft_filter
from cgid.physics.bodies import sphere_share
from cgid.physics.inverse import dissipative_constant
from cgid.physics.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES
from cgid.reproduction import paper
from cgid.reproduction.paper import paper_impact
from cgid.validation import Floats
from cgid.workers import workers

if TYPE_CHECKING:
    from cgid.finite_element import History

#: Elements over Hertz's contact radius.
ELEMENTS = 14
#: Restitution of the damped impacts, chosen here: the paper gives no number for its damping. (It has one during the
#: contact, ours is another: the sphere is a Kelvin-Voigt body.)
RESTITUTION = 0.8
#: Radius of the round plate [m]: half the length of the paper's rectangular one.
PLATE_RADIUS = paper.PLATE_SIZE[0] / 2
#: Stiffness of a soft contact per area, times element size over bulk modulus: LS-DYNA's unless told
#: otherwise.
PENALTY_FACTOR = 0.1
#: Factors of a soft contact tried on two spheres at one speed [m/s].
FACTORS, FACTOR_SPHERES, FACTOR_VELOCITY = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0), (1, 3), 6.0

#: Groups of cases: the paper's twenty impacts with hard contact, elastic and damped; elastic with a contact as soft as
#: our elements make it, and as soft as that of larger ones (the mesh stays ours); and two of them with every factor.
UNDAMPED, DAMPED, SOFT, SOFT_BY_FACTOR = "undamped", "damped", "soft", "soft_by_factor"
SOFT_1_MM, SOFT_2_MM = "soft_1_mm", "soft_2_mm"
GROUPS = (UNDAMPED, DAMPED, SOFT, SOFT_1_MM, SOFT_2_MM, SOFT_BY_FACTOR)
#: Size of those larger elements, which are not meshed [m]: of the paper's sphere (section 3.1), and half of it, for its
#: contact has finer ones.
ELEMENT_SIZES = {SOFT_1_MM: 0.001, SOFT_2_MM: 0.002}
#: Impacts of the study.
N_CASES = (3 + len(ELEMENT_SIZES)) * len(YANG2018_SPHERES) * len(paper.VELOCITIES) + len(FACTOR_SPHERES) * len(FACTORS)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One impact of the study, of a sphere of Table 2 on the plate.

    Parameters
    ----------
    group : str
    sphere : int
        Number in Table 2.
    velocity : float
        [m/s].
    retardation_time : float
        Of the sphere as a Kelvin-Voigt body [s].
    penalty_factor : float
        Of a soft contact; 0 for a hard one.
    """

    group: str
    sphere: int
    velocity: float
    retardation_time: float = 0.0
    penalty_factor: float = 0.0


def all_cases() -> list[Case]:
    """Return every case, group by group, the four spheres at five speeds each."""
    twenty = [(sphere, velocity) for sphere in YANG2018_SPHERES for velocity in paper.VELOCITIES]
    return [
        *(Case(group=UNDAMPED, sphere=sphere, velocity=velocity) for sphere, velocity in twenty),
        *(
            Case(group=DAMPED, sphere=sphere, velocity=velocity, retardation_time=retardation_time)
            for sphere in YANG2018_SPHERES
            for velocity, retardation_time in zip(paper.VELOCITIES, retardation_times(sphere), strict=True)
        ),
        *(
            Case(group=SOFT, sphere=sphere, velocity=velocity, penalty_factor=PENALTY_FACTOR)
            for sphere, velocity in twenty
        ),
        *(
            Case(group=group, sphere=sphere, velocity=velocity, penalty_factor=factor_of(size, sphere, velocity))
            for group, size in ELEMENT_SIZES.items()
            for sphere, velocity in twenty
        ),
        *(
            Case(group=SOFT_BY_FACTOR, sphere=sphere, velocity=FACTOR_VELOCITY, penalty_factor=factor)
            for sphere in FACTOR_SPHERES
            for factor in FACTORS
        ),
    ]


def retardation_times(sphere: int) -> list[float]:
    """Return b [s] of a Kelvin-Voigt sphere that has the chosen restitution at each speed of the paper.

    By Kuwabara and Kono's `A = 3/2 b s`, the contact law of such a sphere (s is its share in the compliance of both
    bodies): so nothing is fitted, and what restitution the finite elements then have is a result.
    """
    impact = paper_impact(sphere, paper.VELOCITIES, "hertz")
    share = sphere_share(impact.sphere, impact.target)
    return [float(time) for time in dissipative_constant(RESTITUTION, impact) / (1.5 * share)]


def factor_of(size: float, sphere: int, velocity: float) -> float:
    """Return the factor with which our elements press as softly as `PENALTY_FACTOR` does with elements of this size."""
    return PENALTY_FACTOR * element_size(sphere, velocity) / size


def element_size(sphere: int, velocity: float) -> float:
    """Return the size of our elements at the contact [m]: a part of Hertz's contact radius."""
    impact = paper_impact(sphere, velocity, "hertz")
    return float(np.sqrt(impact.reduced_radius * impact.peak_displacement)) / ELEMENTS


def element_sizes() -> list[float]:
    """Return the size of our elements at the contact of each of the twenty impacts [m]."""
    return [element_size(sphere, velocity) for sphere in YANG2018_SPHERES for velocity in paper.VELOCITIES]


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


def low_passed(samples: Floats, sampling_rate: float, edge: float) -> Floats:
    """Return a course behind the paper's FFT filter, a brick wall at an edge [Hz]."""
    # The filter is circular: before the touch there was nothing, and that must be said.
    whole = np.concatenate((np.zeros(samples.size), samples))
    return np.asarray(fft_filter(whole, sampling_rate, high=edge)[samples.size :], np.float64)


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


#: The file that comes with the package; `cgid reproduce --finite-element` makes it anew.
STUDY_FILE = "finite_element.npz"
_SHIPPED = Path(__file__).with_name(STUDY_FILE)
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

"""The finite-element study of the paper's impacts: cases, results, computation, data file.

To renew the shipped file: `python -m studies.paper --finite-element -o paper`, then
`cp paper/finite_element.npz studies/paper/`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid._lib.validation import Floats
from cgid._lib.workers import workers
from cgid.measure.filters import fft_filter
from cgid.physics.contact.bodies import sphere_share
from cgid.physics.contact.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES
from studies.paper import printed
from studies.paper.printed import paper_impact
from studies.paper.sensitivity import dissipative_constant

if TYPE_CHECKING:
    from studies.finite_element import History

# ---- cases ----------------------------------------------------------------------------------------------------------

#: Number of elements over Hertz's contact radius.
ELEMENTS = 14
#: Restitution of the damped impacts, chosen here: the paper does not quantify its damping, which acts during contact.
#: Here the sphere is a Kelvin-Voigt body.
RESTITUTION = 0.8
#: Radius of the round plate [m]: half the length of the paper's rectangular plate.
PLATE_RADIUS = printed.PLATE_SIZE[0] / 2
#: Stiffness per area of a soft contact, times element size / bulk modulus; the default of LS-DYNA.
PENALTY_FACTOR = 0.1
#: Factors of a soft contact for two spheres at one speed [m/s].
FACTORS, FACTOR_SPHERES, FACTOR_VELOCITY = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0), (1, 3), 6.0

#: Groups of cases. Each of the first five holds the paper's twenty impacts: hard contact, elastic and damped; elastic
#: with the soft contact of our element size, and with that of larger elements (on our mesh). The last group holds two
#: impacts with every factor.
UNDAMPED, DAMPED, SOFT, SOFT_BY_FACTOR = "undamped", "damped", "soft", "soft_by_factor"
SOFT_1_MM, SOFT_2_MM = "soft_1_mm", "soft_2_mm"
#: Size of the larger elements [m]: as in the paper's sphere (section 3.1), and half, as its mesh is finer at the
#: contact.
ELEMENT_SIZES = {SOFT_1_MM: 0.001, SOFT_2_MM: 0.002}

#: Sphere and speed of the paper's twenty impacts.
_TWENTY = [(sphere, velocity) for sphere in YANG2018_SPHERES for velocity in printed.VELOCITIES]
#: Number of impacts in the study.
N_CASES = (3 + len(ELEMENT_SIZES)) * len(_TWENTY) + len(FACTOR_SPHERES) * len(FACTORS)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One impact of the study: a sphere of Table 2 on the plate.

    sphere : number in Table 2
    velocity : [m/s]
    retardation_time : of the sphere as a Kelvin-Voigt body [s]
    penalty_factor : of a soft contact; 0 for a hard one
    """

    group: str
    sphere: int
    velocity: float
    retardation_time: float = 0.0
    penalty_factor: float = 0.0


def all_cases() -> list[Case]:
    """Return every case, group by group."""
    times = [time for sphere in YANG2018_SPHERES for time in retardation_times(sphere)]
    cases = [Case(group=UNDAMPED, sphere=sphere, velocity=velocity) for sphere, velocity in _TWENTY]
    cases += [
        Case(group=DAMPED, sphere=sphere, velocity=velocity, retardation_time=time)
        for (sphere, velocity), time in zip(_TWENTY, times, strict=True)
    ]
    cases += [
        Case(group=SOFT, sphere=sphere, velocity=velocity, penalty_factor=PENALTY_FACTOR)
        for sphere, velocity in _TWENTY
    ]
    for group, size in ELEMENT_SIZES.items():
        # With this factor our elements are as soft as elements of this size.
        factors = [PENALTY_FACTOR * own / size for own in element_sizes()]
        cases += [
            Case(group=group, sphere=sphere, velocity=velocity, penalty_factor=factor)
            for (sphere, velocity), factor in zip(_TWENTY, factors, strict=True)
        ]
    cases += [
        Case(group=SOFT_BY_FACTOR, sphere=sphere, velocity=FACTOR_VELOCITY, penalty_factor=factor)
        for sphere in FACTOR_SPHERES
        for factor in FACTORS
    ]
    return cases


def retardation_times(sphere: int) -> list[float]:
    """Return the retardation time b [s] of the Kelvin-Voigt sphere for the chosen restitution, at each speed.

    By Kuwabara and Kono, `A = 3/2 b s`, where s is the sphere's share of the compliance of both bodies. Nothing is
    fitted: the restitution of the finite elements is a result.
    """
    impact = paper_impact(sphere, printed.VELOCITIES, "hertz")
    share = sphere_share(impact.sphere, impact.target)
    return [float(time) for time in dissipative_constant(RESTITUTION, impact) / (1.5 * share)]


def element_sizes() -> list[float]:
    """Return the element size at the contact [m], Hertz's contact radius / `ELEMENTS`, of the twenty impacts."""
    impacts = [paper_impact(sphere, velocity, "hertz") for sphere, velocity in _TWENTY]
    return [float(np.sqrt(impact.reduced_radius * impact.peak_displacement)) / ELEMENTS for impact in impacts]


# ---- results --------------------------------------------------------------------------------------------------------

#: Results of each impact that the solver returns [SI units].
_OF_HISTORY = (
    "peak_force",
    "peak_displacement",
    "contact_duration",
    "peak_pressure",
    "peak_sphere_energy",
    "peak_plate_energy",
    "restitution",
    "energy_error",
    "momentum_error",
)
#: Edges of the low-pass for the force of the centre node, times the contact duration.
_EDGES = (4, 5)
#: All scalar results of each impact.
NUMBERS = (*_OF_HISTORY, *(f"filtered_at_{edge}" for edge in _EDGES))
#: Time series, with the solver's name for each.
_COURSE_OF_HISTORY = {
    "force": "contact_force",
    "displacement": "centre_displacement",
    "pressure": "contact_pressure",
    "sphere_energy": "sphere_energy",
    "plate_energy": "plate_energy",
    "centre_node_force": "centre_node_force",
}
#: All time series that an impact may have.
COURSES = (*_COURSE_OF_HISTORY, "filtered_force")


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One computed impact.

    numbers : each of `NUMBERS`; `filtered_at_4` and `filtered_at_5` are the peak of the centre node's
        mass x acceleration after a low-pass at 4/T and 5/T [N]; `energy_error` is nan with damping
    duration : of the time series [s], which continue for some time after the contact
    courses : none or some of `COURSES`, (n_points,), at even intervals from first touch
    """

    case: Case
    numbers: Mapping[str, float]
    duration: float
    courses: Mapping[str, Floats]

    @property
    def times(self) -> Floats:
        """Times of the points of `courses` since first touch [s]; empty without courses."""
        n_points = next((course.size for course in self.courses.values()), 0)
        return np.linspace(0, self.duration, n_points)


@dataclass(frozen=True, kw_only=True, eq=False)
class Study:
    """Every impact of the study, and a description of how it was made."""

    runs: tuple[Run, ...]
    made: str

    def of(self, group: str) -> tuple[Run, ...]:
        """Return the impacts of a group."""
        return tuple(run for run in self.runs if run.case.group == group)

    def values(self, group: str, name: str) -> Floats:
        """Return one of `NUMBERS` for each impact of a group."""
        return np.array([run.numbers[name] for run in self.of(group)])


# ---- computing ------------------------------------------------------------------------------------------------------

#: Stored points of a time series.
N_POINTS = 200
#: Stored time series by group; the other groups store none.
_KEPT = {UNDAMPED: COURSES, DAMPED: COURSES, **dict.fromkeys(ELEMENT_SIZES, ("force", "displacement"))}


def run_study(jobs: int | None = None, progress: Callable[[int], object] | None = None) -> Study:
    """Compute every impact with `jobs` processes, by default one per core; call `progress(1)` after each."""
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
    """Return a description of how the study is made."""
    return (
        "axisymmetric linear elasticity (small strains), sphere and plate meshed, "
        f"{ELEMENTS} elements over Hertz's contact radius, contact of nodes that cannot pass through each other; "
        f"round plate {printed.PLATE_SIZE[2] * 1e3:g} mm thick with a radius of {PLATE_RADIUS * 1e3:g} mm, its lower "
        "face fixed as in the paper, its edge free; no gravity"
    )


def computed(n_points: int, case: Case) -> Run:
    """Compute a case; each time series has `n_points` points."""
    # A local import: reading the shipped results needs neither the solver nor its compiler.
    from cgid.physics import Sphere
    from studies.finite_element import ElasticPlate, FiniteElementImpact, PenaltyContact

    soft = PenaltyContact(factor=case.penalty_factor) if case.penalty_factor else None
    history = FiniteElementImpact(
        sphere=Sphere(material=YANG2018_SPHERES[case.sphere], radius=YANG2018_RADIUS),
        plate=ElasticPlate(material=STEEL, thickness=printed.PLATE_SIZE[2], radius=PLATE_RADIUS, lower_face="fixed"),
        velocity=case.velocity,
        retardation_time=case.retardation_time,
        elements=ELEMENTS,
        penalty=soft,
        method="auto",
    ).run()
    return shortened(case, history, n_points)


def shortened(case: Case, history: History, n_points: int) -> Run:
    """Return the stored part of a history."""
    waving = history.centre_node_force
    filtered = [low_passed(waving.samples, waving.sampling_rate, edge / history.contact_duration) for edge in _EDGES]
    # Damped impacts have no energy balance.
    numbers = {name: float(np.nan if (value := getattr(history, name)) is None else value) for name in _OF_HISTORY}
    numbers |= {f"filtered_at_{edge}": float(course.max()) for edge, course in zip(_EDGES, filtered, strict=True)}
    courses = {name: getattr(history, of).samples for name, of in _COURSE_OF_HISTORY.items()}
    courses["filtered_force"] = filtered[0]
    times = history.times
    wanted = np.linspace(0, times[-1], n_points)
    kept = {name: np.interp(wanted, times, courses[name]) for name in _KEPT.get(case.group, ())}
    return Run(case=case, numbers=numbers, duration=float(times[-1]), courses=kept)


def low_passed(samples: Floats, sampling_rate: float, edge: float) -> Floats:
    """Apply the paper's FFT filter, a brick wall at `edge` [Hz]."""
    # The filter is circular; zeros before the touch keep the end from leaking into the beginning.
    whole = np.concatenate((np.zeros(samples.size), samples))
    return np.asarray(fft_filter(whole, sampling_rate, high=edge)[samples.size :], np.float64)


# ---- the data file --------------------------------------------------------------------------------------------------

#: The shipped file; `python -m studies.paper --finite-element` makes it anew.
STUDY_FILE = "finite_element.npz"
#: Columns that describe a case.
_CASE = tuple(field.name for field in fields(Case))


def packed(study: Study) -> bytes:
    """Return the content of the data file: scalars in float64, time series in float32."""
    arrays: dict[str, Any] = {"made": np.array(study.made)}
    arrays |= {name: np.array([getattr(run.case, name) for run in study.runs]) for name in _CASE}
    arrays |= {name: np.array([run.numbers[name] for run in study.runs]) for name in NUMBERS}
    arrays["duration"] = np.array([run.duration for run in study.runs])
    for name in COURSES:
        places = [place for place, run in enumerate(study.runs) if name in run.courses]
        courses = [study.runs[place].courses[name] for place in places]
        arrays[f"course_{name}"] = np.array(courses, np.float32).reshape(len(courses), -1 if courses else 0)
        arrays[f"runs_{name}"] = np.array(places, np.int64)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> Study:
    """Return the study in the content of a data file."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        return _study({name: stored[name] for name in stored.files})


def _study(arrays: Mapping[str, Any]) -> Study:
    n_runs = arrays["group"].size
    courses: list[dict[str, Floats]] = [{} for _ in range(n_runs)]
    for name in COURSES:
        for place, course in zip(arrays[f"runs_{name}"].tolist(), arrays[f"course_{name}"], strict=True):
            courses[place][name] = course.astype(np.float64)
    runs = (
        Run(
            case=Case(**{name: arrays[name][place].item() for name in _CASE}),
            numbers={name: arrays[name][place].item() for name in NUMBERS},
            duration=arrays["duration"][place].item(),
            courses=courses[place],
        )
        for place in range(n_runs)
    )
    return Study(runs=tuple(runs), made=str(arrays["made"]))


@cache
def shipped_study() -> Study:
    """Return the shipped study, read once."""
    return unpacked(Path(__file__).with_name(STUDY_FILE).read_bytes())

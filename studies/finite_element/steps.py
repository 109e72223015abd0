"""Time integration of a finite-element impact: explicit central differences, implicit steps, and their records."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cgid._lib.validation import Floats
from cgid.errors import CgidError, InvalidValue
from studies.finite_element._stepping import advance, press
from studies.finite_element.assembly import Body, Pair
from studies.finite_element.mesh import REACH

#: Explicit records per duration of a Hertz impact, and records between checks for the end of the impact.
PER_DURATION, AT_ONCE = 2000, 25
#: The run continues for this fraction of Hertz's duration after the contact, and ends at the latest at this multiple.
AFTERWARDS, LONGEST = 0.25, 12.0
#: Fewest and most steps per duration of a Hertz impact: fewer do not resolve it, more take hours.
MIN_STEPS, MAX_STEPS = 50, 1_000_000
#: Default explicit step over the stable one, and fewest steps between records: a contact that begins or ends within a
#: step loses energy in proportion to the squared step, and a coarse mesh would allow large steps.
_CAUTION, _MIN_PER_RECORD = 0.9, 2
#: Default implicit steps per duration: errors of about .1 % of the peak force, .2 % of the duration.
STEPS_PER_DURATION = 500
#: Retardation times beyond this multiple of the duration make a body rigid.
_SLOWEST = 100.0
#: Columns of `Records.values`, and those of the momenta of sphere and plate.
N_VALUES, MOMENTA = 9, slice(6, 8)

Progress = Callable[[float], object]


@dataclass(frozen=True)
class Records:
    """The motion at even intervals from first touch on.

    `interval` separates the records, `step` the integration steps [s]; `forces` are those of each contact node [N],
    (n_records, n_contact). The columns of `values`, upwards positive: displacements of the sphere's centre and mass
    centre [m], acceleration of its centre [m/s^2], internal energies of sphere and plate and total kinetic energy [J],
    momenta of sphere and plate, and impulse of the contact force so far [N s].
    """

    interval: float
    step: float
    forces: Floats
    values: Floats


def collected(run: Run, pair: Pair, duration: float, progress: Progress | None) -> Records:
    """Return the records of a run; it ends a while after the last contact force, once the mass centres separate.

    A swinging free plate could still hit the sphere after that. `InvalidValue` is raised if the contact outgrows the
    fine part of the mesh, or the bodies never separate, or do so within a few steps.
    """
    forces: list[Floats] = []
    values: list[Floats] = []
    count = last = 0
    interval, step = run.interval, run.step
    for some_forces, some_values in run.chunks:
        if some_forces[:, -1].any():
            raise InvalidValue(
                f"the contact must stay within {REACH:g} times Hertz's contact radius, which the mesh is made for, "
                "and it grew wider; use a stiffer contact, or a thicker plate"
            )
        pressed = np.flatnonzero(some_forces.any(axis=1))
        if pressed.size:
            last = count + int(pressed[-1]) + 1
        forces.append(some_forces)
        values.append(some_values)
        count += len(some_forces)
        if progress is not None:
            progress(count * interval / duration)
        is_quiet = (count - last) * interval >= AFTERWARDS * duration and count * interval >= duration / 2
        if is_quiet and pair.parting_speed(*some_values[-1, MOMENTA]) >= 0:
            _require_resolved((last - 1) * interval, step)
            kept = last + int(AFTERWARDS * duration / interval)
            return Records(interval, step, np.concatenate(forces)[:kept], np.concatenate(values)[:kept])
        if count * interval > LONGEST * duration:
            break
    raise InvalidValue(
        f"the sphere must part from the plate, it still touches or nears it after {count * interval:.3g} s, "
        f"{LONGEST:g} durations of an elastic impact; use a smaller retardation_time, or a heavier plate"
    )


def _require_resolved(contact_duration: float, step: float) -> None:
    """Raise `InvalidValue` for a contact of only a few steps: a light plate ends it long before Hertz's theory does."""
    if contact_duration < MIN_STEPS * step:
        raise InvalidValue(
            f"time_step must be at most a {MIN_STEPS}th of the contact, which lasted {contact_duration:.3g} s, got "
            f"{step:.3g} s; use {contact_duration / (4 * MIN_STEPS):.2g} s"
        )


def require_times_fit(retardation: tuple[float, float], time_step: float | None, duration: float) -> None:
    """Raise `InvalidValue` if step or retardation times are out of proportion to the duration of the contact [s]."""
    if max(retardation) > _SLOWEST * duration:
        raise InvalidValue(
            f"retardation_time must be at most {_SLOWEST * duration:.3g} s, {_SLOWEST:g} times the contact of Hertz's "
            f"theory, got {max(retardation):.3g} s; nothing deforms with more"
        )
    if time_step is None:
        return
    longest, shortest = duration / MIN_STEPS, duration / MAX_STEPS
    if not shortest <= time_step <= longest:
        raise InvalidValue(
            f"time_step must be between {shortest:.3g} and {longest:.3g} s, {MAX_STEPS} and {MIN_STEPS} steps "
            f"of the contact of Hertz's theory, got {time_step:.3g} s; leave it out and it is chosen"
        )


def stable_time_step(pair: Pair, retardation: tuple[float, float]) -> float:
    """Return the largest stable step [s].

    For central differences with damping by the velocities of half a step before, it is `2 / w (sqrt(1 + z^2) - z)`,
    with `w` the highest frequency of a body and `z = b w / 2` (Belytschko, Liu & Moran, Nonlinear Finite Elements,
    section 6.2). Massless nodes and the contact between them only lower the frequencies.
    """
    limits = []
    for frequency, delay in zip(pair.highest_frequencies, retardation, strict=True):
        ratio = delay * frequency / 2
        limits.append(2 / frequency / (np.hypot(1, ratio) + ratio))
    return float(min(limits))


@dataclass(frozen=True)
class Run:
    """Records to come, chunk by chunk (forces and values of `Records`), their interval and the integration step [s]."""

    chunks: Iterator[tuple[Floats, Floats]]
    interval: float
    step: float


def explicit(
    pair: Pair, velocity: float, duration: float, retardation: tuple[float, float], time_step: float | None
) -> Run:
    """Return the run after touch at `velocity` [m/s]; `duration` [s] estimates the contact.

    A step beyond the stability limit raises `InvalidValue`.
    """
    limit = stable_time_step(pair, retardation)
    if limit * MAX_STEPS < duration:
        raise InvalidValue(
            f"the explicit method needs steps of {limit:.3g} s here, and may take at most {MAX_STEPS} in the contact "
            f"of {duration:.3g} s; use method implicit"
        )
    step, stride = _step_and_stride(limit, duration / PER_DURATION, time_step)
    return Run(_explicit_chunks(pair, velocity, np.array(retardation), step, stride), step * stride, step)


def _step_and_stride(limit: float, interval: float, time_step: float | None) -> tuple[float, int]:
    if time_step is None:
        stride = max(_MIN_PER_RECORD, int(np.ceil(interval / (_CAUTION * limit))))
        return interval / stride, stride
    if time_step > limit:
        raise InvalidValue(
            f"time_step must not pass the limit of stability, {limit:.4g} s, got {time_step:.4g} s; take a smaller "
            "step, or method implicit, which has no such limit"
        )
    return time_step, max(1, round(interval / time_step))


def _explicit_chunks(
    pair: Pair, velocity: float, retardation: Floats, step: float, stride: int
) -> Iterator[tuple[Floats, Floats]]:
    matrix = (pair.stiffness.indptr, pair.stiffness.indices, pair.stiffness.data.reshape(-1, 4))
    touch = np.stack(pair.touching)
    size, n = pair.mass.size, touch.shape[1]
    stiffness = pair.stiffness.tocsr()
    inverse = np.stack([np.linalg.inv(stiffness[rows][:, rows].toarray()) for rows in touch])
    lag = retardation / step
    compliance = inverse[0] / (1 + lag[0]) + inverse[1] / (1 + lag[1]) + np.diag(pair.soft_part)
    moving = (pair.mass > 0) & ~pair.fixed
    inertia = (
        pair.mass,
        np.divide(1.0, pair.mass, out=np.zeros(size), where=moving),
        step,
        retardation,
        pair.n_sphere,
        pair.centre,
    )
    v = np.zeros(size)
    v[1 : pair.n_sphere : 2] = -velocity
    v[touch.ravel()] = 0.0
    state = (np.zeros(size), v, np.zeros((2, n)), np.zeros(n), np.zeros(n, np.bool_), np.zeros(1))
    while True:
        rows = (np.empty((AT_ONCE, n)), np.empty((AT_ONCE, N_VALUES)))
        if not advance(matrix, (touch, inverse, compliance, pair.gap), inertia, state, rows, stride):
            raise CgidError("the contact found no set of nodes that press and do not pull; use another time_step")
        yield rows


def implicit(
    pair: Pair, velocity: float, duration: float, retardation: tuple[float, float], time_step: float | None
) -> Run:
    """Return the run after touch at `velocity` [m/s]; `duration` [s] estimates the contact.

    Second-order backward differences (BDF2) for displacements and velocities damp what they cannot resolve, so massless
    nodes and strong damping do no harm.
    """
    step = duration / STEPS_PER_DURATION if time_step is None else time_step
    return Run(_implicit_chunks(pair, velocity, retardation, step), step, step)


class _Band:
    """A symmetric matrix with a banded Cholesky factor: here two to five times faster than a general sparse factor."""

    def __init__(self, matrix: Any) -> None:
        from scipy.linalg import cholesky_banded
        from scipy.sparse import csgraph

        matrix = sparse.csr_array(matrix)
        self._order: NDArray[np.int32] = csgraph.reverse_cuthill_mckee(matrix, symmetric_mode=True)
        entries = matrix[self._order][:, self._order].tocoo()
        below = entries.row - entries.col
        lower = below >= 0
        band = np.zeros((below.max() + 1, matrix.shape[0]))
        band[below[lower], entries.col[lower]] = entries.data[lower]
        self._factor = np.asfortranarray(cholesky_banded(band, lower=True))

    def solve(self, right: Floats) -> Floats:
        """Return the solution for one right-hand side or a matrix of them."""
        from scipy.linalg import lapack

        found, _ = lapack.dpbtrs(self._factor, right[self._order], lower=1)
        solution = np.empty_like(right)
        solution[self._order] = found.reshape(right.shape)
        return solution


class _Mover:
    """A body that steps first without contact, then with the contact forces."""

    def __init__(self, body: Body, mass: Floats, retardation: float, step: float, speed: float) -> None:
        free = body.free
        self.stiffness = body.stiffness[free][:, free]
        self.mass, self.retardation, self.step = mass[free], retardation, step
        stepped = (1 + 1.5 * retardation / step) * self.stiffness + sparse.diags_array(2.25 / step**2 * self.mass)
        self._solve = _Band(stepped).solve
        self.contact = np.searchsorted(free, body.contact)
        pressed = np.zeros((free.size, self.contact.size))
        pressed[self.contact, np.arange(self.contact.size)] = 1.0
        self.yielding = self._solve(pressed)
        self.axial = free % 2 == 1
        # Before touch the body moved at constant speed.
        self.v = np.where(self.axial, speed, 0.0)
        self.u = np.zeros(free.size)
        self._before = (self.u - step * self.v, self.v)

    def fly(self) -> Floats:
        """Return the displacements after a step without contact; `move` then completes the step."""
        (u, v), step = self._before, self.step
        self._late_u = (u - 4 * self.u) / (2 * step)
        late_v = (v - 4 * self.v) / (2 * step)
        inertia = self.mass * (1.5 / step * self._late_u + late_v)
        if self.retardation:
            inertia = inertia + self.retardation * (self.stiffness @ self._late_u)
        self._ahead = self._solve(-inertia)
        return np.asarray(self._ahead)

    def move(self, forces: Floats) -> None:
        """Complete the step under these contact forces."""
        self._before = (self.u, self.v)
        self.u = self._ahead + self.yielding @ forces
        self.v = 1.5 / self.step * self.u + self._late_u

    @property
    def compliance(self) -> Floats:
        """Displacement of the contact nodes per force on them, within a step."""
        return np.asarray(self.yielding[self.contact])

    @property
    def internal_energy(self) -> float:
        """Elastic energy [J]."""
        return float(self.u @ (self.stiffness @ self.u)) / 2

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy of all nodes, including vibration [J]."""
        return float(self.v @ (self.mass * self.v)) / 2


def _implicit_chunks(
    pair: Pair, velocity: float, retardation: tuple[float, float], step: float
) -> Iterator[tuple[Floats, Floats]]:
    masses = (pair.mass[: pair.n_sphere], pair.mass[pair.n_sphere :])
    sphere = _Mover(pair.sphere, masses[0], retardation[0], step, -velocity)
    plate = _Mover(pair.plate, masses[1], retardation[1], step, 0.0)
    compliance = np.ascontiguousarray(sphere.compliance + plate.compliance + np.diag(pair.soft_part))
    centre = int(np.searchsorted(pair.sphere.free, pair.centre))
    stiffness_of_centre = sphere.stiffness[[centre]].toarray()[0] / sphere.mass[centre]
    weights, plate_weights = (np.where(body.axial, body.mass, 0.0) for body in (sphere, plate))
    force, touching, impulse = np.zeros(pair.gap.size), np.zeros(pair.gap.size, np.bool_), 0.0
    while True:
        forces, values = np.empty((AT_ONCE, pair.gap.size)), np.empty((AT_ONCE, N_VALUES))
        for record in range(AT_ONCE):
            forces[record] = force
            values[record] = (
                sphere.u[centre],
                weights @ sphere.u / weights.sum(),
                -(stiffness_of_centre @ (sphere.u + sphere.retardation * sphere.v)),
                sphere.internal_energy,
                plate.internal_energy,
                sphere.kinetic_energy + plate.kinetic_energy,
                weights @ sphere.v,
                plate_weights @ plate.v,
                impulse,
            )
            gap = pair.gap + sphere.fly()[sphere.contact] - plate.fly()[plate.contact]
            if not press(compliance, gap, force, touching):
                raise CgidError("the contact found no set of nodes that press and do not pull; use another time_step")
            impulse += step / 2 * float(forces[record].sum() + force.sum())
            sphere.move(force)
            plate.move(-force)
        yield forces, values

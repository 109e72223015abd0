"""Implicit steps (BDF2): the way through time where damping would make explicit steps too small."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cgid.errors import CgidError
from cgid.finite_element._stepping import press
from cgid.finite_element.elasticity import Body
from cgid.finite_element.pair import Pair
from cgid.finite_element.records import AT_ONCE, N_VALUES, Progress, Records, collected
from cgid.validation import Floats

#: Steps of a Hertz impact's duration unless told otherwise: some .1 % of the peak force, .2 % of the duration.
PER_DURATION = 500


def implicit(
    pair: Pair,
    velocity: float,
    duration: float,
    *,
    retardation: tuple[float, float],
    time_step: float | None,
    progress: Progress | None,
) -> Records:
    """Return the motion after the sphere touches at `velocity` [m/s], where it is about in contact for `duration` [s].

    Second-order backward differences, once for displacements and once for velocities: they damp what they cannot
    follow, so massless nodes and strong damping do no harm.

    Raises
    ------
    InvalidValue
        The bodies never part.
    """
    step = duration / PER_DURATION if time_step is None else time_step
    return collected(_chunks(pair, velocity, retardation, step), pair, step, step, duration, progress)


class _Band:
    """A symmetric matrix, factored as a band: two to five times quicker to solve here than a general sparse factor."""

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
        """Return the solution for one right-hand side, or for a matrix of them."""
        from scipy.linalg import lapack

        found, _ = lapack.dpbtrs(self._factor, right[self._order], lower=1)
        solution = np.empty_like(right)
        solution[self._order] = found.reshape(right.shape)
        return solution


class _Mover:
    """A body that goes a step ahead: freely first, then by the forces that turn out."""

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
        # Before the touch it flew straight on.
        self.v = np.where(self.axial, speed, 0.0)
        self.u = np.zeros(free.size)
        self._before = (self.u - step * self.v, self.v)

    def fly(self) -> Floats:
        """Return where it would be after a step without contact; `move` then takes the step."""
        (u, v), step = self._before, self.step
        self._late_u = (u - 4 * self.u) / (2 * step)
        late_v = (v - 4 * self.v) / (2 * step)
        inertia = self.mass * (1.5 / step * self._late_u + late_v)
        if self.retardation:
            inertia = inertia + self.retardation * (self.stiffness @ self._late_u)
        self._ahead = self._solve(-inertia)
        return np.asarray(self._ahead)

    def move(self, forces: Floats) -> None:
        """Take the step under these contact forces."""
        self._before = (self.u, self.v)
        self.u = self._ahead + self.yielding @ forces
        self.v = 1.5 / self.step * self.u + self._late_u

    @property
    def compliance(self) -> Floats:
        """Displacement of contact nodes by forces on them, within a step."""
        return np.asarray(self.yielding[self.contact])

    @property
    def internal_energy(self) -> float:
        """Elastic energy [J]."""
        return float(self.u @ (self.stiffness @ self.u)) / 2

    @property
    def kinetic_energy(self) -> float:
        """Of all nodes, vibration and all [J]."""
        return float(self.v @ (self.mass * self.v)) / 2


def _chunks(
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

"""A slow twin of the finite-element impact: the same bodies with another integrator and another contact.

Matrices come from `ElementTwin`; only the node positions come from `studies.finite_element`. Nodes that may touch have
no mass along z: they are always in equilibrium, by non-negative least squares (scipy). The rest is a differential
equation, solved in the natural modes of the bodies by an eighth-order Runge-Kutta method (scipy).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from scipy.optimize import nnls

from studies.tests.element_twin import ElementTwin


class BodyTwin:
    """One body: its natural modes, and the motion of its contact nodes with them.

    squares : squares of the natural frequencies without contact [1/s^2], (n_modes,)
    follow : displacement of the contact nodes per mode, (n_contact, n_modes); transposed, the effect of their forces on
        the modes
    yielding : additional displacement of those nodes by forces on them [m/N], (n_contact, n_contact)
    axial : momentum along z of each mode at speed 1 [kg^(1/2)], (n_modes,)
    shapes : displacement of every unknown per mode without contact, (n_unknowns, n_modes); unknown 2 k + 1 is u_z of
        node k
    """

    def __init__(self, mesh, material, held, volume: float) -> None:
        count = len(mesh.nodes)
        twin = ElementTwin(mesh.nodes[mesh.elements], material, points=2)
        stiffness, mass = np.zeros((2 * count, 2 * count)), np.zeros(count)
        for corners, own_stiffness, own_mass in zip(mesh.elements, twin.stiffness(), twin.mass(), strict=True):
            unknowns = (2 * corners[:, None] + [0, 1]).ravel()
            stiffness[np.ix_(unknowns, unknowns)] += own_stiffness
            mass[corners] += own_mass
        mass = np.repeat(mass * (volume * float(np.asarray(material.density)) / mass.sum()), 2)
        self._leave_without_mass(mesh, mass)
        touching = 2 * np.asarray(mesh.contact) + 1
        still = {2 * node for node in np.flatnonzero(mesh.nodes[:, 0] == 0)}
        still |= {unknown for node in held for unknown in (2 * node, 2 * node + 1)}
        moving = np.array([k for k in range(2 * count) if k not in still and k not in set(touching)])
        self.yielding = np.linalg.inv(stiffness[np.ix_(touching, touching)])
        follow = -self.yielding @ stiffness[np.ix_(touching, moving)]
        rest = stiffness[np.ix_(moving, moving)] + stiffness[np.ix_(moving, touching)] @ follow
        self.squares, shapes = eigh(rest, np.diag(mass[moving]))
        self.follow = follow @ shapes
        self.shapes = np.zeros((2 * count, moving.size))
        self.shapes[moving], self.shapes[touching] = shapes, self.follow
        self.axial = (mass[moving] * (moving % 2)) @ shapes

    @staticmethod
    def _leave_without_mass(mesh, mass) -> None:
        """Move the axial mass of contact nodes to the nearest other node of their elements."""
        touching = set(mesh.contact)
        for node in mesh.contact:
            near = {k for corners in mesh.elements if touching & set(corners) for k in corners} - touching
            nearest = min(sorted(near), key=lambda k: np.linalg.norm(mesh.nodes[k] - mesh.nodes[node]))
            mass[2 * nearest + 1] += mass[2 * node + 1]
            mass[2 * node + 1] = 0


@dataclass(frozen=True)
class Course:
    """The time series of a run: [N], [N s], [m], [m/s^2], [J], [J], [J]."""

    force: np.ndarray
    momentum: np.ndarray
    centre: np.ndarray
    acceleration: np.ndarray
    sphere_energy: np.ndarray
    plate_energy: np.ndarray
    kinetic_energy: np.ndarray


class ImpactTwin:
    """A sphere that falls on a plate, both elastic, at `velocity` [m/s]; `gap` is (n_contact,) [m]."""

    def __init__(self, sphere: BodyTwin, plate: BodyTwin, gap, velocity: float) -> None:
        self.sphere, self.plate, self.gap, self.velocity = sphere, plate, np.asarray(gap), velocity
        self._follow = np.hstack((sphere.follow, -plate.follow))
        self._squares = np.concatenate((sphere.squares, plate.squares))
        self._lower = np.linalg.cholesky(sphere.yielding + plate.yielding)
        self._upper = np.linalg.inv(self._lower)

    def forces(self, modes):
        """Return the contact forces [N] of least energy without penetration."""
        gap = self.gap + self._follow @ modes
        if (gap >= 0).all():
            return np.zeros(gap.size)
        return nnls(self._lower.T, -self._upper @ gap)[0]

    def _acceleration(self, modes):
        return self._follow.T @ self.forces(modes) - self._squares * modes

    def run(self, times, centre: int) -> Course:
        """Return the time series at times [s]; `centre` is the node at the sphere's centre."""
        size, row = self.sphere.axial.size, 2 * centre + 1
        start = np.concatenate((-self.velocity * self.sphere.axial, np.zeros(self.plate.axial.size)))
        found = solve_ivp(
            lambda _, state: np.concatenate((state[start.size :], self._acceleration(state[: start.size]))),
            (0, times[-1]),
            np.concatenate((np.zeros(start.size), start)),
            "DOP853",
            times,
            rtol=1e-5,
            atol=1e-8 * np.abs(start).max(),
        )
        assert found.success, found.message
        u, v = np.split(found.y, 2)
        forces = np.array([self.forces(one) for one in u.T])
        return Course(
            force=forces.sum(axis=1),
            momentum=self.sphere.axial @ v[:size],
            centre=self.sphere.shapes[row] @ u[:size],
            acceleration=self.sphere.shapes[row] @ np.array([self._acceleration(one)[:size] for one in u.T]).T,
            sphere_energy=_stored(self.sphere, u[:size], forces),
            plate_energy=_stored(self.plate, u[size:], forces),
            kinetic_energy=(v**2).sum(axis=0) / 2,
        )


def _stored(body: BodyTwin, modes, forces):
    """Return the internal energy: of the modes, and of the additional displacement of pressed nodes."""
    return (body.squares @ modes**2 + np.einsum("ti,ij,tj->t", forces, body.yielding, forces)) / 2

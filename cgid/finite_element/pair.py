"""Sphere and plate as one system of unknowns, and how they touch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from cgid.finite_element.elasticity import Body, Flags, highest_frequency
from cgid.finite_element.mesh import Integers
from cgid.validation import Floats


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two bodies whose surfaces may touch, node upon node; the unknowns of the sphere come first.

    The nodes that may touch have no mass along z: theirs lies on the nodes next to them (Khenous, Laborde & Renard
    2008, Eur. J. Mech. A/Solids 27, 918). So nothing is hit when two nodes meet, the contact force is a smooth
    function of time, and no energy is lost.

    Parameters
    ----------
    sphere, plate : Body
    softness : float
        Distance by which surfaces press into each other, over pressure [m/Pa]; 0 for a hard contact.
    """

    sphere: Body
    plate: Body
    softness: float = 0.0

    @property
    def n_sphere(self) -> int:
        """Number of the sphere's unknowns."""
        return self.sphere.mass.size

    @cached_property
    def stiffness(self) -> Any:
        """Matrix of both, in blocks of 2 x 2 [N/m]."""
        both = sparse.block_diag((self.sphere.stiffness, self.plate.stiffness), format="csr")
        blocks = sparse.bsr_array(both, blocksize=(2, 2))
        blocks.sort_indices()
        return blocks

    @cached_property
    def mass(self) -> Floats:
        """Lumped masses [kg], 0 for u_z of nodes that may touch."""
        return np.concatenate([_relieved(body) for body in (self.sphere, self.plate)])

    @cached_property
    def highest_frequencies(self) -> tuple[float, float]:
        """Of sphere and plate, each alone [rad/s]."""
        return highest_frequency(self.sphere), highest_frequency(self.plate)

    @cached_property
    def fixed(self) -> Flags:
        """Unknowns that stay 0."""
        return np.concatenate((self.sphere.fixed, self.plate.fixed))

    @cached_property
    def touching(self) -> tuple[Integers, Integers]:
        """The unknowns u_z of sphere and plate that may touch, (n_contact,) each."""
        return self.sphere.contact, self.plate.contact + self.n_sphere

    def parting_speed(self, sphere_momentum: float, plate_momentum: float) -> float:
        """Return how fast the mass centres move apart [m/s]; a plate that is held somewhere does not move."""
        plate_speed = 0.0 if self._is_held else plate_momentum / self.mass[self.n_sphere + 1 :: 2].sum()
        return float(sphere_momentum / self.mass[1 : self.n_sphere : 2].sum() - plate_speed)

    @cached_property
    def _is_held(self) -> bool:
        return bool(self.plate.fixed[1::2].any())

    @property
    def centre(self) -> int:
        """The unknown u_z of the sphere's centre."""
        nodes = self.sphere.mesh.nodes
        return 2 * self.sphere.mesh.nearest(0.0, float(nodes[:, 1].max()) / 2) + 1

    @cached_property
    def gap(self) -> Floats:
        """Distance of the two surfaces before anything moves, (n_contact,) [m]."""
        return np.asarray(self.sphere.mesh.nodes[self.sphere.mesh.contact, 1])

    @cached_property
    def places(self) -> Floats:
        """Distance from the axis, (n_contact,) [m]."""
        return np.asarray(self.sphere.mesh.nodes[self.sphere.mesh.contact, 0])

    @cached_property
    def areas(self) -> Floats:
        """Surface of each node, (n_contact,) [m^2]: the integral of its shape function over the plate."""
        r = np.append(self.places, 2 * self.places[-1] - self.places[-2])
        left, here, right = np.append(0.0, r[:-2]), r[:-1], r[1:]
        return np.asarray(np.pi / 3 * ((here - left) * (left + 2 * here) + (right - here) * (2 * here + right)))

    @cached_property
    def soft_part(self) -> Floats:
        """What a soft contact adds to the compliance of each node, (n_contact,) [m/N]."""
        return self.softness / self.areas


def _relieved(body: Body) -> Floats:
    """Return the masses with those of u_z of contact nodes on the nearest nodes behind them."""
    mass, mesh = body.mass.copy(), body.mesh
    behind = np.setdiff1d(mesh.elements[np.isin(mesh.elements, mesh.contact).any(axis=1)], mesh.contact)
    for node in mesh.contact:
        nearest = behind[np.argmin(np.hypot(*(mesh.nodes[behind] - mesh.nodes[node]).T))]
        mass[2 * nearest + 1] += mass[2 * node + 1]
        mass[2 * node + 1] = 0.0
    return mass

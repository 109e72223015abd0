"""Stiffness and mass of axisymmetric elastic bodies, and the pair of bodies in contact.

Elements are bilinear quadrilaterals with 2 x 2 Gauss points and lumped mass (Zienkiewicz & Taylor, The Finite Element
Method, vol. 1, axisymmetric stress analysis): strains (u_r,r, u_z,z, u_r / r, u_r,z + u_z,r), volume element 2 pi r dr
dz.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics import Material
from studies.finite_element.mesh import Integers, Mesh

Flags = NDArray[np.bool_]

#: Corners of the reference element, and its Gauss points, all of weight 1.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_POINTS = _CORNERS / np.sqrt(3)
#: Stiffest material [Pa].
_STIFFEST = 1e15
#: Above this Poisson's ratio bilinear elements lock.
_LOCKING = 0.45


@dataclass(frozen=True, kw_only=True)
class Body:
    """Matrices of an elastic body; unknowns 2 i and 2 i + 1 are u_r and u_z of node i.

    stiffness : sparse [N/m], (2 n_nodes, 2 n_nodes)
    mass : lumped [kg], (2 n_nodes,)
    fixed : unknowns that stay 0, u_r on the axis and those of held nodes, (2 n_nodes,)
    """

    mesh: Mesh
    stiffness: Any
    mass: Floats
    fixed: Flags

    @property
    def contact(self) -> Integers:
        """Unknowns u_z of the nodes that may touch."""
        return 2 * self.mesh.contact + 1

    @property
    def free(self) -> Integers:
        """Unknowns that can move."""
        return np.flatnonzero(~self.fixed)


def require_elements_fit(material: Material) -> None:
    """Raise `InvalidValue` for a material that is an array, too stiff, or nearly incompressible."""
    validation.number("density", material.density)
    modulus = validation.number("youngs_modulus", material.youngs_modulus)
    if modulus > _STIFFEST:
        raise InvalidValue(
            f"youngs_modulus must be at most {_STIFFEST:g} Pa, a thousand times diamond's, got {modulus:.3g} Pa; a "
            "lower one is as good as rigid"
        )
    ratio = validation.number("poisson_ratio", material.poisson_ratio)
    if ratio > _LOCKING:
        raise InvalidValue(
            f"poisson_ratio must be at most {_LOCKING:g}, got {ratio:g}: beyond it these elements are too stiff; use a "
            "lower one"
        )


def body(mesh: Mesh, material: Material, *, volume: float, held: Integers | None = None) -> Body:
    """Return the matrices of a body; `held` lists the fixed nodes.

    The masses are scaled to the true volume [m^3]: the mesh of a sphere has corners and lacks .1 % of it.
    """
    fixed = np.zeros((len(mesh.nodes), 2), bool)
    fixed[mesh.nodes[:, 0] == 0, 0] = True
    if held is not None:
        fixed[held] = True
    stiffnesses, masses = element_matrices(mesh, material)
    unknowns = (2 * mesh.elements[:, :, None] + np.arange(2)).reshape(-1, 8)
    rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
    size = 2 * len(mesh.nodes)
    stiffness = sparse.csr_array(
        sparse.coo_array((stiffnesses.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))
    )
    mass = np.bincount(mesh.elements.ravel(), masses.ravel(), len(mesh.nodes))
    mass *= volume * float(np.asarray(material.density)) / mass.sum()
    return Body(mesh=mesh, stiffness=stiffness, mass=np.repeat(mass, 2), fixed=fixed.ravel())


def highest_frequency(of: Body) -> float:
    """Return the highest natural frequency [rad/s], by Lanczos iteration."""
    from scipy.sparse import linalg

    root = of.mass[of.free] ** -0.5
    scaled = of.stiffness[of.free][:, of.free].multiply(root[:, None]).multiply(root[None, :]).tocsr()
    start = np.ones(root.size)  # ARPACK's default is random
    try:
        highest = linalg.eigsh(scaled, k=1, which="LM", tol=1e-6, v0=start, return_eigenvectors=False)[0]
    except linalg.ArpackError as error:
        raise InvalidValue(
            f"a body must have natural frequencies, none were found ({error}); use other sizes"
        ) from None
    return float(np.sqrt(highest))


def element_matrices(mesh: Mesh, material: Material) -> tuple[Floats, Floats]:
    """Return stiffness (n, 8, 8) [N/m] and lumped mass (n, 4) [kg] of each element."""
    corners = mesh.nodes[mesh.elements]
    elasticity = _elasticity(material)
    stiffnesses, masses = np.zeros((len(corners), 8, 8)), np.zeros((len(corners), 4))
    for point in _POINTS:
        shape = np.prod(1 + _CORNERS * point, axis=1) / 4
        slopes = _CORNERS * (1 + _CORNERS * point)[:, ::-1] / 4
        jacobian = np.einsum("ai,eaj->eij", slopes, corners)
        gradient = np.einsum("eji,ai->eaj", np.linalg.inv(jacobian), slopes)
        r = corners[:, :, 0] @ shape
        volume = 2 * np.pi * r * np.linalg.det(jacobian)
        strain = np.zeros((len(corners), 4, 4, 2))
        strain[:, 0, :, 0] = strain[:, 3, :, 1] = gradient[:, :, 0]
        strain[:, 1, :, 1] = strain[:, 3, :, 0] = gradient[:, :, 1]
        strain[:, 2, :, 0] = shape / r[:, None]
        by_unknown = strain.reshape(-1, 4, 8)
        stiffnesses += np.swapaxes(by_unknown, 1, 2) @ elasticity @ by_unknown * volume[:, None, None]
        masses += float(np.asarray(material.density)) * volume[:, None] * shape
    return stiffnesses, masses


def _elasticity(material: Material) -> Floats:
    """Return the elasticity matrix [Pa] from strain to stress, in the order r, z, theta, rz."""
    modulus, nu = float(np.asarray(material.youngs_modulus)), float(np.asarray(material.poisson_ratio))
    first, second = modulus * nu / ((1 + nu) * (1 - 2 * nu)), modulus / (2 * (1 + nu))
    matrix = np.diag([2 * second, 2 * second, 2 * second, second])
    matrix[:3, :3] += first
    return matrix


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two bodies in node-to-node contact; the unknowns of the sphere come first.

    Contact nodes have no mass along z: it is moved to the nodes next to them (Khenous, Laborde & Renard 2008, Eur. J.
    Mech. A/Solids 27, 918). So nodes meet without a shock, the contact force is smooth in time, and no energy is lost.

    softness : penetration over pressure [m/Pa]; 0 for a hard contact
    """

    sphere: Body
    plate: Body
    softness: float = 0.0

    @property
    def n_sphere(self) -> int:
        """Number of unknowns of the sphere."""
        return self.sphere.mass.size

    @cached_property
    def stiffness(self) -> Any:
        """Matrix of both bodies in 2 x 2 blocks [N/m]."""
        both = sparse.block_diag((self.sphere.stiffness, self.plate.stiffness), format="csr")
        blocks = sparse.bsr_array(both, blocksize=(2, 2))
        blocks.sort_indices()
        return blocks

    @cached_property
    def mass(self) -> Floats:
        """Lumped masses [kg]; 0 for u_z of nodes that may touch."""
        return np.concatenate([_relieved(body) for body in (self.sphere, self.plate)])

    @cached_property
    def highest_frequencies(self) -> tuple[float, float]:
        """Highest natural frequencies of sphere and plate, each alone [rad/s]."""
        return highest_frequency(self.sphere), highest_frequency(self.plate)

    @cached_property
    def fixed(self) -> Flags:
        """Unknowns that stay 0."""
        return np.concatenate((self.sphere.fixed, self.plate.fixed))

    @cached_property
    def touching(self) -> tuple[Integers, Integers]:
        """Unknowns u_z of sphere and plate that may touch, (n_contact,) each."""
        return self.sphere.contact, self.plate.contact + self.n_sphere

    def parting_speed(self, sphere_momentum: float, plate_momentum: float) -> float:
        """Return the speed at which the mass centres separate [m/s]; a held plate does not move."""
        plate_speed = 0.0 if self._is_held else plate_momentum / self.mass[self.n_sphere + 1 :: 2].sum()
        return float(sphere_momentum / self.mass[1 : self.n_sphere : 2].sum() - plate_speed)

    @cached_property
    def _is_held(self) -> bool:
        return bool(self.plate.fixed[1::2].any())

    @property
    def centre(self) -> int:
        """Unknown u_z of the sphere's centre."""
        nodes = self.sphere.mesh.nodes
        return 2 * self.sphere.mesh.nearest(0.0, float(nodes[:, 1].max()) / 2) + 1

    @cached_property
    def gap(self) -> Floats:
        """Initial distance of the two surfaces, (n_contact,) [m]."""
        return np.asarray(self.sphere.mesh.nodes[self.sphere.mesh.contact, 1])

    @cached_property
    def places(self) -> Floats:
        """Distance from the axis, (n_contact,) [m]."""
        return np.asarray(self.sphere.mesh.nodes[self.sphere.mesh.contact, 0])

    @cached_property
    def areas(self) -> Floats:
        """Surface area of each node, (n_contact,) [m^2]: the integral of its shape function over the plate."""
        r = np.append(self.places, 2 * self.places[-1] - self.places[-2])
        left, here, right = np.append(0.0, r[:-2]), r[:-1], r[1:]
        return np.asarray(np.pi / 3 * ((here - left) * (left + 2 * here) + (right - here) * (2 * here + right)))

    @cached_property
    def soft_part(self) -> Floats:
        """Compliance that a soft contact adds to each node, (n_contact,) [m/N]."""
        return self.softness / self.areas


def _relieved(body: Body) -> Floats:
    """Return the masses, with those of u_z of contact nodes moved to the nearest nodes behind them."""
    mass, mesh = body.mass.copy(), body.mesh
    behind = np.setdiff1d(mesh.elements[np.isin(mesh.elements, mesh.contact).any(axis=1)], mesh.contact)
    for node in mesh.contact:
        nearest = behind[np.argmin(np.hypot(*(mesh.nodes[behind] - mesh.nodes[node]).T))]
        mass[2 * nearest + 1] += mass[2 * node + 1]
        mass[2 * node + 1] = 0.0
    return mass

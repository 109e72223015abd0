"""Stiffness and mass of an axisymmetric elastic body: bilinear quadrilaterals, 2 x 2 Gauss points, lumped mass.

The elements are those of the textbooks (Zienkiewicz & Taylor, The Finite Element Method, vol. 1, axisymmetric stress
analysis): strains (u_r,r, u_z,z, u_r / r, u_r,z + u_z,r), volume element 2 pi r dr dz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cgid.errors import InvalidValue
from cgid.finite_element.mesh import Integers, Mesh
from cgid.physics.materials import Material
from cgid.validation import Floats

Flags = NDArray[np.bool_]

#: Corners of the reference element, and its Gauss points of weight 1.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_POINTS = _CORNERS / np.sqrt(3)


@dataclass(frozen=True, kw_only=True)
class Body:
    """An elastic body as its matrices; unknown 2 i is u_r of node i, 2 i + 1 its u_z.

    Parameters
    ----------
    mesh : Mesh
    stiffness : scipy.sparse.csr_array, (2 n_nodes, 2 n_nodes)
        [N/m].
    mass : ndarray, (2 n_nodes,)
        Lumped [kg].
    fixed : ndarray of bool, (2 n_nodes,)
        Unknowns that stay 0: u_r on the axis, and what is held.
    """

    mesh: Mesh
    stiffness: Any
    mass: Floats
    fixed: Flags

    @property
    def contact(self) -> Integers:
        """The unknowns u_z of the nodes that may touch."""
        return 2 * self.mesh.contact + 1

    @property
    def free(self) -> Integers:
        """The unknowns that can move."""
        return np.flatnonzero(~self.fixed)


def body(mesh: Mesh, material: Material, *, volume: float, held: Integers | None = None) -> Body:
    """Return the matrices of a body; `held` are nodes that cannot move.

    The masses are stretched to those of the true volume [m^3]: a sphere's mesh has corners and lacks .1 % of it.
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
    start = np.ones(root.size)  # ARPACK would draw one
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
    """Return the matrix from strain to stress [Pa], in the order r, z, theta, rz."""
    modulus, nu = float(np.asarray(material.youngs_modulus)), float(np.asarray(material.poisson_ratio))
    first, second = modulus * nu / ((1 + nu) * (1 - 2 * nu)), modulus / (2 * (1 + nu))
    matrix = np.diag([2 * second, 2 * second, 2 * second, second])
    matrix[:3, :3] += first
    return matrix

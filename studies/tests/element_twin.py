"""A slow twin of the finite elements: axisymmetric quadrilaterals from Lame's energy, entry by entry.

It uses nothing of `studies.finite_element`. The strain is a 3 x 3 tensor with the energy `lambda/2 tr^2 + mu e:e`. An
entry of the stiffness is the energy that two displacements store together minus that of each alone. The shape functions
come from a linear system instead of formulas.
"""

from __future__ import annotations

import itertools

import numpy as np

from cgid.physics import Material

#: Corners of the reference square.
_PLACE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def lame(material: Material) -> tuple[float, float]:
    """Return Lame's constants lambda and mu [Pa]."""
    modulus, nu = float(np.asarray(material.youngs_modulus)), float(np.asarray(material.poisson_ratio))
    return modulus * nu / ((1 + nu) * (1 - 2 * nu)), modulus / (2 * (1 + nu))


class ElementTwin:
    """Elements of four corners (r, z), (n, 4, 2) [m], integrated with `points` x `points` Gauss points."""

    def __init__(self, corners, material: Material, points: int) -> None:
        self.corners, self.material, self.points = np.asarray(corners, float), material, points
        #: Column a holds the coefficients of 1, x, y, xy of the function that is 1 at corner a and 0 at the others.
        self.shapes = np.linalg.inv([[1, x, y, x * y] for x, y in _PLACE])

    def gauss(self):
        """Yield r, volume (n,), shape functions (4,), their slopes d/dr and d/dz (n, 2, 4), at each Gauss point."""
        nodes, weights = np.polynomial.legendre.leggauss(self.points)
        for (i, x), (j, y) in itertools.product(enumerate(nodes), repeat=2):
            shape = np.array([1, x, y, x * y]) @ self.shapes
            along = np.array([[0, 1, 0, y], [0, 0, 1, x]]) @ self.shapes
            jacobian = along @ self.corners
            r = self.corners[:, :, 0] @ shape
            volume = 2 * np.pi * r * np.abs(np.linalg.det(jacobian)) * weights[i] * weights[j]
            yield r, volume, shape, np.linalg.solve(jacobian, np.broadcast_to(along, (len(r), 2, 4)))

    def energy(self, moved):
        """Return the energy of each element [J] with its corners displaced by `moved`, (4, 2) or (n, 4, 2) [m]."""
        first, second = lame(self.material)
        moved = np.broadcast_to(moved, self.corners.shape)
        total = np.zeros(len(self.corners))
        for r, volume, shape, slopes in self.gauss():
            gradient = np.zeros((len(r), 3, 3))
            gradient[:, :2, :2] = np.swapaxes(slopes @ moved, 1, 2)
            gradient[:, 2, 2] = moved[:, :, 0] @ shape / r
            strain = (gradient + np.swapaxes(gradient, 1, 2)) / 2
            trace = np.trace(strain, axis1=1, axis2=2)
            total += volume * (first / 2 * trace**2 + second * np.sum(strain * strain, axis=(1, 2)))
        return total

    def stiffness(self):
        """Return the stiffness, (n, 8, 8) [N/m]; unknown 2 a is u_r of corner a, 2 a + 1 its u_z."""
        unit = np.eye(8).reshape(8, 4, 2)
        alone = np.array([self.energy(one) for one in unit])
        together = np.array([[self.energy(a + b) for b in unit] for a in unit])
        return np.moveaxis(together - alone[:, None] - alone[None], -1, 0)

    def mass(self):
        """Return the mass of each corner, density x integral of its shape function over the volume, (n, 4) [kg]."""
        density = float(np.asarray(self.material.density))
        return density * sum(volume[:, None] * shape for _, volume, shape, _ in self.gauss())


def solid_of_revolution(nodes, elements) -> float:
    """Return the volume of elements rotated about the axis, by Pappus: 2 pi x the first moment of each polygon."""
    r, z = np.moveaxis(np.asarray(nodes)[elements], -1, 0)
    after_r, after_z = np.roll(r, -1, axis=1), np.roll(z, -1, axis=1)
    moment = ((r + after_r) * (r * after_z - after_r * z)).sum(axis=1) / 6
    return float(2 * np.pi * np.abs(moment).sum())

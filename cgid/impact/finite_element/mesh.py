"""Meshes of a sphere and a plate in the half plane (r, z), made by hand and graded towards the contact at (0, 0).

The sphere's mesh is that of a quarter plane, bent: a Moebius map takes the quarter plane's corner to the point of
contact, infinity to the opposite pole, one side to the axis and the other to the surface. It keeps angles, so elements
that are square in the quarter plane are nearly square in the sphere. There the mesh is a quarter of a disc, rings that
grow like their radius out to the equator, and the same quarter disc turned inside out for the other half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats

Integers = NDArray[np.int64]

#: Near the contact both bodies are meshed evenly, out to this many contact radii; only there the surfaces may touch.
REACH = 2


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Quadrilaterals of four nodes.

    Parameters
    ----------
    nodes : ndarray, (n_nodes, 2)
        r and z [m].
    elements : ndarray of int, (n_elements, 4)
        Nodes of each, anticlockwise in (r, z).
    contact : ndarray of int, (n_contact,)
        Nodes of the surface that may touch, from the axis outwards.
    """

    nodes: Floats
    elements: Integers
    contact: Integers

    def nearest(self, r: float, z: float) -> int:
        """Return the node nearest to a point."""
        return int(np.argmin(np.hypot(self.nodes[:, 0] - r, self.nodes[:, 1] - z)))


def sphere_mesh(radius: float, contact_radius: float, elements: int) -> Mesh:
    """Return the mesh of a sphere that stands on the plane z = 0, with so many elements over the contact radius."""
    reach, across = REACH * contact_radius, REACH * elements
    # The surface lies at r = 2 R y / (1 + y^2), y being the place on the side of the quarter plane.
    core = reach / radius / (1 + np.sqrt(1 - (reach / radius) ** 2))
    disc = _quarter_disc(across // 2)
    rings = np.exp(np.linspace(np.log(core), 0, 1 + round(-np.log(core) * across / (np.pi / 2))))
    parts = [core * disc, _rings(rings, across), 1 / np.conj(np.where(disc == 0, 1e-30, disc))]
    placed = [2j * radius * part / (1 + part) for part in parts]
    placed[2][disc == 0] = 2j * radius
    blocks = [_disc_elements(across // 2), _grid_elements(rings.size, across + 1), _disc_elements(across // 2)]
    mesh = _joined(placed, blocks, tolerance=1e-9 * reach)
    surface = np.flatnonzero(np.abs(np.hypot(mesh.nodes[:, 0], mesh.nodes[:, 1] - radius) - radius) < 1e-9 * radius)
    surface = surface[(mesh.nodes[surface, 1] < radius) & (mesh.nodes[surface, 0] < reach * (1 + 1e-9))]
    return Mesh(nodes=mesh.nodes, elements=mesh.elements, contact=surface[np.argsort(mesh.nodes[surface, 0])])


def plate_mesh(thickness: float, radius: float, contact_places: Floats) -> Mesh:
    """Return the mesh of a round plate below the plane z = 0, with nodes where those of the sphere may touch it."""
    first = contact_places[1] - contact_places[0]
    growth = 1 + np.pi / 2 / (contact_places.size - 1)
    last = contact_places[-1] - contact_places[-2]
    r = np.concatenate(
        (contact_places, contact_places[-1] + _growing(last, growth, radius - contact_places[-1], thickness / 2))
    )
    z = -np.concatenate(([0.0], _growing(first, growth, thickness, thickness / 2)))
    rs, zs = np.meshgrid(r, z, indexing="ij")
    # r grows along rows and z falls along columns: turned round to be anticlockwise.
    elements = _grid_elements(r.size, z.size)[:, ::-1]
    contact = np.arange(contact_places.size) * z.size
    return Mesh(nodes=np.column_stack((rs.ravel(), zs.ravel())), elements=elements, contact=contact)


def _growing(first: float, growth: float, length: float, largest: float) -> Floats:
    """Return the ends of steps that grow by a factor up to a largest one and fill a length."""
    steps = [first]
    while sum(steps) < length:
        steps.append(min(steps[-1] * growth, largest))
    ends = np.cumsum(steps)
    return np.asarray(ends * (length / ends[-1]))


def _quarter_disc(k: int) -> NDArray[np.complex128]:
    """Return the nodes of a quarter of the unit disc, x - i y: k x k elements in the corner, two bent grids around."""
    side, corner = 0.5, 0.37 * (1 + 1j)
    share = np.linspace(0, 1, k + 1)
    x, y = np.meshgrid(share, share, indexing="ij")
    square = side * x * (1 - y) + corner * x * y + 1j * side * y * (1 - x)
    arc = np.exp(1j * np.linspace(0, np.pi / 2, 2 * k + 1))
    edge = np.concatenate((square[-1, :], square[-2::-1, -1]))
    shell = edge + share[:, None] * (arc - edge)
    return np.asarray(np.conj(np.concatenate((square.ravel(), shell.ravel()))))


def _disc_elements(k: int) -> Integers:
    square = _grid_elements(k + 1, k + 1)
    return np.concatenate((square, (k + 1) ** 2 + _grid_elements(k + 1, 2 * k + 1)))


def _rings(radii: Floats, across: int) -> NDArray[np.complex128]:
    return np.asarray(radii[:, None] * np.exp(-1j * np.linspace(0, np.pi / 2, across + 1))).ravel()


def _grid_elements(rows: int, columns: int) -> Integers:
    """Return the elements of a grid of nodes numbered along its rows of `columns` nodes."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.column_stack((first, first + columns, first + columns + 1, first + 1))


def _joined(parts: list[NDArray[np.complex128]], blocks: list[Integers], tolerance: float) -> Mesh:
    """Return one mesh of parts whose nodes coincide at their seams."""
    offsets = np.cumsum([0, *(part.size for part in parts[:-1])])
    places = np.concatenate(parts)
    elements = np.concatenate([block + offset for block, offset in zip(blocks, offsets, strict=True)])
    keys = np.round(np.column_stack((places.real, places.imag)) / tolerance).astype(np.int64)
    _, kept, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    nodes = np.column_stack((places.real, places.imag))[kept]
    nodes[np.abs(nodes[:, 0]) < tolerance, 0] = 0.0
    elements = merged[elements]
    corners = nodes[elements]
    twice = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    elements[twice < 0] = elements[twice < 0, ::-1]
    return Mesh(nodes=nodes, elements=elements, contact=np.empty(0, np.int64))

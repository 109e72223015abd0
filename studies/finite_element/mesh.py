"""The plate and the contact of a finite-element impact, and meshes of sphere and plate.

Meshes lie in the half plane (r, z), graded towards the contact at (0, 0). The mesh of the sphere is a mapped mesh of a
quarter plane. A Moebius map takes the corner of the quarter plane to the point of contact, infinity to the opposite
pole, one side to the axis and the other to the surface. It preserves angles, so square elements stay nearly square. The
mesh of the quarter plane has three parts: a quarter disc, rings that grow with their radius out to the equator, and the
same quarter disc inverted for the other half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics import Material

LOWER_FACES = ("fixed", "free")
#: Both bodies are meshed evenly out to this many contact radii; only there may the surfaces touch.
REACH = 2.3
#: Most nodes of a plate; more would take hours.
MAX_NODES = 200_000
#: Elements over the contact radius: the fewest (with less, pressure and radius rest on two or three nodes), those for a
#: peak force within 1 %, and the most.
_FEWEST, _ONE_PERCENT, _MOST = 5, 7, 60
#: Largest plate in contact radii; smaller ones already act as a half space.
_LARGEST = 1e5

Integers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ElasticPlate:
    """A round plate, hit at its centre; its edge is free.

    Parameters
    ----------
    material : Material
    thickness, radius : float [m]
    lower_face : {"fixed", "free"}
        Held, as in the simulations of Yang, Zeng & Wan (2018), or free, so that nothing holds the plate.
    retardation_time : float, optional [s]
        Of a Kelvin-Voigt material, stress = E (strain + retardation time x strain rate).
    """

    material: Material
    thickness: float
    radius: float
    lower_face: Literal["fixed", "free"]
    retardation_time: float = 0.0

    def __post_init__(self) -> None:
        validation.instance("material", self.material, Material)
        hold_numbers(self, "m", thickness=validation.positive, radius=validation.positive)
        hold_numbers(self, "s", retardation_time=validation.not_negative)
        validation.choice("lower_face", self.lower_face, LOWER_FACES)


@dataclass(frozen=True, kw_only=True)
class PenaltyContact:
    """Surfaces that penetrate each other, as in many finite-element programs, instead of a hard contact.

    The pressure is `factor` x bulk modulus (the lower of both) / element size x penetration: a coarser mesh makes a
    softer contact. The element size is Hertz's contact radius over the number of elements. The default factor of
    LS-DYNA is .1 (LS-DYNA Theory Manual, chapter 29).

    Parameters
    ----------
    factor : float
    """

    factor: float = 0.1

    def __post_init__(self) -> None:
        hold_numbers(self, "", factor=validation.positive)

    def softness(self, first: Material, second: Material, element_size: float) -> float:
        """Return penetration over pressure [m/Pa]."""
        return element_size / (self.factor * min(bulk_modulus(first), bulk_modulus(second)))


def bulk_modulus(material: Material) -> float:
    """Return `E / (3 (1 - 2 nu))` [Pa]."""
    return float(material.youngs_modulus / (3 * (1 - 2 * np.asarray(material.poisson_ratio))))


def hold_numbers(owner: object, unit: str, **rules: Callable[[str, ArrayLike, str], Floats]) -> None:
    """Check that fields of a frozen dataclass are valid scalars, and store them as floats."""
    for name, rule in rules.items():
        object.__setattr__(owner, name, validation.number(name, getattr(owner, name), unit, rule))


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Quadrilaterals of four nodes.

    nodes : r and z [m], (n_nodes, 2)
    elements : nodes of each, anticlockwise in (r, z), (n_elements, 4)
    contact : surface nodes that may touch, from the axis outwards, (n_contact,)
    """

    nodes: Floats
    elements: Integers
    contact: Integers

    def nearest(self, r: float, z: float) -> int:
        """Return the node nearest to a point."""
        return int(np.argmin(np.hypot(self.nodes[:, 0] - r, self.nodes[:, 1] - z)))


def sphere_mesh(radius: float, contact_radius: float, elements: int) -> Mesh:
    """Return the mesh of a sphere on the plane z = 0, with this number of elements over the contact radius."""
    k = -(-round(REACH * elements) // 2)
    reach = contact_radius * 2 * k / elements
    # On the surface r = 2 R y / (1 + y^2), with y the coordinate on the side of the quarter plane.
    core = reach / radius / (1 + np.sqrt(1 - (reach / radius) ** 2))
    radii = np.exp(np.linspace(np.log(core), 0, 1 + round(-np.log(core) * 2 * k / (np.pi / 2))))
    disc, (square, shell) = _quarter_disc(k)
    rings = radii[1:, None] * disc[shell[-1]]
    # Each part begins with the last nodes of the previous one.
    in_rings = np.vstack((shell[-1], disc.size + np.arange(rings.size).reshape(rings.shape)))
    above = disc.size + rings.size + np.arange(disc.size)
    above[shell[-1]] = in_rings[-1]
    quarter_plane = np.concatenate((core * disc, rings.ravel()))
    bent = quarter_plane / (1 + quarter_plane)
    turned = 1 / (1 + np.conj(disc[: -shell.shape[1]]))
    places = 2j * radius * np.concatenate((bent, turned))
    grids = (square, shell, in_rings, above[square], above[shell])
    return _mesh(places, np.concatenate([_cells(grid) for grid in grids]), np.append(square[0], shell[1:, -1]))


def plate_mesh(thickness: float, radius: float, contact_places: Floats, growth: float) -> Mesh:
    """Return the mesh of a round plate below z = 0, with nodes opposite the sphere's contact nodes.

    Away from the contact, elements grow `growth` times as fast as those of the sphere.
    """
    first = contact_places[1] - contact_places[0]
    growth = 1 + growth * np.pi / 2 / (contact_places.size - 1)
    last = contact_places[-1] - contact_places[-2]
    r = np.concatenate(
        (contact_places, contact_places[-1] + _growing(last, growth, radius - contact_places[-1], thickness / 2))
    )
    z = -np.concatenate(([0.0], _growing(first, growth, thickness, thickness / 2)))
    if r.size * z.size > MAX_NODES:
        raise InvalidValue(
            f"the mesh of the plate must have at most {MAX_NODES} nodes, got {r.size} x {z.size} for a radius of "
            f"{radius:.4g} m and a thickness of {thickness:.4g} m; use another of these, or fewer elements"
        )
    rs, zs = np.meshgrid(r, z, indexing="ij")
    grid = np.arange(rs.size).reshape(rs.shape)
    return _mesh((rs + 1j * zs).ravel(), _cells(grid), grid[: contact_places.size, 0])


def require_fine_mesh(elements: float, contact_radius: float) -> None:
    """Raise `InvalidValue` for a mesh that is too coarse for the contact, or needlessly fine."""
    if elements < _FEWEST:
        raise InvalidValue(
            f"the mesh must have at least {_FEWEST} elements over the contact radius of {contact_radius * 1e3:.3g} mm "
            f"({_ONE_PERCENT} for the peak force within 1 %), got {elements:.3g}; use elements = {_ONE_PERCENT} or "
            f"more, or an element_size of {contact_radius / _ONE_PERCENT * 1e3:.3g} mm or less"
        )
    if elements > _MOST:
        raise InvalidValue(
            f"the mesh must have at most {_MOST} elements over the contact radius of {contact_radius * 1e3:.3g} mm, "
            f"got {min(elements, 1e9):.4g}; 14 give the peak force within about .1 %"
        )


def require_room(plate: ElasticPlate, contact_radius: float) -> None:
    """Raise `InvalidValue` for a plate thinner than the contact radius, hardly wider than the contact, or too large."""
    if plate.thickness < contact_radius:
        raise InvalidValue(
            f"thickness of the plate must be at least the contact radius, {contact_radius * 1e3:.3g} mm, got "
            f"{plate.thickness * 1e3:.3g} mm; use a thicker plate"
        )
    for name, size in (("thickness", plate.thickness), ("radius", plate.radius)):
        if size > _LARGEST * contact_radius:
            raise InvalidValue(
                f"{name} of the plate must be at most {_LARGEST * contact_radius:.3g} m, {_LARGEST:g} contact radii, "
                f"got {size:.3g} m; use a smaller one, the impact will not notice"
            )
    needed = 2 * REACH * contact_radius
    if plate.radius < needed:
        raise InvalidValue(
            f"radius of the plate must be at least {needed * 1e3:.3g} mm, {2 * REACH:g} times the contact radius, got "
            f"{plate.radius * 1e3:.3g} mm; use a wider plate"
        )


def _growing(first: float, growth: float, length: float, largest: float) -> Floats:
    """Return the ends of steps that grow by a factor, up to `largest`, and fill `length`."""
    ends, step = [first], first
    while ends[-1] < length:
        step = min(step * growth, largest)
        ends.append(ends[-1] + step)
        if len(ends) > MAX_NODES:
            break
    return np.asarray(ends) * (length / ends[-1])


def _quarter_disc(k: int) -> tuple[NDArray[np.complex128], tuple[Integers, Integers]]:
    """Return the nodes of a quarter of the unit disc, x - i y, and its two grids of nodes.

    k x k elements fill the corner, k x 2 k surround them; the last row of the latter is the arc, and its nodes come
    last.
    """
    side, corner = 0.5, 0.37 * (1 - 1j)
    share = np.linspace(0, 1, k + 1)
    x, y = np.meshgrid(share, share, indexing="ij")
    inside = side * x * (1 - y) + corner * x * y - 1j * side * y * (1 - x)
    square = np.arange(inside.size).reshape(inside.shape)
    edge = np.concatenate((square[-1], square[-2::-1, -1]))
    arc = np.exp(-1j * np.linspace(0, np.pi / 2, 2 * k + 1))
    around = (1 - share[1:, None]) * inside.ravel()[edge] + share[1:, None] * arc
    shell = np.vstack((edge, inside.size + np.arange(around.size).reshape(around.shape)))
    return np.concatenate((inside.ravel(), around.ravel())), (square, shell)


def _cells(grid: Integers) -> Integers:
    """Return the quadrilaterals between the nodes of a grid, (n_elements, 4)."""
    corners = (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:])
    return np.stack([corner.ravel() for corner in corners], axis=1)


def _mesh(places: NDArray[np.complex128], elements: Integers, contact: Integers) -> Mesh:
    """Return the mesh of nodes at r + i z, with every element turned anticlockwise."""
    nodes = np.column_stack((places.real, places.imag))
    nodes[np.abs(nodes[:, 0]) < 1e-12 * nodes[:, 0].max(), 0] = 0.0
    corners = nodes[elements]
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    clockwise = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    elements[clockwise] = elements[clockwise, ::-1]
    return Mesh(nodes=nodes, elements=elements, contact=contact)

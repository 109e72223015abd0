"""Modes of a stiffened tail beam by finite elements, by numpy and scipy alone.

Nothing here comes from `cgid`, whose own beam is a thin plate with smeared ribs. Here the skin is a Mindlin plate, with
shear, rotary inertia and stretching, and each rib stands where it is: a Mindlin shell of its own whose web bends
sideways ("shells"), a Timoshenko beam that keeps its section ("beams"), or smeared over the width ("smeared").

Elements are rectangles with Lagrange polynomials on Gauss-Lobatto nodes and full integration, which do not lock at
degree 4 and above. All parts are uniform, so their matrices are Kronecker products of matrices of lines. A beam with
an even number of ribs is symmetric about its middle line: half of it is solved twice, even and odd.

Displacements of the skin at height z are `u + z p`, `v + z q`, `w`: p and q are minus the slopes of a thin plate.
"""

from __future__ import annotations

import hashlib
import itertools
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu

Floats = NDArray[np.float64]
Ribs = Literal["shells", "beams", "smeared", "none"]
Edges = Literal["cantilever", "simply-supported"]
#: A field as a sum: numbers of unknowns, -1 where there is none, and their factor.
Tie = list[tuple[NDArray[np.intp], float]]
#: Mindlin's shear factor, and that of a rectangular bar.
SHEAR = 5 / 6
#: Fields of a plate or shell: along, across, out of the plane, and the two rotations.
_FIELDS = ("u", "v", "w", "p", "q")
#: Width of a slice of the band [Hz], and the most unknowns of a dense eigenproblem.
_SLICE, _DENSE = 2000.0, 1200


@dataclass(frozen=True, kw_only=True)
class Beam:
    """Sizes [m], steel, and elements of a tail beam; the defaults are those of the scene `tail_beam`.

    `mindlin` scales what parts Mindlin's plate from Kirchhoff's, the give in shear and the rotary inertia: smeared and
    towards 0 the beam becomes that of `cgid`, in between it is a little off it. `element` is the longest element [m],
    `degree` that of its polynomials: five nodes per wave and degree 5 find a frequency to 1e-3.
    """

    length: float = 1.6
    width: float = 1.4
    thickness: float = 0.030
    edges: Edges = "cantilever"
    number: int = 8
    depth: float = 0.250
    rib_thickness: float = 0.025
    ribs: Ribs = "shells"
    density: float = 7850.0
    youngs_modulus: float = 210e9
    poisson_ratio: float = 0.30
    mindlin: float = 1.0
    element: float = 0.13
    degree: int = 5

    @property
    def shear_modulus(self) -> float:
        """G [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def spacing(self) -> float:
        """Width over number of ribs [m]."""
        return self.width / self.number


# -- lines ------------------------------------------------------------------------------------------------


class Line(NamedTuple):
    """Elements on a line: nodes [m], and the integrals of f g, f' g and f' g' of their polynomials."""

    breaks: Floats
    degree: int
    nodes: Floats
    mass: sparse.csr_array
    mixed: sparse.csr_array
    slopes: sparse.csr_array


@cache
def _element(degree: int) -> tuple[Floats, Floats, Floats, Floats]:
    inner = legendre.Legendre.basis(degree).deriv().roots()
    nodes = np.concatenate([[-1.0], np.sort(inner.real), [1.0]])
    series = np.linalg.inv(legendre.legvander(nodes, degree))  # Legendre coefficients of each polynomial, in columns
    points, weights = legendre.leggauss(degree + 1)
    value = legendre.legvander(points, degree) @ series
    slope = legendre.legvander(points, degree - 1) @ legendre.legder(series)
    weighted = weights[:, None]
    return nodes, value.T @ (weighted * value), slope.T @ (weighted * value), slope.T @ (weighted * slope)


def line(corners: Floats, element: float, degree: int) -> Line:
    """Return a line whose elements end at the corners [m] and are no longer than `element`."""
    parts = [np.linspace(a, b, int(np.ceil((b - a) / element - 1e-9)) + 1)[:-1] for a, b in itertools.pairwise(corners)]
    breaks = np.append(np.concatenate(parts), corners[-1])
    own, *matrices = _element(degree)
    halves = np.diff(breaks) / 2
    size = degree * len(halves) + 1
    nodes = np.append((breaks[:-1, None] + halves[:, None] * (own[:-1] + 1)).ravel(), breaks[-1])
    index = degree * np.arange(len(halves))[:, None] + np.arange(degree + 1)
    rows, columns = (np.broadcast_to(part, (*index.shape, degree + 1)) for part in (index[..., None], index[:, None]))
    built = [
        sparse.csr_array(
            ((halves[:, None, None] ** power * matrix).ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)
        )
        for power, matrix in zip((1, 0, -1), matrices, strict=True)
    ]
    return Line(breaks, degree, nodes, *built)


def weights_at(of: Line, places: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Return the nodes around each place and their weights, both (n, degree + 1)."""
    element = np.clip(np.searchsorted(of.breaks, places, side="right") - 1, 0, len(of.breaks) - 2)
    start, end = of.breaks[element], of.breaks[element + 1]
    own = 2 * (places - start) / (end - start) - 1
    series = np.linalg.inv(legendre.legvander(_element(of.degree)[0], of.degree))
    return of.degree * element[:, None] + np.arange(of.degree + 1), legendre.legvander(own, of.degree) @ series


# -- plates and bars --------------------------------------------------------------------------------------


class Part(NamedTuple):
    """Stiffness and mass of a part in its own fields, as blocks by pairs of fields."""

    stiffness: dict[tuple[str, str], sparse.csr_array]
    mass: dict[tuple[str, str], sparse.csr_array]


class Rigidity(NamedTuple):
    """Energy `(r11 f_s^2 + 2 r12 f_s g_t + r22 g_t^2 + r66 (f_t + g_s)^2) / 2` of two fields."""

    r11: float
    r22: float
    r12: float
    r66: float


def _stretched(s: Line, t: Line, pair: str, r: Rigidity) -> dict[tuple[str, str], sparse.csr_array]:
    f, g = pair
    return {
        (f, f): r.r11 * sparse.kron(s.slopes, t.mass) + r.r66 * sparse.kron(s.mass, t.slopes),
        (g, g): r.r22 * sparse.kron(s.mass, t.slopes) + r.r66 * sparse.kron(s.slopes, t.mass),
        (f, g): r.r12 * sparse.kron(s.mixed, t.mixed.T) + r.r66 * sparse.kron(s.mixed.T, t.mixed),
    }


def bending(
    beam: Beam, s: Line, t: Line, r: Rigidity, shear: tuple[float, float], mass: float, rotary: tuple[float, float]
) -> Part:
    """Return a Mindlin plate: shear stiffness [N/m] and rotary inertia [kg] along s and t, mass per area."""
    even, (along, across) = sparse.kron(s.mass, t.mass), (value / beam.mindlin for value in shear)
    stiffness = _stretched(s, t, "pq", r)
    stiffness["p", "p"] = stiffness["p", "p"] + along * even
    stiffness["q", "q"] = stiffness["q", "q"] + across * even
    stiffness["w", "w"] = along * sparse.kron(s.slopes, t.mass) + across * sparse.kron(s.mass, t.slopes)
    stiffness["w", "p"] = along * sparse.kron(s.mixed, t.mass)
    stiffness["w", "q"] = across * sparse.kron(s.mass, t.mixed)
    turning = {(f, f): beam.mindlin * value * even for f, value in zip("pq", rotary, strict=True)}
    return Part(stiffness, {("w", "w"): mass * even} | turning)


def shell(beam: Beam, s: Line, t: Line, thickness: float) -> Part:
    """Return a flat shell of steel: a Mindlin plate that also stretches."""
    nu, wide = beam.poisson_ratio, beam.youngs_modulus / (1 - beam.poisson_ratio**2)

    def rigidity(section: float) -> Rigidity:
        return Rigidity(wide * section, wide * section, nu * wide * section, beam.shear_modulus * section)

    cube, shear = thickness**3 / 12, SHEAR * beam.shear_modulus * thickness
    rotary = beam.density * cube
    part = bending(beam, s, t, rigidity(cube), (shear, shear), beam.density * thickness, (rotary, rotary))
    part.stiffness.update(_stretched(s, t, "uv", rigidity(thickness)))
    part.mass.update({(f, f): part.mass["w", "w"] for f in "uv"})
    return part


def bar(beam: Beam, s: Line) -> Part:
    """Return a rib as a Timoshenko beam in the motion of its centroid; r is its rotation about the vertical."""
    d, b, e, g = beam.depth, beam.rib_thickness, beam.youngs_modulus, beam.shear_modulus
    area, upright, lying = d * b, b * d**3 / 12, d * b**3 / 12
    shear = SHEAR * g * area
    stiffness = {
        ("u", "u"): e * area * s.slopes,
        ("p", "p"): e * upright * s.slopes + shear * s.mass,
        ("r", "r"): e * lying * s.slopes + shear * s.mass,
        ("q", "q"): g * torsion_constant(beam) * s.slopes,
        ("w", "w"): shear * s.slopes,
        ("v", "v"): shear * s.slopes,
        ("w", "p"): shear * s.mixed,
        ("v", "r"): shear * s.mixed,
    }
    inertia = dict.fromkeys("uvw", area) | {"p": upright, "r": lying, "q": upright + lying}
    return Part(stiffness, {(f, f): beam.density * value * s.mass for f, value in inertia.items()})


def smeared_plate(beam: Beam, s: Line, t: Line) -> Part:
    """Return skin and ribs as one orthotropic Mindlin plate: Huber's rigidities, and the shear of the webs along s."""
    h, d, b, e, g = beam.thickness, beam.depth, beam.rib_thickness, beam.youngs_modulus, beam.shear_modulus
    nu, ribbed = beam.poisson_ratio, 1 / beam.spacing if beam.ribs == "smeared" else 0.0
    area, wide, between = d * b * ribbed, e / (1 - nu**2), (d + h) / 2
    skin = wide * h**3 / 12
    axis = e * area * between / (e * area + wide * h)  # of bending, below the middle of the skin
    along = skin + wide * h * axis**2 + e * area * (d**2 / 12 + (between - axis) ** 2)
    rotary = h**3 / 12 + h * axis**2 + area * (d**2 / 12 + (between - axis) ** 2)
    rigidity = Rigidity(along, skin, nu * skin, g * h**3 / 12 + g * torsion_constant(beam) * ribbed / 4)
    # A rib carries the shear along it, as the web of a girder; a bare skin all of it.
    shear = (SHEAR * g * (area or h), SHEAR * g * h)
    inertia = (beam.density * rotary, beam.density * h**3 / 12)
    return bending(beam, s, t, rigidity, shear, beam.density * (h + area), inertia)


def torsion_constant(beam: Beam) -> float:
    d, b = max(beam.depth, beam.rib_thickness), min(beam.depth, beam.rib_thickness)
    return d * b**3 * (1 / 3 - 0.21 * b / d * (1 - (b / d) ** 4 / 12))


# -- the whole beam ---------------------------------------------------------------------------------------


class Rib(NamedTuple):
    """A rib: its matrices and fields, how they follow from all unknowns, and the unknowns of its own."""

    part: Part
    fields: tuple[str, ...]
    terms: list[Tie]
    own: list[NDArray[np.intp]]


class Model(NamedTuple):
    """Matrices of half a beam over its free unknowns, and the unknowns of w in the skin (n_x, n_y), -1 where held."""

    stiffness: sparse.csc_array
    mass: sparse.csc_array
    skin: NDArray[np.intp]
    x: Line
    y: Line


def _matrix(blocks: dict[tuple[str, str], sparse.csr_array], fields: tuple[str, ...]) -> sparse.csr_array:
    size = next(iter(blocks.values())).shape[0]
    rows = []
    for f in fields:
        row = [blocks.get((f, g), blocks[g, f].T if (g, f) in blocks else None) for g in fields]
        rows.append([sparse.csr_array((size, size)) if block is None else block for block in row])
    return sparse.csr_array(sparse.block_array(rows))


class _Unknowns:
    """Numbers of the unknowns of each field, given in turn."""

    def __init__(self) -> None:
        self.size = 0

    def field(self, *shape: int) -> NDArray[np.intp]:
        numbers = self.size + np.arange(int(np.prod(shape))).reshape(shape)
        self.size += numbers.size
        return numbers


def _tied(terms: list[Tie], size: int) -> sparse.csr_array:
    rows, columns, values, start = [], [], [], 0
    for field in terms:
        for numbers, factor in field:
            rows.append(start + np.flatnonzero(numbers.ravel() >= 0))
            columns.append(numbers.ravel()[numbers.ravel() >= 0])
            values.append(np.full(len(columns[-1]), factor))
        start += field[0][0].size
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(entries, shape=(start, size))


def model(beam: Beam, parity: Literal["even", "odd"]) -> Model:
    """Return half of a beam, from y = 0 to the middle line, even or odd in w about it."""
    discrete = beam.ribs in ("shells", "beams")
    if discrete and beam.number % 2:
        raise ValueError(f"number must be even, for the beam to have a middle line without a rib, got {beam.number}")
    at = (np.arange(beam.number // 2) + 0.5) * beam.spacing if discrete else np.empty(0)
    x = line(np.array([0.0, beam.length]), beam.element, beam.degree)
    y = line(np.concatenate([[0.0], at, [beam.width / 2]]), beam.element, beam.degree)
    names = _FIELDS if discrete else _FIELDS[2:]
    unknowns = _Unknowns()
    skin = {name: unknowns.field(len(x.nodes), len(y.nodes)) for name in names}
    part = shell(beam, x, y, beam.thickness) if discrete else smeared_plate(beam, x, y)
    parts = [(part, names, [[(skin[name], 1.0)] for name in names])]
    extra = []
    for place in at:
        column = int(np.argmin(np.abs(y.nodes - place)))
        edge = {name: numbers[:, column] for name, numbers in skin.items()}
        part, fields, terms, own = (_web if beam.ribs == "shells" else _bar)(beam, x, edge, unknowns)
        parts.append((part, fields, terms))
        extra += own
    held = (
        [np.atleast_1d(numbers[0]) for numbers in (*skin.values(), *extra)]
        if beam.edges == "cantilever"
        else _supported(skin)
    )
    held += [skin[name][:, -1] for name in ("vq" if parity == "even" else "uwp") if name in skin]
    free = np.ones(unknowns.size, bool)
    free[np.concatenate(held)] = False
    number = np.append(np.where(free, np.cumsum(free) - 1, -1), -1)  # the last for what is no unknown, -1
    stiffness, mass = sparse.csr_array((free.sum(),) * 2), sparse.csr_array((free.sum(),) * 2)
    for part, fields, terms in parts:
        tied = _tied([[(number[numbers], factor) for numbers, factor in field] for field in terms], int(free.sum()))
        stiffness = stiffness + tied.T @ _matrix(part.stiffness, fields) @ tied
        mass = mass + tied.T @ _matrix(part.mass, fields) @ tied
    return Model(sparse.csc_array(stiffness), sparse.csc_array(mass), number[skin["w"]], x, y)


def _supported(skin: dict[str, NDArray[np.intp]]) -> list[NDArray[np.intp]]:
    ends = [skin[name][row] for name in "wq" for row in (0, -1)]
    return ends + [skin[name][:, 0] for name in "wp"]


def _web(beam: Beam, x: Line, edge: dict[str, NDArray[np.intp]], unknowns: _Unknowns) -> Rib:
    z = line(np.array([0.0, beam.depth]), beam.element, beam.degree)
    below = {name: unknowns.field(len(x.nodes), len(z.nodes) - 1) for name in _FIELDS}
    turn = unknowns.field(len(x.nodes), 1)  # the web's own rotation about the vertical
    none, half = np.full_like(turn, -1), -beam.thickness / 2

    def hung(name: str, *from_skin: tuple[str, float]) -> Tie:
        empty = np.full_like(below[name], -1)
        ties = [(np.hstack([edge[master][:, None], empty]), factor) for master, factor in from_skin]
        return [(np.hstack([none, below[name]]), 1.0), *ties]

    terms = [
        hung("u", ("u", 1.0), ("p", half)),
        hung("v", ("w", -1.0)),
        hung("w", ("v", 1.0), ("q", half)),
        [(np.hstack([turn, below["p"]]), 1.0)],
        hung("q", ("q", 1.0)),
    ]
    return Rib(shell(beam, x, z, beam.rib_thickness), _FIELDS, terms, [*below.values(), turn])


def _bar(beam: Beam, x: Line, edge: dict[str, NDArray[np.intp]], unknowns: _Unknowns) -> Rib:
    turn, down = unknowns.field(len(x.nodes)), -(beam.thickness + beam.depth) / 2
    terms = [
        [(edge["u"], 1.0), (edge["p"], down)],
        [(edge["v"], 1.0), (edge["q"], down)],
        *([(edge[name], 1.0)] for name in "wpq"),
        [(turn, 1.0)],
    ]
    return Rib(bar(beam, x), (*_FIELDS, "r"), terms, [turn])


# -- modes ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Modes:
    """Undamped modes of unit modal mass: frequency [Hz], w at the skin's nodes [kg^-1/2], parity 1 or -1."""

    beam: Beam
    frequency: Floats
    skin: Floats
    parity: Floats
    x: Line
    y: Line

    def shape(self, x: Floats, y: Floats) -> Floats:
        """Return w of each mode at points [m] of the skin, (n, n_modes) [kg^-1/2]."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        other = y > self.beam.width / 2
        rows, along = weights_at(self.x, x)
        columns, across = weights_at(self.y, np.where(other, self.beam.width - y, y))
        out = np.empty((len(x), len(self.frequency)))
        for k in range(len(x)):
            values = self.skin[:, rows[k, 0] : rows[k, -1] + 1, columns[k, 0] : columns[k, -1] + 1]
            out[k] = np.einsum("mij,i,j->m", values, along[k], across[k], optimize=False)
        return np.where(other[:, None], self.parity, 1.0) * out


def lowest(stiffness: sparse.csc_array, mass: sparse.csc_array, highest: float) -> tuple[Floats, Floats]:
    """Return all frequencies up to `highest` [Hz] and their vectors of unit modal mass, by shift and invert.

    The band is cut into slices, each with a shift in its middle; the modes nearest to the shift are found, until one
    of them lies outside of the slice.
    """
    size = stiffness.shape[0]
    if size <= _DENSE:
        values, vectors = linalg.eigh(stiffness.toarray(), mass.toarray())
        kept = values <= (2 * np.pi * highest) ** 2
        return np.sqrt(values[kept]) / (2 * np.pi), vectors[:, kept]
    edges = (2 * np.pi * np.linspace(0, highest, max(round(highest / _SLICE), 1) + 1)) ** 2
    found, number = [], 60
    for low, high in itertools.pairwise(edges):
        shift = (low + high) / 2
        factor = splu(
            sparse.csc_matrix(stiffness - shift * mass),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        inverse = LinearOperator(stiffness.shape, matvec=factor.solve, dtype=np.float64)
        while True:
            values, vectors = eigsh(stiffness, number, mass, sigma=shift, OPinv=inverse, v0=np.ones(size))
            if np.abs(values - shift).max() > (high - low) / 2:
                break
            number = int(1.4 * number) + 10
        # Sylvester's law: as many negative pivots as modes below the shift.
        below = sum(len(part[0]) for part in found) + np.count_nonzero((values > low) & (values < shift))
        if not np.array_equal(factor.perm_r, factor.perm_c) or np.count_nonzero(factor.U.diagonal() < 0) != below:
            raise ArithmeticError(
                f"modes must be complete below {np.sqrt(shift) / (2 * np.pi):.6g} Hz, some are missing"
            )
        order = np.argsort(values)
        order = order[(values[order] > low) & (values[order] <= high)]
        found.append((np.sqrt(values[order]) / (2 * np.pi), vectors[:, order]))
        number = int(1.2 * len(order)) + 20
    return np.concatenate([part[0] for part in found]), np.hstack([part[1] for part in found])


def modes_of(beam: Beam, highest: float) -> Modes:
    """Return the modes of a beam up to a frequency [Hz], kept in the system's folder for temporary files."""
    own = hashlib.sha256(Path(__file__).read_bytes() + repr((beam, highest)).encode()).hexdigest()[:16]
    file = Path(tempfile.gettempdir()) / f"independent_modes_{own}.npz"
    halves = {name: model(beam, name) for name in ("even", "odd")} if not file.exists() else {}
    if halves:
        found = _solved(beam, halves, highest)
        partial = file.with_suffix(f".{np.random.default_rng().integers(2**32)}.npz")
        np.savez(partial, **found)
        partial.replace(file)
    else:
        with np.load(file) as stored:
            found = dict(stored)
    x = line(found["x"], beam.element, beam.degree)
    y = line(found["y"], beam.element, beam.degree)
    return Modes(beam, found["frequency"], found["skin"].astype(np.float64), found["parity"], x, y)


def _solved(beam: Beam, halves: dict[str, Model], highest: float) -> dict[str, Floats]:
    frequencies, shapes, parities = [], [], []
    for sign, half in zip((1.0, -1.0), halves.values(), strict=True):
        frequency, vectors = lowest(half.stiffness, half.mass, highest)
        # The other half weighs as much: unit mass of the whole beam.
        known = np.vstack([vectors, np.zeros(len(frequency))]) / np.sqrt(2)
        frequencies.append(frequency)
        shapes.append(np.moveaxis(known[half.skin], -1, 0))
        parities.append(np.full(len(frequency), sign))
    frequency = np.concatenate(frequencies)
    order = np.argsort(frequency)
    return {
        "frequency": frequency[order],
        "skin": np.concatenate(shapes)[order].astype(np.float32),
        "parity": np.concatenate(parities)[order],
        "x": half.x.breaks,
        "y": half.y.breaks,
    }

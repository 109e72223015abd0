"""Modes of clamped and cantilever panels by Rayleigh and Ritz, in polynomials.

A shape is a sum of products of one-dimensional functions, integrals of Legendre polynomials that keep to the held
edges; free edges follow from the energy. In these the frequencies fall towards the true ones as the degree rises,
at first exponentially, at last as the corner where a held edge meets a free one allows (Leissa 1973, J. Sound Vib.
31, 257, has the cases). The degree is raised until that changes no frequency by more than `TOLERANCE`, which
leaves them within 3e-5 of the exact ones (1e-8 where all edges are held), and a cantilever's shapes within .002.

Two things keep the digits where polynomials of degree 60 would lose them. In each direction the functions are
first turned into those that diagonalise mass and bending both, so that the stiffness, scaled to a unit diagonal, is
well conditioned. And what is solved for is `1 / omega^2`: rounding is relative to the largest, the first mode's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from cgid.elementary import matrix_product
from cgid.physics.collocation import gauss
from cgid.physics.tail_beam import _eigen
from cgid.physics.tail_beam.rigidities import Rigidities
from cgid.physics.tail_beam.shapes import PolynomialShapes
from cgid.validation import Floats

#: Relative change of any frequency, when both degrees are raised by `_RISE`, at which the basis is taken as enough.
TOLERANCE = 1e-5
_RISE = 4
#: Polynomials for each half wave that fits in, and some more for what happens at the edges.
_PER_HALF_WAVE, _FOR_EDGES = math.pi / 2, 8


@dataclass(frozen=True, eq=False)
class _Line:
    """Functions of one coordinate u in [-1, 1] and the integrals of their products.

    Parameters
    ----------
    functions : ndarray, (n_degrees, n_functions)
        Their coefficients in Legendre polynomials.
    """

    functions: Floats

    def integrals(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the integrals of f f, f' f', f'' f'' and f'' f over [-1, 1], each (n_functions, n_functions).

        Gauss's rule with as many nodes as degrees is exact for these.
        """
        nodes, weights = gauss(len(self.functions))
        value, slope, bend = (
            matrix_product(
                np.asarray(legendre.legvander(nodes, len(part) - 1), np.float64), np.asarray(part, np.float64)
            )
            for part in (self.functions, legendre.legder(self.functions), legendre.legder(self.functions, 2))
        )
        pairs = ((value, value), (slope, slope), (bend, bend), (bend, value))
        weighed = ((first, weights[:, None] * second) for first, second in pairs)
        mass, slopes, bending, mixed = (matrix_product(first.T, second) for first, second in weighed)
        return mass, slopes, bending, mixed


def _integrated(series: Floats) -> Floats:
    """Return the integrals from -1 of Legendre series (n_degrees, n): `(P_(n+1) - P_(n-1)) / (2 n + 1)` of P_n."""
    shares = series / (2 * np.arange(len(series)) + 1)[:, None]
    out = np.zeros((len(series) + 1, series.shape[1]))
    out[1:] = shares
    out[: len(series) - 1] -= shares[1:]
    out[0] += shares[0]
    return out


def _line(number: int, held: str) -> list[_Line]:
    """Return `number` functions, even and odd ones apart where the line is symmetric.

    `held` says where value and slope are zero: at "both" ends, the "start", or "none". The second derivatives are
    Legendre polynomials, turned so that the integrals of f f are diagonal as well.
    """
    # Integrals of P_n from -1 vanish at +1 as well from the second degree on.
    degrees = np.arange(number) + (2 if held == "both" else 0)
    bends = np.zeros((degrees[-1] + 1, number))
    bends[degrees, np.arange(number)] = np.sqrt(degrees + 0.5)
    functions = _integrated(_integrated(bends))
    if held == "none":
        functions[:2] = 0.0  # what is left bends; the motions of a rigid body are functions of their own
    parts = [functions] if held == "start" else [functions[:, 0::2], functions[:, 1::2]]
    for parity, part in enumerate(parts):
        parts[parity] = matrix_product(part, eigenpairs(_Line(part).integrals()[0])[1])
        if held == "none":
            rigid = np.zeros((len(part), 1))
            rigid[parity] = math.sqrt(parity + 0.5)
            parts[parity] = np.hstack([rigid, parts[parity]])
    return [_Line(part) for part in parts]


@dataclass(frozen=True, eq=False)
class _Panel:
    """One symmetry of a panel: stiffness over mass per area, and mass, in products of the functions of two lines.

    Parameters
    ----------
    stiffness : ndarray, (n_products, n_products)
        In [rad^2/s^2], over the square [-1, 1] x [-1, 1].
    mass : ndarray, (n_products,)
        Of each product; by the choice of the functions the mass of two is zero.
    """

    along: _Line
    across: _Line
    stiffness: Floats
    mass: Floats

    @classmethod
    def of(cls, along: _Line, across: _Line, rigidities: Rigidities, length: float, width: float) -> _Panel:
        """Return the panel whose shapes are products of a function along and one across."""
        a, b = 4 / (length * length), 4 / (width * width)
        mass_x, slope_x, bending_x, mixed_x = along.integrals()
        mass_y, slope_y, bending_y, mixed_y = across.integrals()
        stiffness = rigidities.along * (a * a) * np.kron(bending_x, mass_y)
        stiffness += rigidities.across * (b * b) * np.kron(mass_x, bending_y)
        stiffness += 4 * rigidities.twist * a * b * np.kron(slope_x, slope_y)
        coupled = rigidities.coupling * a * b * np.kron(mixed_x, mixed_y.T)
        stiffness += coupled + coupled.T
        mass = np.kron(np.diag(mass_x), np.diag(mass_y)).astype(np.float64)
        return cls(along, across, np.asarray(stiffness / rigidities.mass, dtype=np.float64), mass)

    def _standard(self) -> tuple[Floats, Floats, Floats]:
        """Return the standard form of `M v = v K / omega^2`, the factor of the stiffness, and the products' scale."""
        scale = 1 / np.sqrt(np.diag(self.stiffness))
        factor = self.stiffness * scale * scale[:, None]
        if not _eigen.factorise(factor):
            raise FloatingPointError("stiffness of a panel is not positive")
        form = np.empty_like(factor)
        _eigen.standard_form(factor, self.mass * scale * scale, form)
        return form, factor, scale

    def frequencies(self, highest: float) -> Floats:
        """Return the natural frequencies up to the highest [rad/s], ascending."""
        return 1 / np.sqrt(eigenvalues(self._standard()[0], 1 / (highest * highest)))

    def modes(self, highest: float) -> tuple[Floats, Floats]:
        """Return the frequencies up to the highest [rad/s] and the shapes, whose mean square is 1/4.

        Of these the coefficients (n_degrees_x, n_degrees_y, n_modes) in products of Legendre polynomials.
        """
        form, factor, scale = self._standard()
        inverse, vectors = eigenpairs(form, 1 / (highest * highest))
        _eigen.unfactorised(factor, vectors)
        vectors *= scale[:, None] / np.sqrt(inverse)
        cube = vectors.reshape(self.along.functions.shape[1], self.across.functions.shape[1], -1)
        half = matrix_product(self.along.functions, cube).swapaxes(0, 1)
        return 1 / np.sqrt(inverse), matrix_product(self.across.functions, half).swapaxes(0, 1)


def ritz_modes(
    rigidities: Rigidities, length: float, width: float, held: tuple[str, str], highest: float
) -> tuple[Floats, PolynomialShapes]:
    """Return the natural frequencies up to the highest [rad/s], and the shapes, whose mean square is 1/4.

    Parameters
    ----------
    held : tuple of str
        Along x and along y where value and slope are zero: "both" ends, the "start", or "none".
    """
    wave_number = [math.sqrt(highest * math.sqrt(rigidities.mass / d)) for d in (rigidities.along, rigidities.across)]
    numbers = [
        math.ceil(_PER_HALF_WAVE * k * extent / math.pi) + _FOR_EDGES
        for k, extent in zip(wave_number, (length, width), strict=True)
    ]

    def panels() -> list[_Panel]:
        lines = [_line(number, where) for number, where in zip(numbers, held, strict=True)]
        return [_Panel.of(x, y, rigidities, length, width) for x in lines[0] for y in lines[1]]

    # What falls to the highest frequency as the degree rises lies barely above it before.
    coarse = [panel.frequencies(1.001 * highest) for panel in panels()]
    while True:
        numbers = [number + _RISE for number in numbers]
        found = [panel.modes(highest) for panel in panels()]
        fine = [part for part, _ in found]
        if all(_settled(*pair) for pair in zip(coarse, fine, strict=True)):
            break
        coarse = fine
    frequencies = np.concatenate(fine)
    order = np.argsort(frequencies, kind="stable")
    return frequencies[order], PolynomialShapes.of([shapes for _, shapes in found], order)


def eigenvalues(matrix: Floats, lowest: float = -np.inf) -> Floats:
    """Return the eigenvalues of a symmetric matrix (n, n) above the lowest, falling; the matrix is used up."""
    return _tridiagonal(matrix, lowest)[2]


def eigenpairs(matrix: Floats, lowest: float = -np.inf) -> tuple[Floats, Floats]:
    """Return the same and their unit vectors, (n, n_values)."""
    diagonal, beside, values, factors = _tridiagonal(matrix, lowest)
    rows = np.empty((values.size, len(matrix)))
    _eigen.vectors(diagonal, beside, values, rows)
    columns = np.ascontiguousarray(rows.T)
    _eigen.turned_back(matrix, factors, columns)
    return values, columns


def _tridiagonal(matrix: Floats, lowest: float) -> tuple[Floats, Floats, Floats, Floats]:
    n = len(matrix)
    diagonal, beside, factors, values = np.empty(n), np.empty(n - 1), np.empty(n), np.empty(n)
    _eigen.tridiagonalise(matrix, diagonal, beside, factors)
    return diagonal, beside, values[: _eigen.largest(diagonal, beside, lowest, values)], factors


def _settled(coarse: Floats, fine: Floats) -> bool:
    return bool(fine.size <= coarse.size and np.all(coarse[: fine.size] - fine <= TOLERANCE * fine))

"""Mode shapes that can be asked for at any point: products of sines, or sums of Legendre polynomials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.validation import Floats

Indices = NDArray[np.intp]

#: A term that adds less than this to every mode (a shape's mean square is 1/4) is left out; together at most 1e-6.
_NEGLIGIBLE = 1e-7


@dataclass(frozen=True, eq=False)
class SineShapes:
    """`sin(i pi x) sin(j pi y)` over the unit square: a simply supported panel.

    Parameters
    ----------
    along, across : ndarray of int, (n_modes,)
        i and j, half waves in x and y.
    """

    along: Indices
    across: Indices

    def at(self, x: Floats, y: Floats) -> Floats:
        """Return the shapes (n_points, n_modes) at points (n_points,) of the unit square."""
        from cgid.physics.tail_beam import _shapes

        out = np.empty((x.size, self.along.size))
        if out.size:
            _shapes.sine_shapes(x, y, self.along, self.across, out)
        return out

    def taken(self, modes: Indices) -> SineShapes:
        """Return only the modes of these numbers."""
        return SineShapes(self.along[modes], self.across[modes])


@dataclass(frozen=True, eq=False)
class _Symmetry:
    """The modes of one symmetry: which they are, and their terms `P_i(2x - 1) P_j(2y - 1)`.

    Parameters
    ----------
    modes : ndarray of int, (n_modes,)
        Their numbers among all modes.
    along, across : ndarray of int, (n_terms,)
        i and j of each term.
    coefficients : ndarray, (n_terms, n_modes)
        Filled up with zeros, for the kernel to take four terms and sixteen modes at a time.
    """

    modes: Indices
    along: Indices
    across: Indices
    coefficients: Floats

    def kept(self, columns: Indices, numbers: Indices) -> _Symmetry:
        """Return these columns under new numbers, without negligible terms."""
        coefficients = self.coefficients[:, columns]
        terms = np.flatnonzero(np.abs(coefficients).max(axis=1, initial=0.0) > _NEGLIGIBLE)
        more_terms, more_modes = -terms.size % 4, -columns.size % 16
        return _Symmetry(
            numbers,
            np.pad(self.along[terms], (0, more_terms)),
            np.pad(self.across[terms], (0, more_terms)),
            np.pad(coefficients[terms], ((0, more_terms), (0, more_modes))),
        )


@dataclass(frozen=True, eq=False)
class PolynomialShapes:
    """Sums of products of Legendre polynomials over the unit square, those of each symmetry together."""

    symmetries: tuple[_Symmetry, ...]

    @classmethod
    def of(cls, coefficients: list[Floats], order: Indices) -> PolynomialShapes:
        """Return shapes given the coefficients (n_degrees_x, n_degrees_y, n_modes) of each symmetry.

        `order` says which of the modes, counted through all symmetries, stands at each place.
        """
        place = np.empty(order.size, dtype=np.intp)
        place[order] = np.arange(order.size)
        symmetries, start = [], 0
        for cube in coefficients:
            modes = place[start : start + cube.shape[2]]
            start += cube.shape[2]
            along, across = (index.ravel() for index in np.indices(cube.shape[:2]))
            table = cube.reshape(along.size, modes.size)
            # Of a shape and its negative, the one whose largest coefficient is positive.
            table = table * np.sign(table[np.abs(table).argmax(axis=0), np.arange(modes.size)])
            symmetries.append(_Symmetry(modes, along, across, table).kept(np.arange(modes.size), modes))
        return cls(tuple(symmetries))

    def at(self, x: Floats, y: Floats) -> Floats:
        """Return the shapes (n_points, n_modes) at points (n_points,) of the unit square."""
        from cgid.physics.tail_beam import _shapes

        out = np.empty((x.size, sum(symmetry.modes.size for symmetry in self.symmetries)))
        for symmetry in self.symmetries:
            if symmetry.modes.size and x.size:
                part = np.empty((x.size, symmetry.coefficients.shape[1]))
                _shapes.polynomial_shapes(x, y, symmetry.along, symmetry.across, symmetry.coefficients, part)
                out[:, symmetry.modes] = part[:, : symmetry.modes.size]
        return out

    def taken(self, modes: Indices) -> PolynomialShapes:
        """Return only the modes of these numbers."""
        place = np.full(sum(symmetry.modes.size for symmetry in self.symmetries), -1)
        place[modes] = np.arange(modes.size)
        symmetries = []
        for symmetry in self.symmetries:
            numbers = place[symmetry.modes]
            symmetries.append(symmetry.kept(np.flatnonzero(numbers >= 0), numbers[numbers >= 0]))
        return PolynomialShapes(tuple(symmetries))


Shapes = SineShapes | PolynomialShapes

"""Modes of a panel: frequencies, damping, modal masses, and shapes at any point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.physics.tail_beam.shapes import Shapes
from cgid.validation import Floats

Point = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True, kw_only=True, eq=False)
class Modes:
    """Natural modes of a rectangular panel, `TailBeam.modes` makes them.

    Mode r moves by `q_r'' + 2 zeta_r omega_r q_r' + omega_r^2 q_r = shape_r(impact) P / m_r`, and a point of the
    panel by the sum of `shape_r(point) q_r`.

    Parameters
    ----------
    frequency : ndarray, (n_modes,)
        Natural frequencies without damping [Hz], ascending.
    damping_ratio : ndarray, (n_modes,)
    modal_mass : ndarray, (n_modes,)
        Integral of mass per area times shape squared [kg].
    length, width : float
        Of the panel [m].
    shapes : SineShapes or PolynomialShapes
        Over the unit square; the mean square of each is 1/4.
    """

    frequency: Floats
    damping_ratio: Floats
    modal_mass: Floats
    length: float
    width: float
    shapes: Shapes

    def __post_init__(self) -> None:
        validation.hold(self, "frequency", "damping_ratio", "modal_mass")

    def shape(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the shapes of all modes at points of the panel, dimensionless.

        Parameters
        ----------
        x, y : array_like
            From the held edge along the length and from one side over the width [m]; they broadcast.

        Returns
        -------
        ndarray, (*points, n_modes)

        Raises
        ------
        InvalidValue
            A point does not lie on the panel.
        """
        along, across = validation.broadcast(x=on_panel("x", x, self.length), y=on_panel("y", y, self.width))
        values = self.shapes.at(along.ravel(), across.ravel())
        return values.reshape(*along.shape, self.frequency.size)

    def participation(self, impact: Point, sensor: Point) -> Floats:
        """Return how much each mode carries from one point to another, `shape(impact) shape(sensor) / modal_mass`.

        Parameters
        ----------
        impact, sensor : tuple of array_like
            x and y [m] of where the force acts and of where the motion is measured.

        Returns
        -------
        ndarray, (*points, n_modes)
            [1/kg].
        """
        return self.shape(*impact) * self.shape(*sensor) / self.modal_mass

    def up_to(self, frequency: float) -> Modes:
        """Return only the modes up to a frequency [Hz]; their shapes then cost less, too."""
        return self.taken(np.flatnonzero(self.frequency <= validation.not_negative("frequency", frequency, "Hz")))

    def taken(self, modes: NDArray[np.intp]) -> Modes:
        """Return only the modes of these numbers, ascending."""
        return replace(
            self,
            frequency=self.frequency[modes],
            damping_ratio=self.damping_ratio[modes],
            modal_mass=self.modal_mass[modes],
            shapes=self.shapes.taken(modes),
        )


def on_panel(name: str, value: ArrayLike, extent: float) -> Floats:
    """Return places as a share of a side, or raise."""
    place = validation.real(name, value, "m")
    off = np.flatnonzero((place < 0) | (place > extent))
    if off.size:
        index = f" at index {off[0]}" if place.ndim else ""
        raise InvalidValue(
            f"{name} must lie on the beam, from 0 to {extent:g} m, got {place.ravel()[off[0]]:g} m{index}"
        )
    return place / extent

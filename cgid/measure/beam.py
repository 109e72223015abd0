"""A beam and its sensor as plain arrays: the response of each mode to a contact force, weighed by the place.

`cgid.scene.through_beam` makes it from a scene, a model file holds it, and `cgid.identification.inversion` turns it
round.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.validation import Floats

#: Points of a contact force to a sample, and length of a table of forces [s].
FINE, FORCE_TIME = 16, 3.9e-3
#: Samples at the start of a table of forces, within which touch lies.
TOUCH = 7

Singles = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Beam:
    """A beam and its sensor as arrays.

    Parameters
    ----------
    sampling_rate : float [Hz]
        Of the recorder whose anti-alias filter `filters` describes.
    poles : ndarray of complex, (n_modes,) [rad/s]
        Of the modes, in the upper half-plane.
    participation : ndarray, (n_modes, n_x, n_y) [1/kg]
        Of each mode at the Chebyshev nodes (`nodes`) of the region where blows fall, including a gain.
    region : ndarray, (4,) [m]
        Lowest and highest x, lowest and highest y.
    filters : ndarray of complex, (n_filter_poles,) [rad/s]
        Poles of the sensor chain, in the upper half-plane and on the real axis.
    derivatives : int
        Of the displacement: 0, 1 or 2 for displacement, velocity or acceleration.
    shapes : ndarray, (n_shapes, n_points) [1]
        Principal shapes of contact forces, `FINE` points to a sample, before the filters.
    deviations : ndarray, (n_shapes,) [1]
        Standard deviation of the coefficient of each, for a force of peak 1.
    """

    #: Names of the arrays in a model file.
    ARRAYS: ClassVar = ("scalars", "poles", "participation", "region", "filters", "shapes", "deviations")

    sampling_rate: float
    poles: NDArray[np.complex128]
    participation: Floats
    region: Floats
    filters: NDArray[np.complex128]
    derivatives: int
    shapes: Floats
    deviations: Floats

    def weights(self, x: Floats, y: Floats) -> tuple[Singles, Singles, Singles]:
        """Return the participation of the modes at places (n,) [m] and its slopes in x and y, each (n, n_modes)."""
        _, n_x, n_y = self.participation.shape
        along, along_slope = lagrange(n_x, self.region[0], self.region[1], x)
        across, across_slope = lagrange(n_y, self.region[2], self.region[3], y)
        flat = np.ascontiguousarray(self.participation.transpose(1, 2, 0))
        with_y, with_slope = np.tensordot(across, flat, (1, 1)), np.tensordot(across_slope, flat, (1, 1))
        return (
            np.einsum("nx,nxm->nm", along, with_y).astype(np.float32),
            np.einsum("nx,nxm->nm", along_slope, with_y).astype(np.float32),
            np.einsum("nx,nxm->nm", along, with_slope).astype(np.float32),
        )

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The beam as arrays for a model file."""
        return {
            "beam.scalars": np.array([self.sampling_rate, float(self.derivatives)]),
            "beam.poles": np.stack([self.poles.real, self.poles.imag]),
            "beam.participation": self.participation,
            "beam.region": self.region,
            "beam.filters": np.stack([self.filters.real, self.filters.imag]),
            "beam.shapes": self.shapes,
            "beam.deviations": self.deviations,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Beam | None:
        """Return the beam of `arrays`, checked; None if they hold none."""
        own = {name.removeprefix("beam."): array for name, array in arrays.items() if name.startswith("beam.")}
        if not own:
            return None
        names = cls.ARRAYS
        if own.keys() != set(names) or any(own[name].dtype.kind != "f" for name in names):
            raise BadData(f"a beam must have the arrays {', '.join(names)} of real numbers")
        for name in names:
            validation.real(f"beam.{name}", own[name])
        beam = cls(
            sampling_rate=float(own["scalars"].ravel()[0]),
            derivatives=int(own["scalars"].ravel()[-1]),
            poles=_complex("poles", own["poles"]),
            filters=_complex("filters", own["filters"]),
            **{name: own[name] for name in ("participation", "region", "shapes", "deviations")},
        )
        beam.check()
        return beam

    def check(self) -> None:
        """Raise `BadData` unless the shapes of the arrays and their signs belong together."""
        validation.positive("sampling_rate of a beam", self.sampling_rate, "Hz")
        n_modes, n_shapes = len(self.poles), len(self.deviations)
        sound = (
            self.derivatives in (0, 1, 2)
            and (self.poles.real < 0).all()
            and (self.poles.imag > 0).all()
            and (self.filters.real < 0).all()
            and self.participation.ndim == 3
            and len(self.participation) == n_modes
            and self.region.shape == (4,)
            and (self.region[1::2] >= self.region[::2]).all()
            and self.shapes.shape == (n_shapes, points_of(self.sampling_rate))
            and (self.deviations > 0).all()
        )
        if not sound:
            raise BadData("the arrays of a beam must fit each other, with poles that decay; train the model again")


def _complex(name: str, parts: Floats) -> NDArray[np.complex128]:
    if parts.ndim != 2 or len(parts) != 2:
        raise BadData(f"beam.{name} must be real and imaginary parts, got shape {parts.shape}")
    return np.asarray(parts[0] + 1j * parts[1])


def points_of(sampling_rate: float) -> int:
    """Return the number of points of a table of forces."""
    return FINE * round(FORCE_TIME * sampling_rate)


def nodes(n: int, lowest: float, highest: float) -> Floats:
    """Return n Chebyshev nodes between two places, ascending; of one node, the middle."""
    return (lowest + highest) / 2 - (highest - lowest) / 2 * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def lagrange(n: int, lowest: float, highest: float, place: Floats) -> tuple[Floats, Floats]:
    """Return the weights of n Chebyshev nodes at places (n_places,) and their slopes, each (n_places, n).

    Through Chebyshev polynomials: `f(t) = sum_j c_j T_j(t)`, with `c_j` a cosine transform of the values at the nodes.
    """
    half = (highest - lowest) / 2
    if n == 1 or half == 0:
        return np.full((place.size, n), 1 / n), np.zeros((place.size, n))
    angle = np.pi * (np.arange(n) + 0.5) / n
    order = np.arange(n)
    transform = np.cos(np.outer(order, np.pi - angle)) * (2 / n)
    transform[0] /= 2
    t = np.clip((place - (lowest + highest) / 2) / half, -1 + 1e-12, 1 - 1e-12)
    theta = np.arccos(t)
    values = np.cos(np.outer(theta, order))
    slopes = order * np.sin(np.outer(theta, order)) / np.sin(theta)[:, None] / half
    return values @ transform, slopes @ transform


def gain(poles: NDArray[np.complex128], frequencies: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Return the gain of filters at frequencies [Hz]; 1 without any."""
    s = 2j * np.pi * frequencies
    out = np.ones(s.shape, complex)
    for pole in poles:
        both = pole.imag != 0
        out *= (abs(pole) ** 2 / ((s - pole) * (s - pole.conjugate()))) if both else -pole.real / (s - pole)
    return out


def filtered(beam: Beam, forces: Floats) -> Floats:
    """Return forces (..., n_points), `FINE` points to a sample, behind the filters of a beam."""
    n_points = forces.shape[-1]
    spectrum = np.fft.rfft(forces, 2 * n_points, axis=-1)
    spectrum *= gain(beam.filters, np.fft.rfftfreq(2 * n_points, 1 / (FINE * beam.sampling_rate)))
    return np.asarray(np.fft.irfft(spectrum, axis=-1)[..., :n_points])


def respond(beam: Beam, forces: Floats, n_samples: int) -> Floats:
    """Return the response of every mode to forces (n_forces, n_points) at samples, (n_modes, n_forces, n_samples).

    A mode is a pole s: `x' = s x + f`, exact for forces straight between their points. Its displacement is
    `Im x / Im s`, its derivatives have further factors s, and the acceleration has the force itself, too.
    """
    pole, step = beam.poles, 1 / (FINE * beam.sampling_rate)
    z = pole * step
    grown = np.exp(z)
    late = step * (grown - 1 - z) / z**2
    early = step * (grown - 1) / z - late
    powers = grown[:, None] ** np.arange(FINE - 1, -1, -1)
    points = np.zeros((len(pole), FINE + 1), complex)
    points[:, :FINE] += powers * early[:, None]
    points[:, 1:] += powers * late[:, None]
    amplitude = pole**beam.derivatives / (1j * pole.imag)
    over_a_sample = grown**FINE
    state = np.zeros((len(pole), len(forces)), complex)
    out = np.empty((len(pole), len(forces), n_samples))
    longer = np.concatenate([forces, np.zeros((len(forces), 1))], axis=1)
    for sample in range(n_samples):
        out[:, :, sample] = (amplitude[:, None] * state).real
        state *= over_a_sample[:, None]
        if (sample + 1) * FINE <= forces.shape[1]:
            own = longer[:, sample * FINE : (sample + 1) * FINE + 1]
            state += points @ own.T
            if beam.derivatives == 2:
                out[:, :, sample] += own[:, 0]
    return out

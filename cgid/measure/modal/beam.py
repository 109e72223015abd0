"""A beam and its sensor as plain arrays: the response of each mode to a contact force.

`cgid.scene.synthesis.through_beam` makes it from a scene, and a model file contains it;
`cgid.identification.inversion.inversion` inverts it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.measure.modal.modes import CORRECTED, Modes, NodeShapes, lagrange, phi, residues

#: Quadrature nodes of an average over the error of a frequency.
_DRAWS = 5
#: Points of a contact force per sample, and length of a table of forces [s].
FINE, FORCE_TIME = 16, 3.9e-3
#: Samples at the start of a table of forces, that contain the onset.
TOUCH = 7
#: Length of the compared part of a response [s].
SPAN_TIME = 25e-3
#: Spacing of the grid of locations [m].
GRID = 0.025
#: Sampling rates [Hz]: a table of forces has 14 samples or more, a response at most 12,500.
RATES = (2 * TOUCH / FORCE_TIME, 5e5)
#: Maximum number of modes, grid locations, and samples of all responses together (a quarter of a gigabyte in single
#: precision).
MAX_MODES, MAX_LOCATIONS, MAX_NUMBERS = 1024, 1 << 14, 1 << 26
#: Maximum number of sensors; smallest and largest fraction of a participation that a sensor measures.
MAX_SENSORS, _SHARES = 16, (1e-6, 1e6)
#: Maximum number of shapes, poles of filters, and nodes in a direction.
_MAX_SHAPES, _MAX_FILTERS, _MAX_NODES = 64, 32, 512
#: Moduli of poles and of filters over the sampling rate, least imaginary part of a pole over its modulus, and limits of
#: other numbers above 0.
_POLES, _CUT_OFFS, _MIN_IMAGINARY, _NUMBERS = (1e-5, 1e3), (1e-3, 1e3), 1e-6, (1e-9, 1e9)

Singles = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Beam:
    """A beam and its sensor as arrays."""

    #: Names of the arrays in a model file; the optional ones may be missing.
    OPTIONAL: ClassVar = ("sensors", "errors", "linear_phase")
    ARRAYS: ClassVar = ("scalars", "poles", "participation", "region", "filters", "shapes", "deviations", *OPTIONAL)

    sampling_rate: float  # sampling rate of the recorder with the anti-alias filter `filters` [Hz]
    #: shapes at nodes where rocks fall, times that at the best sensor and a gain [1/kg]; fractions by sensor
    modes: Modes
    #: (n_filter_poles,), poles of the sensor chain, in the upper half-plane and on the real axis [rad/s]
    filters: NDArray[np.complex128]
    derivatives: int  # 0, 1 or 2 for displacement, velocity or acceleration
    shapes: Floats  # (n_shapes, n_points), principal contact forces, `FINE` points a sample, before the filters
    deviations: Floats  # (n_shapes,), standard deviations of their coefficients for a force of peak 1
    #: (3,), of a low-pass of linear phase in the chain: edge, width of the edge [Hz] and delay [s]; None without one
    linear_phase: Floats | None = None

    def gain(self, frequencies: NDArray[np.floating]) -> NDArray[np.complex128]:
        """Return the gain of the sensor chain at frequencies [Hz]."""
        out = gain(self.filters, frequencies)
        return out if self.linear_phase is None else out * linear_phase_gain(frequencies, *self.linear_phase.tolist())

    @property
    def delay(self) -> float:
        """Delay of a low-pass of linear phase [s]."""
        return 0.0 if self.linear_phase is None else float(self.linear_phase[2])

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles of the modes in the upper half-plane, (n_modes,) [rad/s]."""
        return self.modes.poles

    @property
    def _nodes(self) -> NodeShapes:
        assert isinstance(self.modes.at_impact, NodeShapes)
        return self.modes.at_impact

    @property
    def participation(self) -> Floats:
        """Participation of the modes at the nodes, (n_modes, n_x, n_y) [1/kg]."""
        return self._nodes.values

    @property
    def region(self) -> Floats:
        """Lowest and highest x, lowest and highest y, (4,) [m]."""
        return self._nodes.region

    @property
    def errors(self) -> Floats | None:
        """Standard deviations of ln frequency, ln damping ratio and ln participation, (3, n_modes); None if exact."""
        return self.modes.deviation

    @property
    def shares(self) -> Floats:
        """Fractions of `participation` that each sensor measures, (n_sensors, n_modes)."""
        assert self.modes.at_sensor is not None
        return self.modes.at_sensor

    @property
    def n_sensors(self) -> int:
        """Number of sensors; their samples are inverted together."""
        return len(self.shares)

    def at(self, rate: float) -> Beam:
        """Return the beam with a recorder of another rate [Hz], whose low-passes are at the same share of it."""
        ratio = rate / self.sampling_rate
        low_pass = np.abs(self.filters) < np.pi * self.sampling_rate
        own, points = (np.arange(points_of(one)) / (FINE * one) for one in (self.sampling_rate, rate))
        return replace(
            self,
            sampling_rate=rate,
            filters=np.where(low_pass, self.filters * ratio, self.filters),
            linear_phase=None if self.linear_phase is None else self.linear_phase * [ratio, ratio, 1.0],
            shapes=np.array([np.interp(points, own, shape) for shape in self.shapes]).reshape(-1, points.size),
        )

    def of_sensor(self, number: int) -> Beam:
        """Return the beam as one of its sensors measures it alone."""
        alone = replace(self.modes, at_sensor=np.ones((1, len(self.poles))))
        return replace(self, modes=alone).with_shapes(self.participation * self.shares[number][:, None, None])

    def with_shapes(self, participation: Floats) -> Beam:
        """Return the beam with other participations at the nodes."""
        return replace(self, modes=replace(self.modes, at_impact=NodeShapes(participation, self.region)))

    def taken(self, part: slice | NDArray[np.intp]) -> Beam:
        """Return the beam with some of its modes."""
        return replace(self, modes=self.modes.taken(part))

    @property
    def n_samples(self) -> int:
        """Number of samples of a response to an impact."""
        return round(SPAN_TIME * self.sampling_rate)

    def grid(self, spacing: float) -> tuple[Floats, Floats, Singles]:
        """Return x and y of a grid in the region, each (n_places,) [m], and their weights as in `weights`."""
        sides, axes = [], []
        for axis, n in enumerate(sides_of(self.region, spacing)):
            low, high = self.region[2 * axis : 2 * axis + 2].tolist()
            sides.append(np.linspace(low, high, n))
            axes.append(lagrange(self.participation.shape[axis + 1], low, high, sides[-1])[0])
        x, y = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
        at = (axes[0] @ self.participation @ axes[1].T).reshape(len(self.participation), -1)
        return x, y, np.ascontiguousarray(at.T, dtype=np.float32)

    def weights(self, x: Floats, y: Floats) -> tuple[Singles, Singles, Singles]:
        """Return the participation of the modes at locations (n,) [m] and its slopes in x and y, each (n, n_modes)."""
        n_modes, n_x, n_y = self.participation.shape
        along, along_slope = lagrange(n_x, self.region[0], self.region[1], x)
        across, across_slope = lagrange(n_y, self.region[2], self.region[3], y)
        along, along_slope, across, across_slope = (
            side.astype(self.participation.dtype) for side in (along, along_slope, across, across_slope)
        )
        with_y, with_slope = ((side @ self._by_y).reshape(-1, n_x, n_modes) for side in (across, across_slope))
        both = np.stack([along, along_slope], axis=1) @ with_y
        last = along[:, None] @ with_slope
        return both[:, 0].astype(np.float32), both[:, 1].astype(np.float32), last[:, 0].astype(np.float32)

    @cached_property
    def _by_y(self) -> Floats:
        """Participation, (n_y, n_x * n_modes)."""
        return np.ascontiguousarray(self.participation.transpose(2, 1, 0).reshape(self.participation.shape[2], -1))

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The beam as arrays for a model file."""
        arrays = {
            "beam.scalars": np.array([self.sampling_rate, float(self.derivatives)]),
            "beam.poles": np.stack([self.poles.real, self.poles.imag]),
            "beam.participation": self.participation,
            "beam.region": self.region,
            "beam.filters": np.stack([self.filters.real, self.filters.imag]),
            "beam.shapes": self.shapes,
            "beam.deviations": self.deviations,
        }
        if self.n_sensors > 1:
            arrays["beam.sensors"] = self.shares
        if self.errors is not None:
            arrays["beam.errors"] = self.errors
        if self.linear_phase is not None:
            arrays["beam.linear_phase"] = self.linear_phase
        # A file contains no empty array.
        return {name: array for name, array in arrays.items() if array.size}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Beam | None:
        """Return the beam of `arrays`, checked; None if there is none."""
        stored = {name.removeprefix("beam."): array for name, array in arrays.items() if name.startswith("beam.")}
        if not stored:
            return None
        stored.setdefault("filters", np.empty((2, 0)))
        needed = cls.ARRAYS[: -len(cls.OPTIONAL)]
        names = (*needed, *(name for name in cls.OPTIONAL if name in stored))
        if stored.keys() != set(names) or any(stored[name].dtype.kind != "f" for name in names):
            raise BadData(f"a beam must have the arrays {', '.join(needed)} of real numbers")
        for name in names:
            validation.real(f"beam.{name}", stored[name])
        if stored["scalars"].shape != (2,):
            raise BadData(f"beam.scalars must be sampling rate and derivatives, got shape {stored['scalars'].shape}")
        poles, sensors = _complex("poles", stored["poles"]), stored.get("sensors")
        if not (poles.imag > 0).all():
            raise BadData("beam.poles must be in the upper half-plane; train the model again")
        size = np.abs(poles)
        beam = cls(
            sampling_rate=float(stored["scalars"][0]),
            derivatives=stored["scalars"][1].item(),
            modes=Modes(
                frequency=size / (2 * np.pi),
                damping_ratio=-poles.real / size,
                at_impact=NodeShapes(stored["participation"], stored["region"]),
                at_sensor=np.ones((1, poles.size)) if sensors is None else sensors,
                deviation=stored.get("errors"),
            ),
            filters=_complex("filters", stored["filters"]),
            shapes=stored["shapes"],
            deviations=stored["deviations"],
            linear_phase=stored.get("linear_phase"),
        )
        beam.check()
        return replace(beam, derivatives=int(beam.derivatives))

    def check(self) -> None:
        """Raise `BadData` unless the arrays belong together and their tables are finite and of bounded size."""
        validation.between("sampling_rate of a beam", self.sampling_rate, *RATES, "Hz")
        n_modes, n_shapes = len(self.poles), self.deviations.size
        size, rates = np.abs(self.participation), np.abs(self.poles) / self.sampling_rate
        sound = (
            self.derivatives in (0, 1, 2)
            and (self.poles.real < 0).all()
            and (self.poles.imag > _MIN_IMAGINARY * np.abs(self.poles)).all()
            and (self.filters.real < 0).all()
            and (self.filters.imag >= 0).all()
            and _inside(rates, *_POLES)
            and _inside(np.abs(self.filters) / self.sampling_rate, *_CUT_OFFS)
            and self.participation.ndim == 3
            and len(self.participation) == n_modes
            and _inside(size.max(initial=0.0), *_NUMBERS)
            and self.region.shape == (4,)
            and (self.region[1::2] >= self.region[::2]).all()
            and self.deviations.ndim == 1
            and self.shapes.shape == (n_shapes, points_of(self.sampling_rate))
            and (np.abs(self.shapes).max(axis=1, initial=0.0) > _NUMBERS[0]).all()
            and (np.abs(self.shapes) < _NUMBERS[1]).all()
            and _inside(self.deviations, *_NUMBERS)
            and self.shares.ndim == 2
            and self.shares.shape[1] == n_modes
            and _inside(np.abs(self.shares).max(axis=1, initial=0.0), *_SHARES)
            and (
                self.linear_phase is None
                or (
                    self.linear_phase.shape == (3,)
                    and _inside(self.linear_phase[:2] / self.sampling_rate, *_CUT_OFFS)
                    and 0 <= self.linear_phase[2] <= FORCE_TIME
                )
            )
            and (self.errors is None or (self.errors.shape == (len(CORRECTED), n_modes) and _inside(self.errors, 0, 1)))
        )
        if not sound:
            raise BadData("the arrays of a beam must fit each other, with poles that decay; train the model again")
        counts = (n_shapes, len(self.filters), *self.participation.shape[1:], self.n_sensors)
        limits = (_MAX_SHAPES, _MAX_FILTERS, _MAX_NODES, _MAX_NODES, MAX_SENSORS)
        few = all(one <= limit for one, limit in zip(counts, limits, strict=True))
        if not few or not bounded(n_modes, n_shapes, self.n_sensors * self.n_samples, self.region):
            n_samples, sides = n_modes * n_shapes * self.n_sensors * self.n_samples, np.diff(self.region)[::2]
            raise BadData(
                f"a beam must have at most {MAX_MODES} modes, {_MAX_SHAPES} shapes, {_MAX_NODES} nodes in a "
                f"direction, {MAX_SENSORS} sensors, {MAX_NUMBERS} samples of all responses and {MAX_LOCATIONS} "
                f"locations, got {n_modes} modes, {n_shapes} shapes, {' x '.join(map(str, counts[2:4]))} nodes, "
                f"{self.n_sensors} sensors, {n_samples} samples and a region of "
                f"{' x '.join(f'{side:g} m' for side in sides)}"
            )


def bounded(n_modes: int, n_shapes: int, n_samples: int, region: Floats) -> bool:
    """Return whether the tables of a beam fit in memory."""
    along, across = sides_of(region, GRID)
    return n_modes <= MAX_MODES and n_modes * n_shapes * n_samples <= MAX_NUMBERS and along * across <= MAX_LOCATIONS


def sides_of(region: Floats, spacing: float) -> tuple[int, int]:
    """Return the number of grid points in either direction."""
    along, across = (int(np.ceil((high - low) / spacing)) + 1 for low, high in region.reshape(2, 2).tolist())
    return along, across


def _inside(values: Floats, lowest: float, highest: float) -> bool:
    return bool(np.all((values >= lowest) & (values <= highest)))


def _complex(name: str, parts: Floats) -> NDArray[np.complex128]:
    if parts.ndim != 2 or len(parts) != 2:
        raise BadData(f"beam.{name} must be real and imaginary parts, got shape {parts.shape}")
    return np.asarray(parts[0] + 1j * parts[1])


def points_of(sampling_rate: float) -> int:
    """Return the number of points of a table of forces."""
    return FINE * round(FORCE_TIME * sampling_rate)


def gain(poles: NDArray[np.complex128], frequencies: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Return the gain of filters at frequencies [Hz]; 1 without any."""
    s = 2j * np.pi * frequencies
    out = np.ones(s.shape, complex)
    for pole in poles:
        both = pole.imag != 0
        out *= (abs(pole) ** 2 / ((s - pole) * (s - pole.conjugate()))) if both else -pole.real / (s - pole)
    return out


def linear_phase_gain(
    frequencies: NDArray[np.floating], edge: float, width: float, delay: float
) -> NDArray[np.complex128]:
    """Return the gain of a brick wall at an edge, smoothed by a Gaussian of a standard deviation `width`, and late."""
    # Its impulse response is a sinc times a Gaussian, which ends: a filter of finite impulse response.
    height = [0.5 * math.erfc(place) for place in ((np.abs(frequencies) - edge) / (math.sqrt(2) * width)).tolist()]
    return np.asarray(np.array(height) * np.exp(-2j * np.pi * frequencies * delay))


def filtered(beam: Beam, forces: Floats) -> Floats:
    """Return forces (..., n_points), `FINE` points to a sample, after the filters of a beam."""
    n_points = forces.shape[-1]
    spectrum = np.fft.rfft(forces, 2 * n_points, axis=-1)
    spectrum *= beam.gain(np.fft.rfftfreq(2 * n_points, 1 / (FINE * beam.sampling_rate)))
    return np.asarray(np.fft.irfft(spectrum, axis=-1)[..., :n_points])


def respond(beam: Beam, forces: Floats, n_samples: int) -> Floats:
    """Return responses (n_modes, n_forces, n_samples) of the modes to forces (n_forces, n_points)."""
    # A mode is a pole s: `x' = s x + f`, exact for forces straight between their points. Its displacement is `Im x / Im
    # s`; derivatives have further factors s, and the acceleration has the force itself, too.
    pole, step = beam.poles, 1 / (FINE * beam.sampling_rate)
    z = pole * step
    grown = np.exp(z)
    first, second = phi(z)
    late, early = step * second, step * (first - second)
    powers = grown[:, None] ** np.arange(FINE - 1, -1, -1)
    points = np.zeros((len(pole), FINE + 1), complex)
    points[:, :FINE] += powers * early[:, None]
    points[:, 1:] += powers * late[:, None]
    amplitude = residues(pole, beam.derivatives)
    over_a_sample = grown**FINE
    state = np.zeros((len(pole), len(forces)), complex)
    out = np.empty((len(pole), len(forces), n_samples))
    n_driven = min(forces.shape[1] // FINE, n_samples)
    longer = np.concatenate([forces, np.zeros((len(forces), 1))], axis=1)
    for sample in range(n_driven):
        refined = longer[:, sample * FINE : (sample + 1) * FINE + 1]
        out[:, :, sample] = (amplitude[:, None] * state).real
        if beam.derivatives == 2:
            out[:, :, sample] += refined[:, 0]
        state = state * over_a_sample[:, None] + points @ refined.T
    free = (amplitude[:, None] * np.exp(np.outer(pole / beam.sampling_rate, np.arange(n_samples - n_driven))))[:, None]
    out[:, :, n_driven:] = state.real[:, :, None] * free.real - state.imag[:, :, None] * free.imag
    return out


def corrected(beam: Beam, correction: Floats) -> Beam:
    """Return a beam with corrections (3, n_modes) of ln frequency, ln damping ratio and ln participation."""
    of_poles = np.concatenate([correction[:2], np.zeros_like(correction[2:])])
    result = replace(beam, modes=beam.modes.corrected(of_poles))
    return result.with_shapes(beam.participation * np.exp(correction[2])[:, None, None])


def respond_on_average(beam: Beam, forces: Floats, n_samples: int) -> tuple[Floats, list[Floats]]:
    """Return the mean of `respond` over the errors of the modes, and terms whose squares sum to its variance."""
    # The error of a frequency turns a response by radians, so it needs Gauss-Hermite quadrature; for damping and
    # participation slopes suffice.
    errors = beam.errors
    if errors is None:
        return respond(beam, forces, n_samples), []

    def off(row: int, n_std: float) -> Floats:
        correction = np.zeros((len(CORRECTED), len(beam.poles)))
        correction[row] = n_std * errors[row]
        return respond(corrected(beam, correction), forces, n_samples)

    nodes, weights = np.polynomial.hermite_e.hermegauss(_DRAWS)
    responses = [off(0, node) for node in nodes.tolist()]
    mean = np.tensordot(weights / weights.sum(), responses, 1)
    deviations = [
        np.sqrt(weight) * (one - mean) for weight, one in zip(weights / weights.sum(), responses, strict=True)
    ]
    return mean, [*deviations, (off(1, 1.0) - off(1, -1.0)) / 2, errors[2][:, None, None] * mean]

"""Fourier coefficients of beam vibrations, the responses of a beam to principal force shapes, and noise weights.

Signals and tables are discrete Fourier transforms, in which coloured noise is a weight for each frequency.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib import user_cache
from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.measure.fit.ar_noise import ORDER
from cgid.measure.modal.beam import GRID, Beam, Singles, filtered, respond_on_average, sides_of

#: Minimum number of frequencies, and limits of the response to a force of 1 N, whose squares fit single precision.
_MIN_BINS, _LOUDNESS = 17, (1e-12, 1e11)
#: Rows, modes or locations processed at once: their responses fit in the processor's cache.
ROWS = 64
#: Frequency bands, each with its own mixtures of the modes.
_BANDS = 4
#: Ratio of the squared forces with separate tables for errors of the modes, and the minimum weight.
STRONGER, _MIN_WEIGHT = 16.0, 1e-30
#: Fraction of the energy of an impact below which errors of the modes are neglected, as after calibration with 300
#: impacts.
_NEGLIGIBLE = 1e-4


class Rowwise:
    """A dataclass of arrays whose first axis is the impact; a field may be None."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def rows(self, rows: NDArray[np.intp] | slice) -> Self:
        """Return some of the rows."""
        return self.changed(lambda array: array[rows])

    def changed(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Self:
        """Return the same with each array changed."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return type(self)(**{n: change(part) if isinstance(part, np.ndarray) else part for n, part in fields.items()})

    def replaced(self, rows: NDArray[np.intp], other: Self) -> Self:
        """Return all rows, some of them those of another."""
        fields = {}
        for name in self.__dataclass_fields__:
            fields[name] = getattr(self, name).copy()
            fields[name][rows] = getattr(other, name)
        return type(self)(**fields)

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Return the rows of all parts."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Observations(Rowwise):
    """Vibrations from which forces are estimated; the sensor axis may be omitted where the beam has one sensor."""

    frames: Floats  # (n, n_sensors, n_samples), at the beam's rate, without baseline; 0 after the frame's end
    noise: Floats  # (n, n_sensors), standard deviation; infinite for an uninformative sensor
    coefficients: Floats | None = None  # (n, n_sensors, ORDER), of the AR noise; None for white noise
    innovation: Floats | None = None  # (n, n_sensors)
    error: Floats | None = None  # (n, n_sensors, n_coefficients), power of further errors over that of the noise
    clipped: NDArray[np.bool_] | None = None  # (n, n_sensors, n_samples), lower bounds: excluded from the fit
    limit: float | None = None  # highest frequency used [Hz]

    def by_sensor(self) -> Observations:
        """Return the same with an axis of sensors."""
        return self if self.noise.ndim == 2 else self.changed(lambda array: array[:, None])

    @property
    def level(self) -> Floats:
        """Standard deviation of the noise of the quietest sensor, (n,)."""
        return np.asarray(self.noise.min(axis=1))


@dataclass(frozen=True, eq=False)
class ModeErrors:
    """Errors of the modes, as noise whose power is proportional to the square of the force."""

    turn: Singles  # (n_sensors, n_each, n_each), columns rotate coefficients so that this noise is independent
    power: Floats  # (n_coefficients,), of this noise in rotated coefficients, for a force of 1 N
    diagonal: Floats  # (n_coefficients,), of this noise in Fourier coefficients, for a force of 1 N
    energy: Floats  # (n_coefficients,), expected square of Fourier coefficients for a force of 1 N

    @classmethod
    def of(cls, covariance: Floats, energy: Floats) -> ModeErrors:
        """Return the errors of covariances (n_sensors, n_each, n_each): those of two sensors count as independent."""
        power, turn = np.linalg.eigh(covariance)
        diagonal = covariance[:, range(power.shape[1]), range(power.shape[1])]
        return cls(turn.astype(np.float32), np.maximum(power, 0.0).ravel(), diagonal.ravel(), energy)

    def turned(self, coefficients: NDArray[Any], turn: Singles | None = None) -> NDArray[Any]:
        """Return Fourier coefficients (..., n_coefficients) times the rotation, or another matrix."""
        turn = self.turn if turn is None else turn
        parts = coefficients.reshape(-1, len(turn), turn.shape[1]).swapaxes(0, 1) @ turn
        return np.ascontiguousarray(parts.swapaxes(0, 1)).reshape(coefficients.shape)

    def strength(self, samples: Singles, weight: Singles) -> Floats:
        """Return the squared force estimated from samples and weights, each (n, n_coefficients), over the noise."""
        energy = np.sum(np.square(samples, dtype=np.float64) * weight, axis=1) - (weight > 0).sum(axis=1)
        return np.asarray(np.maximum(energy, 1.0) / np.maximum(weight @ self.energy, 1e-300))

    def weight(self, weight: NDArray[Any], strength: Floats) -> Singles:
        """Return weights of turned coefficients, from those of Fourier coefficients without errors of the modes."""
        noise = self.turned(1 / np.maximum(weight, _MIN_WEIGHT).astype(np.float64), np.square(self.turn))
        total = 1 / (noise + strength[:, None] * self.power)
        return np.where(total > np.sqrt(_MIN_WEIGHT), total, 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ResponseTable:
    """Responses of a beam to force shapes, band by band, with principal mixtures in place of the modes."""

    # Modes beyond a band respond almost equally in it, so fewer mixtures give the same response.

    beam: Beam  # with the participation of the mixtures, band after band
    kept: NDArray[np.intp]  # (n_kept,), numbers of the coefficients, band after band
    #: mixtures, coefficients, and responses (n_mixtures, n_shapes, n_coefficients)
    bands: list[tuple[slice, slice, Singles]]

    @classmethod
    def of(cls, beam: Beam, participation: NDArray[Any], kept: NDArray[np.intp], *tables: Singles) -> ResponseTable:
        """Return the table of these bands; arrays as of `BeamResponses.table`."""
        bands, mixtures, first = [], 0, 0
        for table in tables:
            last = mixtures + len(table), first + table.shape[2]
            bands.append((slice(mixtures, last[0]), slice(first, last[1]), table))
            mixtures, first = last
        return cls(beam.with_shapes(participation), kept, bands)

    @property
    def n_shapes(self) -> int:
        """Number of shapes of the force."""
        return int(self.bands[0][2].shape[1])

    def leading(self, n_shapes: int) -> ResponseTable:
        """Return the same of the first shapes."""
        bands = [(mixtures, kept, np.ascontiguousarray(table[:, :n_shapes])) for mixtures, kept, table in self.bands]
        return replace(self, bands=bands)

    def lower_half(self) -> ResponseTable:
        """Return the same of the lower half of the bands."""
        bands = self.bands[: max(len(self.bands) // 2, 1)]
        beam = self.beam.with_shapes(self.beam.participation[: bands[-1][0].stop])
        return replace(self, beam=beam, kept=self.kept[: bands[-1][1].stop], bands=bands)

    def of_shapes(self, at: Singles, root: Singles | None) -> Singles:
        """Return weighted responses (n, n_shapes, n_kept) for weights `at` (n, n_mixtures) of the mixtures."""
        out = np.empty((len(at), self.n_shapes, self.kept.size), np.float32)
        for mixtures, kept, table in self.bands:
            part = (at[:, mixtures] @ table.reshape(len(table), -1)).reshape(len(at), self.n_shapes, -1)
            np.multiply(part, np.float32(1) if root is None else root[..., None, kept], out=out[:, :, kept])
        return out

    def of_forces(self, at: Singles, force: Singles, root: Singles | None) -> Singles:
        """Return the responses to forces (n, n_shapes) for several weights of mixtures each (n, n_at, n_mixtures)."""
        out = np.empty((*at.shape[:2], self.kept.size), np.float32)
        for mixtures, kept, table in self.bands:
            both = at[:, :, mixtures, None] * force[:, None, None]
            part = both.reshape(at.shape[0] * at.shape[1], -1) @ table.reshape(-1, table.shape[2])
            part = part.reshape(*at.shape[:2], -1)
            np.multiply(part, np.float32(1) if root is None else root[:, None, kept], out=out[:, :, kept])
        return out

    def by_mixture(self, samples: Singles) -> Singles:
        """Return the products of the table and samples (n, n_kept), (n, n_mixtures, n_shapes)."""
        parts = [samples[:, kept] @ table.reshape(-1, table.shape[2]).T for _, kept, table in self.bands]
        return np.concatenate(parts, axis=1).reshape(len(samples), -1, self.n_shapes)

    def powers(self, at: Singles, root: Singles) -> tuple[Floats, Singles]:
        """Return powers (n_locations, n_shapes) and directions of the force from coefficients times `root`."""
        gram = np.empty((len(at), self.n_shapes, self.n_shapes), np.float32)
        for first in range(0, len(at), ROWS):
            response = self.of_shapes(at[first : first + ROWS], root)
            gram[first : first + ROWS] = response @ response.transpose(0, 2, 1)
        power, rotation = np.linalg.eigh(gram.astype(np.float64))
        return np.maximum(power, 0.0), np.ascontiguousarray(rotation.transpose(0, 2, 1), dtype=np.float32)


class BeamResponses:
    """Fourier coefficients of one beam up to the frequency `limit` [Hz], its responses, and noise weights.

    Tables of a beam that is used often, such as that of a model file, are `lasting`: in the user's cache.
    """

    def __init__(self, beam: Beam, limit: float = np.inf, *, lasting: bool = False) -> None:
        self.beam, self.limit, self.lasting = beam, limit, lasting
        self.n_samples = beam.n_samples

    @cached_property
    def _identity(self) -> str:
        return user_cache.identity_of(self.beam.arrays)

    def kept(self, name: str, make: Callable[[], Sequence[NDArray[Any]]]) -> Sequence[NDArray[Any]]:
        """Return the tables that `make` makes, perhaps as they were made before for this beam."""
        return user_cache.kept(f"{self._identity}-{name}-{self.limit:g}", make) if self.lasting else make()

    # -- Fourier coefficients -------------------------------------------------------------------------

    @cached_property
    def forces(self) -> Floats:
        """Principal shapes after the filters, each times its deviation, (n_shapes, n_points)."""
        return filtered(self.beam, self.beam.shapes * self.beam.deviations[:, None])

    @cached_property
    def bins(self) -> slice:
        """The frequencies used: above 0, up to the 1 % point of the filters or, without any, below half the rate."""
        frequencies = np.fft.rfftfreq(self.n_samples, 1 / self.beam.sampling_rate)
        passed = (np.abs(self.beam.gain(frequencies)) > 0.01) & (frequencies <= self.limit)
        return slice(1, min(max(int(np.flatnonzero(passed)[-1]) + 1, _MIN_BINS), (self.n_samples + 1) // 2))

    @property
    def n_bins(self) -> int:
        """Number of frequencies used."""
        return int(self.bins.stop - self.bins.start)

    def transformed(self, samples: Floats) -> Singles:
        """Return orthonormal Fourier coefficients of samples (..., n_samples): real and imaginary part by frequency."""
        spectrum = np.fft.rfft(samples, axis=-1, norm="ortho")[..., self.bins] * np.sqrt(2)
        return np.ascontiguousarray(spectrum).view(np.float64).astype(np.float32)

    def cut(self, observations: Observations, first: NDArray[np.intp]) -> Singles:
        """Return coefficients over the noise from samples `first` (n,) on, those of each sensor in turn."""
        samples = cut(observations.frames, first, self.n_samples) / observations.level[:, None, None]
        return self.transformed(samples).reshape(len(samples), -1)

    # -- responses ------------------------------------------------------------------------------------

    @cached_property
    def _responses(self) -> tuple[Singles, ModeErrors | None]:
        """Return mean responses (n_modes, n_shapes, n_coefficients) for participation 1, and errors of the modes."""
        n_modes, n_each, n_sensors = len(self.beam.poles), 2 * self.n_bins, self.beam.n_sensors
        out = np.empty((n_modes, len(self.forces), n_sensors, n_each), np.float32)
        covariance, loud = np.zeros((n_sensors, n_each, n_each)), np.zeros(n_modes)
        if self.beam.errors is not None:
            loud = np.mean(np.square(self.beam.grid(GRID)[2], dtype=np.float64), axis=0)
        for first in range(0, n_modes, ROWS):
            part = slice(first, first + ROWS)
            with np.errstate(over="ignore"):
                mean, others = respond_on_average(self.beam.taken(part), self.forces, self.n_samples)
                shares = self.beam.shares.T[part, None, :, None].astype(np.float32)
                np.multiply(self.transformed(mean)[:, :, None], shares, out=out[part])
            for other in others:
                for sensor, size in enumerate(self.beam.shares[:, part] * np.sqrt(loud[part])):
                    rows = (self.transformed(other) * size[:, None, None].astype(np.float32)).reshape(-1, n_each)
                    covariance[sensor] += rows.T @ rows
        loudest = float(np.abs(self.beam.participation).max()) * max(float(out.max()), -float(out.min()))
        if not _LOUDNESS[0] < loudest < _LOUDNESS[1]:
            raise BadData(
                f"a beam must respond by {_LOUDNESS[0]:g} to {_LOUDNESS[1]:g} to a force of 1 N, got {loudest:g}; "
                "train the model again"
            )
        table = out.reshape(n_modes, len(self.forces), -1)
        if self.beam.errors is None:
            return table, None
        energy = np.tensordot(loud, np.sum(np.square(out), axis=1, dtype=np.float64), 1)
        return table, ModeErrors.of(covariance, energy.ravel())

    @cached_property
    def errors(self) -> ModeErrors | None:
        """The errors of the modes; None if negligible."""
        if self.beam.errors is None:
            return None
        errors = ModeErrors(*self.kept("errors", lambda: [*vars(self._responses[1]).values()]))
        return errors if errors.power.sum() > _NEGLIGIBLE * errors.energy.sum() else None

    def turned(self, coefficients: Singles) -> Singles:
        """Return coefficients whose noise is independent, from Fourier coefficients, each (n, n_coefficients)."""
        return coefficients if self.errors is None else self.errors.turned(coefficients)

    @cached_property
    def _turned_responses(self) -> Singles:
        table = self._responses[0]
        return self.turned(table.reshape(-1, table.shape[2])).reshape(table.shape)

    def table(self, n_shapes: int, share: float, top: float = np.inf, *, turned: bool = False) -> ResponseTable:
        """Return the responses below `top` [Hz] to the first shapes."""
        # Mixtures may differ from modes by `share` of the amplitude. Rotated coefficients (`turned`) have no frequency
        # where the modes have errors.
        name = f"responses-{n_shapes}-{share:g}-{top:g}-{turned:d}"
        return ResponseTable.of(self.beam, *self.kept(name, lambda: self._bands(n_shapes, share, top, turned)))

    def _bands(self, n_shapes: int, share: float, top: float, turned: bool) -> list[NDArray[Any]]:
        """Return participation of the mixtures, numbers of coefficients, and the responses of each band."""
        responses = self._turned_responses if turned else self._responses[0]
        n_low, n_bands = int(min(max(top * self.n_samples / self.beam.sampling_rate, 16), self.n_bins)), 1
        if turned:
            n_low, n_bands = (n_low, _BANDS) if self.errors is None else (self.n_bins, 1)
        participation, kept, bands = [], [], []
        for band in np.array_split(np.arange(2 * n_low), n_bands):
            columns = np.add.outer(np.arange(self.beam.n_sensors) * 2 * self.n_bins, band).ravel()
            part, mixed = _mixed(self.beam, responses[:, :n_shapes, columns], share)
            participation.append(part)
            kept.append(columns)
            bands.append(mixed)
        return [np.concatenate(participation).astype(np.float32), np.concatenate(kept), *bands]

    # -- weights --------------------------------------------------------------------------------------

    def counts(self, limit: float | None) -> Singles:
        """Return 1 for the coefficients of a sensor up to a frequency [Hz], else 0."""
        frequency = np.arange(self.bins.start, self.bins.stop) * self.beam.sampling_rate / self.n_samples
        return np.repeat(frequency <= (np.inf if limit is None else limit), 2).astype(np.float32)

    @cached_property
    def _lags(self) -> tuple[NDArray[np.complex128], Floats]:
        """Phases of the lags of AR noise (ORDER, n_bins), and logarithms of the frequencies about their mean."""
        frequency = np.arange(self.bins.start, self.bins.stop) / self.n_samples
        octave = np.log(frequency) - np.log(frequency).mean()
        return np.exp(-2j * np.pi * np.outer(np.arange(1, ORDER + 1), frequency)), octave

    def weights(self, observations: Observations) -> tuple[Singles, Floats]:
        """Return the weight of each coefficient over `Observations.level`, (n, n_coefficients), and noise exponents."""
        weight = np.ones((*observations.noise.shape, 2 * self.n_bins), np.float32)
        exponent = np.zeros(observations.noise.shape)
        colour = observations.coefficients
        if colour is not None and observations.innovation is not None and colour.any():
            lag, octave = self._lags
            rows = np.nonzero(colour.any(axis=2))
            power = (observations.innovation / observations.noise)[rows][:, None] ** 2
            noise_gain = 1 - colour[rows] @ lag
            power = power / (np.square(noise_gain.real) + np.square(noise_gain.imag))
            exponent[rows] = -np.log(power) @ octave / np.sum(np.square(octave))
            weight[rows] = np.repeat(1 / power, 2, axis=1)
        if observations.error is not None:
            weight /= 1 + weight * observations.error[..., : weight.shape[-1]]  # that of a wider band, too
        quiet = np.square(observations.level[:, None] / observations.noise).astype(np.float32)
        weight *= quiet[:, :, None] * self.counts(observations.limit)
        # An uninformative sensor has white noise.
        informs = np.isfinite(observations.noise)
        exponent = np.sum(exponent, axis=1, where=informs) / informs.sum(axis=1)
        return weight.reshape(len(weight), -1), exponent

    def strength(self, samples: Singles, weight: Singles) -> Floats:
        """Return the square of the force that errors of the modes follow, (n,); 1 without these."""
        return np.ones(len(samples)) if self.errors is None else self.errors.strength(samples, weight)

    def with_errors(self, weight: Singles, strength: Floats) -> Singles:
        """Return the weights of Fourier coefficients with the errors of the modes as independent noise of each."""
        if self.errors is None:
            return weight
        return np.asarray(weight / (1 + weight * (strength[:, None] * self.errors.diagonal)), np.float32)

    def turned_weight(self, weight: Singles, strength: Floats) -> Singles:
        """Return the weights of turned coefficients from those of Fourier coefficients."""
        return weight if self.errors is None else self.errors.weight(weight, strength)


def cut(frames: NDArray[Any], start: NDArray[np.intp], n_samples: int) -> Floats:
    """Return the samples of each row from its start on, zeros where the frame has ended."""
    out = np.zeros((*frames.shape[:-1], n_samples))
    for row, first in enumerate(np.clip(start, 0, frames.shape[-1]).tolist()):
        part = frames[row, ..., first : first + n_samples]
        out[row, ..., : part.shape[-1]] = part
    return out


def grid_numbers(beam: Beam, every: int = 1) -> NDArray[np.intp]:
    """Return the numbers of the locations of the grid, or of a coarser one, (n_x, n_y)."""
    sides = sides_of(beam.region, GRID)
    return np.arange(np.prod(sides)).reshape(sides)[::every, ::every]


def _mixed(beam: Beam, responses: Singles, share: float) -> tuple[Floats, Singles]:
    """Return participation and responses of principal mixtures, which differ by at most `share` of the amplitude."""
    loud = np.sqrt(np.mean(np.square(beam.participation), axis=(1, 2)))[:, None]
    table = (responses.reshape(len(responses), -1) * loud).astype(np.float32)
    power, mixes = np.linalg.eigh((table @ table.T).astype(np.float64))
    mixes = mixes[:, np.cumsum(power) > share**2 * power.sum()][:, ::-1]
    participation = np.tensordot(mixes / np.maximum(loud, 1e-300), beam.participation, (0, 0))
    mixed = np.ascontiguousarray(mixes.T.astype(np.float32) @ table)
    return participation, mixed.reshape(-1, *responses.shape[1:])

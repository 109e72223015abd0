"""Through the beam to the force: from the acceleration of a beam to the place of a blow and the force of its contact.

The way from a contact force to an accelerometer is linear once the place is known. A force is a sum of a few principal
shapes, and each shape rings every mode of the beam; the place only weighs the modes. So for a place the samples are a
linear Gaussian model in some 16 unknowns, whose evidence has a closed form. It is computed on a grid of places, from
tables that are made once. From the best one Gauss-Newton steps lead to the place itself, which stays an unknown of the
model: the uncertainty of the force includes that of the place. The samples of several sensors, each over its own noise,
are samples of one model.

Signals and tables are discrete Fourier transforms, in which coloured noise is a weight for each frequency. A `Beam` is
plain arrays, so that a model file can hold it; `cgid.scene.through_beam` makes it from a scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.measure.ar_noise import ORDER
from cgid.measure.beam import GRID, TOUCH, Beam, Singles, filtered, gain, respond_on_average, sides_of
from cgid.validation import Floats

#: Expected strengths of a blow over the noise, by what the samples of a typical place would hold.
_LEVELS = np.geomspace(2.0, 2e4, 12)
#: Longest Gauss-Newton step from the grid to the place, and the second step from which on a third follows [m].
_LONGEST_STEP, _FAR = 0.012, 0.006
#: Singular values of the clipped samples, of the largest, below which they reach beyond the band alone.
_IN_BAND = 1e-3
#: Fewest frequencies that tell, and limits of the response to a force of 1 N: squares keep to single precision.
_FEWEST_BINS, _LOUDNESS = 17, (1e-12, 1e11)
#: Prior deviation of the place about the best of the grid [m].
_PLACE_DEVIATION = 0.1
#: Rows, modes or places at a time, and places of the start: their responses fit into the cache of a processor.
_ROWS, _PLACES = 64, 16
#: The start is sought below this frequency [Hz], with so many shapes and places of a wider grid [m], at every second
#: sample; the place below this frequency, with so many shapes: in the ringing of an earlier blow fewer lose it.
_LOW, _LOW_SHAPES, _LOW_GRID, _STRIDE = 3.2e3, 6, 0.05, 2
_TOP, _GRID_SHAPES = 1e5, 14
#: Shapes in the first step from the grid, and in slopes.
_LEADING = 14
#: The place is first sought below this frequency [Hz], with so many shapes, at every second place of the grid in either
#: direction; then beside so many of the best.
_WIDE, _WIDE_SHAPES, _BEST = 5e3, 12, (32, 6)
#: Share of the amplitude by which mixtures of modes may differ from the modes, on the way to the force and to a place.
_SAME, _NEARLY = 3e-4, 3e-3
#: Powers of the noise of sensors over that of the quietest for which there is a grid of its own: 1, one ratio, two.
_RATIO, _FAINTEST = 8.0, 2
#: Coefficients with less than this share of the usual weight are drowned.
_DROWNED = 0.02
#: Ratio of the squares of forces for which errors of the modes have a grid of their own, and the least weight.
_STRONGER, _LEAST_WEIGHT = 16.0, 1e-30
#: Share of the energy of a blow below which errors of the modes do not count, as after calibration with 300 blows.
_NEGLIGIBLE = 1e-4
#: Exponents of coloured noise, f^-a, for which there is a grid of its own.
_COLOURS = (0.0, 0.5, 1.0, 1.5, 2.0)


class Ringing:
    """What the modes of a beam still ring from earlier blows: a Gaussian process, seen before touch.

    The amplitudes are those that a blow anywhere leaves after one of `AGES`; their common strength is the one of the
    highest evidence.

    Parameters
    ----------
    inversion : Inversion
    n_quiet : int
        Samples before touch that are looked at.
    sensor : int
        Which of the beam's sensors.
    """

    #: Ages of the earlier blow [s], powers of the ringing over that of the noise, and gain of evidence that it takes.
    AGES, POWERS, CERTAIN = (0.005, 0.02, 0.08), np.geomspace(0.3, 3e6, 15), 12.0
    #: The tables go on for so many samples longer than the inversion, because the touch is not known yet.
    LATER = 64

    def __init__(self, inversion: Inversion, n_quiet: int, sensor: int = 0) -> None:
        beam, self.n_quiet, self.n_samples = inversion.beam, n_quiet, inversion.n_samples + self.LATER
        time = np.arange(n_quiet + self.n_samples) / beam.sampling_rate
        frequency = np.abs(beam.poles) / (2 * np.pi)
        loud = np.sqrt(np.mean(np.square(beam.participation), axis=(1, 2))) * np.abs(gain(beam.filters, frequency))
        loud *= np.abs(beam.poles) ** (beam.derivatives - 1) * np.abs(beam.shares[sensor])
        self._tables = []
        for age in self.AGES:
            size = loud * np.exp(beam.poles.real * age)
            kept = size > 1e-4 * size.max()
            waves = size[kept] * np.exp(np.outer(time, beam.poles[kept]))
            both = np.concatenate([waves.real, waves.imag], axis=1)
            both /= np.sqrt(np.mean(np.sum(np.square(both[:n_quiet]), axis=1)))
            before, after = both[:n_quiet], both[n_quiet:]
            power, turn = np.linalg.eigh(before @ before.T)
            onward = after @ (before.T @ turn)
            spectra = [np.square(inversion.transformed(part.T[:, : inversion.n_samples])) for part in (after, onward)]
            self._tables.append((np.maximum(power, 0.0), turn, onward, spectra[0].sum(axis=0), spectra[1]))

    def after(self, before: Floats, innovation: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Return what rings on, from samples before touch.

        Parameters
        ----------
        before : ndarray, (n, n_quiet)
        innovation : ndarray, (n,)
            Standard deviation of what noise of any colour leaves unpredicted: the rival of the ringing.

        Returns
        -------
        tuple of ndarray
            The ringing after these samples (n, n_samples), the standard deviation of the noise (n,), the power of the
            error of the ringing over that of the noise at each coefficient (n, n_coefficients), and whether there is
            ringing (n,).
        """
        n = len(before)
        best = -self.n_quiet * np.log(np.maximum(innovation, 1e-150)) + self.CERTAIN
        found, level, rings = np.zeros((n, self.n_samples)), innovation.copy(), np.zeros(n, bool)
        error = np.zeros((n, self._tables[0][3].size))
        for power, turn, onward, whole, spectrum in self._tables:
            told = before @ turn
            for ratio in self.POWERS:
                variance = 1 + ratio * power
                # The most likely noise for this ratio has a closed form.
                left = np.mean(np.square(told) / variance, axis=1)
                evidence = -0.5 * self.n_quiet * np.log(np.maximum(left, 1e-300)) - 0.5 * np.log(variance).sum()
                better = np.flatnonzero(evidence > best)
                if better.size:
                    best[better], rings[better], level[better] = evidence[better], True, np.sqrt(left[better])
                    found[better] = (told[better] * (ratio / variance)) @ onward.T
                    error[better] = ratio * np.maximum(whole - (ratio / variance) @ spectrum, 0.0)
        return found, level, error, rings


class Rowwise:
    """A dataclass of arrays whose first axis is the blow; a field may be None."""

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
        found = {}
        for name in self.__dataclass_fields__:
            found[name] = getattr(self, name).copy()
            found[name][rows] = getattr(other, name)
        return type(self)(**found)

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Return the rows of all parts."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Sought(Rowwise):
    """Vibrations whose force is sought.

    The axis of sensors may be left out where the beam has one.

    Attributes
    ----------
    frames : ndarray, (n, n_sensors, n_samples)
        At the sampling rate of the beam, without baseline; zeros where the frame has ended.
    noise : ndarray, (n, n_sensors)
        Standard deviation of the noise; infinite for a sensor that tells nothing.
    coefficients, innovation : ndarray, (n, n_sensors, ORDER) and (n, n_sensors), optional
        Of the colour of the noise, as in `cgid.measure.ar_noise.ARNoise`; white by default.
    error : ndarray, (n, n_sensors, n_coefficients), optional
        Power of further errors over that of the noise.
    clipped : ndarray of bool, (n, n_sensors, n_samples), optional
        Samples that only bound the motion, which went at least as far: the force is found from the others.
    limit : float, optional
        Frequency up to which the samples tell [Hz].
    """

    frames: Floats
    noise: Floats
    coefficients: Floats | None = None
    innovation: Floats | None = None
    error: Floats | None = None
    clipped: NDArray[np.bool_] | None = None
    limit: float | None = None

    def by_sensor(self) -> Sought:
        """Return the same with an axis of sensors."""
        return self if self.noise.ndim == 2 else self.changed(lambda array: array[:, None])

    @property
    def level(self) -> Floats:
        """Standard deviation of the noise of the quietest sensor, (n,)."""
        return np.asarray(self.noise.min(axis=1))


@dataclass(frozen=True, eq=False)
class Inverted(Rowwise):
    """What samples tell of some blows, each row one blow.

    Attributes
    ----------
    x, y : ndarray, (n,) [m]
        The most probable place.
    place_deviation : ndarray, (n, 2) [m]
    start : ndarray, (n,)
        Sample of the frame at which the table of forces begins: touch lies within `TOUCH` samples of it.
    coefficients : ndarray, (n, n_shapes)
        Of the force in principal shapes, each over its deviation and over the noise, with the prior of the shapes.
    information, vector : ndarray, (n, n_shapes, n_shapes) and (n, n_shapes)
        The likelihood of coefficients c after the place is projected out: `-c information c / 2 + vector c`.
    noise : ndarray, (n,)
        Standard deviation of the noise of the quietest sensor [unit of the samples].
    evidence : ndarray, (n,)
        Logarithm of the evidence over that of noise alone, per sample.
    misfit : ndarray, (n,)
        Mean square of what is left, over the noise: 1 where the beam explains the samples.
    unexplained : ndarray, (n,)
        Share of the samples' energy that is left beyond the noise, at least 0.
    """

    x: Floats
    y: Floats
    place_deviation: Floats
    start: NDArray[np.intp]
    coefficients: Floats
    information: Floats
    vector: Floats
    noise: Floats
    evidence: Floats
    misfit: Floats
    unexplained: Floats


@dataclass(frozen=True, eq=False)
class _Few:
    """A part of the tables of a beam that finds where to begin.

    Attributes
    ----------
    kept : ndarray of int, (n_kept,)
        Numbers of the coefficients.
    table : ndarray, (n_modes, n_shapes, n_kept)
        Of the modes and shapes that are kept.
    x, y : ndarray, (n_places,) [m]
    at : ndarray, (n_places, n_modes)
    """

    kept: NDArray[np.intp]
    table: Singles
    x: Floats
    y: Floats
    at: Singles

    def powers(self, root: Singles, places: NDArray[np.intp] | None = None) -> tuple[Floats, Singles]:
        """Return what coefficients times `root` tell of a force at places: powers and the directions they are of.

        Shapes (n_places, n_shapes) and (n_places, n_shapes, n_shapes).
        """
        n_shapes, at = self.table.shape[1], self.at if places is None else self.at[places]
        table = self.table.reshape(len(self.table), -1)
        gram = np.empty((len(at), n_shapes, n_shapes), np.float32)
        for first in range(0, len(at), _ROWS):
            part = slice(first, first + _ROWS)
            response = (at[part] @ table).reshape(-1, n_shapes, self.kept.size) * root
            gram[part] = response @ response.transpose(0, 2, 1)
        power, rotation = np.linalg.eigh(gram.astype(np.float64))
        return np.maximum(power, 0.0), np.ascontiguousarray(rotation.transpose(0, 2, 1), dtype=np.float32)

    def heard(self, samples: Singles) -> Singles:
        """Return the products of responses and samples (n, n_kept), (n_places, n_shapes, n)."""
        n_modes, n_shapes, n_kept = self.table.shape
        by_mode = self.table.reshape(-1, n_kept) @ samples.T
        return (self.at @ by_mode.reshape(n_modes, -1)).reshape(len(self.at), n_shapes, -1)

    def by_mode(self, samples: Singles) -> Singles:
        """Return the products of the table and samples (n, n_kept), (n, n_modes, n_shapes)."""
        n_modes, n_shapes, n_kept = self.table.shape
        return (samples @ self.table.reshape(-1, n_kept).T).reshape(-1, n_modes, n_shapes)


class _Law:
    """What the samples tell of the coefficients at the places of a grid, in noise of one law.

    Parameters
    ----------
    few : _Few
    weight : ndarray, (n_kept,)
        Of each coefficient.
    levels : ndarray, optional
        Of the force; by default they follow from all places. With them, a place is computed when it is first needed.
    """

    def __init__(self, few: _Few, weight: Singles, levels: Floats | None = None) -> None:
        self.few, self.weight = few, weight
        n_places, n_shapes = len(few.at), few.table.shape[1]
        if levels is None:
            power, self._rotation = few.powers(np.sqrt(weight))
            self.levels = _LEVELS / np.sqrt(np.median(power.sum(axis=1)))
            self._share, self._cost = _shares(power, self.levels)
            return
        self.levels, self._known = levels, np.zeros(n_places, bool)
        self._rotation = np.empty((n_places, n_shapes, n_shapes), np.float32)
        self._share = np.empty((n_places, levels.size, n_shapes), np.float32)
        self._cost = np.empty((n_places, levels.size, 1), np.float32)

    def evidence(self, heard: Singles) -> Singles:
        """Return the evidence of what is heard at all places, (n_places, n_levels, n), from `_Few.heard`."""
        return np.asarray(self._share @ np.square(self._rotation @ heard) - self._cost)

    def evidence_at(self, places: NDArray[np.intp], by_mode: Singles) -> Singles:
        """Return the same at places (n, n_places) of their own, (n, n_places, n_levels), from `_Few.by_mode`."""
        new = np.unique(places[~self._known[places]])
        if new.size:
            power, self._rotation[new] = self.few.powers(np.sqrt(self.weight), new)
            self._share[new], self._cost[new] = _shares(power, self.levels)
            self._known[new] = True
        told = np.square(self._rotation[places] @ (self.few.at[places] @ by_mode)[:, :, :, None])
        return (self._share[places] @ told - self._cost[places])[:, :, :, 0]


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors of the modes as noise whose power is proportional to the square of the force.

    Attributes
    ----------
    turn : ndarray, (n_sensors, n_each, n_each)
        Columns turn the coefficients of a sensor to others, in which this noise is independent.
    power, untold : ndarray, (n_coefficients,)
        Of this noise for a force of 1 N, in those and in Fourier coefficients.
    energy : ndarray, (n_coefficients,)
        Expected square of Fourier coefficients for a force of 1 N.
    """

    turn: Singles
    power: Floats
    untold: Floats
    energy: Floats

    @classmethod
    def of(cls, covariance: Floats, energy: Floats) -> _Errors:
        """Return the errors of covariances (n_sensors, n_each, n_each): those of two sensors count as independent."""
        power, turn = np.linalg.eigh(covariance)
        diagonal = covariance[:, range(power.shape[1]), range(power.shape[1])]
        return cls(turn.astype(np.float32), np.maximum(power, 0.0).ravel(), diagonal.ravel(), energy)

    def turned(self, coefficients: NDArray[Any], turn: Singles | None = None) -> NDArray[Any]:
        """Return Fourier coefficients (..., n_coefficients) turned, or what another matrix makes of them."""
        turn = self.turn if turn is None else turn
        parts = coefficients.reshape(-1, len(turn), turn.shape[1]).swapaxes(0, 1) @ turn
        return np.ascontiguousarray(parts.swapaxes(0, 1)).reshape(coefficients.shape)

    def strength(self, samples: Singles, weight: Singles) -> Floats:
        """Return the square of the force that samples of weights suggest, each (n, n_coefficients), over the noise."""
        left = np.sum(np.square(samples, dtype=np.float64) * weight, axis=1) - (weight > 0).sum(axis=1)
        return np.asarray(np.maximum(left, 1.0) / np.maximum(weight @ self.energy, 1e-300))

    def weight(self, weight: NDArray[Any], strength: Floats) -> Singles:
        """Return weights of turned coefficients, from those of Fourier coefficients without errors of the modes."""
        noise = self.turned(1 / np.maximum(weight, _LEAST_WEIGHT).astype(np.float64), np.square(self.turn))
        found = 1 / (noise + strength[:, None] * self.power)
        return np.where(found > np.sqrt(_LEAST_WEIGHT), found, 0).astype(np.float32)


class Inversion:
    """The tables of one beam, and the inversion of accelerations through them.

    Parameters
    ----------
    beam : Beam
    limit : float, optional
        Frequency up to which the samples tell [Hz].
    """

    def __init__(self, beam: Beam, limit: float = np.inf) -> None:
        self.beam, self.limit = beam, limit
        self.n_samples = beam.n_samples

    # -- tables ---------------------------------------------------------------------------------------

    @cached_property
    def forces(self) -> Floats:
        """Principal shapes behind the filters, each times its deviation, (n_shapes, n_points)."""
        return filtered(self.beam, self.beam.shapes * self.beam.deviations[:, None])

    @cached_property
    def bins(self) -> slice:
        """Frequencies that tell: above 0, up to where the filters leave 1 % or, without them, below half the rate."""
        frequencies = np.fft.rfftfreq(self.n_samples, 1 / self.beam.sampling_rate)
        heard = (np.abs(gain(self.beam.filters, frequencies)) > 0.01) & (frequencies <= self.limit)
        return slice(1, min(max(int(np.flatnonzero(heard)[-1]) + 1, _FEWEST_BINS), (self.n_samples + 1) // 2))

    def transformed(self, samples: Floats) -> Singles:
        """Return orthonormal Fourier coefficients of samples (..., n_samples), real then imaginary parts."""
        found = np.fft.rfft(samples, axis=-1, norm="ortho")[..., self.bins] * np.sqrt(2)
        return np.concatenate([found.real, found.imag], axis=-1).astype(np.float32)

    def _stacked(self, samples: Floats, level: Floats) -> Singles:
        """Return `transformed` of samples (n, n_sensors, n_samples) over a level (n,), those of each sensor in turn."""
        return self.transformed(samples / level[:, None, None]).reshape(len(samples), -1)

    def _each(self, of_one: NDArray[Any]) -> NDArray[Any]:
        """Return the same coefficients for every sensor."""
        return np.tile(of_one, self.beam.n_sensors)

    @cached_property
    def _responses(self) -> tuple[Singles, _Errors | None]:
        """Transformed mean responses of each mode to each shape for participation 1, and the errors of the modes.

        Shape (n_modes, n_shapes * n_coefficients), the coefficients of each sensor in turn.

        Raises `BadData` if they leave the range of single precision, which no true beam does.
        """
        n_modes, n_each = len(self.beam.poles), 2 * (self.bins.stop - self.bins.start)
        out = np.empty((n_modes, len(self.forces), self.beam.n_sensors, n_each), np.float32)
        covariance, loud = np.zeros((self.beam.n_sensors, n_each, n_each)), np.zeros(n_modes)
        if self.beam.errors is not None:
            loud = np.mean(np.square(self.beam.grid(GRID)[2], dtype=np.float64), axis=0)
        for first in range(0, n_modes, _ROWS):
            part = slice(first, first + _ROWS)
            with np.errstate(over="ignore"):
                mean, others = respond_on_average(self.beam.taken(part), self.forces, self.n_samples)
                shares = self.beam.shares.T[part, None, :, None].astype(np.float32)
                np.multiply(self.transformed(mean)[:, :, None], shares, out=out[part])
            for other in others:
                for sensor, heard in enumerate(self.beam.shares[:, part] * np.sqrt(loud[part])):
                    rows = (self.transformed(other) * heard[:, None, None].astype(np.float32)).reshape(-1, n_each)
                    covariance[sensor] += rows.T @ rows
        loudest = float(np.abs(self.beam.participation).max()) * max(float(out.max()), -float(out.min()))
        if not _LOUDNESS[0] < loudest < _LOUDNESS[1]:
            raise BadData(
                f"a beam must ring between {_LOUDNESS[0]:g} and {_LOUDNESS[1]:g} for a force of 1 N, got {loudest:g}; "
                "train the model again"
            )
        if self.beam.errors is None:
            return out.reshape(n_modes, -1), None
        energy = np.tensordot(loud, np.sum(np.square(out), axis=1, dtype=np.float64), 1)
        return out.reshape(n_modes, -1), _Errors.of(covariance, energy.ravel())

    @cached_property
    def _errors(self) -> _Errors | None:
        """The errors of the modes; None if these are known well enough."""
        found = None if self.beam.errors is None else self._responses[1]
        return found if found is not None and found.power.sum() > _NEGLIGIBLE * found.energy.sum() else None

    def _turned(self, coefficients: Singles) -> Singles:
        """Return coefficients whose noise is independent, from Fourier coefficients, each (n, n_coefficients)."""
        return coefficients if self._errors is None else self._errors.turned(coefficients)

    def _untold(self, weight: Singles, strength: Floats) -> Singles:
        """Return the weights of Fourier coefficients with the errors of the modes as noise of each by itself."""
        if self._errors is None:
            return weight
        return np.asarray(weight / (1 + weight * (strength[:, None] * self._errors.untold)), np.float32)

    def _weighed(self, weight: Singles, strength: Floats) -> Singles:
        """Return the weights of turned coefficients from those of Fourier coefficients."""
        return weight if self._errors is None else self._errors.weight(weight, strength)

    @cached_property
    def _table(self) -> Singles:
        """Turned mean responses, shape as in `_responses`."""
        found = self._responses[0]
        return self._turned(found.reshape(found.shape[0] * len(self.beam.deviations), -1)).reshape(found.shape)

    @cached_property
    def _laws(self) -> dict[tuple[Any, ...], tuple[_Law, _Law]]:
        return {}

    @cached_property
    def _all(self) -> tuple[Beam, Singles]:
        """The beam and its table of all frequencies and shapes in as few weights as tell the same."""
        return _compressed(self.beam, self._table, _SAME)

    @cached_property
    def _leading(self) -> Singles:
        """The same of the first shapes, which lead to the place, (n_weights, n_shapes, n_coefficients)."""
        _, table = self._all
        return np.ascontiguousarray(table.reshape(len(table), len(self.beam.deviations), -1)[:, :_LEADING])

    def _few(self, responses: Singles, top: float, most: int, apart: float, every: int = 1) -> _Few:
        """Return the part of a table below a frequency [Hz], of the first shapes and every so many places of a grid."""
        n_bins = self.bins.stop - self.bins.start
        n_low = min(max(int(top * self.n_samples / self.beam.sampling_rate), 16), n_bins)
        kept = np.add.outer(np.arange(2 * self.beam.n_sensors) * n_bins, np.arange(n_low)).ravel()
        n_shapes = min(most, len(self.beam.deviations))
        table = responses.reshape(len(responses), len(self.beam.deviations), -1)[:, :n_shapes][:, :, kept]
        beam, table = _compressed(self.beam, table.reshape(len(table), -1), _NEARLY)
        number = np.arange(np.prod(sides_of(beam.region, apart))).reshape(sides_of(beam.region, apart))
        (x, y, at), own = beam.grid(apart), number[::every, ::every].ravel()
        return _Few(kept, table.reshape(len(table), n_shapes, -1), x[own], y[own], at[own])

    @cached_property
    def _grid(self) -> _Few:
        """The tables of the grid on which the place is sought."""
        # What is turned has no frequency.
        top = _TOP if self._errors is None else self.beam.sampling_rate
        return self._few(self._table, top, _GRID_SHAPES, GRID)

    @cached_property
    def _wide(self) -> _Few:
        """The tables of every second place of the grid in either direction, where the place is sought first."""
        return self._few(self._responses[0], _WIDE, _WIDE_SHAPES, GRID, 2)

    @cached_property
    def _beside(self) -> NDArray[np.intp]:
        """Numbers of the places of `_grid` at each of `_wide`, and beside it, (n_places, 9)."""
        number = np.arange(len(self._grid.x)).reshape(sides_of(self.beam.region, GRID))
        around = np.pad(number, 1, mode="edge")
        near = [(1, 1), *((i, k) for i in range(3) for k in range(3) if (i, k) != (1, 1))]
        columns = [around[i : i + len(number) : 2, k : k + number.shape[1] : 2].ravel() for i, k in near]
        return np.stack(columns, axis=1)

    def _coarse(
        self, exponent: float, limit: float | None = None, strong: int = 0, fainter: tuple[int, ...] = ()
    ) -> tuple[_Law, _Law]:
        """Return what `_wide` and `_grid` tell in noise of power f^-exponent.

        The power of the noise of each sensor is that of the quietest times `_RATIO` to the power of `fainter`, and the
        square of the force that errors of the modes follow is `_STRONGER` to that of `strong`.
        """
        key = exponent, limit, strong, fainter
        if key not in self._laws:
            weight = self._each(self._law(exponent) * self._heard(limit))
            for sensor, part in enumerate(np.split(weight, self.beam.n_sensors) if any(fainter) else ()):
                part *= _RATIO ** -fainter[sensor]
            strength = np.array([_STRONGER**strong])
            wide = _Law(self._wide, self._untold(weight[None], strength)[0, self._wide.kept])
            own = self._weighed(weight[None], strength)[0, self._grid.kept]
            self._laws[key] = wide, _Law(self._grid, own, wide.levels)
        return self._laws[key]

    def _heard(self, limit: float | None) -> Singles:
        frequency = np.arange(self.bins.start, self.bins.stop) * self.beam.sampling_rate / self.n_samples
        return np.tile(frequency <= (np.inf if limit is None else limit), 2).astype(np.float32)

    def _law(self, exponent: float) -> Singles:
        frequency = np.arange(self.bins.start, self.bins.stop, dtype=np.float64)
        weight = frequency**exponent
        return np.tile(weight / weight.mean(), 2).astype(np.float32)

    # -- the inversion --------------------------------------------------------------------------------

    def invert(self, sought: Sought, start: NDArray[np.intp]) -> Inverted:
        """Return places and forces of blows.

        Parameters
        ----------
        sought : Sought
        start : ndarray of int, (n, 2)
            First and last sample of the frame in which touch may lie.

        Returns
        -------
        Inverted
        """
        if sought.limit is not None and self.beam.errors is not None:  # errors are turned in the band that tells
            return self._up_to(sought.limit).invert(replace(sought, limit=None), start)
        sought = sought.by_sensor()
        n_rows = max(_ROWS // self.beam.n_sensors, 1)
        parts = [slice(first, first + n_rows) for first in range(0, max(len(start), 1), n_rows)]
        return Inverted.joined([self._inverted(sought.rows(part), start[part]) for part in parts])

    def likeliest(self, sought: Sought, touch: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return which sample of the frame, of several each (n, n_samples), is most probably the one of touch, (n,)."""
        if sought.limit is not None and self.beam.errors is not None:
            return self._up_to(sought.limit).likeliest(replace(sought, limit=None), touch)
        sought = sought.by_sensor()
        n_rows = max(_ROWS // (self.beam.n_sensors * touch.shape[1]), 1)
        best = [
            self._evidence(sought.rows(slice(first, first + n_rows)), touch[first : first + n_rows]).argmax(axis=1)
            for first in range(0, len(touch), n_rows)
        ]
        return np.take_along_axis(touch, np.concatenate(best)[:, None], axis=1)[:, 0]

    def _evidence(self, sought: Sought, touch: NDArray[np.intp]) -> Floats:
        """Return the evidence of the best place of the grid for each sample of touch, (n, n_samples)."""
        weight, exponent = self._weights(sought)
        frames, level = sought.frames, sought.level
        samples = [self._stacked(_cut(frames, own - TOUCH // 2, self.n_samples), level) for own in touch.T]
        strength = np.ones((len(samples), len(touch)))
        if self._errors is not None:
            strength = np.stack([self._errors.strength(own, weight) for own in samples])
        n = len(samples)
        weight, exponent = np.tile(weight, (n, 1)), np.tile(exponent, n)
        found = self._search(np.concatenate(samples), weight, exponent, sought.limit, strength.ravel())[0]
        return found.reshape(n, -1).T

    @cached_property
    def _narrower(self) -> dict[float, Inversion]:
        return {}

    def _up_to(self, limit: float) -> Inversion:
        """Return the inversion of a narrower band; its tables are made once."""
        return self._narrower.setdefault(limit, Inversion(self.beam, limit))

    def _inverted(self, sought: Sought, start: NDArray[np.intp]) -> Inverted:
        weight, exponent = self._weights(sought)
        strength = np.ones(len(start))
        if self._errors is not None:
            early = _cut(sought.frames, start[:, 0] - TOUCH // 2, self.n_samples)
            strength = self._errors.strength(self._stacked(early, sought.level), weight)
        begun = self._start(sought, start, weight, strength)
        samples = self._stacked(_cut(sought.frames, begun, self.n_samples), sought.level)
        _, place, level = self._search(samples, weight, exponent, sought.limit, strength)
        samples = self._turned(samples)
        weight, told = self._weighed(weight, strength), weight
        found = self._refined(samples, weight, self._grid.x[place], self._grid.y[place], level)
        if self._errors is not None:
            peak = (found["coefficients"] @ (self.beam.shapes * self.beam.deviations[:, None])).max(axis=1)
            weight = self._errors.weight(told, np.square(peak))
            found = self._refined(samples, weight, found["x"], found["y"], level)
        if sought.clipped is not None and sought.clipped.any():
            rows = np.flatnonzero(sought.clipped.any(axis=(1, 2)))
            unknown = _cut(sought.clipped[rows], begun[rows], self.n_samples) > 0
            own = self._refined(
                samples[rows],
                weight[rows],
                found["x"][rows],
                found["y"][rows],
                level[rows],
                self._directions(unknown, weight[rows]),
            )
            for name, array in found.items():
                array[rows] = own[name]
        return Inverted(start=begun, noise=sought.level, **found)

    def _weights(self, sought: Sought) -> tuple[Singles, Floats]:
        """Return the weight of each coefficient over `Sought.level`, (n, n_coefficients), and noise exponents, (n,)."""
        (n, n_sensors), n_bins = sought.noise.shape, self.bins.stop - self.bins.start
        weight, exponent = np.ones((n, n_sensors, 2 * n_bins)), np.zeros((n, n_sensors))
        if sought.coefficients is not None and sought.innovation is not None and sought.coefficients.any():
            frequency = np.arange(self.bins.start, self.bins.stop) / self.n_samples
            lag = np.exp(-2j * np.pi * np.outer(np.arange(1, ORDER + 1), frequency))
            rows = np.nonzero(sought.coefficients.any(axis=2))
            power = (sought.innovation / sought.noise)[rows][:, None] ** 2
            power = power / np.abs(1 - sought.coefficients[rows] @ lag) ** 2
            exponent[rows] = -np.polynomial.polynomial.polyfit(np.log(frequency), np.log(power).T, 1)[1]
            weight[rows] = np.tile(1 / power, 2)
        if sought.error is not None:
            weight /= 1 + weight * sought.error
        weight *= np.square(sought.level[:, None] / sought.noise)[:, :, None] * self._heard(sought.limit)
        # A sensor that tells nothing has no colour either.
        told = np.isfinite(sought.noise)
        exponent = np.sum(exponent, axis=1, where=told) / told.sum(axis=1)
        return weight.reshape(n, -1).astype(np.float32), exponent

    def _directions(self, unknown: NDArray[np.bool_], weight: Singles) -> Singles:
        """Return orthonormal directions of the weighted coefficients that unknown samples move, for each row.

        Rows of zeros fill the shape (n, n_directions, n_coefficients).
        """
        n, n_sensors, _ = unknown.shape
        found = []
        for row in range(n):
            sensor, sample = np.nonzero(unknown[row])
            moves = np.zeros((sample.size, n_sensors, weight.shape[1] // n_sensors))
            moves[np.arange(sample.size), sensor] = self._moves[sample]
            moves = self._turned(moves.reshape(sample.size, weight.shape[1])) * np.sqrt(weight[row])
            _, size, own = np.linalg.svd(moves, full_matrices=False)
            found.append(own[size > _IN_BAND * size.max(initial=0.0)])
        out = np.zeros((n, max(len(own) for own in found), weight.shape[1]), np.float32)
        for row, own in enumerate(found):
            out[row, : len(own)] = own
        return out

    @cached_property
    def _moves(self) -> Singles:
        """What each sample adds to the coefficients, (n_samples, n_coefficients)."""
        return self.transformed(np.eye(self.n_samples))

    @cached_property
    def _low(self) -> _Few:
        """The tables that find the start."""
        return self._few(self._responses[0], _LOW, _LOW_SHAPES, _LOW_GRID)

    @cached_property
    def _low_tables(self) -> dict[tuple[int, ...], tuple[Singles, Singles, Singles, Floats]]:
        return {}

    def _low_of(self, fainter: tuple[int, ...]) -> tuple[Singles, Singles, Singles, Floats]:
        """Return rotation, shares and costs of every second level, and the weights, where sensors are fainter."""
        if fainter not in self._low_tables:
            n_each = self._low.kept.size // self.beam.n_sensors
            weight = np.repeat(_RATIO ** -np.array(fainter, np.float64), n_each)
            power, rotation = self._low.powers(np.sqrt(weight).astype(np.float32))
            share, cost = _shares(power, (_LEVELS / np.sqrt(np.median(power.sum(axis=1))))[::2])
            self._low_tables[fainter] = rotation, share, cost, weight
        return self._low_tables[fainter]

    def _start(self, sought: Sought, start: NDArray[np.intp], weight: Singles, strength: Floats) -> NDArray[np.intp]:
        """Return the sample at which the table of forces begins, (n,): touch lies within `TOUCH` samples of it."""
        first = np.asarray(start[:, 0] - TOUCH // 2)
        steps = np.arange(0, int((start[:, 1] - start[:, 0]).max(initial=0)) + 1, _STRIDE)
        if steps.size == 1:
            return first
        kinds, kind = np.unique(self._fainter(weight), axis=0, return_inverse=True)
        weight = self._untold(weight, strength)
        for number, of_sensors in enumerate(kinds.tolist()):
            rows = np.flatnonzero(kind.ravel() == number)
            own = weight[rows][:, self._low.kept]
            first[rows] += self._later(sought.rows(rows), start[rows], own, steps, tuple(of_sensors))
        return first

    def _later(
        self,
        sought: Sought,
        start: NDArray[np.intp],
        weight: Singles,
        steps: NDArray[np.intp],
        of_sensors: tuple[int, ...],
    ) -> NDArray[np.intp]:
        """Return by how many samples to begin later, (n,), of blows whose sensors are alike in their noise."""
        few, (turned, share, cost, law) = self._low, self._low_of(of_sensors)
        if self.beam.n_sensors > 1:
            quiet = law == 1.0
            scale = np.exp(np.mean(np.log(np.maximum(weight[:, quiet], 1e-30)), axis=1, keepdims=True))
            own = self._lawful(weight, law * scale, np.equal(of_sensors, _FAINTEST))
            weight = (own / np.sqrt(scale)).astype(np.float32)
        first = start[:, 0] - TOUCH // 2
        samples = self._stacked(_cut(sought.frames, first, self.n_samples), sought.level)[:, few.kept]
        spectrum = _complex(samples, self.beam.n_sensors)
        turn = np.exp(2j * np.pi * np.outer(steps, np.arange(1, spectrum.shape[2] + 1)) / self.n_samples)
        later = spectrum[:, None] * turn[:, None]
        trusted = np.repeat(weight, steps.size, axis=0)
        shifted = np.stack([later.real, later.imag], axis=3).astype(np.float32).reshape(trusted.shape) * trusted
        told = np.square(turned @ few.heard(shifted))
        best: NDArray[np.floating] = np.full(len(shifted), -np.inf, np.float32)
        for first_place in range(0, len(few.at), _PLACES):
            part = slice(first_place, first_place + _PLACES)
            best = np.maximum(best, (share[part] @ told[part] - cost[part]).max(axis=(0, 1)))
        evidence = best.reshape(len(start), steps.size).astype(np.float64)
        evidence[steps > (start[:, 1] - start[:, 0])[:, None]] = -np.inf
        trust = np.exp(evidence - evidence.max(axis=1, keepdims=True))
        # A force begins so softly that a late start explains the samples as well: rather begin early.
        early = TOUCH // 2
        return np.asarray(np.round(trust @ steps / trust.sum(axis=1)).astype(np.intp) - early)

    def _search(
        self, samples: Singles, weight: Singles, exponent: Floats, limit: float | None, strength: Floats
    ) -> tuple[Floats, NDArray[np.intp], Floats]:
        """Return the evidence of the best place of the grid, its number, and the best level of the force, each (n,)."""
        n, fainter = len(samples), self._fainter(weight)
        strong = np.round(np.log(strength) / np.log(_STRONGER)).astype(np.intp)
        nearest = np.argmin(np.abs(np.subtract.outer(exponent, _COLOURS)), axis=1)
        kinds, kind = np.unique(np.column_stack([nearest, strong, fainter]), axis=0, return_inverse=True)
        parts = [np.flatnonzero(kind.ravel() == number) for number in range(len(kinds))]
        laws = [self._coarse(_COLOURS[c], limit, force, tuple(each)) for c, force, *each in kinds.tolist()]
        heard = []
        for which, (few, given, own) in enumerate(
            (
                (self._wide, samples, self._untold(weight, strength)),
                (self._grid, self._turned(samples), self._weighed(weight, strength)),
            )
        ):
            given, own = given[:, few.kept], own[:, few.kept]
            for (_, _, *of_sensors), rows, law in zip(kinds.tolist(), parts, laws, strict=True):
                given[rows] = self._scaled(given[rows], own[rows], law[which].weight, of_sensors)
            heard.append(given)
        at_all, by_mode = self._wide.heard(heard[0]), self._grid.by_mode(heard[1])
        out = np.full(n, -np.inf), np.zeros(n, np.intp), np.ones(n)
        for rows, (wide, fine) in zip(parts, laws, strict=True):
            # The best of the wide grid by themselves, and what is beside the best of these.
            places = _highest(wide.evidence(at_all[:, :, rows]).max(axis=1).T, _BEST[0])
            evidence = fine.evidence_at(self._beside[places, 0], by_mode[rows]).max(axis=2)
            places = np.take_along_axis(places, _highest(evidence, _BEST[1]), axis=1)
            places = self._beside[places].reshape(rows.size, -1)
            evidence = fine.evidence_at(places, by_mode[rows])
            place, level = np.unravel_index(evidence.reshape(rows.size, -1).argmax(axis=1), evidence.shape[1:])
            each = np.arange(rows.size)
            out[0][rows], out[1][rows] = evidence[each, place, level], places[each, place]
            out[2][rows] = fine.levels[level]
        return out

    def _scaled(self, samples: Singles, weight: Singles, law: Singles, of_sensors: list[int]) -> Singles:
        """Return weighted samples (n, n_kept) over the root of the level of their noise."""
        # The law has a mean weight of 1; the level of the noise is that of its middle, at the quietest sensors.
        heard_at = (law > 0) & np.repeat(np.equal(of_sensors, 0), law.size // len(of_sensors))
        scale = np.exp(np.mean(np.log(weight[:, heard_at] / law[heard_at]), axis=1))
        if self.beam.n_sensors > 1 or self._errors is not None:
            weight = self._lawful(weight, law * scale[:, None], np.equal(of_sensors, _FAINTEST))
        return np.asarray(samples * weight / np.sqrt(scale)[:, None], np.float32)

    def _lawful(self, weight: Singles, law: Floats, faint: NDArray[np.bool_]) -> Singles:
        """Return the weights of the law in place of others, (n, n_kept), at the level of those for faint sensors.

        Else a sensor that is a little louder or of another colour than the tables say would shift the place. What the
        ringing of an earlier blow drowns stays drowned.
        """
        n, n_sensors = len(weight), self.beam.n_sensors
        ratio = (weight / np.maximum(law, 1e-30)).reshape(n, n_sensors, -1)
        level = np.where(faint, np.minimum(ratio.mean(axis=2), 1.0), 1.0)
        drowned = np.minimum(1.0, ratio / np.maximum(_DROWNED * np.median(ratio, axis=2, keepdims=True), 1e-30))
        return np.asarray(law * (drowned * level[:, :, None]).reshape(n, -1), np.float32)

    def _fainter(self, weight: Singles) -> NDArray[np.intp]:
        """Return the powers of `_RATIO` by which each sensor is noisier than the quietest, (n, n_sensors)."""
        n_sensors = self.beam.n_sensors
        power = weight.reshape(len(weight), n_sensors, -1).mean(axis=2, dtype=np.float64)
        ratio = np.maximum(power, 1e-300) / np.maximum(power.max(axis=1, keepdims=True), 1e-300)
        return np.asarray(np.minimum(np.round(-np.log(ratio) / np.log(_RATIO)), _FAINTEST).astype(np.intp))

    def _refined(
        self, samples: Singles, weight: Singles, x: Floats, y: Floats, level: Floats, without: Singles | None = None
    ) -> dict[str, Any]:
        """Return the fields of `Inverted` that follow from samples by Gauss-Newton steps from the grid.

        Directions `without` (n, n_directions, n_coefficients) tell nothing.
        """
        root = None if (weight == 1).all() else np.sqrt(weight)
        heard = _beside(samples if root is None else samples * root, without)
        x, y, _ = self._stepped(heard, root, x, y, level, without, leads=True)
        x, y, found = self._stepped(heard, root, x, y, level, without)
        far = np.flatnonzero(found.pop("step") > _FAR)
        if far.size:
            few_root, few_without = (None if part is None else part[far] for part in (root, without))
            x[far], y[far], again = self._stepped(heard[far], few_root, x[far], y[far], level[far], few_without)
            for name, array in found.items():
                array[far] = again[name]
        told = (weight > 0).sum(axis=1) - (0 if without is None else without.any(axis=2).sum(axis=1))
        rest, told = found.pop("rest"), np.maximum(told, 1)
        energy = np.maximum(np.square(heard, dtype=np.float64).sum(axis=1), 1e-300)
        return {
            "x": x,
            "y": y,
            **found,
            "misfit": rest / told,
            "unexplained": np.maximum(rest - told, 0) / energy,
        }

    def _stepped(
        self,
        heard: Singles,
        root: Singles | None,
        x: Floats,
        y: Floats,
        level: Floats,
        without: Singles | None,
        leads: bool = False,
    ) -> tuple[Floats, Floats, dict[str, Floats]]:
        """Return the places after a Gauss-Newton step and, unless it only `leads` to these, what the samples tell.

        `heard` are samples times the roots of their weights. The force follows the step to first order.
        """

        def weighted(curves: Singles) -> Singles:
            if root is not None:
                curves *= root[:, None]
            return _beside(curves, without)

        n, (beam, table), leading = len(heard), self._all, self._leading
        at, *ways = beam.weights(x, y)
        # The first shapes are enough for the first step, and for slopes.
        if leads:
            table = leading.reshape(len(leading), -1)
        own = weighted((at @ table).reshape(n, -1, heard.shape[1]))
        gram = (own @ own.transpose(0, 2, 1)).astype(np.float64)
        with_prior = gram + np.eye(own.shape[1]) / level[:, None, None] ** 2
        vector = (own @ heard[:, :, None])[:, :, 0].astype(np.float64)
        force = np.linalg.solve(with_prior, vector[:, :, None])[:, :, 0]
        single = force.astype(np.float32)
        moves = (np.stack(ways, axis=1)[:, :, :, None] * single[:, None, None, : leading.shape[1]]).reshape(2 * n, -1)
        curves = np.asarray(moves @ leading.reshape(-1, heard.shape[1]), np.float32)
        slopes = weighted(curves.reshape(n, 2, -1))
        cross = (own @ slopes.transpose(0, 2, 1)).astype(np.float64)
        inner = (slopes @ slopes.transpose(0, 2, 1)).astype(np.float64) + np.eye(2) / _PLACE_DEVIATION**2
        left = heard - (single[:, None] @ own)[:, 0]
        # The place after the coefficients are projected out, with their prior.
        through = np.linalg.solve(with_prior, cross)
        curvature = inner - cross.transpose(0, 2, 1) @ through
        pull = (slopes @ left[:, :, None])[:, :, 0].astype(np.float64)
        move = np.linalg.solve(curvature, pull[:, :, None])[:, :, 0].clip(-_LONGEST_STEP, _LONGEST_STEP)
        x_low, x_high, y_low, y_high = self.beam.region
        new_x, new_y = (x + move[:, 0]).clip(x_low, x_high), (y + move[:, 1]).clip(y_low, y_high)
        if leads:
            return new_x, new_y, {}
        move = np.stack([new_x - x, new_y - y], axis=1)
        change = (through @ move[:, :, None])[:, :, 0]
        moved = (change.astype(np.float32)[:, None] @ own)[:, 0] - (move.astype(np.float32)[:, None] @ slopes)[:, 0]
        # The coefficients after the place is projected out, without their prior.
        back = cross @ np.linalg.inv(inner)
        push = (slopes @ heard[:, :, None])[:, :, 0].astype(np.float64)
        _, cost = np.linalg.slogdet(np.eye(own.shape[1]) + level[:, None, None] ** 2 * gram)
        gained = 0.5 * np.einsum("nk,nk->n", vector, force) - 0.5 * cost
        return (
            new_x,
            new_y,
            {
                "step": np.hypot(*move.T),
                "rest": np.square(left + moved, dtype=np.float64).sum(axis=1),
                "place_deviation": np.sqrt(np.maximum(np.linalg.inv(curvature)[:, [0, 1], [0, 1]], 0.0)),
                "coefficients": force - change,
                "information": gram - back @ cross.transpose(0, 2, 1),
                "vector": vector - np.einsum("nki,ni->nk", back, push),
                "evidence": gained / (self.beam.n_sensors * self.n_samples),
            },
        )


def _beside(coefficients: Singles, directions: Singles | None) -> Singles:
    """Return coefficients (n, n_coefficients) or (n, n_of_them, n_coefficients) without what lies in directions."""
    if directions is None:
        return coefficients
    own = coefficients.reshape(len(coefficients), -1, coefficients.shape[-1])
    rest = np.asarray(own - own @ directions.transpose(0, 2, 1) @ directions, np.float32)
    return rest.reshape(coefficients.shape)


def _compressed(beam: Beam, table: Singles, share: float) -> tuple[Beam, Singles]:
    """Return a beam and its table with the principal mixtures of the modes in their place.

    The modes beyond the band are heard alike, so fewer mixtures tell the same but for a share of the amplitude.
    """
    loud = np.sqrt(np.mean(np.square(beam.participation), axis=(1, 2)))[:, None]
    own = (table * loud).astype(np.float32)
    power, mixes = np.linalg.eigh((own @ own.T).astype(np.float64))
    kept = np.cumsum(power) > share**2 * power.sum()
    mixes = mixes[:, kept][:, ::-1]
    participation = np.tensordot(mixes / np.maximum(loud, 1e-300), beam.participation, (0, 0))
    return beam.with_shapes(participation), np.ascontiguousarray(mixes.T.astype(np.float32) @ own)


def _shares(power: Floats, levels: Floats) -> tuple[Singles, Singles]:
    """Return what squares of rotated vectors add to the evidence for each level of the force, and what it costs.

    Power is (n_places, n_shapes); shapes (n_places, n_levels, n_shapes) and (n_places, n_levels, 1).
    """
    share = 0.5 / (power[:, None] + levels[:, None] ** -2)
    cost = 0.5 * np.log1p(levels[:, None] ** 2 * power[:, None]).sum(axis=2, keepdims=True)
    return share.astype(np.float32), cost.astype(np.float32)


def _highest(values: Singles, count: int) -> NDArray[np.intp]:
    """Return the columns of the highest values (n, n_columns), (n, at most count)."""
    count = min(count, values.shape[1])
    return np.argpartition(values, -count, axis=1)[:, -count:]


def _complex(coefficients: Singles, n_sensors: int) -> NDArray[np.complexfloating]:
    """Return real and imaginary parts, those of each sensor in turn, as complex (n, n_sensors, n_frequencies)."""
    parts = coefficients.reshape(len(coefficients), n_sensors, 2, -1)
    return np.asarray(parts[:, :, 0] + 1j * parts[:, :, 1])


def _cut(frames: NDArray[Any], start: NDArray[np.intp], n_samples: int) -> Floats:
    """Return the samples of each row from its start on, zeros where the frame has ended."""
    out = np.zeros((*frames.shape[:-1], n_samples))
    for row, first in enumerate(np.clip(start, 0, frames.shape[-1]).tolist()):
        part = frames[row, ..., first : first + n_samples]
        out[row, ..., : part.shape[-1]] = part
    return out

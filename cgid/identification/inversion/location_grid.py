"""The most probable onset and location of an impact, by evidence on grids of locations.

The evidence is computed from cached tables, first on a coarse grid from low frequencies, then on a fine grid near the
best locations from all frequencies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.beam_responses import (
    STRONGER,
    BeamResponses,
    Observations,
    ResponseTable,
    Rowwise,
    grid_numbers,
)
from cgid.measure.modal.beam import GRID, TOUCH, Singles

#: Expected strengths of an impact over the noise, for samples of a typical location.
_LEVELS = np.geomspace(2.0, 2e4, 12)
#: The onset is searched below this frequency [Hz], with this number of shapes and grid spacing [m], at every second
#: sample.
LOW, _LOW_SHAPES, _LOW_GRID, _STRIDE = 3.2e3, 6, 0.05, 2
#: The location is found with so many shapes: fewer lose it in the ring-down of an earlier impact. Before, the best of
#: every second location of the grid in either direction are found below this frequency [Hz], with so many shapes.
#: So many of these are compared by themselves, and the best of these with the locations next to them.
_SHAPES, _WIDE, _WIDE_SHAPES, _BEST = 14, 5e3, 12, (64, 12)
#: Maximum error of mixtures of modes over the amplitude in this search.
_NEARLY = 3e-3
#: Powers of the noise of sensors over that of the quietest with separate tables: 1, one ratio, two.
_RATIO, _FAINTEST = 8.0, 2
#: Coefficients with less than this fraction of the typical weight are negligible.
_MIN_WEIGHT = 0.02
#: Exponents of coloured noise, f^-a, with separate tables.
_COLOURS = (0.0, 0.75, 1.5)
#: Returns tables that its argument makes, perhaps as they were made before.
Kept = Callable[[Callable[[], Sequence[NDArray[Any]]]], Sequence[NDArray[Any]]]
#: Numbers of an array that fits in the processor's cache with two others; columns and rows processed at once.
_SIZE, _COLUMNS, _AT_ONCE = 1 << 16, 1024, 8


@dataclass(frozen=True, eq=False)
class Start(Rowwise):
    """Start of the Gauss-Newton steps."""

    first: NDArray[np.intp]  # (n,), sample at which the force table begins; the onset is within `TOUCH` samples of it
    x: Floats  # (n,) [m]
    y: Floats  # (n,) [m]
    level: Floats  # (n,), prior standard deviation of the force coefficients
    evidence: Floats  # (n,), its logarithm, on the grid


@dataclass(frozen=True, eq=False)
class CoarseTables:
    """A part of the responses of a beam, and the weights `at` (n_locations, n_mixtures) of a grid of locations."""

    table: ResponseTable
    x: Floats
    y: Floats
    at: Singles

    @classmethod
    def of(cls, table: ResponseTable, spacing: float, every: int = 1) -> CoarseTables:
        """Return the tables of a grid of locations [m], or of every so many of it along and across."""
        x, y, at = table.beam.grid(spacing)
        locations = slice(None) if every == 1 else grid_numbers(table.beam, every).ravel()
        return cls(table, x[locations], y[locations], at[locations])


class NoiseTables:
    """Evidence of the force at all locations, for one weighting (n_kept,) of the coefficients by noise."""

    def __init__(self, tables: CoarseTables, weight: Singles, kept: Kept, every: int = 1) -> None:
        self.tables, self.weight = tables, weight
        power, self._rotation = kept(lambda: tables.table.powers(tables.at, np.sqrt(weight)))
        self.levels = _LEVELS / np.sqrt(np.median(power.sum(axis=1)))
        self._share = _shares(power, self.levels[::every])

    def evidence(self, samples: Singles) -> Singles:
        """Return the evidence of the best level for weighted samples (n, n_kept), (n_locations, n)."""
        table, at, n = self.tables.table, self.tables.at, len(samples)
        out = np.empty((len(at), n), np.float32)
        by_mixture = np.ascontiguousarray(table.by_mixture(samples).transpose(1, 2, 0)).reshape(at.shape[1], -1)
        n_each = min(max(_SIZE // (table.n_shapes * n), 8), len(at))
        squares = np.ones((n_each, table.n_shapes + 1, n), np.float32)
        for first in range(0, len(at), n_each):
            part = slice(first, first + n_each)
            vector = (at[part] @ by_mixture).reshape(-1, table.n_shapes, n)
            own = squares[: len(vector)]
            np.square(self._rotation[part] @ vector, out=own[:, :-1])
            (self._share[part] @ own).max(axis=1, out=out[part])
        return out


class NearTables:
    """The same at some locations, with tables made on first use: those of all locations if they are kept."""

    def __init__(self, tables: CoarseTables, weight: Singles, levels: Floats, kept: Kept | None) -> None:
        self.tables, self.weight, self.levels, self._kept = tables, weight, levels, kept
        n_locations, n_shapes = len(tables.at), tables.table.n_shapes
        self._known = np.zeros(n_locations, bool)
        self._power: Floats = np.empty((n_locations, n_shapes))
        self._rotation = np.empty((n_locations, n_shapes, n_shapes), np.float32)
        self._share = np.empty((n_locations, levels.size, n_shapes + 1), np.float32)

    def evidence(self, locations: NDArray[np.intp], by_mixture: Singles) -> Singles:
        """Return the evidence at locations (n, n_locations), (n, n_locations, n_levels), from `by_mixture`."""
        at, new = self.tables.at, np.unique(locations[~self._known[locations]])
        if new.size:
            make, root = self.tables.table.powers, np.sqrt(self.weight)
            if self._kept is None:
                self._power[new], self._rotation[new] = make(at[new], root)
            elif not self._known.any():
                self._power, self._rotation = self._kept(lambda: make(at, root))
            self._share[new] = _shares(self._power[new], self.levels)
            self._known[new] = True
        out = np.empty((*locations.shape, self.levels.size), np.float32)
        squares = np.ones((_AT_ONCE, locations.shape[1], self._share.shape[2], 1), np.float32)
        for first in range(0, len(out), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            own, vector = locations[rows], at[locations[rows]] @ by_mixture[rows]
            np.square(self._rotation[own] @ vector[..., None], out=squares[: len(own), :, :-1])
            out[rows] = (self._share[own] @ squares[: len(own)])[..., 0]
        return out


class LocationGrid:
    """Grids of locations of one beam, which find the start of the Gauss-Newton steps."""

    def __init__(self, responses: BeamResponses) -> None:
        self.responses, self.beam = responses, responses.beam
        self._noise_tables: dict[tuple[Any, ...], tuple[NoiseTables, NearTables]] = {}
        self._low_tables: dict[tuple[int, ...], NoiseTables] = {}

    # -- tables ---------------------------------------------------------------------------------------

    @cached_property
    def low(self) -> CoarseTables:
        """The tables for the onset."""
        return CoarseTables.of(self.responses.table(_LOW_SHAPES, _NEARLY, LOW), _LOW_GRID)

    @cached_property
    def wide(self) -> CoarseTables:
        """The tables of every second location of the grid in either direction, for the first search."""
        return CoarseTables.of(self.responses.table(_WIDE_SHAPES, _NEARLY, _WIDE), GRID, 2)

    @cached_property
    def fine(self) -> CoarseTables:
        """The tables of the complete grid."""
        return CoarseTables.of(self.responses.table(_SHAPES, _NEARLY, turned=True), GRID)

    @cached_property
    def _near(self) -> NDArray[np.intp]:
        """Numbers of the locations of `fine` at each of `wide`, and next to it, (n_locations, 9)."""
        number = grid_numbers(self.beam)
        around = np.pad(number, 1, mode="edge")
        near = [(1, 1), *((i, k) for i in range(3) for k in range(3) if (i, k) != (1, 1))]
        columns = [around[i : i + len(number) : 2, k : k + number.shape[1] : 2].ravel() for i, k in near]
        return np.stack(columns, axis=1)

    def noise_tables(
        self, exponent: float, limit: float | None = None, strong: int = 0, fainter: tuple[int, ...] = ()
    ) -> tuple[NoiseTables, NearTables]:
        """Return the tables of `wide` and `fine` for noise of power f^-exponent."""
        # The noise power of a sensor is that of the quietest times `_RATIO` to the power of `fainter`; errors of the
        # modes follow the square of the force, `STRONGER` to the power of `strong`.
        key = exponent, limit, strong, fainter
        if key not in self._noise_tables:
            responses, bins = self.responses, self.responses.bins
            law = np.arange(bins.start, bins.stop, dtype=np.float64) ** exponent
            law = np.repeat(law / law.mean(), 2) * responses.counts(limit)
            power = _RATIO ** -np.array(fainter or [0] * self.beam.n_sensors, np.float64)
            weight, strength = np.outer(power, law).reshape(1, -1).astype(np.float32), np.array([STRONGER**strong])
            turned = responses.turned_weight(weight, strength)[0, self.fine.table.kept]
            weight = responses.with_errors(weight, strength)[0, self.wide.table.kept]
            name = "-".join(map(str, (f"{exponent:g}", limit, strong, *fainter)))
            wide = NoiseTables(self.wide, weight, partial(responses.kept, f"wide-{name}"))
            # Beams with errors or several sensors have too many kinds of noise to make the tables of all locations.
            lasts = responses.lasting and responses.errors is None and self.beam.n_sensors == 1
            near = partial(responses.kept, f"near-{name}") if lasts else None
            self._noise_tables[key] = wide, NearTables(self.fine, turned, wide.levels, near)
        return self._noise_tables[key]

    def _tables_of_low(self, fainter: tuple[int, ...]) -> NoiseTables:
        if fainter not in self._low_tables:
            n_each = self.low.table.kept.size // self.beam.n_sensors
            weight = np.repeat(_RATIO ** -np.array(fainter, np.float64), n_each).astype(np.float32)
            kept = partial(self.responses.kept, "-".join(map(str, ("low", *fainter))))
            self._low_tables[fainter] = NoiseTables(self.low, weight, kept, 2)
        return self._low_tables[fainter]

    # -- the onset ------------------------------------------------------------------------------------

    def first(self, observations: Observations, weight: Singles, onset: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the sample at which the force table begins, for an onset between two samples (n, 2)."""
        first = np.asarray(onset[:, 0] - TOUCH // 2)
        steps = np.arange(0, int((onset[:, 1] - onset[:, 0]).max(initial=0)) + 1, _STRIDE)
        if steps.size == 1:
            return first
        samples = self.responses.cut(observations, first)
        fainter, strength = self._fainter(weight), self.responses.strength(samples, weight)
        weight = self.responses.with_errors(weight, strength)
        for each, rows in _groups(fainter):
            evidence = self._evidence_of(samples[rows], weight[rows], steps, each)
            evidence[steps > (onset[rows, 1] - onset[rows, 0])[:, None]] = -np.inf
            trust = np.exp(evidence - evidence.max(axis=1, keepdims=True))
            # A force begins so gradually that a late start explains the samples equally well: prefer an early one.
            first[rows] += np.round(trust @ steps / trust.sum(axis=1)).astype(np.intp) - TOUCH // 2
        return first

    def later(self, samples: Singles, weight: Singles, n_steps: int) -> Floats:
        """Return the highest evidence on the grid of another force that begins within so many samples, (n,)."""
        out, steps = np.zeros(len(samples)), np.arange(-TOUCH, n_steps, 3 * _STRIDE)
        for each, rows in _groups(self._fainter(weight)):
            # White, as in the tables: they would take the noise of a colour for a force.
            law = np.repeat(_RATIO ** -np.array(each, np.float64), weight.shape[1] // len(each)).astype(np.float32)
            white = samples[rows] * np.sqrt(weight[rows] / law)
            out[rows] = self._evidence_of(white, np.broadcast_to(law, white.shape), steps, each).max(axis=1)
        return out

    def _evidence_of(self, samples: Singles, weight: Singles, steps: NDArray[np.intp], fainter: list[int]) -> Floats:
        """Return the evidence that a force begins some samples later, (n, n_steps), for sensors of equal noise."""
        kept, tables = self.low.table.kept, self._tables_of_low(tuple(fainter))
        weight, n_sensors = weight[:, kept], self.beam.n_sensors
        if n_sensors > 1:
            quiet = tables.weight == 1.0
            scale = np.exp(np.mean(np.log(np.maximum(weight[:, quiet], 1e-30)), axis=1, keepdims=True))
            lawful = self._lawful(weight, tables.weight * scale, np.equal(fainter, _FAINTEST))
            weight = (lawful / np.sqrt(scale)).astype(np.float32)
        spectrum = np.ascontiguousarray(samples[:, kept]).view(np.complex64).reshape(len(samples), 1, n_sensors, -1)
        frequency = np.arange(1, spectrum.shape[3] + 1) / self.responses.n_samples
        rotation = np.exp(2j * np.pi * np.outer(steps, frequency))[:, None].astype(np.complex64)
        evidence, n_rows = np.empty((len(samples), steps.size)), max(_COLUMNS // steps.size, 1)
        for first in range(0, len(samples), n_rows):
            rows = slice(first, first + n_rows)
            later = (spectrum[rows] * rotation).view(np.float32).reshape(-1, steps.size, kept.size)
            later *= weight[rows, None]
            evidence[rows] = tables.evidence(later.reshape(-1, kept.size)).max(axis=0).reshape(-1, steps.size)
        return evidence

    # -- the location ---------------------------------------------------------------------------------

    def search(self, observations: Observations, weight: Singles, exponent: Floats, first: NDArray[np.intp]) -> Start:
        """Return the best locations of the grid for forces that begin at samples of the frame, (n,)."""
        responses = self.responses
        samples = responses.cut(observations, first)
        n, strength = len(samples), responses.strength(samples, weight)
        strong = np.round(np.log(strength) / np.log(STRONGER)).astype(np.intp)
        nearest = np.argmin(np.abs(np.subtract.outer(exponent, _COLOURS)), axis=1)
        out = Start(first, *np.zeros((4, n)))
        low, kept = self.wide.table.kept, self.fine.table.kept
        in_order = np.argsort(kept)
        wide_samples, wide_weight = samples[:, low], responses.with_errors(weight, strength)[:, low]
        samples, weight = responses.turned(samples), responses.turned_weight(weight, strength)
        for (colour, force, *fainter), rows in _groups(np.column_stack([nearest, strong, self._fainter(weight)])):
            wide, fine = self.noise_tables(_COLOURS[colour], observations.limit, force, tuple(fainter))
            given = self._scaled(wide_samples[rows], wide_weight[rows], wide.weight, fainter)
            # The best of the wide grid by themselves, and the neighbours of the best of these.
            places = _highest(wide.evidence(given).T, _BEST[0])
            given = self._scaled(samples[rows], weight[rows], fine.weight[in_order], fainter)
            by_mixture = self.fine.table.by_mixture(given[:, kept])
            evidence = fine.evidence(self._near[places, 0], by_mixture).max(axis=2)
            places = np.take_along_axis(places, _highest(evidence, _BEST[1]), axis=1)
            places = self._near[places].reshape(rows.size, -1)
            evidence = fine.evidence(places, by_mixture)
            best, level = np.unravel_index(evidence.reshape(rows.size, -1).argmax(axis=1), evidence.shape[1:])
            each = np.arange(rows.size)
            out.evidence[rows], out.level[rows] = evidence[each, best, level], fine.levels[level]
            out.x[rows], out.y[rows] = self.fine.x[places[each, best]], self.fine.y[places[each, best]]
        return out

    def _scaled(self, samples: Singles, weight: Singles, law: Singles, fainter: list[int]) -> Singles:
        """Return weighted samples (n, n_kept) over the root of the level of their noise."""
        # The law has a mean weight of 1; the level of the noise is that of its middle, at the quietest sensors.
        quiet = (law > 0) & np.repeat(np.equal(fainter, 0), law.size // self.beam.n_sensors)
        scale = np.exp(np.mean(np.log(weight[:, quiet] / law[quiet]), axis=1))
        if self.beam.n_sensors > 1 or self.responses.errors is not None:
            weight = self._lawful(weight, law * scale[:, None], np.equal(fainter, _FAINTEST))
        return np.asarray(samples * weight / np.sqrt(scale)[:, None], np.float32)

    def _lawful(self, weight: Singles, law: Floats, faint: NDArray[np.bool_]) -> Singles:
        """Return the weights of a noise law for faint sensors, at the same level, and the other weights unchanged."""
        # Otherwise a sensor a little noisier or of another colour than the tables would shift the location.
        n, n_sensors = len(weight), self.beam.n_sensors
        ratio = (weight / np.maximum(law, 1e-30)).reshape(n, n_sensors, -1)
        level = np.where(faint, np.minimum(ratio.mean(axis=2), 1.0), 1.0)
        retained = np.minimum(1.0, ratio / np.maximum(_MIN_WEIGHT * np.median(ratio, axis=2, keepdims=True), 1e-30))
        return np.asarray(law * (retained * level[:, :, None]).reshape(n, -1), np.float32)

    def _fainter(self, weight: Singles) -> NDArray[np.intp]:
        """Return the powers of `_RATIO` by which each sensor is noisier than the quietest, (n, n_sensors)."""
        if self.beam.n_sensors == 1:
            return np.zeros((len(weight), 1), np.intp)
        power = weight.reshape(len(weight), self.beam.n_sensors, -1).mean(axis=2, dtype=np.float64)
        ratio = np.maximum(power, 1e-300) / np.maximum(power.max(axis=1, keepdims=True), 1e-300)
        return np.asarray(np.minimum(np.round(-np.log(ratio) / np.log(_RATIO)), _FAINTEST).astype(np.intp))


def _groups(kinds: NDArray[np.intp]) -> list[tuple[list[int], NDArray[np.intp]]]:
    """Return the distinct rows of an array (n, ...), and the indices of each."""
    each, number = np.unique(kinds, axis=0, return_inverse=True)
    return [(kind, np.flatnonzero(number.ravel() == k)) for k, kind in enumerate(each.tolist())]


def _shares(power: Floats, levels: Floats) -> Singles:
    """Return the contribution of squared rotated vectors, and of 1, to the evidence of each force level."""
    share = 0.5 / (power[:, None] + levels[:, None] ** -2)
    cost = 0.5 * np.log1p(levels[:, None] ** 2 * power[:, None]).sum(axis=2, keepdims=True)
    return np.concatenate([share, -cost], axis=2).astype(np.float32)


def _highest(values: Singles, count: int) -> NDArray[np.intp]:
    """Return the columns of the highest values (n, n_columns), (n, at most count)."""
    count = min(count, values.shape[1])
    return np.argpartition(values, -count, axis=1)[:, -count:]

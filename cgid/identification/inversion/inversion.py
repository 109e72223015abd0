"""Estimate impact location and contact force from beam acceleration.

For a given location the acceleration is linear in the contact force. A force is a sum of principal shapes, each of
which excites every mode of the beam; the location only weighs the modes. This is a linear Gaussian model in some 16
unknowns, whose evidence has a closed form: `location_grid` finds the best location of a grid. Gauss-Newton steps then
refine the location, and the uncertainty of the force includes that of the location. The samples of several sensors,
each over its own noise, are samples of one model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.beam_responses import BeamResponses, Observations, ResponseTable, Rowwise, cut
from cgid.identification.inversion.location_grid import LOW, LocationGrid, Start
from cgid.measure.modal.beam import TOUCH, Singles

__all__ = ["ForceEstimate", "Inversion", "Observations", "Start"]

#: Longest Gauss-Newton step from the grid to the location, and the second step from which on a third follows [m].
_MAX_STEP, _FAR = 0.012, 0.006
#: Prior standard deviation of the location about the best of the grid [m].
_PRIOR_OF_LOCATION = 0.1
#: The onset that low frequencies tell may be early by this [s]; later ones are tried every so many samples. Misfit and
#: fraction of energy unexplained from which the location is searched again.
_EARLY, _TRIED, _LOST = 0.5e-3, 4, (1.3, 1e-3)
#: Shapes in the first step from the grid, and in slopes.
_LEADING = 14
#: Maximum error of mixtures of modes over the amplitude.
_SAME = 3e-4
#: Vibrations processed at once.
_AT_ONCE = 256
#: Singular values of the clipped samples, relative to the largest, below which they are outside the band.
_IN_BAND = 1e-3
#: A second impact explains more than this fraction of the energy: a beam is hardly known better.
MORE_THAN_ONE = 6e-4
#: It begins within this time [s]. It is searched where more than so many standard deviations are left at low
#: frequencies, and is there if its evidence is more than this and it explains more than this fraction of what is left.
_SECOND, _MUCH_LEFT, _SURELY, _MOST = 3.2e-3, 3.0, 8.0, 0.3
#: With more than this fraction of clipped samples, as of a square wave, nothing is explained: few samples remain, and
#: leaving so many out costs a hundred times as much as an impact.
_MOST_CLIPPED = 0.3


@dataclass(frozen=True, eq=False)
class ForceEstimate(Rowwise):
    """Location and force estimated from vibrations, each row one impact."""

    x: Floats  # (n,) [m], most probable location
    y: Floats  # (n,) [m]
    place_deviation: Floats  # (n, 2) [m], standard deviation
    start: NDArray[np.intp]  # (n,), sample at which the force table begins; the onset is within `TOUCH` samples of it
    coefficients: Floats  # (n, n_shapes), of the force, each over its prior standard deviation and the noise
    information: Floats  # (n, n_shapes, n_shapes), log-likelihood of c: `-c information c / 2 + vector c`
    vector: Floats  # (n, n_shapes); the location is projected out
    noise: Floats  # (n,), standard deviation at the quietest sensor [unit of the samples]
    evidence: Floats  # (n,), ln evidence over that of noise alone, per sample
    misfit: Floats  # (n,), mean square of the residual over the noise; 1 if the beam explains the samples
    unexplained: Floats  # (n,), fraction of energy in the residual beyond the noise, at least 0
    overlap: Floats  # (n,), fraction of energy that surely is of one more impact soon after; 0 until asked

    def later(self, samples: NDArray[np.intp]) -> Start:
        """Return the start of another estimate at the same location, of a force that begins by some samples later."""
        level = np.sqrt(np.maximum(np.mean(np.square(self.coefficients), axis=1), 1.0))
        return Start(self.start + samples, self.x, self.y, level, self.evidence)

    def or_better(self, other: ForceEstimate) -> ForceEstimate:
        """Return the estimate of each row that has the higher evidence."""
        rows = np.flatnonzero(other.evidence > self.evidence)
        return self.replaced(rows, other.rows(rows)) if rows.size else self


class Inversion(BeamResponses):
    """The tables of one beam, and the inversion of accelerations through them; parameters as of `BeamResponses`."""

    @cached_property
    def grid(self) -> LocationGrid:
        """The grids of locations."""
        return LocationGrid(self)

    @cached_property
    def _all(self) -> ResponseTable:
        return self.table(len(self.beam.deviations), _SAME, turned=True)

    @cached_property
    def _leading(self) -> ResponseTable:
        return self._all.leading(_LEADING)

    @cached_property
    def _lower(self) -> ResponseTable:
        return self._leading.lower_half()

    @cached_property
    def _narrower(self) -> dict[float, Inversion]:
        return {}

    def _for(self, observations: Observations) -> tuple[Inversion, Observations]:
        """Return the inversion of the used band, whose tables are cached, and observations by sensor."""
        limit = observations.limit
        if limit is None or self.beam.errors is None:
            return self, observations.by_sensor()
        # Errors of the modes are rotated in the used band.
        narrower = self._narrower.setdefault(limit, Inversion(self.beam, limit))
        return narrower, replace(observations, limit=None).by_sensor()

    def invert(self, observations: Observations, onset: NDArray[np.intp]) -> ForceEstimate:
        """Return locations and forces of impacts with an onset between samples `onset` (n, 2) of the frame."""
        own, observations = self._for(observations)
        parts = []
        for rows in own._slices(len(onset)):
            part = observations.rows(rows)
            weight, exponent = own.weights(part)
            start = own.grid.search(part, weight, exponent, own.grid.first(part, weight, onset[rows]))
            parts.append(own._refined(part, weight, start))
        return ForceEstimate.joined(parts)

    def settle(self, observations: Observations, onset: NDArray[np.intp]) -> ForceEstimate:
        """Return the same as `invert`, with more steps, of the onset that explains an impact best."""
        found = self.invert(observations, onset)
        begin, steps = found.start, np.arange(0, int(_EARLY * self.beam.sampling_rate) + 1, _TRIED)
        for later in steps:
            found = found.or_better(self.refine(observations, found.later(begin + later - found.start)))
        lost = np.flatnonzero((found.misfit > _LOST[0]) & (found.unexplained > _LOST[1]))
        if lost.size:
            own = observations.rows(lost)
            others = np.add.outer(found.start[lost] + TOUCH // 2, steps[:2])
            other = self.refine(own, self.compare(own, others))
            found = found.replaced(lost, found.rows(lost).or_better(other))
        return found.or_better(self.refine(observations, found.later(np.zeros_like(begin))))

    def refine(self, observations: Observations, start: Start) -> ForceEstimate:
        """Return locations and forces by Gauss-Newton steps alone."""
        own, observations = self._for(observations)
        parts = [(observations.rows(rows), start.rows(rows)) for rows in own._slices(len(start.x))]
        return ForceEstimate.joined([own._refined(part, own.weights(part)[0], begin) for part, begin in parts])

    def compare(self, observations: Observations, onset: NDArray[np.intp]) -> Start:
        """Return the start of highest evidence on the grid among several onsets, (n, n_onsets)."""
        own, observations = self._for(observations)
        n, n_onsets = onset.shape
        row, first = np.repeat(np.arange(n), n_onsets), onset.ravel() - TOUCH // 2
        weight, exponent = own.weights(observations)
        parts = [
            own.grid.search(observations.rows(row[rows]), weight[row[rows]], exponent[row[rows]], first[rows])
            for rows in own._slices(row.size)
        ]
        starts = Start.joined(parts)
        return starts.rows(starts.evidence.reshape(n, -1).argmax(axis=1) + np.arange(n) * n_onsets)

    def overlap(self, observations: Observations, estimate: ForceEstimate) -> Floats:
        """Return the fraction of energy that surely is of a second impact, soon after each, (n,)."""
        own, observations = self._for(observations)
        slices = own._slices(len(estimate.x))
        return np.concatenate([own._overlap(observations.rows(rows), estimate.rows(rows)) for rows in slices])

    @cached_property
    def _low(self) -> ResponseTable:
        return self.table(len(self.beam.deviations), _SAME, LOW)

    def _overlap(self, observations: Observations, estimate: ForceEstimate) -> Floats:
        samples, table = self.cut(observations, estimate.start), self._low
        weight = self.weights(observations)[0]
        weight = self.with_errors(weight, self.strength(samples, weight))
        ways = table.of_shapes(table.beam.weights(estimate.x, estimate.y)[0], None)
        left = np.zeros_like(samples)
        fitted = np.einsum("ns,nsk->nk", estimate.coefficients.astype(np.float32), ways)
        left[:, table.kept] = samples[:, table.kept] - fitted
        count = np.count_nonzero(weight[:, table.kept], axis=1)
        energy = np.sum(np.square(left) * weight, axis=1) - count
        least = MORE_THAN_ONE * np.einsum("nk,nk,nk->n", samples, samples, weight)
        rows = np.flatnonzero(energy > np.maximum(_MUCH_LEFT * np.sqrt(2 * np.maximum(count, 1)), least))
        out = np.zeros(len(samples))
        if rows.size:
            gained = 2 * self.grid.later(left[rows], weight[rows], round(_SECOND * self.beam.sampling_rate))
            surely = gained > np.maximum(np.maximum(2 * _SURELY, _MOST * energy[rows]), least[rows])
            out[rows] = MORE_THAN_ONE * surely * gained / least[rows]
        return out

    def _slices(self, n: int) -> list[slice]:
        """Return slices of rows, at least one."""
        n_rows = max(_AT_ONCE // self.beam.n_sensors, 1)
        return [slice(first, first + n_rows) for first in range(0, max(n, 1), n_rows)]

    def _refined(self, observations: Observations, weight: Singles, start: Start) -> ForceEstimate:
        samples, by_frequency = self.cut(observations, start.first), weight
        weight = self.turned_weight(weight, self.strength(samples, weight))
        samples, x, y, level = self.turned(samples), start.x, start.y, start.level
        fields = self._descended(samples, weight, x, y, level)
        if self.errors is not None:
            peak = (fields["coefficients"] @ (self.beam.shapes * self.beam.deviations[:, None])).max(axis=1)
            weight = self.errors.weight(by_frequency, np.square(peak))
            fields = self._descended(samples, weight, fields["x"], fields["y"], level)
        if observations.clipped is not None and observations.clipped.any():
            clipped = cut(observations.clipped, start.first, self.n_samples) > 0
            there = np.clip(observations.clipped.shape[2] - start.first, 1, self.n_samples)
            share = clipped.mean(axis=1).sum(axis=1) / there
            fields["unexplained"][share > _MOST_CLIPPED] = 1.0
            rows = np.flatnonzero((share > 0) & (share <= _MOST_CLIPPED))
            if rows.size:
                x, y, level, weight = fields["x"][rows], fields["y"][rows], level[rows], weight[rows]
                others = self._descended(samples[rows], weight, x, y, level, self._directions(clipped[rows], weight))
                for name, array in fields.items():
                    array[rows] = others[name]
        return ForceEstimate(start=start.first, noise=observations.level, overlap=np.zeros(len(samples)), **fields)

    def _directions(self, clipped: NDArray[np.bool_], weight: Singles) -> Singles:
        """Return orthonormal directions (n, n_directions, n_coefficients) that clipped samples move; or zeros."""
        n, n_sensors, _ = clipped.shape
        parts = []
        for row in range(n):
            sensor, sample = np.nonzero(clipped[row])
            moves = np.zeros((sample.size, n_sensors, weight.shape[1] // n_sensors))
            moves[np.arange(sample.size), sensor] = self._moves[sample]
            moves = self.turned(moves.reshape(sample.size, weight.shape[1])) * np.sqrt(weight[row])
            # As a singular value decomposition, at a third of the cost.
            power, mixed = np.linalg.eigh(moves @ moves.T)
            kept = power > _IN_BAND**2 * power.max(initial=0.0)
            parts.append((mixed[:, kept] / np.sqrt(power[kept])).T @ moves)
        out = np.zeros((n, max(len(own) for own in parts), weight.shape[1]), np.float32)
        for row, own in enumerate(parts):
            out[row, : len(own)] = own
        return out

    @cached_property
    def _moves(self) -> Singles:
        """Contribution of each sample to the coefficients, (n_samples, n_coefficients)."""
        return self.transformed(np.eye(self.n_samples))

    def _descended(
        self, samples: Singles, weight: Singles, x: Floats, y: Floats, level: Floats, without: Singles | None = None
    ) -> dict[str, Any]:
        """Return the fields of `ForceEstimate` after Gauss-Newton steps from the grid, except `without`."""
        selected = self._all.kept
        root = None if (weight == 1).all() else np.sqrt(weight[:, selected])
        without = None if without is None else without[:, :, selected]
        samples = _beside(samples[:, selected] if root is None else samples[:, selected] * root, without)
        # The lower half of the band is enough for the first step, except in directions of the complete band.
        low = self._lower if without is None else self._leading
        few = slice(low.kept.size)
        x, y, _ = self._stepped(low, samples[:, few], None if root is None else root[:, few], x, y, level, without)
        x, y, fields = self._stepped(self._all, samples, root, x, y, level, without)
        count = (weight > 0).sum(axis=1) - (0 if without is None else without.any(axis=2).sum(axis=1))
        far = np.flatnonzero(fields.pop("step") > _FAR)
        if far.size:
            root, without = (None if part is None else part[far] for part in (root, without))
            x[far], y[far], others = self._stepped(self._all, samples[far], root, x[far], y[far], level[far], without)
            for name, array in fields.items():
                array[far] = others[name]
        residual, count = fields.pop("residual"), np.maximum(count, 1)
        energy = np.maximum(np.square(samples, dtype=np.float64).sum(axis=1), 1e-300)
        unexplained = np.maximum(residual - count, 0) / energy
        return {"x": x, "y": y, **fields, "misfit": residual / count, "unexplained": unexplained}

    def _stepped(
        self,
        table: ResponseTable,
        samples: Singles,
        root: Singles | None,
        x: Floats,
        y: Floats,
        level: Floats,
        without: Singles | None,
    ) -> tuple[Floats, Floats, dict[str, Floats]]:
        """Return locations after a Gauss-Newton step and, with the complete table, the information of the samples."""
        at, *slopes_of_at = table.beam.weights(x, y)
        # The first shapes are enough for slopes.
        leading = self._leading if table is self._all else table
        ways = _beside(table.of_shapes(at, root), without)
        gram = (ways @ ways.transpose(0, 2, 1)).astype(np.float64)
        with_prior = gram + np.eye(ways.shape[1]) / level[:, None, None] ** 2
        vector = (ways @ samples[:, :, None])[:, :, 0].astype(np.float64)
        force = np.linalg.solve(with_prior, vector[:, :, None])[:, :, 0]
        single = force.astype(np.float32)
        slopes = leading.of_forces(np.stack(slopes_of_at, axis=1), single[:, : leading.n_shapes], root)
        slopes = _beside(slopes, without)
        cross = (ways @ slopes.transpose(0, 2, 1)).astype(np.float64)
        inner = (slopes @ slopes.transpose(0, 2, 1)).astype(np.float64) + np.eye(2) / _PRIOR_OF_LOCATION**2
        residual = samples - (single[:, None] @ ways)[:, 0]
        # The location with the coefficients projected out, with their prior.
        through = np.linalg.solve(with_prior, cross)
        curvature = inner - cross.transpose(0, 2, 1) @ through
        pull = (slopes @ residual[:, :, None])[:, :, 0].astype(np.float64)
        move = np.linalg.solve(curvature, pull[:, :, None])[:, :, 0].clip(-_MAX_STEP, _MAX_STEP)
        x_low, x_high, y_low, y_high = self.beam.region
        new_x, new_y = (x + move[:, 0]).clip(x_low, x_high), (y + move[:, 1]).clip(y_low, y_high)
        if table is not self._all:
            return new_x, new_y, {}
        move = np.stack([new_x - x, new_y - y], axis=1)
        change = (through @ move[:, :, None])[:, :, 0]
        residual += (change.astype(np.float32)[:, None] @ ways)[:, 0] - (move.astype(np.float32)[:, None] @ slopes)[
            :, 0
        ]
        # The coefficients after the location is projected out, without their prior.
        back = cross @ np.linalg.inv(inner)
        push = (slopes @ samples[:, :, None])[:, :, 0].astype(np.float64)
        _, cost = np.linalg.slogdet(np.eye(ways.shape[1]) + level[:, None, None] ** 2 * gram)
        gained = 0.5 * np.einsum("nk,nk->n", vector, force) - 0.5 * cost
        return (
            new_x,
            new_y,
            {
                "step": np.hypot(*move.T),
                "residual": np.square(residual, dtype=np.float64).sum(axis=1),
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
    rows = coefficients.reshape(len(coefficients), -1, coefficients.shape[-1])
    others = np.asarray(rows - rows @ directions.transpose(0, 2, 1) @ directions, np.float32)
    return others.reshape(coefficients.shape)

"""The modes of a beam, learned from impacts at unknown locations with unknown forces.

The samples of an impact are `sum_r participation_r(location) response_r(pole_r, force) + noise`. Location and force
differ from impact to impact, but all share the poles. Both are estimated with the current poles; a Gauss-Newton step
then corrects all modes at once, with locations and forces projected out: variable projection (Golub & Pereyra 1973),
with Gaussian priors. A mode in a wrong local minimum is then searched for by itself over a wider range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.inversion import ForceEstimate, Inversion, Observations
from cgid.measure.fit.ar_noise import ARNoise
from cgid.measure.modal.beam import Beam, Singles, corrected, respond
from cgid.measure.modal.modes import CORRECTED

#: Relative step of the difference quotients in a pole: at the end of a response, it turns the fastest mode by some
#: thousandths of a radian.
POLE_STEP = 1e-6
#: Prior standard deviation of a location about its estimate [m].
_LOCATION_DEVIATION = 0.1
#: Impacts per round while the poles move far, and per search of single modes.
_FEW, _N_SEARCHED = 80, 48
#: Gauss-Newton rounds before the first search of single modes, between two, and at last with all impacts; searches.
_FIRST, _BETWEEN, _LAST, _MAX_SEARCHES = 8, 2, 10, 6
#: Successive bands as fractions of the whole, and the range of modes beyond a band that still affect it.
_BANDS, _BEYOND = (0.12, 0.24, 0.4, 0.6, 0.8, 1.0), 1.15
#: The same where the modes are nearly known and the sensor is not; step of the quotients in its location [m].
_BANDS_OF_SENSOR, _PLACE_STEP = (0.24, 0.5, 1.0), 1e-4
#: With frequency errors below this fraction of the damping ratio, the complete band is learned at once.
_NARROW = 0.7
#: Factor of the standard deviations for the nonlinearity in the poles; measured by benchmarks/beam/calibrate.py.
_BEYOND_LINEAR = 1.1
#: Distance from a mode, in relative terms and at least so many bins, of the residual that may have moved it, and the
#: part of its amplitude that does; measured by benchmarks/beam/chain.py.
_NEAR, _NEAR_BINS, _MOVED_BY_LEFT = 0.04, 2.0, 0.5
#: Part of a mode's deviation that is added for each mode that lies within its bandwidth; measured by the same.
_MOVED_BY_SHAPES = 0.5
#: A filter of linear phase rings for so many standard deviations of its impulse response; least noise over the peak.
_RINGS, _LEAST_NOISE = 3.0, 1e-7
#: Maximum number of rounds.
MAX_ROUNDS = len(_BANDS) * (_FIRST + _MAX_SEARCHES * _BETWEEN) + _LAST
#: Poles have converged when this fraction of the steps is no longer than this fraction of their standard deviations.
_QUANTILE, _CONVERGED = 0.97, 0.5
#: Widest range of the search, in prior standard deviations and relative to the frequency; its step in damping ratios.
_WIDEST, _WIDEST_SHARE, _FINEST = 3.0, 0.12, 0.35
#: Minimum gain in log-likelihood for a move to another minimum, and the separation of modes that move together.
_MIN_GAIN, _SEPARATION = 10.0, 0.04


@dataclass(frozen=True, eq=False)
class ImpactFrames:
    """Recorded impacts."""

    frames: Floats  # (n, n_samples), at the sampling rate of the beam, without baseline
    start: NDArray[np.intp]  # (n, 2), first and last possible sample of the onset
    noise: Floats  # (n,), standard deviation
    colour: ARNoise
    n_quiet: int  # samples before any onset

    def __len__(self) -> int:
        return len(self.frames)

    def taken(self, rows: slice | NDArray[np.intp]) -> ImpactFrames:
        """Return some of the impacts."""
        colour = ARNoise(self.colour.coefficients[rows], self.colour.innovation[rows])
        return ImpactFrames(self.frames[rows], self.start[rows], self.noise[rows], colour, self.n_quiet)

    def behind(self, beam: Beam) -> ImpactFrames:
        """Return the same as of the recorder of a beam: a filter of linear phase is late, and rings before an onset."""
        if beam.linear_phase is None:
            return self
        rate, (edge, width, delay) = beam.sampling_rate, beam.linear_phase.tolist()
        start = np.maximum(self.start - np.array([int(np.ceil(delay * rate)), 0]), 0)
        n_quiet = self.n_quiet - min(int(rings(beam) * rate), self.n_quiet // 2)
        # Noise has passed the filter as well: none above its edge, which no autoregression of low order follows.
        power = np.square(np.abs(np.fft.rfft(self.frames[:, :n_quiet], axis=1))) / n_quiet
        passed = np.fft.rfftfreq(n_quiet, 1 / rate) < edge - 2 * width
        passed[:2] = [False, True]
        noise = np.sqrt(power[:, passed].mean(axis=1)) + _LEAST_NOISE * np.abs(self.frames).max(axis=1) + 1e-300
        return ImpactFrames(self.frames, start, noise, ARNoise(np.zeros_like(self.colour.coefficients), noise), n_quiet)

    def observations(self, raised: Floats | float = 1.0, limit: float | None = None) -> Observations:
        """Return the impacts with their noise raised by factors, (n,)."""
        colour = self.colour
        return Observations(
            self.frames, self.noise * raised, colour.coefficients, colour.innovation * raised, limit=limit
        )

    def weight(self, inversion: Inversion) -> Floats:
        """Return the power of white noise of the same variance over that of the noise, (n, n_coefficients)."""
        bins = np.arange(inversion.bins.start, inversion.bins.stop) / inversion.n_samples
        weight = np.ones((len(self), 2 * bins.size))
        rows = self.colour.rows
        if rows.size:
            weight[rows] = np.repeat(self.noise[rows, None] ** 2 / self.colour.of(rows).power(bins), 2, axis=1)
        return weight


def rings(beam: Beam) -> float:
    """Return for how long a filter of linear phase rings before an onset [s]; 0 without one."""
    return 0.0 if beam.linear_phase is None else _RINGS / (2 * np.pi * float(beam.linear_phase[1]))


def evidence_of(inversion: Inversion, impacts: ImpactFrames) -> tuple[Floats, ForceEstimate]:
    """Return the log evidence of each impact per sample, (n,), and their locations and forces."""
    # White noise alone has -0.5. A beam that explains the impacts has a few tenths less, since locations and forces are
    # unknown; a wrong beam has much less.
    force = inversion.settle(impacts.observations(), impacts.start)
    samples = _cut(impacts.frames, force.start, inversion.n_samples) / impacts.noise[:, None]
    power = np.sum(np.square(inversion.transformed(samples), dtype=np.float64) * impacts.weight(inversion), axis=1)
    return np.asarray(force.evidence - 0.5 * power / inversion.n_samples), force


@dataclass(frozen=True)
class MovedSensor:
    """A sensor whose location is uncertain: the beam with it moved by x and y [m], and standard deviations [m]."""

    beam: Callable[[Floats], Beam]
    deviation: Floats


@dataclass(frozen=True, eq=False)
class Heard:
    """The impacts on a beam as one of its sensors measures them, whose location is perhaps uncertain."""

    beam: Beam
    impacts: ImpactFrames
    sensor: MovedSensor | None = None

    def at(self, place: Floats) -> Beam:
        """Return the beam with its sensor moved."""
        return self.beam if self.sensor is None else self.sensor.beam(place)

    def corrected(self, place: Floats, correction: Floats) -> Beam:
        """Return the same with corrections of its modes, of which a sensor may hear the first alone."""
        beam = self.at(place)
        return corrected(beam, correction[:, : len(beam.poles)])


class Learned:
    """Corrections of the modes of a beam that all its sensors share, and the steps that improve them."""

    # `correction`, `deviation` (3, n_modes): of ln frequency, ln damping ratio and ln participation; `has_converged`:
    # whether the last step was small compared with the standard deviations. `places` (n_sensors, 2): where the location
    # of the sensors is learned as well, since modes that are off shift it, and the reverse. Each sensor has its own
    # filters, and sees locations and forces by itself.

    def __init__(self, heard: Sequence[Heard], prior: Floats, progress: Callable[[int], object] | None = None) -> None:
        self._heard, self._progress, self._prior = heard, progress, prior
        self._n_impacts, self._placed = len(heard[0].impacts), heard[0].sensor is not None
        self.places = np.zeros((len(heard), 2))
        self.correction: Floats = np.zeros(prior.shape)
        self.deviation, self.has_converged = prior.copy(), False
        self._quantities, self._raised = np.flatnonzero(prior.any(axis=1)), np.ones((len(heard), self._n_impacts))

    def on(self, heard: Sequence[Heard], prior: Floats) -> Learned:
        """Return the same of the beam behind other recorders, which may hear other modes beyond the band."""
        other = Learned(heard, prior, self._progress)
        n = min(prior.shape[1], self.correction.shape[1])
        other.correction[:, :n] = self.correction[:, :n]
        return other

    def approach(self) -> None:
        """Come near to the modes with some of the impacts."""
        first = self._heard[0].beam
        few, inversion = min(_FEW, self._n_impacts), Inversion(first)
        top = inversion.bins.stop / inversion.n_samples * first.sampling_rate
        ratio = float(np.median(first.modes.damping_ratio))
        # Low modes first: they determine the locations, and these the higher modes. Errors well below the width of a
        # resonance need no such order.
        narrow = _BANDS_OF_SENSOR if self._placed else _BANDS[-1:]
        for fraction in _BANDS if float(self._prior[0].max()) > _NARROW * ratio else narrow:
            limit = None if fraction == 1 else fraction * top
            for search in range(_MAX_SEARCHES + 1):
                for _ in range(_BETWEEN if search else _FIRST):
                    if self.step(few, limit):
                        break
                if search == _MAX_SEARCHES or not self.search(few, limit):
                    break

    def settle(self) -> None:
        """Make the last steps, with all impacts."""
        for _ in range(_LAST):
            if self.step(self._n_impacts):
                break
        # What is left of a vibration although all impacts share the modes moves those near it, weak ones most, and does
        # so in every impact alike: scatter does not show it. Nor are shapes exact: what one lacks moves modes that
        # overlap it.
        overlap = self._overlap()
        for quantity, told in zip(self._quantities, self._told, strict=True):
            moved = _MOVED_BY_LEFT**2 * np.maximum(self._left, 0.0) / np.maximum(told, 1e-300)
            known = np.sqrt(self.deviation[quantity] ** 2 + moved)
            known[: overlap.size] *= np.sqrt(1 + np.square(_MOVED_BY_SHAPES * overlap))
            self.deviation[quantity] = np.minimum(known, np.maximum(self._prior[quantity], self.deviation[quantity]))

    def _overlap(self) -> Floats:
        """Return the number of other modes within the bandwidth of each, the further the less."""
        one, place = max(zip(self._heard, self.places, strict=True), key=lambda pair: len(pair[0].beam.poles))
        modes = one.corrected(place, self.correction).modes
        apart = (modes.frequency - modes.frequency[:, None]) / (modes.damping_ratio * modes.frequency)[:, None]
        return np.asarray(np.sum(1 / (1 + np.square(apart)), axis=1) - 1)

    def _system(self, number: int, n_impacts: int, limit: float | None) -> System:
        """Return the impacts of a sensor, inverted with the corrected beam."""
        one, rows = self._heard[number], slice(n_impacts)
        beam = one.corrected(self.places[number], self.correction)
        return System(beam, one.impacts.taken(rows), self._raised[number, rows], limit)

    def _sides(self, number: int, axis: int) -> tuple[Beam, Beam]:
        """Return the corrected beam with a sensor on either side of its place."""
        one, here, step = self._heard[number], self.places[number], _PLACE_STEP * np.eye(2)[axis]
        return one.corrected(here + step, self.correction), one.corrected(here - step, self.correction)

    def step(self, n_impacts: int, limit: float | None = None) -> bool:
        """Make a Gauss-Newton step with the first impacts, up to a frequency; return `has_converged`."""
        quantities = self._quantities
        prior = np.maximum(self._prior[quantities], 1e-9)
        every, now = prior.ravel(), self.correction[quantities].ravel()
        if self._placed:
            of_sensors = [one.sensor.deviation for one in self._heard if one.sensor is not None]
            every, now = np.concatenate([every, *of_sensors]), np.concatenate([now, self.places.ravel()])
        pulls, curvature = np.zeros((n_impacts, every.size)), np.zeros((every.size,) * 2)
        self._left = np.zeros(self._prior.shape[1])
        for number in range(len(self._heard)):
            system = self._system(number, n_impacts, limit)
            indices, slopes = self._slopes(system, number)
            own, curved = system.equations(slopes)
            pulls[:, indices] += own
            curvature[np.ix_(indices, indices)] += curved
            self._raised[number, :n_impacts] = np.sqrt(np.maximum(system.power, 1.0))
            self._left[: len(system.beam.poles)] += system.left_near(system.beam.modes.frequency)
        self._told = np.diag(curvature)[: prior.size].reshape(prior.shape)
        now, step, deviation = newton(curvature, pulls, every, now)
        self.places = now[prior.size :].reshape(-1, 2) if self._placed else self.places
        now, step, deviation = now[: prior.size], step[: prior.size], deviation[: prior.size]
        self.correction[quantities] = now.reshape(prior.shape)
        self.deviation[quantities] = np.minimum(_BEYOND_LINEAR * deviation.reshape(prior.shape), prior)
        if self._progress is not None:
            self._progress(1)
        self.has_converged = bool(np.quantile(np.abs(step) / deviation, _QUANTILE) < _CONVERGED)
        return self.has_converged

    def _slopes(self, system: System, number: int) -> tuple[NDArray[np.intp], Callable[[int], Singles]]:
        """Return which parameters the impacts of a sensor tell, and the slopes of an impact in them."""
        n_modes, quantities = self._prior.shape[1], self._quantities
        indices = np.add.outer(np.arange(quantities.size) * n_modes, system.active).ravel()
        of_modes = system.by_modes(quantities)
        if not self._placed:
            return indices, of_modes
        of_place = system.by_beams(lambda axis: self._sides(number, axis), 2, _PLACE_STEP)

        def both(row: int) -> Singles:
            return np.concatenate([of_modes(row), of_place(row).astype(np.float32)])

        return np.concatenate([indices, quantities.size * n_modes + 2 * number + np.arange(2)]), both

    def search(self, n_impacts: int, limit: float | None) -> bool:
        """Move single modes to other minima; return whether any of them improved."""
        n_impacts = min(n_impacts, _N_SEARCHED)
        parts = [
            (one.at(place), self._system(number, n_impacts, limit))
            for number, (one, place) in enumerate(zip(self._heard, self.places, strict=True))
        ]
        moved = search_valleys(parts, self.correction, self._prior)
        self.correction = self.correction if moved is None else moved
        return moved is not None


def newton(curvature: Floats, pulls: Floats, prior: Floats, now: Floats) -> tuple[Floats, Floats, Floats]:
    """Return parameters (n,) after a Gauss-Newton step no longer than the prior, the step, and standard deviations."""
    covariance = np.linalg.inv(curvature + np.diag(prior**-2))
    # If the gradients of single impacts scatter more than the curvature predicts, the model is not exact: Huber (1967).
    scatter = np.sum(np.square(covariance @ pulls.T), axis=1)
    step = np.clip(covariance @ (pulls.sum(axis=0) - now / prior**2), -prior, prior)
    return now + step, step, np.sqrt(np.maximum(np.diag(covariance), scatter))


def _cut(frames: Floats, start: NDArray[np.intp], n_samples: int) -> Floats:
    """Return the samples of each row from its start on, zeros after the frame."""
    columns = start[:, None] + np.arange(n_samples)
    inside = np.take_along_axis(frames, np.clip(columns, 0, frames.shape[1] - 1), axis=1)
    return np.where((columns >= 0) & (columns < frames.shape[1]), inside, 0.0)


class System:
    """Impacts inverted with one beam, and the normal equations of its errors."""

    # `raised` (n_blows,) are factors of the noise, `limit` [Hz] is the highest frequency used; `active` are the modes
    # up to it, `inverted` locations and forces, and `power` (n_blows,) the mean squared residual over the noise.

    def __init__(self, beam: Beam, impacts: ImpactFrames, raised: Floats, limit: float | None = None) -> None:
        self.beam, self.inversion, self.raised = beam, Inversion(beam), raised
        bins = self.inversion.bins
        frequency = np.arange(bins.start, bins.stop) / self.inversion.n_samples * beam.sampling_rate
        highest = np.inf if limit is None else limit
        self.columns = np.flatnonzero(np.repeat(frequency, 2) <= highest)
        self.active = np.flatnonzero(beam.modes.frequency <= _BEYOND * highest)
        self.inverted = self.inversion.settle(impacts.observations(raised, limit), impacts.start)
        self.root = np.sqrt(impacts.weight(self.inversion)[:, self.columns]).astype(np.float32)
        samples = (
            _cut(impacts.frames, self.inverted.start, self.inversion.n_samples) / (impacts.noise * raised)[:, None]
        )
        self.samples = self.inversion.transformed(samples)[:, self.columns] * self.root
        self.table = self._informative(respond(beam, self.inversion.forces, self.inversion.n_samples))
        self.at = self.beam.weights(self.inverted.x, self.inverted.y)
        self.power = np.empty(len(impacts))
        self.left = np.zeros(self.columns.size)

    def by_modes(self, quantities: NDArray[np.intp]) -> Callable[[int], Singles]:
        """Return the slopes of an impact in corrections of the active modes, quantity by quantity."""
        slopes = [self._slope(quantity) if quantity < 2 else self.table[self.active] for quantity in quantities]

        def of(row: int) -> Singles:
            single, at = self.inverted.coefficients[row].astype(np.float32), self.at[0][row][self.active, None]
            return np.concatenate([(single @ slope) * at for slope in slopes])

        return of

    def _slope(self, row: int) -> Singles:
        """Return the slopes of the responses in ln frequency or ln damping ratio, like `table`."""
        step = np.zeros((len(CORRECTED), len(self.beam.poles)))
        step[row] = POLE_STEP
        sides = [self._responses(corrected(self.beam, sign * step)) for sign in (1, -1)]
        return self._informative((sides[0] - sides[1]) / (2 * POLE_STEP))

    def equations(self, slopes: Callable[[int], Singles | Floats]) -> tuple[Floats, Floats]:
        """Return the gradients of the impacts in the parameters, (n_blows, n), and their curvature, (n, n)."""
        # `slopes` returns the slopes of the coefficients of an impact, by its number, (n, n_columns).
        pulls, curvature = [], np.zeros(())
        for row in range(len(self.power)):
            every, precision, left, weight = self.nuisance(row)
            self.power[row] = float(np.mean(np.square(left))) * self.raised[row] ** 2
            self.left += weight * (np.square(left, dtype=np.float64) - self.raised[row] ** -2)
            jacobian = slopes(row) * self.root[row]
            cross = weight * (every @ jacobian.T).astype(np.float64)
            half = np.linalg.solve(np.linalg.cholesky(precision), cross).astype(jacobian.dtype)
            curvature = curvature + (jacobian.dtype.type(weight) * jacobian) @ jacobian.T - half.T @ half
            # Without the gradient of the force's prior: its level is unknown, and would raise all participations.
            push = np.linalg.solve(precision, weight * (every @ left).astype(np.float64))
            pulls.append(weight * (jacobian @ left).astype(np.float64) - cross.T @ push)
        return np.array(pulls), curvature

    def left_near(self, frequency: Floats) -> Floats:
        """Return the power that is left beyond the noise near each mode, (n_modes,)."""
        inversion = self.inversion
        bins = np.repeat(np.arange(inversion.bins.start, inversion.bins.stop), 2)[self.columns]
        own = bins / inversion.n_samples * self.beam.sampling_rate
        least = _NEAR_BINS / inversion.n_samples * self.beam.sampling_rate
        # Modes above the band are told by its end alone.
        frequency = np.minimum(frequency, own[-1])
        near = np.abs(own - frequency[:, None]) < np.maximum(_NEAR * frequency, least)[:, None]
        return np.asarray(near @ self.left)

    def _informative(self, responses: Floats) -> Singles:
        """Return the informative coefficients of responses."""
        return np.ascontiguousarray(self.inversion.transformed(responses)[..., self.columns])

    def _responses(self, beam: Beam) -> Floats:
        """Return the responses of the active modes of another beam."""
        return respond(beam.taken(self.active), self.inversion.forces, self.inversion.n_samples)

    def of(self, beam: Beam) -> Singles:
        """Return the table of the active modes of another beam."""
        return self._informative(self._responses(beam))

    def by_beams(self, sides: Callable[[int], tuple[Beam, Beam]], n: int, step: float) -> Callable[[int], Floats]:
        """Return the slopes of an impact in n parameters, from the beams a step above and below in each."""
        # In double precision: a poorly determined parameter is a small difference of large numbers.
        slopes = np.zeros((len(self.power), n, self.columns.size), np.float32)
        for number in range(n):
            for beam, sign in zip(sides(number), (1, -1), strict=True):
                at = beam.weights(self.inverted.x, self.inverted.y)[0]
                weights = (at[:, :, None] * self.inverted.coefficients[:, None]).reshape(len(at), -1).astype(np.float32)
                table = self.table
                if not np.array_equal(beam.poles, self.beam.poles):
                    table = self._informative(respond(beam, self.inversion.forces, self.inversion.n_samples))
                slopes[:, number] += np.float32(sign / (2 * step)) * (weights @ table.reshape(-1, self.columns.size))
        return lambda row: slopes[row].astype(np.float64)

    def level(self, row: int) -> float:
        """Return the prior variance of the coefficients of one impact."""
        return max(float(np.mean(np.square(self.inverted.coefficients[row]))), 1.0)

    def nuisance(self, row: int) -> tuple[Singles, Floats, Singles, float]:
        """Return the directions of force and location of an impact, their precision, the residual, and the weight."""
        force = self.inverted.coefficients[row]
        single = force.astype(np.float32)
        ways = np.tensordot(np.stack([at[row] for at in self.at]), self.table, 1) * self.root[row]
        ways[1:, 0] = single @ ways[1:]
        left = self.samples[row] - single @ ways[0]
        weight = 1 / max(float(np.mean(np.square(left))), 1.0)
        every = np.concatenate([ways[0], ways[1:, 0]])
        prior = np.diag(np.concatenate([np.full(force.size, 1 / self.level(row)), np.full(2, _LOCATION_DEVIATION**-2)]))
        # The level of the forces is unknown: their prior would determine the size of a beam.
        along = force / max(float(np.linalg.norm(force)), 1e-300)
        prior[:-2, :-2] -= np.outer(along, along) / self.level(row)
        exact = every.astype(np.float64)  # in single precision it might not be positive
        return every, np.asarray(weight * (exact @ exact.T) + prior), left, weight


def search_valleys(parts: Sequence[tuple[Beam, System]], now: Floats, deviation: Floats) -> Floats | None:
    """Return corrections in which some modes have moved to another local minimum; None if none improves."""
    # Each mode is tried by itself at frequencies over its prior; other modes are fixed, locations and forces adjust.
    # `parts` are the sensors: the beam without corrections, and its impacts inverted with these.
    beam, active = parts[0][0], parts[0][1].active
    ratio = beam.modes.damping_ratio[active]
    widest = min(_WIDEST * float(deviation[0].max()), _WIDEST_SHARE)
    finest = max(_FINEST * float(np.median(ratio)), widest / 60)
    shifts = np.arange(-np.ceil(widest / finest), np.ceil(widest / finest) + 1) * finest
    heard = []
    for number, (_, system) in enumerate(parts):
        for row in range(min(len(system.power), _N_SEARCHED)):
            every, precision, left, weight = system.nuisance(row)
            half = np.linalg.solve(np.linalg.cholesky(precision), np.sqrt(weight) * every).astype(np.float32)
            single = system.inverted.coefficients[row].astype(np.float32)
            at = system.at[0][row][active]
            root = system.root[row]
            present = (single @ system.table[active]) * at[:, None] * root
            own = np.exp(-now[2, active]).astype(np.float32) * at
            heard.append((number, single, own, present, left, half, weight, root))
    prior = np.maximum(deviation[:, active], 1e-9)
    at_now = -0.5 * np.sum((now[:, active] / prior) ** 2, axis=0)
    gains = np.empty((shifts.size, len(ratio)))
    for number, shift in enumerate(shifts):
        other = np.zeros_like(now)
        other[0] = shift
        tables = [system.of(corrected(own, other)) for own, system in parts]
        gain = -0.5 * (shift / prior[0]) ** 2 - at_now
        for sensor, single, at, present, left, half, weight, root in heard:
            change = present - (single @ tables[sensor]) * at[:, None] * root
            through, along = half @ change.T, half @ left
            gain -= 0.5 * weight * (2 * change @ left + np.einsum("ms,ms->m", change, change))
            gain += 0.5 * weight * (2 * along @ through + np.einsum("km,km->m", through, through))
        gains[number] = gain
    best = np.argmax(gains, axis=0)
    gain, shift = gains[best, np.arange(best.size)], shifts[best]
    frequency = np.log(beam.modes.frequency)
    moved, taken = now.copy(), np.empty(0)
    for number in np.argsort(-gain):
        mode = active[number]
        if gain[number] < _MIN_GAIN:
            break
        pair = frequency[mode] + np.array([now[0, mode], shift[number]])
        if abs(pair[1] - pair[0]) < finest or np.abs(np.subtract.outer(pair, taken)).min(initial=np.inf) < _SEPARATION:
            continue
        taken = np.append(taken, pair)
        moved[:, mode] = 0.0
        moved[0, mode] = shift[number]
    return moved if taken.size else None

"""The pulse family fitted to a force in principal shapes, such as that from the acceleration of a beam.

The information of the samples about the force is a quadratic form in some 16 coefficients
(`ForceEstimate.information`). A pulse of the family has such coefficients, too: its spectrum is a table in shape and in
frequency times width, and the projection onto the shapes is linear. So a pulse is fitted in 16 numbers, whatever the
length of the signal was.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from cgid import family
from cgid.identification.beam_responses import Observations, Rowwise
from cgid.identification.inversion import ForceEstimate, Inversion
from cgid.identification.ring_down import RingDown
from cgid.measure.ar_noise import ARNoise, ar_noise_of
from cgid.measure.beam import FINE, SPAN_TIME, TOUCH, Beam, gain
from cgid.measure.least_squares import least_squares
from cgid.measure.template import relative_times
from cgid.measure.vibration import VibrationBatch
from cgid.validation import Floats

#: Nodes of the shape s = ln e (above 0: reversed pulses) in the table of spectra; points of a pulse to its width and of
#: its transform.
_SHAPES = np.linspace(np.log(0.06), 1.2, 41)
_POINTS, _LENGTH = 96, 1 << 14
#: Smallest and largest width [s] (impulse over peak), and how far the onset may be outside its slack [samples].
_WIDTHS, _BEYOND = (25e-6, 1.6e-3), 2.0
#: Pulses of the table by ln width, shape and onset, and the stride of those tried first.
_NODES, _FIRST = (48, _SHAPES.size, 45), (2, 5, 2)
#: Number of best shapes refined in few steps, and in more steps for the best of these, by interpolation of the table;
#: the gain in log-likelihood that ends the steps.
_N_STARTS, _FEW, _MORE, _MIN_GAIN = 6, 3, 7, 1e-3
#: Minimum variance of ln peak, ln width and shape.
_MIN_VARIANCE = 1e-20
#: Prior mean and standard deviation of the shape, and of the onset [samples].
_SHAPE_PRIOR, _ONSET_PRIOR = (-0.9, 1.5), (TOUCH / 2, TOUCH / 2)
#: Rows processed at once.
_ROWS = 64
#: Maximum time of the onset before the first sample above the noise [s]: the travel time of waves.
REACH = 1.2e-3
#: Relative tolerance of equal sampling rates; with others, the band up to this fraction of the lower rate is used.
_SAME_RATE, _TOP = 1e-6, 0.41
_MAX_RATIO = 1000
#: An onset this close to the ends of the table of forces is searched this much further [samples].
_EDGE, _BESIDE = 0.35, 4
#: With more than this fraction of the energy unexplained, and a misfit above this, the onset is searched this much
#: later [samples].
_MUCH, _LATER = (0.01, 1.3), (4, 8, 12, -6, 20)
#: In a stream: median unexplained fraction of energy on a foreign beam, and number of impacts for it; number of impacts
#: that settle the filter; number that test it again, and ratio of noise that triggers this.
_FOREIGN, _RECENT, _SETTLED, _TESTS, _LOUDER = 0.05, 200, 60, 8, 4.0
#: Numbers of impacts before decisions, and the later interval between decisions.
_DECISIONS, _EVERY = (8, 16, 32), 64
#: Maximum number of channels, before and after gaps, with such a state.
_REMEMBERED = 4096
#: Maximum misfit of noise: five standard deviations of chi-square of the coefficients of a frame.
_BY_NOISE = 1.28
#: Minimum and maximum number of samples before onset to estimate ring-down.
_MIN_QUIET, _MAX_QUIET = 64, 256
#: Samples at a limit are equal within this, and are at least this many.
_SAME, _SHARED, _TOLERANCE = 1e-6, 2, 0.01
#: Minimum noise over the signal.
_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class Contact(Rowwise):
    """Fitted pulses, each row one impact."""

    peak: Floats  # (n,) [N]
    width: Floats  # (n,) [s], impulse over peak
    shape: Floats  # (n,), ln e; above 0 for a pulse that rises more slowly than it falls
    touch: Floats  # (n,), after `ForceEstimate.start` [samples]
    covariance: Floats  # (n, 3, 3), of ln peak, ln width and shape; times the misfit if that is above 1
    coefficients: Floats  # (n, n_shapes), of the fitted pulse, over the noise
    misfit: Floats  # (n,), reduced chi-square of the recovered force against the fitted pulse


@cache
def _spectra() -> NDArray[np.complex128]:
    """Return spectra (n_shapes, n_frequencies) of pulses of peak 1 and width 1, about their peak."""
    restitution = np.minimum(np.exp(-np.abs(_SHAPES)), family.MAX_RESTITUTION)
    contact, top, _ = family.times(restitution)
    height = family.force(top[:, None], restitution)[:, 0]
    width = (1 + restitution) / height
    lasts, rises = (contact / width)[:, None], (top / width)[:, None]
    backwards = _SHAPES[:, None] > 0
    time = np.arange(int(lasts.max() * _POINTS) + 1) / _POINTS
    own = np.where(backwards, lasts - time, time) * width[:, None]
    pulse = family.force(np.clip(own, 0, contact[:, None]), restitution) / height[:, None]
    spectrum = np.fft.rfft(np.where(time > lasts, 0, pulse), _LENGTH) / _POINTS
    peak = np.where(backwards, lasts - rises, rises)
    return np.asarray(spectrum * np.exp(2j * np.pi * np.fft.rfftfreq(_LENGTH, 1 / _POINTS) * peak))


class ContactFit:
    """Fit the pulse family in the principal shapes of one beam."""

    def __init__(self, inversion: Inversion) -> None:
        self.beam: Beam = inversion.beam
        self.forces = inversion.forces

    @cached_property
    def _frequencies(self) -> Floats:
        n_points = self.forces.shape[1]
        found = np.fft.rfftfreq(2 * n_points, 1 / (FINE * self.beam.sampling_rate))
        folded = np.abs(gain(self.beam.filters, found)) > 5e-3
        # Beyond half the sampling rate, too: residual energy there is folded into the samples.
        return np.asarray(found[: min(int(np.flatnonzero(folded)[-1]) + 1, found.size // 4)], np.float64)

    @cached_property
    def _projection(self) -> NDArray[np.complex128]:
        """From the spectrum of a force [N s] to its coefficients, (n_frequencies, n_shapes): the real part."""
        n_points, rate = self.forces.shape[1], FINE * self.beam.sampling_rate
        spectrum = np.fft.rfft(self.forces, 2 * n_points, axis=1)[:, : self._frequencies.size]
        inner = self.forces @ self.forces.T
        # Sum over points of force and shape, by Parseval: 2 / N, but 1 / N at frequency 0.
        share = np.full(self._frequencies.size, 2.0)
        share[0] = 1.0
        weights = spectrum.conj() * share / (2 * n_points) * rate * gain(self.beam.filters, self._frequencies)
        return np.ascontiguousarray(np.linalg.solve(inner, weights).T)

    def coefficients(self, width: Floats, shape: Floats, touch: Floats) -> tuple[Floats, Floats]:
        """Return coefficients (n, n_shapes) of pulses of peak 1 N, and slopes (n, 3, n_shapes)."""
        # The slopes are in ln width, shape and onset [s].
        spectrum, in_width, in_shape = self._spectrum(width, shape)
        turn = -2j * np.pi * self._frequencies
        phase = np.exp(turn * touch[:, None])
        spectrum *= phase
        real, imaginary = self._projection.real, self._projection.imag
        ways = (spectrum, in_width * phase, in_shape * phase, spectrum * turn)
        found = [part.real @ real - part.imag @ imaginary for part in ways]
        return found[0], np.stack(found[1:], axis=1)

    def _spectrum(self, width: Floats, shape: Floats) -> tuple[NDArray[np.complex128], ...]:
        """Return the spectra of pulses that begin at 0, and their slopes in ln width and shape, (n, n_frequencies)."""
        table, step = _spectra(), _SHAPES[1] - _SHAPES[0]
        place = (np.clip(shape, _SHAPES[0], _SHAPES[-1]) - _SHAPES[0]) / step
        node = np.clip(np.floor(place).astype(np.intp) - 1, 0, _SHAPES.size - 4)
        weight, weight_slope = _cubic(place - node).swapaxes(0, 1)
        scaled = width[:, None] * self._frequencies * (_LENGTH / _POINTS)
        index = np.minimum(scaled.astype(np.intp), table.shape[1] - 2)
        share = scaled - index
        spectrum = np.zeros(scaled.shape, complex)
        in_shape, in_frequency = np.zeros_like(spectrum), np.zeros_like(spectrum)
        for number in range(4):
            low = table[(node + number)[:, None], index]
            rise = table[(node + number)[:, None], index + 1] - low
            value = low + share * rise
            spectrum += weight[:, number : number + 1] * value
            in_shape += weight_slope[:, number : number + 1] * value
            in_frequency += weight[:, number : number + 1] * rise
        _, peak_time, _, peak_slope = relative_times(shape)
        turn = -2j * np.pi * self._frequencies
        phase = np.exp(turn * (width * peak_time)[:, None]) * width[:, None]
        spectrum *= phase
        in_shape = in_shape * phase / step + spectrum * turn * (width * peak_slope)[:, None]
        in_width = spectrum * (1 + turn * (width * peak_time)[:, None]) + in_frequency * scaled * phase
        return spectrum, in_width, in_shape

    @cached_property
    def _bank(self) -> NDArray[np.float32]:
        """Coefficients of the pulses of the table, (*_NODES, n_shapes)."""
        width, shape, touch = (np.linspace(low, high, n) for low, high, n in zip(*_LIMITS, _NODES, strict=True))
        turn = np.exp(-2j * np.pi * np.outer(self._frequencies, touch / self.beam.sampling_rate))
        later = (turn[:, :, None] * self._projection[:, None]).reshape(len(turn), -1).astype(np.complex64)
        # As in `_spectrum`, but the shapes are those of its table.
        scaled = np.exp(width)[:, None] * self._frequencies * (_LENGTH / _POINTS)
        index = np.minimum(scaled.astype(np.intp), _spectra().shape[1] - 2)
        spectrum = _spectra()[:, index]
        spectrum += (scaled - index) * (_spectra()[:, index + 1] - spectrum)
        late = np.outer(relative_times(shape)[1], np.exp(width))
        spectrum *= np.exp(-2j * np.pi * self._frequencies * late[:, :, None]) * np.exp(width)[:, None]
        spectrum = spectrum.transpose(1, 0, 2).reshape(-1, len(turn)).astype(np.complex64)
        found = spectrum.real @ later.real - spectrum.imag @ later.imag
        return np.asarray(found.reshape(*_NODES, -1))

    @cached_property
    def _tried(self) -> tuple[Floats, NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return the initial pulses, shape by shape: parameters, -ln prior, coefficients and their products."""
        sides = [
            np.linspace(low, high, n)[::every] for low, high, n, every in zip(*_LIMITS, _NODES, _FIRST, strict=True)
        ]
        likely = (sides[2] >= 0) & (sides[2] <= TOUCH)
        bank = self._bank[:: _FIRST[0], :: _FIRST[1], :: _FIRST[2]][:, :, likely].transpose(3, 1, 0, 2)
        mesh = np.meshgrid(sides[1], sides[0], sides[2][likely], indexing="ij")
        at = np.stack([mesh[1], mesh[0], mesh[2]], axis=-1).reshape(len(sides[1]), -1, 3)
        flat = np.ascontiguousarray(bank.reshape(len(bank), -1))
        first, second = np.triu_indices(len(flat))
        return at, _cost_of_prior(at).ravel().astype(np.float32), flat, flat[first] * flat[second]

    def fit(self, estimate: ForceEstimate) -> Contact:
        """Return the pulses that fit recovered forces best."""
        parts = [
            self._fit(estimate.information[rows], estimate.vector[rows])
            for rows in (slice(first, first + _ROWS) for first in range(0, max(len(estimate.vector), 1), _ROWS))
        ]
        at, peak, own, covariance = (np.concatenate(part) for part in zip(*parts, strict=True))
        spacing = estimate.coefficients - own
        misfit = np.einsum("nk,nkl,nl->n", spacing, estimate.information, spacing) / max(own.shape[1] - 4, 1)
        # True pulses are not exactly of the family, as strong impacts show; widened as by Birge (1932, Phys. Rev. 40,
        # 207).
        covariance *= np.maximum(misfit, 1.0)[:, None, None]
        return Contact(peak * estimate.noise, np.exp(at[:, 0]), at[:, 1], at[:, 2], covariance, own, misfit)

    def _fit(self, information: Floats, vector: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return ln width, shape and onset [samples]; peak over noise, coefficients, and covariance as in `Contact`."""
        starts = self._starts(information, vector)
        rows = np.repeat(np.arange(len(starts)), _N_STARTS)
        at, products = self._descended(starts.reshape(-1, 3), information[rows], vector[rows], _FEW)
        best = np.argmin(products[:, 4, 4].reshape(-1, _N_STARTS), axis=1)
        at = at.reshape(*starts.shape)[np.arange(len(starts)), best]
        at = self._descended(at, information, vector, _MORE)[0]
        peak, products = self._products(at, information, vector)
        covariance = np.linalg.inv(products[:, :4, :4])[:, :3, :3]
        # Rounding may make a variance negative if a force is far too large.
        covariance[:, range(3), range(3)] = np.maximum(covariance[:, range(3), range(3)], _MIN_VARIANCE)
        return at, peak, self.table_coefficients(at)[:, 0] * peak[:, None], np.asarray(covariance, np.float64)

    def _starts(self, information: Floats, vector: Floats) -> Floats:
        """Return the most probable pulses tried, one for each of the best shapes, (n, n_starts, 3)."""
        at, prior, bank, products = self._tried
        first, second = np.triu_indices(len(bank))
        both = np.where(first == second, 2.0, 4.0) * information[:, first, second]
        gained = np.maximum(vector.astype(np.float32) @ bank, 0)
        gained *= gained
        gained /= np.maximum(both.astype(np.float32) @ products, 1e-30)
        gained -= prior
        gained = gained.reshape(len(gained), len(at), -1)
        best = np.argmax(gained, axis=2)
        top = np.take_along_axis(gained, best[:, :, None], axis=2)[:, :, 0]
        shapes = np.argsort(-top, axis=1)[:, :_N_STARTS]
        return np.asarray(at[shapes, np.take_along_axis(best, shapes, axis=1)])

    def exact_coefficients(self, at: Floats) -> tuple[Floats, Floats]:
        """Return the coefficients of pulses of ln width, shape and onset [samples], (n, 3), and their slopes."""
        own, slopes = self.coefficients(np.exp(at[:, 0]), at[:, 1], at[:, 2] / self.beam.sampling_rate)
        slopes[:, 2] /= self.beam.sampling_rate
        return own, slopes

    def table_coefficients(self, at: Floats) -> NDArray[np.float32]:
        """Return coefficients and slopes, (n, 4, n_shapes), as `exact_coefficients` by interpolation of the table."""
        (low, high), counts = _LIMITS, np.array(_NODES)
        scale = (counts - 1) / (high - low)
        place = (at - low) * scale
        node = np.clip(place.astype(np.intp) - 1, 0, counts - 4)
        weights = _cubic((place - node).astype(np.float32))
        weights[:, :, 1] *= scale[:, None].astype(np.float32)
        # Value, and slope in each parameter: the products of the weights along the three axes.
        along, across, later = (weights[:, axis, which] for axis, which in enumerate(_IS_SLOPE))
        both = (across[:, :, :, None] * later[:, :, None]).reshape(len(at), 4, 1, 16)
        product = (along[:, :, :, None] * both).reshape(len(at), 4, 64)
        steps = np.array([counts[1] * counts[2], counts[2], 1])
        around = np.indices((4, 4, 4)).reshape(3, -1).T @ steps
        nodes = self._bank.reshape(-1, self._bank.shape[-1]).take(np.add.outer(node @ steps, around), axis=0)
        return np.asarray(product @ nodes)

    def _products(self, at: Floats, information: Floats, vector: Floats) -> tuple[Floats, Floats]:
        """Return the best peaks of pulses (n,), and products as of `least_squares`: of ln peak and the parameters."""
        ways = self.table_coefficients(at).astype(np.float64)
        along = (ways @ vector[:, :, None])[:, :, 0]
        power = ways @ information @ ways.transpose(0, 2, 1)
        peak = np.maximum(along[:, 0], 1e-12) / np.maximum(power[:, 0, 0], 1e-30)
        out = np.empty((len(at), 5, 5))
        out[:, :4, :4] = power * np.square(peak)[:, None, None]
        out[:, [1, 2, 3], [1, 2, 3]] += _PRIOR
        # Never singular, even for uninformative samples.
        out[:, range(4), range(4)] = out[:, range(4), range(4)] * (1 + 1e-9) + 1e-30
        out[:, :4, 4] = peak[:, None] * (along - peak[:, None] * power[:, 0])
        out[:, 1:4, 4] -= (at - _MIDDLE) * _PRIOR
        out[:, 4, 4] = 2 * _cost_of_prior(at) - peak * np.maximum(along[:, 0], 0.0)
        return peak, out

    def _descended(self, at: Floats, information: Floats, vector: Floats, n_steps: int) -> tuple[Floats, Floats]:
        """Return the best parameters near some, and the products there."""

        def equations(at: Floats, rows: NDArray[np.intp]) -> Floats:
            return self._products(at, information[rows], vector[rows])[1]

        def moved(at: Floats, step: Floats, _: NDArray[np.intp]) -> Floats:
            return np.clip(at + np.nan_to_num(step[:, 1:]), *_LIMITS)

        small = np.full(len(at), 2 * _MIN_GAIN)
        with np.errstate(over="ignore", invalid="ignore"):  # for uninformative samples
            return least_squares(at.copy(), equations, moved, small, n_steps)[:2]


#: Lowest and highest ln width, shape and onset [samples]; middle and precision of their prior.
_LIMITS = (
    np.array([np.log(_WIDTHS[0]), _SHAPES[0], -_BEYOND]),
    np.array([np.log(_WIDTHS[1]), _SHAPES[-1], TOUCH + _BEYOND]),
)
#: The same of ln width and shape alone.
LOWEST, HIGHEST = tuple(_LIMITS[0][:2].tolist()), tuple(_LIMITS[1][:2].tolist())
#: Powers of a position between four nodes -> weight of each, and its slope.
_POWERS = np.linalg.inv(np.vander(np.arange(4.0), increasing=True))
_POWERS = np.concatenate([_POWERS, np.arange(1, 5)[:, None] * np.roll(_POWERS, -1, axis=0)], axis=1)
_POWERS[3, 4:] = 0
#: Whether the weights of an axis (ln width, shape, onset) are slopes, in the value and in each of the three slopes.
_IS_SLOPE = np.eye(4, dtype=np.intp)[1:]
_MIDDLE, _PRIOR = np.array([0.0, _SHAPE_PRIOR[0], _ONSET_PRIOR[0]]), np.array([0, _SHAPE_PRIOR[1], _ONSET_PRIOR[1]])
_PRIOR[1:] **= -2


def _cost_of_prior(at: Floats) -> Floats:
    return np.asarray(0.5 * np.sum((at - _MIDDLE) ** 2 * _PRIOR, axis=-1))


def _cubic(place: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the weights of nodes 0 to 3 at positions, and their slopes, (..., 2, 4)."""
    square = place * place
    powers = np.stack([np.ones_like(place), place, square, square * place], axis=-1)
    return (powers @ _POWERS.astype(place.dtype)).reshape(*place.shape, 2, 4)


def clipped_samples(frames: Floats, shared: int = _SHARED) -> NDArray[np.bool_] | None:
    """Return which samples (n, n_samples) are at the limit of their recorder; None if there are none."""
    # A limit is a value that `shared` samples have in common at the top or the bottom, at least half as far out as the
    # other side; the other side is then limited as far out, even where one sample reaches it.
    high, low = frames.max(axis=1), frames.min(axis=1)
    out = np.zeros(frames.shape, bool)
    beyond = np.zeros(len(frames), bool)
    for extreme, other in ((high, low), (low, high), (high, low)):
        at = np.abs(frames - extreme[:, None]) <= _SAME * np.abs(extreme)[:, None]
        limit = (at.sum(axis=1) >= shared) & (np.abs(extreme) >= 0.5 * np.abs(other)) & (high > low)
        limit |= beyond & (np.abs(extreme + other) <= _TOLERANCE * np.abs(extreme))
        beyond |= limit
        out |= at & limit[:, None]
    return out if out.any() else None


# -- from vibrations to features ------------------------------------------------------------------------------


class ThroughBeam:
    """Features of the contact force from vibrations of a beam."""

    # Rows of one impact follow in the order of the sensors. A recorder with another sampling rate is assumed to have
    # the same anti-alias filter, at the same fraction of its rate or, if it is faster, at the same frequency: whichever
    # force is more like a pulse.

    def __init__(self, beam: Beam) -> None:
        self.beam = beam
        self.inversion = Inversion(beam)
        self.fit = ContactFit(self.inversion)
        self._ring_down: dict[tuple[int, int], RingDown] = {}

    @property
    def n_sensors(self) -> int:
        """Number of sensors, and of vibrations of one impact."""
        return self.beam.n_sensors

    def stream(self) -> BeamStream:
        """Return the same for impacts that follow each other in a stream."""
        return BeamStream(self)

    def measured(self, vibrations: VibrationBatch) -> dict[str, Floats]:
        """Return the features of the contact forces of vibrations by name, nan where there is no impact."""
        return self.features(vibrations, *self.look(vibrations))

    def features(self, vibrations: VibrationBatch, estimate: ForceEstimate, contact: Contact) -> dict[str, Floats]:
        """Return the features of vibrations by name, from their estimates."""
        deviation = np.sqrt(contact.covariance[:, range(3), range(3)])
        correlation = np.clip(contact.covariance / (deviation[:, :, None] * deviation[:, None]), -1.0, 1.0)
        # Subtract what noise and earlier vibration can explain.
        surely = np.maximum(estimate.misfit - _BY_NOISE, 0.0) / np.maximum(estimate.misfit - 1, 1e-9)
        event = vibrations.event[:, : round(SPAN_TIME * vibrations.sampling_rate)]
        before = np.square(self._loudest(vibrations.noise)) * event.shape[1]
        energy = np.maximum(self._loudest(np.sum(np.square(event), axis=1)), 1e-300)
        surely = np.maximum(estimate.unexplained * surely - before / energy, 0.0)
        return {
            "beam_peak_force": contact.peak,
            "beam_pulse_width": contact.width,
            "beam_restitution": np.exp(contact.shape),
            "beam_peak_force_deviation": deviation[:, 0],
            "beam_pulse_width_deviation": deviation[:, 1],
            "beam_restitution_deviation": deviation[:, 2],
            "beam_peak_width_correlation": correlation[:, 0, 1],
            "beam_peak_restitution_correlation": correlation[:, 0, 2],
            "beam_width_restitution_correlation": correlation[:, 1, 2],
            "beam_impact_x": estimate.x,
            "beam_impact_y": estimate.y,
            "beam_place_deviation": np.hypot(*estimate.place_deviation.T),
            "beam_misfit": estimate.misfit,
            "beam_unexplained": 100 * estimate.unexplained,
            "beam_surely_unexplained": 100 * surely,
        }

    def _loudest(self, values: Floats) -> Floats:
        """Return the largest value of the sensors of each impact."""
        return np.asarray(values.reshape(-1, self.n_sensors).max(axis=1))

    def look(self, vibrations: VibrationBatch) -> tuple[ForceEstimate, Contact]:
        """Return the forces behind vibrations at any sampling rate, and the pulses fitted to them."""
        n = len(vibrations.samples) // self.n_sensors
        return self.at_other_filter(vibrations, np.ones((n, 2), bool), np.ones(n, bool))[:2]

    def at_other_filter(
        self, vibrations: VibrationBatch, filters: NDArray[np.bool_], again: NDArray[np.bool_]
    ) -> tuple[ForceEstimate, Contact, Floats]:
        """Return force, pulse, and misfit of each filter (n, 2), infinite if not tried; `again` tries other onsets."""
        rate, own = vibrations.sampling_rate, self.beam.sampling_rate
        if not rate > own * (1 + _SAME_RATE):
            filters = np.broadcast_to([True, False], filters.shape)
        rows = [np.flatnonzero(column) for column in filters.T]
        parts = [
            self._estimated(vibrations, ratio, part, again[part])
            for ratio, part in zip((rate / own, 1.0), rows, strict=True)
            if part.size or not filters.size
        ]
        estimates, contacts = zip(*parts, strict=True)
        estimate, contact = ForceEstimate.joined(list(estimates)), Contact.joined(list(contacts))
        # A wrong filter distorts the force rather than leaving a residual: the pulse fits it worse.
        misfit = np.full(filters.shape, np.inf)
        misfit.T[filters.T] = contact.misfit
        place = np.cumsum(filters.T).reshape(filters.T.shape).T - 1
        best = place[np.arange(len(filters)), misfit.argmin(axis=1)]
        return estimate.rows(best), contact.rows(best), misfit

    def _estimated(
        self, vibrations: VibrationBatch, filters: float, rows: NDArray[np.intp], again: NDArray[np.bool_]
    ) -> tuple[ForceEstimate, Contact]:
        """Return the same for some rows and an anti-alias filter at another ratio to that of the beam."""
        observations, onset = self._prepared(vibrations, filters, rows)
        estimate = self.inversion.invert(observations, onset)
        contact = self.fit.fit(estimate)
        # If the onset is at the edge of the table of forces, search there, at the same location. If it is too early,
        # much stays unexplained: compare others.
        edge = np.where(contact.touch < _EDGE, -_BESIDE, np.where(contact.touch > TOUCH - _EDGE, _BESIDE, 0))
        start = estimate.later(edge)
        lost = np.flatnonzero(again & (estimate.unexplained > _MUCH[0]) & (estimate.misfit > _MUCH[1]))
        if lost.size:
            others = np.add.outer(start.first[lost] + TOUCH // 2, (0, *_LATER))
            start = start.replaced(lost, self.inversion.compare(observations.rows(lost), others))
        rows = np.flatnonzero(again & (start.first != estimate.start))
        if rows.size:
            other = self.inversion.refine(observations.rows(rows), start.rows(rows))
            before = self._before(observations.rows(rows), estimate.start[rows], other.start)
            better = np.flatnonzero(other.misfit + before < estimate.misfit[rows])
            if better.size:
                estimate = estimate.replaced(rows[better], other.rows(better))
                contact = contact.replaced(rows[better], self.fit.fit(other.rows(better)))
        return estimate, contact

    def _before(self, observations: Observations, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
        """Return the energy outside a window that begins at the last sample, in units of the total misfit, (n,)."""
        columns = np.arange(min(observations.frames.shape[2], int(last.max(initial=0))))
        out = (columns >= first[:, None]) & (columns < last[:, None])
        power = np.square(observations.frames[:, :, : columns.size] / observations.noise[:, :, None])
        return np.asarray(np.sum(power, axis=(1, 2), where=out[:, None]) / (self.n_sensors * self.beam.n_samples))

    def _prepared(
        self, vibrations: VibrationBatch, filters: float, rows: NDArray[np.intp]
    ) -> tuple[Observations, NDArray[np.intp]]:
        """Return what the inversion needs of some impacts, and where the onset may lie."""
        if rows.size < len(vibrations.samples) // self.n_sensors:
            vibrations = vibrations.rows(np.add.outer(rows * self.n_sensors, np.arange(self.n_sensors)).ravel())
        frames = vibrations.samples - vibrations.offset[:, None]
        rate, own = vibrations.sampling_rate, self.beam.sampling_rate
        quiet = vibrations.n_quiet.astype(np.float64)
        first = vibrations.first.astype(np.float64)
        limit = None
        if abs(rate / own - 1) > _SAME_RATE:
            frames = self.resampled(frames, rate, filters)
            quiet, first = quiet * own / rate, first * own / rate
            limit = _TOP * min(rate, own)
        clear = self._clearest(vibrations)
        start = np.stack(
            [np.maximum(np.floor(first - REACH * own), np.floor(quiet))[clear], np.ceil(first)[clear] + 1], axis=1
        )
        start[:, 0] = np.minimum(start[:, 0], start[:, 1])
        noise = self._noise(frames, quiet, vibrations, limit)
        found = Observations(frames, noise, limit=limit)
        if limit is None:
            colour = ar_noise_of(frames, quiet, np.zeros(len(frames)), 1)
            clipped = clipped_samples(frames)
            frames, noise, error = self._settled(frames, quiet.astype(np.intp), noise, colour)
            found = Observations(frames, noise, colour.coefficients, colour.innovation, error, clipped)
        return self._together(found, vibrations), start.astype(np.intp)

    def _clearest(self, vibrations: VibrationBatch) -> NDArray[np.intp]:
        """Return the row of each impact whose sensor measures it best, (n,)."""
        if self.n_sensors == 1:
            return np.arange(len(vibrations.samples))
        clear = vibrations.peak / np.maximum(vibrations.noise, 1e-300)
        best = np.argmax(clear.reshape(-1, self.n_sensors), axis=1)
        return np.asarray(np.arange(best.size) * self.n_sensors + best)

    def _together(self, found: Observations, vibrations: VibrationBatch) -> Observations:
        """Return rows of vibrations as impacts; a sensor without an impact is uninformative."""
        if self.n_sensors == 1:
            return found.by_sensor()
        silent = np.zeros(len(found.noise), bool)
        silent[list(vibrations.problems())] = True
        silent &= ~np.repeat(silent.reshape(-1, self.n_sensors).all(axis=1), self.n_sensors)
        found.noise[silent] = np.inf
        if found.coefficients is not None:
            found.coefficients[silent] = 0.0
        return found.changed(lambda array: array.reshape(-1, self.n_sensors, *array.shape[1:]))

    def _settled(
        self, frames: Floats, quiet: NDArray[np.intp], noise: Floats, colour: ARNoise
    ) -> tuple[Floats, Floats, Floats | None]:
        """Return frames without ring-down of earlier impacts, the noise, and the error power of the ring-down."""
        rows = colour.rows[quiet[colour.rows] >= _MIN_QUIET]
        if not rows.size:
            return frames, noise, None
        frames, noise, error = frames.copy(), noise.copy(), None
        lengths, sensors = np.minimum(quiet[rows], _MAX_QUIET) // 32 * 32, rows % self.n_sensors
        for n_quiet, sensor in sorted(set(zip(lengths.tolist(), sensors.tolist(), strict=True))):
            if (n_quiet, sensor) not in self._ring_down:
                self._ring_down[n_quiet, sensor] = RingDown(self.inversion, n_quiet, sensor)
            ring_down, own = self._ring_down[n_quiet, sensor], rows[(lengths == n_quiet) & (sensors == sensor)]
            before = np.stack([frames[row, quiet[row] - n_quiet : quiet[row]] for row in own])
            found, level, own_error, rings = ring_down.after(before, colour.innovation[own])
            error = np.zeros((len(frames), own_error.shape[1])) if error is None else error
            for number in np.flatnonzero(rings).tolist():
                part = frames[own[number], quiet[own[number]] : quiet[own[number]] + ring_down.n_samples]
                part -= found[number, : part.size]
            colour.coefficients[own[rings]] = 0.0
            noise[own[rings]], error[own[rings]] = level[rings], own_error[rings]
        return frames, noise, error

    def _noise(self, frames: Floats, quiet: Floats, vibrations: VibrationBatch, limit: float | None) -> Floats:
        """Return the standard deviation of white noise as loud as that before onset in the band up to `limit`."""
        if limit is None:
            found = vibrations.noise
        else:
            before = np.arange(frames.shape[1]) < quiet[:, None]
            power = np.sum(np.square(frames), axis=1, where=before) / np.maximum(quiet, 1)
            found = np.sqrt(power * self.beam.sampling_rate / 2 / limit)
        # Without noise: the accuracy of a table of the beam.
        return np.asarray(np.maximum(found, _FLOOR * np.sqrt(np.mean(np.square(frames), axis=1)) + 1e-300))

    def resampled(self, frames: Floats, rate: float, filters: float) -> Floats:
        """Return frames at the rate of the beam, with its filters instead of those at `filters` times the frequency."""
        own = self.beam.sampling_rate
        ratio = Fraction(own / rate).limit_denominator(_MAX_RATIO)
        n = -(-frames.shape[1] // ratio.denominator) * ratio.denominator
        n_out = n * ratio.numerator // ratio.denominator
        spectrum = np.fft.rfft(frames, n, axis=1)
        frequency = np.fft.rfftfreq(n, 1 / rate)
        inside = frequency <= _TOP * min(rate, own)
        low_pass = np.abs(self.beam.filters) < np.pi * own
        recorder_gain = np.where(low_pass, self.beam.filters * filters, self.beam.filters)
        change = np.where(inside, gain(self.beam.filters, frequency) / gain(recorder_gain, frequency), 0.0)
        out = np.zeros((len(frames), n_out // 2 + 1), complex)
        kept = min(out.shape[1], spectrum.shape[1])
        out[:, :kept] = (spectrum * change)[:, :kept]
        return np.asarray(np.fft.irfft(out, n_out, axis=1) * (n_out / n))[:, : int(frames.shape[1] * own / rate)]


class _Channel:
    """State of a channel from its impacts, which determines the fit of the next ones."""

    # Decisions are made after fixed numbers of impacts, so they do not depend on the batches.

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset the state."""
        self.n, self.n_tests, self.lost, self.level = 0, 0, 0, 0.0
        self.unexplained: deque[float] = deque(maxlen=_RECENT)
        self.ratios: list[float] = []
        self.levels: list[float] = []
        self.filters, self.again = np.ones(2, bool), True

    @property
    def n_next(self) -> int:
        """Number of impacts up to the next decision."""
        return next((n for n in _DECISIONS if n > self.n), (self.n // _EVERY + 1) * _EVERY) - self.n

    def plan(self, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the filters to try (n, 2) for the next impacts, and whether to try other samples of onset, (n,)."""
        tests = np.arange(n) < self.n_tests
        self.n_tests = max(self.n_tests - n, 0)
        return tests[:, None] | self.filters, tests | self.again

    def learn(self, unexplained: Floats, misfit: Floats, level: Floats) -> None:
        """Add the unexplained energy of the next impacts, their misfits for both filters (n, 2), and their noise."""
        decides = self.n_next == len(level)
        self.n += len(level)
        self.unexplained.extend(unexplained.tolist())
        self.levels.extend(level.tolist())
        for one in (unexplained > _FOREIGN).tolist():
            self.lost = max(self.lost + (1 if one else -1), 0)
        both = misfit[np.isfinite(misfit).all(axis=1)]
        self.ratios.extend(np.log(np.maximum(both, 1e-300)) @ (1.0, -1.0))
        if not decides:
            return
        before, self.level, self.levels = self.level, float(np.median(self.levels)), []
        if before and not 1 / _LOUDER < self.level / before < _LOUDER:
            self.reset()
            return
        self.again = bool(np.median(self.unexplained) <= _FOREIGN)
        if self.n >= _SETTLED and self.ratios:
            beams = bool(np.median(self.ratios) > 0)
            self.filters = np.array([not beams, beams])
        if self.lost >= _SETTLED:
            self.lost, self.n_tests, self.ratios = 0, _TESTS, []


class BeamStream:
    """State of each channel of a stream, so that not every impact tries all filters and onsets."""

    # On a foreign beam another onset is no better, and a recorder has one filter. Both are tried again after a gap, a
    # change of level, or as many unexplained impacts as settled them.

    def __init__(self, through: ThroughBeam) -> None:
        self.through = through
        self._channels: dict[int, _Channel] = {}

    @property
    def n_sensors(self) -> int:
        """Number of sensors, and of vibrations of one impact."""
        return self.through.n_sensors

    def measured(self, vibrations: VibrationBatch) -> dict[str, Floats]:
        """Return the features of the next vibrations of a stream, as `ThroughBeam.measured`."""
        n_sensors = self.n_sensors
        rest = np.arange(len(vibrations.samples) // n_sensors)
        channel = np.zeros(rest.size, np.intp) if vibrations.channel is None else vibrations.channel
        parts, found = [], []
        for old in list(self._channels)[:-_REMEMBERED]:  # before gaps
            del self._channels[old]
        while rest.size:
            numbers = np.unique(channel[rest]).tolist()
            states = [self._channels.pop(number, _Channel()) for number in numbers]
            self._channels |= zip(numbers, states, strict=True)
            rows = [rest[channel[rest] == k][: state.n_next] for k, state in zip(numbers, states, strict=True)]
            plans = [state.plan(own.size) for state, own in zip(states, rows, strict=True)]
            of_all = np.concatenate(rows)
            order = np.argsort(of_all)
            parts.append(of_all[order])
            part = vibrations.rows(np.add.outer(parts[-1] * n_sensors, np.arange(n_sensors)).ravel())
            filters, again = (np.concatenate(one)[order] for one in zip(*plans, strict=True))
            estimate, contact, misfit = self.through.at_other_filter(part, filters, again)
            found.append(self.through.features(part, estimate, contact))
            for state, own in zip(states, rows, strict=True):
                own = np.searchsorted(parts[-1], own)
                state.learn(estimate.unexplained[own], misfit[own], estimate.noise[own])
            rest = np.setdiff1d(rest, parts[-1])
        order = np.argsort(np.concatenate(parts))
        return {name: np.concatenate([one[name] for one in found])[order] for name in found[0]}

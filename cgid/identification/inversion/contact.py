"""The pulse family fitted to a force in principal shapes, such as that from the acceleration of a beam.

The information of the samples about the force is a quadratic form in some 16 coefficients
(`ForceEstimate.information`). A pulse of the family has such coefficients, too: its spectrum is a table in shape and in
frequency times width, and the projection onto the shapes is linear. So a pulse is fitted in 16 numbers, whatever the
length of the signal was.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.beam_responses import Rowwise
from cgid.identification.inversion.inversion import ForceEstimate, Inversion
from cgid.measure.fit import family
from cgid.measure.fit.least_squares import least_squares
from cgid.measure.fit.template import relative_times
from cgid.measure.modal.beam import FINE, TOUCH, Beam

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
_ROWS = 256
#: A wrong filter bends short pulses; longer ones [samples] contain echoes of the beam.
_SHORT = 5.0
#: With more than this median share outside of the pulse family, forces are not those of contacts.
MISSHAPEN = 0.03


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
    outside: Floats  # (n,), amplitude of the recovered force beyond pulse and noise, over the pulse's; nan if long


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
    """Fit the pulse family in the principal shapes of one beam, or in the same shapes with the chain of another."""

    def __init__(self, inversion: Inversion, behind: Beam | None = None) -> None:
        self.beam = inversion.beam if behind is None else behind
        self.forces = inversion.forces
        self._kept = inversion.kept if behind is None else lambda _, make: make()

    @cached_property
    def _frequencies(self) -> Floats:
        n_points = self.forces.shape[1]
        found = np.fft.rfftfreq(2 * n_points, 1 / (FINE * self.beam.sampling_rate))
        folded = np.abs(self.beam.gain(found)) > 5e-3
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
        weights = spectrum.conj() * share / (2 * n_points) * rate * self.beam.gain(self._frequencies)
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
        _, peak_time, _, peak_slope, *_ = relative_times(shape)
        turn = -2j * np.pi * self._frequencies
        phase = np.exp(turn * (width * peak_time)[:, None]) * width[:, None]
        spectrum *= phase
        in_shape = in_shape * phase / step + spectrum * turn * (width * peak_slope)[:, None]
        in_width = spectrum * (1 + turn * (width * peak_time)[:, None]) + in_frequency * scaled * phase
        return spectrum, in_width, in_shape

    @cached_property
    def _bank(self) -> NDArray[np.float32]:
        """Coefficients of the pulses of the table, (*_NODES, n_shapes)."""
        return np.asarray(self._kept("bank", lambda: [self._made_bank()])[0])

    def _made_bank(self) -> NDArray[np.float32]:
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
        left, of_pulse = (np.einsum("nk,nkl,nl->n", one, estimate.information, one) for one in (spacing, own))
        n_free = max(own.shape[1] - 4, 1)
        misfit = left / n_free
        outside = np.sqrt(np.maximum(left - n_free, 0) / np.maximum(of_pulse, 1e-300))
        outside[np.exp(at[:, 0]) > _SHORT / self.beam.sampling_rate] = np.nan
        # True pulses are not exactly of the family, as strong impacts show; widened as by Birge (1932, Phys. Rev. 40,
        # 207).
        covariance *= np.maximum(misfit, 1.0)[:, None, None]
        return Contact(peak * estimate.noise, np.exp(at[:, 0]), at[:, 1], at[:, 2], covariance, own, misfit, outside)

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
        with np.errstate(over="ignore"):  # a beam that hardly responds, as a damaged model may have
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


def _cubic(position: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the weights of nodes 0 to 3 at positions, and their slopes, (..., 2, 4)."""
    square = position * position
    powers = np.stack([np.ones_like(position), position, square, square * position], axis=-1)
    return (powers @ _POWERS.astype(position.dtype)).reshape(*position.shape, 2, 4)

"""The pulse family fitted to a force that is known in principal shapes, as from the acceleration of a beam.

The samples tell of the force no more than a quadratic form in some 16 coefficients (`Inverted.information`). A pulse of
the family has such coefficients, too: its spectrum is a table in shape and in frequency times width, and the projection
onto the shapes is linear. So a pulse is fitted in 16 numbers, whatever the length of the signal was.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from cgid import family
from cgid.identification.inversion import Inversion, Inverted, Ringing, Rowwise, Sought
from cgid.measure.beam import FINE, TOUCH, Beam, gain
from cgid.measure.colour import Colour, colour_of
from cgid.measure.template import relative_times
from cgid.measure.vibration import VibrationBatch
from cgid.validation import Floats

#: Nodes of the shape s = ln e (above 0: reversed pulses), and points of a pulse of width 1 to that width.
_SHAPES = np.linspace(np.log(0.06), 1.2, 21)
_POINTS, _LENGTH = 96, 1 << 15
#: Widths [s] (impulse over peak), shapes and touches [samples] of the pulses tried first.
_WIDTHS, _TRIED = np.geomspace(25e-6, 1.6e-3, 48), np.linspace(np.log(0.08), 1.0, 9)
_TOUCHES = np.arange(0.25, TOUCH, 0.5)
#: Prior mean and deviation of the shape, and of the touch [samples].
_SHAPE_PRIOR, _TOUCH_PRIOR = (-0.9, 1.5), (TOUCH / 2, TOUCH / 2)
#: Levenberg-Marquardt steps.
_STEPS = 8
#: Touch lies at most so long before the first sample that rises above the noise [s]: waves take that long.
REACH = 1.2e-3
#: Recorders within this share have the same sampling rate; of others the band up to this share of the lower rate tells.
_SAME_RATE, _TOP = 1e-6, 0.41
_LARGEST_RATIO = 1000
#: A touch within this of the ends of the table of forces is sought so much further on [samples].
_EDGE, _BESIDE = 0.35, 4
#: Samples before touch that show ringing: fewest and most.
_FEWEST_QUIET, _MOST_QUIET = 64, 256
#: Samples at a limit share their value within this, and are at least so many.
_SAME, _SHARED = 1e-6, 3
#: Least noise over the signal.
_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class Contact(Rowwise):
    """Fitted pulses, each row one blow.

    Attributes
    ----------
    peak : ndarray, (n,) [N]
    width : ndarray, (n,) [s]
        Impulse over peak.
    shape : ndarray, (n,)
        ln e, above 0 for a pulse that rises more slowly than it falls.
    touch : ndarray, (n,)
        After `Inverted.start` [samples].
    covariance : ndarray, (n, 3, 3)
        Of ln peak, ln width and shape.
    coefficients : ndarray, (n, n_shapes)
        Of the fitted pulse, over the noise.
    misfit : ndarray, (n,)
        Distance of the recovered force from the fitted pulse, in its own deviations, squared, over the degrees of
        freedom.
    """

    peak: Floats
    width: Floats
    shape: Floats
    touch: Floats
    covariance: Floats
    coefficients: Floats
    misfit: Floats


@cache
def _spectra() -> NDArray[np.complex128]:
    """Return the spectrum of pulses of peak 1 and width 1 about their peak, (n_shapes, n_frequencies).

    Frequencies are multiples of `_POINTS / _LENGTH` over the width.
    """
    out = np.empty((_SHAPES.size, _LENGTH // 2 + 1), complex)
    for row, shape in enumerate(_SHAPES.tolist()):
        restitution = np.array([min(np.exp(-abs(shape)), family.HIGHEST_RESTITUTION)])
        contact, top, _ = (float(one[0]) for one in family.times(restitution))
        height = float(family.force(np.array([[top]]), restitution)[0, 0])
        width = (1 + restitution[0]) / height
        lasts, rises = contact / width, top / width
        if shape > 0:
            rises = lasts - rises
        inside = np.arange(int(lasts * _POINTS) + 1) / _POINTS
        own = lasts - inside if shape > 0 else inside
        pulse = family.force(np.clip(own * width, 0, contact)[None], restitution)[0] / height
        padded = np.zeros(_LENGTH)
        padded[: inside.size] = pulse
        out[row] = np.fft.rfft(padded) / _POINTS
        out[row] *= np.exp(2j * np.pi * np.fft.rfftfreq(_LENGTH, 1 / _POINTS) * rises)
    return out


class ContactFit:
    """The pulse family in the principal shapes of one beam.

    Parameters
    ----------
    inversion : Inversion
    """

    def __init__(self, inversion: Inversion) -> None:
        self.beam: Beam = inversion.beam
        self.forces = inversion.forces

    @cached_property
    def _frequencies(self) -> Floats:
        n_points = self.forces.shape[1]
        found = np.fft.rfftfreq(2 * n_points, 1 / (FINE * self.beam.sampling_rate))
        heard = np.abs(gain(self.beam.filters, found)) > 1e-3
        return np.asarray(found[: min(int(np.flatnonzero(heard)[-1]) + 1, found.size // FINE)], np.float64)

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
        """Return the coefficients of pulses of peak 1 N, (n, n_shapes), and their slopes, (n, 3, n_shapes).

        Parameters
        ----------
        width : ndarray, (n,) [s]
        shape : ndarray, (n,)
        touch : ndarray, (n,) [s]
            After the start of the table of forces.

        The slopes are in ln width, shape and touch.
        """
        table, step = _spectra(), _SHAPES[1] - _SHAPES[0]
        place = (np.clip(shape, _SHAPES[0], _SHAPES[-1]) - _SHAPES[0]) / step
        node = np.clip(np.floor(place).astype(np.intp) - 1, 0, _SHAPES.size - 4)
        weight, weight_slope = _cubic(place - node)
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
        phase = np.exp(turn * (touch + width * peak_time)[:, None]) * width[:, None]
        spectrum *= phase
        in_shape = in_shape * phase / step + spectrum * turn * (width * peak_slope)[:, None]
        in_width = spectrum * (1 + turn * (width * peak_time)[:, None]) + in_frequency * scaled * phase
        real, imaginary = self._projection.real, self._projection.imag
        found = [part.real @ real - part.imag @ imaginary for part in (spectrum, in_width, in_shape, spectrum * turn)]
        return found[0], np.stack(found[1:], axis=1)

    @cached_property
    def _bank(self) -> tuple[Floats, NDArray[np.float32]]:
        """Parameters (n, 3) and coefficients (n, n_shapes) of the pulses tried first."""
        mesh = np.meshgrid(_WIDTHS, _TRIED, _TOUCHES / self.beam.sampling_rate, indexing="ij")
        tried = np.stack([side.ravel() for side in mesh], axis=1)
        return tried, self.coefficients(*tried.T)[0].astype(np.float32)

    def fit(self, inverted: Inverted) -> Contact:
        """Return the pulses that agree best with recovered forces."""
        tried, bank = self._bank
        information, vector = inverted.information, inverted.vector
        n = len(vector)
        along = vector.astype(np.float32) @ bank.T
        first = np.empty(n, np.intp)
        for row in range(n):
            size = np.einsum("jk,jk->j", bank @ information[row].astype(np.float32), bank)
            told = np.where(along[row] > 0, np.square(along[row]) / np.maximum(size, 1e-30), 0.0)
            first[row] = np.argmax(told)
        scale = np.array([1.0, 1.0, 1 / self.beam.sampling_rate])
        lowest = np.array([np.log(_WIDTHS[0]), _SHAPES[0], -2.0])
        highest = np.array([np.log(_WIDTHS[-1]), _SHAPES[-1], TOUCH + 2.0])
        at = np.stack([np.log(tried[first, 0]), tried[first, 1], tried[first, 2] / scale[2]], axis=1)
        middle = np.array([0.0, _SHAPE_PRIOR[0], _TOUCH_PRIOR[0]])
        prior = np.array([0.0, _SHAPE_PRIOR[1] ** -2, _TOUCH_PRIOR[1] ** -2])

        def look(at: Floats) -> tuple[Floats, Floats, Floats, Floats]:
            own, slopes = self.coefficients(np.exp(at[:, 0]), at[:, 1], at[:, 2] * scale[2])
            slopes = slopes * scale[None, :, None]
            size = np.einsum("nk,nkl,nl->n", own, information, own)
            told = np.einsum("nk,nk->n", own, vector)
            peak = np.maximum(told, 1e-12) / np.maximum(size, 1e-30)
            cost = -0.5 * peak * np.maximum(told, 0.0) + 0.5 * np.sum((at - middle) ** 2 * prior, axis=1)
            ways = np.concatenate([own[:, None], slopes], axis=1) * peak[:, None, None]
            return ways, peak, cost, own * peak[:, None]

        ways, peak, cost, own = look(at)
        damping = np.full(n, 1e-3)
        for _ in range(_STEPS):
            left = vector - np.einsum("nkl,nl->nk", information, own)
            pull = np.einsum("npk,nk->np", ways, left)
            pull[:, 1:] -= (at - middle) * prior
            curvature = self._curvature(ways, information, prior)
            raised = curvature.copy()
            raised[:, range(4), range(4)] *= 1 + damping[:, None]
            move = np.linalg.solve(raised, pull[:, :, None])[:, 1:, 0]
            other = np.clip(at + move, lowest, highest)
            new = look(other)
            better = new[2] <= cost
            at = np.where(better[:, None], other, at)
            ways = np.where(better[:, None, None], new[0], ways)
            peak, cost = np.where(better, new[1], peak), np.where(better, new[2], cost)
            own = np.where(better[:, None], new[3], own)
            damping = np.where(better, 0.2 * damping, 8 * damping)
        covariance = np.linalg.inv(self._curvature(ways, information, prior))[:, :3, :3]
        apart = inverted.coefficients - own
        misfit = np.einsum("nk,nkl,nl->n", apart, information, apart) / max(own.shape[1] - 4, 1)
        return Contact(peak * inverted.noise, np.exp(at[:, 0]), at[:, 1], at[:, 2], np.asarray(covariance), own, misfit)

    @staticmethod
    def _curvature(ways: Floats, information: Floats, prior: Floats) -> Floats:
        found = ways @ information @ ways.transpose(0, 2, 1)
        found[:, [1, 2, 3], [1, 2, 3]] += prior
        found[:, range(4), range(4)] *= 1 + 1e-9
        return np.asarray(found)


def _cubic(place: Floats) -> tuple[Floats, Floats]:
    """Return the weights of four nodes at places from node 0 (n,), and their slopes, each (n, 4)."""
    weights, slopes = np.empty((place.size, 4)), np.empty((place.size, 4))
    for node in range(4):
        others = [other for other in range(4) if other != node]
        a, b, c = (place - other for other in others)
        size = np.prod([float(node - other) for other in others])
        weights[:, node], slopes[:, node] = a * b * c / size, (a * b + a * c + b * c) / size
    return weights, slopes


def clipped_samples(frames: Floats) -> NDArray[np.bool_] | None:
    """Return which samples (n, n_samples) are at the limit of their recorder; None if there are none.

    A limit is a value that three samples share at the top or the bottom, at least half as far out as the other side.
    """
    high, low = frames.max(axis=1), frames.min(axis=1)
    out = np.zeros(frames.shape, bool)
    for extreme, other in ((high, low), (low, high)):
        at = np.abs(frames - extreme[:, None]) <= _SAME * np.abs(extreme)[:, None]
        limit = (at.sum(axis=1) >= _SHARED) & (np.abs(extreme) >= 0.5 * np.abs(other))
        out |= at & limit[:, None]
    return out if out.any() else None


# -- from vibrations to features ------------------------------------------------------------------------------


class ThroughBeam:
    """A beam to look through: from vibrations to features of the contact force.

    A recorder with another sampling rate is supposed to have the same anti-alias filter at the same share of its rate.

    Parameters
    ----------
    beam : Beam
    """

    def __init__(self, beam: Beam) -> None:
        self.beam = beam
        self.inversion = Inversion(beam)
        self.fit = ContactFit(self.inversion)
        self._ringing: dict[int, Ringing] = {}

    def measured(self, vibrations: VibrationBatch) -> dict[str, Floats]:
        """Return the features of the contact forces of vibrations by name, nan where there is no impact."""
        inverted, contact = self.look(vibrations)
        deviation = np.sqrt(contact.covariance[:, range(3), range(3)])
        correlation = contact.covariance / (deviation[:, :, None] * deviation[:, None])
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
            "beam_impact_x": inverted.x,
            "beam_impact_y": inverted.y,
            "beam_place_deviation": np.hypot(*inverted.place_deviation.T),
            "beam_misfit": inverted.misfit,
            "beam_unexplained": 100 * inverted.unexplained,
        }

    def look(self, vibrations: VibrationBatch) -> tuple[Inverted, Contact]:
        """Return the forces behind vibrations at any sampling rate, and the pulses fitted to them."""
        sought, start = self._prepared(vibrations)
        inverted = self.inversion.invert(sought, start)
        contact = self.fit.fit(inverted)
        # Where touch lies at the edge of the table of forces, look there.
        edge = np.where(contact.touch < _EDGE, -_BESIDE, np.where(contact.touch > TOUCH - _EDGE, _BESIDE, 0))
        rows = np.flatnonzero(edge)
        if rows.size:
            begun = inverted.start[rows] + edge[rows] + TOUCH // 2
            other = self.inversion.invert(sought.rows(rows), np.stack([begun, begun], axis=1))
            better = np.flatnonzero(other.misfit < inverted.misfit[rows])
            inverted = inverted.replaced(rows[better], other.rows(better))
            contact = contact.replaced(rows[better], self.fit.fit(other.rows(better)))
        return inverted, contact

    def _prepared(self, vibrations: VibrationBatch) -> tuple[Sought, NDArray[np.intp]]:
        """Return what the inversion needs of vibrations, and where touch may lie."""
        frames = vibrations.samples - vibrations.offset[:, None]
        rate, own = vibrations.sampling_rate, self.beam.sampling_rate
        quiet = vibrations.n_quiet.astype(np.float64)
        first = vibrations.first.astype(np.float64)
        limit = None
        if abs(rate / own - 1) > _SAME_RATE:
            frames = self.resampled(frames, rate)
            quiet, first = quiet * own / rate, first * own / rate
            limit = _TOP * min(rate, own)
        start = np.stack([np.maximum(np.floor(first - REACH * own), np.floor(quiet)), np.ceil(first) + 1], axis=1)
        start[:, 0] = np.minimum(start[:, 0], start[:, 1])
        noise = self._noise(frames, quiet, vibrations, limit)
        if limit is not None:
            return Sought(frames, noise, limit=limit), start.astype(np.intp)
        colour = colour_of(frames, quiet, np.zeros(len(frames)), 1)
        clipped = clipped_samples(frames)
        frames, noise, error = self._settled(frames, quiet.astype(np.intp), noise, colour)
        return Sought(frames, noise, colour.coefficients, colour.innovation, error, clipped), start.astype(np.intp)

    def _settled(
        self, frames: Floats, quiet: NDArray[np.intp], noise: Floats, colour: Colour
    ) -> tuple[Floats, Floats, Floats | None]:
        """Return frames without what rings from earlier blows, the noise, and the power of the error of that.

        Where there is ringing, `colour` becomes white.
        """
        rows = colour.rows[quiet[colour.rows] >= _FEWEST_QUIET]
        if not rows.size:
            return frames, noise, None
        frames, noise, error = frames.copy(), noise.copy(), None
        lengths = np.minimum(quiet[rows], _MOST_QUIET) // 32 * 32
        for n_quiet in np.unique(lengths).tolist():
            if n_quiet not in self._ringing:
                self._ringing[n_quiet] = Ringing(self.inversion, n_quiet)
            ringing, own = self._ringing[n_quiet], rows[lengths == n_quiet]
            before = np.stack([frames[row, quiet[row] - n_quiet : quiet[row]] for row in own])
            found, level, own_error, rings = ringing.after(before, colour.innovation[own])
            error = np.zeros((len(frames), own_error.shape[1])) if error is None else error
            for number in np.flatnonzero(rings).tolist():
                part = frames[own[number], quiet[own[number]] : quiet[own[number]] + ringing.n_samples]
                part -= found[number, : part.size]
            colour.coefficients[own[rings]] = 0.0
            noise[own[rings]], error[own[rings]] = level[rings], own_error[rings]
        return frames, noise, error

    def _noise(self, frames: Floats, quiet: Floats, vibrations: VibrationBatch, limit: float | None) -> Floats:
        """Return the standard deviation of white noise as loud as that before touch in the band up to `limit`."""
        if limit is None:
            found = vibrations.noise
        else:
            before = np.arange(frames.shape[1]) < quiet[:, None]
            power = np.sum(np.square(frames), axis=1, where=before) / np.maximum(quiet, 1)
            found = np.sqrt(power * self.beam.sampling_rate / 2 / limit)
        # Without any noise: what a table of the beam is worth.
        return np.asarray(np.maximum(found, _FLOOR * np.sqrt(np.mean(np.square(frames), axis=1)) + 1e-300))

    def resampled(self, frames: Floats, rate: float) -> Floats:
        """Return frames at the rate of the beam, with its filters in place of those of their recorder."""
        own = self.beam.sampling_rate
        ratio = Fraction(own / rate).limit_denominator(_LARGEST_RATIO)
        n = -(-frames.shape[1] // ratio.denominator) * ratio.denominator
        n_out = n * ratio.numerator // ratio.denominator
        spectrum = np.fft.rfft(frames, n, axis=1)
        frequency = np.fft.rfftfreq(n, 1 / rate)
        inside = frequency <= _TOP * min(rate, own)
        low_pass = np.abs(self.beam.filters) < np.pi * own
        theirs = np.where(low_pass, self.beam.filters * (rate / own), self.beam.filters)
        change = np.where(inside, gain(self.beam.filters, frequency) / gain(theirs, frequency), 0.0)
        out = np.zeros((len(frames), n_out // 2 + 1), complex)
        kept = min(out.shape[1], spectrum.shape[1])
        out[:, :kept] = (spectrum * change)[:, :kept]
        return np.asarray(np.fft.irfft(out, n_out, axis=1) * (n_out / n))[:, : int(frames.shape[1] * own / rate)]

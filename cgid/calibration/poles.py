"""Poles of free decays: natural frequencies and damping ratios after hammer taps, with standard deviations.

After the force has ended, every decay is a sum of the same damped exponentials. Its discrete Fourier transform is
exactly a sum of simple poles, without leakage. Band by band, each decay is such a sum over the modes of the band and a
polynomial for everything else.

1. Least squares for a common denominator (LSCF: Guillaume, Verboven & Vanlanduit 1998) gives poles at every order of
   the model; those that return from order to order are stable.
2. From the poles of some orders maximum likelihood in white noise, the amplitudes projected out (Golub & Pereyra 1973),
   gives the estimates; Schwarz's criterion selects the order. Then poles are added where the residual is largest.
3. Their covariance is the larger of the Cramer-Rao bound and of the scatter between single taps (Huber 1967), so that
standard deviations include changes of the beam from tap to tap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.least_squares import least_squares

Complexes = NDArray[np.complex128]

#: A band: width of its core over its frequency, and its maximum [Hz]; extent fitted beyond it on either side.
_WIDTH, _WIDEST, _MARGIN = 0.25, 500.0, 0.3
#: Minimum and maximum number of bins of a band, which determine the number of samples transformed.
_MIN_BINS, _MAX_BINS = 48, 400
#: Degree of the polynomial for modes outside of a band.
_DEGREE = 8
#: The band fills this fraction of the circle of the discrete model.
_CIRCLE = 0.85
#: Range of damping ratios.
MIN_DAMPING, MAX_DAMPING = 2e-5, 0.15
#: A pole is stable if its distance from one of the previous order is at most this fraction of its distance from the
#: axis, or of a bin.
_STABLE = 0.4
#: Number of orders without a better fit that ends the search, rounds of a fit, and the gain that ends it.
_MAX_WORSE, _ROUNDS, _CONVERGED = 4, 30, 1e-2
#: A further pole is tried at so many of the loudest bins of the residual, with these decays in widths of a bin.
#: It must leave at most the first fraction of the energy as it is tried, and the second when it is refined.
_PEAKS, _DECAYS, _PROMISING, _WORTH = 3, (0.5, 2.0, 8.0), 0.95, 0.8
#: Poles of least squares are refined if their gain is this fraction of the cost of their parameters.
_AT_FIRST = 0.25
#: Modes of other bands are in the background up to this many half-widths of a band from its middle.
_BEYOND = 3.0
#: A band's energy has decayed when it is below this multiple of its final value.
_DECAYED = 1.5
#: Ratio of the least to the largest diagonal element of a triangular matrix below which it is singular.
_SINGULAR = 1e-9
#: Two poles are one mode if their frequencies are closer than this fraction of the wider's distance from the axis, and
#: these distances differ by this factor; or if the poles are within this fraction of it.
_ONE, _UNLIKE, _SAME = 0.6, 1.5, 0.3
#: Maximum relative standard deviation of the damping of a reported mode.
_MAX_UNSURE = 0.35


@dataclass(frozen=True, kw_only=True, eq=False)
class Poles:
    """Modes of some free decays."""

    pole: Complexes  # (n_modes,) [1/s], `-damping_ratio w + j w sqrt(1 - damping_ratio^2)`, ascending
    deviation: Floats  # (2, n_modes), standard deviations of ln frequency and ln damping ratio
    amplitude: Complexes  # (n_decays, n_modes), a decay is the sum of `Re(amplitude exp(pole t))`
    amplitude_deviation: Floats  # (2, n_decays, n_modes), from the noise of each decay and from the shared poles
    orders: NDArray[np.intp]  # (n_modes,), number of orders of the model at which least squares found the mode
    chart: Floats  # (n, 4), every pole of every order: order, frequency [Hz], damping ratio, 1 if stable
    #: The same poles, but two for a mode whose decay is not exponential; the same where there is no such mode.
    apart: Complexes

    @property
    def frequency(self) -> Floats:
        """Natural frequencies [Hz]."""
        return np.asarray(np.abs(self.pole) / (2 * np.pi))

    @property
    def damping_ratio(self) -> Floats:
        """Fractions of critical damping."""
        return np.asarray(-self.pole.real / np.abs(self.pole))

    def taken(self, modes: NDArray[np.intp]) -> Poles:
        """Return some of the modes, with the chart of all."""
        return Poles(
            pole=self.pole[modes],
            deviation=self.deviation[:, modes],
            amplitude=self.amplitude[:, modes],
            amplitude_deviation=self.amplitude_deviation[..., modes],
            orders=self.orders[modes],
            chart=self.chart,
            apart=self.apart,
        )

    def without_window(self, tau: float) -> Poles:
        """Return the modes without the damping that an exponential window of this time constant [s] adds."""
        pole = self.pole + 1 / tau
        # Of a damping that is nearly all the window's, little is known.
        with np.errstate(divide="ignore"):
            unsure = self.deviation[1] * np.abs(self.pole.real / pole.real)
        damped = np.flatnonzero((pole.real < -MIN_DAMPING * np.abs(pole)) & (unsure < _MAX_UNSURE))
        found = self.taken(damped)
        deviation = np.stack([found.deviation[0], unsure[damped]])
        apart = self.apart + 1 / tau
        apart = apart[apart.real < -MIN_DAMPING * np.abs(apart)]
        return replace(found, pole=pole[damped], deviation=deviation, apart=apart)


def poles_of(
    decays: Floats,
    sampling_rate: float,
    band: tuple[float, float],
    max_order: int,
    progress: Callable[[int], object] | None = None,
) -> Poles:
    """Return the modes of some free decays (n_decays, n_samples) of one body, possibly none."""
    # `band` [Hz] is the lowest and highest natural frequency, `max_order` the maximum number of modes in one of the
    # bands. `progress` receives the percentage of work done since the last call.
    decays = decays - decays.mean(axis=1, keepdims=True)
    whole = np.fft.rfft(decays, axis=1)
    fits, cores = [], list(_cores(band, decays.shape[1] / sampling_rate))
    for k, core in enumerate(cores):
        fits.append(_Band(decays, whole, sampling_rate, core).best(max_order))
        if progress is not None:
            progress(100 * (k + 1) // len(cores) - 100 * k // len(cores))
    known = np.concatenate([fit.pole[fit.band.in_core(fit.pole)] for fit in fits])
    # Again with the modes of other bands in the background: no polynomial follows a resonance near the edge.
    again = [fit.band.with_background(fit, known) for fit in fits]
    reported = [fit.band.reported(fit.band.joined(fit)) for fit in again]
    apart = np.concatenate([fit.pole[fit.band.in_core(fit.pole)] for fit in again])
    charts = [fit.band.chart for fit in fits]
    pole = np.concatenate([part.pole for part in reported])
    order = np.argsort(np.abs(pole))
    return Poles(
        pole=pole[order],
        deviation=np.concatenate([part.deviation for part in reported], axis=1)[:, order],
        amplitude=np.concatenate([part.amplitude for part in reported], axis=1)[:, order],
        amplitude_deviation=np.concatenate([part.amplitude_deviation for part in reported], axis=2)[..., order],
        orders=np.concatenate([part.orders for part in reported])[order],
        chart=np.concatenate(charts),
        apart=apart[np.argsort(np.abs(apart))],
    )


def _cores(band: tuple[float, float], duration: float) -> Iterator[tuple[float, float]]:
    """Yield adjoining bands [Hz]."""
    low, highest = band
    while low < highest:
        width = max(min(_WIDTH * low, _WIDEST), _MIN_BINS / (1 + 2 * _MARGIN) / duration)
        high = low + width
        if highest - high < 0.3 * width:
            high = highest
        yield low, high
        low = high


class _Band:
    """The decays in one band: bins of their transform."""

    # `line` (n_bins,): frequencies [rad/s]; `bins` (n_bins, n_decays): transform over the square root of the length,
    # `free` the same with the background projected out.

    def __init__(self, decays: Floats, whole: Complexes, sampling_rate: float, core: tuple[float, float]) -> None:
        # `whole` is the transform of the decays.
        self.core, self.step = core, 1 / sampling_rate
        margin = _MARGIN * (core[1] - core[0])
        low, high = max(core[0] - margin, 0.3 * core[0]), min(core[1] + margin, 0.497 * sampling_rate)
        self.n_samples = _decay_length(whole, decays.shape[1], sampling_rate, (low, high))
        spectrum = np.fft.rfft(decays[:, : self.n_samples], axis=1).T / np.sqrt(self.n_samples)
        frequency = np.fft.rfftfreq(self.n_samples, self.step)
        selected = np.flatnonzero((frequency >= low) & (frequency <= high))
        self.line, self.bins = 2 * np.pi * frequency[selected], spectrum[selected]
        self.centre, self.half = np.pi * (low + high), np.pi * (high - low)
        self.take_background(np.polynomial.chebyshev.chebvander((self.line - self.centre) / self.half, _DEGREE))
        self.chart = np.empty((0, 4))

    def take_background(self, background: Floats | Complexes) -> None:
        """Set the columns (n_bins, n) of everything that is no mode of the band."""
        self.background = background
        self._orthonormal = np.linalg.qr(background)[0]
        self.free = self.without_background(self.bins)

    def without_background(self, columns: Complexes) -> Complexes:
        """Return columns (n_bins, n) with the background projected out."""
        return np.asarray(columns - self._orthonormal @ (self._orthonormal.conj().T @ columns))

    # -- least squares at every order ---------------------------------------------------------------------

    def starts(self, max_order: int) -> list[Complexes]:
        """Return initial sets of poles of every order from 1 on, and store the stabilisation chart."""
        angle = _CIRCLE * np.pi * (self.line - self.centre) / self.half
        largest = min(max_order, self.line.size // 4)
        powers = np.exp(1j * np.outer(angle, np.arange(largest + 1)))
        rows, out, before = [], [], np.empty(0, complex)
        for order in range(1, largest + 1):
            clear, every = self._roots(powers[:, : order + 1])
            near = np.abs(clear[:, None] - before).min(axis=1, initial=np.inf)
            bin_width = 2 * np.pi / (self.n_samples * self.step)
            stable = near < _STABLE * np.maximum(-clear.real, 0.1 * bin_width)
            size = np.abs(clear)
            rows.append(np.stack([np.full(size.size, order), size / (2 * np.pi), -clear.real / size, stable], axis=1))
            out += [clear, every]
            before = clear
        chart = np.concatenate([self.chart, *rows])
        self.chart = chart[(chart[:, 1] >= self.core[0]) & (chart[:, 1] < self.core[1])]
        return out

    def _roots(self, powers: Complexes) -> tuple[Complexes, Complexes]:
        """Return the poles of one order [1/s]: least squares of `denominator bins - numerators`, twice."""
        # With 1 as the lowest coefficient, poles due to noise grow and are dropped (Cauberghe et al. 2005), but so are
        # others in strong noise. With 1 as the highest, all decay.
        basis = np.linalg.qr(powers)[0]
        n = powers.shape[1]
        matrix = np.zeros((n, n), complex)
        for decay in self.bins.T:
            decays = decay[:, None] * powers
            decays = decays - basis @ (basis.conj().T @ decays)
            matrix += decays.conj().T @ decays
        poles = []
        for fixed in (0, n - 1):
            free = np.delete(np.arange(n), fixed)
            free_coefficients = np.linalg.lstsq(matrix[np.ix_(free, free)], -matrix[free, fixed], rcond=None)[0]
            roots = np.roots(np.insert(free_coefficients, fixed, 1.0)[::-1])
            roots = roots[(np.abs(roots) > 1e-12) & np.isfinite(roots)]
            pole = 1j * self.centre + self.half * np.log(roots) / (_CIRCLE * np.pi)
            poles.append(pole[self._are_inside(pole)])
        return poles[0], poles[1]

    def _are_inside(self, pole: Complexes) -> NDArray[np.bool_]:
        """Return which poles can be modes in or near the band."""
        ratio = -pole.real / np.abs(pole)
        reach = 0.15 * self.half
        inside = (ratio > MIN_DAMPING) & (ratio < MAX_DAMPING)
        return np.asarray(inside & (pole.imag > self.line[0] - reach) & (pole.imag < self.line[-1] + reach))

    # -- maximum likelihood -------------------------------------------------------------------------------

    def best(self, max_order: int) -> _Fit:
        """Return the best fit of all orders."""
        best, worse = _Fit(self, np.empty(0, complex)), 0
        for start in self.starts(max_order):
            first = self._pruned(_Fit(self, start), _AT_FIRST, refine=False)
            if best.is_near(first.pole):
                continue
            fit = self._pruned(_refined(first))
            if fit.criterion < best.criterion:
                best, worse = fit, 0
            else:
                worse += 1
            if worse == _MAX_WORSE:
                break
        return self._grown(best, max_order)

    def _grown(self, fit: _Fit, max_order: int) -> _Fit:
        """Return a fit with further poles where its residual is largest; each takes a fifth of the energy or more."""
        # Least squares of a common denominator overlooks a weak mode on the flank of a strong one.
        width = 2 * np.pi / (self.n_samples * self.step)
        while fit.pole.size < max_order:
            loudest = np.argsort(np.square(np.abs(fit.left)).sum(axis=1))[-_PEAKS:]
            tried = [
                _Fit(self, np.append(fit.pole, 1j * line - decay * width))
                for line in self.line[loudest].tolist()
                for decay in _DECAYS
            ]
            first = min(tried, key=lambda one: one.power)
            if first.power > _PROMISING * fit.power:
                return fit
            grown = self._pruned(_refined(first))
            if grown.power > _WORTH * fit.power or grown.criterion > fit.criterion:
                return fit
            fit = grown
        return fit

    def with_background(self, fit: _Fit, known: Complexes) -> _Fit:
        """Return a fit with the modes beyond the band in the background, from a fit without."""
        outside = np.abs(known.imag - self.centre) / self.half
        beyond = known[(outside > 1) & (outside < _BEYOND)]
        distance = np.abs(beyond[:, None] - fit.pole).min(axis=1, initial=np.inf)
        beyond = beyond[distance > -2 * beyond.real]
        inverse = 1 / (1j * self.line[:, None] - beyond)
        self.take_background(np.concatenate([self.background, inverse / np.linalg.norm(inverse, axis=0)], axis=1))
        return self._pruned(_refined(_Fit(self, fit.pole)))

    def in_core(self, pole: Complexes) -> NDArray[np.bool_]:
        """Return which poles have natural frequencies in the core of the band."""
        frequency = np.abs(pole) / (2 * np.pi)
        return np.asarray((frequency >= self.core[0]) & (frequency < self.core[1]))

    def joined(self, fit: _Fit) -> _Fit:
        """Return a fit with one pole for each pair that is a single mode with non-exponential decay."""
        # A mode with a slipping joint looks like two at one frequency with different damping. Half of the difference is
        # added to the standard deviations.
        while (pair := _double(fit.pole)) is not None:
            gain = fit.gains()
            weak, selected = sorted(pair, key=lambda k: gain[k])
            distance = (fit.pole[weak] - fit.pole[selected]) / 2
            fit.blur[selected] += abs(distance.real) + 1j * abs(distance.imag)
            fit = self._pruned(_refined(fit.without(weak)))
        return fit

    def _pruned(self, fit: _Fit, fraction: float = 1.0, *, refine: bool = True) -> _Fit:
        """Return a fit without the poles that gain less than a fraction of the cost of their parameters."""
        while fit.pole.size:
            inside = self._are_inside(fit.pole)
            gain = np.where(inside, fit.gains(), 0.0)
            worst = int(np.argmin(gain))
            if gain[worst] > fraction * fit.price:
                return fit
            fit = fit.without(worst)
            fit = _refined(fit) if refine else fit
        return fit

    def reported(self, fit: _Fit) -> Poles:
        """Return the modes of a fit in the core of the band."""
        frequency = np.abs(fit.pole) / (2 * np.pi)
        deviation = fit.deviation()
        selected = self.in_core(fit.pole) & ((deviation[1] < _MAX_UNSURE) | (fit.blur != 0))
        amplitude, variance = fit.amplitudes(self.step)
        near = np.abs(np.log(self.chart[:, 1][:, None] / frequency[selected])) < np.maximum(
            0.5 * -fit.pole.real[selected] / np.abs(fit.pole[selected]), 1e-3
        )
        return Poles(
            pole=fit.pole[selected],
            deviation=deviation[:, selected],
            amplitude=amplitude[:, selected],
            amplitude_deviation=variance[..., selected],
            orders=np.array([np.unique(self.chart[row, 0]).size for row in near.T], np.intp),
            chart=np.empty((0, 4)),
            apart=fit.pole[selected],
        )


def _decay_length(spectrum: Complexes, n: int, sampling_rate: float, band: tuple[float, float]) -> int:
    """Return after how many of n samples a band has decayed into noise, from their transform (n_decays, n_bins)."""
    frequency = np.fft.rfftfreq(n, 1 / sampling_rate)
    # The envelope of a band, at a lower rate.
    inside = spectrum[:, np.searchsorted(frequency, band[0]) : np.searchsorted(frequency, band[1], side="right")]
    n_envelope = min(n, max(1 << (2 * inside.shape[1]).bit_length(), 512))
    power = np.square(np.abs(np.fft.ifft(inside, n_envelope, axis=1))).sum(axis=0)
    count = max(n_envelope // 50, 1)
    level = power[: n_envelope // count * count].reshape(-1, count).mean(axis=1)
    over = np.flatnonzero(level > _DECAYED * np.median(level[-max(level.size // 8, 1) :]))
    width = band[1] - band[0]
    min_samples, max_samples = (int(np.ceil(bins * sampling_rate / width)) for bins in (_MIN_BINS, _MAX_BINS))
    needed = int(1.2 * count * n / n_envelope * (over[-1] + 1)) if over.size else 0
    return int(min(max(needed, min_samples), max(max_samples, min_samples), n))


class _Fit:
    """Poles in a band, with their amplitudes."""

    # `pole` (n_poles,) [1/s]; `blur` (n_poles,): additional standard deviations of modes with non-exponential decay;
    # `coefficients` (n_poles, n_decays); `left` (n_bins, n_decays): residual; `power`: its sum of squares.

    def __init__(self, band: _Band, pole: Complexes, blur: Complexes | None = None) -> None:
        self.band, self.pole = band, pole
        self.blur = np.zeros(pole.size, complex) if blur is None else blur
        inverse = 1 / (1j * band.line[:, None] - pole)
        # Columns of norm 1, so that orders of magnitude do not matter; the background is projected out (Frisch 1933).
        self.scale = 1 / np.maximum(np.linalg.norm(inverse, axis=0), 1e-300)
        self.basis = inverse * self.scale
        free = band.without_background(self.basis)
        self.q, self.r = np.linalg.qr(free)
        size = np.abs(np.diag(self.r))
        target = self.q.conj().T @ band.free
        # The pseudo-inverse is the costly part, and most fits are steps that need no more than their residual.
        sound = size.min(initial=1.0) > _SINGULAR
        self.coefficients = np.linalg.solve(self.r, target) if sound else self.inverse @ target
        self.left = band.free - free @ self.coefficients
        self.power = float(np.sum(np.square(np.abs(self.left))))

    @cached_property
    def inverse(self) -> Complexes:
        """Pseudo-inverse of `r`."""
        return np.asarray(np.linalg.pinv(self.r, rcond=1e-13))

    def without(self, k: int) -> _Fit:
        """Return the fit without one pole, the others unchanged."""
        return _Fit(self.band, np.delete(self.pole, k), np.delete(self.blur, k))

    def is_near(self, pole: Complexes) -> bool:
        """Return whether some poles are as many as the fit's, and as close as poles of stable modes."""
        if pole.size != self.pole.size:
            return False
        distance = np.abs(np.sort_complex(pole * -1j) - np.sort_complex(self.pole * -1j))
        return bool(np.all(distance < _STABLE * np.abs(np.sort_complex(self.pole * -1j).imag)))

    @property
    def freedom(self) -> float:
        """Complex degrees of freedom of the residual."""
        n_bins, n_decays = self.band.bins.shape
        n_columns = self.pole.size + self.band.background.shape[1]
        return float(max(n_decays * (n_bins - n_columns) - self.pole.size, 1))

    @property
    def price(self) -> float:
        """Minimum gain in twice the log-likelihood of a further pole (Schwarz 1978)."""
        n_bins, n_decays = self.band.bins.shape
        return float(2 * (1 + n_decays) * np.log(2 * n_bins * n_decays))

    @property
    def criterion(self) -> float:
        """Schwarz's criterion, up to a constant; less is better."""
        number = 2 * self.band.bins.size
        return float(number * np.log(max(self.power, 1e-300)) + self.pole.size * self.price)

    @property
    def noise(self) -> float:
        """Variance of a complex bin."""
        return self.power / self.freedom

    def gains(self) -> Floats:
        """Return the loss of twice the log-likelihood without each pole, (n_poles,)."""
        row_norms = np.square(np.abs(self.inverse)).sum(axis=1)
        power = np.square(np.abs(self.coefficients)).sum(axis=1)
        return np.asarray(2 * power / row_norms / max(self.noise, 1e-300))

    def _bends(self) -> Complexes:
        """Return how the basis changes with each pole [s], (n_bins, n_poles)."""
        return np.asarray(self.basis / (1j * self.band.line[:, None] - self.pole))

    def equations(self) -> tuple[Floats, Floats]:
        """Return curvature (n, n) and gradient of each decay (n_decays, n) in real and imaginary parts of the poles."""
        # The residual of decay j bends by a column times its coefficient (Kaufman 1975), so that products over bins and
        # over decays separate.
        bends = self.band.without_background(self._bends())
        bends = bends - self.q @ (self.q.conj().T @ bends)
        mirrored, turned = bends.conj().T, self.coefficients.conj()
        both = (mirrored @ bends) * (turned @ self.coefficients.T)
        curvature = np.block([[both.real, -both.imag], [both.imag, both.real]])
        pulls = turned * (mirrored @ self.left)
        return curvature, np.concatenate([pulls.real, pulls.imag]).T

    def covariance(self) -> Floats:
        """Return the covariance of real and imaginary parts of the poles, (2 n_poles, 2 n_poles) [1/s^2]."""
        curvature, pulls = self.equations()
        inverse = _inverse(curvature)
        bound = 0.5 * self.noise * inverse
        n_decays = len(pulls)
        if n_decays > 1:
            each = pulls @ inverse
            scatter = np.sqrt(n_decays / (n_decays - 1) * np.square(each).sum(axis=0) / np.diag(bound))
            larger = np.maximum(scatter, 1.0)
            bound = bound * np.outer(larger, larger)
        return np.asarray(bound + np.diag(np.square(np.concatenate([self.blur.real, self.blur.imag]))))

    def deviation(self) -> Floats:
        """Return the standard deviations of ln frequency and ln damping ratio, (2, n_poles)."""
        size, n = np.abs(self.pole), self.pole.size
        if not n:
            return np.empty((2, 0))
        covariance = self.covariance()
        out = np.empty((2, n))
        for k, pole in enumerate(self.pole):
            pole_covariance = covariance[np.ix_([k, n + k], [k, n + k])]
            of_size = np.array([pole.real, pole.imag]) / size[k] ** 2
            of_ratio = np.array([1 / pole.real, 0.0]) - of_size
            out[:, k] = [np.sqrt(of_size @ pole_covariance @ of_size), np.sqrt(of_ratio @ pole_covariance @ of_ratio)]
        return out

    def amplitudes(self, step: float) -> tuple[Complexes, Floats]:
        """Return the amplitudes of the decays at their first sample, and their standard deviations as in `Poles`."""
        n, band = self.pole.size, self.band
        if not n:
            return np.empty((band.bins.shape[1], 0), complex), np.empty((2, band.bins.shape[1], 0))
        # A sum over n samples of exp(s t) is (1 - exp(s n step)) / (1 - exp((s - j w) step)), near w = Im s it is (1 -
        # exp(s n step)) / ((j w - s) step) plus a smooth term. Half of a cosine is in its mirror image.
        factor = 2 * step * np.sqrt(band.n_samples) / (1 - np.exp(self.pole * band.n_samples * step))
        variance = self.noise * np.square(np.abs(self.inverse)).sum(axis=1)
        moved = self.inverse @ (self.q.conj().T @ self._bends())
        covariance, parts = self.covariance(), self.coefficients
        by_pole = np.empty((parts.shape[1], n))
        for decay in range(parts.shape[1]):
            slope = moved * parts[:, decay]
            directions = np.concatenate([slope, 1j * slope], axis=1)
            by_pole[decay] = np.einsum("ap,pq,aq->a", directions, covariance, directions.conj()).real
        size = np.abs(factor) * self.scale
        both = np.stack([np.broadcast_to(variance, by_pole.shape), by_pole])
        return factor * self.scale * parts.T, np.sqrt(both) * size


def _double(pole: Complexes) -> tuple[int, int] | None:
    """Return two poles that coincide, or have nearly one frequency and different damping; None without any."""
    for k in range(pole.size):
        for other in range(k):
            wide, narrow = sorted((-pole[k].real, -pole[other].real), reverse=True)
            near = abs(pole[k].imag - pole[other].imag) < _ONE * wide and wide > _UNLIKE * narrow
            if near or abs(pole[k] - pole[other]) < _SAME * wide:
                return other, k
    return None


def _refined(fit: _Fit) -> _Fit:
    """Return the maximum-likelihood fit near a fit."""
    band, n = fit.band, fit.pole.size
    if not n:
        return fit

    def equations(parts: Floats, _: NDArray[np.intp]) -> Floats:
        fitted = _Fit(band, parts[0, :n] + 1j * parts[0, n:])
        curvature, pulls = fitted.equations()
        pull = pulls.sum(axis=0)[:, None]
        return np.block([[curvature, pull], [pull.T, np.full((1, 1), fitted.power)]])[None]

    def moved(parts: Floats, step: Floats, _: NDArray[np.intp]) -> Floats:
        beyond, middle = 4 * band.half, np.repeat([0.0, band.centre], n)
        return np.clip(parts + step, middle - beyond, np.where(middle > 0, middle + beyond, -1e-9 * band.centre))

    start = np.concatenate([fit.pole.real, fit.pole.imag])[None]
    best = least_squares(start, equations, moved, np.array([_CONVERGED * fit.noise]), _ROUNDS)[0][0]
    return _Fit(band, best[:n] + 1j * best[n:], fit.blur)


def _inverse(matrix: Floats) -> Floats:
    """Return the inverse of a positive matrix whose rows have different units."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.linalg.pinv(matrix * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale))

"""From a contact force to the samples of a recorder, through a tail beam and a chain of sensors.

All of it is linear, so all of it is one sum over poles: those of the beam's modes, and those of what the sensor does
to the signal (mounting resonance, anti-alias filter). Each pole is a resonator driven by the force. During contact
the resonators are run on a grid fine enough for the force; once the rock has left, each rings as one exponential, and
only the recorder's samples are computed. There is no internal rate to filter and decimate from.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.counting import count
from cgid.errors import InvalidValue
from cgid.validation import Floats

Complex = NDArray[np.complex128]

#: What a sensor on a beam feels, and how often it is differentiated in time.
DERIVATIVES = {"displacement": 0, "velocity": 1, "acceleration": 2}
Quantity = Literal["force", "displacement", "velocity", "acceleration"]

#: Two poles nearer to each other than this, over their size, are told apart by moving one: their residues would cancel.
_APART = 1e-6
#: Samples of the table of exponentials: it then stays in the cache with a hundred poles.
_TABLE = 256
#: Steps of a contact, see `steps_for`: so many for an error of 1, at least, and a sample at most.
_STEPS_FOR_ONE, _LEAST_STEPS, _MOST_STRIDE = 4.0, 32, 1 << 16
#: Pulses of which windows are in memory at once.
_AT_ONCE = 256


@dataclass(frozen=True, kw_only=True)
class Resonance:
    """A resonance that passes what is slow, `w^2 / (s^2 + 2 zeta w s + w^2)`: a sensor on its mounting.

    Parameters
    ----------
    frequency : float
        [Hz], above 0.
    damping_ratio : float
        Above 0 and below 1.
    """

    frequency: float
    damping_ratio: float

    def __post_init__(self) -> None:
        validation.positive("frequency of the resonance", self.frequency, "Hz")
        require_damping_ratio(self.damping_ratio)

    @property
    def poles(self) -> Complex:
        """The pole in the upper half-plane [rad/s], (1,)."""
        return resonator_poles(np.array([self.frequency]), np.array([self.damping_ratio]))


@dataclass(frozen=True, kw_only=True)
class LowPass:
    """A Butterworth low-pass, as an anti-alias filter before the converter.

    Parameters
    ----------
    frequency : float
        Where it is 3 dB down [Hz].
    order : int
        1 to 12.
    """

    frequency: float
    order: int = 8

    def __post_init__(self) -> None:
        validation.positive("frequency of the low-pass", self.frequency, "Hz")
        if not 1 <= validation.count("order of the low-pass", self.order) <= 12:
            raise InvalidValue(f"order of the low-pass must be at most 12, got {self.order}")

    @property
    def poles(self) -> Complex:
        """The poles of the upper half-plane and the real axis [rad/s]."""
        angles = np.pi * (2 * np.arange((self.order + 1) // 2) + self.order + 1) / (2 * self.order)
        poles = 2 * np.pi * self.frequency * np.exp(1j * angles)
        return np.asarray(np.where(np.abs(poles.imag) < 1e-9 * np.abs(poles), poles.real + 0j, poles))


class Resonators(Protocol):
    """What is asked of the modes of a beam."""

    @property
    def frequency(self) -> Floats:
        """[Hz], (n_modes,)."""

    @property
    def damping_ratio(self) -> Floats:
        """(n_modes,)."""


class Pulses(Protocol):
    """What is asked of the blows."""

    @property
    def contact_duration(self) -> Floats:
        """[s], (n,)."""

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: Any, onset: Any, *, tolerance: float) -> None:
        """Add the forces to frames (n, n_samples), each at a sampling rate of its own, to an error over the peak."""


def require_damping_ratio(damping_ratio: ArrayLike) -> Floats:
    """Return damping ratios that leave an oscillation that dies out: above 0 and below 1."""
    ratio = validation.positive("damping_ratio", damping_ratio)
    if (ratio >= 1).any():
        raise InvalidValue(f"damping_ratio must be below 1, got {ratio.max():g}")
    return ratio


def resonator_poles(frequency: Floats, damping_ratio: Floats) -> Complex:
    """Return `-zeta w + i w sqrt(1 - zeta^2)` [rad/s]."""
    return np.asarray(
        2 * np.pi * frequency * (-damping_ratio + 1j * np.sqrt((1 - damping_ratio) * (1 + damping_ratio)))
    )


def steps_for(tolerance: float) -> int:
    """Return how many steps a contact takes for this error over the largest sample.

    The force is taken as straight between steps after a correction by its second difference. What remains comes from
    touch and separation, where it goes as `t^(3/2)`, and falls with the power 5/2 of their number.
    """
    return max(_LEAST_STEPS, int(np.ceil(_STEPS_FOR_ONE * tolerance**-0.4)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """The linear way from a contact force to a recorder.

    Parameters
    ----------
    sampling_rate : float
        Of the recorder [Hz].
    quantity : {"force", "displacement", "velocity", "acceleration"}
        What the sensor feels: the contact force itself, or the motion of a beam.
    modes : object with `frequency` and `damping_ratio`, optional
        Of the beam, (n_modes,); a force has none.
    filters : tuple of Resonance and LowPass
        What the sensor and the recorder make of it.
    tolerance : float
        Error allowed, over the largest sample: how fine the contact is cut, and which poles are too quiet to be run.

    Raises
    ------
    InvalidValue
        A force with modes or a motion without, or a force without any filter: then nothing responds.
    """

    sampling_rate: float
    quantity: Quantity = "acceleration"
    modes: Resonators | None = None
    filters: tuple[Resonance | LowPass, ...] = ()
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        validation.positive("sampling_rate", self.sampling_rate, "Hz")
        validation.choice("quantity", self.quantity, ("force", *DERIVATIVES))
        if not 0 < self.tolerance <= 0.1:
            raise InvalidValue(f"tolerance must lie above 0 and up to 0.1, got {self.tolerance:g}")
        if (self.quantity == "force") != (self.modes is None):
            raise InvalidValue(
                f"modes must be left out for a force, and given for a motion of the beam, got {self.quantity} "
                f"{'without' if self.modes is None else 'with'} modes"
            )
        if self.modes is None and not self.filters:
            raise InvalidValue("filters must be at least 1 for a force: without any the recorder has the force itself")

    @property
    def n_modes(self) -> int:
        """How many modes the beam has."""
        return 0 if self.modes is None else self.modes.frequency.size

    @cached_property
    def poles(self) -> Complex:
        """All poles of the upper half-plane and the real axis [rad/s], those of the modes first."""
        found = [np.empty(0, complex)] if self.modes is None else [self._mode_poles]
        for own in (part.poles for part in self.filters):
            taken = np.concatenate(found)
            for number, pole in enumerate(own):
                while taken.size and np.abs(taken - own[number]).min() < _APART * abs(pole):
                    own[number] *= 1 + 2 * _APART
            found.append(own)
        return np.concatenate(found)

    @cached_property
    def _mode_poles(self) -> Complex:
        assert self.modes is not None
        # Equal ones (of a square plate) are no trouble: each has a residue of its own.
        return resonator_poles(self.modes.frequency, self.modes.damping_ratio)

    @property
    def _filter_poles(self) -> Complex:
        return self.poles[self.n_modes :]

    def _filtered(self, s: Complex, without: int | None = None) -> Complex:
        """Return the gain of all filters at s; without one of their poles for the residue there."""
        gain = np.ones(np.shape(s), complex)
        for number, pole in enumerate(self._filter_poles):
            both = pole.imag != 0
            gain = gain * (abs(pole) ** 2 if both else -pole)
            if number != without:
                gain = gain / (s - pole)
            if both:
                gain = gain / (s - pole.conjugate())
        return gain

    @cached_property
    def _residues(self) -> tuple[Complex, Complex]:
        """Amplitude of each mode's pole, (n_modes,), and of the filters' poles, (n_modes or 1, n_filter_poles).

        Both for a participation of 1, and twice the residue where a pole stands for its conjugate, too.
        """
        fold = np.where(self.poles.imag != 0, 2.0, 1.0)
        after = np.array([self._filtered(pole, n) for n, pole in enumerate(self._filter_poles)], complex)
        if self.modes is None:
            return np.empty(0, complex), (fold * after)[None]
        k = DERIVATIVES[self.quantity]
        w, zeta = 2 * np.pi * self.modes.frequency, self.modes.damping_ratio
        own = self._mode_poles
        at_modes = own**k / (2j * own.imag) * self._filtered(own)
        s = self._filter_poles[None, :]
        at_filters = after * s**k / (s**2 + 2 * (zeta * w)[:, None] * s + (w**2)[:, None])
        return fold[: self.n_modes] * at_modes, fold[None, self.n_modes :] * at_filters

    def amplitudes(self, participation: Floats | None = None) -> tuple[Complex, Floats]:
        """Return how strongly a force drives each pole, and how much of it passes at once.

        Parameters
        ----------
        participation : ndarray, (n, n_modes), optional
            `shape(impact) shape(sensor) / modal mass` [1/kg]; none for a force.

        Returns
        -------
        tuple of ndarray
            (n, n_poles) and (n,).
        """
        own, filters = self._residues
        if participation is None:
            return filters, np.zeros(1)
        # No BLAS: its sums depend on how many threads it has.
        mixed = np.einsum("ir,rj->ij", participation, filters)
        passes = self.quantity == "acceleration" and not self.filters
        direct = participation.sum(axis=1) if passes else np.zeros(len(participation))
        return np.concatenate([participation * own, mixed], axis=1), direct

    def frequency_response(self, frequencies: ArrayLike, participation: ArrayLike | None = None) -> Complex:
        """Return the response to a force of unit amplitude at frequencies [Hz], complex, (n_frequencies,).

        Parameters
        ----------
        frequencies : array_like, (n_frequencies,)
        participation : array_like, (n_modes,), optional
            As in `amplitudes`.
        """
        rows = None if participation is None else np.atleast_2d(np.asarray(participation, np.float64))
        amplitude, direct = self.amplitudes(rows)
        s = 2j * np.pi * np.asarray(frequencies, np.float64)[:, None]
        pole, half = self.poles[None], np.where(self.poles.imag != 0, 0.5, 1.0) * amplitude[0]
        other = np.where(self.poles.imag != 0, half.conjugate() / (s - pole.conjugate()), 0.0)
        return np.asarray(direct[0] + (half / (s - pole) + other).sum(axis=1))

    def audible(self, participation: Floats | None) -> NDArray[np.intp]:
        """Return the poles that must be run for these pulses, those that ring longest first.

        Left out are the quietest ones of the modes, as long as all that is left out together stays below the
        tolerance, over the loudest one, for every pulse.
        """
        loudness = np.abs(self.amplitudes(participation)[0])
        loudest = loudness[:, : self.n_modes].max(axis=1, initial=1e-300)
        share = (loudness / loudest[:, None]).max(axis=0)
        share[self.n_modes :] = np.inf  # the filters' poles carry what all modes leave in the band
        quiet_first = np.argsort(share, kind="stable")
        kept = quiet_first[np.searchsorted(np.cumsum(share[quiet_first]), self.tolerance, side="right") :]
        return np.asarray(kept[np.argsort(-self.poles[kept].real, kind="stable")])

    def add_to_frames(
        self,
        frames: NDArray[Any],
        pulses: Pulses,
        onset: Floats,
        participation: Floats | None = None,
        *,
        rows: NDArray[np.intp] | None = None,
        ratio: Floats | None = None,
        threads: int = 1,
    ) -> None:
        """Add what the recorder hears of some pulses to its frames, in place.

        Parameters
        ----------
        frames : ndarray of float32 or float64, (n_rows, n_samples)
        pulses : Impact, TapPulses or ModalImpact
            n of them.
        onset : ndarray, (n,)
            Time of touch in the frame [s]; it may lie before it.
        participation : ndarray, (n, n_modes), optional
        rows : ndarray of int, (n,), optional
            The frame of each pulse; the pulses in order by default. A frame may have any number of them.
        ratio : ndarray, (n,), optional
            What each force is multiplied by.
        threads : int
            How many threads share the frames.
        """
        from cgid.impact import _response

        n = len(onset)
        rows = np.arange(n) if rows is None else rows
        chosen = self.audible(participation)
        amplitude, direct = self.amplitudes(participation)
        amplitude = np.broadcast_to(amplitude[:, chosen], (n, chosen.size))
        if ratio is not None:
            amplitude, direct = amplitude * ratio[:, None], direct * ratio
        parts = np.ascontiguousarray(np.stack([amplitude.real, amplitude.imag], axis=1))
        windows = _windows(pulses, onset, self.sampling_rate, self.tolerance)
        ringing = np.empty_like(parts)
        grown = np.exp(self.poles[chosen] / self.sampling_rate)
        turn = np.stack([grown.real, grown.imag])
        driven = self._driven(chosen, windows.strides)
        direct = np.ascontiguousarray(np.broadcast_to(direct, (n,)))
        count("modes", int((chosen < self.n_modes).sum()))
        # Two pulses of one frame must not be added by two threads.
        shared = [np.arange(n)] if np.unique(rows).size < n else np.array_split(np.arange(n), threads)

        def strike(part: NDArray[np.intp]) -> None:
            _response.strike(
                frames, rows, windows.first, windows.stride, windows.count, windows.level, turn, *driven,
                windows.force, windows.drive, parts, direct, ringing, part,
            )  # fmt: skip

        _in_threads(strike, shared)
        self._ring(frames, rows, windows.first + windows.count, ringing, chosen, threads)

    def _ring(
        self,
        frames: NDArray[Any],
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        ringing: Floats,
        chosen: NDArray[np.intp],
        threads: int,
    ) -> None:
        from cgid.impact import _response

        order = np.lexsort((start, rows))
        begin = np.searchsorted(rows[order], np.arange(len(frames) + 1))
        # The filters' poles may be loud and cancel each other: what is silent is told by the modes, if there are any.
        heard = (chosen < self.n_modes) | (self.n_modes == 0)
        loudest = np.zeros(len(frames))
        np.maximum.at(loudest, rows, np.hypot(ringing[:, 0], ringing[:, 1])[:, heard].max(axis=1))
        silence = self.tolerance * loudest / chosen.size
        hop = np.ascontiguousarray(self._rung[:, chosen, _TABLE])
        table = self._rung[:, chosen, :_TABLE].astype(frames.dtype)

        def run(part: NDArray[np.intp]) -> int:
            some = slice(part[0], part[-1] + 1)
            return int(
                _response.ring(
                    frames[some], begin[part[0] : part[-1] + 2], order, start, ringing, table, hop, silence[some]
                )
            )

        count("mode_samples", sum(_in_threads(run, np.array_split(np.arange(len(frames)), threads))))

    def _driven(self, chosen: NDArray[np.intp], strides: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Return what a sample of so many steps does to the poles: polynomials, their shares and g1 of `_response`.

        Shapes (n_levels, largest stride, n_polynomials), (n_levels, 2, n_polynomials, n_poles), (n_levels, 2, n_poles).
        """
        levels = [self._samples_of(stride) for stride in strides.tolist()]
        polynomials = np.zeros((strides.size, strides[-1], self._n_polynomials))
        for level, stride in enumerate(strides.tolist()):
            polynomials[level, :stride] = levels[level].polynomials
        shares = np.stack([level.shares[:, :, chosen] for level in levels])
        return polynomials, shares, np.stack([level.edge[:, chosen] for level in levels])

    @cached_property
    def _rung(self) -> Floats:
        """Ringing of every pole over the samples of a table and one more, (2, n_poles, `_TABLE` + 1)."""
        grown = np.exp(np.outer(self.poles / self.sampling_rate, np.arange(_TABLE + 1)))
        return np.stack([grown.real, grown.imag])

    @cached_property
    def _n_polynomials(self) -> int:
        return _polynomials_for(float(np.abs(self.poles).max()) / self.sampling_rate, self.tolerance)

    @cached_property
    def _kept(self) -> dict[int, _Sample]:
        return {}

    def _samples_of(self, stride: int) -> _Sample:
        """Return what is the same in all blocks, made when first asked for."""
        if stride not in self._kept:
            self._kept[stride] = _sample_of(self.poles, self.sampling_rate, stride, self._n_polynomials)
        return self._kept[stride]


@dataclass(frozen=True)
class _Sample:
    """What a sample of some steps does to all poles: see `Response._driven`."""

    polynomials: Floats
    shares: Floats
    edge: Floats


def _sample_of(poles: Complex, sampling_rate: float, stride: int, n_polynomials: int) -> _Sample:
    h = 1 / (sampling_rate * stride)
    # g0 = h (phi1 - phi2), g1 = h phi2 with phi1 = (e^x - 1) / x, phi2 = (e^x - 1 - x) / x^2.
    phi1, phi2 = _phi(poles * h)
    edge = h * phi2
    drive = h * (phi1 - phi2) + np.exp(poles * h) * edge
    polynomials = np.zeros((stride, n_polynomials))
    shares = np.zeros((n_polynomials, poles.size), complex)
    if stride <= n_polynomials:  # every step by itself
        polynomials[:, :stride] = np.eye(stride)
        shares[:stride] = drive * np.exp(np.outer(np.arange(stride)[::-1], poles * h))
    else:
        polynomials[:] = legendre.legvander(np.linspace(-1, 1, stride), n_polynomials - 1)
        shares[:] = drive * _powers_by_legendre(poles * h * (stride - 1) / 2, n_polynomials)
    return _Sample(polynomials, np.stack([shares.real, shares.imag]), np.stack([edge.real, edge.imag]))


def _powers_by_legendre(c: Complex, n_polynomials: int) -> Complex:
    """Return the Legendre coefficients of `exp(c (1 - v))` over v in [-1, 1], (n_polynomials, n)."""
    from scipy.special import spherical_in

    n = np.arange(n_polynomials)[:, None]
    return np.asarray(np.exp(c) * (2 * n + 1) * (-1.0) ** n * spherical_in(n, c[None]))


@cache
def _polynomials_for(phase: float, tolerance: float) -> int:
    """Return how many polynomials a pole needs that turns by this phase in a sample [rad]."""
    from scipy.special import spherical_in

    n = np.arange(2, 400)
    size = (2 * n + 1) * spherical_in(n, phase / 2)
    quiet = np.flatnonzero((size < 1e-2 * tolerance) | ~np.isfinite(size))
    return int(n[quiet[0]]) if quiet.size else 400


def _phi(x: Complex) -> tuple[Complex, Complex]:
    """Return (e^x - 1) / x and (e^x - 1 - x) / x^2, by their series where these would cancel."""
    small = np.abs(x) < 0.5
    safe = np.where(small, 1.0, x)
    first, second = np.ones_like(x), np.full_like(x, 0.5)
    term = np.ones_like(x)
    for n in range(2, 20):
        term = term * np.where(small, x, 0.0) / n
        first, second = first + term, second + term / (n + 1)
    return np.where(small, first, np.expm1(safe) / safe), np.where(small, second, (np.expm1(safe) - safe) / safe**2)


@dataclass(frozen=True)
class _Windows:
    """The forces of n pulses on fine grids of their own, each with so many steps a sample as its contact needs."""

    first: NDArray[np.int64]
    count: NDArray[np.int64]
    stride: NDArray[np.int64]
    strides: NDArray[np.int64]
    level: NDArray[np.intp]
    force: Floats
    drive: Floats


def _windows(pulses: Pulses, onset: Floats, sampling_rate: float, tolerance: float) -> _Windows:
    duration = pulses.contact_duration * sampling_rate
    needed = np.maximum(np.ceil(np.log2(steps_for(tolerance) / duration)), 0).astype(np.int64)
    if (needed >= 31).any() or (1 << needed.max(initial=0)) > _MOST_STRIDE:
        shortest = float(pulses.contact_duration.min())
        raise InvalidValue(
            f"sampling_rate must give a contact a {_MOST_STRIDE}th of a sample at least, got {sampling_rate:g} Hz for "
            f"one of {shortest:.3g} s; raise it"
        )
    stride = np.int64(1) << needed
    place = onset * sampling_rate
    first = np.floor(place).astype(np.int64)
    # Two steps of no force behind the contact: the last of them still feels it in the correction below.
    length = np.floor(place + duration + 2 / stride).astype(np.int64) + 1 - first
    force = np.zeros((len(onset), int((length * stride).max(initial=0)) + 1))
    pulses.add_to_frames(force, sampling_rate * stride, (place - first) / sampling_rate, tolerance=0.3 * tolerance)
    # A straight line between samples of a bent curve cuts its corners by a twelfth of the second difference.
    drive = force.copy()
    drive[:, 1:-1] -= (force[:, 2:] - 2 * force[:, 1:-1] + force[:, :-2]) / 12
    strides, level = np.unique(stride, return_inverse=True)
    return _Windows(first, length, stride, strides, level, force, drive)


def _in_threads(work: Callable[[NDArray[np.intp]], Any], parts: list[NDArray[np.intp]]) -> list[Any]:
    parts = [part for part in parts if part.size]
    if len(parts) <= 1:
        return [work(part) for part in parts]
    return list(_pool(len(parts)).map(work, parts))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="cgid-response")

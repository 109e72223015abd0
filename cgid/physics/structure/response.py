"""From a contact force to the samples of a recorder, through a tail beam and a chain of sensors.

The chain is linear, so it is one sum over poles: those of the beam's modes, and those of the sensor (mounting
resonance, anti-alias filter). Each pole is a resonator driven by the force. During contact the resonators run on a grid
fine enough for the force (`cgid.physics.structure.driving`). After it each decays as one exponential, computed only at
the recorder's samples. There is no internal sampling rate, hence no filtering and decimation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Complex, Floats
from cgid.errors import InvalidValue
from cgid.measure.modal.modes import Modes, residues, resonator_poles
from cgid.physics.contact.curves import in_parts
from cgid.physics.structure.driving import DrivenSample, Pulses, Windows, polynomials_for

__all__ = ["Filter", "HighPass", "LinearPhase", "LowPass", "Resonance", "Response"]

#: Quantities of a sensor on a beam, and the number of time derivatives of the displacement.
DERIVATIVES = {"displacement": 0, "velocity": 1, "acceleration": 2}
Quantity = Literal["force", "displacement", "velocity", "acceleration"]

#: Relative distance below which a filter's pole is moved away from another pole, since their residues would be large
#: and cancel. So a mounting resonance may shift by up to .2 % if a mode has the same frequency.
_MIN_DISTANCE = 1e-3
#: A Gaussian edge falls from 99 % to 1 % within so many standard deviations; that of an impulse response ends after so
#: many, at 4e-6.
_TO_ONE_PER_CENT, _LENGTH = 4.6527, 5.0
#: Samples in the table of exponentials: with a hundred poles it fits into the cache.
_TABLE = 256


@dataclass(frozen=True, kw_only=True)
class Resonance:
    """A resonance of low-pass form, `w^2 / (s^2 + 2 zeta w s + w^2)`: a sensor on its mounting.

    Parameters
    ----------
    frequency : float [Hz]
        Above 0.
    damping_ratio : float
        Above 0 and below 1.
    """

    frequency: float
    damping_ratio: float

    def __post_init__(self) -> None:
        validation.positive("frequency of the resonance", self.frequency, "Hz")
        validation.damping_ratio("damping_ratio", self.damping_ratio)

    @property
    def poles(self) -> Complex:
        """The pole in the upper half-plane [rad/s], (1,)."""
        return resonator_poles([self.frequency], [self.damping_ratio])


@dataclass(frozen=True, kw_only=True)
class LowPass:
    """A Butterworth low-pass, such as an anti-alias filter.

    Parameters
    ----------
    frequency : float [Hz]
        3 dB cut-off.
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
        """The poles in the upper half-plane and on the real axis [rad/s]."""
        angles = np.pi * (2 * np.arange((self.order + 1) // 2) + self.order + 1) / (2 * self.order)
        sine, cosine = np.sin(angles), np.cos(angles)
        radius = 2 * np.pi * self.frequency
        return np.asarray(radius * (cosine + 1j * np.where(np.abs(sine) < 1e-9, 0.0, sine)))


@dataclass(frozen=True, kw_only=True)
class HighPass:
    """A high-pass of first order, `s / (s + w)`: the AC coupling of a recorder.

    Parameters
    ----------
    frequency : float [Hz]
        3 dB cut-off.
    """

    frequency: float

    def __post_init__(self) -> None:
        validation.positive("frequency of the high-pass", self.frequency, "Hz")

    @property
    def poles(self) -> Complex:
        """Its pole, on the real axis [rad/s], (1,)."""
        return np.array([-2 * np.pi * self.frequency], complex)


@dataclass(frozen=True, kw_only=True)
class LinearPhase:
    """A low-pass of linear phase and finite impulse response, as of a sigma-delta converter.

    All frequencies come late by the same delay: half the length of the impulse response, a sinc under a Gaussian.

    Parameters
    ----------
    frequency : float [Hz]
        Half-amplitude (6 dB) point.
    transition : float
        From 99 % to 1 % of the amplitude, over `frequency`; 0.05 to 1.
    """

    frequency: float
    transition: float = 0.2

    def __post_init__(self) -> None:
        validation.positive("frequency of the low-pass", self.frequency, "Hz")
        validation.between("transition of the low-pass", self.transition, 0.05, 1.0)

    @property
    def poles(self) -> Complex:
        """None: it acts on the force."""
        return np.empty(0, complex)

    @property
    def width(self) -> float:
        """Standard deviation of the Gaussian that smooths the edge [Hz]."""
        return self.transition * self.frequency / _TO_ONE_PER_CENT

    @property
    def delay(self) -> float:
        """Half the length of the impulse response [s]."""
        return _LENGTH / (2 * np.pi * self.width)

    def taps(self, step: float) -> Floats:
        """Return the impulse response at steps [s], times the step."""
        time = step * np.arange(int(2 * self.delay / step) + 1) - self.delay
        own = np.sinc(2 * self.frequency * time) * np.exp(-0.5 * (2 * np.pi * self.width * time) ** 2)
        return np.asarray(2 * self.frequency * step * own)


Filter = Resonance | LowPass | HighPass | LinearPhase


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """The linear path from a contact force to a recorder.

    `InvalidValue` is raised for a force with modes, a motion without, or a force without filters.

    Parameters
    ----------
    sampling_rate : float [Hz]
        Sampling rate of the recorder.
    quantity : {"force", "acceleration", "velocity", "displacement"}
        What the sensor measures: the contact force itself, or a motion of the beam.
    modes : Modes, optional
        Modes of the beam; None for a force.
    filters : tuple of Resonance, LowPass, HighPass or LinearPhase
        Filters of the sensor and the recorder.
    tolerance : float
        Permitted error over the largest sample; sets the steps per contact and which quiet poles are omitted.
    """

    sampling_rate: float
    quantity: Quantity = "acceleration"
    modes: Modes | None = None
    filters: tuple[Filter, ...] = ()
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        validation.positive("sampling_rate", self.sampling_rate, "Hz")
        validation.choice("quantity", self.quantity, ("force", *DERIVATIVES))
        if not 0 < self.tolerance <= 0.1:
            raise InvalidValue(f"tolerance must be above 0 and up to 0.1, got {self.tolerance:g}")
        if (self.quantity == "force") != (self.modes is None):
            raise InvalidValue(
                f"modes must be left out for a force, and given for a motion of the beam, got {self.quantity} "
                f"{'without' if self.modes is None else 'with'} modes"
            )
        if self.modes is None and self._smooth:
            raise InvalidValue("filters must be without a linear phase for a force; use a zero-phase low-pass")
        if self.modes is None and not self.filters:
            raise InvalidValue("filters must be at least 1 for a force: the recording is the force itself")

    @property
    def n_modes(self) -> int:
        """Number of modes of the beam."""
        return 0 if self.modes is None else self.modes.frequency.size

    @cached_property
    def poles(self) -> Complex:
        """All poles in the upper half-plane and on the real axis [rad/s], those of the modes first."""
        poles_of_parts = [np.empty(0, complex)] if self.modes is None else [self.modes.poles]
        for poles in (part.poles for part in self.filters):
            taken = np.concatenate(poles_of_parts)
            for number, pole in enumerate(poles):
                while taken.size and np.abs(taken - poles[number]).min() < _MIN_DISTANCE * np.abs(pole):
                    poles[number] *= 1 + 1.01 * _MIN_DISTANCE
            poles_of_parts.append(poles)
        return np.concatenate(poles_of_parts)

    @property
    def _filter_poles(self) -> Complex:
        return self.poles[self.n_modes :]

    def _filtered(self, s: Complex, without: int | None = None) -> Complex:
        """Return the gain of all filters at s; omit one of their poles to get the residue there."""
        gain = np.ones(np.shape(s), complex)
        falls = [isinstance(part, HighPass) for part in self.filters for _ in part.poles]
        for number, pole in enumerate(self._filter_poles):
            both = pole.imag != 0
            gain = gain * (
                pole.real * pole.real + pole.imag * pole.imag if both else s if falls[number] else -pole.real
            )
            if number != without:
                gain = gain / (s - pole)
            if both:
                gain = gain / (s - pole.conjugate())
        return gain

    @property
    def _passes(self) -> bool:
        """Whether the filters pass the highest frequencies of the force, perhaps smoothed by those of linear phase."""
        return all(isinstance(part, HighPass | LinearPhase) for part in self.filters)

    @property
    def _smooth(self) -> list[LinearPhase]:
        return [part for part in self.filters if isinstance(part, LinearPhase)]

    @property
    def lengthened(self) -> float:
        """By how much filters of linear phase lengthen a force [s]."""
        return 2 * sum(part.delay for part in self._smooth)

    @cached_property
    def _residues(self) -> tuple[Complex, Complex]:
        """Amplitudes of the poles of modes for a participation of 1, of filters for 1j, too; doubled for conjugates."""
        fold = np.where(self.poles.imag != 0, 2.0, 1.0)
        after = np.array([self._filtered(pole, n) for n, pole in enumerate(self._filter_poles)], complex)
        if self.modes is None:
            return np.empty(0, complex), (fold * after)[None]
        k = DERIVATIVES[self.quantity]
        w, zeta = 2 * np.pi * self.modes.frequency, self.modes.damping_ratio
        modal_poles = self.modes.poles
        at_modes = residues(modal_poles, k) / 2 * self._filtered(modal_poles)
        s = self._filter_poles[None, :]
        beam = s**2 + 2 * (zeta * w)[:, None] * s + (w * w)[:, None]
        # A participation of 1j: the state a quarter of a period later, of which nothing passes without delay.
        unit = residues(modal_poles, k)[:, None]
        turned = 0.5j * (unit / (s - modal_poles[:, None]) - unit.conj() / (s - modal_poles[:, None].conj()))
        at_filters = after * np.stack([s**k / beam, turned])
        return fold[: self.n_modes] * at_modes, fold[self.n_modes :] * at_filters

    @cached_property
    def _loudness(self) -> Floats:
        """Loudness of each mode after an impact, for a participation of 1."""
        # The gain of the filters is for a steady tone: at the pole itself it may be unbounded.
        assert self.modes is not None
        size, k = np.abs(self.modes.poles), DERIVATIVES[self.quantity]
        gain = np.abs(self._filtered(1j * size))
        return np.asarray(gain / size if k == 0 else gain if k == 1 else gain * size)

    def amplitudes(self, participation: Floats | Complex | None = None) -> tuple[Complex, Floats]:
        """Return how strongly a force drives each pole, (n, n_poles), and the fraction that passes without delay, (n,).

        Participation is `shape(impact) shape(sensor) / modal mass` [1/kg], (n, n_modes), or None for a force.
        """
        residues, filters = self._residues
        if participation is None:
            return filters, np.full(1, float(self._passes))
        # Not with BLAS, whose last digits depend on the number of threads.
        mixed = np.einsum("nm,mf->nf", participation.real, filters[0])
        if np.iscomplexobj(participation):
            mixed = mixed + np.einsum("nm,mf->nf", participation.imag, filters[1])
        passes = self.quantity == "acceleration" and self._passes
        direct = participation.real.sum(axis=1) if passes else np.zeros(len(participation))
        return np.concatenate([participation * residues, mixed], axis=1), direct

    def frequency_response(self, frequencies: ArrayLike, participation: ArrayLike | None = None) -> Complex:
        """Return the complex response to a unit force at frequencies [Hz], (n_frequencies,), for `exp(+j omega t)`.

        They may be complex, for a damped transform. Participation is (n_modes,) [1/kg], or None for a force.

        At resonance one mode of 50 kg lags a quarter period behind the force:

        >>> shape = np.sqrt([1 / 50.0])
        >>> mode = Modes(
        ...     frequency=np.array([100.0]), damping_ratio=np.array([0.01]), at_impact=shape, at_sensor=shape
        ... )
        >>> response = Response(sampling_rate=1e4, quantity="acceleration", modes=mode)
        >>> float(response.frequency_response([100.0], mode.participation())[0].imag.round(9))
        1.0
        """
        rows = None if participation is None else np.atleast_2d(np.asarray(participation))
        amplitude, direct = self.amplitudes(rows)
        s = 2j * np.pi * np.asarray(frequencies)[:, None]
        pole, half = self.poles[None], np.where(self.poles.imag != 0, 0.5, 1.0) * amplitude[0]
        other = np.where(self.poles.imag != 0, half.conjugate() / (s - pole.conjugate()), 0.0)
        out = direct[0] + (half / (s - pole) + other).sum(axis=1)
        for part in self._smooth:
            step = 1 / (16 * part.frequency)
            taps = part.taps(step)
            out = out * (np.exp(-s * step * np.arange(taps.size)) @ taps)
        return np.asarray(out)

    def audible(self, participation: Floats | None) -> NDArray[np.intp]:
        """Return the poles needed for these pulses, the slowest decay first.

        The quietest modes are omitted as long as their sum stays below the tolerance, relative to the loudest mode, for
        every pulse.
        """
        loudness_ratio = np.full(self.poles.size, np.inf)  # the poles of filters are always needed
        if participation is not None:
            loudness = np.abs(participation) * self._loudness
            loudest = np.maximum(loudness.max(axis=1, keepdims=True), 1e-300)
            loudness_ratio[: self.n_modes] = (loudness / loudest).max(axis=0)
        quiet_first = np.argsort(loudness_ratio, kind="stable")
        audible = quiet_first[np.searchsorted(np.cumsum(loudness_ratio[quiet_first]), self.tolerance, side="right") :]
        return np.asarray(audible[np.argsort(-self.poles[audible].real, kind="stable")])

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
        """Add the response to n pulses to the recorder's frames (n_rows, n_samples), in place.

        Each pulse has an onset [s], which may precede its frame, a participation (n_modes,), a frame in `rows` (by
        default one per pulse; a frame may have several pulses) and a factor `ratio` of its force. The threads share the
        frames.
        """
        from cgid.physics.structure import _response

        n = len(onset)
        rows = np.arange(n) if rows is None else rows
        selected = self.audible(participation)
        amplitude, direct = self.amplitudes(participation)
        amplitude = np.broadcast_to(amplitude[:, selected], (n, selected.size))
        if ratio is not None:
            amplitude, direct = amplitude * ratio[:, None], direct * ratio
        parts = np.ascontiguousarray(np.stack([amplitude.real, amplitude.imag], axis=1))
        windows = Windows(pulses, onset, self.sampling_rate, self.tolerance, self._smooth)
        ringing = np.empty_like(parts)
        turn = np.ascontiguousarray(self._exponentials[:, selected, 1])
        driven = self._driven(selected, windows.strides)
        direct = np.ascontiguousarray(np.broadcast_to(direct, (n,)))
        # Two threads must not add to the same frame.
        shared = [np.arange(n)] if np.unique(rows).size < n else np.array_split(np.arange(n), threads)

        def strike(part: NDArray[np.intp]) -> None:
            _response.strike(
                frames, rows, windows.first, windows.stride, windows.count, windows.level, turn, *driven,
                windows.force, windows.drive, parts, direct, ringing, part,
            )  # fmt: skip

        in_parts(strike, shared, threads)
        self._ring(frames, rows, windows.first + windows.count, ringing, selected, threads)

    def _ring(
        self,
        frames: NDArray[Any],
        rows: NDArray[np.intp],
        start: NDArray[np.int64],
        ringing: Floats,
        selected: NDArray[np.intp],
        threads: int,
    ) -> None:
        from cgid.physics.structure import _response

        order = np.lexsort((start, rows))
        begin = np.searchsorted(rows[order], np.arange(len(frames) + 1))
        hop = np.ascontiguousarray(self._exponentials[:, selected, _TABLE])
        table = np.ascontiguousarray(self._exponentials[:, selected, :_TABLE], frames.dtype)

        def run(part: NDArray[np.intp]) -> None:
            some = slice(part[0], part[-1] + 1)
            _response.ring(
                frames[some], begin[part[0] : part[-1] + 2], order, start, ringing, table, hop, self.tolerance
            )

        in_parts(run, np.array_split(np.arange(len(frames)), threads), threads)

    def _driven(self, selected: NDArray[np.intp], strides: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Return the effect of a sample of each stride on the poles: polynomials, weights, and g1 of `_response`."""
        # Shapes (n_levels, largest stride, n_polynomials), (n_levels, 2, n_polynomials, n_poles), (n_levels, 2,
        # n_poles).
        levels = [self._samples_of(stride) for stride in strides.tolist()]
        polynomials = np.zeros((strides.size, strides[-1], self._n_polynomials))
        for level, stride in enumerate(strides.tolist()):
            polynomials[level, :stride] = levels[level].polynomials
        # One memory layout: the kernel compiles for each.
        weights = np.ascontiguousarray(np.stack([level.weights[:, :, selected] for level in levels]))
        return polynomials, weights, np.ascontiguousarray(np.stack([level.edge[:, selected] for level in levels]))

    @cached_property
    def _exponentials(self) -> Floats:
        """Exponential of every pole over the table's samples and one more, (2, n_poles, `_TABLE` + 1)."""
        grown = np.exp((self.poles / self.sampling_rate)[:, None] * np.arange(_TABLE + 1))
        return np.stack([grown.real, grown.imag])

    @cached_property
    def _n_polynomials(self) -> int:
        return polynomials_for(float(np.abs(self.poles).max()) / self.sampling_rate, self.tolerance)

    @cached_property
    def _driven_samples(self) -> dict[int, DrivenSample]:
        return {}

    def _samples_of(self, stride: int) -> DrivenSample:
        """Return the effect of a sample of this many steps on all poles, cached."""
        if stride not in self._driven_samples:
            self._driven_samples[stride] = DrivenSample(self.poles, self.sampling_rate, stride, self._n_polynomials)
        return self._driven_samples[stride]

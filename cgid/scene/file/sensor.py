"""The `[sensor]` section: from the force, or the motion of the beam, to a recorded signal."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import field_validator, model_validator

from cgid._lib.validation import Floats, Rule
from cgid.measure.filters import SENSOR_TAPER, fft_filter
from cgid.physics.structure.response import Filter, HighPass, LinearPhase, LowPass, Resonance
from cgid.scene.file.background import QUANTITIES, ColouredNoise
from cgid.scene.file.distributions import (
    LIMITS,
    DampingRatio,
    Frequency,
    Level,
    Number,
    Quantity,
    Section,
    WholeNumber,
    quantity_of,
)
from cgid.units import parse

#: Keys in the unit of the quantity -> suffix of the name of their dimension.
_LEVELS = {"absolute_noise": "", "noise_density": " noise density", "range": "", "offset": "", "drift": " per time"}
#: An offset, or its change: of either sign.
_Shift = Annotated[Number, Quantity(rule=Rule(-1e15, 1e15))]
#: Transition of a filter of linear phase over its edge, by default.
TRANSITION = 0.2
#: Minimum full scale relative to a peak.
_MIN_SCALE = 1e-25
#: Samples of a recording with one address: the longest period of a stream's coloured noise.
CHUNK = 1 << 16


class Mounting(Section):
    """The resonance of a sensor on its mounting: a stud at 30 kHz, a magnet at 7 kHz."""

    frequency: Frequency
    """Resonance frequency."""
    damping_ratio: DampingRatio = 0.05
    """Fraction of critical damping."""


class AntiAlias(Section):
    """The low-pass before the converter: a Butterworth filter, or one of linear phase as of sigma-delta converters."""

    frequency: Frequency
    """-3 dB point; -6 dB point of a linear phase."""
    order: Annotated[WholeNumber, Quantity(rule=Rule(1, 12))] = 8
    """Order of a Butterworth filter."""
    kind: Literal["butterworth", "linear-phase"] | None = None
    """Butterworth by default. A filter of linear phase has a finite impulse response, a sinc under a Gaussian, and
    delays all frequencies by half its length; for motions of a beam.
    """
    transition: Annotated[Number, Quantity("ratio", Rule(0.05, 1))] | None = None
    """Of a linear phase: from 99 % to 1 % of the amplitude, over the frequency; 0.2 by default."""

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.linear and self.order != AntiAlias.model_fields["order"].default:
            raise ValueError("order must be left out, a filter of linear phase has none")
        if self.transition is not None and not self.linear:
            raise ValueError("transition must be left out of a Butterworth filter; give order, or kind linear-phase")
        return self

    @property
    def linear(self) -> bool:
        """Whether its phase is linear."""
        return self.kind == "linear-phase"

    @property
    def filter(self) -> LowPass | LinearPhase:
        """The filter itself."""
        if self.linear:
            return LinearPhase(frequency=self.frequency, transition=self.transition or TRANSITION)
        return LowPass(frequency=self.frequency, order=self.order)


class Sensor(Section):
    """A sensor and its recorder.

    The stages of the measuring chain are, in order: mounting, anti-alias filter, AC coupling, bandwidth, gain,
    noise, offset and drift, range, bits. Each stage is off by default. Levels are in the unit of the quantity, as
    numbers or strings with a unit.
    """

    quantity: Literal["force", "acceleration", "velocity", "displacement"] = "force"
    """The contact force, or the motion of the tail beam at the sensor."""
    mounting: Mounting | None = None
    """Resonance that amplifies nearby frequencies."""
    anti_alias: AntiAlias | None = None
    """Causal low-pass; it delays the signal."""
    ac_coupling: Frequency | None = None
    """-3 dB point of the high-pass of first order at the input of the recorder; none by default."""
    relative_noise: Annotated[float, Quantity("ratio", Rule(0, 1e6))] = 0.0
    """Standard deviation of the noise over the largest sample of each signal; for a force over the true peak."""
    absolute_noise: Level = 0.0
    """Standard deviation of the noise."""
    noise_density: Level | None = None
    """White noise per sqrt(Hz); its standard deviation is this times sqrt(sampling rate / 2). The powers of the noises
    add up.
    """
    noise_exponent: Annotated[Number, Quantity(rule=Rule(-1, 2))] | None = None
    """Makes relative and absolute noise coloured: its power per Hz falls with frequency to the power of this. 0
    is white, 1 pink, 2 brown. It is flat below one period of the frame, in a stream of 65,536 samples; the
    standard deviation of the noise is the stated one.
    """
    noise_spectrum: ColouredNoise | None = None
    """The same by a measured spectrum, scaled to the stated standard deviation; or the name of a CSV file next to the
    scene file with columns `frequency [Hz]` and `density [N/sqrt(Hz)]`, in any unit per sqrt(Hz). It must extend from
    one period of the frame (or 65,536 samples), below which it is flat, to half the sampling rate.
    """
    bandwidth: Frequency | None = None
    """Half-amplitude frequency of a zero-phase low-pass [Hz], with a raised-cosine transition half as wide;
    excludes `anti_alias`.
    """
    gain: Annotated[Number, Quantity(rule=Rule(-1e9, 1e9))] | None = None
    """Factor of a motion of the beam, negative for an inverted sensor. `calibrated` fits it to recordings of a beam
    with given dimensions. It does not change the contact with a rock.
    """
    offset: _Shift | None = None
    """Constant shift."""
    drift: _Shift | None = None
    """Change of the offset per second, from the first sample on."""
    range: Annotated[float, Quantity(rule=Rule(*LIMITS["force"]))] | None = None
    """Full scale: samples are clipped at +- this value."""
    relative_range: Annotated[float, Quantity("ratio", Rule(1e-3, 1e6))] | None = None
    """Full scale over the largest sample of each signal before the noise, for a force over the true peak: below
    1 it is clipped. Excludes `range`; not for a stream.
    """
    bits: Annotated[WholeNumber, Quantity(rule=Rule(2, 32))] | None = None
    """Resolution of the converter over its full scale; needs `range` or `relative_range`."""

    @field_validator(*_LEVELS, mode="before")
    @classmethod
    def _in_si(cls, value: Any, info: Any) -> Any:
        quantity = info.data.get("quantity")
        if value is None or quantity is None:  # an invalid quantity has its own error
            return value
        rule, dimension = quantity_of(cls.model_fields[info.field_name]), QUANTITIES[quantity][0]
        number = parse(value, dimension + _LEVELS[info.field_name])
        assert rule is not None
        replace(rule, dimension=dimension + _LEVELS[info.field_name]).require(number, value)  # with its unit
        return number

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.bandwidth is not None and self.anti_alias is not None:
            raise ValueError("must have either bandwidth (zero phase) or anti_alias (causal)")
        if self.quantity == "force" and self.anti_alias is not None and self.anti_alias.linear:
            raise ValueError("anti_alias.kind must be butterworth for a force, or bandwidth a zero-phase low-pass")
        if self.gain is not None and self.quantity == "force":
            raise ValueError("gain must be left out for a force, it applies to motions of the beam")
        if self.gain == 0:
            raise ValueError("gain must not be 0; leave it out for a gain of 1")
        return self

    def problems(self, band: tuple[float, float], drawn: Collection[str]) -> list[str]:
        """Return error messages for the converter, and the noise in a band [Hz], with some randomised settings."""
        problems, scales = [], self._given(("range", "relative_range"), drawn)
        if len(scales) > 1:
            problems.append("sensor.range: must be left out with relative_range; use one of the two")
        if self._given(("bits",), drawn) and not scales:
            problems.append("sensor.bits: needs range or relative_range, without which there is no step; give one")
        if self._given(("bandwidth",), drawn) and "anti_alias_frequency" in drawn:
            problems.append("randomise.anti_alias_frequency: must be left out with bandwidth; use one of the two")
        return problems + self._problems_of_noise(band, drawn)

    def _given(self, names: Iterable[str], drawn: Collection[str]) -> list[str]:
        return [name for name in names if getattr(self, name) is not None or name in drawn]

    def _problems_of_noise(self, band: tuple[float, float], drawn: Collection[str]) -> list[str]:
        problems, colours = [], self._given(("noise_exponent", "noise_spectrum"), drawn)
        if not colours:
            return []
        if len(colours) > 1:
            problems.append(f"sensor.noise_spectrum: must be left out with {colours[0]}; use one of the two")
        if self.noise_density:
            problems.append(
                f"sensor.noise_density: must be left out with {colours[0]}, since it is of white noise; give the "
                "standard deviation of the noise as absolute_noise, or white noise as background.coloured"
            )
        elif not self.noisy and "relative_noise" not in drawn:
            problems.append(
                f"sensor.{colours[0]}: needs relative_noise or absolute_noise, the level of the noise; give one of "
                "these, or leave it out"
            )
        if self.noise_spectrum is not None:
            problems += self.noise_spectrum.problems("sensor.noise_spectrum", self.quantity)
            first, last = self.noise_spectrum.frequencies[0], self.noise_spectrum.frequencies[-1]
            if first > band[0] or last < band[1]:
                problems.append(
                    f"sensor.noise_spectrum.frequencies: must extend from one period of the signals, {band[0]:g} Hz, "
                    f"to half the sampling rate, {band[1]:g} Hz, got {first:g} to {last:g} Hz; measure the missing "
                    "part, or add rows for it"
                )
        return problems

    @property
    def unit(self) -> str:
        """The SI unit of its quantity."""
        return QUANTITIES[self.quantity][1]

    @property
    def filters(self) -> tuple[Filter, ...]:
        """The filters: mounting, anti-alias and AC coupling."""
        return _filters(self.mounting, self.anti_alias, self.ac_coupling)

    @property
    def noisy(self) -> bool:
        """Whether the sensor adds noise."""
        return self.relative_noise > 0 or self.absolute_noise > 0 or bool(self.noise_density)

    @property
    def coloured(self) -> bool:
        """Whether its noise is not white."""
        return bool(self.noise_exponent) or self.noise_spectrum is not None

    def noise_level(self, peak: Floats, sampling_rate: float) -> Floats:
        """Return the standard deviation of the noise for signals with these peaks."""
        density, relative = self.noise_density or 0.0, self.relative_noise * peak
        # Not hypot, whose last digit differs between C libraries.
        steady = self.absolute_noise * self.absolute_noise + density * density * (sampling_rate / 2)
        return np.asarray(np.sqrt(relative * relative + steady))

    def limit_band(self, frames: NDArray[np.floating], sampling_rate: float) -> NDArray[np.floating]:
        """Return the frames after the sensor's zero-phase low-pass."""
        if self.bandwidth is None:
            return frames
        rows = np.asarray(frames, np.float64)
        return fft_filter(rows, sampling_rate, high=self.bandwidth, taper=SENSOR_TAPER).astype(frames.dtype)

    def full_scale(self, peak: Floats) -> float | Floats | None:
        """Return the full scale for signals with these peaks, if any."""
        if self.relative_range is None:
            return self.range
        # A signal of zeros needs a step, too.
        return np.asarray(np.maximum(self.relative_range * peak, _MIN_SCALE))

    def digitise(self, frames: NDArray[np.floating], sampling_rate: float, peak: Floats, first: int = 0) -> None:
        """Apply offset, drift, range and bits to frames (n, n_samples) with these peaks (n,), in place.

        first is the number of the first sample, counted from switching on the sensor.
        """
        if self.drift:
            frames += (self.drift / sampling_rate * np.arange(first, first + frames.shape[-1])).astype(frames.dtype)
        if self.offset:
            frames += frames.dtype.type(self.offset)
        full: Any = self.full_scale(peak)
        if full is None:
            return
        if self.relative_range is not None:
            full = full[:, None].astype(frames.dtype)
        highest = full
        if self.bits is not None:
            step = full / 2 ** (self.bits - 1)
            np.multiply(np.rint(frames / step), step, out=frames)
            highest = full - step
        np.clip(frames, -full, highest, out=frames)


@lru_cache(maxsize=16)
def _filters(mounting: Mounting | None, anti_alias: AntiAlias | None, coupling: float | None) -> tuple[Filter, ...]:
    parts: list[Filter] = []
    if mounting is not None:
        parts.append(Resonance(**mounting.model_dump()))
    if anti_alias is not None:
        parts.append(anti_alias.filter)
    if coupling is not None:
        parts.append(HighPass(frequency=coupling))
    return tuple(parts)


def clip(frames: NDArray[np.floating], level: Floats) -> None:
    """Clip each frame at +- its own level in place; nan means no clipping."""
    rows = np.flatnonzero(np.isfinite(level))
    height = level[rows, None].astype(frames.dtype)
    frames[rows] = np.clip(frames[rows], -height, height)

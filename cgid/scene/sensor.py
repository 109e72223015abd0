"""The `[sensor]` and `[background]` sections: from the force, or the motion of the beam, to a recorded signal.

A background adds hum lines, coloured noise of a given spectrum, or a recording. Its levels apply after the sensor's
bandwidth, in the unit of its quantity; `cgid.scene.noise` makes the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_validator, model_validator

from cgid.counting import count
from cgid.elementary import exp, expm1, log
from cgid.files import require_regular
from cgid.measure.filters import SENSOR_TAPER, fft_filter, filter_gain
from cgid.physics.response import LowPass, Resonance
from cgid.recordings.recording import told
from cgid.scene.distributions import Decibel, Frequency, Level, Number, Ratio, Whole
from cgid.scene.sections import Section
from cgid.units import parse
from cgid.validation import Floats

#: The quantity of a sensor -> the dimension of its levels, and its SI unit.
QUANTITIES = {
    "force": ("force", "N"),
    "acceleration": ("acceleration", "m/s^2"),
    "velocity": ("speed", "m/s"),
    "displacement": ("length", "m"),
}
#: The keys in the unit of the quantity -> suffix of the name of their dimension.
_LEVELS = {"absolute_noise": "", "noise_density": " noise density", "range": "", "offset": "", "drift": " per time"}


class Mounting(Section):
    """The resonance of a sensor on its mounting: a stud at 30 kHz, a magnet at 7 kHz.

    Parameters
    ----------
    frequency : float [Hz]
        Resonance frequency.
    damping_ratio : float
        Share of critical damping.
    """

    frequency: Frequency
    damping_ratio: Ratio = Field(default=0.05, gt=0, lt=1)


class AntiAlias(Section):
    """The Butterworth low-pass before the converter; `frequency` is its -3 dB point.

    Parameters
    ----------
    frequency : float [Hz]
        -3 dB point.
    order : int
        Order of the filter.
    """

    frequency: Frequency
    order: Whole = Field(default=8, ge=1, le=12)


class Sensor(Section):
    """A sensor and its recorder.

    The order is that of a measuring chain: mounting, anti-alias filter or bandwidth, gain, noise, offset and drift,
    range, bits. Each stage is off when left out. Levels are in the unit of the quantity, as numbers or strings with a
    unit.

    Parameters
    ----------
    quantity : {"force", "acceleration", "velocity", "displacement"}
        The contact force, or the motion of the tail beam at the sensor.
    mounting : Mounting, optional
        Resonance that amplifies nearby frequencies.
    anti_alias : AntiAlias, optional
        Causal low-pass; it delays the signal.
    bandwidth : float, optional
        Half-amplitude frequency of a zero-phase low-pass [Hz], with a raised-cosine transition half as wide; excludes
        `anti_alias`.
    gain : float, optional
        Factor of a motion of the beam, negative for an inverted sensor. `calibrated` fits it to recordings where the
        beam is known by its dimensions. It does not change how the beam yields to a rock.
    relative_noise : float
        Standard deviation of white noise over the largest sample of each signal; for a force over the true peak.
    absolute_noise : float
        Standard deviation of white noise.
    noise_density : float
        White noise per sqrt(Hz); its standard deviation is this times sqrt(sampling rate / 2). The noises add in power.
    offset : float, optional
        Constant shift.
    drift : float, optional
        Change of the offset per second, from the first sample on.
    range : float, optional
        Full scale: samples are clipped at +- this value.
    bits : int, optional
        Resolution of the converter over its full scale; needs `range`.
    """

    quantity: Literal["force", "acceleration", "velocity", "displacement"] = "force"
    mounting: Mounting | None = None
    anti_alias: AntiAlias | None = None
    relative_noise: Ratio = Field(default=0.0, ge=0, le=1e6)
    absolute_noise: Level = 0.0
    noise_density: Level | None = None
    bandwidth: Frequency | None = None
    gain: Number | None = Field(default=None, ge=-1e9, le=1e9)
    offset: Number | None = Field(default=None, ge=-1e15, le=1e15)
    drift: Number | None = Field(default=None, ge=-1e15, le=1e15)
    range: Level | None = Field(default=None, ge=1e-9)
    bits: Whole | None = Field(default=None, ge=2, le=32)

    @field_validator(*_LEVELS, mode="before")
    @classmethod
    def _in_si(cls, value: Any, info: Any) -> Any:
        quantity = info.data.get("quantity")
        if value is None or quantity is None:  # an invalid quantity has its own error
            return value
        return parse(value, QUANTITIES[quantity][0] + _LEVELS[info.field_name])

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.bits is not None and self.range is None:
            raise ValueError("bits must come with range: without a full scale there is no step")
        if self.bandwidth is not None and self.anti_alias is not None:
            raise ValueError("must have either bandwidth (zero phase) or anti_alias (causal), and not both")
        if self.gain is not None and self.quantity == "force":
            raise ValueError("gain must be left out for a force, it is that of a motion of the beam")
        if self.gain == 0:
            raise ValueError("gain must not be 0, where nothing is heard; leave it out for a gain of 1")
        return self

    @property
    def unit(self) -> str:
        """The SI unit of its quantity."""
        return QUANTITIES[self.quantity][1]

    @property
    def filters(self) -> tuple[Resonance | LowPass, ...]:
        """The filters with poles: mounting and anti-alias."""
        parts: list[Resonance | LowPass] = []
        if self.mounting is not None:
            parts.append(Resonance(**self.mounting.model_dump()))
        if self.anti_alias is not None:
            parts.append(LowPass(**self.anti_alias.model_dump()))
        return tuple(parts)

    @property
    def noisy(self) -> bool:
        """Whether the sensor adds noise."""
        return self.relative_noise > 0 or self.absolute_noise > 0 or bool(self.noise_density)

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
        # Compiled on import, and most scenes do not need it.
        from cgid.scene import _fourier

        length = frames.shape[-1]
        if not _fourier.transformable(length):
            return fft_filter(frames, sampling_rate, high=self.bandwidth, taper=SENSOR_TAPER)
        count("filtered_frames", frames.size // length)
        frequency = np.asarray(np.fft.rfftfreq(length, 1 / sampling_rate), np.float64)
        gain = filter_gain(frequency, sampling_rate, None, self.bandwidth, SENSOR_TAPER)
        return np.asarray(_fourier.filtered(frames.reshape(-1, length), gain)).reshape(frames.shape)

    def digitise(self, frames: NDArray[np.floating], sampling_rate: float, first: int = 0) -> None:
        """Apply offset, drift, range and bits to the frames in place.

        first is the number of the first sample, counted from switching on the sensor.
        """
        if self.drift:
            frames += (self.drift / sampling_rate * np.arange(first, first + frames.shape[-1])).astype(frames.dtype)
        if self.offset:
            frames += frames.dtype.type(self.offset)
        if self.range is None:
            return
        highest = self.range
        if self.bits is not None:
            step = self.range / 2 ** (self.bits - 1)
            np.multiply(np.rint(frames / step), step, out=frames)
            highest = self.range - step
        np.clip(frames, -self.range, highest, out=frames)


def clip(frames: NDArray[np.floating], level: Floats) -> None:
    """Clip each frame at +- its own level in place; nan means no clipping."""
    rows = np.flatnonzero(np.isfinite(level))
    height = level[rows, None].astype(frames.dtype)
    frames[rows] = np.clip(frames[rows], -height, height)


#: Largest recorded background; it is held in memory [bytes].
_LARGEST_RECORDING = 1 << 30


def _number_or_text(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise ValueError(f"must be a number or a string with a unit, got {value!r}")


#: A number in the SI unit of the sensor's quantity, or a string with a unit; read once the quantity is known.
Sensed = Annotated[Any, AfterValidator(_number_or_text)]


def _level(value: float | str, quantity: str, kind: str = "") -> float:
    """Return a level in the SI unit of a quantity; raises `ValueError` for another unit or a level not above 0."""
    number = parse(value, QUANTITIES[quantity][0] + kind)
    if not 0 < number <= 1e15:
        raise ValueError(f"must be above 0 and at most 1e15 {QUANTITIES[quantity][1]}, got {number:g}")
    return number


class HumLine(Section):
    """A sine of fixed frequency and amplitude; its phase is drawn for each signal.

    Parameters
    ----------
    frequency : float [Hz]
        Frequency of the sine.
    amplitude : float or str
        Amplitude, in the unit of the sensor's quantity.
    """

    frequency: Frequency
    amplitude: Sensed


class ColouredNoise(Section):
    """Gaussian noise of a one-sided amplitude density, linear between its points on logarithmic axes, 0 outside.

    The density is per sqrt(Hz): "0.1 N/sqrt(Hz)", or a number in the SI unit.

    Parameters
    ----------
    frequencies : tuple of float [Hz]
        Ascending points.
    density : tuple of float or str
        Density at these points.
    """

    frequencies: tuple[Frequency, ...] = Field(min_length=2, max_length=100_000)
    density: tuple[Sensed, ...]

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if len(self.density) != len(self.frequencies):
            raise ValueError(
                f"density must have as many numbers as frequencies, {len(self.frequencies)}, got {len(self.density)}"
            )
        for before, after in pairwise(self.frequencies):
            if not before < after:
                raise ValueError(f"frequencies must ascend, got {after:g} Hz after {before:g} Hz")
        return self

    def densities(self, quantity: str) -> Floats:
        """Return the power densities at the frequencies: the squares of the given densities, in SI units per Hz."""
        return np.array([_level(value, quantity, " noise density") for value in self.density]) ** 2

    def at(self, frequency: Floats, quantity: str) -> Floats:
        """Return the one-sided power spectral density at frequencies [Hz], in SI units."""
        knots = log(self.frequencies)
        place = log(frequency)
        level = exp(np.interp(place, knots, log(self.densities(quantity))))
        # Compare logarithms, so that the band includes its ends.
        return np.asarray(np.where((place >= knots[0]) & (place <= knots[-1]), level, 0.0))

    def power(self, quantity: str) -> float:
        """Return the mean square of the noise: the integral of the density, which is a power law between points."""
        f, s = np.array(self.frequencies), self.densities(quantity)
        ratio = log(f[1:] / f[:-1])
        exponent = log(s[1:] / s[:-1]) / ratio + 1
        # s0 f0 (r^p - 1) / p with r = f1 / f0, and s0 f0 ln r where p is 0.
        growth = exponent * ratio
        mean = np.where(np.abs(growth) < 1e-12, 1.0, expm1(growth) / np.where(growth == 0, 1.0, growth))
        return float(np.sum(s[:-1] * f[:-1] * ratio * mean))


class RecordedBackground(Section):
    """A recording without its mean, mixed in from a random start and repeated endlessly.

    The signal-to-noise ratio compares the median peak of the scene's impacts (first hits, drawn by the weights of the
    populations) with the root mean square of the background.

    Parameters
    ----------
    path : str
        A recording, relative to the scene file.
    signal_to_noise : float [dB]
        Level of the impacts over the background.
    sampling_rate : float, optional [Hz]
        Where the recording does not say it.
    channel : str, optional
        Name or number of the channel.
    """

    path: str = Field(min_length=1, max_length=4096)
    signal_to_noise: Decibel
    sampling_rate: Frequency | None = None
    channel: str | None = None

    def file(self, folder: Path) -> Path:
        """Return the file in a folder; raises `NoInput`, or `BadData` for a pipe, a device or too large a file."""
        path = folder / self.path
        with told(str(path)):
            require_regular(path, "a recorded background", _LARGEST_RECORDING)
        return path


class BackgroundSection(Section):
    """Signals recorded in addition to impacts; at least one of its parts.

    Parameters
    ----------
    hum : tuple of HumLine
        Sines, such as the mains.
    coloured : ColouredNoise, optional
        Noise of a given spectrum.
    recorded : RecordedBackground, optional
        A recording that is mixed in.
    """

    hum: tuple[HumLine, ...] = Field(default=(), max_length=1000)
    coloured: ColouredNoise | None = None
    recorded: RecordedBackground | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.hum and self.coloured is None and self.recorded is None:
            raise ValueError("must have at least one of hum, coloured, recorded; or take it out")
        return self

    def problems(self, sensor: Sensor, sampling_rate: float) -> list[str]:
        """Return error messages for this background with a sensor and a sampling rate [Hz]."""
        quantity, nyquist = sensor.quantity, sampling_rate / 2
        found = []
        for index, line in enumerate(self.hum):
            if line.frequency >= nyquist:
                found.append(
                    f"background.hum.{index}.frequency: must be below half the sampling rate, {nyquist:g} Hz, got "
                    f"{line.frequency:g} Hz"
                )
            found += _complaints(
                f"background.hum.{index}.amplitude", partial(_level, quantity=quantity), [line.amplitude]
            )
        if self.coloured is not None:
            highest = self.coloured.frequencies[-1]
            if highest > nyquist:
                found.append(
                    f"background.coloured.frequencies: must lie up to half the sampling rate, {nyquist:g} Hz, got "
                    f"{highest:g} Hz; cut the table there"
                )
            read = partial(_level, quantity=quantity, kind=" noise density")
            found += _complaints("background.coloured.density", read, self.coloured.density)
        return found

    def known_power(self, quantity: str) -> float:
        """Return the mean square of hum and coloured noise in SI units; that of a recording depends on the impacts."""
        lines = sum(0.5 * _level(line.amplitude, quantity) * _level(line.amplitude, quantity) for line in self.hum)
        return lines + (0.0 if self.coloured is None else self.coloured.power(quantity))

    def amplitudes(self, quantity: str) -> Floats:
        """Return the amplitudes of the hum lines in SI units."""
        return np.array([_level(line.amplitude, quantity) for line in self.hum])


def _complaints(path: str, read: Callable[[Any], float], values: Iterable[Any]) -> list[str]:
    """Return error messages for unreadable values."""
    found = []
    for value in values:
        try:
            read(value)
        except ValueError as error:
            found.append(f"{path}: {error}")
    return found

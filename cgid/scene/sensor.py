"""The sensor: what becomes of the true force, or of the motion of the beam, on its way into the frame."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from cgid.counting import count
from cgid.measure.filters import SENSOR_TAPER, fft_filter, filter_gain
from cgid.physics.response import LowPass, Resonance
from cgid.scene.sections import Section
from cgid.scene.units import Frequency, Level, Number, Ratio, Whole
from cgid.units import parse
from cgid.validation import Floats

#: What a sensor may feel -> the dimension of its levels, and its SI unit.
QUANTITIES = {
    "force": ("force", "N"),
    "acceleration": ("acceleration", "m/s^2"),
    "velocity": ("speed", "m/s"),
    "displacement": ("length", "m"),
}
#: The keys in the unit of the quantity, and what is behind its dimension.
_LEVELS = {"absolute_noise": "", "noise_density": " noise density", "range": "", "offset": "", "drift": " per time"}


class Mounting(Section):
    """The resonance of a sensor on its mounting: a stud at 30 kHz, a magnet at 7 kHz."""

    frequency: Frequency
    damping_ratio: Ratio = Field(default=0.05, gt=0, lt=1)


class AntiAlias(Section):
    """The low-pass before the converter, a Butterworth filter: `frequency` is where it is 3 dB down."""

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
        The contact force itself, or the motion of the tail beam at the sensor.
    mounting : Mounting, optional
        Its resonance amplifies what is near to it.
    anti_alias : AntiAlias, optional
        Causal: it delays the signal.
    bandwidth : float, optional
        Edge of a zero-phase low-pass [Hz], gain 1/2 there, with a raised-cosine edge half as wide; in place of an
        anti-alias filter.
    gain : float, optional
        What a motion of the beam is multiplied by, below 0 for a sensor the other way up: what `calibrated` finds
        between recordings and a beam known by its sizes. It changes nothing of how the beam gives way to a rock.
    relative_noise : float
        Standard deviation of the white noise over the largest sample of each signal; for a force over the true peak.
    absolute_noise : float
        Standard deviation of the white noise.
    noise_density : float
        White noise in a band of 1 Hz; over sqrt(half the sampling rate) its standard deviation. All noises together
        add in power.
    offset, drift : float
        What is added to every sample, and by how much that changes in a second, from the first sample on.
    range : float, optional
        Full scale: what lies beyond +- this is clipped.
    bits : int, optional
        Of the converter over its full scale; needs `range`.
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
        if value is None or quantity is None:  # a quantity that is wrong is said to be by itself
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
        """The SI unit of what it feels."""
        return QUANTITIES[self.quantity][1]

    @property
    def filters(self) -> tuple[Resonance | LowPass, ...]:
        """What has poles of its own: mounting and anti-alias filter."""
        parts: list[Resonance | LowPass] = []
        if self.mounting is not None:
            parts.append(Resonance(**self.mounting.model_dump()))
        if self.anti_alias is not None:
            parts.append(LowPass(**self.anti_alias.model_dump()))
        return tuple(parts)

    @property
    def noisy(self) -> bool:
        """Whether there is any noise to draw."""
        return self.relative_noise > 0 or self.absolute_noise > 0 or bool(self.noise_density)

    def noise_level(self, peak: Floats, sampling_rate: float) -> Floats:
        """Return the standard deviation of the noise for signals of these peaks."""
        density, relative = self.noise_density or 0.0, self.relative_noise * peak
        # Not hypot, whose last digit is each C library's own.
        steady = self.absolute_noise * self.absolute_noise + density * density * (sampling_rate / 2)
        return np.asarray(np.sqrt(relative * relative + steady))

    def limit_band(self, frames: NDArray[np.floating], sampling_rate: float) -> NDArray[np.floating]:
        """Return the frames after the sensor's zero-phase low-pass."""
        if self.bandwidth is None:
            return frames
        # Loaded here: it compiles, and most scenes do without.
        from cgid.scene import _fourier

        length = frames.shape[-1]
        if not _fourier.transformable(length):
            return fft_filter(frames, sampling_rate, high=self.bandwidth, taper=SENSOR_TAPER)
        count("filtered_frames", frames.size // length)
        frequency = np.asarray(np.fft.rfftfreq(length, 1 / sampling_rate), np.float64)
        gain = filter_gain(frequency, sampling_rate, None, self.bandwidth, SENSOR_TAPER)
        return np.asarray(_fourier.filtered(frames.reshape(-1, length), gain)).reshape(frames.shape)

    def digitise(self, frames: NDArray[np.floating], sampling_rate: float, first: int = 0) -> None:
        """Shift, clip and round the frames in place, as far as the sensor has offset, drift, range and bits.

        first is the number of the first sample since the sensor was switched on.
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
    """Cut each frame off at +- its own level in place; a level of nan leaves it as it is."""
    rows = np.flatnonzero(np.isfinite(level))
    height = level[rows, None].astype(frames.dtype)
    frames[rows] = np.clip(frames[rows], -height, height)

"""The `[background]` section: what a sensor records besides impacts and its own white noise.

Three kinds, which add: hum lines, coloured noise of a given spectrum, and a recording. They come as the sensor
gives them, behind its bandwidth, in the unit of its quantity. `cgid.scene.background_noise` makes the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cgid.elementary import exp, expm1, log
from cgid.files import require_regular
from cgid.recordings.recording import told
from cgid.scene.sections import Section
from cgid.scene.sensor import QUANTITIES, Sensor
from cgid.scene.units import Decibel, Frequency
from cgid.units import parse
from cgid.validation import Floats

#: A recorded background is held in memory [bytes].
_LARGEST_RECORDING = 1 << 30


def _number_or_text(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise ValueError(f"must be a number or a string with a unit, got {value!r}")


#: A number in the SI unit of the sensor's quantity, or a string with a unit: only the whole scene knows which one.
Sensed = Annotated[Any, AfterValidator(_number_or_text)]


def _level(value: float | str, quantity: str, kind: str = "") -> float:
    """Return a level in the SI unit of a quantity; raises `ValueError` for another unit, or what is not above 0."""
    number = parse(value, QUANTITIES[quantity][0] + kind)
    if not 0 < number <= 1e15:
        raise ValueError(f"must be above 0 and at most 1e15 {QUANTITIES[quantity][1]}, got {number:g}")
    return number


class HumLine(Section):
    """A sine of fixed frequency and amplitude; its phase is drawn for each signal."""

    frequency: Frequency
    amplitude: Sensed


class ColouredNoise(Section):
    """Gaussian noise of a one-sided amplitude density, straight between its points on logarithmic axes, 0 beyond.

    As a sensor's noise density it is what a band of 1 Hz has: "0.1 N/sqrt(Hz)", or a number in the SI unit.
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
        """Return the power densities at the frequencies: the squares of what is asked, in SI units per Hz."""
        return np.array([_level(value, quantity, " noise density") for value in self.density]) ** 2

    def at(self, frequency: Floats, quantity: str) -> Floats:
        """Return the one-sided power spectral density at frequencies [Hz], in SI units."""
        knots = log(self.frequencies)
        place = log(frequency)
        level = exp(np.interp(place, knots, log(self.densities(quantity))))
        # Compared as logarithms, so that the ends themselves belong to the band.
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
    """A recording, mixed in from a random start on and repeated without end, its mean taken out.

    The signal to noise ratio is that of the median peak of the scene's impacts (first hits, drawn by the weights of
    the populations) to the root mean square of the background.
    """

    path: str = Field(min_length=1, max_length=4096)
    signal_to_noise: Decibel
    sampling_rate: Frequency | None = None
    channel: str | None = None

    def file(self, folder: Path) -> Path:
        """Return the file, which lies in a folder; raises `NoInput`, or `BadData` for a pipe, a device or too much."""
        path = folder / self.path
        with told(str(path)):
            require_regular(path, "a recorded background", _LARGEST_RECORDING)
        return path


class BackgroundSection(Section):
    """What is recorded besides impacts; at least one of its parts."""

    hum: tuple[HumLine, ...] = Field(default=(), max_length=1000)
    coloured: ColouredNoise | None = None
    recorded: RecordedBackground | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.hum and self.coloured is None and self.recorded is None:
            raise ValueError("must have at least one of hum, coloured, recorded; or take it out")
        return self

    def problems(self, sensor: Sensor, sampling_rate: float) -> list[str]:
        """Return what is wrong with this background for a sensor and a sampling rate [Hz]."""
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
        """Return the mean square of hum and coloured noise, in SI units; a recording's depends on the impacts."""
        lines = sum(0.5 * _level(line.amplitude, quantity) * _level(line.amplitude, quantity) for line in self.hum)
        return lines + (0.0 if self.coloured is None else self.coloured.power(quantity))

    def amplitudes(self, quantity: str) -> Floats:
        """Return the amplitudes of the hum lines in SI units."""
        return np.array([_level(line.amplitude, quantity) for line in self.hum])


def _complaints(path: str, read: Callable[[Any], float], values: Iterable[Any]) -> list[str]:
    """Return what is said about values that cannot be read."""
    found = []
    for value in values:
        try:
            read(value)
        except ValueError as error:
            found.append(f"{path}: {error}")
    return found

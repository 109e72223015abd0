"""The `[background]` section: hum lines, coloured noise of a given spectrum, a recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cgid._lib.files import read_cells, require_regular
from cgid._lib.validation import Floats, Rule
from cgid.errors import BadData
from cgid.scene.file.distributions import Decibel, Frequency, Quantity, Section
from cgid.units import parse

#: The quantity of a sensor -> the dimension of its levels, and its SI unit.
QUANTITIES = {
    "force": ("force", "N"),
    "acceleration": ("acceleration", "m/s^2"),
    "velocity": ("speed", "m/s"),
    "displacement": ("length", "m"),
}
#: Frequency of the mains without `randomise.hum_frequency` [Hz].
HUM_FREQUENCY = 50.0
#: Minimum level of a background, whose square does not underflow.
_MIN_LEVEL = 1e-100
#: Largest recorded background; it is held in memory [bytes].
_MAX_RECORDING = 1 << 30
#: Largest table of a spectrum [bytes], and the title of its densities.
_MAX_SPECTRUM = 8 << 20
_DENSITY = re.compile(r"density \[[^\]]+/sqrt\(Hz\)\]")


def _number_or_text(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise ValueError(f"must be a number or a string with a unit, got {value!r}")


#: A number in the SI unit of the sensor's quantity, or a string with a unit; read once the quantity is known.
Sensed = Annotated[Any, AfterValidator(_number_or_text)]


def _level(value: float | str, quantity: str, kind: str = "") -> float:
    """Return a level in the SI unit of a quantity; raises `ValueError` for another unit or a level not above 0."""
    number = parse(value, QUANTITIES[quantity][0] + kind)
    if not _MIN_LEVEL <= number <= 1e15:
        unit = QUANTITIES[quantity][1]
        raise ValueError(f"must be above 0, within {_MIN_LEVEL:g} and 1e+15 {unit}, got {number:g}")
    return number


class ColouredNoise(Section):
    """Gaussian noise of a one-sided amplitude density, linear between its points on logarithmic axes.

    The density is per sqrt(Hz): "0.1 N/sqrt(Hz)", or a number in the SI unit. That of a background is 0 outside.
    """

    frequencies: Annotated[tuple[float, ...], Quantity.of("frequency")] = Field(min_length=2, max_length=100_000)
    """Ascending points."""
    density: tuple[Sensed, ...]
    """Density at these points."""

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

    def problems(self, path: str, quantity: str) -> list[str]:
        """Return error messages for densities that are not densities of a quantity."""
        read = partial(_level, quantity=quantity, kind=" noise density")
        return _complaints(f"{path}.density", read, self.density)

    def densities(self, quantity: str) -> Floats:
        """Return the power densities at the frequencies: the squares of the given densities, in SI units per Hz."""
        return np.array([_level(value, quantity, " noise density") for value in self.density]) ** 2

    def at(self, frequency: Floats, quantity: str) -> Floats:
        """Return the one-sided power spectral density at frequencies [Hz], in SI units."""
        knots = np.log(self.frequencies)
        with np.errstate(divide="ignore"):  # -inf at 0 Hz
            place = np.log(frequency)
        level = np.exp(np.interp(place, knots, np.log(self.densities(quantity))))
        # Compare logarithms, so that the band includes its ends.
        return np.asarray(np.where((place >= knots[0]) & (place <= knots[-1]), level, 0.0))

    def power(self, quantity: str) -> float:
        """Return the mean square of the noise: the integral of the density, which is a power law between points."""
        f, s = np.array(self.frequencies), self.densities(quantity)
        ratio = np.log(f[1:] / f[:-1])
        exponent = np.log(s[1:] / s[:-1]) / ratio + 1
        # s0 f0 (r^p - 1) / p with r = f1 / f0, and s0 f0 ln r where p is 0.
        growth = exponent * ratio
        mean = np.where(np.abs(growth) < 1e-12, 1.0, np.expm1(growth) / np.where(growth == 0, 1.0, growth))
        return float(np.sum(s[:-1] * f[:-1] * ratio * mean))


def with_spectrum(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a scene file with the table named in `sensor.noise_spectrum` replaced by its rows."""
    sensor = content.get("sensor")
    if not isinstance(sensor, dict) or not isinstance(sensor.get("noise_spectrum"), str):
        return content
    return content | {"sensor": sensor | {"noise_spectrum": _read_spectrum(folder / sensor["noise_spectrum"])}}


def _read_spectrum(path: Path) -> dict[str, list[float]]:
    """Return frequencies and densities of a file; only the shape of the densities matters, so any unit is accepted."""
    lines = read_cells(path, "the table of a spectrum", _MAX_SPECTRUM)
    titles = lines[0][1] if lines else []
    density = [title for title in titles if _DENSITY.fullmatch(title)]
    if titles.count("frequency [Hz]") != 1 or len(density) != 1:
        raise BadData(
            f"{path}: a table of a spectrum must have the columns 'frequency [Hz]' and 'density [N/sqrt(Hz)]' (or "
            "another unit per sqrt(Hz)) once each; name them in its first line"
        )
    columns: dict[str, list[float]] = {"frequencies": [], "density": []}
    for (name, numbers), title in zip(columns.items(), ("frequency [Hz]", density[0]), strict=True):
        place = titles.index(title)
        for number, cells in lines[1:]:
            cell = cells[place] if place < len(cells) else ""
            try:
                numbers.append(float(cell))
            except ValueError:
                raise BadData(f"{path}, line {number}: {name} must be a number, got {cell!r}") from None
    return columns


class HumLine(Section):
    """A sine of fixed frequency and amplitude, such as the mains (50 or 60 Hz) and each of its multiples.

    Its phase is drawn for each signal.
    """

    frequency: Frequency
    """Frequency of the sine."""
    amplitude: Sensed | None = None
    """Amplitude, in the unit of the sensor's quantity; either this or `relative_amplitude`."""
    relative_amplitude: Annotated[float, Quantity("ratio", Rule(0, 1e6, without="lowest"))] | None = None
    """Amplitude over the largest sample of each signal; for a force over the true peak. Not for a stream."""

    @model_validator(mode="after")
    def _one_amplitude(self) -> Self:
        if (self.amplitude is None) == (self.relative_amplitude is None):
            raise ValueError("must have either amplitude or relative_amplitude")
        return self

    def amplitude_in(self, quantity: str) -> float:
        """Return the amplitude in SI units; 0 for one that is relative to each peak."""
        return 0.0 if self.amplitude is None else _level(self.amplitude, quantity)


class RecordedBackground(Section):
    """A recording without its mean, mixed in from a random start and repeated endlessly.

    The signal-to-noise ratio compares the median peak of the scene's impacts (first hits, drawn by the weights of the
    populations) with the root mean square of the background.
    """

    path: str = Field(min_length=1, max_length=4096)
    """A recording, relative to the scene file."""
    signal_to_noise: Decibel
    """Level of the impacts over the background."""
    sampling_rate: Frequency | None = None
    """Sampling rate, if the recording does not state it."""
    channel: str | None = None
    """Name or number of the channel."""

    def file(self, folder: Path) -> Path:
        """Return the file in a folder; raises `NoInput`, or `BadData` for a pipe, a device or too large a file."""
        from cgid.recordings.recording import clear_errors

        path = folder / self.path
        with clear_errors(str(path)):
            require_regular(path, "a recorded background", _MAX_RECORDING)
        return path


class BackgroundSection(Section):
    """Signals recorded in addition to impacts; at least one of its parts."""

    hum: tuple[HumLine, ...] = Field(default=(), max_length=1000)
    """Sines, such as the mains."""
    coloured: ColouredNoise | None = None
    """Noise of a given spectrum."""
    recorded: RecordedBackground | None = None
    """A recording that is mixed in."""

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.hum and self.coloured is None and self.recorded is None:
            raise ValueError("must have at least one of hum, coloured, recorded; or remove it")
        return self

    def problems(self, quantity: str, sampling_rate: float, *, is_stream: bool) -> list[str]:
        """Return error messages for this background of a sensor's quantity at a sampling rate [Hz]."""
        nyquist = sampling_rate / 2
        problems = []
        for index, line in enumerate(self.hum):
            if line.frequency >= nyquist:
                problems.append(
                    f"background.hum.{index}.frequency: must be below half the sampling rate, {nyquist:g} Hz, got "
                    f"{line.frequency:g} Hz"
                )
            if line.amplitude is not None:
                read = partial(_level, quantity=quantity)
                problems += _complaints(f"background.hum.{index}.amplitude", read, [line.amplitude])
            elif is_stream:
                problems.append(
                    f"background.hum.{index}.relative_amplitude: must be left out of a stream, whose impacts share "
                    "one background; give amplitude"
                )
        if self.coloured is not None:
            highest = self.coloured.frequencies[-1]
            if highest > nyquist:
                problems.append(
                    f"background.coloured.frequencies: must be up to half the sampling rate, {nyquist:g} Hz, got "
                    f"{highest:g} Hz; cut the table there"
                )
            problems += self.coloured.problems("background.coloured", quantity)
        return problems

    def deterministic_power(self, quantity: str) -> float:
        """Return the mean square of hum and coloured noise in SI units; that of a recording depends on the impacts."""
        amplitudes = [line.amplitude_in(quantity) for line in self.hum]
        lines = sum(0.5 * amplitude * amplitude for amplitude in amplitudes)
        return lines + (0.0 if self.coloured is None else self.coloured.power(quantity))


def _complaints(path: str, read: Callable[[Any], float], values: Iterable[Any]) -> list[str]:
    """Return error messages for unreadable values."""
    complaints = []
    for value in values:
        try:
            read(value)
        except ValueError as error:
            complaints.append(f"{path}: {error}")
    return complaints

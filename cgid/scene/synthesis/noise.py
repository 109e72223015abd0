"""Addressed noise: the noise of a sample does not depend on how the signal is split."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # loads its submodules on first use
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.recordings import read_recording
from cgid.scene.file.background import BackgroundSection, ColouredNoise
from cgid.scene.file.schema import Scene
from cgid.scene.file.sensor import CHUNK, Sensor
from cgid.scene.synthesis._noise import LANES, TILE, add_normal
from cgid.scene.synthesis.draws import BLOCK, COLOURED, COLOURED_NOISE, HUM, NOISE, RECORDED, require_seed, uniforms
from cgid.scene.synthesis.impacts import PulseBlock, pulses_of_block
from cgid.scene.synthesis.plan import Plan

#: Samples of a signal that have an address: 93 hours at 51.2 kHz.
MAX_SAMPLES = TILE // LANES << 32
#: Upper bound of the noise in standard deviations: sqrt(2 ln 2^33) = 6.764, with a margin for rounding.
MAX_NOISE = 6.77


def add_noise(
    frames: NDArray[Any], level: Floats, seed: int, block: int, *, first_sample: int = 0, purpose: int = NOISE
) -> None:
    """Add white Gaussian noise of standard deviation `level` (n,) to float frames (n, n_samples), in place."""
    # The noise of a sample depends only on seed, purpose, block, row and sample number, not on the window. It is drawn
    # in tiles of 512 samples, in float32; its tails end at 6.7 standard deviations. The GIL is released.
    seed = require_seed(seed)
    if not 0 <= block < 2**56:
        raise InvalidValue(f"block must be between 0 and 2^56 - 1, got {block}")
    if first_sample < 0 or first_sample + frames.shape[1] > MAX_SAMPLES:
        raise InvalidValue(
            f"samples with noise must be between 0 and {MAX_SAMPLES - 1}, got {first_sample} to "
            f"{first_sample + frames.shape[1] - 1}"
        )
    # The last word of the counter holds the purpose and the upper bits of the block.
    high = purpose << 24 | block >> 32
    words = [np.uint64(word) for word in (block & 0xFFFFFFFF, high, seed & 0xFFFFFFFF, seed >> 32)]
    add_normal(frames, np.asarray(level, frames.dtype), first_sample, *words)


#: Largest denominator of the ratio of two sampling rates.
_MAX_TERM = 10_000
#: Blocks of 256 rocks used for the median peak of a scene.
_REFERENCE_BLOCKS = 4
#: An impact reaches its peak within this many samples.
_REFERENCE_SAMPLES = 2048


@dataclass(frozen=True)
class Coloured:
    """Noise of a given spectrum at one sampling rate: of a background, or of a sensor with standard deviation 1."""

    of: ColouredNoise | Sensor
    quantity: str  # of the sensor
    sampling_rate: float  # [Hz]
    purpose: int  # of its numbers

    def in_frames(self, seed: int, block: int, n_samples: int) -> Floats:
        """Return independent noise for each frame of one block, (`BLOCK`, n_samples)."""
        # A period of at least twice the frame, so that the ends of the frame are independent.
        length = 1 << (2 * n_samples - 1).bit_length()
        return self._rows(self.density(length, n_samples), seed, block, 0, BLOCK)[:, :n_samples]

    def density(self, length: int, n_samples: int) -> Floats:
        """Return the power density at the lines of rows of a length, (length // 2 + 1,) [unit^2/Hz]."""
        # That of a sensor is flat below one period of n_samples, down to 0 Hz, and adds up to 1.
        return _density(self.of, self.quantity, self.sampling_rate, length, n_samples)

    def in_recording(self, seed: int, recording: int, chunk: int) -> Floats:
        """Return the noise of one chunk of a recording, (`CHUNK`,)."""
        return _segment(self, seed, recording, chunk)[CHUNK:] + _segment(self, seed, recording, chunk + 1)[:CHUNK]

    def segment(self, seed: int, recording: int, number: int) -> Floats:
        """Return one segment of a recording, (2 `CHUNK`,); two overlap in every chunk."""
        # They are faded by a sine, whose squares add up to 1, which keeps the power constant.
        fade = np.sin(np.pi * (np.arange(2 * CHUNK) + 0.5) / (2 * CHUNK))
        return np.asarray(fade * self._rows(self.density(2 * CHUNK, CHUNK), seed, recording, number, 1)[0])

    def _rows(self, density: Floats, seed: int, block: int, number: int, rows: int) -> Floats:
        """Return periodic Gaussian noise of the density at its lines, (rows, length); the length is a power of 2."""
        length = 2 * (density.size - 1)
        parts = np.zeros((rows, 2 * density.size))
        add_noise(parts, np.ones(rows), seed, block, first_sample=number * parts.shape[1], purpose=self.purpose)
        # The expected periodogram 2 |X|^2 / (rate n) is then the density. The lines at 0 Hz, half as wide as others,
        # and at half the rate are real and count once.
        height = np.sqrt(density * self.sampling_rate * length / 4)
        height[0] *= np.sqrt(2.0)
        height[-1] *= 2.0
        spectrum = (parts[:, : height.size] + 1j * parts[:, height.size :]) * height
        return np.asarray(np.fft.irfft(spectrum, length))


@lru_cache(maxsize=4)
def _density(of: ColouredNoise | Sensor, quantity: str, sampling_rate: float, length: int, n_samples: int) -> Floats:
    frequency = np.asarray(np.fft.rfftfreq(length, 1 / sampling_rate), np.float64)
    if isinstance(of, ColouredNoise):
        return of.at(frequency, quantity)
    lowest = sampling_rate / n_samples
    frequency = np.maximum(frequency, lowest)
    if of.noise_spectrum is None:
        assert of.noise_exponent is not None
        density = np.power(frequency / lowest, -of.noise_exponent)
    else:
        given = of.noise_spectrum.frequencies
        density = of.noise_spectrum.at(np.clip(frequency, given[0], given[-1]), quantity)
    return np.asarray(density / ((density[0] / 2 + density[1:].sum()) * (sampling_rate / length)))


@lru_cache(maxsize=4)
def _segment(coloured: Coloured, seed: int, recording: int, number: int) -> Floats:
    return coloured.segment(seed, recording, number)


def ar_noise_of(scene: Scene) -> Coloured | None:
    """Return the noise of a scene's sensor with a standard deviation of 1; None if it is white."""
    sensor = scene.sensor
    if not sensor.coloured:
        return None
    return Coloured(sensor, sensor.quantity, scene.sampling.sampling_rate, COLOURED_NOISE)


def add_sensor_noise(frames: NDArray[Any], level: Floats, scene: Scene, seed: int, block: int) -> None:
    """Add the noise of a scene's sensor, of standard deviation `level` (n,), to frames in place."""
    colour = ar_noise_of(scene)
    if colour is None:
        add_noise(frames, level, seed, block)
        return
    unit = colour.in_frames(seed, block, scene.sampling.samples)[: len(frames), : frames.shape[1]]
    frames += (level[:, None] * unit).astype(frames.dtype)


@dataclass(frozen=True)
class Background:
    """The background of a scene at one sampling rate."""

    section: BackgroundSection
    quantity: str  # of the sensor
    sampling_rate: float  # [Hz]
    recorded: Floats | None  # the recording at this rate, with mean 0 and root mean square 1
    recorded_level: float = 0.0  # its factor

    def in_frames(self, seed: int, block: int, n_samples: int, peak: Floats) -> Floats:
        """Return a separate background for each frame of one block, whose peaks are these, (`BLOCK`, n_samples)."""
        out = np.zeros((BLOCK, n_samples))
        numbers = uniforms(seed, block, len(self.section.hum), HUM) if self.section.hum else ()
        for line, phases in zip(self.section.hum, numbers, strict=True):
            turns: Floats = np.asarray(line.frequency * np.arange(n_samples) / self.sampling_rate, np.float64)
            if line.relative_amplitude is None:
                out += line.amplitude_in(self.quantity) * _wave(turns + phases[:, None])
                continue
            # The sine of a sum by those of its parts takes a tenth of the time. Older lines keep their last bits.
            height = (line.relative_amplitude * peak)[:, None]
            out += height * _wave(phases[:, None] + 0.25) * _wave(turns)
            out += height * _wave(phases[:, None]) * _wave(turns + 0.25)
        if self._coloured is not None:
            out += self._coloured.in_frames(seed, block, n_samples)
        if self.recorded is not None:
            starts = (uniforms(seed, block, 1, RECORDED)[0] * self.recorded.size).astype(np.intp)
            out += self.recorded_level * self.recorded[(starts[:, None] + np.arange(n_samples)) % self.recorded.size]
        return out

    def in_recording(self, seed: int, recording: int, chunk: int) -> Floats:
        """Return the background of one chunk of a recording, (`CHUNK`,)."""
        samples = chunk * CHUNK + np.arange(CHUNK)
        out = np.zeros(CHUNK)
        numbers = uniforms(seed, 0, len(self.section.hum), HUM, recording)[:, 0] if self.section.hum else ()
        for line, phase in zip(self.section.hum, numbers, strict=True):
            amplitude = line.amplitude_in(self.quantity)
            out += amplitude * _wave(line.frequency * (samples / self.sampling_rate) + phase)
        if self._coloured is not None:
            out += self._coloured.in_recording(seed, recording, chunk)
        if self.recorded is not None:
            start = int(uniforms(seed, 0, 1, RECORDED, recording)[0, 0] * self.recorded.size)
            out += self.recorded_level * self.recorded[(start + samples) % self.recorded.size]
        return out

    @cached_property
    def rms(self) -> float:
        """Root mean square of the complete background, in SI units."""
        return float(
            np.sqrt(self.section.deterministic_power(self.quantity) + self.recorded_level * self.recorded_level)
        )

    @property
    def _coloured(self) -> Coloured | None:
        section = self.section.coloured
        return None if section is None else Coloured(section, self.quantity, self.sampling_rate, COLOURED)


def _wave(turns: Floats) -> Floats:
    """Return the sine of an angle in turns."""
    return np.sin(2 * np.pi * (turns - np.rint(turns)))


@lru_cache(maxsize=16)
def reference_peak(scene: Scene) -> float:
    """Return the median peak of the first impacts of a scene's rocks, by the weights of their populations."""
    plan = Plan(scene=scene)
    peaks = [_peaks(pulses_of_block(plan, 0, block)) for block in range(_REFERENCE_BLOCKS)]
    slope = 0.0 if scene.stream is None else scene.stream.inclination
    # The normal velocity of a vertical fall is v cos(alpha), and the peak of a Hertz impact scales with v^(6/5).
    return float(np.median(peaks) * np.power(np.cos(slope), 1.2))


def _peaks(pulses: PulseBlock) -> Floats:
    if not pulses.plan.responds:
        return pulses.parameters["peak_force"]
    frames = np.zeros((BLOCK, pulses.scene.sampling.samples or _REFERENCE_SAMPLES))
    pulses.add_to_frames(frames)
    return np.asarray(np.abs(frames).max(axis=1))


def background_of(scene: Scene) -> Background | None:
    """Return the background of a scene at its sampling rate; None if it has none."""
    section, sampling_rate = scene.background, scene.sampling.sampling_rate
    if section is None:
        return None
    recorded, level = None, 0.0
    if section.recorded is not None:
        recorded_section = section.recorded
        path = recorded_section.file(scene.folder)
        recorded = _unit_recording(
            path, _age(path), recorded_section.sampling_rate, recorded_section.channel, sampling_rate
        )
        level = float(reference_peak(scene) * np.power(10.0, -recorded_section.signal_to_noise / 20))
    return Background(section, scene.sensor.quantity, sampling_rate, recorded, level)


def _age(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0  # reading the file reports the error


@lru_cache(maxsize=4)
def _unit_recording(
    path: Path, _age: int, given_rate: float | None, channel: str | None, sampling_rate: float
) -> NDArray[Any]:
    """Return a recording at another rate, with mean 0 and root mean square 1; `_age` tells versions in the cache."""
    signals = read_recording(path, sampling_rate=given_rate, channel=channel)
    if len(signals) > 1:
        names = ", ".join(one.channel for one in signals)
        hint = "choose one by background.recorded.channel"
        raise BadData(f"{path}: a background must be one channel, this file has {names}; {hint}")
    samples = signals[0].samples.astype(np.float64)
    ratio = Fraction(sampling_rate / signals[0].sampling_rate).limit_denominator(_MAX_TERM)
    if not ratio:
        raise BadData(
            f"{path}: a background's sampling rate must be closer to {sampling_rate:g} Hz, it is "
            f"{signals[0].sampling_rate:g} Hz"
        )
    samples -= samples.mean()
    if ratio != 1:
        samples = scipy.signal.resample_poly(samples, ratio.numerator, ratio.denominator)
        samples -= samples.mean()
    level = np.sqrt(np.mean(samples * samples))
    if not level > 0:
        raise BadData(f"{path}: a background must not be constant; give another recording")
    samples /= level
    samples.setflags(write=False)
    return samples

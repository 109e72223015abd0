"""From a scene to a long recording, stretch by stretch of its time axis; memory holds one stretch."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.impact import HertzRangeWarning, Impact, ThinPlateWarning
from cgid.scene.background import sensed_quantity
from cgid.scene.background_noise import CHUNK, Background, background_of
from cgid.scene.population import impact_of
from cgid.scene.randomness import NOISE, generator
from cgid.scene.scene import Scene
from cgid.scene.sensor import Sensor
from cgid.scene.stream.arrivals import arrivals_of
from cgid.scene.stream.axis import TimeAxis
from cgid.scene.stream.places import beam_of
from cgid.scene.stream.rocks import Rocks, arriving, thrown_back
from cgid.scene.stream.truth import empty_truth, joined, truth_of
from cgid.signals import UNITS, Signal

#: The low-pass of a pulse is followed for so many periods of its edge to either side; what is left of it there is
#: under 1e-5 of the peak (`tests/test_stream.py`).
_FILTER_PERIODS = 64


@dataclass(frozen=True)
class Part:
    """A part of a recording, in order.

    Attributes
    ----------
    samples : ndarray, (n,)
        The next ones.
    truth : dict of ndarray, each (n_impacts,)
        Of the impacts of a stretch; they may come somewhat before or behind their samples.
    """

    samples: NDArray[Any]
    truth: dict[str, NDArray[Any]]


def record(
    scene: Scene, seed: int = 0, number: int = 0, *, dtype: Literal["float32", "float64"] = "float32"
) -> tuple[Signal, dict[str, NDArray[Any]]]:
    """Return a recording of a stream in memory, and the truth of its impacts.

    Parameters
    ----------
    scene : Scene
        With a `stream`.
    seed, number : int
        The same seed gives the same recordings; the number tells them apart.
    dtype : {"float32", "float64"}
        Of the samples.

    Returns
    -------
    Signal
        The recording.
    dict of ndarray, each (n_impacts,)
        The impacts in order of time: `cgid.scene.stream.truth.impact_units`, label, specimen.

    Raises
    ------
    InvalidValue
        The scene has no stream, or a number breaks its rule.
    """
    parts = list(parts_of_recording(scene, seed, number, dtype=dtype))
    signal = Signal(
        samples=np.concatenate([part.samples for part in parts]),
        sampling_rate=scene.sampling.sampling_rate,
        unit=unit_of(scene),
        source=f"{scene.name} {number}",
    )
    return signal, joined(scene, [part.truth for part in parts])


def parts_of_recording(scene: Scene, seed: int, number: int, *, dtype: Literal["float32", "float64"]) -> Iterator[Part]:
    """Yield a recording in parts; see `record`."""
    if scene.stream is None:
        raise InvalidValue(f"scene {scene.name} must have a section stream to make a recording of; it has none")
    if not 0 <= number < 2**32:
        raise InvalidValue(f"number of the recording must lie between 0 and 2^32 - 1, got {number}")
    validation.choice("dtype", dtype, ("float32", "float64"))
    beam, rate, guard = beam_of(scene), scene.sampling.sampling_rate, _guard(scene)
    background = background_of(scene)
    audible = hearing_limit(scene, background)
    axis, carried, n_rocks, done = TimeAxis(), Rocks.joined([]), 0, 0
    chain = _Chain(scene.sensor, background, seed, number, dtype)
    n_samples = samples_of(scene)
    for stretch in arrivals_of(scene.stream).stretches(scene.stream.duration, seed, number):
        arrived = arriving(scene, beam, stretch, n_rocks, seed, number)
        n_rocks += len(arrived)
        truth = [empty_truth(scene)]
        coming = Rocks.joined([carried, arrived])
        waiting = []
        while len(coming):
            late = coming["time"] >= stretch.stop
            waiting.append(coming.taken(late))
            now = coming.taken(~late)
            impact = _impact(scene, now)
            add_impacts(axis, scene, impact, now, guard)
            truth.append(truth_of(scene, now, impact))
            loud = impact.peak_force > audible
            coming = thrown_back(scene, beam, now, impact.restitution, impact.contact_duration, loud)
        carried = Rocks.joined(waiting)
        # Later impacts, and what the low-pass makes of them before they touch, lie behind this sample.
        final = min(max(int(stretch.stop * rate) - guard, 0), n_samples)
        ready = [chain.recorded(axis, chunk) for chunk in range(done, final // CHUNK)]
        done = max(done, final // CHUNK)
        yield Part(np.concatenate([np.empty(0, dtype), *ready]), _joined_truth(scene, truth))
    rest = [chain.recorded(axis, chunk) for chunk in range(done, -(-n_samples // CHUNK))]
    behind = n_samples - done * CHUNK
    yield Part(np.concatenate([np.empty(0, dtype), *rest])[:behind], empty_truth(scene))


def samples_of(scene: Scene) -> int:
    """Return the number of samples of a recording."""
    assert scene.stream is not None
    return max(round(scene.stream.duration * scene.sampling.sampling_rate), 1)


def unit_of(scene: Scene) -> str:
    """Return the unit of the samples of a recording: the SI unit of what the sensor measures."""
    return next(iter(UNITS[sensed_quantity(scene.sensor)]))


def hearing_limit(scene: Scene, background: Background | None) -> float:
    """Return the peak force below which an impact drowns in noise and background [N], and its rock is let go.

    0 where the sensor measures another quantity, of which no force alone says how large it is.
    """
    if sensed_quantity(scene.sensor) != "force":
        return 0.0
    return float(np.hypot(scene.sensor.absolute_noise, 0.0 if background is None else background.rms))


def add_impacts(axis: TimeAxis, scene: Scene, impact: Impact, rocks: Rocks, guard: int) -> None:
    """Add what the sensor gives of some impacts to the time axis, noise apart; what overlaps adds up.

    Parameters
    ----------
    axis : TimeAxis
    scene : Scene
    impact : Impact
        n of them.
    rocks : Rocks
        The same, with time of touch and place.
    guard : int
        Samples that the low-pass of the sensor takes to either side.
    """
    if not len(rocks):
        return
    rate, times = scene.sampling.sampling_rate, rocks["time"]
    first = np.floor(times * rate).astype(np.int64) - guard
    width = int(np.ceil(impact.contact_duration.max() * rate)) + 2 + 2 * guard
    windows = np.zeros((times.size, width))
    impact.add_to_frames(windows, rate, (times * rate - first) / rate)
    axis.add(first, scene.sensor.limit_band(windows, rate))


def _impact(scene: Scene, rocks: Rocks) -> Impact:
    with warnings.catch_warnings():
        # A population reaches past Hertz's or Zener's range here and there; `cgid check` says how often.
        for beyond in (HertzRangeWarning, ThinPlateWarning):
            warnings.simplefilter("ignore", beyond)
        return impact_of(scene, rocks.columns, np.arange(len(rocks)))


def _guard(scene: Scene) -> int:
    bandwidth = scene.sensor.bandwidth
    return 0 if bandwidth is None else int(np.ceil(_FILTER_PERIODS * scene.sampling.sampling_rate / bandwidth))


def _joined_truth(scene: Scene, parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the impacts of a stretch in order of time, those after the end of the recording left out."""
    assert scene.stream is not None
    truth = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((truth["rock"], truth["time"]))
    order = order[truth["time"][order] < scene.stream.duration]
    return {name: column[order] for name, column in truth.items()}


@dataclass(frozen=True)
class _Chain:
    """What follows the pulses: noise, background, range and bits, chunk by chunk."""

    sensor: Sensor
    background: Background | None
    seed: int
    number: int
    dtype: str

    def recorded(self, axis: TimeAxis, chunk: int) -> NDArray[Any]:
        """Take the next chunk off the axis and return it as it is recorded."""
        samples = axis.taken((chunk + 1) * CHUNK)
        if self.sensor.absolute_noise > 0:
            draws = generator(self.seed, NOISE, chunk, self.number)
            samples += self.sensor.absolute_noise * draws.standard_normal(CHUNK, dtype=np.float32).astype(np.float64)
        if self.background is not None:
            samples += self.background.in_recording(self.seed, self.number, chunk)
        self.sensor.digitise(samples)
        return samples.astype(self.dtype)

"""From a scene to a long recording, stretch by stretch of its time axis; memory holds one stretch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.scene.background_noise import CHUNK, Background, background_of
from cgid.scene.noise import add_noise
from cgid.scene.plan import Plan, plan
from cgid.scene.response import hearing
from cgid.scene.scene import Scene
from cgid.scene.stream.arrivals import arrivals_of
from cgid.scene.stream.axis import TimeAxis, samples_of
from cgid.scene.stream.rocks import Rocks, arriving, thrown_back
from cgid.scene.stream.sound import hearing_limit, lead, strike
from cgid.scene.stream.truth import empty_truth, joined, truth_of
from cgid.signals import Signal


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
        unit=scene.sensor.unit,
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
    rate, background = scene.sampling.sampling_rate, background_of(scene)
    audible = hearing_limit(scene, background)
    asked = plan(scene, ["recordings"], dtype=dtype)
    heard = hearing(scene) if asked.responds else None
    axis, carried, n_rocks, done = TimeAxis(), Rocks.joined([]), 0, 0
    chain = _Chain(asked, rate, background, seed, number, dtype)
    n_samples = samples_of(scene)
    for stretch in arrivals_of(scene.stream).stretches(scene.stream.duration, seed, number):
        arrived = arriving(scene, stretch, n_rocks, seed, number)
        n_rocks += len(arrived)
        truth = [empty_truth(scene)]
        coming = Rocks.joined([carried, arrived])
        waiting = []
        while len(coming):
            late = coming["time"] >= stretch.stop
            waiting.append(coming.taken(late))
            now = coming.taken(~late)
            delivered = strike(scene, axis, now, heard)
            truth.append(truth_of(scene, now, delivered))
            loud = delivered["peak_force"] > audible
            coming = thrown_back(scene, now, delivered["restitution"], delivered["contact_duration"], loud)
        carried = Rocks.joined(waiting)
        # Later impacts, and what the low-pass makes of them before they touch, lie behind this sample.
        final = min(max(int(stretch.stop * rate) - lead(scene), 0), n_samples)
        ready = [chain.recorded(axis, chunk) for chunk in range(done, final // CHUNK)]
        done = max(done, final // CHUNK)
        yield Part(np.concatenate([np.empty(0, dtype), *ready]), _joined_truth(scene, truth))
    rest = [chain.recorded(axis, chunk) for chunk in range(done, -(-n_samples // CHUNK))]
    behind = n_samples - done * CHUNK
    yield Part(np.concatenate([np.empty(0, dtype), *rest])[:behind], empty_truth(scene))


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

    asked: Plan
    sampling_rate: float
    background: Background | None
    seed: int
    number: int
    dtype: str

    def recorded(self, axis: TimeAxis, chunk: int) -> NDArray[Any]:
        """Take the next chunk off the axis and return it as it is recorded."""
        samples, sensor = axis.taken((chunk + 1) * CHUNK), self.asked.request.scene.sensor
        if self.asked.runs("noise"):
            level = sensor.noise_level(np.zeros(1), self.sampling_rate)
            add_noise(samples[None], level, self.seed, self.number, first_sample=chunk * CHUNK)
        if self.background is not None:
            samples += self.background.in_recording(self.seed, self.number, chunk)
        if self.asked.runs("offset, range and bits"):
            sensor.digitise(samples, self.sampling_rate, first=chunk * CHUNK)
        return samples.astype(self.dtype)

"""From a scene to signals, block by block, doing only what the scene asks for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid import validation
from cgid.counting import count
from cgid.errors import InvalidValue
from cgid.scene.background_noise import add_to_frames
from cgid.scene.noise import HIGHEST_NOISE, add_noise
from cgid.scene.plan import Plan, plan
from cgid.scene.population import draw
from cgid.scene.randomness import BLOCK
from cgid.scene.range_warnings import unwarned
from cgid.scene.response import hearing
from cgid.scene.scene import Scene
from cgid.scene.sensor import Sensor, clip
from cgid.scene.strike import Blows
from cgid.signals import Batch
from cgid.validation import Floats


def synthesise(
    scene: Scene,
    n_signals: int,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: Literal["float32", "float64"] = "float32",
    outputs: Iterable[str] = ("frames",),
) -> Iterator[Batch]:
    """Yield the signals of a scene in batches of at most 256.

    Parameters
    ----------
    scene : Scene
    n_signals : int
        How many, above 0.
    seed : int
        Between 0 and 2^63 - 1. The same seed gives the same signals, in however many calls.
    first : int
        Number of the first signal.
    dtype : {"float32", "float64"}
        Of the samples. The noise is drawn as float32 either way, so both hold the same signals.
    outputs : iterable of str
        "frames", or "pulses" for the forces [N] without beam and sensor; see `cgid.scene.plan`.

    Yields
    ------
    Batch
        Forces [N] or motions of the beam (`Sensor.unit`), labels, parameters, specimens. Where the scene randomises
        its sampling rate each batch has its own.

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    """
    require_count(n_signals, first)
    validation.choice("dtype", dtype, ("float32", "float64"))
    require_frames(scene)
    asked = plan(scene, outputs, dtype=dtype)
    if not asked.request.kept:
        raise InvalidValue(f"outputs must be frames or pulses where signals are wanted, got {', '.join(outputs)}")
    for block, part in blocks(n_signals, first):
        yield _block(asked, seed, block, part, dtype)


def blocks(n_signals: int, first: int) -> Iterator[tuple[int, slice]]:
    """Yield the blocks that hold these signals, and which of each."""
    last = first + n_signals
    for block in range(first // BLOCK, (last - 1) // BLOCK + 1):
        yield block, slice(max(first - block * BLOCK, 0), min(last - block * BLOCK, BLOCK))


def require_count(n_signals: int, first: int) -> None:
    """Raise `InvalidValue` for less than one signal, or a first one before 0."""
    if n_signals < 1 or first < 0:
        raise InvalidValue(f"n_signals must be 1 or more and first 0 or more, got {n_signals} and {first}")


def require_frames(scene: Scene) -> None:
    """Raise `InvalidValue` for a scene that makes recordings."""
    if scene.stream is not None:
        raise InvalidValue(
            f"scene {scene.name}: stream must be left out of a scene that frames are made of; make recordings of it "
            "(cgid generate SCENE -o RECORDING.h5)"
        )


def _block(asked: Plan, seed: int, block: int, part: slice, dtype: DTypeLike) -> Batch:
    with unwarned():
        drawn = draw(asked.request.scene, seed, block)
    return batch_of(asked, drawn, seed, block, part, dtype)


def batch_of(asked: Plan, drawn: Blows, seed: int, block: int, part: slice, dtype: DTypeLike) -> Batch:
    """Return some signals of one block, with all that is known of them; parameters as in `make_frames`."""
    scene = asked.request.scene
    frames = make_frames(asked.for_block(drawn.scene), drawn, seed, block, dtype)
    return Batch(
        signals=frames[part],
        labels=drawn.labels[part],
        sampling_rate=drawn.scene.sampling.sampling_rate,
        unit=scene.sensor.unit if asked.request.sensed else "N",
        pre_trigger=scene.sampling.pre_trigger,
        specimen=drawn.specimen[part],
        parameters={name: values[part] for name, values in drawn.parameters.items()},
        source=scene.sha256,
    )


def make_frames(asked: Plan, drawn: Blows, seed: int, block: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return the frames of one block: pulses, bandwidth, noise, background, clipping, range, bits, if the plan says so.

    Parameters
    ----------
    asked : Plan
        That of the block: of `drawn.scene`.
    drawn : Blows
    seed, block : int
    dtype : {"float32", "float64"}
    """
    return make_beginnings(asked, drawn, seed, block, dtype, drawn.scene.sampling.samples)[0]


def make_beginnings(
    asked: Plan, drawn: Blows, seed: int, block: int, dtype: DTypeLike, n_samples: int
) -> tuple[NDArray[Any], Floats]:
    """Return the first samples of the frames of one block, and what no sample behind them passes.

    They are those of the whole frames to the last bit. All contacts must end within them or lie behind the frame.
    Other parameters as in `make_frames`.

    Returns
    -------
    ndarray, (n_signals, n_samples)
    ndarray, (n_signals,)
        Above every sample of the rest of the frame, in the unit of the signals.
    """
    scene, sensor = drawn.scene, drawn.scene.sensor
    n_signals, whole, rate = len(drawn.labels), scene.sampling.samples, scene.sampling.sampling_rate
    highest_behind = np.zeros(n_signals)
    # The transform of a low-pass goes round the whole frame.
    filtered = asked.runs("bandwidth")
    frames: NDArray[Any] = np.zeros((n_signals, whole if filtered else n_samples), dtype)
    add_pulses(frames, asked, drawn)
    peak = drawn.parameters["peak_force"]
    if filtered:
        frames = sensor.limit_band(frames, rate)
        highest_behind = frames[:, n_samples:].max(axis=1, initial=0.0).astype(np.float64)
        frames = np.ascontiguousarray(frames[:, :n_samples])
    if asked.runs("tail beam"):
        peak = np.abs(frames).max(axis=1).astype(np.float64)
    if asked.runs("noise"):
        level = sensor.noise_level(peak, rate)
        add_noise(frames, level, seed, block)
        highest_behind += HIGHEST_NOISE * level
    if asked.runs("background"):
        count("background_samples", frames.size)
        add_to_frames(frames, scene, seed, block)
    count("frames", n_signals)
    count("frame_samples", frames.size)
    if asked.runs("clipping"):
        count("clipped_frames", n_signals)
        clip(frames, drawn.parameters["clipped_at"] * peak)
    if asked.runs("offset, range and bits"):
        count("digitised_frames", n_signals)
        sensor.digitise(frames, rate)
        highest_behind += _digitised_by(sensor, rate, n_samples, whole)
    return frames, highest_behind


def _digitised_by(sensor: Sensor, sampling_rate: float, first: int, n_samples: int) -> float:
    """Return by how much offset, drift and rounding may raise a sample from a first one on."""
    drift, step = (sensor.drift or 0.0) / sampling_rate, 0.0
    if sensor.range is not None and sensor.bits is not None:
        step = sensor.range / 2**sensor.bits  # half of one
    return (sensor.offset or 0.0) + max(drift * first, drift * n_samples) + step


def add_pulses(frames: NDArray[Any], asked: Plan, drawn: Blows) -> None:
    """Add to each frame what is asked of its blows, in place: their forces, or what beam and sensor make of them."""
    scene = drawn.scene
    heard = hearing(scene) if asked.responds else None
    for strike in drawn.strikes:
        if heard is None:
            strike.add_to_frames(frames, scene.sampling.sampling_rate)
        else:
            strike.add_response(frames, heard, drawn.parameters)

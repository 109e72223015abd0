"""From a scene to signals, block by block, doing only what the scene asks for."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.impact import HertzRangeWarning, ThinPlateWarning
from cgid.scene.background_noise import add_to_frames
from cgid.scene.noise import add_noise
from cgid.scene.population import Draw, draw
from cgid.scene.randomness import BLOCK
from cgid.scene.response import hearing
from cgid.scene.scene import Scene
from cgid.scene.sensor import clip
from cgid.signals import Batch


def synthesise(
    scene: Scene,
    n_signals: int,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: Literal["float32", "float64"] = "float32",
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
    if n_signals < 1 or first < 0:
        raise InvalidValue(f"n_signals must be 1 or more and first 0 or more, got {n_signals} and {first}")
    validation.choice("dtype", dtype, ("float32", "float64"))
    if scene.stream is not None:
        raise InvalidValue(
            f"scene {scene.name}: stream must be left out of a scene that frames are made of; make recordings of it "
            "(cgid generate SCENE -o RECORDING.h5)"
        )
    last = first + n_signals
    for block in range(first // BLOCK, (last - 1) // BLOCK + 1):
        part = slice(max(first - block * BLOCK, 0), min(last - block * BLOCK, BLOCK))
        yield _block(scene, seed, block, part, dtype)


def _block(scene: Scene, seed: int, block: int, part: slice, dtype: DTypeLike) -> Batch:
    with warnings.catch_warnings():
        # A population reaches past Hertz's or Zener's range here and there; `cgid check` says how often.
        for beyond in (HertzRangeWarning, ThinPlateWarning):
            warnings.simplefilter("ignore", beyond)
        drawn = draw(scene, seed, block)
    frames = make_frames(drawn.scene, drawn, seed, block, dtype)
    return Batch(
        signals=frames[part],
        labels=drawn.labels[part],
        sampling_rate=drawn.scene.sampling.sampling_rate,
        unit=scene.sensor.unit,
        pre_trigger=scene.sampling.pre_trigger,
        specimen=drawn.specimen[part],
        parameters={name: values[part] for name, values in drawn.parameters.items()},
        source=scene.sha256,
    )


def make_frames(scene: Scene, drawn: Draw, seed: int, block: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return the frames of one block, with each part of the chain only where it is on.

    Pulses, bandwidth, noise, background, clipping, range, bits.

    The scene is that of the block: `drawn.scene`.
    """
    sensor = scene.sensor
    frames: NDArray[Any] = np.zeros((len(drawn.labels), scene.sampling.samples), dtype)
    add_pulses(frames, scene, drawn)
    frames = sensor.limit_band(frames, scene.sampling.sampling_rate)
    peak = drawn.parameters["peak_force"]
    if sensor.quantity != "force":
        peak = np.abs(frames).max(axis=1).astype(np.float64)
    if sensor.noisy:
        add_noise(frames, sensor.noise_level(peak, scene.sampling.sampling_rate), seed, block)
    if scene.background is not None:
        add_to_frames(frames, scene, seed, block)
    if "clipped_at" in drawn.parameters:
        clip(frames, drawn.parameters["clipped_at"] * peak)
    sensor.digitise(frames, scene.sampling.sampling_rate)
    return frames


def add_pulses(frames: NDArray[Any], scene: Scene, drawn: Draw) -> None:
    """Add to each frame what the recorder hears of its blows, in place: their forces, or the motion of the beam."""
    heard = hearing(scene)
    for strike in drawn.strikes:
        if heard is None:
            strike.add_to_frames(frames, scene.sampling.sampling_rate)
        else:
            strike.add_response(frames, heard, drawn.parameters)

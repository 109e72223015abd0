"""From a scene to signals, block by block, doing only what the scene asks for."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid import validation
from cgid.counting import count
from cgid.errors import InvalidValue
from cgid.impact import HertzRangeWarning, ThinPlateWarning
from cgid.scene.plan import Plan, plan
from cgid.scene.population import Draw, draw
from cgid.scene.randomness import BLOCK, NOISE, generator
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
        "frames", or "pulses" for the forces without a sensor; see `cgid.scene.plan`.

    Yields
    ------
    Batch
        Forces [N], labels, parameters, specimens. Where the scene randomises its sampling rate each batch has its own.

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    """
    require_count(n_signals, first)
    validation.choice("dtype", dtype, ("float32", "float64"))
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


def _block(asked: Plan, seed: int, block: int, part: slice, dtype: DTypeLike) -> Batch:
    scene = asked.request.scene
    with unwarned():
        drawn = draw(scene, seed, block)
    frames = make_frames(asked.for_block(drawn.scene), drawn, seed, block, dtype)
    return Batch(
        signals=frames[part],
        labels=drawn.labels[part],
        sampling_rate=drawn.scene.sampling.sampling_rate,
        unit="N",
        pre_trigger=scene.sampling.pre_trigger,
        specimen=drawn.specimen[part],
        parameters={name: values[part] for name, values in drawn.parameters.items()},
        source=scene.sha256,
    )


@contextmanager
def unwarned() -> Iterator[None]:
    """Draw in silence: a population reaches past Hertz's or Zener's range here and there; `cgid check` says how often."""
    with warnings.catch_warnings():
        for beyond in (HertzRangeWarning, ThinPlateWarning):
            warnings.simplefilter("ignore", beyond)
        yield


def make_frames(
    asked: Plan, drawn: Draw, seed: int, block: int, dtype: DTypeLike, n_samples: int | None = None
) -> NDArray[Any]:
    """Return the frames of one block: pulses, bandwidth, noise, clipping, range, bits, each only where the plan says so.

    Parameters
    ----------
    asked : Plan
        That of the block: of `drawn.scene`.
    drawn : Draw
    seed, block : int
    dtype : {"float32", "float64"}
    n_samples : int, optional
        Only so much of the beginning of each frame; equal to that of the whole frames to the last bit.
    """
    scene, n_signals = drawn.scene, len(drawn.labels)
    length = scene.sampling.samples if n_samples is None else min(n_samples, scene.sampling.samples)
    if asked.runs("bandwidth"):
        # The transform goes round the whole frame.
        frames = np.zeros((n_signals, scene.sampling.samples), dtype)
        add_pulses(frames, scene, drawn)
        limited = scene.sensor.limit_band(frames, scene.sampling.sampling_rate)
        frames = np.ascontiguousarray(limited[:, :length])
        if asked.runs("noise"):
            frames += _noise(scene, drawn, seed, block, dtype, length)
    else:
        # Pulses are added to the noise where they are, which saves a pass over the frames.
        shape = (n_signals, length)
        frames = _noise(scene, drawn, seed, block, dtype, length) if asked.runs("noise") else np.zeros(shape, dtype)
        add_pulses(frames, scene, drawn)
    count("frames", n_signals)
    count("frame_samples", frames.size)
    if asked.runs("clipping"):
        clip(frames, drawn.parameters["clipped_at"] * drawn.parameters["peak_force"])
        count("clipped_frames", n_signals)
    if asked.runs("range and bits"):
        scene.sensor.digitise(frames)
        count("digitised_frames", n_signals)
    return frames


def _noise(scene: Scene, drawn: Draw, seed: int, block: int, dtype: DTypeLike, n_samples: int) -> NDArray[Any]:
    noise = np.empty((len(drawn.labels), scene.sampling.samples), np.float32)
    generator(seed, NOISE, block).standard_normal(dtype=np.float32, out=noise)
    count("noise_samples", noise.size)
    noise = np.ascontiguousarray(noise[:, :n_samples])
    level = scene.sensor.noise_level(drawn.parameters["peak_force"])[:, None]
    if noise.dtype == dtype:
        noise *= level.astype(np.float32)
        return noise
    return noise.astype(np.float64) * level


def add_pulses(frames: NDArray[Any], scene: Scene, drawn: Draw) -> None:
    """Add the force pulses of each signal to its frame, in place."""
    for strike in drawn.strikes:
        strike.add_to_frames(frames, scene.sampling.sampling_rate)

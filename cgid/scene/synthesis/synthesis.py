"""Make signals, or columns of a table, from a scene, block by block, running only the planned stages."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.features.extraction import extract_array, extract_truncated, samples_needed
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.file.sensor import Sensor, clip
from cgid.scene.synthesis.draws import BLOCK, at_once, drawn_block, parameter_units, require_seed
from cgid.scene.synthesis.impacts import PulseBlock, contacts_of, pulses_of_block
from cgid.scene.synthesis.noise import MAX_NOISE, add_sensor_noise, background_of
from cgid.scene.synthesis.plan import OF_TAPS, TRUE, Plan, plan
from cgid.signals import Batch
from cgid.store.table import TableRows

#: Blocks drawn and measured at once, to share the overhead, and most samples of their frames (16 MB).
TOGETHER, _MAX_SAMPLES = 4, 1 << 22
#: Highest number of a signal that may come first: those that follow stay within 64 bits.
MAX_NUMBER = 2**62


def synthesise(
    scene: Scene | str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: Literal["float32", "float64"] = "float32",
    output: Literal["frames", "pulses"] = "frames",
) -> Iterator[Batch]:
    """Yield the signals of a scene in batches of at most 256.

    Parameters
    ----------
    scene : Scene, str or Path
    n_signals : int
        Above 0.
    seed : int
        From 0 to 2^63 - 1. The same seed gives the same signals, over any number of calls.
    first : int
        Number of the first signal.
    dtype : {"float32", "float64"}
        Of the samples. Noise is always drawn as float32, so both hold the same signals.
    output : {"frames", "pulses"}
        "frames", or "pulses" for the forces [N] without beam and sensor; see `cgid.scene.synthesis.plan`.

    Yields
    ------
    Batch
        Forces [N] or motions of the beam (`Sensor.unit`), labels, parameters, specimens. A randomised sampling rate
        differs between batches.

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    """
    scene = load_scene(scene)
    n_signals, first = require_count(n_signals, first)
    seed = require_seed(seed)
    require_frames(scene)
    synthesis_plan = plan(scene, output, dtype=dtype)
    if not synthesis_plan.kept:
        raise InvalidValue(f"output must be frames or pulses where signals are wanted, got {output}")
    together = min(TOGETHER, max(_MAX_SAMPLES // (BLOCK * scene.sampling.samples), 1))
    for block, part in blocks(n_signals, first, at_once(scene, together)):
        pulses = pulses_of_block(synthesis_plan, seed, block, _spanned(part))
        frames = make_frames(pulses, seed, block, synthesis_plan.dtype)
        for _, one in _by_block(part):
            yield batch_of(scene, pulses, frames, one)


def blocks(n_signals: int, first: int, n_blocks: int = 1) -> Iterator[tuple[int, slice]]:
    """Yield the first of every so many blocks that hold these signals, and the slice of their rows."""
    last = first + n_signals
    for block in range(first // BLOCK, (last - 1) // BLOCK + 1, n_blocks):
        yield block, slice(max(first - block * BLOCK, 0), min(last - block * BLOCK, n_blocks * BLOCK))


def _spanned(part: slice) -> int:
    """Return how many blocks hold these rows, which are counted from the first of them."""
    return int(-(-part.stop // BLOCK))


def _by_block(part: slice) -> Iterator[tuple[int, slice]]:
    """Yield the numbers of the blocks that hold these rows, and the rows of each."""
    for number in range(part.start // BLOCK, _spanned(part)):
        yield number, slice(max(number * BLOCK, part.start), min((number + 1) * BLOCK, part.stop))


def require_count(n_signals: int, first: int) -> tuple[int, int]:
    """Return a number of signals and the number of the first as integers, at most `MAX_NUMBER`."""
    return validation.whole("n_signals", n_signals, 1, MAX_NUMBER), validation.whole("first", first, 0, MAX_NUMBER)


def require_frames(scene: Scene) -> None:
    """Raise `InvalidValue` for a stream."""
    if scene.stream is not None:
        raise InvalidValue(
            f"scene {scene.name}: stream must be left out of a scene that frames are made of; make recordings of it "
            "(cgid generate SCENE -o RECORDING.h5)"
        )


def batch_of(scene: Scene, pulses: PulseBlock, frames: NDArray[Any], part: slice) -> Batch:
    """Return some of these signals of a scene, (n_signals, n_samples), with labels, parameters and specimens."""
    plan = pulses.plan
    return Batch(
        signals=frames[part],
        labels=pulses.labels[part],
        sampling_rate=pulses.scene.sampling.sampling_rate,
        unit=scene.sensor.unit if plan.sensed else "N",
        pre_trigger=scene.sampling.pre_trigger,
        specimen=pulses.specimen[part],
        parameters={name: values[part] for name, values in pulses.parameters.items()},
        source=scene.sha256,
    )


def make_frames(pulses: PulseBlock, seed: int, block: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return the frames of one block, or of several from it on, as planned."""
    return make_beginnings(pulses, seed, block, dtype, pulses.scene.sampling.samples)[0]


def make_beginnings(
    pulses: PulseBlock, seed: int, block: int, dtype: DTypeLike, n_samples: int
) -> tuple[NDArray[Any], Floats]:
    """Return the first samples of frames, equal to those of `make_frames`, and upper bounds of the rest."""
    # All contacts must end within them or begin after the frame.
    plan, sampling, sensor = pulses.plan, pulses.scene.sampling, pulses.scene.sensor
    n_signals, rate = len(pulses.labels), sampling.sampling_rate
    max_after = np.zeros(n_signals)
    # The transform of a low-pass is periodic over the complete frame.
    filtered = plan.runs("bandwidth")
    frames: NDArray[Any] = np.zeros((n_signals, sampling.samples if filtered else n_samples), dtype)
    pulses.add_to_frames(frames)
    peak = pulses.parameters["peak_force"]
    if filtered:
        frames = sensor.limit_band(frames, rate)
        max_after = frames[:, n_samples:].max(axis=1, initial=0.0).astype(np.float64)
        frames = np.ascontiguousarray(frames[:, :n_samples])
    if plan.runs("tail beam"):
        peak = np.abs(frames).max(axis=1).astype(np.float64)
    if plan.runs("noise"):
        level = sensor.noise_level(peak, rate)
        for number, part in _by_block(slice(0, n_signals)):
            add_sensor_noise(frames[part], level[part], pulses.scene, seed, block + number)
        max_after += MAX_NOISE * level
    background = background_of(pulses.scene) if plan.runs("background") else None
    if background is not None:
        for number, part in _by_block(slice(0, n_signals)):
            frames[part] += background.in_frames(seed, block + number, frames.shape[1], peak[part]).astype(frames.dtype)
    if plan.runs("clipping"):
        clip(frames, pulses.parameters["clipped_at"] * peak)
    if plan.runs("offset, range and bits"):
        sensor.digitise(frames, rate, peak)
        max_after += _digitised_by(sensor, rate, peak, n_samples, sampling.samples)
    return frames, max_after


def _digitised_by(sensor: Sensor, sampling_rate: float, peak: Floats, first: int, n_samples: int) -> Floats:
    """Return the largest increase of a sample, from a first one on, by offset, drift and rounding."""
    drift, step, full = (sensor.drift or 0.0) / sampling_rate, 0.0, sensor.full_scale(peak)
    if full is not None and sensor.bits is not None:
        step = full / 2**sensor.bits  # half of one
    return np.asarray((sensor.offset or 0.0) + max(drift * first, drift * n_samples) + step)


# -- columns of a table -----------------------------------------------------------------------------------


def columns_of(plan: Plan, n_signals: int, seed: int = 0, *, first: int = 0) -> Iterator[TableRows]:
    """Yield the columns of a plan in batches of at most 1024 signals, making only what a column needs."""
    # Features equal those of `cgid.measure.features.extract` for float32 signals; nan where one cannot be measured.
    n_signals, first = require_count(n_signals, first)
    seed = require_seed(seed)
    require_frames(plan.scene)
    if plan.kept:
        raise InvalidValue(
            "columns are of parameters, closed forms or features, the plan keeps signals; use synthesise"
        )
    if plan.runs("features"):
        return _measured(plan, n_signals, seed, first)
    several = blocks(n_signals, first, at_once(plan.scene, TOGETHER))
    return (_untimed(plan, seed, block, part) for block, part in several)


def _untimed(plan: Plan, seed: int, block: int, part: slice) -> TableRows:
    """Return the columns that need no pulse."""
    drawn = drawn_block(plan.scene, seed, block, _spanned(part))
    here, n = plan.for_block(drawn.scene), drawn.labels.size
    rate = np.full(n, drawn.scene.sampling.sampling_rate)
    values = drawn.values | {"asked_restitution": drawn.values["restitution"], "sampling_rate": rate}
    for name in plan.quantities:
        values[name] = drawn.values[name].copy() if name in OF_TAPS else np.full(n, np.nan)
    if here.runs("impacts") and drawn.fallen.size:
        for rows, contacts in contacts_of(here, drawn.values, drawn.fallen):
            for name in plan.quantities:
                values[name][rows] = getattr(contacts, name)
    return TableRows(
        labels=drawn.labels[part],
        specimen=drawn.specimen[part],
        columns={name: values[name][part] for name in plan.column_units},
    )


def _beginning(pulses: PulseBlock) -> int:
    """Return the number of samples of each frame that the features will most likely use."""
    sampling, names = pulses.scene.sampling, pulses.plan.features
    if pulses.plan.runs("rest of the frames"):
        return sampling.samples
    rate = sampling.sampling_rate
    needed = [
        samples_needed(names, strike.onset * rate, strike.pulses.contact_duration * rate).max()
        for strike in pulses.strikes
    ]
    return int(min(max(needed), sampling.samples))


def _measured(plan: Plan, n_signals: int, seed: int, first: int) -> Iterator[TableRows]:
    """Yield features; blocks with the same sampling rate are measured together."""
    together = 1 if plan.scene.draws("sampling_rate") else TOGETHER
    n_blocks = at_once(plan.scene, together)
    several = blocks(n_signals, first, n_blocks)
    drawn = ((block, part, pulses_of_block(plan, seed, block, _spanned(part))) for block, part in several)
    while group := list(islice(drawn, together // n_blocks)):
        yield _features(plan, seed, group)


def _features(plan: Plan, seed: int, drawn: list[tuple[int, slice, PulseBlock]]) -> TableRows:
    """Return the features of some blocks, each with its number and its requested signals."""
    names, sampling = plan.features, drawn[0][2].scene.sampling
    length = max(_beginning(pulses) for _, _, pulses in drawn)
    made = [make_beginnings(pulses, seed, block, np.float32, length) for block, _, pulses in drawn]
    frames = np.concatenate([signals[part] for (_, part, _), (signals, _) in zip(drawn, made, strict=True)])
    behind = np.concatenate([highest[part] for (_, part, _), (_, highest) in zip(drawn, made, strict=True)])
    if length == sampling.samples:
        table = extract_array(frames, sampling.sampling_rate, names, pre_trigger=sampling.pre_trigger, invalid="nan")
    else:
        table, certain = extract_truncated(frames, sampling.sampling_rate, names, sampling.pre_trigger, behind)
        if not certain.all():
            table[~certain] = _features_of_frames(names, seed, drawn, ~certain)
    values = dict(zip(names, table.T, strict=True))
    for name in parameter_units(plan.scene):
        values[f"{TRUE}{name}"] = np.concatenate([pulses.parameters[name][part] for _, part, pulses in drawn])
    if "sampling_rate" in plan.column_units:
        values["sampling_rate"] = np.full(len(table), sampling.sampling_rate)
    return TableRows(
        labels=np.concatenate([pulses.labels[part] for _, part, pulses in drawn]),
        specimen=np.concatenate([pulses.specimen[part] for _, part, pulses in drawn]),
        columns=values,
    )


def _features_of_frames(
    names: tuple[str, ...], seed: int, drawn: list[tuple[int, slice, PulseBlock]], needed: NDArray[np.bool_]
) -> Floats:
    """Return the features of signals whose first samples did not suffice, (n_wanted, n_features)."""
    sampling, rows, position = drawn[0][2].scene.sampling, [], 0
    for block, part, pulses in drawn:
        here = needed[position : position + part.stop - part.start]
        position += here.size
        if here.any():
            rows.append(make_frames(pulses, seed, block, np.float32)[part][here])
    return extract_array(
        np.concatenate(rows), sampling.sampling_rate, names, pre_trigger=sampling.pre_trigger, invalid="nan"
    )

"""Signals of given pulses, computed by another solver or measured, through the sensor and recorder of a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics.contact.sampled import SampledPulses
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.synthesis.draws import (
    BLOCK,
    PARTICLE,
    POINT_UNITS,
    RANDOMISED_UNITS,
    levels_of,
    numbers_of,
    onset_of,
    parameter_units,
    points_of_impact,
    require_seed,
    settings_of,
    settled,
    specimen_of,
    with_drawn_modes,
)
from cgid.scene.synthesis.impacts import PulseBlock, Strike
from cgid.scene.synthesis.plan import Plan, plan
from cgid.scene.synthesis.synthesis import batch_of, make_frames, require_frames
from cgid.signals import Batch

__all__ = ["synthesise_given"]

#: Parameters determined by the pulses, which may not be given.
_OF_PULSES = ("peak_force", "contact_duration")
#: The rules of parameters; others may be any finite number.
_RULES: dict[str, Callable[..., Floats]] = {
    "density": validation.positive,
    "youngs_modulus": validation.positive,
    "poisson_ratio": validation.poisson_ratio,
    "radius": validation.positive,
    "restitution": validation.restitution,
    "drop_height": validation.not_negative,
    "velocity": validation.positive,
    "second_hit_delay": validation.positive,
    "second_hit_ratio": validation.positive,
    "clipped_at": validation.positive,
    "impact_x": validation.not_negative,
    "impact_y": validation.not_negative,
}
#: A placeholder for unknown numbers that every rule allows.
_ALLOWED = 0.25


def synthesise_given(
    scene: Scene | str | Path,
    pulses: SampledPulses,
    labels: ArrayLike,
    parameters: Mapping[str, ArrayLike] | None = None,
    seed: int = 0,
    *,
    dtype: Literal["float32", "float64"] = "float32",
) -> Iterator[Batch]:
    """Yield the signals of given pulses in batches of at most 256, as `synthesise` does for a scene.

    Frames, beam, sensor, noise and background are those of the scene, and so are the random numbers: signal k has the
    onset and noise of signal k of `synthesise` with the same seed. The pulses are used unchanged: there are no second
    hits, and the beam does not act back on them.

    Parameters
    ----------
    scene : Scene, str or Path
        Its populations determine only which parameters are stored.
    pulses : SampledPulses
        n pulses [N].
    labels : array_like of str, (n,)
    parameters : dict of array_like, each (n,), optional
        Known parameters, with names and units of `cgid.scene.synthesis.draws.parameter_units`; others are nan. Missing
        or nan onsets and points of impact are drawn. Peak, duration and levels of the sensor may not be given.
    seed : int
        From 0 to 2^63 - 1.
    dtype : {"float32", "float64"}
        Of the samples.

    Yields
    ------
    Batch

    Raises
    ------
    InvalidValue
        No pulses, wrong number of labels or parameters, an unknown, impossible or derived parameter, or a scene of a
        stream.
    """
    scene = load_scene(scene)
    validation.choice("dtype", dtype, ("float32", "float64"))
    seed = require_seed(seed)
    require_frames(scene)
    n = len(pulses)
    names = np.asarray(labels, dtype=np.str_)
    if n < 1 or names.shape != (n,):
        raise InvalidValue(f"labels must be one for each of 1 or more pulses, got {names.size} for {n} pulses")
    known = _known(parameters or {}, scene, n)
    synthesis_plan = plan(scene, dtype=dtype)
    for first in range(0, n, BLOCK):
        # Blocks are complete: rows after the last pulse repeat it and are cut from the batch.
        rows = np.minimum(np.arange(first, first + BLOCK), n - 1)
        part = {name: values[rows] for name, values in known.items()}
        pulses_of_block = _block_pulses(synthesis_plan, pulses.taken(rows), names[rows], part, seed, first // BLOCK)
        frames = make_frames(pulses_of_block, seed, first // BLOCK, dtype)
        yield batch_of(scene, pulses_of_block, frames, slice(0, min(n - first, BLOCK)))


def _known(parameters: Mapping[str, ArrayLike], scene: Scene, n: int) -> dict[str, Floats]:
    known, units = {}, parameter_units(scene)
    for name, values in parameters.items():
        column = np.asarray(values)
        if name in _OF_PULSES:
            raise InvalidValue(f"{name} must be left out, it is that of the pulses")
        if name in RANDOMISED_UNITS:
            raise InvalidValue(f"{name} must be left out, it is that of the scene's sensor; change the scene")
        validation.choice("parameter", name, units)
        if column.shape != (n,) or column.dtype.kind not in "fiu":
            raise InvalidValue(f"{name} must be one number for each of {n} pulses, got shape {column.shape}")
        known[name] = column.astype(np.float64)
        checked = np.where(np.isnan(known[name]), _ALLOWED, known[name])
        _RULES.get(name, validation.real)(name, checked, *([units[name]] if units[name] != "1" else []))
    _require_on_beam(known, scene)
    return known


def _require_on_beam(known: Mapping[str, Floats], scene: Scene) -> None:
    if scene.region is None:
        return
    for name, (low, high) in zip(POINT_UNITS, (scene.region[:2], scene.region[2:]), strict=True):
        if name in known and (outside := (known[name] < low) | (known[name] > high)).any():
            row = np.flatnonzero(outside)[0]
            raise InvalidValue(
                f"{name} must be on the beam, between {low:g} and {high:g} m, got {known[name][row]:g} m at index {row}"
            )


def _block_pulses(
    plan: Plan, pulses: SampledPulses, labels: NDArray[np.str_], known: dict[str, Floats], seed: int, block: int
) -> PulseBlock:
    settings = settings_of(plan.scene, seed, block)
    here = with_drawn_modes(settled(plan.scene, settings), seed, block)
    values = {name: np.full(BLOCK, np.nan) for name in parameter_units(plan.scene)}
    drawn = {"onset": onset_of(here, numbers_of(seed, block)[-1]), **points_of_impact(here, seed, block)}
    values |= {"peak_force": pulses.peak_force, "contact_duration": pulses.contact_duration, **known}
    values |= {name: np.where(np.isnan(values[name]), sampled, values[name]) for name, sampled in drawn.items()}
    values |= levels_of(settings)
    # Each unknown particle counts as a separate specimen.
    particle = [known.get(name, np.full(BLOCK, np.nan)) for name in PARTICLE]
    unknown_particle = np.isnan(np.sum(particle, axis=0))
    number = block * BLOCK + np.arange(BLOCK, dtype=np.uint64)
    specimen = np.where(unknown_particle, number, specimen_of([np.ascontiguousarray(column) for column in particle]))
    strike = Strike(np.arange(BLOCK), pulses, values["onset"])
    return PulseBlock(labels, values, specimen, (strike,), plan.for_block(here))

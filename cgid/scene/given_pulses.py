"""Pulses that no law of a scene has made, as its sensor and recorder would have them: another solver's, or measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.physics.sampled import SampledPulses
from cgid.scene.impacts import PARTICLE
from cgid.scene.plan import Plan, plan
from cgid.scene.population import (
    POINT_UNITS,
    RANDOMISED_UNITS,
    levels_of,
    numbers_of,
    onset_of,
    parameter_units,
    points_of_impact,
    specimen_of,
)
from cgid.scene.randomisation import settled
from cgid.scene.randomness import BLOCK
from cgid.scene.scene import Scene
from cgid.scene.strike import Blows, Strike
from cgid.scene.synthesis import batch_of, require_frames
from cgid.signals import Batch
from cgid.validation import Floats

#: What follows from the pulses, and may not be said beside them.
_OF_PULSES = ("peak_force", "contact_duration")
#: What is possible; of a name that is not here, any finite number.
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
#: A number that every rule allows, to stand where none is known.
_ALLOWED = 0.25


def synthesise_given(
    scene: Scene,
    pulses: SampledPulses,
    labels: ArrayLike,
    parameters: Mapping[str, ArrayLike] | None = None,
    seed: int = 0,
    *,
    dtype: Literal["float32", "float64"] = "float32",
) -> Iterator[Batch]:
    """Yield the signals of given pulses in batches of at most 256, as `synthesise` does for those of a scene.

    Frames, beam, sensor, noise and background are those of the scene, and so is every number drawn for them: signal k
    touches where signal k of `synthesise` with the same seed does, and has its noise. The pulses are taken as they
    are: a second hit of the scene does not come, and a beam is driven by them and does not give way again.

    Parameters
    ----------
    scene : Scene
        Its populations only say which parameters are stored.
    pulses : SampledPulses
        n of them, in newtons.
    labels : array_like of str, (n,)
    parameters : dict of array_like, each (n,), optional
        What is known of each impact, by the names and in the units of `cgid.scene.population.parameter_units`; nan
        where it is not. Onset and points of impact are drawn as the scene does where they are nan or left out. Peak and
        duration are those of the pulses, levels of the sensor those of the scene.
    seed : int
        Between 0 and 2^63 - 1.
    dtype : {"float32", "float64"}
        Of the samples.

    Raises
    ------
    InvalidValue
        There is no pulse, labels or parameters are of another number, a parameter is none of the scene's, may not be
        said or is impossible, or the scene makes recordings.
    """
    validation.choice("dtype", dtype, ("float32", "float64"))
    require_frames(scene)
    n = len(pulses)
    names = np.asarray(labels, dtype=np.str_)
    if n < 1 or names.shape != (n,):
        raise InvalidValue(f"labels must be one for each of 1 or more pulses, got {names.size} for {n} pulses")
    known = _known(parameters or {}, scene, n)
    asked = plan(scene, dtype=dtype)
    for first in range(0, n, BLOCK):
        # A block is drawn whole: rows behind the last pulse repeat it, and are left out of the batch.
        rows = np.minimum(np.arange(first, first + BLOCK), n - 1)
        part = {name: values[rows] for name, values in known.items()}
        struck = _struck(asked, pulses.taken(rows), names[rows], part, seed, first // BLOCK)
        yield batch_of(asked, struck, seed, first // BLOCK, slice(0, min(n - first, BLOCK)), dtype)


def _known(parameters: Mapping[str, ArrayLike], scene: Scene, n: int) -> dict[str, Floats]:
    known, units = {}, parameter_units(scene)
    for name, values in parameters.items():
        column = np.asarray(values)
        if name in _OF_PULSES:
            raise InvalidValue(f"{name} must be left out, it is that of the pulses")
        if name in RANDOMISED_UNITS:
            raise InvalidValue(f"{name} must be left out, it is that of the scene's sensor; vary the scene")
        validation.choice("parameter", name, units)
        if column.shape != (n,) or column.dtype.kind not in "fiu":
            raise InvalidValue(f"{name} must be one number for each of {n} pulses, got shape {column.shape}")
        known[name] = column.astype(np.float64)
        said = np.where(np.isnan(known[name]), _ALLOWED, known[name])
        _RULES.get(name, validation.real)(name, said, *([units[name]] if units[name] != "1" else []))
    _require_on_panel(known, scene)
    return known


def _require_on_panel(known: Mapping[str, Floats], scene: Scene) -> None:
    if scene.tail_beam is None:
        return
    for name, size in zip(POINT_UNITS, (scene.tail_beam.length, scene.tail_beam.width), strict=True):
        if name in known and size is not None and (beside := known[name] > size).any():
            row = np.flatnonzero(beside)[0]
            raise InvalidValue(
                f"{name} must lie on the beam, between 0 and {size:g} m, got {known[name][row]:g} m at index {row}"
            )


def _struck(
    asked: Plan, pulses: SampledPulses, labels: NDArray[np.str_], known: dict[str, Floats], seed: int, block: int
) -> Blows:
    here = settled(asked.request.scene, seed, block)
    values = {name: np.full(BLOCK, np.nan) for name in parameter_units(asked.request.scene)}
    drawn = {"onset": onset_of(here, numbers_of(seed, block)[-1]), **points_of_impact(here, seed, block)}
    values |= {"peak_force": pulses.peak_force, "contact_duration": pulses.contact_duration, **known}
    values |= {name: np.where(np.isnan(values[name]), own, values[name]) for name, own in drawn.items()}
    values |= levels_of(here, values)
    # Where nobody said what fell, each is something else.
    particle = [known.get(name, np.full(BLOCK, np.nan)) for name in PARTICLE]
    stranger = np.isnan(np.sum(particle, axis=0))
    number = block * BLOCK + np.arange(BLOCK, dtype=np.uint64)
    specimen = np.where(stranger, number, specimen_of([np.ascontiguousarray(column) for column in particle]))
    return Blows(labels, values, specimen, (Strike(np.arange(BLOCK), pulses, values["onset"]),), here)

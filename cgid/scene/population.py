"""From a scene and a seed to the parameters of its impacts, as arrays, block by block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.impact import Elastic, HuntCrossley, Impact, Sphere, free_fall_velocity
from cgid.materials import Material
from cgid.scene.randomness import uniforms
from cgid.scene.scene import Scene
from cgid.validation import Floats

#: The stored parameters and their units.
PARAMETER_UNITS = {
    "density": "kg/m^3",
    "youngs_modulus": "Pa",
    "poisson_ratio": "1",
    "radius": "m",
    "restitution": "1",
    "drop_height": "m",
    "velocity": "m/s",
    "onset": "s",
    "peak_force": "N",
    "contact_duration": "s",
}
_DRAWN = ("density", "youngs_modulus", "poisson_ratio", "radius", "restitution", "fall")


@dataclass(frozen=True)
class Draw:
    """The impacts of one block.

    Attributes
    ----------
    labels : ndarray of str, (n_signals,)
    parameters : dict of ndarray, each (n_signals,)
        Drawn and derived, in `PARAMETER_UNITS`; onset is the time of touch in the frame.
    specimen : ndarray of uint64, (n_signals,)
        Equal for impacts of an equal particle.
    impact : Impact
        All of them.
    """

    labels: NDArray[np.str_]
    parameters: Mapping[str, Floats]
    specimen: NDArray[np.uint64]
    impact: Impact


def draw(scene: Scene, seed: int, block: int) -> Draw:
    """Return the impacts of one block of 256."""
    kinds = uniforms(seed, block, len(_DRAWN) + 2)
    weights = np.array([population.weight for population in scene.populations])
    edges = np.cumsum(weights / weights.sum())
    which = np.minimum(np.searchsorted(edges, kinds[0], side="right"), len(weights) - 1)
    values = {name: np.ones(which.size) for name in (*_DRAWN[:-1], "drop_height", "velocity")}
    values["drop_height"][:] = np.nan
    for index, population in enumerate(scene.populations):
        rows = np.flatnonzero(which == index)
        for column, name in enumerate(_DRAWN, start=1):
            if name == "fall":
                name = "velocity" if population.drop_height is None else "drop_height"
            distribution = getattr(population, name)
            if distribution is not None:
                values[name][rows] = distribution.quantile(kinds[column][rows])
    fell = np.isfinite(values["drop_height"])
    values["velocity"][fell] = free_fall_velocity(values["drop_height"][fell])
    sampling = scene.sampling
    values["onset"] = (sampling.pre_trigger + sampling.jitter * kinds[-1]) / sampling.sampling_rate
    impact = _impact(scene, values)
    # What a law delivers is what the pulse shows, and what was asked may differ from it.
    for name in ("restitution", "peak_force", "contact_duration"):
        values[name] = getattr(impact, name)
    labels = np.array([population.label for population in scene.populations])[which]
    particle = [values[name] for name in ("density", "youngs_modulus", "poisson_ratio", "radius")]
    return Draw(labels, {name: values[name] for name in PARAMETER_UNITS}, _specimen(particle), impact)


def _impact(scene: Scene, values: Mapping[str, Floats]) -> Impact:
    material = Material(
        density=values["density"], youngs_modulus=values["youngs_modulus"], poisson_ratio=values["poisson_ratio"]
    )
    elastic = scene.impact.dissipation == "elastic"
    return Impact(
        sphere=Sphere(material=material, radius=values["radius"]),
        target=scene.impact.body,
        velocity=values["velocity"],
        stiffness=scene.impact.stiffness,
        dissipation=Elastic() if elastic else HuntCrossley(restitution=values["restitution"], law=scene.impact.law),
    )


def _specimen(particle: list[Floats]) -> NDArray[np.uint64]:
    """Mix material and size into one 64-bit number (the finaliser of splitmix64, Steele et al. 2014).

    An equal particle has the same number in every population, scene and dataset.
    """
    mixed = np.zeros(particle[0].shape, np.uint64)
    for values in particle:
        mixed = mixed + values.view(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return mixed

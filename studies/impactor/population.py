"""The population of a scene: random draws of its impacts with their pulses."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.fit.template import relative_times
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.synthesis.impacts import draws
from studies.impactor.posterior import ImpactorPopulation

#: Number of draws.
_DRAWS = 1 << 17
#: Seed of these draws, unlikely to be chosen for the signals.
_SEED = 0x5EED_0003_C9D1
#: Number of cached populations (some 10 MB each).
_CACHE_SIZE = 4


def population_of(scene: Scene | str | Path, n_draws: int = _DRAWS) -> ImpactorPopulation:
    """Return the population of a scene, the prior of an impactor.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a file, or a shipped one by name: frames of elastic or Hunt-Crossley spheres on a half-space or a rigid
        wall.
    n_draws : int

    Returns
    -------
    ImpactorPopulation

    Raises
    ------
    InvalidValue
        The scene is another one.
    """
    # A file may change, a scene does not.
    return _drawn(load_scene(scene), n_draws)


@lru_cache(maxsize=_CACHE_SIZE)
def _drawn(scene: Scene, n_draws: int) -> ImpactorPopulation:
    thickness = getattr(scene.impact.target, "thickness", None)
    for rule, lacks in (
        ("fixed settings; take [randomise] out", scene.randomise is not None),
        ("populations, it has only taps", not scene.populations),
        ("single frames; take [stream] out", scene.stream is not None),
        # Whose pulses are of the family, with the stored peak, duration and restitution, and similar in all sizes.
        ("elastic or hunt-crossley contacts", not set(scene.dissipations) <= {"hunt-crossley", "elastic"}),
        ("a half-space or rigid target", scene.tail_beam is not None or thickness is not None),
        ("no gravity", scene.impact.gravity is not None),
    ):
        if lacks:
            raise InvalidValue(f"scene {scene.name}: must have {rule} to estimate impactors")
    numbers = {label: number for number, label in enumerate(scene.labels)}
    names = ("peak_force", "contact_duration", "restitution", "radius", "velocity", "density")
    parts: list[dict[str, Floats]] = []
    blocks = draws(scene, _SEED)
    while sum(part["radius"].size for part in parts) < n_draws:
        impacts = next(blocks)
        rows = np.flatnonzero(np.isfinite(impacts.parameters["radius"]))
        group = np.array([numbers[str(label)] for label in impacts.labels])[rows]
        parts.append({"group": group, **{name: impacts.parameters[name][rows] for name in names}})
    drawn = {name: np.concatenate([part[name] for part in parts])[:n_draws] for name in parts[0]}
    shape = np.log(np.maximum(drawn["restitution"], 1e-3))
    return ImpactorPopulation(
        log_peak=np.log(drawn["peak_force"]),
        log_width=np.log(drawn["contact_duration"] / relative_times(shape)[0]),
        shape=shape,
        log_radius=np.log(drawn["radius"]),
        log_speed=np.log(drawn["velocity"]),
        log_mass=np.log(4 / 3 * np.pi * drawn["density"]) + 3 * np.log(drawn["radius"]),
        group=drawn["group"].astype(np.intp),
        name=f"scene {scene.name}",
    )

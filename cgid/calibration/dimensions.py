"""The dimensions of a beam, learned from impacts at unknown locations with unknown forces.

A drawing gives length, width, thickness and ribs to a few per cent. Gauss-Newton steps on their logarithms, with
locations and forces projected out as in `learning`, precede the learning of modes. The lowest modes come first: their
responses shift by less than a period even where the drawing is wrong. Each wider band then refines the dimensions.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgid._lib.validation import Floats
from cgid.calibration.learning import ImpactFrames, System, newton
from cgid.errors import InvalidValue
from cgid.identification.inversion.inversion import Inversion
from cgid.measure.modal.beam import Beam
from cgid.scene.file.schema import Scene, parse_scene
from cgid.scene.synthesis.through_beam import through_modes

#: Dimensions of a [tail_beam] that may be learned.
DAMPING = "damping_ratio"
DIMENSIONS = (
    "length", "width", "thickness", "ribs.depth", "ribs.thickness", "sensor_point.x", "sensor_point.y", DAMPING,
)  # fmt: skip
SENSOR = ("sensor_point.x", "sensor_point.y")
#: Largest error of a dimension; error of the damping ratio over the largest of a dimension, and its maximum.
_MAX_ERROR, _DAMPING_A_DIMENSION, _MAX_DAMPING = 0.1, 10.0, 0.3
#: Keys of a distribution that are lengths.
_LENGTHS = ("value", "values", "lowest", "highest", "mean", "deviation", "median", "characteristic", "parts")
#: Successive bands as fractions of the whole; rounds in each, and number of impacts.
_BANDS, _ROUNDS, _FEW = (0.03, 0.05, 0.08, 0.12, 0.18, 0.26, 0.4, 0.6), 6, 60
MAX_ROUNDS = len(_BANDS) * _ROUNDS
#: Minimum number of modes of a band.
_MIN_MODES = 4
#: A band has converged when no step is longer than this fraction of its standard deviation.
_CONVERGED = 0.3
#: Step of the difference quotients in a logarithm.
_STEP = 1e-4


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """A dimension of a beam before and after learning."""

    name: str  # key of the scene, below `tail_beam`
    before: float  # `before`, `after`: in the SI unit of the scene
    after: float
    deviation: float  # standard deviation of the logarithm


def dimension_errors(scene: Scene, error: float | Mapping[str, float]) -> dict[str, float]:
    """Return the relative errors of the dimensions to learn, by name; empty if all are 0."""
    # The damping ratio is 10 times as uncertain as the worst dimension, at most 30 %.
    dimensions = dimensions_of(scene)
    given = (
        dict(error) if isinstance(error, Mapping) else dict.fromkeys(dimensions or DIMENSIONS, error) | {DAMPING: 0.0}
    )
    for name, value in given.items():
        max_value = _MAX_DAMPING if name == DAMPING else _MAX_ERROR
        if not 0 <= value <= max_value:
            raise InvalidValue(f"dimension_error must be at least 0 and at most {max_value:g}, got {value:g} of {name}")
    errors = {name: value for name, value in given.items() if value}
    if not errors:
        return {}
    if scene.panel is None or (scene.tail_beam is not None and scene.tail_beam.learned is not None):
        what = "tapped" if scene.panel is None else "learned"
        raise InvalidValue(
            f"scene {scene.name}: must have a beam given by its dimensions to learn them, its modes are {what}; leave "
            "dimension_error at 0, or start from the drawing"
        )
    unknown = [name for name in errors if name not in dimensions]
    if unknown:
        raise InvalidValue(f"dimension_error must be of {', '.join(dimensions)}, got {unknown[0]}")
    worst = max(errors.values())
    return {name: errors[name] for name in dimensions if name in errors} | {
        DAMPING: errors.get(DAMPING, min(_DAMPING_A_DIMENSION * worst, _MAX_DAMPING))
    }


def learn_dimensions(
    scene: Scene,
    beam: Beam,
    impacts: ImpactFrames,
    errors: Mapping[str, float],
    *,
    progress: Callable[[int], object] | None = None,
) -> tuple[Scene, tuple[Dimension, ...]]:
    """Return a scene with learned dimensions, and the dimensions."""
    # `beam` is that of the scene, with modes not yet learned; `progress` receives the number of rounds since the last
    # call.
    before, names, prior = dimensions_of(scene), list(errors), np.array(list(errors.values()))
    now, deviation = np.zeros(len(names)), prior
    impacts = impacts.taken(slice(_FEW))
    raised = np.ones(len(impacts))
    inversion = Inversion(beam)
    top = inversion.bins.stop / inversion.n_samples * beam.sampling_rate

    def of(change: Floats) -> Beam:
        return through_modes(with_dimensions(scene, names, change), beam)

    def beside(number: int) -> tuple[Beam, Beam]:
        step = np.zeros(len(names))
        step[number] = _STEP
        return of(now + step), of(now - step)

    for fraction in _BANDS:
        if np.count_nonzero(np.abs(of(now).poles) < 2 * np.pi * fraction * top) < _MIN_MODES:
            continue
        for _ in range(_ROUNDS):
            system = System(of(now), impacts, raised, fraction * top)
            pulls, curvature = system.equations(system.by_beams(beside, len(names), _STEP))
            raised = np.sqrt(np.maximum(system.power, 1.0))
            now, step, deviation = newton(curvature, pulls, prior, now)
            if progress is not None:
                progress(1)
            if (np.abs(step) < _CONVERGED * deviation).all():
                break
    candidate = with_dimensions(scene, names, now)
    after = dimensions_of(candidate)
    values = (
        Dimension(name=name, before=before[name], after=after[name], deviation=float(one))
        for name, one in zip(names, deviation, strict=True)
    )
    return candidate, tuple(values)


def dimensions_of(scene: Scene) -> dict[str, float]:
    """Return the `DIMENSIONS` that a scene's beam has [m], and its damping ratio."""
    values = {}
    for name in DIMENSIONS:
        part: Any = json.loads(scene.text).get("tail_beam")
        for key in name.split("."):
            part = part.get(key) if isinstance(part, dict) else None
        if isinstance(part, int | float):
            values[name] = float(part)
    return values


def with_dimensions(scene: Scene, names: list[str], change: Floats) -> Scene:
    """Return a scene with other dimensions of its beam, by the change of their logarithms."""
    # Impacts and the sensor keep their positions, or move inwards as the beam gets shorter.
    content = json.loads(scene.text)
    beam = content["tail_beam"]
    for name, log in zip(names, change.tolist(), strict=True):
        *folders, last = name.split(".")
        part = beam
        for folder in folders:
            part = part[folder]
        part[last] *= float(np.exp(log))
    assert scene.tail_beam is not None and scene.tail_beam.impact_point is not None
    for axis, side in (("x", "length"), ("y", "width")):
        furthest = getattr(scene.tail_beam.impact_point, axis).extremes[1]
        if furthest > beam[side]:
            beam["impact_point"][axis] = _scaled(beam["impact_point"][axis], beam[side] / furthest * (1 - 1e-12))
        beam["sensor_point"][axis] = min(beam["sensor_point"][axis], beam[side])
    return parse_scene(content, source=f"other dimensions of {scene.name}", folder=scene.folder)


def _scaled(location: Any, factor: float) -> Any:
    """Return a number or a distribution of lengths in another unit."""
    if isinstance(location, int | float):
        return location * factor
    if isinstance(location, list):
        return [_scaled(one, factor) for one in location]
    return {key: _scaled(one, factor) if key in _LENGTHS else one for key, one in location.items()}

"""The inversion of a scene's beam to the contact force: beam, sensor and the contact forces of its rocks."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import eigh

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.modal.beam import (
    FINE,
    FORCE_TIME,
    MAX_SENSORS,
    RATES,
    SPAN_TIME,
    TOUCH,
    Beam,
    bounded,
    filtered,
    points_of,
)
from cgid.measure.modal.modes import Modes, NodeShapes, nodes
from cgid.physics.structure.response import DERIVATIVES, HighPass, LinearPhase
from cgid.scene.file.schema import Scene, load_scene, parse_scene, stored_scene
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.impacts import beam_modes, draw
from cgid.scene.synthesis.plan import highest_frequency

if TYPE_CHECKING:
    from cgid.store.reading import Dataset

#: Pulses drawn for the principal shapes, in blocks of 256, their seed, and the number of shapes.
_BLOCKS, _SEED, N_SHAPES = 12, 0x5EED_0002_C9D1, 18
#: Longest delay of a filter in a table of forces [s].
_DELAY = 0.3 * FORCE_TIME
#: Multiples of the golden section fill an interval evenly.
_GOLDEN = 0.6180339887498949
#: Chebyshev nodes to a wave of the highest mode, and beyond.
_NODES_A_WAVE, _NODES = 4.0, 7
#: Rocks that bounce reach a beam of known size all over, but for these shares of its length and width.
_LENGTHWISE, _CROSSWISE = (0.06, 0.97), (0.07, 0.93)


def beam_of(scene: Scene | str | Path, n_shapes: int = N_SHAPES, sensors: Iterable[tuple[float, float]] = ()) -> Beam:
    """Return the beam of a scene as arrays, with the principal shapes of its contact forces; `sensors` [m]."""
    scene = load_scene(scene)
    if scene.tail_beam is None or scene.sensor.quantity == "force":
        raise InvalidValue(
            f"scene {scene.name}: must have a [tail_beam] and a sensor of motion to look through the beam; add them"
        )
    # An AC coupling, which acts below the modes, is not looked through.
    modes, chain = beam_modes(scene), [part for part in scene.sensor.filters if not isinstance(part, HighPass)]
    rate = scene.sampling.sampling_rate
    at_sensors = _at_sensors(scene, list(sensors))
    best = np.abs(at_sensors).max(axis=0) if len(at_sensors) > 1 else at_sensors[0]
    beam = Beam(
        sampling_rate=rate,
        modes=replace(
            modes,
            at_impact=_at_nodes(scene, replace(modes, at_sensor=best)),
            at_sensor=at_sensors / np.where(best == 0, 1, best) if len(at_sensors) > 1 else np.ones_like(at_sensors),
        ),
        filters=np.concatenate([np.empty(0, complex), *(part.poles for part in chain)]),
        linear_phase=next((linear_phase_of(part) for part in chain if isinstance(part, LinearPhase)), None),
        derivatives=DERIVATIVES[scene.sensor.quantity],
        shapes=np.zeros((0, points_of(rate))),
        deviations=np.zeros(0),
    )
    forces = contact_forces(scene)
    responses = filtered(beam, forces)
    # Principal shapes of what passes the filters, as sums of whole forces: other filters can then be applied to them.
    n_points = forces.shape[1]
    power, shapes = eigh(responses.T @ responses, subset_by_index=(n_points - n_shapes, n_points - 1))
    power, mixes = power[::-1], responses @ (shapes / power)[:, ::-1]
    return replace(beam, shapes=mixes.T @ forces, deviations=np.sqrt(power / len(forces)))


def linear_phase_of(part: LinearPhase, longest: float = _DELAY) -> Floats:
    """Return a filter of linear phase as in `Beam.linear_phase`."""
    # A recorder may be later: the onset is sought. What comes earlier than the delay is lost.
    return np.array([part.frequency, part.width, min(part.delay, longest)])


def through_modes(scene: Scene, beam: Beam) -> Beam:
    """Return a beam with the modes of a scene instead of its own: those of other dimensions, without errors."""
    modes = beam_modes(scene)
    at_node = replace(
        modes, at_impact=_at_nodes(scene, modes), at_sensor=np.ones((1, modes.frequency.size)), deviation=None
    )
    return replace(beam, modes=at_node)


def full_beam(scene: Scene, sensors: Iterable[tuple[float, float]] = ()) -> Beam:
    """Return the beam of a scene to look through, as far as rocks bounce; arguments as of `beam_of`."""
    content = json.loads(scene.text)
    spread_over(content.get("tail_beam", {}))
    return beam_of(parse_scene(content, folder=scene.folder), sensors=sensors)


def spread_over(beam: dict[str, Any]) -> None:
    """Let impacts fall all over a beam of known size, or all over the places of its shapes."""
    if places := beam.get("shapes"):
        for axis in "xy":
            low, high = (end(place[axis] for place in places) for end in (min, max))
            beam["impact_point"][axis] = low if low == high else _uniform(1.0, (low, high))
    elif beam.get("impact_point") is not None and {"length", "width"} <= beam.keys():
        beam["impact_point"] = {"x": _uniform(beam["length"], _LENGTHWISE), "y": _uniform(beam["width"], _CROSSWISE)}


def _uniform(length: float, shares: tuple[float, float]) -> dict[str, Any]:
    return {"distribution": "uniform", "lowest": shares[0] * length, "highest": shares[1] * length}


def has_beam(scene: Scene) -> bool:
    """Return whether a scene has a beam to look through: a motion at one rate, of few enough modes."""
    return not why_no_beam(scene)


def why_no_beam(scene: Scene) -> str:
    """Return why the signals of a scene cannot be looked through a beam; empty if they can."""
    if scene.sensor.quantity == "force":
        return "its sensor measures the force itself"
    if scene.tail_beam is None:
        return "it has no [tail_beam]"
    drawn = [name for name in ("sampling_rate", "anti_alias_frequency") if scene.draws(name)]
    if drawn:
        return f"its {drawn[0]} differs from impact to impact"
    if scene.stream is None and scene.sampling.samples < 2:
        return "its frames are of one sample"
    rate, n_modes = scene.sampling.sampling_rate, beam_modes(scene).frequency.size
    if not RATES[0] <= rate <= RATES[1]:
        return f"its sampling rate, {rate:g} Hz, is outside of {RATES[0]:g} to {RATES[1]:g} Hz"
    return "" if bounded(n_modes, N_SHAPES, round(SPAN_TIME * rate), _region(scene)) else "it has too many modes"


def shared_beam(
    sources: Sequence[Scene | Dataset], sensors: Iterable[tuple[float, float]] = ()
) -> tuple[Beam | None, str]:
    """Return the beam that scenes and datasets share, and in words where it comes from or why there is none."""
    scenes: list[Scene] = []
    for source in sources:
        # Only a beam needs the laws of its scene: those of one's own may not be at hand.
        if not isinstance(source, Scene) and source.quantity == "force":
            return None, f"{source.path.name}: its signals are the force itself"
        scene = source if isinstance(source, Scene) else stored_scene(source.header.attributes, str(source.path))
        if scene is None:
            return None, "a dataset does not hold its scene"
        if why := why_no_beam(scene):
            return None, f"scene {scene.name}: {why}"
        if scenes and _rig(scene) != _rig(scenes[0]):
            return None, f"scenes {scenes[0].name} and {scene.name} differ in their beam, sensor or sampling rate"
        scenes.append(scene)
    return beam_of(scenes[0], sensors=sensors), f"through the beam of scene {scenes[0].name}"


def _rig(scene: Scene) -> tuple[Any, ...]:
    """Return what the modes and the sensor of a scene follow from."""
    content, sensor = json.loads(scene.text), scene.sensor
    steel = content["impact"].get("target")
    return content["tail_beam"], steel, sensor.quantity, sensor.filters, scene.sampling.sampling_rate


def contact_forces(scene: Scene) -> Floats:
    """Return contact forces of the scene's rocks over their peaks, as in `Beam.shapes`."""
    rate, n_points = scene.sampling.sampling_rate, points_of(scene.sampling.sampling_rate)
    blocks = []
    for block in range(_BLOCKS):
        blows = draw(scene, _SEED, block)
        forces = np.zeros((BLOCK, n_points))
        touch = np.asarray((np.arange(BLOCK) * _GOLDEN) % 1 * TOUCH / rate, np.float64)
        for strike in blows.strikes:
            if strike.ratio is None:
                frames = np.zeros((strike.rows.size, n_points))
                strike.pulses.add_to_frames(frames, FINE * rate, np.asarray(touch[strike.rows], np.float64))
                forces[strike.rows] = frames
        peak = forces.max(axis=1)
        blocks.append(forces[peak > 0] / peak[peak > 0, None])
    return np.concatenate(blocks)


def moved(scene: Scene, point: tuple[float, float]) -> Scene:
    """Return a scene with its sensor at another point (x, y) [m] of the beam."""
    if scene.tail_beam is None or scene.tail_beam.modes is not None:
        raise InvalidValue(
            f"scene {scene.name}: must have the dimensions of a beam to move its sensor, measured modes are those of "
            "one point; leave sensors out, or give length, width, thickness and edges in place of modes"
        )
    learned = scene.tail_beam.learned_modes
    uncertain = learned is not None and learned.deviation is not None and learned.deviation[2].any()
    if learned is not None and ((learned.participation() != 1).any() or uncertain):
        raise InvalidValue(
            f"scene {scene.name}: tail_beam.learned must have participations of 1 without deviation to move its "
            "sensor, those learned from impacts are of one point; leave sensors out, or tail_beam.learned"
        )
    content = json.loads(scene.text)
    content["tail_beam"]["sensor_point"] = dict(zip("xy", map(float, point), strict=True))
    return parse_scene(content, source=f"scene {scene.name} with its sensor elsewhere", folder=scene.folder)


def _at_sensors(scene: Scene, points: list[tuple[float, float]]) -> Floats:
    """Return the shapes of the modes at sensors, (n_sensors, n_modes)."""
    if not 0 <= len(points) <= MAX_SENSORS:
        raise InvalidValue(f"sensors must be at most {MAX_SENSORS} points, got {len(points)}; leave some out")
    scenes = [moved(scene, point) for point in points] or [scene]
    return np.stack([np.asarray(beam_modes(one).at_sensor) for one in scenes])


def _at_nodes(scene: Scene, modes: Modes) -> NodeShapes:
    """Return the participation of the modes at Chebyshev nodes of the region where rocks fall, times the gain."""
    gain = scene.sensor.gain or 1.0
    if scene.region is None:
        return NodeShapes((modes.participation() * gain)[:, None, None], np.zeros(4))
    region = _region(scene)
    sides = []
    for axis, (low, high) in enumerate(region.reshape(2, 2).tolist()):
        if scene.panel is None:
            assert isinstance(modes.at_impact, NodeShapes)
            own, size = modes.at_impact.values.shape[1 + axis], np.ptp(modes.at_impact.region[2 * axis :][:2])
            n = int(np.ceil(own * (high - low) / max(size, high - low))) + _NODES if high > low else 1
        else:
            # A free wave, k^4 = omega^2 m / D.
            omega, rigidities = 2 * np.pi * highest_frequency(scene), scene.panel.rigidities
            wave_number = np.sqrt(omega * np.sqrt(rigidities.mass / (rigidities.along, rigidities.across)[axis]))
            n = int(np.ceil(_NODES_A_WAVE * wave_number * (high - low) / (2 * np.pi))) + _NODES
        sides.append(nodes(n if high > low else 1, low, high))
    x, y = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
    at = modes.participation(x, y) * gain
    return NodeShapes(np.ascontiguousarray(at.T.reshape(-1, sides[0].size, sides[1].size)), region)


def _region(scene: Scene) -> Floats:
    """Return minimum and maximum x, minimum and maximum y of impact locations [m]; zeros if irrelevant."""
    assert scene.tail_beam is not None
    point = scene.tail_beam.impact_point
    return np.zeros(4) if point is None else np.array([*point.x.extremes, *point.y.extremes])

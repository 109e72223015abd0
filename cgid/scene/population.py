"""From a scene and a seed to the pulses of one block and their parameters, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cgid.physics import Impact, free_fall_velocity
from cgid.physics.coupled import ModalImpact
from cgid.scene.impacts import PARTICLE, impact_of, impacts_by_coupling
from cgid.scene.randomisation import settled
from cgid.scene.randomness import BLOCK, CLIPPING, IMPACT_POINTS, SECOND_HITS, TAPS, uniforms
from cgid.scene.scene import Scene
from cgid.scene.strike import Blows, Strike
from cgid.scene.taps import SHAPES, TapPulses
from cgid.validation import Floats

#: The stored parameters of every scene and their units.
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
#: Those of what only some scenes have; the sampling rate, where it is randomised, is said by the batch.
_MORE_UNITS = {"second_hit_delay": "s", "second_hit_ratio": "1", "clipped_at": "1"}
POINT_UNITS = {"impact_x": "m", "impact_y": "m"}
#: Those of the sensor, where a scene draws them for each block.
RANDOMISED_UNITS = {"relative_noise": "1", "bandwidth": "Hz"}
#: What the numbers of an address are for, in their order. A fall has one number, whether it is a height or a speed.
FALL = (*PARTICLE, "restitution", "drop_height")
_LATER = {
    TAPS: ("peak_force", "contact_duration"),
    SECOND_HITS: ("second_hit_delay", "second_hit_ratio"),
    CLIPPING: ("clipped_at",),
}


def parameter_units(scene: Scene) -> dict[str, str]:
    """Return the stored parameters of a scene and their units: `PARAMETER_UNITS`, and those of the parts it has."""
    drawn = {name for source in scene.sources for name in source.laws}
    units = PARAMETER_UNITS | {name: unit for name, unit in _MORE_UNITS.items() if name in drawn}
    if scene.panel is not None:
        units |= POINT_UNITS
    if scene.randomise is not None:
        units |= {name: unit for name, unit in RANDOMISED_UNITS.items() if name in scene.randomise.laws}
    return units


@dataclass(frozen=True)
class Draw(Blows):
    """The pulses of one block, as a scene draws them; their parameters are those of `parameter_units`.

    Attributes
    ----------
    impact : Impact
        All that are impacts: every signal of a scene without taps.
    """

    impact: Impact

    @property
    def inelasticity(self) -> Floats:
        """Zener's lambda of the impacts themselves, 0 for what goes through the modes of a beam, (n_impacts,)."""
        first = [strike.pulses for strike in self.strikes if strike.ratio is None]
        return np.concatenate([np.empty(0), *(p.inelasticity for p in first if isinstance(p, Impact))])


@dataclass(frozen=True)
class Given:
    """What is drawn for one block, before any law of impact is asked.

    Attributes
    ----------
    labels : ndarray of str, (n_signals,)
    values : dict of ndarray, each (n_signals,)
        In `parameter_units`, nan where one is not drawn; the restitution is the one asked for.
    specimen : ndarray of uint64, (n_signals,)
    shapes : ndarray of int, (n_signals,)
        Of a tap its number in `SHAPES`, of an impact -1.
    scene : Scene
        The scene as it holds in this block.
    """

    labels: NDArray[np.str_]
    values: dict[str, Floats]
    specimen: NDArray[np.uint64]
    shapes: NDArray[np.intp]
    scene: Scene

    @property
    def fallen(self) -> NDArray[np.intp]:
        """Rows of the impacts."""
        return np.flatnonzero(self.shapes < 0)

    @property
    def tapped(self) -> NDArray[np.intp]:
        """Rows of the taps."""
        return np.flatnonzero(self.shapes >= 0)

    @property
    def impact(self) -> Impact:
        """All impacts of the block."""
        return impact_of(self.scene, self.values, self.fallen)


def given(scene: Scene, seed: int, block: int) -> Given:
    """Return what is drawn for one block of 256."""
    here = settled(scene, seed, block)
    kinds = numbers_of(seed, block)
    which = _sources(scene, kinds[0])
    values = _values(scene, seed, block, which, kinds[1:-1])
    values["onset"] = onset_of(here, kinds[-1])
    values |= levels_of(here, values)
    shapes = np.array([-1] * len(scene.populations) + [list(SHAPES).index(tap.shape) for tap in scene.taps])[which]
    fallen, tapped = np.flatnonzero(shapes < 0), np.flatnonzero(shapes >= 0)
    specimen = np.empty(BLOCK, np.uint64)
    specimen[fallen] = specimen_of([values[name][fallen] for name in PARTICLE])
    specimen[tapped] = specimen_of([shapes[tapped].astype(float), *(values[name][tapped] for name in _LATER[TAPS])])
    labels = np.array([source.label for source in scene.sources])[which]
    return Given(labels, values, specimen, shapes, here)


def given_at(scene: Scene, size: float) -> Given:
    """Return one impact or tap of each source: of median numbers, but of this quantile in radius and duration."""
    count = len(scene.sources)
    values = {name: np.full(count, np.nan) for name in parameter_units(scene)}
    for row, source in enumerate(scene.sources):
        for name, law in source.laws.items():
            share = size if name in ("radius", "contact_duration") else 0.5
            values[name][row] = law.quantile(np.array([share]))[0]
    if scene.panel is not None:
        assert scene.tail_beam is not None and scene.tail_beam.impact_point is not None
        values["impact_x"] = scene.tail_beam.impact_point.x.quantile(np.full(count, 0.5))
        values["impact_y"] = scene.tail_beam.impact_point.y.quantile(np.full(count, 0.5))
    fell = np.isfinite(values["drop_height"])
    values["velocity"][fell] = free_fall_velocity(values["drop_height"][fell])
    shapes = np.array([-1] * len(scene.populations) + [list(SHAPES).index(tap.shape) for tap in scene.taps])
    labels = np.array([source.label for source in scene.sources])
    return Given(labels, values, np.arange(count, dtype=np.uint64), shapes, scene)


def draw(scene: Scene, seed: int, block: int) -> Draw:
    """Return the pulses of one block of 256."""
    drawn = given(scene, seed, block)
    values, shapes, fallen, tapped = drawn.values, drawn.shapes, drawn.fallen, drawn.tapped
    impact = drawn.impact
    strikes: list[Strike] = []
    for rows, pulses, alike in impacts_by_coupling(scene, impact, values, fallen):
        strikes += _strikes(pulses, alike, rows, values)
        # What a law delivers is what the pulse shows, and what was asked may differ from it.
        for name in ("restitution", "peak_force", "contact_duration"):
            values[name][rows] = getattr(pulses, name)
    strikes += _strikes(_taps(shapes, values, tapped), partial(_taps, shapes, values), tapped, values)
    return Draw(drawn.labels, values, drawn.specimen, tuple(strikes), drawn.scene, impact)


def _sources(scene: Scene, uniform: Floats) -> NDArray[np.intp]:
    """Return the number of each signal's population or tap, by their weights."""
    weights = np.array([source.weight for source in scene.sources])
    edges = np.cumsum(weights / weights.sum())
    return np.minimum(np.searchsorted(edges, uniform, side="right"), len(weights) - 1)


def _values(scene: Scene, seed: int, block: int, which: NDArray[np.intp], falls: Floats) -> dict[str, Floats]:
    """Return what the populations and taps draw, nan where one has no such parameter."""
    values = {name: np.full(BLOCK, np.nan) for name in parameter_units(scene)}
    columns = dict(zip(FALL, falls, strict=True))
    columns["velocity"] = columns["drop_height"]
    drawn = {name for source in scene.sources for name in source.laws}
    for purpose, names in _LATER.items():
        if not drawn.isdisjoint(names):
            columns |= dict(zip(names, uniforms(seed, block, len(names), purpose), strict=True))
    for index, source in enumerate(scene.sources):
        rows = np.flatnonzero(which == index)
        for name, law in source.laws.items():
            values[name][rows] = law.quantile(columns[name][rows])
    values |= points_of_impact(scene, seed, block)
    fell = np.isfinite(values["drop_height"])
    values["velocity"][fell] = free_fall_velocity(values["drop_height"][fell])
    return values


def numbers_of(seed: int, block: int) -> Floats:
    """Return the uniform numbers that say source, quantities in `FALL` and onset of each signal of a block, in turn."""
    return uniforms(seed, block, len(FALL) + 2)


def onset_of(scene: Scene, number: Floats) -> Floats:
    """Return the times of touch [s] that belong to uniform numbers; the scene is that of the block."""
    return (scene.sampling.pre_trigger + scene.sampling.jitter * number) / scene.sampling.sampling_rate


def levels_of(scene: Scene, names: Iterable[str]) -> dict[str, Floats]:
    """Return what a scene draws for the sensor of a whole block, nan where it has none; the scene is that of the block.

    Of the names of `parameter_units` only those of `RANDOMISED_UNITS` are answered.
    """
    levels = {name: getattr(scene.sensor, name) for name in names if name in RANDOMISED_UNITS}
    return {name: np.full(BLOCK, np.nan if level is None else level) for name, level in levels.items()}


def points_of_impact(scene: Scene, seed: int, block: int) -> dict[str, Floats]:
    """Return where each impact of a block meets the beam [m], by name; nothing where no beam is known by its sizes."""
    if scene.panel is None:
        return {}
    assert scene.tail_beam is not None and scene.tail_beam.impact_point is not None
    along, across = uniforms(seed, block, 2, IMPACT_POINTS)
    point = scene.tail_beam.impact_point
    return {"impact_x": point.x.quantile(along), "impact_y": point.y.quantile(across)}


def _strikes(
    first: Impact | ModalImpact | TapPulses,
    pulses_of: Callable[[NDArray[np.intp]], Impact | ModalImpact | TapPulses],
    rows: NDArray[np.intp],
    values: Mapping[str, Floats],
) -> Iterator[Strike]:
    """Yield the first pulses of some signals, and the second ones of those that have one; nothing for none."""
    if rows.size:
        yield Strike(rows, first, values["onset"][rows])
    if "second_hit_delay" not in values:
        return
    again = rows[np.isfinite(values["second_hit_delay"][rows])]
    if again.size:
        onset = values["onset"][again] + values["second_hit_delay"][again]
        yield Strike(again, pulses_of(again), onset, values["second_hit_ratio"][again])


def _taps(shapes: NDArray[np.intp], values: Mapping[str, Floats], rows: NDArray[np.intp]) -> TapPulses:
    return TapPulses(shapes[rows], values["peak_force"][rows], values["contact_duration"][rows])


def specimen_of(particle: list[Floats]) -> NDArray[np.uint64]:
    """Mix the numbers of a particle or a tap into one 64-bit number (the finaliser of splitmix64, Steele et al. 2014).

    An equal particle has the same number in every population, scene and dataset.
    """
    mixed = np.zeros(particle[0].shape, np.uint64)
    for values in particle:
        mixed = mixed + values.view(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return mixed

"""The random numbers of a scene: rocks, taps and sensor, for frames and recordings.

Random numbers have addresses: (seed, purpose, block of 256 samples) always gives the same ones. Philox is a
counter-based generator (Salmon et al. 2011). Its key is the seed and the purpose, its counter the block and, in a
stream, the recording, so a sample does not depend on shard, worker or order. White noise, of which far more is needed,
has its own Philox kernel (`cgid.scene.synthesis.noise`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.physics.contact.laws import speed_of_fall
from cgid.physics.contact.materials import YIELD_OVER_STRENGTH
from cgid.scene.file.background import HUM_FREQUENCY, BackgroundSection, HumLine
from cgid.scene.file.distributions import Section, quantity_of
from cgid.scene.file.sections import CONTACT_SHAPE, SHAPES, Population, PrescribedPulses, RandomiseSection
from cgid.scene.file.sensor import AntiAlias

if TYPE_CHECKING:
    from cgid.scene.file.schema import Scene

#: Samples that share one address.
BLOCK = 256
#: Purposes of random numbers; a new purpose gets a new number.
PARAMETERS, NOISE, TAPS, SECOND_HITS, CLIPPING, RANDOMISED, ROCK_SHAPES, VISCOUS, CONTACTS = 1, 2, 3, 4, 5, 6, 7, 8, 9
IMPACT_POINTS, ARRIVALS, HUM, COLOURED, RECORDED, COLOURED_NOISE, MODES = 16, 17, 18, 19, 20, 21, 22

PARTICLE = ("density", "youngs_modulus", "poisson_ratio", "radius")
#: The columns of a rock's numbers, in order. Quantities of which a population has only one use the same number.
FALL = (*PARTICLE, "restitution", "drop_height")
_SHARED = {"velocity": "drop_height", "yield_pressure": "restitution", "strength": "restitution"}
#: The parameters of a rock's shape and their values for a sphere, the default.
SPHERE_SHAPE = {"curvature": 1.0, "effective_mass": 1.0}
#: The columns of optional purposes.
_LATER = {
    TAPS: ("peak_force", "contact_duration"),
    SECOND_HITS: ("second_hit_delay", "second_hit_ratio"),
    CLIPPING: ("clipped_at",),
    ROCK_SHAPES: tuple(SPHERE_SHAPE),
    VISCOUS: ("viscous_restitution",),
    CONTACTS: tuple(CONTACT_SHAPE),
}
#: Randomised settings that are settings of a sensor.
_OF_SENSOR = ("relative_noise", "noise_exponent", "relative_range")


def _units(section: type[Section], *names: str) -> dict[str, str]:
    """Return the units of randomised keys."""
    units = {name: quantity.unit for name in names if (quantity := quantity_of(section.model_fields[name]))}
    return {name: unit or "1" for name, unit in units.items()}


#: The stored parameters of every scene and their units.
PARAMETER_UNITS = {
    **_units(Population, *FALL, "velocity"),
    "onset": "s",
    **_units(PrescribedPulses, *_LATER[TAPS]),
}
#: Parameters of some scenes; the sampling rate is not among them, because each batch states its own.
_MORE_UNITS = {
    **_units(Population, *SPHERE_SHAPE, *CONTACT_SHAPE, "yield_pressure", "strength", "viscous_restitution"),
    "second_hit_delay": "s",
    "second_hit_ratio": "1",
    **_units(Population, "clipped_at"),
}
POINT_UNITS = {"impact_x": "m", "impact_y": "m"}
#: Settings of the sensor that a scene may randomise for each block.
RANDOMISED_UNITS = _units(
    RandomiseSection, *(name for name in RandomiseSection.model_fields if name != "sampling_rate")
)
#: A low-pass with an edge above this fraction of the sampling rate counts as unlimited: the transition of a bandwidth,
#: half as wide as its frequency, extends beyond the band of the frame.
UNLIMITED = 0.45
#: An AC coupling with an edge below this counts as none [Hz]: it shifts no frame by 1e-5 of its peak.
COUPLED = 0.01


def require_seed(seed: int) -> int:
    """Return a seed as an integer, or raise `InvalidValue` unless it is within 0 and 2^63 - 1."""
    return validation.whole("seed", seed, 0, 2**63 - 1)


def generator(seed: int, purpose: int, block: int, recording: int = 0) -> np.random.Generator:
    """Return the generator of one address; `recording` is the number within a stream."""
    key = np.array([seed, purpose], np.uint64)
    # The lower two words of the counter count the numbers drawn.
    counter = np.array([0, 0, recording, block], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def uniforms(seed: int, block: int, n_kinds: int, purpose: int = PARAMETERS, recording: int = 0) -> Floats:
    """Return uniform numbers strictly between 0 and 1, (n_kinds, `BLOCK`), for one purpose in one block."""
    raw = generator(seed, purpose, block, recording).random((BLOCK, n_kinds)).T
    return np.asarray(np.clip(raw, 2.0**-54, None))


def parameter_units(scene: Scene) -> dict[str, str]:
    """Return the stored parameters of a scene and their units: `PARAMETER_UNITS`, and those of its optional parts."""
    drawn = {name for source in scene.sources for name in source.laws}
    drawn |= {"yield_pressure"} if "strength" in drawn else set()
    units = PARAMETER_UNITS | {name: unit for name, unit in _MORE_UNITS.items() if name in drawn}
    if scene.mixes_laws:
        units |= {"dissipation": "1"}  # index in `Scene.law_names`, nan for a tap
    if scene.region is not None:
        units |= POINT_UNITS
    return units | {name: unit for name, unit in RANDOMISED_UNITS.items() if scene.draws(name)}


@dataclass(frozen=True)
class Drawn:
    """The random numbers of one block, before any contact law is applied."""

    labels: NDArray[np.str_]
    # by the names of `parameter_units`, each (n_signals,), nan where not drawn; restitution as requested
    values: dict[str, Floats]
    specimen: NDArray[np.uint64]  # equal for equal particles or equal taps, (n_signals,)
    shapes: NDArray[np.intp]  # index in `SHAPES` of a tap, -1 for an impact, (n_signals,)
    scene: Scene  # that of this block, with its randomised settings drawn

    @property
    def fallen(self) -> NDArray[np.intp]:
        """Rows of the impacts."""
        return np.flatnonzero(self.shapes < 0)

    @property
    def tapped(self) -> NDArray[np.intp]:
        """Rows of the taps."""
        return np.flatnonzero(self.shapes >= 0)


def at_once(scene: Scene, max_blocks: int) -> int:
    """Return how many blocks to sample at once: `max_blocks`, but 1 with settings drawn per block or with a beam."""
    return max_blocks if scene.randomise is None and scene.tail_beam is None else 1


def drawn_block(scene: Scene, seed: int, block: int, n_blocks: int = 1) -> Drawn:
    """Return the random quantities of one block of 256 frames, or of several with equal settings (`at_once`)."""
    blocks = range(block, block + n_blocks)
    settings, sources = settings_of(scene, seed, block), scene.sources
    here = with_drawn_modes(settled(scene, settings), seed, block)
    numbers = np.hstack([numbers_of(seed, one) for one in blocks])
    weights = np.array([source.weight for source in sources])
    edges = np.cumsum(weights / weights.sum())
    which = np.minimum(np.searchsorted(edges, numbers[0], side="right"), len(weights) - 1)
    columns = dict(zip(FALL, numbers[1:-1], strict=True))
    optional = [optional_numbers(sources, seed, one) for one in blocks]
    columns |= {name: np.concatenate([one[name] for one in optional]) for name in optional[0]}
    values = quantities_of(sources, which, columns, parameter_units(scene))
    values |= laws_of(scene, which)
    values |= points_of_impact(scene, seed, block)
    values["onset"] = onset_of(here, numbers[-1])
    values |= levels_of(settings)
    shapes = np.array([-1] * len(scene.populations) + [list(SHAPES).index(tap.shape) for tap in scene.taps])[which]
    fallen, tapped = np.flatnonzero(shapes < 0), np.flatnonzero(shapes >= 0)
    specimen = np.empty(which.size, np.uint64)
    specimen[fallen] = specimen_of([values[name][fallen] for name in PARTICLE])
    specimen[tapped] = specimen_of([shapes[tapped].astype(float), *(values[name][tapped] for name in _LATER[TAPS])])
    return Drawn(np.array([source.label for source in sources])[which], values, specimen, shapes, here)


def optional_numbers(
    sources: Sequence[Population | PrescribedPulses], seed: int, block: int, recording: int = 0
) -> dict[str, Floats]:
    """Return the uniform numbers of the optional purposes that the sources use, by name, each (`BLOCK`,)."""
    laws = {name for source in sources for name in source.laws}
    columns: dict[str, Floats] = {}
    for purpose, names in _LATER.items():
        if not laws.isdisjoint(names):
            columns |= dict(zip(names, uniforms(seed, block, len(names), purpose, recording), strict=True))
    return columns


def quantities_of(
    sources: Sequence[Population | PrescribedPulses],
    which: NDArray[np.intp],
    numbers: Mapping[str, Floats],
    names: Iterable[str],
) -> dict[str, Floats]:
    """Convert uniform numbers of rocks and taps to the named quantities in SI units; nan where a source has none."""
    # which (n,) is the index of the source. A velocity uses the number of the drop height, a yield pressure or strength
    # that of the restitution. A drop height also sets the velocity; a rock without a shape is a sphere.
    values = {name: np.full(which.size, np.nan) for name in names}
    for index, source in enumerate(sources):
        rows = np.flatnonzero(which == index)
        for name in SPHERE_SHAPE.keys() & values.keys() if isinstance(source, Population) else ():
            values[name][rows] = SPHERE_SHAPE[name]
        for name, law in source.laws.items():
            number = numbers[_SHARED.get(name, name)]
            values[name][rows] = law.quantile(number[rows])
    fell = np.isfinite(values["drop_height"])
    values["velocity"][fell] = speed_of_fall(values["drop_height"][fell])
    if "strength" in values:
        crushes = np.isfinite(values["strength"])
        values["yield_pressure"][crushes] = YIELD_OVER_STRENGTH * values["strength"][crushes]
    return values


def laws_of(scene: Scene, which: NDArray[np.intp]) -> dict[str, Floats]:
    """Return the column "dissipation" of rocks of these sources, (n,); empty where all populations have the same."""
    if not scene.mixes_laws:
        return {}
    order = [float(scene.law_names.index(name)) for name in scene.dissipations]
    return {"dissipation": np.array(order + [np.nan] * len(scene.taps))[which]}


def settings_of(scene: Scene, seed: int, block: int) -> dict[str, float]:
    """Return the randomised settings of one block by name, nan for a filter that is off."""
    if scene.randomise is None:
        return {}
    names = RandomiseSection.model_fields
    numbers = dict(zip(names, uniforms(seed, block, len(names), RANDOMISED)[:, :1], strict=True))
    values = {name: float(law.quantile(numbers[name])[0]) for name, law in scene.randomise.laws.items()}
    sampling_rate = values.get("sampling_rate", scene.sampling.sampling_rate)
    for name in ("bandwidth", "anti_alias_frequency"):
        if values.get(name, 0.0) > UNLIMITED * sampling_rate:
            values[name] = np.nan
    if values.get("ac_coupling", np.inf) < COUPLED:
        values["ac_coupling"] = np.nan
    if "bits" in values:
        values["bits"] = float(np.rint(values["bits"]))
    return values


def settled(scene: Scene, settings: Mapping[str, float]) -> Scene:
    """Return the scene of one block, with its randomised settings (`settings_of`); the scene itself if it has none."""
    if not settings:
        return scene
    sampling_rate = settings.get("sampling_rate", scene.sampling.sampling_rate)
    sensor: dict[str, Any] = {name: settings[name] for name in _OF_SENSOR if name in settings}
    if "bits" in settings:
        sensor["bits"] = int(settings["bits"])
    bandwidth = settings.get("bandwidth", scene.sensor.bandwidth)
    sensor["bandwidth"] = bandwidth if bandwidth is not None and bandwidth <= UNLIMITED * sampling_rate else None
    coupling = settings.get("ac_coupling", scene.sensor.ac_coupling)
    sensor["ac_coupling"] = None if coupling is None or np.isnan(coupling) else coupling
    edge = settings.get("anti_alias_frequency")
    if edge is not None:
        given = scene.sensor.anti_alias or AntiAlias(frequency=1.0)
        sensor["anti_alias"] = None if np.isnan(edge) else given.model_copy(update={"frequency": edge})
    background = scene.background
    if settings.get("hum", 0.0) > 0:
        frequency = settings.get("hum_frequency", HUM_FREQUENCY)
        line = HumLine(frequency=frequency, relative_amplitude=settings["hum"])
        others = {} if background is None else dict(background)
        background = BackgroundSection(**others | {"hum": (*others.get("hum", ()), line)})
    return scene.model_copy(
        update={
            "sampling": scene.sampling.model_copy(update={"sampling_rate": sampling_rate}),
            "sensor": scene.sensor.model_copy(update=sensor),
            "background": background,
            "randomise": None,
        }
    )


def with_drawn_modes(scene: Scene, seed: int, block: int) -> Scene:
    """Return the scene of one block with sampled modes; the scene itself if it has no uncertain ones."""
    learned = None if scene.tail_beam is None else scene.tail_beam.learned_modes
    if learned is None or learned.deviation is None:
        return scene
    assert scene.tail_beam is not None
    raw = generator(seed, MODES, block).random((3, learned.frequency.size))
    modes = learned.sampled(ndtri(np.clip(raw, 2.0**-54, None)))
    return scene.model_copy(update={"tail_beam": scene.tail_beam.with_learned(modes)})


def numbers_of(seed: int, block: int) -> Floats:
    """Return the uniform numbers of each signal of a block: source, quantities in `FALL`, onset."""
    return uniforms(seed, block, len(FALL) + 2)


def onset_of(scene: Scene, number: Floats) -> Floats:
    """Return the times of onset [s] for uniform numbers; the scene is that of the block."""
    return (scene.sampling.pre_trigger + scene.sampling.jitter * number) / scene.sampling.sampling_rate


def levels_of(settings: Mapping[str, float]) -> dict[str, Floats]:
    """Return the columns of the stored settings of a block."""
    return {name: np.full(BLOCK, value) for name, value in settings.items() if name in RANDOMISED_UNITS}


def points_of_impact(scene: Scene, seed: int, block: int, recording: int = 0) -> dict[str, Floats]:
    """Return the point of the first impact of each rock of a block [m], by name; empty without a beam of known size."""
    if scene.region is None:
        return {}
    assert scene.tail_beam is not None and scene.tail_beam.impact_point is not None
    along, across = uniforms(seed, block, 2, IMPACT_POINTS, recording)
    point = scene.tail_beam.impact_point
    return {"impact_x": point.x.quantile(along), "impact_y": point.y.quantile(across)}


def specimen_of(particle: list[Floats]) -> NDArray[np.uint64]:
    """Mix the numbers of a particle or a tap into one 64-bit number (splitmix64's finaliser, Steele et al. 2014)."""
    # Rounded to float32 first, so that it does not depend on the last digits of a processor's functions.
    mixed = np.zeros(particle[0].shape, np.uint64)
    for values in particle:
        bits = np.asarray(values, np.float32).view(np.uint32).astype(np.uint64)
        mixed = mixed + bits + np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return mixed

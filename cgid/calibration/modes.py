"""Beam calibration of a scene from recorded, unlabelled impacts, and the file with the result."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu
from threadpoolctl import threadpool_limits

from cgid._lib import validation
from cgid._lib.files import check_new, write_together
from cgid._lib.validation import Floats, rates_agree
from cgid.calibration.chain import PARTS, SensorChain, learn_chain, outside
from cgid.calibration.dimensions import (
    SENSOR,
    Dimension,
    dimension_errors,
    dimensions_of,
    learn_dimensions,
    with_dimensions,
)
from cgid.calibration.learning import Heard, ImpactFrames, Learned, MovedSensor, evidence_of, rings
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection.ear import Ear
from cgid.identification.inversion.contact import MISSHAPEN
from cgid.identification.inversion.inversion import Inversion
from cgid.identification.inversion.through_beam import REACH
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.fit.ar_noise import ar_noise_of
from cgid.measure.frames import clipped_samples
from cgid.measure.modal.beam import SPAN_TIME, Beam, corrected
from cgid.measure.modal.modes import Modes, text_of_table
from cgid.scene.file.schema import Scene, load_scene, parse_scene
from cgid.scene.file.sections import rows_of
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.stream import parts_of_recording
from cgid.scene.synthesis.synthesis import synthesise
from cgid.scene.synthesis.through_beam import beam_of, moved, spread_over, through_modes

if TYPE_CHECKING:
    from cgid.identification.detection.events import Event

__all__ = ["SiteCalibration", "calibrate", "usable_impacts"]

#: Minimum number of usable impacts.
FEWEST = 20
#: Prior standard deviation of ln damping ratio over that of ln frequency, and its maximum.
_DAMPING_A_FREQUENCY, _MAX_DAMPING = 10.0, 0.3
#: No other impact begins for so long after a usable one, whose response is compared over this time [s].
_ALONE = SPAN_TIME + REACH
#: Number of impacts whose evidence is compared, and the seed of simulated ones.
_COMPARED, _SEED = 256, 0x5EED_0002_CA11
#: Maximum number of simulated recordings of a stream, and their maximum total length [s].
_RECORDINGS, _MAX_STREAM = 16, 120.0
#: The evidence may be below that of simulation by this much, absolutely and relatively.
_BELOW, _BELOW_SHARE = 0.1, 0.1
#: Fraction of the worst impacts that is excluded: a missed onset, two impacts at once, a location outside the region.
_WORST = 0.2
#: The same for a stream, in which many impacts begin during the ring-down of earlier ones.
_WORST_OF_STREAM = 0.5
#: A mode is silent at a sensor if its shape is below this fraction of its root mean square; a sensor at nodes of more
#: than this fraction of the modes is unusable. On a line of symmetry it is half.
_SILENT, _MAX_SILENT = 0.02, 0.6
#: Of a beam or sensor that changes: how many times as far as permitted the evidence of a part is below, and the
#: probability of such ranks by chance.
_FOREIGN, _BY_CHANCE = 3.0, 1e-5
#: Sensors of one beam do not place impacts so far apart [m].
_APART = 0.05
#: The location of a sensor is off by about this [m], and as stated within the second length.
_SENSOR_ERROR, _SAME_PLACE = 0.02, 2e-3
#: Forces outside of the pulse family may be so many times those of simulated impacts.
_LIKE_SIMULATED = 2.0
#: A crossing counts if the learned frequencies differ by this many standard deviations.
_CERTAIN = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SiteCalibration:
    """A calibrated scene and how well it explains the recording.

    Attributes
    ----------
    scene : Scene
        With `tail_beam.learned`, and with dimensions that were learned.
    dimensions : tuple of Dimension
        Learned dimensions of the beam, and the location of its sensor where it has moved; else empty.
    start, learned : Modes
        The modes before, with their prior standard deviations, and after.
    n_impacts : int
        Number of impacts used.
    before, after, expected : float
        Mean log-likelihood per sample, without the worst fifth of the impacts (in a stream the worst half): before,
        after, and of impacts simulated on the calibrated beam.
    crossings : int
        Number of neighbouring modes that have swapped.
    has_converged : bool
        Whether the modes have converged.
    chain : mapping of str to tuple
        Keys of the sensor that are not those of the scene, before and after, None where there is none: filter and
        mounting; empty if the stated ones were kept.
    outside : float
        Median share of the recovered forces that no contact has.
    others : tuple of SiteCalibration
        The same for each further sensor of the beam, with the same modes: its location, chain and scene.
    """

    scene: Scene
    dimensions: tuple[Dimension, ...] = ()
    start: Modes
    learned: Modes
    n_impacts: int
    before: float
    after: float
    expected: float
    crossings: int
    has_converged: bool
    chain: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    outside: float = 0.0
    others: tuple[SiteCalibration, ...] = ()

    def save(self, path: str | Path, *, overwrite: bool = False) -> tuple[Path, Path]:
        """Write the scene as a .toml file, and its modes as a table next to it; return both paths.

        Further sensors have a scene and a table each: site-2.toml beside site.toml, and so on.
        """
        texts: dict[Path, bytes] = {}
        for one, file in zip((self, *self.others), scenes_beside(Path(path), 1 + len(self.others)), strict=True):
            file = check_new(file, "a site", (".toml",), overwrite=overwrite)
            table = check_new(table_beside(file), "a table of modes", (".csv",), overwrite=overwrite)
            content = json.loads(one.scene.text)
            content["tail_beam"]["learned"] = table.name
            for part in content.get("background", {}).values():  # paths are relative to the file that names them
                if isinstance(part, dict) and "path" in part:
                    part["path"] = str((one.scene.folder / part["path"]).resolve())
            head = f"# Written by cgid calibrate: the modes of {table.name} are learned from {one.n_impacts} impacts.\n"
            texts[table] = text_of_table(one.learned.columns).encode()
            texts[file] = (head + "\n".join(_toml(content)) + "\n").encode()
        write_together(texts, overwrite=overwrite)
        table, file = list(texts)[:2]
        return file, table


def scenes_beside(path: Path, n_sensors: int) -> list[Path]:
    """Return the paths of the calibrated scenes of some sensors."""
    return [path, *(path.with_name(f"{path.stem}-{number}{path.suffix}") for number in range(2, n_sensors + 1))]


def table_beside(path: Path) -> Path:
    """Return the path of the table of modes of a calibrated scene file."""
    return path.with_name(f"{path.stem}-modes.csv")


def usable_impacts(events: Iterable[Event]) -> tuple[list[Event], dict[str, int]]:
    """Return the impacts usable for calibration, and the numbers of unusable ones by reason.

    Parameters
    ----------
    events : iterable of Event
        Detected impacts of a recording, those of each channel in order of time.

    Returns
    -------
    tuple of list and dict
        The usable impacts, and the number of overlapping, clipped and cut ones; one with another in the stretch that is
        compared overlaps.
    """
    usable, lost = [], {"overlapping": 0, "clipped": 0, "cut": 0}
    following: dict[int, int] = {}
    for event in reversed(list(events)):
        flaw = next((name for name in lost if getattr(event, name)), None)
        if following.get(event.channel, np.inf) - event.onset < _ALONE * event.sampling_rate:
            flaw = "overlapping"
        following[event.channel] = event.onset
        if flaw is None and not event.problem:
            usable.append(event)
        elif flaw is not None:
            lost[flaw] += 1
    return usable[::-1], lost


def calibrate(  # noqa: PLR0913
    scene: Scene | str | Path,
    frames: NDArray[np.floating],
    sampling_rate: float,
    pre_trigger: int,
    *,
    start_error: float = 0.01,
    drift: float = 0.003,
    participation_error: float = 0.0,
    dimension_error: float | Mapping[str, float] = 0.0,
    exact: Collection[str] = (),
    sensors: Sequence[tuple[float, float]] = (),
    max_impacts: int = 300,
    progress: Callable[[int], object] | None = None,
) -> SiteCalibration:
    """Learn the modes of a scene's beam from recorded impacts, and correct the location and chain of its sensor.

    Parameters
    ----------
    scene : Scene, str or Path
        With a beam of known size or a table of modes, and one accelerometer on it.
    frames : ndarray, (n_impacts, n_samples) or (n_impacts, n_sensors, n_samples)
        Impacts at unknown locations, in the order of the recording and in the SI unit of the sensor; clipped ones are
        excluded, and at most `max_impacts`, evenly spaced, are used.
    sampling_rate : float [Hz]
        That of the scene.
    pre_trigger : int
        Samples of each frame before onset.
    start_error : float
        Relative standard deviation of the natural frequencies of an uncalibrated scene; that of the damping ratios is
        10 times as large, at most 0.3.
    drift : float
        The same for a calibrated scene: changes since then.
    participation_error : float
        Relative standard deviation of the modes' participations; with 0, they are not learned.
    dimension_error : float or mapping of str to float
        Relative standard deviation of each dimension of the beam and of the sensor's position, or of those that a
        mapping names (`cgid.calibration.dimensions.DIMENSIONS`). With 0, they are exact. Otherwise they are learned
        first, with the damping ratio, and `start_error` is the remaining error.
    exact : collection of str
        What of the scene is not to be corrected: "sensor" (its location), "filter" (its edge and order), "mounting".
        In a scene that was calibrated before, none of them.
    sensors : sequence of (float, float) [m]
        Points of the sensors that recorded each impact together, in place of the one of the scene. They share the
        modes; each has its own location, filter and mounting, and a scene in `SiteCalibration.others`.
    max_impacts : int
        Maximum number of impacts, 20 or more.
    progress : callable, optional
        Receives the number of rounds done since the last call; there are at most `MAX_ROUNDS`.

    Returns
    -------
    SiteCalibration

    Raises
    ------
    InvalidValue
        A number breaks its rule, or the scene has no beam, or its sensor is at nodes.
    BadData
        Too few impacts, a different sampling rate, modes that cross and cannot be distinguished, another beam, or a
        sensor or recorder that is not like that of the scene.
    """
    scene = load_scene(scene)
    check_numbers(start_error, drift, participation_error, max_impacts)
    for name in exact:
        validation.choice("exact", name, PARTS)
    if scene.tail_beam is not None and scene.tail_beam.learned is not None:
        exact = PARTS  # calibrated before
    scenes = check_sensors(scene, sensors, sampling_rate, participation_error)
    uncertain_dimensions = dimension_errors(scene, dimension_error)
    if sensors:  # the location of each sensor is learned with the modes
        uncertain_dimensions = {name: one for name, one in uncertain_dimensions.items() if name not in SENSOR}
    frames = _unclipped(np.asarray(frames), len(scenes), grouped=bool(sensors))
    rows = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), max_impacts)).round().astype(np.intp))
    if scene.stream is not None and next(_simulated_events(scene), None) is None:
        raise BadData(
            f"scene {scene.name}: stream must contain isolated impacts to compare with, there is none in "
            f"{_RECORDINGS} simulated recordings; correct its arrivals, noise and duration"
        )
    region = None
    if scene.stream is not None:  # its rocks bounce all over the beam
        region = json.loads(scene.text)["tail_beam"].get("impact_point")
        scenes = [_with_beam(one, spread=True) for one in scenes]
    errors = (start_error, drift, participation_error)
    with threadpool_limits(1):
        parts = [
            _Sensor(
                one,
                prepare_impacts(frames[rows, number], sampling_rate, pre_trigger),
                f", sensor {number + 1}" * (len(scenes) > 1),
            )
            for number, one in enumerate(scenes)
        ]
        if uncertain_dimensions:
            dimensions = parts[0].learn_dimensions(uncertain_dimensions, progress)
            for part in parts[1:]:
                part.take(dimensions)
        placed = "sensor" not in exact and not set(SENSOR) <= set(uncertain_dimensions)
        start = _start(parts[0].scene)
        result = Learned(
            [part.heard(placed=placed) for part in parts], _prior(parts[0].scene, start, *errors), progress
        )
        result.approach()
        for part, place in zip(parts, result.places, strict=True):
            part.move(place)
            part.learn_chain(result.correction, exact)
        widest = max(parts, key=lambda part: len(part.beam.poles))
        start = _start(widest.scene)
        result = result.on([part.heard() for part in parts], _prior(widest.scene, start, *errors))
        result.settle()
        for part in parts:
            part.look(result.correction)
            if _far_apart(parts[0], part):
                raise BadData(
                    f"the sensors of scene {scene.name} must hear the same impacts on one beam, they place most of "
                    "them far from each other; give their points in the order of the channels, or calibrate each by "
                    "itself"
                )
        found = [part.calibration(result, errors, region) for part in parts]
    return replace(found[0], others=tuple(found[1:]))


def _unclipped(frames: NDArray[np.floating], n_sensors: int, *, grouped: bool) -> NDArray[np.floating]:
    """Return the impacts that no sensor clips, (n_impacts, n_sensors, n_samples)."""
    if frames.ndim != 2 + grouped or (grouped and frames.shape[1] != n_sensors):
        shape = f"(n_impacts, {n_sensors}, n_samples)" if grouped else "(n_impacts, n_samples)"
        raise InvalidValue(
            f"frames must be of shape {shape}, got {frames.shape}; give sensors, the point of each, in the order of "
            "the frames"
        )
    frames = frames.reshape(len(frames), n_sensors, frames.shape[-1])
    # The two highest samples of an unclipped impact may be equal by chance if a recorder has few steps.
    rows = np.asarray(frames, np.float64).reshape(-1, frames.shape[-1])
    clipped = clipped_samples(rows, shared=3) if len(frames) else None
    lost = np.zeros(len(frames), bool) if clipped is None else clipped.reshape(frames.shape).any(axis=(1, 2))
    frames = frames[~lost]
    if len(frames) < FEWEST:
        left_out = f" and {lost.sum()} clipped ones" if lost.any() else ""
        raise BadData(
            f"impacts must be at least {FEWEST} to learn from, got {len(frames)}{left_out}; record longer"
            + (", and below the sensor's range" if left_out else "")
        )
    return frames


class _Sensor:
    """A sensor of the beam: its scene and beam as they become known, and the impacts that it measured."""

    def __init__(self, scene: Scene, impacts: ImpactFrames, number: str) -> None:
        self.scene, self._measured = scene, impacts
        self._begin()
        self.name, self.together = f"scene {scene.name}{number}", bool(number)
        self.worst = _WORST if scene.stream is None else _WORST_OF_STREAM
        self.before = mean_evidence(self.beam, self.impacts, self.worst)
        self.dimensions: tuple[Dimension, ...] = ()
        self.chain: dict[str, tuple[Any, Any]] = {}

    def _begin(self) -> None:
        """Look through the beam and the recorder of the scene."""
        beam = beam_of(self.scene)
        self.beam = replace(beam, modes=replace(beam.modes, deviation=None))  # which are learned
        self.impacts = self._measured.behind(beam)

    def learn_dimensions(
        self, errors: Mapping[str, float], progress: Callable[[int], object] | None
    ) -> tuple[Dimension, ...]:
        """Learn the dimensions of the beam; return them."""
        self.scene, self.dimensions = learn_dimensions(self.scene, self.beam, self.impacts, errors, progress=progress)
        self.beam = through_modes(self.scene, self.beam)
        return self.dimensions

    def take(self, dimensions: tuple[Dimension, ...]) -> None:
        """Take the dimensions that another sensor has learned."""
        change = np.log([one.after / one.before for one in dimensions])
        self.scene = with_dimensions(self.scene, [one.name for one in dimensions], change)
        self.dimensions, self.beam = dimensions, through_modes(self.scene, self.beam)

    def heard(self, *, placed: bool = False) -> Heard:
        """Return the impacts of this sensor, with its location uncertain where the scene has a drawing."""
        scene, beam = self.scene, self.beam
        assert scene.tail_beam is not None
        if not placed or scene.panel is None or scene.tail_beam.learned is not None:
            return Heard(beam, self.impacts)

        def elsewhere(place: Floats) -> Beam:
            return through_modes(_with_sensor(scene, place), beam)

        return Heard(beam, self.impacts, MovedSensor(elsewhere, np.full(2, _SENSOR_ERROR)))

    def move(self, place: Floats) -> None:
        """Move the sensor, if it is not where the scene has it."""
        if np.hypot(*place) > _SAME_PLACE:
            stated, self.scene = self.scene, _with_sensor(self.scene, place)
            self.dimensions += _moved(stated, self.scene)
            self.beam = through_modes(self.scene, self.beam)

    def learn_chain(self, correction: Floats, exact: Collection[str]) -> None:
        """Learn filter and mounting, if the stated ones make no contact forces."""
        chain = learn_chain(self.scene, corrected(self.beam, correction), self.impacts, exact)
        if chain is not None:
            self.chain = _changes(self.scene, chain)
            self.scene = chain.placed(self.scene)
            self._begin()

    def look(self, correction: Floats) -> None:
        """Invert the impacts through the corrected beam."""
        self.inversion = Inversion(corrected(self.beam, correction[:, : len(self.beam.poles)]))
        self.evidence, self.forces = evidence_of(self.inversion, self.impacts)

    def calibration(self, result: Learned, errors: tuple[float, float, float], region: Any) -> SiteCalibration:
        """Return the calibrated scene; raises `BadData` where it does not explain the impacts."""
        n, scene, start = len(self.beam.poles), self.scene, _start(self.scene)
        prior = _prior(scene, start, *errors)
        learned = replace(start.corrected(result.correction[:, :n]), deviation=result.deviation[:, :n])
        crossings = count_crossings(scene, learned)
        result_scene = _with_beam(scene, learned=rows_of(learned), impact_point=region)
        usual, simulated = evidence_of(self.inversion, _simulated(result_scene).behind(self.beam))
        after, expected = (_mean(one, self.worst) for one in (self.evidence, usual))
        margin = max(_BELOW, _BELOW_SHARE * abs(expected))
        least, foreign = expected - margin, expected - _FOREIGN * margin
        if after >= least and self._changes_within(least, foreign):
            raise BadData(
                f"the impacts on the beam of {self.name} must be of one beam, and of a sensor that stays: a "
                "part of them is explained by itself, and what came before or after it is not; calibrate each part "
                "by itself"
            )
        misshapen, usually = (outside(self.inversion, some) for some in (self.forces, simulated))
        if after < least:
            raise BadData(
                f"the beam of {self.name} must explain the impacts as well as simulated ones: their "
                f"log-likelihood is {after:.3g} per sample ({self.before:.3g} before), expected {expected:.3g}; check "
                f"the beam, {'the order of the channels, ' * self.together}the position of the sensor and the region "
                f"of the impacts{' (bounces count: give the scene a [stream])' * (scene.stream is None)}, or use more "
                "impacts, a larger start error, each part by itself if beam or sensor changed in between"
                + (
                    ", or a dimension error of 3 % if the drawing may be inaccurate"
                    * (scene.panel is not None and not self.dimensions)
                )
                + (
                    f"; its filter of linear phase rings for {1e3 * rings(self.beam):.2g} ms before an impact, "
                    f"at most {1e3 * self.beam.delay:.2g} ms of it can be looked at: record faster"
                    * (rings(self.beam) > self.beam.delay)
                )
            )
        if misshapen > max(MISSHAPEN, _LIKE_SIMULATED * usually):
            raise BadData(
                f"the forces of impacts on the beam of {self.name} must have the shape of contacts: "
                f"{misshapen:.1%} of them (median) is outside of it, {usually:.1%} in simulated impacts; its filter, "
                "mounting, sensor or modes differ in a way that cannot be learned: state the recorder's filter in "
                "sensor.anti_alias, mount the sensor on a stud, measure its location, or label impacts and train on "
                "them"
            )
        return SiteCalibration(
            scene=result_scene,
            dimensions=self.dimensions,
            start=replace(start, deviation=prior),
            learned=learned,
            n_impacts=len(self.impacts),
            before=self.before,
            after=after,
            expected=expected,
            crossings=crossings,
            has_converged=result.has_converged,
            chain=self.chain,
            outside=misshapen,
        )

    def _changes_within(self, least: float, foreign: float) -> bool:
        """Return whether the impacts before or after some point are explained, and the others are not."""
        n = len(self.impacts)
        parts = [np.split(self.evidence, [at]) for at in (n * np.arange(1, 20) // 20).tolist()]
        return any(
            # By ranks, too: single impacts may leave far more than others.
            mannwhitneyu(own, rest, alternative="greater").pvalue < _BY_CHANCE
            and _mean(own, self.worst) >= least
            and _mean(rest, self.worst) < foreign
            for before, after in parts
            for own, rest in ((before, after), (after, before))
        )


def _far_apart(first: _Sensor, other: _Sensor) -> bool:
    """Return whether two sensors place the same impacts as far apart as different ones."""
    x, y = (getattr(first.forces, axis) - getattr(other.forces, axis) for axis in "xy")
    by_chance = [getattr(first.forces, axis) - np.roll(getattr(other.forces, axis), 1) for axis in "xy"]
    apart = float(np.median(np.hypot(x, y)))
    return apart > max(_APART, float(np.median(np.hypot(*by_chance))) / 2)


def _with_sensor(scene: Scene, place: Floats) -> Scene:
    """Return a scene with its sensor moved by x and y [m], on the beam."""
    assert scene.tail_beam is not None and scene.tail_beam.sensor_point is not None and scene.panel is not None
    point, sides = scene.tail_beam.sensor_point, (scene.panel.length, scene.panel.width)
    x, y = (
        float(np.clip(one + step, 0, side))
        for one, step, side in zip((point.x, point.y), place.tolist(), sides, strict=True)
    )
    return _with_beam(scene, sensor_point={"x": x, "y": y})


def _moved(stated: Scene, found: Scene) -> tuple[Dimension, ...]:
    """Return the changed location of a sensor."""
    before, after = dimensions_of(stated), dimensions_of(found)
    known = _SAME_PLACE / 2
    return tuple(
        Dimension(name=one, before=before[one], after=after[one], deviation=known / after[one]) for one in SENSOR
    )


def _changes(stated: Scene, chain: SensorChain) -> dict[str, tuple[Any, Any]]:
    """Return the keys of the sensor that a chain changes, before and after."""
    old, new = SensorChain.of(stated).keys, chain.keys
    return {name: (old.get(name), new.get(name)) for name in old | new if old.get(name) != new.get(name)}


def uncertain(scene: Scene, start_error: float) -> Scene:
    """Return a scene with modes of at least this uncertainty; arguments and errors as in `calibrate`."""
    check_numbers(start_error, start_error, 0.0, FEWEST)
    check_scene(scene, scene.sampling.sampling_rate)
    start = _start(scene)
    deviation = _prior(scene, start, start_error, start_error, 0.0)
    return _with_beam(scene, learned=rows_of(replace(start, deviation=deviation)))


def check_numbers(start_error: float, drift: float, participation_error: float, max_impacts: int) -> None:
    """Raise `InvalidValue` if a number of `calibrate` breaks its rule."""
    for name, value, max_value in (
        ("start_error", start_error, 0.1),
        ("drift", drift, 0.1),
        ("participation_error", participation_error, 1.0),
    ):
        if not 0 <= value <= max_value or (name == "start_error" and value == 0):
            least = "above 0" if name == "start_error" else "at least 0"
            raise InvalidValue(f"{name} must be {least} and at most {max_value:g}, got {value:g}")
    validation.whole("max_impacts", max_impacts, FEWEST)


def check_sensors(
    scene: Scene, sensors: Sequence[tuple[float, float]], sampling_rate: float, participation_error: float
) -> list[Scene]:
    """Return the scene of each sensor; raises as `check_scene`, or if one is not on the beam."""
    scenes = [moved(scene, point) for point in sensors] or [scene]
    for one in scenes:
        check_scene(one, sampling_rate)
    if participation_error and len(scenes) > 1:
        raise InvalidValue(
            f"participation_error must be 0 for several sensors, got {participation_error:g}: participations are of "
            "one point; calibrate each sensor by itself"
        )
    return scenes


def check_scene(scene: Scene, sampling_rate: float) -> None:
    """Raise unless a scene has a beam that its sensor measures (`InvalidValue`), at this rate (`BadData`)."""
    if scene.tail_beam is None or scene.sensor.quantity == "force":
        raise InvalidValue(
            f"scene {scene.name}: must have a [tail_beam] and a sensor of motion on it to be calibrated; add them"
        )
    rate = scene.sampling.sampling_rate
    if not rates_agree(sampling_rate, rate):
        raise BadData(
            f"the recording must be sampled at {rate:g} Hz like scene {scene.name}, whose modes reach "
            f"{beam_modes(scene).frequency.max():.4g} Hz, got {sampling_rate:g} Hz; set sampling.sampling_rate and "
            "sensor.anti_alias of the scene to those of the recorder"
        )
    lowest = float(beam_modes(scene).frequency.min())
    if lowest >= rate / 2:
        raise InvalidValue(
            f"scene {scene.name}: sampling.sampling_rate must be more than twice the frequency of a mode to learn it, "
            f"got {rate:g} Hz and a lowest mode at {lowest:.4g} Hz; record faster"
        )
    shape = np.abs(np.asarray(beam_modes(scene).at_sensor))
    # A shape's root mean square is 1 over the root of the mass.
    silent = shape < _SILENT * (shape.max() if scene.panel is None else 1 / np.sqrt(scene.panel.mass))
    if silent.mean() > _MAX_SILENT:
        raise InvalidValue(
            f"scene {scene.name}: the sensor must measure the modes, {silent.sum()} of {silent.size} have a node at "
            "tail_beam.sensor_point; move it"
        )


def _start(scene: Scene) -> Modes:
    """Return the modes of a scene before calibration, in the order of the beam's, without standard deviations."""
    assert scene.tail_beam is not None
    if scene.tail_beam.learned_modes is not None:
        return scene.tail_beam.learned_modes
    modes = beam_modes(scene)
    return Modes.relative(modes.frequency, modes.damping_ratio, np.ones_like(modes.frequency))


def _prior(scene: Scene, start: Modes, start_error: float, drift: float, participation: float) -> Floats:
    """Return the prior deviations, (3, n_modes)."""
    assert scene.tail_beam is not None
    moved = start_error if scene.tail_beam.learned is None else drift
    more = np.array([moved, min(_DAMPING_A_FREQUENCY * moved, _MAX_DAMPING), participation])
    present = np.zeros((3, start.frequency.size)) if start.deviation is None else start.deviation
    return np.asarray(np.sqrt(np.square(present) + np.square(more)[:, None]))


def prepare_impacts(frames: NDArray[np.floating], sampling_rate: float, pre_trigger: int) -> ImpactFrames:
    batch = VibrationBatch(np.asarray(frames, np.float64), sampling_rate, pre_trigger)
    level = np.sqrt(np.mean(np.square(batch.samples), axis=1))
    first = np.maximum(batch.first - int(np.ceil(REACH * sampling_rate)), batch.n_quiet)
    start = np.stack([np.minimum(first, batch.first + 1), batch.first + 1], axis=1).astype(np.intp)
    still = batch.samples - batch.offset[:, None]
    noise = np.maximum(batch.noise, 1e-6 * level + 1e-300)
    colour = ar_noise_of(still, batch.n_quiet.astype(np.float64), 1e-6 * level)
    return ImpactFrames(still, start, noise, colour, pre_trigger)


def mean_evidence(beam: Beam, impacts: ImpactFrames, worst: float) -> float:
    """Return the mean log-likelihood of some impacts, without this fraction, the worst."""
    return _mean(evidence_of(Inversion(beam), impacts.taken(slice(_COMPARED)))[0], worst)


def _mean(evidence: Floats, worst: float) -> float:
    return float(np.sort(evidence)[int(worst * evidence.size) :].mean())


def _simulated(scene: Scene) -> ImpactFrames:
    """Return simulated impacts on the beam of a scene, as detected if it has a stream."""
    rate = scene.sampling.sampling_rate
    if scene.stream is None:
        frames = np.concatenate([batch.signals for batch in synthesise(scene, _COMPARED, _SEED)])
        return prepare_impacts(frames, rate, scene.sampling.pre_trigger)
    events = list(_simulated_events(scene))
    taken = np.unique(np.linspace(0, len(events) - 1, min(len(events), _COMPARED)).round().astype(np.intp))
    frames, before = frames_of([events[number] for number in taken])
    return prepare_impacts(frames, rate, before)


def _simulated_events(scene: Scene) -> Iterator[Event]:
    """Yield the usable impacts that a detector finds in recordings of a stream."""
    left = round(_MAX_STREAM * scene.sampling.sampling_rate)
    for number in range(_RECORDINGS):
        ear, events = Ear(scene.sampling.sampling_rate, kind="vibration", lines=False), []
        for samples, _ in parts_of_recording(scene, _SEED, number, dtype="float32"):
            events += ear.feed(samples[np.newaxis]).events
            left -= samples.size
            if left <= 0:
                break
        yield from usable_impacts(events + ear.feed(None).events)[0]
        if left <= 0:
            return


def count_crossings(scene: Scene, learned: Modes) -> int:
    """Return how many neighbours have swapped; raises `BadData` if their shapes do not distinguish them."""
    logs, deviation = np.log(learned.frequency), learned.columns["frequency_deviation"]
    crossed = np.flatnonzero(np.diff(logs) < -_CERTAIN * np.hypot(deviation[1:], deviation[:-1]))
    if crossed.size and scene.region is None:
        first, second = learned.frequency[crossed[0] : crossed[0] + 2]
        raise BadData(
            f"modes {crossed[0] + 1} and {crossed[0] + 2} must not cross in a table of modes: they moved to "
            f"{first:.5g} and {second:.5g} Hz; use a smaller start error, or one mode for both"
        )
    return int(crossed.size)


def _with_beam(scene: Scene, *, spread: bool = False, **changes: Any) -> Scene:
    """Return a scene with another beam: with some of its keys changed, or impacts all over it."""
    content = json.loads(scene.text)
    content["tail_beam"] |= {name: value for name, value in changes.items() if value is not None}
    if spread:
        spread_over(content["tail_beam"])
    return parse_scene(content, source=f"calibration of {scene.name}", folder=scene.folder)


def _toml(content: dict[str, Any]) -> list[str]:
    """Return a scene as lines of TOML: its sections as tables, deeper levels inline."""
    lines = [f"{key} = {_value(part)}" for key, part in content.items() if not _is_section(part)]
    for key, part in content.items():
        for table in part if isinstance(part, list) else [part]:
            if _is_section(part):
                head = f"[[{key}]]" if isinstance(part, list) else f"[{key}]"
                lines += ["", head, *(f"{name} = {_value(value)}" for name, value in table.items())]
    return lines


def _is_section(part: Any) -> bool:
    return isinstance(part, dict) or (isinstance(part, list) and bool(part) and isinstance(part[0], dict))


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_value(entry)}" for name, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else repr(value)


def frames_of(events: Sequence[Event]) -> tuple[NDArray[np.floating], int]:
    """Return the frames of impacts from one detector, and how many samples of each are before onset."""
    before = events[0].pre_trigger
    assert before is not None  # those of vibrations are known
    return np.stack([event.samples for event in events]), before

"""`cgid calibrate`: learn the modes of your beam from a recording of unlabelled impacts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from cgid._lib import validation
from cgid._lib.terminal import counted
from cgid._lib.validation import rates_agree
from cgid.cli.help import Command
from cgid.cli.options import (
    OUTPUT,
    PATH,
    SCENE,
    OutputName,
    json_option,
    overwrite_option,
    point_of,
    share_of,
)
from cgid.cli.output import print_json, progress_bar, say, warn, warn_of_one_place
from cgid.cli.reading import ReadingOptions, reading_options
from cgid.cli.site import keys
from cgid.errors import BadData, InvalidValue
from cgid.units import UNITS, quantity_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cgid.calibration import SiteCalibration
    from cgid.identification.detection import Event
    from cgid.scene import Scene


def _modes_beside(path: Path) -> list[Path]:
    from cgid.calibration.modes import table_beside

    return [table_beside(path)]


@click.command(
    cls=Command,
    short_help="Learn the modes of a beam from a recording of unlabelled impacts.",
    example="cgid generate tail_beam -n 24 -o impacts.h5\ncgid calibrate impacts.h5 --scene tail_beam -o site.toml",
)
@click.argument("recordings", type=PATH, nargs=-1, required=True, metavar="RECORDING...")
@click.option("--scene", "scene_name", type=SCENE, required=True, help="Start from the beam of this scene.")
@click.option(
    "-o",
    "--output",
    type=OutputName(_modes_beside),
    required=True,
    help="Write this scene (.toml), and its modes next to it.",
)
@click.option(
    "--dimension-error",
    default="0 %",
    show_default=True,
    help="Set the uncertainty of all or some dimensions, as in 'thickness=3 %, ribs.depth=2 %'; these are fitted.",
)
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    metavar="X,Y",
    help="Calibrate sensors at these points [m] of the scene's beam together: the channels, in this order. It "
    "takes the place of --same-beam.",
)
@click.option(
    "--plot", "picture", type=OUTPUT, help="Plot the modes before and after, with standard deviations, as PNG."
)
@overwrite_option
@json_option
@reading_options()
@keys(start_error="1 %", drift="0.3 %", participation_error="0 %", exact="", impacts=300)
def calibrate(
    recordings: tuple[str, ...],
    scene_name: str,
    output: str,
    start_error: str,
    drift: str,
    participation_error: str,
    dimension_error: str,
    exact: str,
    sensors: tuple[str, ...],
    impacts: int,
    picture: str | None,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> None:
    """Learn the modes of a beam from RECORDINGs of its impacts, or a dataset of them, and write a scene.

    No labels are needed. A few hundred impacts at unknown locations suffice if the scene's beam is approximately
    correct: its frequencies within a few per cent, its shapes and the region of the impacts. If these come from a
    drawing, give its uncertainty with --dimension-error. The location of the sensor (to some centimetres), its mounting
    and the recorder's filter are corrected where the impacts contradict the scene. Train with the learned beam by cgid
    train site.toml. Nothing is written if the beam does not explain the impacts sufficiently. Several sensors of one
    beam share its modes; each has its own location, filter and mounting, and a scene: site.toml, site-2.toml.
    """
    from cgid._lib.files import check_new
    from cgid.calibration import calibrate as calibrated
    from cgid.calibration import dimensions
    from cgid.calibration.chain import PARTS
    from cgid.calibration.learning import MAX_ROUNDS
    from cgid.calibration.modes import FEWEST, check_numbers, check_sensors, scenes_beside, table_beside
    from cgid.plots.figure import new_picture
    from cgid.scene import load_scene

    for path in reversed(scenes_beside(Path(output), max(len(sensors), 1))):
        path = check_new(path, "a site", (".toml",), overwrite=overwrite)
        check_new(table_beside(path), "a table of modes", (".csv",), overwrite=overwrite)
    points = [point_of(text) for text in sensors]
    drawing = None if picture is None else new_picture(picture, overwrite=overwrite)
    scene = load_scene(scene_name)
    warn_of_one_place(scene)
    errors: dict[str, Any] = {
        "start_error": share_of("start_error", start_error),
        "drift": share_of("drift", drift),
        "participation_error": share_of("participation_error", participation_error),
    }
    parts = tuple(filter(None, (part.strip() for part in exact.split(","))))
    for part in parts:
        validation.choice("exact", part, PARTS)
    validation.whole("impacts", impacts, FEWEST)
    check_numbers(**errors, max_impacts=impacts)
    check_sensors(scene, points, scene.sampling.sampling_rate, errors["participation_error"])
    of_dimensions = dimensions.dimension_errors(scene, _of_each(dimension_error))
    frames, rate, before = _frames(recordings, scene, reading, len(points))
    say(f"{path}: learning from {min(impacts, len(frames))} of {counted(len(frames), 'usable impact')}", err=True)
    n_rounds = MAX_ROUNDS + dimensions.MAX_ROUNDS * bool(of_dimensions)
    with progress_bar(n_rounds, "rounds at most", "fitting beam", every=10.0) as progress:
        errors["dimension_error"] = of_dimensions
        errors |= {"exact": parts, "sensors": points, "max_impacts": impacts}
        found = calibrated(scene, frames, rate, before, progress=progress, **errors)
    found.save(path, overwrite=overwrite)
    if drawing is not None:
        _draw(found, drawing, overwrite)
    _say(found, path, as_json)


def _of_each(text: str) -> float | dict[str, float]:
    """Return the error of all dimensions, or of the named ones."""
    if "=" not in text:
        return share_of("--dimension-error", text)
    parts = (part.partition("=") for part in text.split(","))
    return {name.strip(): share_of("--dimension-error", value.strip()) for name, _, value in parts}


def _frames(
    recordings: tuple[str, ...], scene: Scene, reading: ReadingOptions, n_sensors: int
) -> tuple[NDArray[np.floating], float, int]:
    """Return frames of all usable impacts in the unit of the scene's sensor, their rate, and samples before onset."""
    from cgid.calibration.modes import FEWEST, frames_of, usable_impacts

    if any(reading.wants_complete_dataset(path) for path in recordings):
        if len(recordings) > 1:
            raise InvalidValue(f"{recordings[0]}: a dataset must be the only input, got {len(recordings)} recordings")
        if n_sensors:
            raise InvalidValue(f"--sensor must be left out, {recordings[0]} is a dataset of one sensor")
        return _of_dataset(recordings[0], scene)
    rocks: list[list[Event]] = []
    n_found, rate, every = 0, 0.0, dict.fromkeys(("overlapping", "clipped", "cut"), 0)
    for path in recordings:
        recording = reading.recording(path)
        if rate and not rates_agree(recording.sampling_rate, rate):
            raise BadData(f"{path}: all recordings must have one sampling rate, got {recording.sampling_rate:g} Hz")
        rate = recording.sampling_rate
        events = _found(recording, scene, reading, max(n_sensors, 1))
        usable, lost = usable_impacts(events)
        rocks += [[event] for event in usable] if n_sensors < 2 else _together(usable, n_sensors, rate, path)
        n_found += len(events)
        every = {name: n + lost[name] for name, n in every.items()}
    if len(rocks) < FEWEST:
        reasons = ", ".join(f"{n} {name}" for name, n in every.items() if n)
        raise BadData(
            f"{recordings[0]}: impacts that stand alone must be at least {FEWEST}, got {len(rocks)} of {n_found}"
            + (f" ({reasons})" if reasons else "")
            + "; record longer or with sparser drops, and below the sensor's range"
        )
    frames, before = frames_of([event for rock in rocks for event in rock])
    frames = np.asarray(frames, np.float64)
    return frames.reshape(len(rocks), n_sensors, -1) if n_sensors else frames, rate, before


def _together(usable: list[Event], n_sensors: int, rate: float, path: str) -> list[list[Event]]:
    """Return the impacts that all sensors measure, each by channel."""
    from cgid.identification.prediction.same_beam import CROSSING, SAME, RockAssigner

    usable = sorted(usable, key=lambda event: event.onset)
    assigner: RockAssigner[Event] = RockAssigner([range(n_sensors)], rate)
    rocks = assigner.feed(usable, math.inf)
    found = [sorted(rock, key=lambda event: event.channel) for rock in rocks if len(rock) == n_sensors]
    fewest = min(sum(event.channel == channel for event in usable) for channel in range(n_sensors))
    if len(found) < SAME * fewest:
        raise BadData(
            f"{path}: the channels must be of one beam, got {len(found)} of {fewest} impacts within "
            f"{1e3 * CROSSING:g} ms of each other; pick those of one beam with --channel"
        )
    return found


def _found(recording: Any, scene: Scene, reading: ReadingOptions, n_sensors: int) -> list[Event]:
    """Return the impacts of a recording in the unit of a scene's sensor."""
    from cgid.calibration.modes import check_scene
    from cgid.identification.training.impact_table import found_impacts
    from cgid.identification.training.recordings import unit_of

    if len(recording.channels) != n_sensors:
        raise BadData(
            f"{recording.source}: the recording must be of {counted(n_sensors, 'sensor')}, got "
            f"{counted(len(recording.channels), 'channel')}; pick by --channel, or place each by --sensor X,Y"
        )
    unit = unit_of(recording)
    quantity = quantity_of(unit)
    if quantity != scene.sensor.quantity:
        raise BadData(
            f"{recording.source}: the recording must be of {scene.sensor.quantity} like scene {scene.name}, got "
            f"{quantity} [{unit}]; choose another channel, or give "
            + ("--set full_scale='500 g'" if quantity == "level" else "--unit")
        )
    check_scene(scene, recording.sampling_rate)
    factor = UNITS[quantity][unit]
    return found_impacts(recording, "vibration", factor, dead_time=reading.dead_time, told=warn)


def _of_dataset(path: str, scene: Scene) -> tuple[NDArray[np.floating], float, int]:
    """Return the frames of a dataset, their rate and samples before onset."""
    from cgid.store import Dataset

    dataset = Dataset(path)
    first = dataset.signal(0)
    factor = UNITS[scene.sensor.quantity].get(first.unit or "")
    if factor is None:
        raise BadData(
            f"{path}: the dataset must be of {scene.sensor.quantity} like scene {scene.name}, got {first.unit}"
        )
    frames = np.concatenate([batch.signals for batch in dataset.batches()])
    return np.asarray(frames * factor, np.float64), first.sampling_rate, first.pre_trigger or 0


def _draw(found: SiteCalibration, path: Path, overwrite: bool) -> None:
    from cgid._lib.files import write_whole
    from cgid.plots.figure import modes_picture

    write_whole(path, modes_picture(found.start, found.learned), overwrite=overwrite)


def _content(found: SiteCalibration, path: Path) -> dict[str, Any]:
    """Return what is told of a calibrated sensor."""
    modes, change = found.learned, np.log(found.learned.frequency / found.start.frequency)
    deviation = modes.columns["frequency_deviation"]
    known = deviation < 0.5 * found.start.columns["frequency_deviation"]
    return {
        "scene": found.scene.name,
        "site": str(path),
        "n_impacts": found.n_impacts,
        "n_modes": int(modes.frequency.size),
        "n_learned": int(known.sum()),
        "frequency_change": float(np.median(np.abs(change[known]))) if known.any() else None,
        "frequency_deviation": float(np.median(deviation[known])) if known.any() else None,
        "dimensions": {
            one.name: {"before": one.before, "after": one.after, "deviation": one.deviation} for one in found.dimensions
        },
        "sensor": {name: {"before": before, "after": after} for name, (before, after) in found.chain.items()},
        "outside_contacts": found.outside,
        "evidence": {"before": found.before, "after": found.after, "expected": found.expected},
        "crossings": found.crossings,
        "at_rest": found.has_converged,
    }


def _say(found: SiteCalibration, path: Path, as_json: bool) -> None:
    from cgid.calibration.modes import scenes_beside

    sensors = (found, *found.others)
    contents = [_content(*each) for each in zip(sensors, scenes_beside(path, len(sensors)), strict=True)]
    if as_json:
        print_json(contents[0] | ({"others": contents[1:]} if found.others else {}))
    for content in [] if as_json else contents:
        learned = f"{content['n_learned']} of {content['n_modes']} modes learned"
        say(f"{content['site']}: {counted(content['n_impacts'], 'impact')}, {learned}")
        for name, one in content["dimensions"].items():
            unit = "" if name.endswith("ratio") else " m"
            known_to = f"standard deviation {100 * one['deviation']:.2g} %"
            say(f"{name}: {one['before']:.5g}{unit} before, {one['after']:.5g}{unit} after, {known_to}")
        for name, one in content["sensor"].items():
            unit = " Hz" if name.endswith("frequency") else ""
            before, after = (
                "none" if value is None else f"{value:.4g}{unit}" if isinstance(value, float) else value
                for value in (one["before"], one["after"])
            )
            say(f"sensor.{name}: {before} before, {after} after")
        if content["n_learned"]:
            say(
                f"natural frequencies changed by {content['frequency_change']:.3%} (median), standard deviation "
                f"{content['frequency_deviation']:.3%}"
            )
        evidence = content["evidence"]
        say(
            f"log-likelihood per sample {evidence['before']:.3g} before, {evidence['after']:.3g} after, "
            f"expected {evidence['expected']:.3g}"
        )
    if found.crossings:
        warn(f"{counted(found.crossings, 'pair')} of neighbouring modes swapped")
    if not found.has_converged:
        warn("the modes have not converged; use more impacts, or calibrate again")

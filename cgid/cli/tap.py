"""`cgid tap`: the modes of a beam from a recording of hammer taps."""

from __future__ import annotations

import itertools
import os
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, SCENE, json_option, overwrite_option, point_of, share_of
from cgid.cli.output import print_json, progress_bar, say, warn
from cgid.cli.reading import ReadingOptions, reading_options
from cgid.cli.site import keys
from cgid.errors import BadData, InvalidValue
from cgid.units import UNITS, quantity_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cgid.calibration import TapTest
    from cgid.calibration.splice import Span
    from cgid.measure.modal.modes import Modes

#: A delay of the hammer is told from here on [s].
_TOLD = 5e-6
#: Taps whose relative participations scatter by more than this were at several places.
_SCATTERED = 0.5
#: So large a part of the modes without a participation is no matter of weak ones.
_UNSURE = 0.5
#: A mode of which places predict less is coarsely sampled.
_COARSE = 0.3


@click.command(
    cls=Command,
    short_help="Find the modes of a beam in a recording of hammer taps.",
    example="cgid tap taps.csv --channel 1 --hammer 2 -o modes.csv --plot modes.png",
)
@click.argument("recording", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, help="Write the modes to this table (.csv).")
@click.option("--hammer", metavar="CHANNEL", help="Read the force of the hammer from this channel: its name or number.")
@click.option(
    "--band", nargs=2, type=float, metavar="LOW HIGH", help="Keep natural frequencies between LOW and HIGH [Hz]."
)
@click.option(
    "--taps",
    "table",
    type=PATH,
    help="Use only the taps listed in this table (.csv) in the column 'time_s'; of a roving hammer, 'x_m' and 'y_m' "
    "are the place of each tap.",
)
@click.option("--sensor", metavar="X,Y", help="Set the place of the sensor of a roving hammer [m].")
@click.option("--scene", "scene_name", type=SCENE, help="Write the modes of this scene's beam, corrected by the taps.")
@click.option(
    "--plot", "picture", type=OUTPUT, help="Plot the poles of all orders of the model, and the response, as PNG."
)
@overwrite_option
@json_option
@reading_options()
@keys(contact=2.0, start_error="1 %")
def tap(
    recording: str,
    output: str,
    hammer: str | None,
    band: tuple[float, float] | None,
    contact: float,
    table: str | None,
    sensor: str | None,
    scene_name: str | None,
    start_error: str,
    picture: str | None,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> None:
    """Find natural frequencies, damping ratios and participations of a beam in a RECORDING of hammer taps.

    Tap five to ten times at one point, a second or more apart, with any hammer; an accelerometer on the beam records.
    With an instrumented hammer, name its channel by --hammer: then participations are in 1/kg. The table is one for
    tail_beam.modes of a scene and, with --scene, for tail_beam.learned.

    A roving hammer taps a grid of places once or more each, one of them next to the sensor. Places closer than half of
    the shortest wave length give the shapes between them, in a table beside the first for tail_beam.shapes.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.calibration.roving import roving_test
    from cgid.calibration.splice import Splice
    from cgid.calibration.taps import read_taps, save_learned, tap_test
    from cgid.plots.figure import new_picture

    path = check_new(Path(output), "a table of modes (a scene, in .toml, names it)", (".csv",), overwrite=overwrite)
    drawing = None if picture is None else new_picture(picture, overwrite=overwrite)
    times, places = (None, None) if table is None else read_taps(table)
    _require_roving(places is not None, hammer, sensor)
    modes = None if scene_name is None else _modes_of(scene_name)
    error = share_of("start_error", start_error)
    if not 0 < error <= 0.1:
        raise InvalidValue(f"start_error must be above 0 and at most 10 %, got {error:g}")
    spans, rate, quantity = read_with_hammer(recording, hammer, reading, Splice.OVERLAP)
    splice = Splice(spans, rate, recording, times, 0 if places is None else len(places))
    with progress_bar(100, "%", "finding modes") as progress:
        options: dict[str, Any] = {"hammer": splice.force, "times": splice.inside(times), "quantity": quantity}
        options |= {"band": band or None, "source": recording, "progress": progress}
        if places is None:
            test = tap_test(splice.response, rate, contact=contact * 1e-3, **options)
        else:
            assert sensor is not None
            test = roving_test(splice.response, rate, places=places, sensor=point_of(sensor), **options)
    test = replace(test, taps=tuple(splice.placed(tap) for tap in test.taps))
    known = alike = None
    if modes is None:
        test.save(path, overwrite=overwrite)
    else:
        from cgid.calibration.matching import matched

        learned, known, alike = matched(test, modes, error)
        save_learned(learned, path, overwrite=overwrite)
    if drawing is not None:
        from cgid.plots.figure import stabilisation_picture

        write_whole(drawing, stabilisation_picture(test), overwrite=overwrite)
    # The ratios of modes are those of a place. The deviation is that of a mean over the taps.
    scatter = np.median(test.modes.deviation[2]) * np.sqrt(len(test.used)) if test.modes.deviation is not None else 0.0
    if hammer is None and len(test.used) > 1 and scatter > _SCATTERED:
        warn(
            f"{recording}: taps must be at one place, these excite modes in ratios {100 * scatter:.0f} % apart, "
            "as falling rocks do; frequencies and damping ratios hold, participations do not: tap one place"
        )
    unsure = 0 if test.modes.deviation is None else np.count_nonzero(test.modes.deviation[2] >= 1)
    if unsure > _UNSURE * test.modes.frequency.size:
        warn(
            f"{recording}: modes must be surer than their own size, {unsure} of {test.modes.frequency.size} are not: "
            "noise, or an exponential window of the recorder; switch that off, tap harder or narrow --band"
        )
    if len(test.used) == 1:
        warn("one tap: the standard deviations omit the variation between taps; tap about five times")
    _say(test, path, scene_name, known, alike, as_json)


def _later(hammer: Any, recording: Any) -> int:
    """Return by how many samples a hammer's channel begins after the response, as the file says; 0 if it does not."""
    first, other = (next(iter(one.starts), None) for one in (hammer, recording))
    count = 0 if first is None or other is None else round((first - other).total_seconds() * recording.sampling_rate)
    if count:
        say(
            f"hammer begins {1e3 * count / recording.sampling_rate:.6g} ms after the response in the file, moved",
            err=True,
        )
    return count


def _require_roving(roving: bool, hammer: str | None, sensor: str | None) -> None:
    """Raise `InvalidValue` unless the options fit a table of places, or one without."""
    if roving and (hammer is None or sensor is None):
        raise InvalidValue("--taps with places must be used with --hammer and --sensor; give its channel and its place")
    if not roving and sensor is not None:
        raise InvalidValue("--sensor must be used with a table of places; give --taps with the columns x_m and y_m")


def _modes_of(name: str) -> Modes:
    """Return the modes of a scene's beam."""
    from cgid.scene import load_scene
    from cgid.scene.synthesis.impacts import beam_modes

    scene = load_scene(name)
    if scene.tail_beam is None:
        raise InvalidValue(f"scene {scene.name}: must have a [tail_beam] to be compared with taps; add it")
    modes = beam_modes(scene)
    if (np.diff(modes.frequency) < 0).any():
        raise InvalidValue(
            f"scene {scene.name}: natural frequencies must ascend to be matched; remove the learned ones"
        )
    return modes


def read_with_hammer(
    path: str, hammer: str | None, reading: ReadingOptions, overlap: float
) -> tuple[Iterator[Span], float, str]:
    """Return stretches of a minute that overlap by some seconds, the rate and the response's quantity."""
    from cgid.calibration.taps import factor_of
    from cgid.identification.training.recordings import unit_of
    from cgid.recordings import is_dataset, open_recording

    if path == "-":
        raise InvalidValue("stdin: a recording of taps must be a file, it is read more than once; save it first")
    if is_dataset(path):
        raise InvalidValue(f"{path}: taps must be a recording, this is a dataset of impacts; record taps on the beam")
    chain: dict[str, Any] = {"sampling_rate": reading.sampling_rate, "site": reading.site, **reading.chain}
    # A unit for all channels is that of the response.
    by_name = reading.unit if "=" in (reading.unit or "") else None
    recorded_hammer, pull = None, 1.0
    if hammer is not None:
        recorded_hammer = open_recording(path, channel=hammer, unit=by_name, **chain)
        unit = unit_of(recorded_hammer)
        if quantity_of(unit) != "force" or len(recorded_hammer.channels) > 1:
            is_level = quantity_of(unit) == "level"
            raise BadData(
                f"{path}: --hammer must be one channel of force, got {quantity_of(unit)} [{unit}]; "
                + (f"give --set channels.{hammer}.full_scale='5 kN'" if is_level else "correct it")
            )
        pull = UNITS["force"][unit]
    channels: Any = reading.channel or None
    if recorded_hammer is not None and channels is None:
        every = open_recording(path, unit=by_name, **chain)
        channels = [one.name for one in every.channels if one.name != recorded_hammer.channels[0].name]
        if not channels:
            raise BadData(
                f"{path}: there must be a channel besides the hammer's, got none; record an accelerometer, too"
            )
    recording = open_recording(path, channel=channels, unit=reading.unit, **chain)
    forces = [one.name for one in recording.channels if one.unit is not None and one.quantity == "force"]
    if hammer is None and 0 < len(forces) < len(recording.channels):
        raise BadData(
            f"{path}: --hammer must name the channel of a force beside a response, got {', '.join(forces)} without it; "
            f"give --hammer {shlex.quote(forces[0])}"
        )
    if recorded_hammer is not None and recorded_hammer.channels[0].name in [one.name for one in recording.channels]:
        raise InvalidValue(f"{path}: --hammer and --channel must be different channels, got {hammer} for both")
    quantity, factor = factor_of(unit_of(recording), path)
    spans = _spans(recording, recorded_hammer, factor, pull, overlap)
    return spans, recording.sampling_rate, quantity


def _spans(recording: Any, hammer: Any, factor: float, pull: float, overlap: float) -> Iterator[Span]:
    """Yield stretches of a recording and of its hammer, in SI units; warnings are told at the end."""
    from cgid.calibration.splice import MINUTE, moved, spans_of

    rate = recording.sampling_rate
    forces = itertools.repeat(None) if hammer is None else moved(hammer.blocks(), _later(hammer, recording))
    blocks = (
        np.asarray(block, np.float64) if force is None else np.concatenate([block, force]).astype(np.float64)
        for block, force in zip(recording.blocks(), forces, strict=hammer is not None)
    )
    for first, samples, last in spans_of(blocks, round(MINUTE * rate), round(overlap * rate)):
        force = None if hammer is None else samples[-1] * pull
        yield first, samples[: len(recording.channels)] * factor, force, last
    for warning in recording.warnings:
        warn(warning)


def _say(test: TapTest, path: Path, scene: str | None, known: Any, alike: Any, as_json: bool) -> None:
    """Print the modes, and how to use them; those matched with a scene's, and how alike both are."""
    from cgid.calibration.matching import LEAST_MAC
    from cgid.calibration.roving import RovingTest
    from cgid.measure.modal.modes import are_lines, shapes_beside

    content = _content(test, path, known, alike)
    if as_json:
        print_json(content)
        return
    unit = "1/kg" if test.modes.scaled else "of the largest"
    say(
        f"{path}: {counted(test.modes.frequency.size, 'mode')} from {test.band[0]:.4g} to {test.band[1]:.5g} Hz, "
        f"{len(test.used)} of {counted(len(test.taps), 'tap')} used, {test.duration:.3g} s of each"
    )
    for one in content["taps"]:
        if one["flaw"]:
            say(f"tap at {one['time']:.4g} s not used: {one['flaw']}")
    if abs(test.delay) >= _TOLD:
        say(f"hammer recorded {1e3 * abs(test.delay):.3g} ms {'late' if test.delay > 0 else 'early'}, corrected")
    if test.unexplained is not None and len(test.used) > 1:
        left = sorted(test.unexplained.tolist())[len(test.used) // 2]
        say(f"{100 * left:.2g} % of a tap is not explained by the modes from the others (median)")
    if isinstance(test, RovingTest):
        worst, middle = test.modes.frequency[test.unpredicted > _COARSE], sorted(test.unpredicted.tolist())
        say(
            f"{len(test.places)} places: {100 * middle[len(middle) // 2]:.2g} % of a mode is not predicted by other "
            f"places (median), more than {100 * _COARSE:.0f} % of {counted(len(worst), 'mode')}"
            + (f", {worst.min():.4g} to {worst.max():.4g} Hz: weak, or the grid is too coarse" if len(worst) else "")
        )
    outside = int(are_lines(test.response.damping_ratio).sum())
    split = test.response.frequency.size - outside - test.modes.frequency.size
    if outside:
        and_split = f", {split} for decays that are not exponential" if split > 0 else ""
        say(f"{counted(outside, 'more row')} of the table for modes outside of the band{and_split}")
    say(f"{'frequency [Hz]':>20}{'damping ratio [%]':>22}{f'participation [{unit}]':>32}")
    for mode in content["modes"]:
        deviations = [mode[f"{name}_deviation"] for name in ("frequency", "damping_ratio", "participation")]
        say(
            f"{mode['frequency']:>12.6g} +- {mode['frequency'] * deviations[0]:<8.2g}"
            f"{100 * mode['damping_ratio']:>10.4g} +- {100 * mode['damping_ratio'] * deviations[1]:<8.2g}"
            f"{mode['participation']:>16.4g} +- {abs(mode['participation']) * deviations[2]:.2g}"
        )
    if known is None and isinstance(test, RovingTest):
        (x_low, y_low), (x_high, y_high) = test.places.min(axis=0), test.places.max(axis=0)
        say(
            f'cgid: hint: name the tables in a scene, modes = "{path.name}", learned = "{path.name}" and shapes = '
            f'"{shapes_beside(path).name}" below [tail_beam] in place of its panel, with impact_point from '
            f"{x_low:g} to {x_high:g} m and {y_low:g} to {y_high:g} m, then cgid check support.toml",
            err=True,
        )
    elif known is None:
        say(
            f'cgid: hint: name the table in a scene, modes = "{path.name}" and learned = "{path.name}" below '
            "[tail_beam] in place of its panel, then cgid check support.toml",
            err=True,
        )
    else:
        say(f"{int((known >= 0).sum())} of {known.size} modes of {scene} corrected")
        if not all(one != one for one in alike.tolist()):
            shown = sorted(one for one in alike.tolist() if one == one)
            say(
                f"MAC of matched modes {shown[len(shown) // 2]:.2f} (median), {sum(one < LEAST_MAC for one in shown)} "
                f"below {LEAST_MAC:g} not corrected"
            )
        table = Path(os.path.relpath(path, Path(scene or "").parent)).as_posix()
        say(
            f'cgid: hint: put learned = "{table}" below [tail_beam] of {scene}; impacts then teach '
            f"the other modes: cgid calibrate RECORDING --scene {scene} -o site.toml",
            err=True,
        )


def _content(test: TapTest, path: Path, known: Any, alike: Any) -> dict[str, Any]:
    columns = {**test.modes.columns, "orders": test.poles.orders}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return {
        "output": str(path),
        "duration": test.duration,
        "band": list(test.band),
        "absolute": test.modes.scaled,
        "delay": test.delay,
        "unexplained": None if test.unexplained is None else test.unexplained.tolist(),
        "n_matched": None if known is None else int((known >= 0).sum()),
        "mac": None if alike is None else [None if one != one else one for one in alike.tolist()],
        "taps": [{"time": one.time, "used": not one.flaw, "flaw": one.reason} for one in test.taps],
        "modes": [dict(zip(columns, row, strict=True)) for row in rows],
    }

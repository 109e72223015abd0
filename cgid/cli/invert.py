"""`cgid invert`: the force of impacts from the motion of the beam, where it was tapped or anywhere on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, SCENE, json_option, overwrite_option
from cgid.cli.output import print_json, say, warn, warn_of_one_place
from cgid.cli.reading import ReadingOptions, reading_options
from cgid.cli.site import keys
from cgid.cli.tap import read_with_hammer
from cgid.errors import InvalidValue

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cgid.calibration.forces import ImpactForce
    from cgid.calibration.splice import Span

#: Where more than this fraction of the amplitude is left, forces are those of another beam.
_WRONG = 0.5


@click.command(
    cls=Command,
    short_help="Recover the force of impacts from the motion of a beam.",
    example="cgid tap taps.csv --channel 1 --hammer 2 --band 60 2000 -o modes.csv\n"
    "cgid invert taps.csv --channel 1 --hammer 2 --modes modes.csv -o forces.csv",
)
@click.argument("recording", type=PATH)
@click.option(
    "--modes",
    "tables",
    type=PATH,
    multiple=True,
    help="Use this table of cgid tap --hammer, for impacts at the place of its taps; repeat it for each channel.",
)
@click.option("--scene", "scene_name", type=SCENE, help="Look for the place of each impact on the beam of this scene.")
@click.option("-o", "--output", type=OUTPUT, help="Write force and standard deviation over time to this table (.csv).")
@click.option("--hammer", metavar="CHANNEL", help="Compare with the force measured in this channel.")
@click.option(
    "--band", nargs=2, type=float, metavar="LOW HIGH", help="Use LOW to HIGH [Hz], instead of the band of the taps."
)
@overwrite_option
@json_option
@reading_options()
@keys(longest_contact=6.0)
def invert(
    recording: str,
    tables: tuple[str, ...],
    scene_name: str | None,
    output: str | None,
    hammer: str | None,
    band: tuple[float, float] | None,
    longest_contact: float,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> None:
    """Recover the contact force of each impact in a RECORDING of a beam's motion, or a signal of a dataset (index).

    A table of cgid tap holds the modes of one place: only impacts there can be inverted. On the beam of a scene, which
    has a drawing or shapes of a roving hammer, the place of each impact is looked for as cgid predict does, and the
    force is a pulse of its family.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.calibration.forces import OVERLAP, forces_in
    from cgid.recordings import is_dataset

    path = None if output is None else check_new(Path(output), "a table of forces", (".csv",), overwrite=overwrite)
    modes = _modes_of(tables, scene_name, band)
    if recording != "-" and is_dataset(recording):
        spans, rate, quantity = _frame_of(recording, hammer, reading)
    else:
        spans, rate, quantity = read_with_hammer(recording, hammer, reading, OVERLAP)
    rows: list[dict[str, Any]] = []
    text: list[str] = []
    left_out: list[str] = []

    def told(why: str) -> None:
        left_out.append(why)
        warn(why)

    options: dict[str, Any] = {"quantity": quantity, "band": band or None, "contact": longest_contact * 1e-3}
    for one in forces_in(spans, rate, modes, source=recording, told=told, **options):
        rows.append(_row(one))
        if path is not None:
            text += _lines(len(rows), one)
    for row in rows:
        if row["clipped"]:
            warn(f"impact at {row['time']:.4g} s: the response is clipped, its force is wrong; use a larger range")
        if 0 < row["duration"] < row.pop("shortest"):
            warn(
                f"impact at {row['time']:.4g} s: the contact is as short as the band can show, so its force may be "
                "shorter and higher; widen the --band of the taps"
            )
        if row["peak"] <= 0:
            warn(f"impact at {row['time']:.4g} s: the force pulls; is it inverted (--set invert=true), or elsewhere?")
    if left_out:
        warn(f"{recording}: {len(left_out)} of {len(rows) + len(left_out)} impacts left out, for these reasons")
    left = sorted(row["unexplained"] for row in rows)[len(rows) // 2]
    if left > _WRONG:
        warn(
            f"{recording}: the modes must explain most of the vibration, {100 * left:.0f} % is left (median), so "
            "forces are wrong; check the beam, the sensor and the sampling rate of the recorder"
        )
    if path is not None:
        title = "impact,time [s],force [N],deviation [N]" + ("" if hammer is None else ",measured [N]")
        title += ",x [m],y [m]" if scene_name is not None else ""
        write_whole(path, "\n".join([title, *text, ""]).encode(), overwrite=overwrite)
    if as_json:
        print_json({"output": output, "impacts": rows, "left_out": left_out})
        return
    say(f"{recording}: {counted(len(rows), 'impact')}")
    place = "" if scene_name is None else f"{'x [mm]':>18}{'y [mm]':>16}"
    say(f"{'time [s]':>10}{'peak [N]':>24}{'duration [ms]':>15}{'impulse [N s]':>26}{'unexplained [%]':>17}{place}")
    for row in rows:
        place = "".join(
            f"{1e3 * row[axis]:>8.0f} +- {1e3 * row[f'{axis}_deviation']:<4.1f}" for axis in "xy" if axis in row
        )
        say(
            f"{row['time']:>10.5g}{row['peak']:>12.5g} +- {row['peak_deviation']:<8.2g}{1e3 * row['duration']:>15.4g}"
            f"{row['impulse']:>14.4g} +- {row['impulse_deviation']:<8.2g}{100 * row['unexplained']:>17.3g}{place}"
        )
        if "errors" in row:
            errors = dict(row["errors"])
            late = errors.pop("delay")
            errors_text = ", ".join(f"{name} {100 * value:+.2g} %" for name, value in errors.items())
            say(f"{'':>10}  beside the measured force, {1e3 * late:+.2g} ms later: {errors_text}")


def _frame_of(path: str, hammer: str | None, reading: ReadingOptions) -> tuple[Iterable[Span], float, str]:
    """Return one signal of a dataset as `read_with_hammer` returns a recording."""
    from cgid.calibration.taps import factor_of

    if hammer is not None:
        raise InvalidValue(f"{path}: --hammer must be left out, a dataset has no channel of a hammer")
    if reading.wants_complete_dataset(path):
        raise InvalidValue(f"{path}: index must choose one signal of this dataset, from 0; give --set index=0")
    (signal,) = reading.signals(path)
    quantity, factor = factor_of(str(signal.unit), path)
    return [(0, factor * np.atleast_2d(signal.samples), None, True)], signal.sampling_rate, quantity


def _modes_of(tables: tuple[str, ...], scene_name: str | None, band: tuple[float, float] | None) -> Any:
    """Return the modes of tables, or the beam of a scene."""
    if bool(tables) == (scene_name is not None):
        raise InvalidValue(
            "--modes or --scene must be given, and not both: a table of modes for impacts at the place of its taps, a "
            "scene for impacts anywhere on its beam; choose one"
        )
    if scene_name is None:
        from cgid.measure.modal.modes import read_modes, shapes_beside

        for shapes in map(shapes_beside, tables):
            if shapes.exists():
                raise InvalidValue(
                    f"--modes must be a table of taps at one place, {shapes} beside it says that a hammer roved; name "
                    "both in a scene, and give that as --scene"
                )
        return [read_modes(table) for table in tables]
    if band:
        raise InvalidValue("--band must be left out with --scene, whose sensor has the band; change it there")
    from cgid.scene import load_scene
    from cgid.scene.synthesis.through_beam import beam_of, why_no_beam

    scene = load_scene(scene_name)
    if why := why_no_beam(scene):
        raise InvalidValue(
            f"scene {scene.name}: must have a beam to look through, but {why}; change it, or give --modes"
        )
    warn_of_one_place(scene)
    return beam_of(scene)


def _row(one: ImpactForce) -> dict[str, Any]:
    """Return the numbers of one impact, with errors where the force was measured."""
    found = one.found
    peak, impulse = found.peak, found.impulse
    row: dict[str, Any] = {
        "time": float(found.time[0]),
        "peak": peak[0],
        "peak_deviation": peak[1],
        "duration": found.duration,
        "shortest": found.shortest,
        "impulse": impulse[0],
        "impulse_deviation": impulse[1],
        "unexplained": found.unexplained,
        "clipped": one.clipped,
    }
    if found.place is not None and found.place_deviation is not None:
        for axis, place, deviation in zip("xy", found.place, found.place_deviation, strict=True):
            row |= {axis: place, f"{axis}_deviation": deviation}
    return row if one.errors is None else {**row, "errors": one.errors}


def _lines(number: int, one: ImpactForce) -> list[str]:
    """Return the rows of a table of forces, one for each time."""
    found = one.found
    columns = [found.time, found.force, found.deviation]
    columns += [] if one.measured is None else [one.measured]
    place = "" if found.place is None else ",{:.6g},{:.6g}".format(*found.place)
    return [
        f"{number}," + ",".join(f"{float(value):.9g}" for value in row) + place for row in zip(*columns, strict=True)
    ]
